"""Write an identified robot as MJCF, the format of MuJoCo, without its package."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.settings import require_each, require_kind
from robotid.base.typing import Array
from robotid.output.files.exports import (
    WORLD,
    Exported,
    Format,
    Option,
    SimulatedLink,
    Written,
    XmlFormat,
    own_drives,
    write_model,
)
from robotid.output.files.result_file import CommandedDrive, Result, limit_of
from robotid.output.files.urdf import numbers_text
from robotid.robot.bodies import principal_moments
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint

#: Models of the delay of a command.
DELAYS = ("history", "filter")
FORMAT = Format(
    "mjcf",
    "MuJoCo model",
    ".xml",
    use="Use the result in MuJoCo; the identified URDF is written, too.",
    use_of_gains="Simulate it in MuJoCo, gains and delays included.",
    options={
        "step": Option("time step [s], default 0.001", "S", float),
        "delay": Option(
            "model of the command delay, default history, which needs MuJoCo 3.5", "HOW",
            among=DELAYS,
        ),
    },
)  # fmt: skip
#: Attribute of a joint, or of a tendon over several joints, for each term of a drive.
_ATTRIBUTES = {
    "armature": "armature", "viscous": "damping", "coulomb": "frictionloss", "spring": "stiffness",
}  # fmt: skip
_OFFSET = "offset"  # the bias of the actuator states it
_TERMS = (*_ATTRIBUTES, _OFFSET)
#: Sizes of a geom divided by those of a shape in a URDF: MuJoCo uses half lengths.
_SIZES = {"box": (0.5,), "sphere": (1.0,), "cylinder": (1.0, 0.5)}
_VISIBLE = {"group": "2"}  # the viewer shows this group by default
#: Visual geoms have no contacts; collision geoms touch the world, but not the robot.
_GEOMS = {
    "visual": _VISIBLE | {"contype": "0", "conaffinity": "0"},
    "collision": {"group": "3", "contype": "1", "conaffinity": "0"},
}
#: Softness of the friction constraint. With MuJoCo's 0.9 a joint of small inertia creeps at torques
#: below its friction. With its 0.02 s friction is below Fc for 10 ms around each reversal; the
#: minimum is 2 steps.
_STIFF = {"solimpfriction": "0.999 0.999 0.001 0.5 2", "solreffriction": "1e-5 1"}
#: Softness of a closed loop, as small as MuJoCo and the time step permit.
_CLOSED = {"solimp": "0.9999 0.9999 0.001 0.5 2", "solref": "1e-5 1"}
_COMPILER = {
    "angle": "radian", "autolimits": "true", "inertiafromgeom": "false", "balanceinertia": "false",
    "boundmass": "0", "boundinertia": "0",
}  # fmt: skip
_MOST_FACES = 200_000  # of a mesh that MuJoCo reads
_STL_HEAD, _STL_FACE = 84, 50  # bytes; MuJoCo does not read STL in text form


def export(result: Result, target: Path, *, step: float = 0.001, delay: str = "history") -> Written:
    """Write a result as MJCF."""
    of = Exported.of(result, _TERMS)
    notes = write_mjcf(
        of.model, of.pi, target, original=of.original, commanded=of.commanded, step=step,
        delay=delay, notes=of.notes,
    )  # fmt: skip
    return of.written(target, notes=notes)


@dataclass(frozen=True)
class _Servos:
    """The joints with position controllers.

    A step changes v by the force at its start and then q by the new v, so that a force acts half a
    step early. Commands are therefore read half a step later, with linear interpolation.
    """

    of: Mapping[str, CommandedDrive]  # by joint
    step: float  # [s]
    delay: str  # model of the delay, one of DELAYS

    @property
    def notes(self) -> list[str]:
        """Notes on these joints."""
        if not self.of:
            return []
        notes = ["controls are position commands, joint positions are encoder readings [rad, m]"]
        delays = {name: drive.delay for name, drive in self.of.items() if drive.delay > 0}
        if delays and self.delay == "filter":
            notes.append(
                "delays are first-order filters with the delay as time constant; their initial "
                "value is 0 unless act sets it"
            )
        elif delays:
            notes.append(
                f"delays are increased by half a step of {self.step:g} s, because the force of a "
                "step acts half a step early; they need MuJoCo 3.5; commands before the start are "
                "0 unless mj_initCtrlHistory sets them"
            )
        short = [name for name in delays if delays[name] < 0.5 * self.step]
        if short and self.delay == "history":
            notes.append(f"delays below half a step are half a step: {listed(short)}")
        return notes

    def actuator(self, joint: Joint, offset: float) -> dict[str, str]:
        """Return the attributes of a joint's actuator: kp (ctrl(t - delay) - q) - kd v - offset."""
        drive = self.of[joint.name]
        at = {
            "gainprm": numbers_text([drive.kp, 0.0, 0.0]),
            "biastype": "affine",
            "biasprm": numbers_text([-offset, -drive.kp, -drive.kd]),
        }
        if (limit := limit_of(drive, joint)) < np.inf:  # of the drive, before the offset
            at["forcerange"] = numbers_text([-limit - offset, limit - offset])
        if drive.delay > 0 and self.delay == "filter":
            at |= {"dyntype": "filterexact", "dynprm": numbers_text([drive.delay, 0.0, 0.0])}
        elif drive.delay > 0:
            delay = max(drive.delay + 0.5 * self.step, self.step)  # MuJoCo's minimum is a step
            samples = str(math.ceil(round(delay / self.step, 9)))
            at |= {"delay": numbers_text([delay]), "nsample": samples, "interp": "linear"}
        return at


