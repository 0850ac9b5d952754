"""Do the joints that a job holds still stand where it says, as far as the logs tell."""

from collections.abc import Iterator, Sequence

import numpy as np

from robotid._typing import Array
from robotid.commands.job import Job, LogEntry
from robotid.identification.verdict import Finding
from robotid.logs.read import LogLayout
from robotid.logs.table import Table, prefixes
from robotid.robot.model import RobotModel

__all__ = ["check_locked"]

_STILL = 0.02  # [rad or m] a held joint may move, or stand elsewhere, by so much


def check_locked(job: Job, model: RobotModel, entries: Sequence[LogEntry]) -> Iterator[Finding]:
    """Yield held joints that logs show to move, or to stand elsewhere.

    Args:
        job: The job.
        model: Its robot.
        entries: Logs that are small enough to be in memory.

    Yields:
        An error "locked_position" per log and joint.

    Raises:
        DataError: If a file cannot be used.
    """
    for entry in entries if model.locked else ():
        layout, table = job.lay_out(entry, model)
        turning = {joint.name for joint in model.tree.movable if joint.type != "prismatic"}
        for joint, stated in model.locked.items():
            q = _position(layout, table, entry, joint)
            if q is None or not len(q):
                continue
            if joint in turning and layout.units.angle == "deg":
                q = np.deg2rad(q)
            middle, reach = float(np.median(q)), float(np.ptp(q))
            if reach <= _STILL and abs(middle - stated) <= _STILL:
                continue
            said = f"the job holds {joint} at {stated:.4g}" + (
                "" if joint in job.locked else ", unasked"
            )
            if reach > _STILL:
                what = f"moves over {reach:.3g} there"
                todo = f"identify {joint}, too, or cut the log to where it stands"
            else:
                what = f"stands at {middle:.4g} there"
                todo = f"state locked = {{ {joint} = {middle:.4g} }} (--lock {joint}={middle:.4g})"
            name = entry.path.name
            message = f"{name}: {said}, but the log has its position, and it {what}; {todo}"
            evidence = {"stated": stated, "median": middle, "range": reach}
            yield Finding("locked_position", "error", f"{name}: {joint}", message, evidence)


def _position(layout: LogLayout, table: Table, entry: LogEntry, joint: str) -> Array | None:
    """Return the position of a joint that is not read otherwise, as logged; None if it is not."""
    named = layout.source.joints.get(joint, joint)
    names = [prefix + named for prefix in prefixes()["q"] if prefix + named in table.names]
    if not names:
        return None
    (time,) = layout.columns["time"]
    columns = table.read([time, names[0]])
    t = layout.stamps(columns[time])
    start = -np.inf if entry.start is None else entry.start
    end = np.inf if entry.end is None else entry.end
    q = columns[names[0]][(t >= start) & (t <= end)]
    found: Array = q[np.isfinite(q)]
    return found
