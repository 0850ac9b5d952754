"""Parquet files as tables of named columns; pyarrow is imported when one is opened."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, MissingDependencyError
from robotid.base.typing import Array
from robotid.data.files.column_names import named_by_row
from robotid.data.files.foreign_tables import renamed
from robotid.data.files.table import Place, RowReader, Table, WritableFormat, parsing
from robotid.data.signal_settings import LogSource

_TEXTS = ("string", "large_string")  # types of columns
_BATCH = 16384  # rows decoded together, if not all are required
_BUFFER = 2**16  # bytes of each column read together in this case, not whole row groups


class ParquetFormat(WritableFormat):
    """Parquet files; null becomes NaN."""

    def open(self, path: Path, source: LogSource) -> Table:
        with _open(path) as file:
            names = list(file.schema_arrow.names)
            texts = [x for x in names if str(file.schema_arrow.field(x).type) in _TEXTS]
            rows = next(file.iter_batches(1, columns=texts), None) if texts else None
        first = rows.to_pylist()[0] if rows is not None and len(rows) else {}
        table = Table(names, partial(_read, path), (), _ParquetRows(path))
        return renamed(table, named_by_row(dict.fromkeys(names, "") | first))

    def write(self, table: Mapping[str, Array], path: Path) -> None:
        pa = load_pyarrow("writing Parquet")
        pa.parquet.write_table(pa.table(dict(table)), path)


def load_pyarrow(purpose: str) -> ModuleType:
    """Return pyarrow, with pyarrow.parquet imported."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingDependencyError(purpose, "pyarrow", "parquet") from error
    package: ModuleType = pyarrow
    return package


@dataclass(frozen=True)
class _ParquetRows(RowReader):
    path: Path

    def count(self) -> int:
        with _open(self.path) as file:
            return int(file.metadata.num_rows)

    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        row = 0
        with _open(self.path, [name], _BUFFER) as file:
            for group in range(file.num_row_groups):  # one by one: groups stay in memory
                for batch in self._batches(file, name, [group]):
                    yield _to_numpy(batch.column(0)), Place(row)
                    row += batch.num_rows

    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        values = {name: np.empty(stop - first) for name in wanted}
        with _open(self.path, wanted, _BUFFER) as file:
            sizes = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
            edges = np.cumsum([0, *sizes])
            groups = np.flatnonzero((edges[:-1] < stop) & (edges[1:] > first)).tolist()
            for name in wanted:  # one by one: each column needs memory for some pages
                row = int(edges[groups[0]])
                for batch in self._batches(file, name, groups):
                    start, end = max(first - row, 0), min(stop - row, batch.num_rows)
                    if start < end:
                        part = slice(row + start - first, row + end - first)
                        values[name][part] = _to_numpy(batch.column(0).slice(start, end - start))
                    row += batch.num_rows
                    if row >= stop:
                        break
        return values

    def _batches(self, file: Any, name: str, groups: Sequence[int]) -> Iterator[Any]:  # noqa: ANN401
        """Yield batches of rows of one column."""
        how = {"columns": [name], "row_groups": groups, "use_threads": False}
        batches: Iterator[Any] = file.iter_batches(_BATCH, **how)
        return batches


@contextmanager
def _open(path: Path, wanted: Sequence[str] = (), buffer: int = 0) -> Iterator[Any]:
    """Open a Parquet file; the wanted columns must contain numbers."""
    pa = load_pyarrow("reading Parquet")
    with (
        parsing(path, "Parquet"),
        pa.parquet.ParquetFile(path, buffer_size=buffer) as file,
    ):
        for name in wanted:
            kind = file.schema_arrow.field(name).type
            if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
                todo = "write one column per value, or their sum" * pa.types.is_nested(kind)
                raise DataError(
                    f"{path.name}: {name} contains {kind}, wanted numbers; {todo or 'convert it'}"
                )
        yield file


def _read(path: Path, wanted: Sequence[str]) -> dict[str, Array]:
    with _open(path, wanted) as file:
        table = file.read(columns=list(wanted))
    return {name: _to_numpy(table.column(name)) for name in wanted}


def _to_numpy(column: Any) -> Array:  # noqa: ANN401
    """Return a column of a table or of a batch; null becomes NaN."""
    chunks = column.chunks if hasattr(column, "chunks") else [column]
    # to_numpy imports pandas if it is installed, half a second; DLPack does not support null
    parts = [
        chunk.to_numpy(zero_copy_only=False) if chunk.null_count else np.from_dlpack(chunk)
        for chunk in chunks
    ]
    return np.concatenate([np.empty(0), *parts], dtype=np.float64)
