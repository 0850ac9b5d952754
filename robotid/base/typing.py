"""The type of arrays, whose shapes are in docstrings, and the report of progress."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]

__all__ = ["STAGES", "Array", "ProgressCallback", "ignore_progress", "report_stage"]

#: The stages of an identification from files; one of logs in memory starts with the second.
STAGES = ("reading logs", "checking logs", "fitting", "errors and intervals", "writing")


#: Called with the name of the work, the units done, the total units, and their name.
ProgressCallback: TypeAlias = Callable[[str, int, int, str], None]


def ignore_progress(what: str, done: int, total: int, unit: str) -> None:
    """Ignore a report of progress.

    Args:
        what: The name of the work.
        done: The units done.
        total: The total units.
        unit: Their name.
    """


def report_stage(
    progress: ProgressCallback | None, name: str, stages: Sequence[str] = STAGES
) -> None:
    """Report the start of a stage: its name, the stages done, their number, "stages".

    Args:
        progress: The function to call, if any.
        name: The stage.
        stages: All stages, in order.
    """
    if progress is not None:
        progress(name, stages.index(name), len(stages), "stages")
