"""Write drives that follow commands as actuators of Isaac Lab, which need not be installed."""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robotid._files import write_text
from robotid._typing import Array
from robotid.exceptions import DataError, SettingsError
from robotid.export.commanded import CommandedDrive, limit_of
from robotid.export.exported import Exported, Written, unstated_terms
from robotid.export.result import Result
from robotid.export.yaml_text import yaml_text
from robotid.findings import listed
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint
from robotid.versions import __version__

__all__ = ["export", "isaac_actuators", "write_isaac"]

# the drive terms that Isaac Lab's actuators have, the offset by a sentence of its own.
_TERMS = ("armature", "viscous", "coulomb", "offset")
_STEP = 0.005  # [s]
_HEAD = """\
Actuators of {robot} for Isaac Lab 2.2 or later (Isaac Sim 5, where friction is a torque), by
robotid {version}. N m, N m s/rad, kg m^2, rad/s; N, N s/m, kg, m/s of prismatic joints.

  import yaml
  from isaaclab.actuators import DelayedPDActuatorCfg
  groups = yaml.safe_load(open("{file}"))["actuators"]
  actuators = {{name: DelayedPDActuatorCfg(**group) for name, group in groups.items()}}

Delays are the nearest steps of physics_dt, which sim.dt must be; where min_delay is less than
max_delay, Isaac Lab draws one for each robot at each reset. Friction is Coulomb's, at rest and
moving.
"""


def export(result: Result, target: Path, *, step: float = _STEP) -> Written:
    """Write the drives of a result as the YAML of Isaac Lab's actuators.

    Args:
        result: The result.
        target: The file to write.
        step: As of ``write_isaac``.

    Raises:
        DataError, SettingsError: As of ``write_isaac``; also if it has no URDF.
    """
    of = Exported.of(result, _TERMS)
    notes = write_isaac(of.model, of.pi, of.commanded, target, step=step, notes=of.notes)
    return of.written(target, notes=notes)


def isaac_actuators(
    model: RobotModel, commanded: Sequence[CommandedDrive], physics_dt: float
) -> dict[str, Any]:
    """Return the groups of joints that have the same drives, as Isaac Lab's fields name them.

    Args:
        model: The robot, whose URDF has limits of speeds and of what has no other limit.
        commanded: The drives of its joints.
        physics_dt: Time step of the simulator, in which delays are counted [s].

    Returns:
        {"physics_dt", "actuators": {group: fields of ``DelayedPDActuatorCfg``}}; a limit that is
        not stated is None, for which Isaac Lab takes that of its own model of the robot.

    Raises:
        DataError: If there are no drives that follow commands.
        SettingsError: If physics_dt is not positive.
    """
    if not 0 < physics_dt < math.inf:
        raise SettingsError(f"step is {physics_dt:g} s, wanted a positive time")
    if not commanded:
        raise DataError(
            "the result has no gains of drives, which Isaac Lab's actuators need: identify a log "
            'with commands, with [controller] and [estimator] name = "simulation"'
        )
    groups: dict[str, tuple[dict[str, Any], list[str]]] = {}
    for drive, joint in zip(commanded, model.limits, strict=True):
        fields = _fields(drive, joint, physics_dt)
        groups.setdefault(yaml_text(fields, ""), (fields, []))[1].append(drive.joint)
    actuators: dict[str, Any] = {}
    for fields, joints in groups.values():
        name = _group_name(joints)
        while name in actuators:
            name += "_"
        actuators[name] = {"joint_names_expr": [re.escape(joint) for joint in joints], **fields}
    return {"physics_dt": physics_dt, "actuators": actuators}


def write_isaac(
    model: RobotModel,
    pi: Array,
    commanded: Sequence[CommandedDrive],
    target: str | Path,
    *,
    step: float = _STEP,
    notes: Sequence[str] = (),
) -> tuple[str, ...]:
    """Write drives that follow commands as the YAML of Isaac Lab's actuators.

    Args:
        model: The robot.
        pi: Standard parameters, shape (p,), SI units, in ``layout.names`` order.
        commanded: Its drives.
        target: The file to write.
        step: Time step of the simulator, in which delays are counted [s].
        notes: What else is to be said of the file.

    Returns:
        What the file does not state, a sentence each; its head has them, too.

    Raises:
        DataError: If there are no drives that follow commands, or the folder does not exist.
        SettingsError: If step is not positive, or the target is a folder.
    """
    content = isaac_actuators(model, commanded, step)
    said = [*notes, *unstated_terms(model, pi, "Isaac Lab", _TERMS)]
    for key, words in (
        ("offset", "the offset, which may be subtracted from the effort target"),
        ("zero", "the encoder's zero, which the simulator's position and command have more"),
    ):
        values = [f"{drive.joint} {x:.4g}" for drive in commanded if (x := getattr(drive, key))]
        if values:
            said.append(f"Isaac Lab has no place for {words}: {listed(values)}")
    head = _HEAD.format(robot=json.dumps(model.name), version=__version__, file=Path(target).name)
    write_text(yaml_text(content, "\n".join([head, *said]) if said else head), target)
    return tuple(said)


def _fields(drive: CommandedDrive, joint: Joint, physics_dt: float) -> dict[str, Any]:
    """Return the fields of one joint's actuator but for its name."""
    steps = round(drive.delay / physics_dt)
    return {
        "effort_limit": _limit(limit_of(drive, joint)),
        "velocity_limit": _limit(joint.velocity),
        "stiffness": drive.kp,
        "damping": drive.kd,
        "armature": drive.armature,
        "friction": drive.coulomb,
        "dynamic_friction": drive.coulomb,
        "viscous_friction": drive.viscous,
        "min_delay": steps,
        "max_delay": steps,
    }


def _limit(value: float) -> float | None:
    return value if 0 < value < math.inf else None


def _group_name(joints: Sequence[str]) -> str:
    """Return the words that the names of joints have in common."""
    words = [set(joint.split("_")) for joint in joints]
    return "_".join(w for w in joints[0].split("_") if all(w in own for own in words)) or "drives"
