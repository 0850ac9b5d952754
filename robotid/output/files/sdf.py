"""Write an identified robot as SDF 1.9, which Gazebo and Drake read."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from robotid.base.typing import Array
from robotid.output.files.exports import (
    WORLD,
    Exported,
    Format,
    SimulatedLink,
    Written,
    XmlFormat,
    write_model,
)
from robotid.output.files.result_file import Result
from robotid.output.files.urdf import numbers_text
from robotid.robot.bodies import Shape, central_inertial
from robotid.robot.model import RobotModel
from robotid.robot.tree import MOMENTS, Joint

_VERSION, _VERSION_OF_MIMIC = "1.9", "1.11"
#: Element of a joint's ``<dynamics>`` that states a term of its drive.
_DYNAMICS = {"viscous": "damping", "coulomb": "friction"}
_ROTOR = "armature"  # stated by an element of Drake
_TERMS = (*_DYNAMICS, _ROTOR)
_MESHES = (".dae", ".stl", ".obj", ".glb", ".gltf")
_SIZES = {"sphere": ("radius",), "cylinder": ("radius", "length")}

FORMAT = Format("sdf", "SDF 1.9, for Gazebo and Drake", ".sdf")


def export(result: Result, target: Path) -> Written:
    """Write a result as SDF."""
    of = Exported.of(result, _TERMS)
    notes = write_sdf(of.model, of.pi, target, original=of.original, notes=of.notes)
    return of.written(target, notes=notes)


def write_sdf(
    model: RobotModel,
    pi: Array,  # (p,)
    target: str | Path,
    *,
    original: str | Path | None = None,  # a further URDF to which paths of meshes may be relative
    notes: Sequence[str] = (),
) -> tuple[str, ...]:
    """Write standard parameters as an SDF file; return what it does not state, as in its head.

    The inertial of a moving link includes those of all links fixed to it, which are frames. Links
    beyond locked joints have their own inertial. Viscous and Coulomb friction are the joint's
    damping and friction; the armature is Drake's rotor inertia, which Gazebo does not read.
    """
    gravity = numbers_text(model.pin_model.gravity.linear)
    every = [
        *notes,
        "Drake reads armature (drake:rotor_inertia), not friction; Gazebo reads friction, not "
        "armature",
        f"gravity is a property of the world; the identification used <gravity>{gravity}</gravity>",
    ]
    to = XmlFormat("SDF", _TERMS, False, lambda mesh: mesh.suffix.lower() in _MESHES)
    return write_model(model, pi, target, original, to, partial(_sdf, model.name), every)


def _sdf(name: str, links: Sequence[SimulatedLink], values: Mapping[str, float]) -> ET.Element:
    version = _VERSION_OF_MIMIC if any(link.leader for link in links) else _VERSION
    top = ET.Element("sdf", {"version": version, "xmlns:drake": "drake.mit.edu"})
    robot = ET.SubElement(top, "model", name=name)
    holders: dict[str, ET.Element] = {}  # the element with the shapes of a link
    for link in links:
        is_frame = not (link.moves or link.floats) and link.inertial is None
        if is_frame and link.parent in holders:
            frame = ET.SubElement(robot, "frame", name=link.name, attached_to=link.parent)
            _add_pose(frame, link.pose, link.parent)
            holders[link.name] = holders[link.parent]
        else:
            holders[link.name] = _add_link(robot, link)
            if not link.floats:
                _add_joint(robot, link, values)
        for number, (tag, shape, pose, mesh) in enumerate(link.shapes):
            element = ET.SubElement(holders[link.name], tag, name=f"{link.name}_{number}")
            _add_pose(element, pose, link.name)
            _add_geometry(element, shape, mesh)
    return top


def _add(parent: ET.Element, tag: str, *values: float) -> ET.Element:
    element = ET.SubElement(parent, tag)
    element.text = numbers_text(values)
    return element


def _add_pose(parent: ET.Element, pose: Array, relative_to: str) -> None:
    element = _add(parent, "pose", *pose)
    element.set("rotation_format", "quat_xyzw")
    if relative_to != WORLD:
        element.set("relative_to", relative_to)


def _add_link(robot: ET.Element, link: SimulatedLink) -> ET.Element:
    element = ET.SubElement(robot, "link", name=link.name)
    _add_pose(element, link.pose, link.parent)
    if link.inertial is not None:
        inertial, stated = ET.SubElement(element, "inertial"), central_inertial(link.inertial)
        _add(inertial, "pose", *stated.com, 0.0, 0.0, 0.0)
        _add(inertial, "mass", stated.mass)
        inertia = ET.SubElement(inertial, "inertia")
        for tag, moment in zip(MOMENTS, stated.inertia, strict=True):
            _add(inertia, tag, moment)
    return element


def _add_joint(robot: ET.Element, link: SimulatedLink, values: Mapping[str, float]) -> None:
    joint = link.joint or Joint(f"{WORLD}_to_{link.name}", "fixed", WORLD, link.name)
    kind = joint.type if link.moves else "fixed"
    element = ET.SubElement(robot, "joint", name=joint.name, type=kind)
    ET.SubElement(element, "parent").text = link.parent
    ET.SubElement(element, "child").text = link.name
    if not link.moves:
        return
    axis = ET.SubElement(element, "axis")
    _add(axis, "xyz", *joint.axis)
    if link.leader is not None:
        leader, ratio, offset = link.leader
        mimic = ET.SubElement(axis, "mimic", joint=leader)
        for tag, value in (("multiplier", ratio), ("offset", offset), ("reference", 0.0)):
            _add(mimic, tag, value)
    limit, dynamics = ET.SubElement(axis, "limit"), ET.SubElement(axis, "dynamics")
    if joint.has_limits:
        _add(limit, "lower", joint.lower)
        _add(limit, "upper", joint.upper)
    for tag, value in (("effort", joint.effort), ("velocity", joint.velocity)):
        if 0.0 < value < np.inf:
            _add(limit, tag, value)
    for term, tag in _DYNAMICS.items():
        if (drive := values.get(f"{joint.name}.{term}")) is not None:
            _add(dynamics, tag, drive)
    if (rotor := values.get(f"{joint.name}.{_ROTOR}")) is not None:
        _add(element, "drake:rotor_inertia", rotor)
        _add(element, "drake:gear_ratio", 1.0)


def _add_geometry(element: ET.Element, shape: Shape, mesh: Path | None) -> None:
    geometry = ET.SubElement(ET.SubElement(element, "geometry"), shape.kind)
    if mesh is not None:
        ET.SubElement(geometry, "uri").text = mesh.as_uri()
        _add(geometry, "scale", *shape.size)
    elif shape.kind == "box":
        _add(geometry, "size", *shape.size)
    else:
        for tag, value in zip(_SIZES[shape.kind], shape.size, strict=True):
            _add(geometry, tag, value)
    if element.tag == "visual" and shape.rgba is not None:
        material = ET.SubElement(element, "material")
        for tag in ("ambient", "diffuse"):
            _add(material, tag, *shape.rgba)
