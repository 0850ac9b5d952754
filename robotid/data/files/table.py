"""The common form of all file formats: named columns, read as a whole or row by row."""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from importlib import import_module
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, TypeGuard

import numpy as np

from robotid.base.exceptions import DataError, MissingDependencyError, RobotIdError
from robotid.base.findings import listed, suggestion
from robotid.base.typing import Array
from robotid.data.files.columns import is_clock, named_by_row, quantity_of
from robotid.data.signal_settings import LogSource

_CLOCK = "__time"  # PlotJuggler's
_SECONDS = re.compile(r"(.*)(?<![a-z])(secs?|n(?:ano)?secs?)")  # of a stamp in two columns
_NAMED = re.compile(r"(.*)/([^/]+)/(position|velocity|acceleration|effort)")  # topic, joint, kind


@dataclass(frozen=True)
class Place:
    """The start of a row in a file."""

    row: int = 0  # its number
    line: int = 0  # number of its line in a text file
    offset: int = 0  # bytes before it in a text file


class RowReader(ABC):
    """Reads rows of a file that need not fit into memory."""

    @abstractmethod
    def count(self) -> int:
        """Return the approximate number of rows, without reading them."""

    @abstractmethod
    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        """Yield one column, a block of rows at a time."""

    @abstractmethod
    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        """Return the columns of some rows by name, each (stop - first,); a missing value is NaN."""


@dataclass(frozen=True)
class Column:
    """A column that is computed from others, row by row."""

    sources: tuple[str, ...]
    values: Callable[..., Array] = lambda _, x: x  # of the first row's number and the sources


@dataclass(frozen=True)
class Table:
    """The columns of one file."""

    names: list[str]  # in the order of the file
    read: Callable[[Sequence[str]], dict[str, Array]]  # returns columns by name, (N,); NaN: missing
    notes: tuple[str, ...] = ()  # for the user
    rows: RowReader | None = None  # reads row by row; None if the format is read as a whole
    renamed: Mapping[str, str] = field(default_factory=dict)  # names above by name in the file
    angle_unit: str = ""  # why the unit of angles must be stated; "" if it is known
    sensors: Mapping[str, str] = field(default_factory=dict)  # sources of interpolated columns
    axes: Mapping[str, str] = field(default_factory=dict)  # of "twist" and "wrench", if known

    def reader(self, wanted: Sequence[str]) -> RowReader:
        """Return the reader of the rows; of a format that is read as a whole, of wanted columns."""
        return self.rows or _WholeTable(self, wanted)

    def with_columns(self, columns: Mapping[str, Column], names: Sequence[str]) -> "Table":
        """Return a table in which some columns are computed, and the names of all its columns."""
        rows = None if self.rows is None else _ComputedRows(self.rows, columns)
        read = partial(_computed, columns, first=0, read=self.read)
        return replace(self, names=list(names), read=read, rows=rows)

    def with_names(self, names: Mapping[str, str]) -> "Table":
        """Return a table with other names of columns, by their name in it."""
        if not names:
            return self
        columns = {name: Column((old,)) for old, name in names.items()}
        table = self.with_columns(columns, [names.get(name, name) for name in self.names])
        return replace(table, renamed={**self.renamed, **names})


@dataclass(frozen=True, eq=False)
class _WholeTable(RowReader):
    """Rows of a file of a format that cannot be read in parts."""

    table: Table
    wanted: Sequence[str]

    def count(self) -> int:
        return len(next(iter(self._columns.values())))

    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        yield self._columns[name], Place()

    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        return {name: self._columns[name][first:stop] for name in wanted}

    @cached_property
    def _columns(self) -> dict[str, Array]:
        return self.table.read(self.wanted)


@dataclass(frozen=True)
class _ComputedRows(RowReader):
    """Rows of a file with columns that are computed from others."""

    rows: RowReader
    columns: Mapping[str, Column]

    def count(self) -> int:
        return self.rows.count()

    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        column, row = self.columns.get(name, Column((name,))), 0
        for blocks in zip(*map(self.rows.scan, column.sources), strict=True):
            yield column.values(row, *(values for values, _ in blocks)), blocks[0][1]
            row += len(blocks[0][0])

    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        return _computed(
            self.columns, wanted, first, lambda names: self.rows.read(names, first, stop, near)
        )


def _computed(
    columns: Mapping[str, Column],
    wanted: Sequence[str],
    first: int,
    read: Callable[[Sequence[str]], dict[str, Array]],
) -> dict[str, Array]:
    """Return wanted columns from those that a reader returns."""
    used = {name: columns.get(name, Column((name,))) for name in wanted}
    values = read(list(dict.fromkeys(chain.from_iterable(x.sources for x in used.values()))))
    return {
        name: column.values(first, *(values[x] for x in column.sources))
        for name, column in used.items()
    }


@dataclass(frozen=True)
class Format:
    """One file format; to add one, write its module and enter it in ``formats``."""

    suffixes: tuple[str, ...]
    open: Callable[[Path, LogSource], Table]  # faults of a column are reported when it is read
    write: Callable[[Mapping[str, Array], Path], None] | None = None  # of columns (N,)
    written: tuple[str, ...] = ()  # suffixes with which it is written
    topics: str = ""  # what contains a log: "topic", "group"; "": there is one log per file


class Frame(Protocol):
    """A DataFrame, of pandas, polars or another library."""

    @property
    def columns(self) -> Any: ...  # noqa: ANN401

    def __getitem__(self, name: Any, /) -> Any: ...  # noqa: ANN401


def is_frame(thing: object) -> TypeGuard[Frame]:
    """Return whether an object has named columns, as a DataFrame."""
    return hasattr(thing, "columns") and hasattr(thing, "__getitem__")


