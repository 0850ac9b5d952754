"""Check of locked joints against their logged positions."""

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from robotid._typing import Array
from robotid.findings import Finding, log_finding
from robotid.robot.model import RobotModel

__all__ = ["STILL", "check_locked"]

#: Largest range of a locked joint, and largest difference from its stated position [rad or m].
STILL = 0.02


def check_locked(
    model: RobotModel, positions: Mapping[str, Array], log: str, asked: Collection[str]
) -> Iterator[Finding]:
    """Yield an error "locked_position" per locked joint that moves or has another position.

    Args:
        model: The robot.
        positions: Logged positions of the locked joints by name, shape (N,) [rad or m].
        log: Name of the log.
        asked: Joints that the user asked to lock.
    """
    for joint, q in positions.items():
        stated = model.locked[joint]
        middle, extent = float(np.median(q)), float(np.ptp(q))
        if extent <= STILL and abs(middle - stated) <= STILL:
            continue
        default = "" if joint in asked else " by default"
        if extent > STILL:
            what = f"moves over a range of {extent:.3g} in the log"
            todo = f"identify {joint}, too, or use only the part of the log in which it is at rest"
        else:
            what = f"is at {middle:.4g} in the log"
            todo = f"state locked = {{ {joint} = {middle:.4g} }} (--lock {joint}={middle:.4g})"
        message = f"{joint} is locked at {stated:.4g}{default} but {what}; {todo}"
        evidence = {"stated": stated, "median": middle, "range": extent}
        yield log_finding(log, "locked_position", "error", message, joint, **evidence)
