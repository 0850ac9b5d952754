"""Check of locked joints against their logged positions."""

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from robotid.base.findings import Finding, toml_key
from robotid.base.typing import Array
from robotid.data.signal_settings import LogUnits
from robotid.diagnosis.catalogue import finding
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
    """Yield an error "locked_position" per locked joint that moves or has another position."""
    prismatic = {joint.name for joint in model.tree.movable if joint.type == "prismatic"}
    for joint, q in positions.items():
        stated = model.locked[joint]
        middle, extent = float(np.median(q)), float(np.ptp(q))
        if extent <= STILL and abs(middle - stated) <= STILL:
            continue
        what = "moves" if extent > STILL else "stands"
        yield finding(
            "locked_position", log, joint, what=what, todo=what, default=joint in asked,
            unit="m" if joint in prismatic else "rad", stated=stated, median=middle, range=extent,
            setting=f"locked = {{ {joint} = {middle:.4g} }}", flag=f"--lock {joint}={middle:.4g}",
            percent=percent_hint(model, joint, middle, units),
        )  # fmt: skip


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
