"""The time stamps of a log larger than memory, in a temporary file."""

import tempfile
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from types import TracebackType

import numpy as np

from robotid._typing import Array
from robotid.logs.data import require_finite, require_increasing

__all__ = ["TimeStamps"]

_BLOCK = 2**17  # stamps in memory at a time
_DIGIT = 16  # bits of a step decided in one pass


class TimeStamps:
    """The time stamps of a log, checked: finite, strictly increasing.

    Args:
        blocks: The stamps, a block of rows at a time [s].
        where: What the log is called.

    Raises:
        DataError: If a stamp is not finite, or not after the one before.
    """

    def __init__(self, blocks: Iterable[Array], where: str) -> None:
        self._count = 0
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 closed by __exit__
        try:
            self._fill(blocks, where)
        except BaseException:
            self._file.close()
            raise

    def __len__(self) -> int:
        return self._count

    def __enter__(self) -> "TimeStamps":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def read(self, first: int, stop: int) -> Array:
        """Return some time stamps.

        Args:
            first: First row.
            stop: Row after the last one.

        Returns:
            Shape (stop - first,) [s].
        """
        self._file.seek(8 * first)
        return np.fromfile(self._file, np.float64, max(stop - first, 0))

    def at(self, row: int) -> float:
        """Return one time stamp.

        Args:
            row: The row.

        Returns:
            Its stamp [s].
        """
        return float(self.read(row, row + 1)[0])

    def search(self, t: float) -> int:
        """Return the first row that is not before a time.

        Args:
            t: The time [s].

        Returns:
            The row; the number of rows if all are before.
        """
        return bisect_left(range(self._count), t, key=self.at)

    def blocks(self, first: int, stop: int) -> Iterator[tuple[int, Array]]:
        """Yield the time stamps in blocks that share a stamp with the one before.

        Args:
            first: First row.
            stop: Row after the last one.

        Yields:
            The first row of a block, and its stamps, at least two [s].
        """
        for row in range(first, stop - 1, _BLOCK):
            yield row, self.read(row, min(row + _BLOCK + 1, stop))

    def median_step(self, first: int, stop: int) -> float:
        """Return the median time step, exactly, whatever the number of rows.

        Args:
            first: First row.
            stop: Row after the last one.

        Returns:
            The median [s].
        """
        steps = stop - first - 1
        middle = [self._ordered(first, stop, rank) for rank in {(steps - 1) // 2, steps // 2}]
        return float(np.mean(middle))

    def _fill(self, blocks: Iterable[Array], where: str) -> None:
        last = np.empty(0)
        for block in blocks:
            require_finite(block[:, None], block, ["time"], where, self._count)
            require_increasing(np.append(last, block), where, self._count - len(last))
            np.ascontiguousarray(block, dtype=np.float64).tofile(self._file)
            self._count += len(block)
            last = block[-1:]

    def _ordered(self, first: int, stop: int, rank: int) -> float:
        """Return the step of a rank; positive floats are in the order of their bits."""
        found = 0
        for shift in range(64 - _DIGIT, -1, -_DIGIT):
            counts = np.zeros(2**_DIGIT, dtype=np.int64)
            for _, t in self.blocks(first, stop):
                keys = np.diff(t).view(np.uint64)
                if shift < 64 - _DIGIT:
                    keys = keys[keys >> np.uint64(shift + _DIGIT) == found]
                digits = (keys >> np.uint64(shift)) & np.uint64(2**_DIGIT - 1)
                counts += np.bincount(digits.astype(np.int64), minlength=2**_DIGIT)
            below = np.cumsum(counts)
            digit = int(np.searchsorted(below, rank, side="right"))
            rank -= int(below[digit - 1]) if digit else 0
            found = (found << _DIGIT) | digit
        return float(np.array([found], dtype=np.uint64).view(np.float64)[0])
