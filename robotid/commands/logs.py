"""The logs of a job: which are too long for memory, and what they hold of locked joints."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from robotid._typing import Array
from robotid.commands.job import Job, LogEntry
from robotid.doctor.locked_joints import check_locked
from robotid.exceptions import DataError
from robotid.findings import Finding
from robotid.identification.survey import LongLog, survey
from robotid.logs.formats import count_rows
from robotid.logs.table import prefixes
from robotid.regressor.base_parameters import BaseMapping
from robotid.robot.model import RobotModel

__all__ = ["examine_locked", "is_long", "survey_logs"]

_PIECES = 8  # pieces that the rows in memory are cut into: smoothing a piece takes some room
_SHORTEST = 256  # rows of a piece


def is_long(job: Job, entries: Sequence[LogEntry]) -> bool:
    """Return whether logs have more rows than may be in memory at once.

    Args:
        job: The job.
        entries: Its logs; files of formats that are only read whole count as nothing.

    Returns:
        Whether they are to be read in pieces.
    """
    paths = {entry.path for entry in entries}
    return sum(_count(path) for path in paths) > job.rows_in_memory


def _count(path: Path) -> int:
    try:
        return count_rows(path) or 0
    except DataError:
        return 0  # what is wrong with a file is told as it is read


def survey_logs(
    job: Job, entries: Sequence[LogEntry], model: RobotModel, mapping: BaseMapping
) -> tuple[LongLog, ...]:
    """Return logs of a job ready to be read in pieces.

    Args:
        job: The job.
        entries: The logs.
        model: Its robot.
        mapping: Standard to base parameters.

    Returns:
        The logs, cut into pieces of a fixed number of rows: an eighth of those in memory.

    Raises:
        DataError: If a file cannot be used.
        SettingsError: If a setting does not fit a log.
    """
    length = max(job.rows_in_memory // _PIECES, _SHORTEST)
    return tuple(
        survey(
            *job.lay_out(entry, model),
            model,
            mapping,
            job.signals,
            start=entry.start,
            end=entry.end,
            length=length,
        )
        for entry in entries
    )


def examine_locked(job: Job, model: RobotModel, entries: Sequence[LogEntry]) -> Iterator[Finding]:
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
        positions = _held_positions(job, model, entry)
        yield from check_locked(model, positions, entry.path.name, job.locked)


def _held_positions(job: Job, model: RobotModel, entry: LogEntry) -> dict[str, Array]:
    """Return the positions of locked joints that a log has and that are not read otherwise."""
    layout, table = job.lay_out(entry, model)
    turning = {joint.name for joint in model.tree.movable if joint.type != "prismatic"}
    start = -np.inf if entry.start is None else entry.start
    end = np.inf if entry.end is None else entry.end
    (time,) = layout.columns["time"]
    positions = {}
    for joint in model.locked:
        named = layout.source.joints.get(joint, joint)
        names = [prefix + named for prefix in prefixes()["q"] if prefix + named in table.names]
        if not names:
            continue
        columns = table.read([time, names[0]])
        t = layout.stamps(columns[time])
        q = columns[names[0]][(t >= start) & (t <= end)]
        q = q[np.isfinite(q)]
        if joint in turning and layout.units.angle == "deg":
            q = np.deg2rad(q)
        if len(q):
            positions[joint] = q
    return positions
