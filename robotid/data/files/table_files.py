"""Tables in files: named columns of numbers in any format that is known by its suffix."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import DATASET, dataset_of, missing_file, written_whole
from robotid.base.typing import Array
from robotid.data.files.arrays import Hdf5Format, MatFormat, NpzFormat
from robotid.data.files.bags import BagFormat
from robotid.data.files.csv_files import CsvFormat
from robotid.data.files.foreign_tables import with_own_names, with_stated_names, with_time
from robotid.data.files.lerobot import LeRobotFormat
from robotid.data.files.parquet_files import ParquetFormat
from robotid.data.files.table import Format, Table, WritableFormat
from robotid.data.signal_settings import LogSource

_FORMATS: dict[str, Format] = {
    ".csv": CsvFormat(),
    ".dat": CsvFormat(),
    ".txt": CsvFormat(),
    ".parquet": ParquetFormat(),
    ".npz": NpzFormat(),
    ".h5": Hdf5Format(),
    ".hdf5": Hdf5Format(),
    ".mat": MatFormat(),
    ".mcap": BagFormat(),
    ".db3": BagFormat(),
    ".bag": BagFormat(),
}
_READ_ONLY = (".dat", ".txt")
_WRITTEN = {
    suffix: f
    for suffix, f in _FORMATS.items()
    if isinstance(f, WritableFormat) and suffix not in _READ_ONLY
}
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
    if source.command is not None and not isinstance(form, BagFormat):
        raise SettingsError(
            f"log.command is {source.command!r}, the topic of a bag, but {path.name} is no bag; "
            "write the commands to columns, as qref_<joint>"
        )
    table = with_stated_names(form.open(path, source), path.name, source.names)
    if isinstance(form, CsvFormat | ParquetFormat):  # with one table per file
        table = with_own_names(table, path.name, f"{path.suffix} files", source)
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
        is_dataset = (path / DATASET).is_file()
        return LeRobotFormat() if is_dataset else BagFormat()
    suffix = path.suffix.lower()
    if not path.exists():
        raise DataError(missing_file(path, "log file"))
    if suffix not in _FORMATS:
        raise DataError(
            f"{path.name}: the suffix is {suffix!r}, wanted a log file of type "
            f"{_listed(list(_FORMATS))}, or the folder of a ROS 2 bag or of a LeRobot dataset; "
            "convert it"
        )
    if not path.is_file():
        raise DataError(missing_file(path, "log file"))
    return _FORMATS[suffix]


def write_columns(table: Mapping[str, Array], path: Path) -> None:
    """Write columns to a file; reading them returns exactly the same numbers.

    A temporary file in the same folder is written and then renamed, so the file is always complete.

    table (N,).
    """
    form = _WRITTEN[check_suffix(path)]
    with written_whole(path) as temporary:
        form.write(table, temporary)


def check_suffix(path: Path, what: str = "logs", *, also: Sequence[str] = ()) -> str:
    """Return the suffix of a file to write; used before its content is computed."""
    suffix = path.suffix.lower()
    if suffix not in _WRITTEN:
        raise DataError(
            f"{path.name}: {what} are written as {_listed([*_WRITTEN, *also])} files, not "
            f"{suffix!r}"
        )
    return suffix


def _listed(words: list[str]) -> str:
    """Return words with commas, and "or" before the last."""
    return f"{', '.join(words[:-1])} or {words[-1]}"