def open_frame(frame: Frame) -> Table:
    """Return the table in a DataFrame; an index with a name becomes a column."""
    if getattr(getattr(frame, "index", None), "name", None) is not None:
        frame = frame.reset_index()  # type: ignore[attr-defined]
    keys = {str(key): key for key in frame.columns}
    named = named_by_row({x: next(iter(frame[key]), "") for x, key in keys.items()})

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        return {name: _numbers(frame[keys[name]], named.get(name, name)) for name in wanted}

    return Table(list(keys), read).with_names(named)


def _numbers(values: Any, name: str) -> Array:  # noqa: ANN401
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        kind = getattr(values, "dtype", type(values).__name__)
        raise DataError(
            f"log: column {name!r} contains {kind}, expected numbers ({error}); convert it"
        ) from error


def with_standard_names(table: Table, where: str, kind: str, source: LogSource) -> Table:
    """Return a table with PlotJuggler's ``/topic/elbow/position`` as ``position_elbow``."""
    topics: dict[str, dict[str, str]] = {}  # standard names by name in the file, by topic
    is_standard = any(name.startswith(("q_", "position_")) for name in table.names)
    for name in table.names if _CLOCK in table.names or not is_standard else ():
        if match := _NAMED.fullmatch(name):
            topic, joint, quantity = match.groups()
            topics.setdefault(topic, {})[name] = f"{quantity}_{joint}"
    if source.topic is not None and not topics:
        note = f"the topic {source.topic!r} is not used: {kind} have none"
        table = replace(table, notes=(*table.notes, note))
    names = {_CLOCK: "time"} if _CLOCK in table.names and "time" not in table.names else {}
    if topics and source.topic is None:  # the only one, with efforts if any topic has efforts
        moved = [x for x, own in topics.items() if any("effort_" in y for y in own.values())]
        words = "its columns have names as <topic>/<joint>/position"
        names |= topics[choose(where, moved or list(topics), "topics of joint states", words)]
    elif topics and source.topic not in topics:
        raise DataError(
            f"{where} has no topic {source.topic!r}; topics: {listed(topics)}"
            f"{suggestion(str(source.topic), topics)}"
        )
    elif topics:
        names |= topics[str(source.topic)]
    return table.with_names(names)


def with_stated_names(table: Table, where: str, names: Sequence[str]) -> Table:
    """Return a table with the names that a job states for all columns, in their order."""
    if names and len(names) != len(table.names):
        raise DataError(
            f"{where} has {len(table.names)} columns, but log.names has {len(names)}; name "
            "each column, in their order"
        )
    return table.with_names(dict(zip(table.names, names, strict=True))) if names else table


def with_time(table: Table, rate: float | None) -> Table:
    """Return a table with a column "time" from seconds and nanoseconds, or from a stated rate."""
    if any(is_clock(name) for name in table.names):
        note = "log.rate is not used: the log has time stamps"
        return table if rate is None else replace(table, notes=(*table.notes, note))
    if rate is not None:
        any_column = next((x for x in table.names if quantity_of(x)), table.names[0])
        time = Column((any_column,), lambda row, x: (row + np.arange(len(x))) / rate)
        return table.with_columns({"time": time}, ["time", *table.names])
    parts: dict[str, list[str]] = {}
    for name in table.names:
        if match := _SECONDS.fullmatch(name):
            parts.setdefault(match[1], []).append(name)
    pairs = [
        sorted(names, key=lambda x: x.endswith(("nsec", "nsecs", "nanosec", "nanosecs")))
        for names in parts.values()
        if len(names) == 2
    ]
    if len(pairs) != 1:
        return table
    time = Column(tuple(pairs[0]), lambda _, sec, nanosec: sec + 1e-9 * nanosec)
    others = [name for name in table.names if name not in pairs[0]]
    return table.with_columns({"time": time}, ["time", *others])


def with_even_stamps(table: Table, column: str, stamp: str = "even") -> Table:
    """Return a table whose rows have equal time steps: the straight line through its stamps."""
    if stamp != "even":
        return table

    @cache
    def line() -> Array:
        blocks = (values for values, _ in table.reader([column]).scan(column))
        t = np.concatenate([np.empty(0), *blocks])
        if len(t) < 2:
            return np.array([0.0, *t])
        slope, start = np.polyfit(np.arange(len(t)), t - t[0], 1)
        return np.array([slope, start + t[0]])

    def stamps(row: int, t: Array) -> Array:
        return np.polyval(line(), np.arange(row, row + len(t)))

    return table.with_columns({column: Column((column,), stamps)}, table.names)


def choose(where: str, candidates: Sequence[str], noun: str, listing: str) -> str:
    """Return the only one of the possible places of a log in a file."""
    if len(candidates) == 1:
        return candidates[0]
    names = sorted(candidates)
    raise DataError(
        f"{where} has {len(names)} {noun}: {listed(names)}; {listing}. Set one: topic = "
        f'"{names[0]}" (job file table [log], CLI --topic)'
    )


def load_package(purpose: str, extra: str, *modules: str) -> list[ModuleType]:
    """Return modules of a package that an extra of robotid installs."""
    try:
        return [import_module(name) for name in modules]
    except ImportError as error:
        raise MissingDependencyError(purpose, modules[0].partition(".")[0], extra) from error


@contextmanager
def parsing(path: Path, kind: str) -> Iterator[None]:
    """Convert the exceptions of a parser to a DataError."""
    try:
        yield
    except RobotIdError:
        raise
    except Exception as error:  # a parser of foreign bytes fails in many ways
        reason = f"{type(error).__name__}: {error}"[:200]
        raise DataError(f"{path.name}: broken {kind} file ({reason}); export it again") from error
