"""Tables with column names of other programs: PlotJuggler's, and DataFrames."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeGuard

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.findings import listed
from robotid.log_files.table import Place, RowReader, Table, choose, prefixes
from robotid.logs.data import suggestion
from robotid.logs.settings import LogSource

__all__ = ["Frame", "is_frame", "open_frame", "with_own_names"]

_CLOCK = "__time"  # PlotJuggler's
_COLUMNS = "its columns have names as <topic>/<joint>/position"
_NAMED = re.compile(r"(.*)/([^/]+)/(position|velocity|acceleration|effort)")  # topic, joint, kind


class Frame(Protocol):
    """A DataFrame, of pandas, polars or another library."""

    @property
    def columns(self) -> Any: ...  # noqa: ANN401

    def __getitem__(self, name: Any, /) -> Any: ...  # noqa: ANN401


def is_frame(thing: object) -> TypeGuard[Frame]:
    """Return whether an object has named columns, as a DataFrame.

    Args:
        thing: Any object.
    """
    return hasattr(thing, "columns") and hasattr(thing, "__getitem__")


def open_frame(frame: Frame) -> Table:
    """Return the table in a DataFrame; an index with a name becomes a column.

    Args:
        frame: The DataFrame.
    """
    if getattr(getattr(frame, "index", None), "name", None) is not None:
        frame = frame.reset_index()  # type: ignore[attr-defined]
    keys = {str(key): key for key in frame.columns}

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        return {name: _numbers(frame[keys[name]], name) for name in wanted}

    return Table([str(key) for key in frame.columns], read)


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

    Args:
        table: The table.
        where: Name of its file, for errors.
        kind: Noun for its format, as ".csv files".
        source: Its topic, if it has joint states of several topics.

    Raises:
        DataError: If it has joint states of several topics and no topic, or another one, is stated.
    """
    topics: dict[str, dict[str, str]] = {}  # names in the file, by topic and own name
    standard = [name for name in table.names if name.startswith(prefixes()["q"])]
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
    if not own:
        return table
    theirs = {name: mine for mine, name in own.items()}

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        columns = table.read([own.get(name, name) for name in wanted])
        return {name: columns[own.get(name, name)] for name in wanted}

    rows = None if table.rows is None else _Renamed(table.rows, own)
    names = [theirs.get(name, name) for name in table.names]
    return replace(table, names=names, read=read, rows=rows, renamed=theirs)


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