def write_mjcf(
    model: RobotModel,
    pi: Array,  # (p,)
    target: str | Path,
    *,
    original: str | Path | None = None,  # a further URDF to which paths of meshes may be relative
    commanded: Sequence[CommandedDrive] = (),  # with the friction of pi
    step: float = 0.001,  # [s]
    delay: str = "history",
    notes: Sequence[str] = (),
) -> tuple[str, ...]:
    """Write standard parameters as an MJCF file; return what it does not state, as in its head.

    Every link is a body. The inertial of a moving link includes those of all links fixed to it.
    Armature, viscous and Coulomb friction are the joint's armature, damping and frictionloss, or
    those of a tendon over the joints that a drive moves. The torque offset is the bias of the
    joint's actuator, whose control is the drive's torque. A frictionloss is a soft constraint:
    ``mj_inverse`` gives Fc sign(v) for a moving joint, and less near zero speed. Passive joints
    have no actuator. A loop is a ``connect`` constraint, two along a hinge, or a ``weld``.

    The control of a joint with a position controller is its position command. Its delay is a
    history of commands, which needs MuJoCo 3.5, or a first-order filter with the same delay at low
    frequencies. The position of such a joint is the reading of its encoder (``ref``).
    """
    require_kind(step, (float, int), "step", "a time [s]")
    if not 0 < step < np.inf:
        raise SettingsError(f"step is {step:g} s, expected a positive time")
    if delay not in DELAYS:
        raise SettingsError(f"delay is {delay!r}, expected one of {listed(DELAYS)}")
    require_each(commanded, CommandedDrive, "commanded", "a list of drives")
    to = XmlFormat("MJCF", _TERMS, True, _is_readable)
    servos = _Servos({drive.joint: drive for drive in commanded}, step, delay)
    build = partial(_mjcf, model, servos)
    return write_model(model, pi, target, original, to, build, [*notes, *servos.notes])


def _is_readable(mesh: Path) -> bool:
    """Return whether MuJoCo reads a mesh: OBJ, or binary STL with a permitted number of faces."""
    if mesh.suffix.lower() != ".stl":
        return mesh.suffix.lower() == ".obj"
    with mesh.open("rb") as stream:
        head = stream.read(_STL_HEAD)
    faces = int.from_bytes(head[_STL_HEAD - 4 :], "little")
    size = _STL_HEAD + _STL_FACE * faces
    return 1 <= faces <= _MOST_FACES and mesh.stat().st_size == size


def _mjcf(
    model: RobotModel, servos: _Servos, links: Sequence[SimulatedLink], values: Mapping[str, float]
) -> ET.Element:
    top = ET.Element("mujoco", model=model.name)
    ET.SubElement(top, "compiler", _COMPILER)
    gravity = numbers_text(model.pin_model.gravity.linear)
    option = ET.SubElement(top, "option", gravity=gravity, integrator="implicitfast")
    if servos.of:
        option.set("timestep", numbers_text([servos.step]))
    default, assets = ET.SubElement(top, "default"), ET.SubElement(top, "asset")
    for tag in ("joint", "tendon"):
        ET.SubElement(default, tag, _STIFF)
    for name, contacts in _GEOMS.items():
        ET.SubElement(ET.SubElement(default, "default", {"class": name}), "geom", contacts)
    own, bodies = own_drives(model, values), {WORLD: ET.SubElement(top, "worldbody")}
    for link in links:
        at = {"name": link.name} | _pose(link.pose)
        bodies[link.name] = body = ET.SubElement(bodies[link.parent], "body", at)
        _add_motion(body, link, own, servos)
        _add_geoms(body, link, assets)
    _add_drives(top, model, links, values, servos)
    _add_loops(top, model, bodies)
    return top


