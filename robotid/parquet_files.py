"""Parquet files as tables of named columns; pyarrow is imported when one is opened."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError, MissingDependencyError
from robotid.log_source import Table

__all__ = ["load_pyarrow", "open_parquet", "write_parquet"]


def open_parquet(path: Path) -> Table:
    """Return the table in a Parquet file.

    Args:
        path: The file.

    Returns:
        The table; null becomes NaN.

    Raises:
        DataError: If the file is broken, or a column read holds no numbers.
        MissingDependencyError: If pyarrow is not installed.
    """
    with _open(path) as file:
        names = list(file.schema_arrow.names)
    return Table(names, partial(_read, path))


def write_parquet(table: Mapping[str, Array], path: Path) -> None:
    """Write columns as Parquet.

    Args:
        table: Arrays of shape (N,) by name.
        path: The file.

    Raises:
        MissingDependencyError: If pyarrow is not installed.
    """
    pa = load_pyarrow("writing Parquet")
    pa.parquet.write_table(pa.table(dict(table)), path)


def load_pyarrow(purpose: str) -> ModuleType:
    """Return pyarrow, with its parquet loaded.

    Args:
        purpose: What it is needed for, as "reading Parquet".

    Returns:
        The package.

    Raises:
        MissingDependencyError: If it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingDependencyError(purpose, "pyarrow", "parquet") from error
    package: ModuleType = pyarrow
    return package


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    """Open a Parquet file; what is wrong with it is told in our words."""
    pa = load_pyarrow("reading Parquet")
    try:
        with pa.parquet.ParquetFile(path) as file:
            yield file
    except (pa.ArrowInvalid, OSError) as error:
        raise DataError(f"{path.name}: broken Parquet file ({error}); export it again") from error


def _read(path: Path, wanted: Sequence[str]) -> dict[str, Array]:
    """Return the wanted columns of a Parquet file; null becomes NaN."""
    types = load_pyarrow("reading Parquet").types
    with _open(path) as file:
        for name in wanted:
            kind = file.schema_arrow.field(name).type
            if not (types.is_integer(kind) or types.is_floating(kind)):
                raise DataError(f"{path.name}: {name} holds {kind}, wanted numbers; convert it")
        table = file.read(columns=list(wanted))
    return {name: table.column(name).to_numpy().astype(np.float64, copy=False) for name in wanted}
