"""Arrays: their type, and those in arguments, real and read-only; the report of progress."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotid.base.exceptions import DataError

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


def real_numbers(values: ArrayLike | None, name: str, *, hint: str = "") -> Array:
    """Return values as a read-only array of numbers; NaN where a masked array is masked."""
    if values is None:
        raise DataError(f"{name} is None, expected an array{hint}")
    try:
        array: Array = np.ma.asanyarray(values)
        if array.dtype.kind not in "biufO":
            raise TypeError(f"numbers of kind {array.dtype.kind!r}")
        if np.ma.is_masked(array):
            return frozen(np.ma.filled(array.astype(np.float64), np.nan))
        return frozen(values)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(
            f"{name} is not an array of real numbers ({str(error)[:100]}); expected an array of "
            "floats with rows of equal length"
        ) from error


def frozen(values: ArrayLike, dtype: type = np.float64) -> Array:
    """Return the values as a read-only array; copied unless they are read-only already."""
    array: Array = np.asarray(values, dtype=dtype)
    if array.flags.writeable:
        array = array.copy()
        array.flags.writeable = False
    return array
