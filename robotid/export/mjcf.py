"""Write an identified robot as MJCF, the format of MuJoCo, which need not be installed."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

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
from robotid.robot.bodies import principal_moments
from robotid.robot.meshes import Shape
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
_SEEN = {"group": "2"}  # what the viewer shows by default
#: Sizes of a geom over those of a shape in a URDF: MuJoCo states half lengths.
_SIZES = {"box": (0.5,), "sphere": (1.0,), "cylinder": (1.0, 0.5)}
#: How friction gives way: with MuJoCo's 0.9 a light joint creeps under less than its friction.
_STIFF = {"solimpfriction": "0.999 0.999 0.001 0.5 2"}
_MOST_FACES = 200_000  # of a mesh that MuJoCo reads
_STL_HEAD, _STL_FACE = 84, 50  # bytes; MuJoCo reads no STL written as text


def write_mjcf(
    model: RobotModel, pi: Array, target: str | Path, *, original: str | Path | None = None
) -> tuple[str, ...]:
    """Write standard parameters as an MJCF file.

    Every link is a body; the one that a joint moves has the inertial of all that are fixed to it.
    Armature, viscous and Coulomb friction are the joint's armature, damping and frictionloss, or
    those of a tendon over the joints that a drive turns with. The torque offset is the bias of the
    joint's actuator, whose control is the drive's torque. MuJoCo's frictionloss holds a joint still
    through a soft constraint: ``mj_inverse`` gives Fc sign(v) where the joint moves, and less where
    it hardly does. The robot touches the world, not itself.

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
    terms = (*_ATTRIBUTES, _OFFSET)
    notes = left_out_notes("MJCF", model, pi, terms, meshes, has_couplings=True)
    values = dict(zip(model.layout.names, pi.tolist(), strict=True))
    top = ET.Element("mujoco", model=model.name)
    top.append(ET.Comment(head_comment(model, notes)))
    ET.SubElement(
        top, "compiler", angle="radian", autolimits="true", inertiafromgeom="false",
        balanceinertia="false", boundmass="0", boundinertia="0",
    )  # fmt: skip
    gravity = numbers_text(model.pin_model.gravity.linear)
    ET.SubElement(top, "option", gravity=gravity, integrator="implicitfast")
    _add_defaults(top)
    files = _add_meshes(top, links)
    bodies = {WORLD: ET.SubElement(top, "worldbody")}
    for link in links:
        bodies[link.name] = body = _add_body(bodies[link.parent], link, values)
        if model.free_flyer and link.parent == WORLD:
            body.insert(0, ET.Element("freejoint", name="root_joint"))
        is_seen = any(tag == "visual" for tag, _ in link.shapes)
        for tag, shape in link.shapes:
            _add_geom(body, {"class": tag} | ({} if is_seen else _SEEN), shape, files)
    _add_drives(top, model, values)
    ET.indent(top)
    write_text(ET.tostring(top, encoding="unicode") + "\n", target)
    return tuple(notes)


def _is_readable(mesh: Path) -> bool:
    """Whether MuJoCo reads a mesh: OBJ, or STL in binary with a usual number of faces."""
    if mesh.suffix.lower() != ".stl":
        return mesh.suffix.lower() == ".obj"
    with mesh.open("rb") as stream:
        head = stream.read(_STL_HEAD)
    faces = int.from_bytes(head[_STL_HEAD - 4 :], "little")
    size = _STL_HEAD + _STL_FACE * faces
    return 1 <= faces <= _MOST_FACES and mesh.stat().st_size == size


def _add_defaults(top: ET.Element) -> None:
    """Add how friction gives way, and geoms: seen only, or touching the world, not the robot."""
    default = ET.SubElement(top, "default")
    for tag in ("joint", "tendon"):
        ET.SubElement(default, tag, _STIFF)
    for name, conduct in (
        ("visual", _SEEN | {"contype": "0", "conaffinity": "0"}),
        ("collision", {"group": "3", "contype": "1", "conaffinity": "0"}),
    ):
        ET.SubElement(ET.SubElement(default, "default", {"class": name}), "geom", conduct)


