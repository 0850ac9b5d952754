"""CSV files as tables of named columns."""

import csv
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import quoted
from robotid.base.typing import Array
from robotid.data.files.columns import named_by_row
from robotid.data.files.table import Format, Place, RowReader, Table
from robotid.data.signal_settings import LogSource

_BLOCK = 4096  # lines read at a time
_SENSED = ("base_", "imu_", "contact_", "wrench_")  # columns that other devices record


def _open(path: Path, source: LogSource) -> Table:
    names, separator, header, first = _header(path, source)
    rows = _CsvRows(path, names, separator, header)
    read = partial(rows.read, first=0, stop=sys.maxsize, near=Place())
    return Table(names, read, rows=rows).with_names(named_by_row(first))


def _write(table: Mapping[str, Array], path: Path) -> None:
    rows = np.column_stack(list(table.values()))
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table)
        writer.writerows(row.tolist() for row in rows)


#: CSV files and text with white space: UTF-8, the first line names the columns, or a job does.
#: Numbers are written with the fewest digits that reproduce them exactly.
CSV = Format((".csv", ".dat", ".txt"), _open, _write, written=(".csv",))


@dataclass(frozen=True)
class _CsvRows(RowReader):
    path: Path
    names: list[str]
    separator: str | None  # None: any white space
    header: int  # lines before the first row

    def count(self) -> int:
        with self.path.open("rb") as file:
            blocks = iter(partial(file.read, 2**20), b"")
            return sum(block.count(b"\n") for block in blocks) - self.header

    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        for lines, place, _ in self._blocks(Place(), sys.maxsize):
            yield self._numbers(self._rows(lines, place.line), [name])[name], place

    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        parts = []
        for lines, place, count in self._blocks(near, stop):
            start, end = max(first - place.row, 0), min(stop - place.row, count)
            if start < end:
                rows = self._rows(lines, place.line)
                parts.append(self._numbers(islice(rows, start, end), wanted))
        if not parts:
            raise DataError(f"{self.path.name} has a header but no rows; record at least 2")
        return {name: np.concatenate([part[name] for part in parts]) for name in wanted}

    def _blocks(self, near: Place, stop: int) -> Iterator[tuple[list[str], Place, int]]:
        """Yield lines, blank lines included, the place of the first, and the number of rows."""
        with self.path.open("rb") as file:
            place = near
            if near.offset == 0:
                skipped = sum(len(file.readline()) for _ in range(self.header))
                place = Place(0, 1 + self.header, skipped)
            file.seek(place.offset)
            while place.row < stop and (raw := list(islice(file, _BLOCK))):
                rows = len(raw) - sum(line.isspace() for line in raw)
                with _utf8(self.path):
                    lines = [line.decode() for line in raw]
                if rows:
                    yield lines, place, rows
                size = sum(map(len, raw))
                place = Place(place.row + rows, place.line + len(raw), place.offset + size)

    def _numbers(self, rows: Iterable[str], wanted: Sequence[str]) -> dict[str, Array]:
        columns = [self.names.index(name) for name in wanted]
        form: dict[str, Any] = {"comments": None, "delimiter": self.separator, "quotechar": '"'}
        try:
            values = np.loadtxt(rows, usecols=columns, ndmin=2, **form)
        except DataError:
            raise
        except ValueError as error:
            raise self._bad_cell(columns) from error
        return dict(zip(wanted, values.T, strict=True))

    def _rows(self, lines: Iterable[str], first: int) -> Iterator[str]:
        """Yield the lines that are not blank, and reject those with too few or too many cells."""
        count, separator = len(self.names), self.separator
        for number, line in enumerate(lines, start=first):
            if line.isspace():
                continue
            if separator is None or line.count(separator) != count - 1:  # it may be in quotes
                cells = len(_split(self.path.name, line, separator, number))
                if cells != count:
                    raise DataError(
                        f"{self.path.name}: line {number} has {cells} cells, the header has "
                        f"{count}; correct it"
                    )
            yield line if separator == "," else line.replace(",", ".")  # of decimals

    def _bad_cell(self, columns: list[int]) -> DataError:
        """Return the error on the first cell that is not a number."""
        for lines, place, _ in self._blocks(Place(), sys.maxsize):
            for row, line in enumerate(self._rows(lines, place.line), start=place.row):
                cells = _split(self.path.name, line, self.separator, row + 1 + self.header)
                for i in columns:
                    if not _is_number(cells[i]):
                        return self._no_number(self.names[i], row, cells[i])
        return DataError(
            f"{self.path.name} contains a cell that is not a decimal number; correct it"
        )

    def _no_number(self, name: str, row: int, cell: str) -> DataError:
        hint = "; write decimals with a point" if "," in cell else ""
        other = "interpolate a column of another rate at the joints' stamps"
        if not cell.strip() and name.startswith(_SENSED):
            hint = f"; {other}"
        end = "" if cell.strip() or hint else f", or {other}"
        return DataError(
            f"{self.path.name}: {name} is {repr(cell[:80]) if cell.strip() else 'empty'} at row "
            f"{row}, expected a number{hint}; remove such rows or correct the recording{end}"
        )


@contextmanager
def _utf8(path: Path) -> Iterator[None]:
    try:
        yield
    except UnicodeDecodeError as error:
        raise DataError(f"{path.name} is not UTF-8 text: {error}; save it as UTF-8") from error


def _header(
    path: Path, source: LogSource
) -> tuple[list[str], str | None, int, Mapping[str, object]]:
    """Return names (numbers without a header), separator, lines before the rows, and a row."""
    with _utf8(path), path.open(encoding="utf-8-sig") as file:  # with or without a byte order mark
        line, second = file.readline(), file.readline()
    if not line.strip():
        raise DataError(f"{path.name} is empty; its first line must name the columns")
    text = re.sub(r"^(#|% )\s*", "", line.strip("\r\n"))
    separator: str | None = max(",;\t", key=text.count)
    if str(separator) not in text:
        separator = None if len(text.split()) > 1 else ","
    names = [cell.strip() for cell in _split(path.name, text, separator, 1)]
    if not all(_is_number(name) for name in names):
        cells = _split(path.name, second or ",", separator, 2)
        return names, separator, 1, dict(zip(names, cells, strict=False))
    if not source.names:
        half = range(1, len(names) // 2 + 1)
        likely = ["time"] * (len(names) % 2)
        likely += [f"{kind}_{k}" for kind in ("q", "tau") for k in half]
        raise DataError(
            f"{path.name} has no header. Set the names of its {len(names)} columns in the job "
            "file, and the rate of its rows if none of them is the time. An example:\n"
            f"[log]\nnames = [{', '.join(map(quoted, likely))}]"
            + "\nrate = 100  # [Hz]"
            * ("time" not in likely),
            code="missing_column",
        )
    return [str(k) for k in range(len(names))], separator, 0, {}


def _split(where: str, line: str, separator: str | None, number: int) -> list[str]:
    """Return the cells of a line; quoted cells may contain separators."""
    if separator is None:
        return line.split()
    try:
        return next(csv.reader([line], delimiter=separator))
    except (csv.Error, StopIteration) as error:
        reason = str(error) or "no cells"
        raise DataError(f"{where}: line {number} cannot be read ({reason}); correct it") from error


def _is_number(text: str) -> bool:
    """Whether a cell contains a number, NaN or infinity."""
    try:
        float(text)
    except ValueError:
        return False
    return True