def _add_motion(
    body: ET.Element, link: SimulatedLink, values: Mapping[str, float], servos: _Servos
) -> None:
    if link.inertial is not None:
        moments, axes = principal_moments(link.inertial)
        x, y, z = np.maximum(moments, 0.0)  # their sums are possible moments in any rounding
        com = link.inertial[1:4] / link.inertial[0]
        pose = np.append(com, Rotation.from_matrix(axes).as_quat())
        mass, inertia = numbers_text(link.inertial[:1]), numbers_text([y + z, z + x, x + y])
        ET.SubElement(body, "inertial", _pose(pose) | {"mass": mass, "diaginertia": inertia})
    if link.floats:
        ET.SubElement(body, "freejoint", name="root_joint")
    if (joint := link.joint) is not None and link.moves:
        kind = "slide" if joint.type == "prismatic" else "hinge"
        at = {"name": joint.name, "type": kind, "axis": numbers_text(joint.axis)}
        zero = servos.of[joint.name].zero if joint.name in servos.of else 0.0
        if zero:  # an encoder reads q_urdf - zero
            at |= {"ref": numbers_text([-zero]), "springref": numbers_text([-zero])}
        if joint.has_limits:
            at["range"] = numbers_text([joint.lower - zero, joint.upper - zero])
        ET.SubElement(body, "joint", at | _drive(joint.name, values))


def _add_geoms(body: ET.Element, link: SimulatedLink, assets: ET.Element) -> None:
    """Add the shapes of a link; collision shapes are visible if it has no visual ones."""
    has_visual = any(tag == "visual" for tag, *_ in link.shapes)
    for tag, shape, pose, mesh in link.shapes:
        at = {"class": tag} | ({} if has_visual else _VISIBLE) | _pose(pose)
        if mesh is None:
            sizes = numbers_text(np.multiply(shape.size, _SIZES[shape.kind]))
            at |= {"type": shape.kind, "size": sizes}
        else:
            at |= {"type": "mesh", "mesh": f"{mesh.stem}_{len(assets)}"}
            # as a shell: many visual meshes do not enclose a volume
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
    servos: _Servos,
) -> None:
    tags = ("tendon", "equality", "actuator")
    tendons, equality, actuators = (ET.SubElement(top, tag) for tag in tags)
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
        if limits.name in model.passive:
            continue
        at = {"name": limits.name, "joint": limits.name}
        if limits.name not in servos.of and 0.0 < limits.effort < np.inf:
            at["ctrlrange"] = numbers_text([-limits.effort, limits.effort])
        offset = sum(  # this torque does not reach the joint
            ratio * values.get(f"{drive.name}.{_OFFSET}", 0.0)
            for drive in model.layout.drives
            for joint, ratio in drive.ratios
            if joint == limits.name
        )
        if limits.name in servos.of:
            at |= servos.actuator(limits, offset)
        elif offset:
            at |= {"biastype": "affine", "biasprm": numbers_text([-offset, 0.0, 0.0])}
        ET.SubElement(actuators, "general" if "biastype" in at else "motor", at)


def _add_loops(top: ET.Element, model: RobotModel, bodies: Mapping[str, ET.Element]) -> None:
    """Add the loops: each point that coincides is a pair of sites, one in each of the links."""
    equality = ET.SubElement(top, "equality") if model.loops else top
    for loop in model.loops:
        axis = model.length * np.array(loop.axis) / np.linalg.norm(loop.axis)
        tag = "weld" if loop.kind == "rigid" else "connect"
        for k, place in enumerate([np.zeros(3), axis] if loop.kind == "hinge" else [np.zeros(3)]):
            names = [f"{loop.name} {k} {link}" for link in loop.frames]
            for link, name in zip(loop.frames, names, strict=True):
                ET.SubElement(bodies[link], "site", name=name, pos=numbers_text(place))
            ET.SubElement(equality, tag, {"site1": names[0], "site2": names[1]} | _CLOSED)


def _drive(name: str, values: Mapping[str, float]) -> dict[str, str]:
    stated = {key: values.get(f"{name}.{term}") for term, key in _ATTRIBUTES.items()}
    return {key: numbers_text([value]) for key, value in stated.items() if value is not None}


def _pose(pose: Array) -> dict[str, str]:
    return {"pos": numbers_text(pose[:3]), "quat": numbers_text(pose[[6, 3, 4, 5]])}
