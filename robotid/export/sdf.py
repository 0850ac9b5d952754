"""Write an identified robot as SDF 1.9, which Gazebo and Drake read."""

import xml.etree.ElementTree as ET
from pathlib import Path

from robotid._files import write_text
from robotid._typing import Array
from robotid.export.links import (
    WORLD,
    SimulatedLink,
    head_comment,
    leader_of,
    left_out_notes,
    quaternion,
    simulated_links,
)
from robotid.export.urdf import numbers_text
from robotid.robot.bodies import central_inertial
from robotid.robot.meshes import Shape
from robotid.robot.model import RobotModel
from robotid.robot.tree import MOMENTS, Joint

__all__ = ["write_sdf"]

_VERSION, _VERSION_OF_MIMIC = "1.9", "1.11"
_DRAKE = "drake.mit.edu"
#: Element of a joint's ``<dynamics>`` that states a term of its drive.
_DYNAMICS = {"viscous": "damping", "coulomb": "friction"}
_ROTOR = "armature"  # stated by an element of Drake's own
_MESHES = (".dae", ".stl", ".obj", ".glb", ".gltf")
_SIZES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length")}


def write_sdf(
    model: RobotModel, pi: Array, target: str | Path, *, original: str | Path | None = None
) -> tuple[str, ...]:
    """Write standard parameters as an SDF file of one model.

    A link that a joint moves has the inertial of all that are fixed to it, which are frames; links
    behind locked joints keep their own. Viscous and Coulomb friction are the joint's damping and
    friction; the armature is Drake's rotor inertia, which Gazebo has no place for.

    Args:
        model: The robot.
        pi: Standard parameters, shape (p,), SI units, in ``layout.names`` order.
        target: The file to write.
        original: The URDF that the model's was made of, beside which meshes are looked for, too.

    Returns:
        What the file does not state, a sentence each; its head has them, too.

    Raises:
        DataError: If pi does not have p finite entries, or the folder does not exist.
        ModelError: If a link or a drive would be physically impossible.
        SettingsError: If the target is a folder.
    """
    links, meshes = simulated_links(model, pi, _is_readable, [original] if original else [])
    values = dict(zip(model.layout.names, pi.tolist(), strict=True))
    notes = left_out_notes("SDF", model, pi, (*_DYNAMICS, _ROTOR), meshes)
    notes.append("Drake reads armature (drake:rotor_inertia), not friction; Gazebo the reverse")
    gravity = numbers_text(model.pin_model.gravity.linear)
    notes.append(
        f"gravity is the world's to state: <gravity>{gravity}</gravity> was identified with"
    )
    leaders = {
        link.joint.name: leader
        for link in links
        if link.joint is not None and (leader := leader_of(model, link.joint))
    }
    version = _VERSION_OF_MIMIC if leaders else _VERSION
    top = ET.Element("sdf", {"version": version, "xmlns:drake": _DRAKE})
    top.append(ET.Comment(head_comment(model, notes)))
    robot = ET.SubElement(top, "model", name=model.name)
    holders: dict[str, ET.Element] = {}  # the element that shows what a link looks like
    for link in links:
        is_fixed = link.joint is None and not (model.free_flyer and link.parent == WORLD)
        if is_fixed and link.inertial is None and link.parent in holders:
            frame = ET.SubElement(robot, "frame", name=link.name, attached_to=link.parent)
            _add_pose(frame, link.placement, link.parent)
            holders[link.name] = holders[link.parent]
        else:
            holders[link.name] = _add_link(robot, link)
            if is_fixed:
                joint = ET.SubElement(robot, "joint", name=f"{link.name}_fixed", type="fixed")
                _add_ends(joint, link)
            elif link.joint is not None:
                _add_joint(robot, link, link.joint, values, leaders.get(link.joint.name))
        for number, (tag, shape) in enumerate(link.shapes):
            _add_shape(holders[link.name], f"{link.name}_{number}", link.name, tag, shape)
    ET.indent(top)
    write_text(ET.tostring(top, encoding="unicode") + "\n", target)
    return tuple(notes)


