"""Bags of ROS 1 and ROS 2, MCAP among them: joint states as a table of named columns.

The library rosbags reads all of them, without an installation of ROS.
"""

from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError, MissingDependencyError
from robotid.findings import listed
from robotid.logs.data import repeated, suggestion
from robotid.logs.settings import LogSource
from robotid.logs.table import Table, choose

__all__ = ["open_bag"]

_TYPE = "sensor_msgs/msg/JointState"
_FIELDS = ("position", "velocity", "effort")

Layout = tuple[tuple[str, ...], tuple[str, ...]]  # names of joints, and the fields that are filled


@dataclass
class _Block:
    """The messages that name the same joints in the same order and fill the same fields."""

    number: "array[int]" = field(default_factory=lambda: array("q"))  # place in the bag
    stamp: "array[int]" = field(default_factory=lambda: array("q"))  # [ns]
    values: "array[float]" = field(default_factory=lambda: array("d"))  # field by field


def open_bag(path: Path, source: LogSource) -> Table:
    """Return the joint states of one topic of a bag; a row is a message.

    The columns are ``time`` [s] since the epoch, ``position_<joint>``, ``velocity_<joint>`` and
    ``effort_<joint>``. Each message may name its joints in another order. Messages that hold none
    of the columns that are read, as those of another publisher, are passed over.

    Args:
        path: A .mcap, .db3 or .bag file, or the folder of a ROS 2 bag.
        source: Which topic, and which clock.

    Returns:
        The table.

    Raises:
        DataError: If the bag is broken, the topic is missing, of another type, or one of several,
            a message does not fit together, or only some of the messages hold what is read.
        MissingDependencyError: If rosbags is not installed.
    """
    blocks: dict[Layout, _Block] = {}
    count = 0
    with _open(path) as (reader, decode):
        topic = _choose_topic(path.name, reader, source.topic)
        chosen = [c for c in reader.connections if c.topic == topic]
        for count, (_, logged, raw) in enumerate(_told(path, reader.messages(chosen)), start=1):
            message = _decoded(path, decode, raw)
            layout, values = _content(path.name, topic, count - 1, message)
            block = blocks.setdefault(layout, _Block())
            block.number.append(count - 1)
            clock = message.header.stamp
            by_header = source.stamp == "header"
            block.stamp.append(clock.sec * 10**9 + clock.nanosec if by_header else logged)
            for part in values:
                block.values.frombytes(part.tobytes())
    where = f"{path.name}, topic {topic!r}"
    if source.stamp == "header" and not any(any(block.stamp) for block in blocks.values()):
        raise DataError(
            f"{where}: the stamps in the headers of all {count} messages are 0. To use the time "
            'of recording, state stamp = "log" (job file table [log], CLI --stamp log, Python '
            'source=LogSource(stamp="log"))'
        )
    names = list(dict.fromkeys(n for layout in blocks for n in _columns(layout)))
    names.sort(key=lambda name: _FIELDS.index(name.partition("_")[0]))
    return Table(["time", *names], partial(_read, where, blocks))


