"""Time stamps of a log of any length, checked and stored in a memory-mapped temporary file."""

import tempfile
from collections.abc import Iterable, Iterator

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import require_finite, require_increasing

_BLOCK = 2**17  # stamps processed together


def map_stamps(blocks: Iterable[Array], where: str) -> Array:
    """Time stamps of a log, shape (N,) [s], in a file that exists as long as the array."""
    count, last = 0, np.empty(0)
    with tempfile.TemporaryFile() as file:
        for block in blocks:
            require_finite(block[:, None], block, ["time"], where, count)
            require_increasing(np.append(last, block), where, count - len(last))
            np.ascontiguousarray(block, dtype=np.float64).tofile(file)
            count, last = count + len(block), block[-1:]
        file.flush()
        return np.memmap(file, np.float64, "r", shape=(count,)) if count else last


def blocks_of(t: Array) -> Iterator[tuple[int, Array]]:
    """Yield time stamps in blocks; each block shares a stamp with the block before: t (N,) [s]."""
    for row in range(0, len(t) - 1, _BLOCK):
        yield row, t[row : row + _BLOCK + 1]


def median_step(t: Array) -> float:
    """Return the median time step [s]; those of a long log are sorted in a temporary file.

    t (N,) [s].
    """
    if len(t) <= _BLOCK:
        return float(np.median(np.diff(t)))
    with tempfile.TemporaryFile() as file:
        steps = np.memmap(file, np.float64, "w+", shape=(len(t) - 1,))
        for row, block in blocks_of(t):
            steps[row : row + len(block) - 1] = np.diff(block)
        return float(np.median(steps, overwrite_input=True))
