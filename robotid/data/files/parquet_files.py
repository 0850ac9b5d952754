"""Parquet files, tables that are no logs, and episodes of LeRobot datasets of version 2 or 3."""

import csv
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.files import DATASET, missing_file, read_json
from robotid.base.findings import listed, suggestion
from robotid.base.typing import Array
from robotid.data.files.columns import named_by_row
from robotid.data.files.table import Format, Place, RowReader, Table, choose, load_package, parsing
from robotid.data.log import repeated
from robotid.data.signal_settings import LogSource

_TEXTS = ("string", "large_string")  # types of columns
_BATCH = 16384  # rows decoded together, if not all are required
_BUFFER = 2**16  # bytes of each column read together in this case, not whole row groups
_GROUP = 10_000  # rows of a row group, which are in memory before it is written


def _open(path: Path, source: LogSource) -> Table:
    with _opened(path) as file:
        names = list(file.schema_arrow.names)
        texts = [x for x in names if str(file.schema_arrow.field(x).type) in _TEXTS]
        rows = next(file.iter_batches(1, columns=texts), None) if texts else None
    first = rows.to_pylist()[0] if rows is not None and len(rows) else {}
    table = Table(names, partial(_read, path), (), _ParquetRows(path))
    return table.with_names(named_by_row(dict.fromkeys(names, "") | first))


def _write(table: Mapping[str, Array], path: Path) -> None:
    pa = load_pyarrow("writing Parquet")
    pa.parquet.write_table(pa.table(dict(table)), path)


#: Parquet files; null becomes NaN.
PARQUET = Format((".parquet",), _open, _write, written=(".parquet",))


def load_pyarrow(purpose: str) -> ModuleType:
    """Return pyarrow, with pyarrow.parquet imported."""
    return load_package(purpose, "parquet", "pyarrow", "pyarrow.parquet")[0]


@dataclass(frozen=True)
class _ParquetRows(RowReader):
    path: Path

    def count(self) -> int:
        with _opened(self.path) as file:
            return int(file.metadata.num_rows)

    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        row = 0
        with _opened(self.path, [name], _BUFFER) as file:
            for group in range(file.num_row_groups):  # one by one: groups stay in memory
                for batch in _batches(file, name, [group]):
                    yield _to_numpy(batch.column(0)), Place(row)
                    row += batch.num_rows

    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        values = {name: np.empty(stop - first) for name in wanted}
        with _opened(self.path, wanted, _BUFFER) as file:
            sizes = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
            edges = np.cumsum([0, *sizes])
            groups = np.flatnonzero((edges[:-1] < stop) & (edges[1:] > first)).tolist()
            for name in wanted:  # one by one: each column needs memory for some pages
                row = int(edges[groups[0]])
                for batch in _batches(file, name, groups):
                    start, end = max(first - row, 0), min(stop - row, batch.num_rows)
                    if start < end:
                        part = slice(row + start - first, row + end - first)
                        values[name][part] = _to_numpy(batch.column(0).slice(start, end - start))
                    row += batch.num_rows
                    if row >= stop:
                        break
        return values


def _batches(file: Any, name: str, groups: Sequence[int]) -> Iterator[Any]:  # noqa: ANN401
    """Yield batches of rows of one column."""
    how = {"columns": [name], "row_groups": groups, "use_threads": False}
    batches: Iterator[Any] = file.iter_batches(_BATCH, **how)
    return batches


@contextmanager
def _opened(path: Path, wanted: Sequence[str] = (), buffer: int = 0) -> Iterator[Any]:
    """Open a Parquet file; the wanted columns must contain numbers."""
    pa = load_pyarrow("reading Parquet")
    with parsing(path, "Parquet"), pa.parquet.ParquetFile(path, buffer_size=buffer) as file:
        for name in wanted:
            kind = file.schema_arrow.field(name).type
            if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
                is_nested = pa.types.is_nested(kind)
                remedy = "write one column per value, or their sum" if is_nested else "convert it"
                raise DataError(f"{path.name}: {name} contains {kind}, expected numbers; {remedy}")
        yield file


def _read(path: Path, wanted: Sequence[str]) -> dict[str, Array]:
    with _opened(path, wanted) as file:
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