@contextmanager
def _open(path: Path) -> Iterator[tuple[Any, Callable[[bytes], Any]]]:
    """Open a bag: its reader, and what decodes a message; ROS need not be installed."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        purpose = "reading ROS bags and MCAP files"
        raise MissingDependencyError(purpose, "rosbags", "bag") from error
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise DataError(
            f"{path.name} is a folder without metadata.yaml, so not a ROS 2 bag; name the .mcap or "
            ".db3 file in it, or restore it with 'ros2 bag reindex'"
        )
    is_ros1 = path.suffix.lower() == ".bag" and not path.is_dir()
    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    deserialize = types.deserialize_ros1 if is_ros1 else types.deserialize_cdr
    try:
        reader: Any = Reader1(path) if is_ros1 else Reader2(path)
        reader.open()
    except Exception as error:  # a parser of foreign bytes fails in many ways
        raise _broken(path, error) from error
    try:
        yield reader, lambda raw: deserialize(raw, _TYPE)
    finally:
        reader.close()


def _broken(path: Path, error: Exception) -> DataError:
    """Return the error that tells what the library says of a file."""
    reason = str(error) or type(error).__name__
    return DataError(
        f"{path.name}: broken, unfinished or foreign bag ({reason}); record it again, or "
        "restore it with 'mcap recover', 'ros2 bag reindex' or 'rosbag reindex'"
    )


def _told(path: Path, messages: Iterator[Any]) -> Iterator[Any]:
    """Yield messages, and tell in our words where a bag breaks off."""
    while True:
        try:
            message = next(messages)
        except StopIteration:
            return
        except Exception as error:  # a parser of foreign bytes fails in many ways
            raise _broken(path, error) from error
        yield message


def _decoded(path: Path, decode: Callable[[bytes], Any], raw: bytes) -> Any:  # noqa: ANN401
    try:
        return decode(raw)
    except Exception as error:  # a parser of foreign bytes fails in many ways
        raise _broken(path, error) from error


def _choose_topic(where: str, reader: Any, wanted: str | None) -> str:  # noqa: ANN401
    """Return the topic to read: the one wanted, or the only one of joint states."""
    types = {c.topic: _full_name(c.msgtype) for c in reader.connections}
    filled = {c.topic for c in reader.connections if c.msgcount}
    listing = f"topics: {dict(sorted(types.items()))}"
    if wanted is not None:
        if wanted not in types:
            raise DataError(
                f"{where} has no topic {wanted!r}; {listing}{suggestion(wanted, types)}"
            )
        if types[wanted] != _TYPE:
            raise DataError(
                f"{where}: topic {wanted!r} holds {types[wanted]}, wanted {_TYPE}; {listing}"
            )
        if wanted not in filled:
            raise DataError(f"{where}: topic {wanted!r} holds no message; {listing}")
        return wanted
    found = sorted(topic for topic in filled if types[topic] == _TYPE)
    if not found:
        raise DataError(f"{where} holds no message of {_TYPE}; {listing}")
    return choose(where, found, f"topics of {_TYPE}", listing)


def _full_name(msgtype: str) -> str:
    """Return a type as ROS 2 writes it: with "msg" in the middle."""
    package, _, name = msgtype.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{name}"


def _content(where: str, topic: str, number: int, message: Any) -> tuple[Layout, list[Array]]:  # noqa: ANN401
    """Return what a message names, and the fields that it fills."""
    names = tuple(message.name)
    fields = {name: getattr(message, name) for name in _FIELDS}
    for name, values in fields.items():
        if len(values) not in (0, len(names)):
            raise DataError(
                f"{where}: message {number} on {topic!r} names {len(names)} joints but holds "
                f"{len(values)} values of {name}; correct the recording"
            )
    if len(set(names)) < len(names):
        raise DataError(
            f"{where}: message {number} on {topic!r} names {listed(repeated(names))} twice; "
            "correct the recording"
        )
    filled = {name: values for name, values in fields.items() if len(values)}
    return (names, tuple(filled)), list(filled.values())


def _columns(layout: Layout) -> list[str]:
    """Return the columns that messages of a layout fill, in the order of their values."""
    joints, filled = layout
    return [f"{name}_{joint}" for name in filled for joint in joints]


def _read(where: str, blocks: dict[Layout, _Block], wanted: Sequence[str]) -> dict[str, Array]:
    """Return columns, in the order of the messages."""
    columns = [name for name in wanted if name != "time"]
    used = [layout for layout in blocks if not set(columns).isdisjoint(_columns(layout))]
    _require_whole(where, {layout: blocks[layout] for layout in used}, columns)
    number = np.concatenate([blocks[layout].number for layout in used])
    order = np.argsort(number)
    parts: dict[str, list[Array]] = {name: [] for name in wanted}
    for layout in used:
        block, names = blocks[layout], _columns(layout)
        values = np.frombuffer(block.values).reshape(-1, len(names))
        for name in columns:
            parts[name].append(values[:, names.index(name)])
        if "time" in parts:
            parts["time"].append(np.frombuffer(block.stamp, dtype=np.int64) / 1e9)
    return {name: np.concatenate(part)[order] for name, part in parts.items()}


def _require_whole(where: str, blocks: dict[Layout, _Block], columns: Sequence[str]) -> None:
    """Refuse messages that hold only some of the columns."""
    total = sum(len(block.number) for block in blocks.values())
    partial_: dict[int, list[str]] = {}
    count = 0
    for layout, block in blocks.items():
        held = set(_columns(layout))
        if lacking := [name for name in columns if name not in held]:
            partial_[block.number[0]] = lacking
            count += len(block.number)
    if partial_:
        first = min(partial_)
        raise DataError(
            f"{where}: {count} of {total} messages lack some of what is read, the first (message "
            f"{first}) {listed(partial_[first])}. A row is one message: read only joints that are "
            "always "
            "published together, and leave out the others"
        )
