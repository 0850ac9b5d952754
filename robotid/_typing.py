"""The alias of every array, whose shapes stand in docstrings; and how progress is reported."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]

__all__ = ["STAGES", "Array", "ProgressCallback", "ignore_progress", "report_stage"]

#: What an identification does, from files to files; one of logs in memory begins at the second.
STAGES = ("reading logs", "checking logs", "fitting", "errors and intervals", "writing")


#: Called with what is being done, how many units are done, how many there are, and their name.
ProgressCallback: TypeAlias = Callable[[str, int, int, str], None]


def ignore_progress(what: str, done: int, total: int, unit: str) -> None:
    """Take a report of progress and show nothing.

    Args:
        what: What is being done.
        done: How many units are done.
        total: How many there are.
        unit: Their name.
    """


def report_stage(
    progress: ProgressCallback | None, name: str, stages: Sequence[str] = STAGES
) -> None:
    """Report that a stage of a longer work begins: its name, those done, those in all, "stages".

    Args:
        progress: What to call, if anything.
        name: The stage.
        stages: All of them, in order.
    """
    if progress is not None:
        progress(name, stages.index(name), len(stages), "stages")
