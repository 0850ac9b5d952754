"""Write an identified robot as MJCF, the format of MuJoCo, which need not be installed."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robotid._typing import Array
from robotid.export.links import WORLD, Format, SimulatedLink, own_drives, write_model
from robotid.export.urdf import numbers_text
from robotid.robot.bodies import principal_moments
from robotid.robot.model import RobotModel

__all__ = ["write_mjcf"]

#: Attribute of a joint, or of a tendon over several, that states a term of a drive.
_ATTRIBUTES = {
    "armature": "armature",
    "viscous": "damping",
    "coulomb": "frictionloss",
    "spring": "stiffness",
}
_OFFSET = "offset"  # stated by the actuator's bias
#: Sizes of a geom over those of a shape in a URDF: MuJoCo states half lengths.
_SIZES = {"box": (0.5,), "sphere": (1.0,), "cylinder": (1.0, 0.5)}
_SEEN = {"group": "2"}  # what the viewer shows by default
#: What is only seen, and what touches the world but not the robot itself.
_GEOMS = {
    "visual": _SEEN | {"contype": "0", "conaffinity": "0"},
    "collision": {"group": "3", "contype": "1", "conaffinity": "0"},
}
#: How friction gives way: with MuJoCo's 0.9 a light joint creeps under less than its friction.
_STIFF = {"solimpfriction": "0.999 0.999 0.001 0.5 2"}
_COMPILER = {
    "angle": "radian", "autolimits": "true", "inertiafromgeom": "false", "balanceinertia": "false",
    "boundmass": "0", "boundinertia": "0",
}  # fmt: skip
_MOST_FACES = 200_000  # of a mesh that MuJoCo reads
_STL_HEAD, _STL_FACE = 84, 50  # bytes; MuJoCo reads no STL written as text


def write_mjcf(
    model: RobotModel, pi: Array, target: str | Path, *, original: str | Path | None = None
) -> tuple[str, ...]:
    """Write standard parameters as an MJCF file.

    Every link is a body; the one that a joint moves has the inertial of all that are fixed to it.
    Armature, viscous and Coulomb friction are the joint's armature, damping and frictionloss, or
    those of a tendon over the joints that a drive turns with. The torque offset is the bias of the
    joint's actuator, whose control is the drive's torque. A frictionloss is a soft constraint:
    ``mj_inverse`` gives Fc sign(v) where the joint moves, and less where it hardly does.

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
    to = Format("MJCF", (*_ATTRIBUTES, _OFFSET), True, _is_readable)
    return write_model(model, pi, target, original, to, partial(_mjcf, model))


def _is_readable(mesh: Path) -> bool:
    """Whether MuJoCo reads a mesh: OBJ, or STL in binary with a usual number of faces."""
    if mesh.suffix.lower() != ".stl":
        return mesh.suffix.lower() == ".obj"
    with mesh.open("rb") as stream:
        head = stream.read(_STL_HEAD)
    faces = int.from_bytes(head[_STL_HEAD - 4 :], "little")
    size = _STL_HEAD + _STL_FACE * faces
    return 1 <= faces <= _MOST_FACES and mesh.stat().st_size == size


def _mjcf(
    model: RobotModel, links: Sequence[SimulatedLink], values: Mapping[str, float]
) -> ET.Element:
    top = ET.Element("mujoco", model=model.name)
    ET.SubElement(top, "compiler", _COMPILER)
    gravity = numbers_text(model.pin_model.gravity.linear)
    ET.SubElement(top, "option", gravity=gravity, integrator="implicitfast")
    default, assets = ET.SubElement(top, "default"), ET.SubElement(top, "asset")
    for tag in ("joint", "tendon"):
        ET.SubElement(default, tag, _STIFF)
    for name, conduct in _GEOMS.items():
        ET.SubElement(ET.SubElement(default, "default", {"class": name}), "geom", conduct)
    own, bodies = own_drives(model, values), {WORLD: ET.SubElement(top, "worldbody")}
    for link in links:
        at = {"name": link.name} | _pose(link.pose)
        bodies[link.name] = body = ET.SubElement(bodies[link.parent], "body", at)
        _add_motion(body, link, own)
        _add_geoms(body, link, assets)
    _add_drives(top, model, links, values)
    return top


