"""The type of arrays, whose shapes are in docstrings, and the report of progress."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]

#: The stages of an identification from files; one of logs in memory starts with the second.
STAGES = ("reading logs", "checking logs", "fitting", "errors and intervals", "writing")


#: Called with the name of the work, the units done, the total units, and their name.
ProgressCallback: TypeAlias = Callable[[str, int, int, str], None]


def ignore_progress(what: str, done: int, total: int, unit: str) -> None:
    """Ignore a report of progress."""


def report_stage(
    progress: ProgressCallback | None, name: str, stages: Sequence[str] = STAGES
) -> None:
    """Report the start of a stage: its name, the stages done, their number, "stages"."""
    if progress is not None:
        progress(name, stages.index(name), len(stages), "stages")
