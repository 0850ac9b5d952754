"""The alias that every array in the package is annotated with; shapes stand in docstrings."""

from collections.abc import Callable
from typing import Any, TypeAlias

from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]

__all__ = ["Array", "ProgressCallback", "ignore_progress"]


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
