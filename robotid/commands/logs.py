"""Which jobs are too long to be in memory, and their logs."""

from collections.abc import Sequence
from pathlib import Path

from robotid.commands.job import Job, LogEntry
from robotid.exceptions import DataError
from robotid.identification.survey import LongLog, survey
from robotid.logs.formats import count_rows
from robotid.regressor.base_parameters import BaseMapping
from robotid.robot.model import RobotModel

__all__ = ["is_long", "survey_logs"]

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
