"""Tables of texts and numbers that are no logs: read from CSV or Parquet, written to Parquet."""

import csv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from robotid.base.exceptions import DataError
from robotid.base.files import missing_file
from robotid.data.files.parquet_files import load_pyarrow
from robotid.data.files.table import parsing

_GROUP = 10_000  # rows of a row group, which are in memory before it is written


def read_text_table(path: str | Path) -> tuple[list[str], list[dict[str, str]]]:
    """Return the names of the columns and the rows of a table; a missing value is ""."""
    source = Path(path)
    if not source.is_file():
        raise DataError(missing_file(source, "table"))
    readers = {".csv": _read_csv, ".parquet": _read_parquet}
    if source.suffix.lower() not in readers:
        raise DataError(
            f"{source.name}: the suffix is {source.suffix!r}, wanted a table of type .csv or "
            ".parquet; convert it"
        )
    names, rows = readers[source.suffix.lower()](source)
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise DataError(f"{source.name} has several columns {repeated[0]!r}; rename all but one")
    return names, [dict(zip(names, row, strict=True)) for row in rows]


def _read_csv(path: Path) -> tuple[list[str], list[list[str]]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = [line for line in csv.reader(file, strict=True) if line]
    except (csv.Error, UnicodeDecodeError) as error:
        raise DataError(f"{path.name} is not a CSV table: {error}; wanted UTF-8 text") from error
    if not lines:
        raise DataError(f"{path.name} is empty, wanted a row of names and rows of values")
    names, *rows = [[cell.strip() for cell in line] for line in lines]
    for number, row in enumerate(rows, start=1):
        if len(row) != len(names):
            raise DataError(
                f"{path.name} row {number} has {len(row)} values, wanted {len(names)}, as many as "
                "columns; put values that contain a comma in double quotes"
            )
    return names, rows


def _read_parquet(path: Path) -> tuple[list[str], list[list[str]]]:
    pa = load_pyarrow("reading Parquet")
    with parsing(path, "Parquet"):
        table = pa.parquet.read_table(path)
        columns = [column.to_pylist() for column in table.columns]
    cells = [["" if x is None else str(x).strip() for x in column] for column in columns]
    return list(table.column_names), [list(row) for row in zip(*cells, strict=True)]


class ParquetRows:
    """Writes rows to a Parquet file; at most one row group of them is in memory."""

    def __init__(self, writer: Any, schema: Any) -> None:  # noqa: ANN401
        self._writer, self._schema = writer, schema
        self._waiting: list[Mapping[str, str | float | None]] = []
        self.count = 0  # rows so far

    def add(self, rows: Sequence[Mapping[str, str | float | None]]) -> None:
        """Add rows."""
        self.count += len(rows)
        self._waiting += rows
        while len(self._waiting) >= _GROUP:
            self._write(_GROUP)

    def close(self) -> None:
        """Write the rows that are left."""
        if self._waiting:
            self._write(len(self._waiting))

    def _write(self, count: int) -> None:
        import pyarrow

        some, self._waiting = self._waiting[:count], self._waiting[count:]
        columns = {name: [row.get(name) for row in some] for name in self._schema.names}
        self._writer.write_table(pyarrow.table(columns, schema=self._schema))


@contextmanager
def parquet_rows(path: Path, columns: Mapping[str, type]) -> Iterator[ParquetRows]:
    """Write a Parquet file row by row; equal rows make equal files."""
    pa = load_pyarrow("writing Parquet")
    kinds = {str: pa.string(), float: pa.float64()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in columns.items()])
    with pa.parquet.ParquetWriter(path, schema) as writer:
        rows = ParquetRows(writer, schema)
        yield rows
        rows.close()


def parquet_values(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of a Parquet file, without their nulls; a row group of them is in memory."""
    pa = load_pyarrow("reading Parquet")
    with parsing(path, "Parquet"), pa.parquet.ParquetFile(path) as file:
        for batch in file.iter_batches(_GROUP):
            for row in batch.to_pylist():
                yield {name: value for name, value in row.items() if value is not None}
