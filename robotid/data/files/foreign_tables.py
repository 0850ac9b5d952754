"""Tables with column names of other programs: PlotJuggler's, and DataFrames."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeGuard

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.files.column_names import is_clock, named_by_row, quantity_of
from robotid.data.files.table import Place, RowReader, Table, choose
from robotid.data.log import suggestion
from robotid.data.signal_settings import LogSource

_CLOCK = "__time"  # PlotJuggler's
_COLUMNS = "its columns have names as <topic>/<joint>/position"
_SECONDS = re.compile(r"(.*)(?<![a-z])(secs?|n(?:ano)?secs?)")  # of a stamp in two columns
_NAMED = re.compile(r"(.*)/([^/]+)/(position|velocity|acceleration|effort)")  # topic, joint, kind


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
    keys = {named.get(x, x): key for x, key in keys.items()}

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        return {name: _numbers(frame[keys[name]], name) for name in wanted}

    return Table(list(keys), read, renamed=named)


def _numbers(values: Any, name: str) -> Array:  # noqa: ANN401
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        kind = getattr(values, "dtype", type(values).__name__)
        raise DataError(
            f"log: column {name!r} contains {kind}, wanted numbers ({error}); convert it"
        ) from error


def with_own_names(table: Table, where: str, kind: str, source: LogSource) -> Table:
    """Return a table with the columns of PlotJuggler renamed to standard names.

    ``/joint_states/elbow/position`` becomes ``position_elbow``, likewise velocity, acceleration and
    effort, and ``__time`` becomes ``time``. A table with standard columns is not changed.
    """
    topics: dict[str, dict[str, str]] = {}  # names in the file, by topic and own name
    standard = [name for name in table.names if name.startswith(("q_", "position_"))]
    for name in table.names if _CLOCK in table.names or not standard else ():
        if found := _NAMED.fullmatch(name):
            topic, joint, quantity = found.groups()
            topics.setdefault(topic, {})[f"{quantity}_{joint}"] = name
    if source.topic is not None and not topics:
        note = f"the topic {source.topic!r} is not used: {kind} have none"
        table = replace(table, notes=(*table.notes, note))
    own = {"time": _CLOCK} if _CLOCK in table.names and "time" not in table.names else {}
    if topics:
        own |= topics[_topic(topics, where, source)]
    return renamed(table, {name: mine for mine, name in own.items()})


def with_stated_names(table: Table, where: str, names: Sequence[str]) -> Table:
    """Return a table with the names that a job states for all columns, in their order."""
    if not names:
        return table
    if len(names) != len(table.names):
        raise DataError(
            f"{where} has {len(table.names)} columns, but log.names states {len(names)}; name "
            "each column, in their order"
        )
    return renamed(table, dict(zip(table.names, names, strict=True)))


def with_time(table: Table, rate: float | None) -> Table:
    """Return a table with a column "time" from seconds and nanoseconds, or from a stated rate."""
    if any(is_clock(name) for name in table.names):
        note = "log.rate is not used: the log has time stamps"
        return table if rate is None else replace(table, notes=(*table.notes, note))
    if rate is not None:
        first = next((x for x in table.names if quantity_of(x)), table.names[0])
        return _timed(table, (first,), lambda row, x: (row + np.arange(len(x))) / rate)
    parts: dict[str, list[str]] = {}
    for name in table.names:
        if found := _SECONDS.fullmatch(name):
            parts.setdefault(found[1], []).append(name)
    pairs = [sorted(own, key=lambda x: x.endswith(("nsec", "nsecs", "nanosec", "nanosecs")))
             for own in parts.values() if len(own) == 2]  # fmt: skip
    if len(pairs) != 1:
        return table
    return _timed(table, tuple(pairs[0]), lambda _, sec, nanosec: sec + 1e-9 * nanosec)


def _timed(table: Table, sources: tuple[str, ...], stamps: Callable[..., Array]) -> Table:
    """Return a table with a column "time" from others and the number of the first row."""

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        columns = table.read(list(dict.fromkeys([*(x for x in wanted if x != "time"), *sources])))
        return columns | {"time": stamps(0, *(columns[x] for x in sources))}

    rows = None if table.rows is None else _Timed(table.rows, sources, stamps)
    names = ["time", *(x for x in table.names if x not in sources or len(sources) == 1)]
    return replace(table, names=names, read=read, rows=rows)


def renamed(table: Table, theirs: Mapping[str, str]) -> Table:
    """Return a table with other names of columns."""
    own = {name: old for old, name in theirs.items()}
    if not own:
        return table

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        columns = table.read([own.get(name, name) for name in wanted])
        return {name: columns[own.get(name, name)] for name in wanted}

    rows = None if table.rows is None else _Renamed(table.rows, own)
    names = [theirs.get(name, name) for name in table.names]
    return replace(table, names=names, read=read, rows=rows, renamed={**table.renamed, **theirs})


def _topic(topics: Mapping[str, Mapping[str, str]], where: str, source: LogSource) -> str:
    """Return the stated topic, or the only one (with efforts, if any topic has efforts)."""
    if source.topic is not None:
        if source.topic not in topics:
            raise DataError(
                f"{where} has no topic {source.topic!r}; topics: {listed(topics)}"
                f"{suggestion(source.topic, topics)}"
            )
        return source.topic
    moved = [topic for topic, names in topics.items() if any("effort_" in x for x in names)]
    return choose(where, moved or list(topics), "topics of joint states", _COLUMNS)


@dataclass(frozen=True)
class _Timed(RowReader):
    rows: RowReader
    sources: tuple[str, ...]
    stamps: Callable[..., Array]

    def count(self) -> int:
        return self.rows.count()

    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        if name != "time":
            yield from self.rows.scan(name)
            return
        for blocks in zip(*map(self.rows.scan, self.sources), strict=True):
            place = blocks[0][1]
            yield self.stamps(place.row, *(values for values, _ in blocks)), place

    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        names = list(dict.fromkeys([*(x for x in wanted if x != "time"), *self.sources]))
        columns = self.rows.read(names, first, stop, near)
        return columns | {"time": self.stamps(first, *(columns[x] for x in self.sources))}


@dataclass(frozen=True)
class _Renamed(RowReader):
    rows: RowReader
    own: Mapping[str, str]  # names in the file, by own name

    def count(self) -> int:
        return self.rows.count()

    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        return self.rows.scan(self.own.get(name, name))

    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        columns = self.rows.read([self.own.get(x, x) for x in wanted], first, stop, near)
        return {name: columns[self.own.get(name, name)] for name in wanted}