def read_text_table(path: str | Path) -> tuple[list[str], list[dict[str, str]]]:
    """Return the names of the columns and the rows of a CSV or Parquet table; missing: ""."""
    source = Path(path)
    if not source.is_file():
        raise DataError(missing_file(source, "table"))
    match source.suffix.lower():
        case ".csv":
            names, rows = _csv_texts(source)
        case ".parquet":
            with _opened(source) as file:
                table = file.read()
            columns = [column.to_pylist() for column in table.columns]
            cells = [["" if x is None else str(x).strip() for x in column] for column in columns]
            names, rows = list(table.column_names), list(map(list, zip(*cells, strict=True)))
        case suffix:
            raise DataError(
                f"{source.name}: the suffix is {suffix!r}, expected a table of type .csv or "
                ".parquet; convert it"
            )
    if twice := repeated(names):
        raise DataError(f"{source.name} has several columns {twice[0]!r}; rename all but one")
    return names, [dict(zip(names, row, strict=True)) for row in rows]


def _csv_texts(path: Path) -> tuple[list[str], list[list[str]]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = [line for line in csv.reader(file, strict=True) if line]
    except (csv.Error, UnicodeDecodeError) as error:
        raise DataError(f"{path.name} is not a CSV table: {error}; expected UTF-8 text") from error
    if not lines:
        raise DataError(f"{path.name} is empty, expected a row of names and rows of values")
    names, *rows = [[cell.strip() for cell in line] for line in lines]
    for number, row in enumerate(rows, start=1):
        if len(row) != len(names):
            raise DataError(
                f"{path.name} row {number} has {len(row)} values, expected {len(names)}, as many "
                "as columns; put values that contain a comma in double quotes"
            )
    return names, rows


def write_rows(
    path: Path, rows: Iterable[Mapping[str, str | float | None]], columns: Mapping[str, type]
) -> None:
    """Write rows to a Parquet file, one row group after the other; equal rows make equal files."""
    pa = load_pyarrow("writing Parquet")
    kinds, left = {str: pa.string(), float: pa.float64()}, iter(rows)
    schema = pa.schema([(name, kinds[kind]) for name, kind in columns.items()])
    with pa.parquet.ParquetWriter(path, schema) as writer:
        while group := list(islice(left, _GROUP)):
            writer.write_table(pa.Table.from_pylist(group, schema=schema))


#: Prefixes of the columns of each feature, by the endings of the names in it.
_FEATURES: Mapping[str, Mapping[str, str]] = {
    "observation.state": {"": "q", "pos": "q", "q": "q", "vel": "dq", "dq": "dq",
                          "torque": "tau", "tau": "tau", "effort": "tau"},
    "observation.velocity": {"": "dq"},
    "observation.effort": {"": "tau"},
    "action": {"": "qref", "pos": "qref", "q": "qref", "vel": "dqref", "dq": "dqref",
               "torque": "tauref", "tau": "tauref", "effort": "tauref"},
}  # fmt: skip
_NORMALISED = (
    "LeRobot's files lack the unit of positions: degrees, or normalised positions, -100 to 100 "
    "over the calibrated range (a gripper: 0 to 100). Record normalised positions again with "
    'use_degrees = true. For angles, set angle = "deg" or "rad" in [units] (CLI --angle-unit deg)'
)
_Place = tuple[str, int]  # a feature, and the number of a value in its vectors


def _open_episode(path: Path, source: LogSource) -> Table:
    """Return the table of an episode: that of the topic, as ``episode_3``, or the only one."""
    pa = load_pyarrow("reading LeRobot datasets")
    columns = _motor_columns(path, _features(path))
    parts: dict[int, list[Path]] = {}  # files with rows of an episode, by its number
    with parsing(path, "LeRobot"):
        for file in sorted(path.glob("data/**/*.parquet")):
            numbers = pa.parquet.read_table(file, columns=["episode_index"])
            for number in np.unique(numbers.column(0).to_numpy()):
                parts.setdefault(int(number), []).append(file)
    number = _episode(path, sorted(parts), source.topic)
    note = (
        f"episode {number}: its time stamps are frame numbers over the frame rate, so the "
        "delay between commands and positions has an error of up to one frame"
    )
    read = partial(_read_episode, path, parts[number], number, columns)
    return Table(["time", *columns], read, notes=(note,), angle_unit=_NORMALISED)


LEROBOT = Format((), _open_episode, topics="episode")


def _features(path: Path) -> dict[str, Any]:
    """Return the description of the columns of the dataset."""
    info = read_json(path / DATASET, "description of a LeRobot dataset")
    features = info.get("features") if isinstance(info, dict) else None
    if not isinstance(features, dict) or not all(isinstance(x, dict) for x in features.values()):
        raise DataError(
            f"{path.name}: meta/info.json does not describe a LeRobot dataset of version 2 or "
            f"3: features is {str(features)[:80]}, expected a table of tables"
        )
    return features


def _motor_columns(path: Path, features: Mapping[str, Any]) -> dict[str, _Place]:
    """Return the columns of the motors of the dataset, by standard name."""
    columns: dict[str, _Place] = {}
    for feature in filter(features.__contains__, _FEATURES):
        names = _motor_names(features[feature].get("names"))
        if not names:
            raise DataError(
                f"{path.name}: meta/info.json has no names of the motors in {feature}; add "
                f"their names, in the order of its {features[feature].get('shape')} values"
            )
        for place, name in enumerate(names):
            joint, dot, end = name.rpartition(".")
            if not dot or end not in _FEATURES[feature]:
                joint, end = name, ""
            column = f"{_FEATURES[feature][end]}_{joint}"
            if column in columns:
                other, number = columns[column]
                raise DataError(
                    f"{path.name}: meta/info.json has the same name for {name!r} of {feature}, "
                    f"number {place}, and number {number} of {other}; give each motor another name"
                )
            columns[column] = feature, place
    if not columns:
        raise DataError(
            f"{path.name} has neither observation.state nor action, expected one of them; "
            f"features: {listed(features)}"
        )
    return columns


def _motor_names(stated: object) -> list[str]:
    """Return the names of a feature's values; none if their form is unknown."""
    groups: list[Any] = list(stated.values()) if isinstance(stated, dict) else [stated]
    if not all(isinstance(group, list) for group in groups):  # neither {"motors": [...]} nor a list
        return []
    names = [name for group in groups for name in group]
    return names if all(isinstance(name, str) for name in names) else []


def _episode(path: Path, numbers: Sequence[int], wanted: str | None) -> int:
    """Return the number of the stated episode, or of the only one."""
    names = [f"episode_{number}" for number in numbers]
    if not names:
        raise DataError(f"{path.name} has no episode: its files data/**/*.parquet have no rows")
    if wanted is None:
        wanted = choose(path.name, names, "episodes", "each episode is a separate log")
    digits = re.fullmatch(r"(?:episode_)?0*([0-9]+)", wanted)
    chosen = f"episode_{digits[1]}" if digits else wanted
    if chosen not in names:
        shown = wanted if len(wanted) <= 40 else f"{wanted[:40]}..."
        raise DataError(
            f"{path.name} has no episode {shown!r}; episodes: {listed(names)}"
            f"{suggestion(shown, names)}"
        )
    return numbers[names.index(chosen)]


def _read_episode(
    path: Path,
    files: Sequence[Path],
    number: int,
    columns: Mapping[str, _Place],
    wanted: Sequence[str],
) -> dict[str, Array]:
    """Return columns of an episode, in the order of its frames."""
    pa = load_pyarrow("reading LeRobot datasets")
    places = {name: columns[name] for name in wanted if name != "time"}
    features = sorted({feature for feature, _ in places.values()})
    names = ["timestamp", "episode_index", "frame_index", *features]
    with parsing(path, "LeRobot"):
        table = pa.concat_tables([pa.parquet.read_table(file, columns=names) for file in files])
        rows = np.flatnonzero(table.column("episode_index").to_numpy() == number)
        rows = rows[np.argsort(table.column("frame_index").to_numpy()[rows], kind="stable")]
        vectors = {
            feature: np.array(table.column(feature).take(rows).to_pylist(), dtype=np.float64)
            for feature in features
        }
        t = table.column("timestamp").to_numpy()[rows].astype(np.float64).ravel()
    values: dict[str, Array] = {"time": t}
    for name, (feature, place) in places.items():
        vector = vectors[feature]
        if vector.ndim != 2 or place >= vector.shape[1]:
            raise DataError(
                f"{path.name}: {feature} has vectors of shape {vector.shape[1:]}, but "
                f"meta/info.json has at least {place + 1} names of motors for it"
            )
        values[name] = vector[:, place]
    return {name: values[name] for name in wanted}
