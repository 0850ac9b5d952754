"""The formats of log files: a format is known by its entry in one table."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import DATASET, dataset_of, missing_file, written_whole
from robotid.base.typing import Array
from robotid.data.files.arrays import HDF5, MAT, NPZ
from robotid.data.files.bags import BAG
from robotid.data.files.csv_files import CSV
from robotid.data.files.parquet_files import LEROBOT, PARQUET
from robotid.data.files.table import (
    Format,
    Table,
    with_standard_names,
    with_stated_names,
    with_time,
)
from robotid.data.signal_settings import LogSource

#: All formats of files; BAG and LEROBOT are folders, too.
FORMATS = (CSV, PARQUET, NPZ, HDF5, MAT, BAG)
_READ = {suffix: form for form in FORMATS for suffix in form.suffixes}
_WRITTEN = {suffix: form.write for form in FORMATS for suffix in form.written if form.write}
_LONGEST_NAME = 1000  # characters of a column


def open_table(path: Path, source: LogSource) -> Table:
    """Return the table in a file; faults of a column are reported when it is read."""
    if (dataset := dataset_of(path)) is not None:
        if source.topic not in (None, path.name):
            raise SettingsError(
                f"log.topic is {source.topic!r}, but the log is {path.name} of {dataset.name}; "
                "leave topic out"
            )
        path, source = dataset, replace(source, topic=path.name)
    form = _format_of(path)
    if source.command is not None and form is not BAG:
        raise SettingsError(
            f"log.command is {source.command!r}, the topic of a bag, but {path.name} is no bag; "
            "write the commands to columns, as qref_<joint>"
        )
    table = with_stated_names(form.open(path, source), path.name, source.names)
    if not form.topics:
        table = with_standard_names(table, path.name, f"{path.suffix} files", source)
    table = with_time(table, source.rate)
    for name in table.names:
        if len(name) > _LONGEST_NAME:
            raise DataError(
                f"{path.name}: a column has a name of {len(name)} characters, {name[:40]!r}..., "
                f"wanted at most {_LONGEST_NAME}; rename it"
            )
    return table


def _format_of(path: Path) -> Format:
    """Return the format of a log that exists."""
    if path.is_dir():
        return LEROBOT if (path / DATASET).is_file() else BAG
    suffix = path.suffix.lower()
    if path.exists() and suffix not in _READ:
        raise DataError(
            f"{path.name}: the suffix is {suffix!r}, wanted a log file of type "
            f"{_alternatives(list(_READ))}, or the folder of a ROS 2 bag or of a LeRobot dataset; "
            "convert it"
        )
    if not path.is_file():
        raise DataError(missing_file(path, "log file"))
    return _READ[suffix]


def write_columns(table: Mapping[str, Array], path: Path) -> None:
    """Write columns to a file; reading them returns exactly the same numbers.

    A temporary file in the same folder is written and then renamed, so the file is always complete.

    table (N,).
    """
    write = _WRITTEN[check_suffix(path)]
    with written_whole(path) as temporary:
        write(table, temporary)


def check_suffix(path: Path, what: str = "logs", *, also: Sequence[str] = ()) -> str:
    """Return the suffix of a file to write; used before its content is computed."""
    suffix = path.suffix.lower()
    if suffix not in _WRITTEN:
        raise DataError(
            f"{path.name}: {what} are written as {_alternatives([*_WRITTEN, *also])} files, not "
            f"{suffix!r}"
        )
    return suffix


def _alternatives(words: list[str]) -> str:
    """Return words with commas, and "or" before the last."""
    return f"{', '.join(words[:-1])} or {words[-1]}"
