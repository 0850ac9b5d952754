"""Arrays in arguments: real numbers, read-only."""

import numpy as np
from numpy.typing import ArrayLike

from robotid.base.exceptions import DataError
from robotid.base.typing import Array


def real_numbers(values: ArrayLike | None, name: str, *, hint: str = "") -> Array:
    """Return values as a read-only array of numbers; NaN where a masked array is masked."""
    if values is None:
        raise DataError(f"{name} is None, wanted an array{hint}")
    try:
        array: Array = np.ma.asanyarray(values)
        if array.dtype.kind not in "biufO":
            raise TypeError(f"numbers of kind {array.dtype.kind!r}")
        if np.ma.is_masked(array):
            return frozen(np.ma.filled(array.astype(np.float64), np.nan))
        return frozen(values)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(
            f"{name} is not an array of real numbers ({str(error)[:100]}); wanted an array of "
            "floats with rows of equal length"
        ) from error


def frozen(values: ArrayLike, dtype: type = np.float64) -> Array:
    """Return the values as a read-only array; copied unless they are read-only already."""
    array: Array = np.asarray(values, dtype=dtype)
    if array.flags.writeable:
        array = array.copy()
        array.flags.writeable = False
    return array
