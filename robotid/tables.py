"""Tables in files: named columns of numbers as CSV or Parquet, whatever they mean."""

import csv
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from types import ModuleType
from typing import Any, TextIO

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError, MissingDependencyError

__all__ = ["column_names", "read_columns", "write_columns"]


def column_names(path: Path) -> list[str]:
    """Return the names of the columns of a file.

    Args:
        path: A .csv or .parquet file.

    Returns:
        The names, in the file's order.

    Raises:
        DataError: If the file is missing or has no header.
        MissingDependencyError: If it is Parquet and pyarrow is not installed.
    """
    is_csv = _is_csv(path)
    if not path.is_file():
        raise DataError(f"there is no log file {str(path)!r}")
    return _csv_header(path)[0] if is_csv else _parquet_names(path)


def read_columns(path: Path, wanted: Sequence[str]) -> dict[str, Array]:
    """Return some columns of a file.

    Args:
        path: A .csv or .parquet file.
        wanted: Names of the columns.

    Returns:
        Arrays of shape (N,) by name; a missing value is NaN.

    Raises:
        DataError: If a cell is no number, a row has another length, or there is no row.
        MissingDependencyError: If it is Parquet and pyarrow is not installed.
    """
    return _read_csv(path, wanted) if _is_csv(path) else _read_parquet(path, wanted)


def write_columns(table: Mapping[str, Array], path: Path) -> None:
    """Write columns to a file; reading them gives the same numbers, to the last bit.

    The file is written beside its final place and then moved there: it is never half-written.

    Args:
        table: Arrays of shape (N,) by name.
        path: A .csv or .parquet file; one that exists is replaced.

    Raises:
        DataError: If the file name ends in neither.
        MissingDependencyError: If Parquet is written without pyarrow.
        OSError: If the folder cannot be written to.
    """
    write = _write_csv if _is_csv(path) else _write_parquet
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        write(table, partial)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _is_csv(path: Path) -> bool:
    """Return whether a file is CSV rather than Parquet, by its suffix."""
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise DataError(f"{path.name}: logs are .csv or .parquet files, not {suffix!r}; convert it")
    return suffix == ".csv"


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
                        "remove the row or mend the recording",
                        code="not_a_number",
                    )
    return DataError(f"{path.name} holds a cell that is not a plain decimal number")


def _is_number(text: str) -> bool:
    """Return whether a cell holds a number, NaN and infinity among them."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _write_csv(table: Mapping[str, Array], path: Path) -> None:
    """Write columns as CSV; the shortest decimals that give the same bits."""
    rows = np.column_stack(list(table.values()))
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table)
        writer.writerows(row.tolist() for row in rows)


def _pyarrow(purpose: str) -> ModuleType:
    """Return pyarrow, with its parquet loaded."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingDependencyError(purpose, "pyarrow", "parquet") from error
    package: ModuleType = pyarrow
    return package


@contextmanager
def _open_parquet(path: Path) -> Iterator[Any]:
    """Open a Parquet file; what is wrong with it is told in our words."""
    pa = _pyarrow("reading Parquet")
    try:
        with pa.parquet.ParquetFile(path) as file:
            yield file
    except (pa.ArrowInvalid, OSError) as error:
        raise DataError(f"{path.name}: broken Parquet file ({error}); export it again") from error


def _parquet_names(path: Path) -> list[str]:
    """Return the column names of a Parquet file."""
    with _open_parquet(path) as file:
        return list(file.schema_arrow.names)


def _read_parquet(path: Path, wanted: Sequence[str]) -> dict[str, Array]:
    """Return the wanted columns of a Parquet file; null becomes NaN."""
    types = _pyarrow("reading Parquet").types
    with _open_parquet(path) as file:
        for name in wanted:
            kind = file.schema_arrow.field(name).type
            if not (types.is_integer(kind) or types.is_floating(kind)):
                raise DataError(f"{path.name}: {name} holds {kind}, wanted numbers; convert it")
        table = file.read(columns=list(wanted))
    return {name: table.column(name).to_numpy().astype(np.float64, copy=False) for name in wanted}


def _write_parquet(table: Mapping[str, Array], path: Path) -> None:
    """Write columns as Parquet."""
    pa = _pyarrow("writing Parquet")
    pa.parquet.write_table(pa.table(dict(table)), path)