def _is_readable(mesh: Path) -> bool:
    return mesh.suffix.lower() in _MESHES


def _add(parent: ET.Element, tag: str, *values: float) -> ET.Element:
    element = ET.SubElement(parent, tag)
    element.text = numbers_text(values)
    return element


def _add_pose(parent: ET.Element, placement: Array, relative_to: str = "") -> None:
    pose = _add(parent, "pose", *placement[:3, 3], *quaternion(placement))
    pose.set("rotation_format", "quat_xyzw")
    if relative_to not in ("", WORLD):
        pose.set("relative_to", relative_to)


def _add_ends(joint: ET.Element, link: SimulatedLink) -> None:
    for tag, name in (("parent", link.parent), ("child", link.name)):
        ET.SubElement(joint, tag).text = name


def _add_link(robot: ET.Element, link: SimulatedLink) -> ET.Element:
    element = ET.SubElement(robot, "link", name=link.name)
    _add_pose(element, link.placement, link.parent)
    if link.inertial is not None:
        inertial, stated = ET.SubElement(element, "inertial"), central_inertial(link.inertial)
        _add(inertial, "pose", *stated.com, 0.0, 0.0, 0.0)
        _add(inertial, "mass", stated.mass)
        inertia = ET.SubElement(inertial, "inertia")
        for tag, moment in zip(MOMENTS, stated.inertia, strict=True):
            _add(inertia, tag, moment)
    return element


def _add_joint(
    robot: ET.Element,
    link: SimulatedLink,
    joint: Joint,
    values: dict[str, float],
    leader: tuple[str, float, float] | None,
) -> None:
    element = ET.SubElement(robot, "joint", name=joint.name, type=joint.type)
    _add_ends(element, link)
    axis = ET.SubElement(element, "axis")
    _add(axis, "xyz", *joint.axis)
    if leader is not None:
        name, ratio, offset = leader
        mimic = ET.SubElement(axis, "mimic", joint=name)
        for tag, value in (("multiplier", ratio), ("offset", offset), ("reference", 0.0)):
            _add(mimic, tag, value)
    limit = ET.SubElement(axis, "limit")
    stated = {"lower": joint.lower, "upper": joint.upper} if joint.has_limits else {}
    for tag, value in (stated | {"effort": joint.effort, "velocity": joint.velocity}).items():
        if 0.0 < abs(value) < float("inf") or tag in stated:
            _add(limit, tag, value)
    dynamics = ET.SubElement(axis, "dynamics")
    for term, tag in _DYNAMICS.items():
        if (drive := values.get(f"{joint.name}.{term}")) is not None:
            _add(dynamics, tag, drive)
    if (rotor := values.get(f"{joint.name}.{_ROTOR}")) is not None:
        _add(element, "drake:rotor_inertia", rotor)
        _add(element, "drake:gear_ratio", 1.0)


def _add_shape(holder: ET.Element, name: str, frame: str, tag: str, shape: Shape) -> None:
    element = ET.SubElement(holder, tag, name=name)
    _add_pose(element, shape.placement, frame)
    geometry = ET.SubElement(ET.SubElement(element, "geometry"), shape.kind)
    if shape.kind == "mesh":
        ET.SubElement(geometry, "uri").text = Path(shape.file).as_uri()
        _add(geometry, "scale", *shape.size)
    elif shape.kind == "box":
        _add(geometry, "size", *shape.size)
    else:
        for size, value in zip(_SIZES[shape.kind], shape.size, strict=True):
            _add(geometry, size, value)
    if tag == "visual" and shape.rgba is not None:
        material = ET.SubElement(element, "material")
        for lit in ("ambient", "diffuse"):
            _add(material, lit, *shape.rgba)