def _add_meshes(top: ET.Element, links: tuple[SimulatedLink, ...]) -> dict[tuple[str, str], str]:
    """Add each mesh once for each scale, and return their names."""
    names: dict[tuple[str, str], str] = {}
    assets = ET.SubElement(top, "asset")
    for shape in (shape for link in links for _, shape in link.shapes if shape.file):
        key = (shape.file, numbers_text(shape.size))
        if key not in names:
            names[key] = f"{Path(shape.file).stem}_{len(names)}"
            # as a shell: many of what is only looked at enclose no volume
            at = {"name": names[key], "file": key[0], "scale": key[1], "inertia": "shell"}
            ET.SubElement(assets, "mesh", at)
    return names


def _add_body(parent: ET.Element, link: SimulatedLink, values: dict[str, float]) -> ET.Element:
    body = ET.SubElement(parent, "body", {"name": link.name} | _pose(link.placement))
    if link.inertial is not None:
        second, axes = principal_moments(link.inertial)
        x, y, z = np.maximum(second, 0.0)  # exactly so, for MuJoCo wants A + B >= C to the last bit
        centre = np.eye(4)
        centre[:3, :3], centre[:3, 3] = axes, link.inertial[1:4] / link.inertial[0]
        mass, moments = numbers_text(link.inertial[:1]), numbers_text([y + z, z + x, x + y])
        ET.SubElement(body, "inertial", _pose(centre) | {"mass": mass, "diaginertia": moments})
    joint = link.joint
    if joint is not None:
        kind = "slide" if joint.type == "prismatic" else "hinge"
        at = {"name": joint.name, "type": kind, "axis": numbers_text(joint.axis)}
        if joint.has_limits:
            at["range"] = numbers_text([joint.lower, joint.upper])
        ET.SubElement(body, "joint", at | _drive(joint.name, values))
    return body


def _drive(name: str, values: dict[str, float]) -> dict[str, str]:
    """Return the attributes that state the terms of a drive."""
    stated = {key: values.get(f"{name}.{term}") for term, key in _ATTRIBUTES.items()}
    return {key: numbers_text([value]) for key, value in stated.items() if value is not None}


def _add_geom(
    body: ET.Element, at: dict[str, str], shape: Shape, files: dict[tuple[str, str], str]
) -> None:
    at = at | _pose(shape.placement)
    if shape.kind == "mesh":
        at |= {"type": "mesh", "mesh": files[shape.file, numbers_text(shape.size)]}
    else:
        sizes = np.array(shape.size) * _SIZES[shape.kind]
        at |= {"type": shape.kind, "size": numbers_text(sizes)}
    if shape.rgba is not None:
        at["rgba"] = numbers_text(shape.rgba)
    ET.SubElement(body, "geom", at)


def _add_drives(top: ET.Element, model: RobotModel, values: dict[str, float]) -> None:
    """Add drives of several joints as tendons, joints that follow others, and actuators."""
    tendons, equality, actuators = (
        ET.SubElement(top, tag) for tag in ("tendon", "equality", "actuator")
    )
    for coupling in model.layout.couplings:
        at = {"name": coupling.name} | _drive(coupling.name, values)
        tendon = ET.SubElement(tendons, "fixed", at)
        for joint, ratio in coupling.ratios:
            ET.SubElement(tendon, "joint", joint=joint, coef=numbers_text([ratio]))
    for each in model.tree.movable:
        leader = None if each.name in model.locked else leader_of(model, each)
        if leader is not None:
            name, ratio, offset = leader
            polynomial = numbers_text([offset, ratio, 0.0, 0.0, 0.0])
            ET.SubElement(equality, "joint", joint1=each.name, joint2=name, polycoef=polynomial)
    for each in model.limits:
        at = {"name": each.name, "joint": each.name}
        if 0.0 < each.effort < np.inf:
            at["ctrlrange"] = numbers_text([-each.effort, each.effort])
        offset = values.get(f"{each.name}.{_OFFSET}", 0.0)
        if offset:  # what of the drive's torque does not reach the joint
            bias = {"biastype": "affine", "biasprm": numbers_text([-offset, 0.0, 0.0])}
            ET.SubElement(actuators, "general", at | bias)
        else:
            ET.SubElement(actuators, "motor", at)


def _pose(placement: Array) -> dict[str, str]:
    x, y, z, w = quaternion(placement)
    return {"pos": numbers_text(placement[:3, 3]), "quat": numbers_text([w, x, y, z])}
