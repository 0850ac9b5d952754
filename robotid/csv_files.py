"""CSV files as tables of named columns."""

import csv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.log_source import Table

__all__ = ["open_csv", "write_csv"]


def open_csv(path: Path) -> Table:
    """Return the table in a CSV file.

    Args:
        path: The file: UTF-8, its first line names the columns.

    Returns:
        The table.

    Raises:
        DataError: If there is no header, a cell is no number, or a row has another length.
    """
    return Table(_csv_header(path)[0], partial(_read_csv, path))


def write_csv(table: Mapping[str, Array], path: Path) -> None:
    """Write columns as CSV: the shortest decimals that give the same bits.

    Args:
        table: Arrays of shape (N,) by name.
        path: The file.
    """
    rows = np.column_stack(list(table.values()))
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table)
        writer.writerows(row.tolist() for row in rows)


@contextmanager
def _open_csv(path: Path) -> Iterator[TextIO]:
    """Open a text file, whether or not it starts with a byte order mark."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            yield file
    except UnicodeDecodeError as error:
        raise DataError(f"{path.name} is not UTF-8 text: {error}; save it as UTF-8") from error


def _csv_header(path: Path) -> tuple[list[str], str]:
    """Return the column names of a CSV file and what separates them."""
    with _open_csv(path) as file:
        line = file.readline()
    if not line.strip():
        raise DataError(f"{path.name} is empty; its first line must name the columns")
    separator = max(",;\t", key=line.count)  # the comma, if there is none
    cells = next(csv.reader([line.strip("\r\n").lstrip("# ")], delimiter=separator))
    names = [cell.strip() for cell in cells]
    if all(_is_number(name) for name in names):
        raise DataError(f"{path.name} has no header; its first line must name the columns")
    return names, separator


def _read_csv(path: Path, wanted: Sequence[str]) -> dict[str, Array]:
    """Return the wanted columns of a CSV file."""
    names, separator = _csv_header(path)
    columns = [names.index(name) for name in wanted]
    with _open_csv(path) as file:
        file.readline()
        rows = _whole_rows(file, len(names), separator, path.name)
        first = list(islice(rows, 1))
        if not first:
            raise DataError(f"{path.name} has a header but no rows; record at least 2")
        how: Any = {"delimiter": separator, "comments": None, "quotechar": '"', "ndmin": 2}
        try:
            values = np.loadtxt(chain(first, rows), usecols=columns, **how)
        except (DataError, UnicodeDecodeError):
            raise
        except ValueError as error:
            raise _bad_cell(path, names, columns, separator) from error
    return dict(zip(wanted, values.T, strict=True))


def _whole_rows(lines: TextIO, count: int, separator: str, where: str) -> Iterator[str]:
    """Yield the lines that are not blank, and refuse those with too few or too many cells."""
    for number, line in enumerate(lines, start=2):
        if line.isspace():
            continue
        if line.count(separator) != count - 1:  # unless a separator stands in quotes
            found = len(next(csv.reader([line], delimiter=separator)))
            if found != count:
                raise DataError(
                    f"{where}: line {number} has {found} cells, the header has {count}; mend it"
                )
        yield line


def _bad_cell(path: Path, names: list[str], columns: list[int], separator: str) -> DataError:
    """Return the error that names the first cell that is not a number."""
    with _open_csv(path) as file:
        file.readline()
        for row, line in enumerate(_whole_rows(file, len(names), separator, path.name)):
            cells = next(csv.reader([line], delimiter=separator))
            for i in columns:
                if not _is_number(cells[i]):
                    found = repr(cells[i]) if cells[i].strip() else "empty"
                    hint = "; write decimals with a point" if "," in cells[i] else ""
                    return DataError(
                        f"{path.name}: {names[i]} is {found} at row {row}, wanted a number{hint}; "
                        "remove the row or mend the recording"
                    )
    return DataError(f"{path.name} holds a cell that is not a plain decimal number")


def _is_number(text: str) -> bool:
    """Return whether a cell holds a number, NaN and infinity among them."""
    try:
        float(text)
    except ValueError:
        return False
    return True
