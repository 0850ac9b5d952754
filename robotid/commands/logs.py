"""The logs of a job: each file opened once, and read at once or in pieces."""

from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path

from robotid.commands.job import Job, LogEntry
from robotid.exceptions import DataError
from robotid.identification.survey import SurveyedLog, survey_log
from robotid.logs.read import LogLayout
from robotid.logs.table import Table
from robotid.robot.model import RobotModel

__all__ = ["survey_logs"]

_PIECES = 8  # pieces that the rows in memory are cut into: smoothing a piece takes some room
_SHORTEST = 256  # rows of a piece


def survey_logs(
    job: Job,
    model: RobotModel,
    *groups: Sequence[LogEntry],
    refuse: Callable[[LogEntry, DataError], None] | None = None,
) -> tuple[tuple[SurveyedLog, ...], ...]:
    """Return logs of a job ready to be read.

    They are kept in memory if all their files together have no more rows than may be; files of
    formats that are only read whole count as nothing. Otherwise each is cut into pieces of a fixed
    number of rows: an eighth of those in memory.

    Args:
        job: The job.
        model: The robot whose joints are read.
        groups: The logs: those to fit, those kept apart.
        refuse: Called with a log that cannot be used, and why; if None, the error is raised.

    Returns:
        The logs of each group.

    Raises:
        DataError: If a file cannot be used.
        SettingsError: If a setting does not fit a log.
    """
    paths = dict.fromkeys(entry.path for entry in chain(*groups))
    opened = {path: _open(job, model, path) for path in paths}
    rows = sum(_count(found) for found in opened.values())
    is_long = rows > job.rows_in_memory
    length = max(job.rows_in_memory // _PIECES, _SHORTEST) if is_long else None

    def survey(entries: Sequence[LogEntry]) -> tuple[SurveyedLog, ...]:
        logs = []
        for entry in entries:
            try:
                found = opened[entry.path]
                if isinstance(found, DataError):
                    raise found
                window = entry.start, entry.end
                logs.append(survey_log(*found, model, job.signals, window, length=length))
            except DataError as error:
                if refuse is None:
                    raise
                refuse(entry, error)
        return tuple(logs)

    return tuple(survey(entries) for entries in groups)


def _open(job: Job, model: RobotModel, path: Path) -> tuple[LogLayout, Table] | DataError:
    try:
        return job.lay_out(LogEntry(path), model)
    except DataError as error:
        return error


def _count(found: tuple[LogLayout, Table] | DataError) -> int:
    """Return about how many rows a file has, if it can be read by rows."""
    if isinstance(found, DataError) or found[1].rows is None:
        return 0
    return found[1].rows.count()
