"""Write drives with position controllers as actuators of Isaac Lab, without its package."""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import write_text
from robotid.base.findings import listed
from robotid.base.versions import __version__
from robotid.output.files.exports import (
    Exported,
    Format,
    Option,
    Written,
    head_of,
    unstated_terms,
    yaml_text,
)
from robotid.output.files.result_file import CommandedDrive, Result, limit_of
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint

# drive terms of Isaac Lab's actuators; a note of its own states the offset
_TERMS = ("armature", "viscous", "coulomb", "offset")
FORMAT = Format(
    "isaac",
    "YAML of Isaac Lab's actuators",
    "_actuators.yaml",
    use_of_gains="Use it for training in Isaac Lab.",
    options={"step": Option("time step, the unit of delays [s], default 0.005", "S", float)},
)


def export(result: Result, target: Path, *, step: float = 0.005) -> Written:
    """Write the drives of a result as the YAML of Isaac Lab's actuators."""
    of = Exported.of(result, _TERMS)
    content = isaac_actuators(of.model, of.commanded, step)
    notes = unstated_terms(of.model, of.pi, "Isaac Lab", _TERMS)
    for key, words, remedy in (
        ("offset", "the torque offset", "subtract it from the effort target"),
        ("zero", "the encoder's zero", "the simulator's position is the encoder's plus the zero"),
    ):
        values = [f"{drive.joint} {x:.4g}" for drive in of.commanded if (x := getattr(drive, key))]
        if values:
            notes.append(f"Isaac Lab lacks {words} ({listed(values)}); {remedy}")
    head = head_of("isaac", robot=json.dumps(of.model.name), version=__version__, file=target.name)
    write_text(yaml_text(content, "\n".join([head, *notes, *of.notes])), target)
    return of.written(target, notes=[*notes, *of.notes])


def isaac_actuators(
    model: RobotModel, commanded: Sequence[CommandedDrive], physics_dt: float
) -> dict[str, Any]:
    """Return the groups of joints with equal drives, with the names of Isaac Lab's fields."""
    if not 0 < physics_dt < math.inf:
        raise SettingsError(f"step is {physics_dt:g} s, expected a positive time")
    if not commanded:
        raise DataError(
            "the result has no gains of drives, which Isaac Lab's actuators require; identify from "
            'a log with commands, with [controller] and [estimator] name = "simulation"'
        )
    groups: dict[str, tuple[dict[str, Any], list[str]]] = {}
    for drive, joint in zip(commanded, model.limits, strict=True):
        fields = _fields(drive, joint, physics_dt)
        groups.setdefault(yaml_text(fields, ""), (fields, []))[1].append(drive.joint)
    actuators: dict[str, Any] = {}
    for fields, joints in groups.values():
        words = [joint.split("_") for joint in joints]  # those in common
        name = "_".join(w for w in words[0] if all(w in own for own in words)) or "drives"
        while name in actuators:
            name += "_"
        actuators[name] = {"joint_names_expr": [re.escape(joint) for joint in joints], **fields}
    return {"physics_dt": physics_dt, "actuators": actuators}


def _fields(drive: CommandedDrive, joint: Joint, physics_dt: float) -> dict[str, Any]:
    steps = max(0, round(drive.delay / physics_dt))
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