def _add_motion(body: ET.Element, link: SimulatedLink, values: Mapping[str, float]) -> None:
    """Add the inertial of a link, and the joint that moves it."""
    if link.inertial is not None:
        moments, axes = principal_moments(link.inertial)
        x, y, z = np.maximum(moments, 0.0)  # sums of them are possible to the last bit
        pose = np.append(
            link.inertial[1:4] / link.inertial[0], Rotation.from_matrix(axes).as_quat()
        )
        mass, inertia = numbers_text(link.inertial[:1]), numbers_text([y + z, z + x, x + y])
        ET.SubElement(body, "inertial", _pose(pose) | {"mass": mass, "diaginertia": inertia})
    if link.floats:
        ET.SubElement(body, "freejoint", name="root_joint")
    if (joint := link.joint) is not None and link.moves:
        kind = "slide" if joint.type == "prismatic" else "hinge"
        at = {"name": joint.name, "type": kind, "axis": numbers_text(joint.axis)}
        if joint.has_limits:
            at["range"] = numbers_text([joint.lower, joint.upper])
        ET.SubElement(body, "joint", at | _drive(joint.name, values))


def _add_geoms(body: ET.Element, link: SimulatedLink, assets: ET.Element) -> None:
    """Add the shapes of a link; what it touches with is shown if nothing else can be."""
    is_seen = any(tag == "visual" for tag, *_ in link.shapes)
    for tag, shape, pose, mesh in link.shapes:
        at = {"class": tag} | ({} if is_seen else _SEEN) | _pose(pose)
        if mesh is None:
            sizes = numbers_text(np.multiply(shape.size, _SIZES[shape.kind]))
            at |= {"type": shape.kind, "size": sizes}
        else:
            at |= {"type": "mesh", "mesh": f"{mesh.stem}_{len(assets)}"}
            # as a shell: many of what is only looked at enclose no volume
            asset = {"name": at["mesh"], "file": str(mesh), "scale": numbers_text(shape.size)}
            ET.SubElement(assets, "mesh", asset | {"inertia": "shell"})
        if shape.rgba is not None:
            at["rgba"] = numbers_text(shape.rgba)
        ET.SubElement(body, "geom", at)


def _add_drives(
    top: ET.Element,
    model: RobotModel,
    links: Sequence[SimulatedLink],
    values: Mapping[str, float],
) -> None:
    """Add drives of several joints as tendons, joints that follow others, and actuators."""
    tendons, equality, actuators = (
        ET.SubElement(top, tag) for tag in ("tendon", "equality", "actuator")
    )
    for coupling in model.layout.couplings:
        at = {"name": coupling.name} | _drive(coupling.name, values)
        tendon = ET.SubElement(tendons, "fixed", at)
        for joint, ratio in coupling.ratios:
            ET.SubElement(tendon, "joint", joint=joint, coef=numbers_text([ratio]))
    for link in links:
        if link.joint is not None and link.leader is not None:
            leader, ratio, shift = link.leader
            at = {"joint1": link.joint.name, "joint2": leader}
            ET.SubElement(equality, "joint", at, polycoef=numbers_text([shift, ratio, 0, 0, 0]))
    for limits in model.limits:
        at = {"name": limits.name, "joint": limits.name}
        if 0.0 < limits.effort < np.inf:
            at["ctrlrange"] = numbers_text([-limits.effort, limits.effort])
        offset = sum(  # does not reach the joint
            ratio * values.get(f"{drive.name}.{_OFFSET}", 0.0)
            for drive in model.layout.drives
            for joint, ratio in drive.ratios
            if joint == limits.name
        )
        if offset:
            at |= {"biastype": "affine", "biasprm": numbers_text([-offset, 0.0, 0.0])}
        ET.SubElement(actuators, "general" if offset else "motor", at)


def _drive(name: str, values: Mapping[str, float]) -> dict[str, str]:
    """Return the attributes that state the terms of a drive."""
    stated = {key: values.get(f"{name}.{term}") for term, key in _ATTRIBUTES.items()}
    return {key: numbers_text([value]) for key, value in stated.items() if value is not None}


def _pose(pose: Array) -> dict[str, str]:
    return {"pos": numbers_text(pose[:3]), "quat": numbers_text(pose[[6, 3, 4, 5]])}
