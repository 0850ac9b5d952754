"""Check of locked joints against their logged positions."""

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from robotid.base.findings import Finding, log_finding, toml_key
from robotid.base.typing import Array
from robotid.data.signal_settings import LogUnits
from robotid.robot.model import RobotModel

#: Largest range of a locked joint, and largest difference from its stated position [rad or m].
STILL = 0.02
_FAR = 2 * np.pi  # number in a log above which a position may be a percentage


def check_locked(
    model: RobotModel,
    positions: Mapping[str, Array],
    log: str,
    asked: Collection[str],
    units: LogUnits,
) -> Iterator[Finding]:
    """Yield an error "locked_position" per locked joint that moves or has another position.

    positions (N,) [rad or m].
    """
    prismatic = {joint.name for joint in model.tree.movable if joint.type == "prismatic"}
    for joint, q in positions.items():
        unit = "m" if joint in prismatic else "rad"
        stated = model.locked[joint]
        middle, extent = float(np.median(q)), float(np.ptp(q))
        if extent <= STILL and abs(middle - stated) <= STILL:
            continue
        default = "" if joint in asked else " by default"
        if extent > STILL:
            what = f"moves over a range of {extent:.3g} {unit} in the log"
            todo = f"identify {joint}, too, or use only the part of the log in which it is at rest"
        else:
            what = f"is at {middle:.4g} {unit} in the log"
            todo = f"state locked = {{ {joint} = {middle:.4g} }} (--lock {joint}={middle:.4g})"
        message = f"{joint} is locked at {stated:.4g} {unit}{default} but {what}; {todo}"
        message += percent_hint(model, joint, middle, units)
        evidence = {"stated": stated, "median": middle, "range": extent}
        yield log_finding(log, "locked_position", "error", message, joint, **evidence)


def percent_hint(model: RobotModel, name: str, position: float, units: LogUnits) -> str:
    """Return what to state if the position of a gripper is a percentage; "" if it cannot be one."""
    joint = next(joint for joint in model.tree.movable if joint.name == name)
    first, scale = units.scale(name, is_angle=joint.type != "prismatic")
    logged = (position - first) / scale
    moves = any(other.parent == joint.child for other in model.tree.movable)
    if name in units.percent or moves or not joint.has_limits or not _FAR < logged <= 100:
        return ""
    low, high = joint.lower, joint.upper
    unit = "m" if joint.type == "prismatic" else "rad"
    return (
        f". If {logged:.4g}, the number in the log, is a percentage, as of LeRobot's grippers, "
        f"state percent = {{ {toml_key(name)} = [{low:.4g}, {high:.4g}] }} in [units], the "
        f"positions at 0 and at 100 [{unit}]: it then is at "
        f"{low + (high - low) * logged / 100:.4g} {unit}"
    )
