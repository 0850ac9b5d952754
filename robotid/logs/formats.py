"""Tables in files: named columns of numbers in any format that is known by its suffix."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from robotid._files import written_whole
from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.logs.arrays import open_hdf5, open_mat, open_npz, write_hdf5, write_mat, write_npz
from robotid.logs.bags import open_bag
from robotid.logs.csv_files import open_csv, write_csv
from robotid.logs.parquet_files import open_parquet, write_parquet
from robotid.logs.settings import LogSource
from robotid.logs.table import Table

__all__ = ["open_table", "write_columns"]


@dataclass(frozen=True)
class _Format:
    """How one format is opened and, if it is, written."""

    open: Callable[[Path, LogSource], Table]
    write: Callable[[Mapping[str, Array], Path], None] | None = None


def _without_topics(open_file: Callable[[Path], Table]) -> Callable[[Path, LogSource], Table]:
    """Return the opener of a format that has one table; a topic that is stated is noted."""

    def open_only(path: Path, source: LogSource) -> Table:
        table = open_file(path)
        if source.topic is None:
            return table
        note = f"the topic {source.topic!r} is not used: {path.suffix} files have none"
        return replace(table, notes=(note,))

    return open_only


_HDF5 = _Format(open_hdf5, write_hdf5)
_BAG = _Format(open_bag)
_FORMATS = {
    ".csv": _Format(_without_topics(open_csv), write_csv),
    ".parquet": _Format(_without_topics(open_parquet), write_parquet),
    ".npz": _Format(open_npz, write_npz),
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".mat": _Format(open_mat, write_mat),
    ".mcap": _BAG,
    ".db3": _BAG,
    ".bag": _BAG,
}


def open_table(path: Path, source: LogSource) -> Table:
    """Return the table in a file.

    Args:
        path: A file of a known suffix, or the folder of a ROS 2 bag.
        source: Where in the file.

    Returns:
        The table; what is wrong with a column is told when it is read.

    Raises:
        DataError: If the file is missing, of another suffix or broken, or its table is not found.
        MissingDependencyError: If a package that reads it is not installed.
    """
    if path.is_dir():
        return open_bag(path, source)
    suffix = path.suffix.lower()
    if suffix not in _FORMATS:
        raise DataError(
            f"{path.name}: logs are {_listed(list(_FORMATS))} files, or the folder of a ROS 2 bag, "
            f"not {suffix!r}; convert it"
        )
    if not path.is_file():
        raise DataError(f"there is no log file {str(path)!r}")
    return _FORMATS[suffix].open(path, source)


def write_columns(table: Mapping[str, Array], path: Path) -> None:
    """Write columns to a file; reading them gives the same numbers, to the last bit.

    The file is written beside its final place and then moved there: it is never half-written.

    Args:
        table: Arrays of shape (N,) by name.
        path: A file whose suffix names a format that is written; one that exists is replaced.

    Raises:
        DataError: If the file name ends otherwise, or the format cannot hold a name.
        MissingDependencyError: If a package that writes it is not installed.
        OSError: If the folder cannot be written to.
    """
    written = {suffix: f.write for suffix, f in _FORMATS.items() if f.write is not None}
    suffix = path.suffix.lower()
    if suffix not in written:
        raise DataError(
            f"{path.name}: logs are written as {_listed(list(written))} files, not {suffix!r}"
        )
    with written_whole(path) as beside:
        written[suffix](table, beside)


def _listed(words: list[str]) -> str:
    """Return words with commas, and "or" before the last."""
    return f"{', '.join(words[:-1])} or {words[-1]}"
