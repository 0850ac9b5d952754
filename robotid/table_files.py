"""Tables of numbers as CSV and Parquet files: a name and a column of equal length for each."""

import csv
import os
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError, MissingDependencyError

__all__ = ["is_csv", "load_pyarrow", "write_table"]


def write_table(table: Mapping[str, Array], path: str | Path) -> None:
    """Write columns as CSV or Parquet; reading them gives the same numbers, to the last bit.

    The file is written beside its final place and then moved there: it is never half-written.

    Args:
        table: Columns by name, each of shape (N,).
        path: A .csv or .parquet file; one that exists is replaced.

    Raises:
        DataError: If the file name ends in neither.
        MissingDependencyError: If Parquet is written without pyarrow.
        OSError: If the folder cannot be written to.
    """
    target = Path(path)
    write = _write_csv if is_csv(target) else _write_parquet
    partial = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        write(table, partial)
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


def is_csv(path: Path) -> bool:
    """Return whether a file is CSV rather than Parquet, by its suffix.

    Args:
        path: The file.

    Returns:
        Whether it is.

    Raises:
        DataError: If its name ends in neither.
    """
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise DataError(f"{path.name}: logs are .csv or .parquet files, not {suffix!r}; convert it")
    return suffix == ".csv"


def load_pyarrow(purpose: str) -> ModuleType:
    """Return pyarrow, with its parquet loaded.

    Args:
        purpose: What it is needed for, as "writing Parquet".

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


def _write_csv(table: Mapping[str, Array], path: Path) -> None:
    """Write columns as CSV; the shortest decimals that give the same bits."""
    rows = np.column_stack(list(table.values()))
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table)
        writer.writerows(row.tolist() for row in rows)


def _write_parquet(table: Mapping[str, Array], path: Path) -> None:
    """Write columns as Parquet."""
    pa = load_pyarrow("writing Parquet")
    pa.parquet.write_table(pa.table(dict(table)), path)
