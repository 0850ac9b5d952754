"""CSV files as tables of named columns."""

import csv
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import quoted
from robotid.base.typing import Array
from robotid.data.files.column_names import named_by_row
from robotid.data.files.table import Place, RowReader, Table, WritableFormat
from robotid.data.signal_settings import LogSource

_BLOCK = 4096  # lines read at a time
_SENSED = ("base_", "imu_", "contact_", "wrench_")  # columns that other devices record


class CsvFormat(WritableFormat):
    """CSV files and text with white space: UTF-8, the first line names the columns, or a job does.

    Numbers are written with the fewest digits that reproduce them exactly.
    """

    def open(self, path: Path, source: LogSource) -> Table:
        names, separator, header = _csv_header(path, source)
        with _open_csv(path) as file:
            row = _split(path.name, "".join(islice(file, 1, 2)) or ",", separator, 2)
        named = named_by_row(dict(zip(names, row, strict=False)))
        rows = _CsvRows(path, [named.get(x, x) for x in names], separator, header)
        return Table(rows.names, rows.read_all, (), rows, named)

    def write(self, table: Mapping[str, Array], path: Path) -> None:
        rows = np.column_stack(list(table.values()))
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(table)
            writer.writerows(row.tolist() for row in rows)


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
        for lines, place, _ in self._blocks(Place(), None):
            yield self._numbers(self._whole(lines, place.line), [name])[name], place

    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        parts = []
        for lines, place, rows in self._blocks(near, stop):
            start, end = max(first - place.row, 0), min(stop - place.row, rows)
            if start < end:
                whole = self._whole(lines, place.line)
                parts.append(self._numbers(islice(whole, start, end), wanted))
        return {name: np.concatenate([part[name] for part in parts]) for name in wanted}

    def _blocks(self, near: Place, stop: int | None) -> Iterator[tuple[list[str], Place, int]]:
        """Yield lines, blank lines included, the place of the first, and the number of rows."""
        with self.path.open("rb") as file:
            place = near
            if near.offset == 0:
                skipped = sum(len(file.readline()) for _ in range(self.header))
                place = Place(0, 1 + self.header, skipped)
            file.seek(place.offset)
            while stop is None or place.row < stop:
                raw = list(islice(file, _BLOCK))
                rows = len(raw) - sum(line.isspace() for line in raw)
                if not raw:
                    return
                try:
                    lines = [line.decode() for line in raw]
                except UnicodeDecodeError as error:
                    raise _not_utf8(self.path, error) from error
                if rows:
                    yield lines, place, rows
                size = sum(map(len, raw))
                place = Place(place.row + rows, place.line + len(raw), place.offset + size)

    def read_all(self, wanted: Sequence[str]) -> dict[str, Array]:
        """Return whole columns by name."""
        with _open_csv(self.path) as file:
            rows = self._whole(islice(file, self.header, None), 1 + self.header)
            first = list(islice(rows, 1))
            if not first:
                raise DataError(f"{self.path.name} has a header but no rows; record at least 2")
            return self._numbers(chain(first, rows), wanted)

    def _numbers(self, rows: Iterable[str], wanted: Sequence[str]) -> dict[str, Array]:
        columns = [self.names.index(name) for name in wanted]
        form: dict[str, Any] = {"comments": None, "delimiter": self.separator, "quotechar": '"'}
        try:
            values = np.loadtxt(rows, usecols=columns, ndmin=2, **form)
        except (DataError, UnicodeDecodeError):
            raise
        except ValueError as error:
            raise self._bad_cell(columns) from error
        return dict(zip(wanted, values.T, strict=True))

    def _whole(self, lines: Iterable[str], first: int) -> Iterator[str]:
        """Yield the lines that are not blank, and reject those with too few or too many cells."""
        count, separator = len(self.names), self.separator
        for number, line in enumerate(lines, start=first):
            if line.isspace():
                continue
            if (
                separator is None or line.count(separator) != count - 1
            ):  # unless a separator is in quotes
                found = len(self._cells(line, number))
                if found != count:
                    raise DataError(
                        f"{self.path.name}: line {number} has {found} cells, the header has "
                        f"{count}; correct it"
                    )
            yield line

    def _cells(self, line: str, number: int) -> list[str]:
        return _split(self.path.name, line, self.separator, number)

    def _bad_cell(self, columns: list[int]) -> DataError:
        """Return the error on the first cell that is not a number."""
        where = self.path.name
        with _open_csv(self.path) as file:
            lines = islice(file, self.header, None)
            for row, line in enumerate(self._whole(lines, 1 + self.header)):
                cells = self._cells(line, row + 1 + self.header)
                for i in columns:
                    if not _is_number(cells[i]):
                        found = repr(cells[i][:80]) if cells[i].strip() else "empty"
                        hint = "; write decimals with a point" if "," in cells[i] else ""
                        if found == "empty" and self.names[i].startswith(_SENSED):
                            hint = "; interpolate a column of another rate at the joints' stamps"
                        return DataError(
                            f"{where}: {self.names[i]} is {found} at row {row}, wanted a "
                            f"number{hint}; remove the row or correct the recording"
                        )
        return DataError(f"{where} contains a cell that is not a decimal number; correct it")


@contextmanager
def _open_csv(path: Path) -> Iterator[TextIO]:
    """Open a text file, with or without a byte order mark."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            yield file
    except UnicodeDecodeError as error:
        raise _not_utf8(path, error) from error


def _not_utf8(path: Path, error: UnicodeDecodeError) -> DataError:
    return DataError(f"{path.name} is not UTF-8 text: {error}; save it as UTF-8")


def _csv_header(path: Path, source: LogSource) -> tuple[list[str], str | None, int]:
    """Return the names in the first line, the separator and the number of lines before the rows.

    Without a header, the names are the numbers of the columns.
    """
    with _open_csv(path) as file:
        line = file.readline()
    if not line.strip():
        raise DataError(f"{path.name} is empty; its first line must name the columns")
    text = re.sub(r"^(#|% )\s*", "", line.strip("\r\n"))
    separator: str | None = max(",;\t", key=text.count)
    if str(separator) not in text:
        separator = None if len(text.split()) > 1 else ","
    names = [cell.strip() for cell in _split(path.name, text, separator, 1)]
    if not all(_is_number(name) for name in names):
        return names, separator, 1
    if not source.names:
        half = range(1, len(names) // 2 + 1)
        likely = ["time"] * (len(names) % 2)
        likely += [f"{kind}_{k}" for kind in ("q", "tau") for k in half]
        raise DataError(
            f"{path.name} has no header. State the names of its {len(names)} columns in the job "
            "file, and the rate of its rows if none of them is the time. An example:\n"
            f"[log]\nnames = [{', '.join(map(quoted, likely))}]"
            + "\nrate = 100  # [Hz]"
            * ("time" not in likely),
            code="missing_column",
        )
    return [str(k) for k in range(len(names))], separator, 0


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
