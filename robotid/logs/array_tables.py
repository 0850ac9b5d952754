"""Arrays under paths, as NPZ, HDF5 and MAT files hold them, as a table of named columns."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.findings import listed
from robotid.logs.data import suggestion
from robotid.logs.settings import LogSource
from robotid.logs.table import Table, choose, prefixes

__all__ = ["Entry", "table_of_arrays"]

_CLOCKS = ("time", "t")
_LISTS = ("joints", "joint_names")  # entries that name the columns of wide arrays
_WIDE = {prefix[:-1] for kinds in prefixes().values() for prefix in kinds}  # q, position, ...


@dataclass(frozen=True)
class Entry:
    """One array of a file.

    Attributes:
        shape: Its shape.
        is_number: Whether it holds real numbers.
        load: Returns the array.
    """

    shape: tuple[int, ...]
    is_number: bool
    load: Callable[[], Any]


@dataclass(frozen=True)
class _Column:
    """One column of an array; ``index`` None if the array is one."""

    path: str
    index: int | None = None


def table_of_arrays(where: str, entries: Mapping[str, Entry], source: LogSource) -> Table:
    """Return the table in a file of arrays.

    A vector is a column of its own name. A matrix of N samples, along its longer side, is n
    columns ``q_<joint>`` in the order of an entry ``joints``, else ``q_0``, ``q_1``, ...

    Args:
        where: Name of the file, for errors.
        entries: The arrays by path, as "arm/q_elbow".
        source: Which group of them.

    Returns:
        The table.

    Raises:
        DataError: If the group is not in the file, or could be one of several.
    """
    group = _group(where, list(entries), source.topic)
    inside = {path[len(group) :]: path for path in entries if path.startswith(group)}
    lists = [entries[inside[name]] for name in _LISTS if name in inside]
    joints = next((_joint_names(entry) for entry in lists if not entry.is_number), [])
    columns: dict[str, _Column] = {}
    for name, path in inside.items():
        if entries[path].is_number:
            columns |= _columns_of(where, name, path, entries[path].shape, joints)

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        return _read(where, entries, {name: columns[name] for name in wanted})

    return Table(list(columns), read)


def _group(where: str, paths: Sequence[str], topic: str | None) -> str:
    """Return what the paths of the group start with: "" or a name with a slash behind it."""
    parents = {path: path.rpartition("/") for path in paths}
    groups = sorted({head + slash for head, slash, _ in parents.values()})
    if topic is not None:
        group = topic.strip("/") + "/" if topic.strip("/") else ""
        if not any(path.startswith(group) for path in paths):
            known = [name.rstrip("/") or "/" for name in groups]
            raise DataError(
                f"{where} has no group {topic!r}; groups found: "
                f"{listed(known)}{suggestion(topic, known)}"
            )
        return group
    timed = {head + slash for head, slash, tail in parents.values() if tail in _CLOCKS}
    if not timed:
        return ""
    names = sorted(name.rstrip("/") or "/" for name in timed)
    chosen = choose(where, names, "groups with a time", f"entries found: {listed(paths)}")
    return "" if chosen == "/" else chosen + "/"


def _joint_names(entry: Entry) -> list[str]:
    """Return the names in an array of text."""
    return [
        (name.decode() if isinstance(name, bytes) else str(name)).strip()
        for name in np.ravel(entry.load()).tolist()
    ]


def _columns_of(
    where: str, name: str, path: str, shape: tuple[int, ...], joints: Sequence[str]
) -> dict[str, _Column]:
    """Return the columns that one array holds, by name."""
    slim = len(shape) == 1 or (len(shape) == 2 and 1 in shape)
    is_wide = name.rpartition("/")[2] in _WIDE and name not in _CLOCKS
    if len(shape) not in (1, 2) or (len(shape) == 2 and 0 in shape):
        return {}
    if slim and not is_wide:
        return {name: _Column(path)}
    count = 1 if slim else min(shape)
    if joints and is_wide and len(joints) != count:
        raise DataError(
            f"{where}: {name} has shape {shape}, but the file names {len(joints)} joints: "
            f"{listed(joints)}; give each joint one column"
        )
    names = joints if joints and len(joints) == count else [str(j) for j in range(count)]
    return {f"{name}_{names[j]}": _Column(path, j) for j in range(count)}


def _read(
    where: str, entries: Mapping[str, Entry], columns: Mapping[str, _Column]
) -> dict[str, Array]:
    """Return columns; each array is loaded once, and all must be of one length."""
    loaded = {path: np.asarray(entries[path].load()) for path in _paths(columns)}
    table: dict[str, Array] = {}
    for name, column in columns.items():
        values = loaded[column.path]
        if column.index is None or values.size == max(values.shape):
            values = values.ravel()
        else:
            rows = values if values.shape[0] >= values.shape[1] else values.T
            values = rows[:, column.index]
        table[name] = values.astype(np.float64)
    first = next(iter(table))
    for name, values in table.items():
        if len(values) != len(table[first]):
            raise DataError(
                f"{where}: {name} has {len(values)} samples, {first} has {len(table[first])}; "
                "a row needs both"
            )
    if not len(table[first]):
        raise DataError(f"{where} has columns but no rows; record at least 2")
    return table


def _paths(columns: Mapping[str, _Column]) -> list[str]:
    """Return the paths of the arrays that columns are in, each once."""
    return list(dict.fromkeys(column.path for column in columns.values()))
