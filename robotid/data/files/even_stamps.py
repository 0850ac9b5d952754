"""Evenly spaced time stamps, for rows that were recorded at one rate and stamped on arrival."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robotid.base.typing import Array
from robotid.data.files.table import Place, RowReader, Table


def with_even_stamps(table: Table, column: str, stamp: str = "even") -> Table:
    """Return a table whose rows have equal time steps: the straight line through its stamps."""
    if stamp != "even":
        return table

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        values = table.read(wanted)
        if (t := values.get(column)) is None:
            return values
        start, step = _line([t])
        return {**values, column: start + step * np.arange(len(t))}

    rows = None if table.rows is None else _EvenRows(table.rows, column)
    return replace(table, read=read, rows=rows)


def _line(blocks: Iterable[Array]) -> tuple[float, float]:
    """Return the first value and the step of the least-squares line through values by row."""
    count, first = 0, 0.0
    sums = np.zeros(4)  # of row, value, row * value, row^2
    for block in blocks:
        if not count and len(block):
            first = float(block[0])
        row, t = np.arange(count, count + len(block), dtype=float), block - first
        sums += row.sum(), t.sum(), row @ t, row @ row
        count += len(block)
    if count < 2:
        return first, 0.0
    row, t, both, square = sums / count
    step = float((both - row * t) / (square - row**2))
    return first + float(t - step * row), step


@dataclass(frozen=True)
class _EvenRows(RowReader):
    """The rows of another reader, with equal time steps."""

    own: RowReader
    column: str

    def count(self) -> int:
        return self.own.count()

    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        row = 0
        for values, place in self.own.scan(name):
            yield self._even(row, row + len(values)) if name == self.column else values, place
            row += len(values)

    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        values = self.own.read(wanted, first, stop, near)
        return values | {x: self._even(first, stop) for x in values if x == self.column}

    def _even(self, first: int, stop: int) -> Array:
        start, step = self._line
        even: Array = start + step * np.arange(first, stop)
        return even

    @cached_property
    def _line(self) -> tuple[float, float]:
        return _line(values for values, _ in self.own.scan(self.column))
