"""Do the joints that a job holds still stand where it says, as far as a log tells."""

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from robotid._typing import Array
from robotid.findings import Finding, log_finding
from robotid.robot.model import RobotModel

__all__ = ["STILL", "check_locked"]

#: A held joint may move, or stand elsewhere, by so much [rad or m].
STILL = 0.02


def check_locked(
    model: RobotModel, positions: Mapping[str, Array], log: str, asked: Collection[str]
) -> Iterator[Finding]:
    """Yield an error "locked_position" per held joint that a log shows to move or stand elsewhere.

    Args:
        model: The robot, whose locked joints are held.
        positions: The held joints' positions in the log by name, shape (N,) [rad or m].
        log: Name of the log.
        asked: Joints that the user asked to be locked.
    """
    for joint, q in positions.items():
        stated = model.locked[joint]
        middle, reach = float(np.median(q)), float(np.ptp(q))
        if reach <= STILL and abs(middle - stated) <= STILL:
            continue
        said = f"the job holds {joint} at {stated:.4g}" + ("" if joint in asked else ", unasked")
        if reach > STILL:
            what = f"moves over {reach:.3g} there"
            todo = f"identify {joint}, too, or cut the log to where it stands"
        else:
            what = f"stands at {middle:.4g} there"
            todo = f"state locked = {{ {joint} = {middle:.4g} }} (--lock {joint}={middle:.4g})"
        message = f"{said}, but the log has its position, and it {what}; {todo}"
        evidence = {"stated": stated, "median": middle, "range": reach}
        yield log_finding(log, "locked_position", "error", message, joint, **evidence)
