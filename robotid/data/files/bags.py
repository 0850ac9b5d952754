"""Bags of ROS 1 and ROS 2, including MCAP: joints, commands and sensors as a table of columns.

The library rosbags reads all of them; ROS need not be installed.
"""

import re
from array import array
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, MissingDependencyError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.files.bag_sensors import Sensor, first_of, is_low_state, sensors_of, with_sensors
from robotid.data.files.table import Format, Table, choose
from robotid.data.log import repeated, suggestion
from robotid.data.signal_settings import LogSource

_STATE = "sensor_msgs/msg/JointState"
_CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
_MEASURED = ("position", "velocity", "effort")
_COMMANDED = ("qref", "dqref", "tauref")
_FIELDS = (*_MEASURED, *_COMMANDED)

Layout = tuple[tuple[str, ...], tuple[str, ...]]  # names of joints, and the fields with values


@dataclass
class _Block:
    """The messages with the same joints in the same order and values in the same fields."""

    number: "array[int]" = field(default_factory=lambda: array("q"))  # place in the bag
    stamp: "array[int]" = field(default_factory=lambda: array("q"))  # [ns]
    values: "array[float]" = field(default_factory=lambda: array("d"))  # field by field


class BagFormat(Format):
    """Bags: .mcap, .db3 or .bag files, or the folder of a ROS 2 bag. A row is a message.

    The columns are ``time`` [s] since the epoch, ``position_<joint>``, ``velocity_<joint>`` and
    ``effort_<joint>``. The order of the joints may differ between messages. Messages without any
    of the required columns, as those of another publisher, are ignored; an inconsistent message,
    or one with only some of the required columns, is a ``DataError``.

    A JointTrajectoryControllerState contains commands, too: its output to the drives, else its
    reference (formerly "desired"), as ``qref_<joint>`` and ``dqref_<joint>``, and the effort of
    the reference as ``tauref_<joint>``. For joint states, the commands are in a second topic; a
    zero-order hold brings them to the time stamps of the states.

    A LowState of Unitree contains its motors, by number: ``position_0``. Columns of sensors are of
    further topics, as of ``with_sensors``.
    """

    def open(self, path: Path, source: LogSource) -> Table:
        with _open(path) as (reader, decode):
            types = {c.topic: _full_name(c.msgtype) for c in reader.connections}
            filled = {c.topic: types[c.topic] for c in reader.connections if c.msgcount}

            def first(topic: str) -> Any:  # noqa: ANN401
                return next(_messages(path, reader, decode, topic))[1]

            sensors = sensors_of(path.name, filled, first, source)
            topic = _choose_topic(path.name, reader, types, source)
            blocks = _blocks(path, reader, decode, topic, source, _MEASURED)
            others: dict[Layout, _Block] = {}
            if source.command is not None:
                others = _blocks(path, reader, decode, source.command, source, _COMMANDED)
        table = _table(f"{path.name}, topic {topic!r}", blocks)
        if source.command is not None:
            commands = _table(f"{path.name}, topic {source.command!r}", others)
            stamps = _stamps(blocks), _stamps(others)
            table = _with_commands(table, commands, stamps, source.command)
        elif unread := _unread_commands(types, topic):
            note = (
                f"commands are in topics that are not read: {listed(unread)}; topic = "
                f'"{unread[0]}" reads them and their measured positions'
            )
            table = replace(table, notes=(note,))
        return with_sensors(table, path.name, sensors, partial(_load, path, source))


def _unread_commands(types: Mapping[str, str], topic: str) -> list[str]:
    """Return the topics of controllers, if the joints are read from another topic."""
    found = sorted(x for x, kind in types.items() if kind == _CONTROLLER)
    return [] if types[topic] == _CONTROLLER else found


def _load(path: Path, source: LogSource, sensor: Sensor) -> tuple[Array, Array]:
    """Return stamps (N,) [s], sorted, and values (N, k) of a topic of a sensor."""
    stamps, rows = array("q"), []
    with _open(path) as (reader, decode):
        for logged, message in _messages(path, reader, decode, sensor.topic):
            stamps.append(_stamp(message, logged, source))
            rows.append(sensor.values(message))
    _require_stamped(path.name, sensor.topic, stamps, source)
    t, values = np.array(stamps) / 1e9, np.array(rows, dtype=np.float64)
    order = np.argsort(t, kind="stable")
    return t[order], values[order]


def _stamp(message: Any, logged: int, source: LogSource) -> int:  # noqa: ANN401
    """Return the stamp of a message [ns]; without a header, the time of recording."""
    if source.stamp == "log" or not hasattr(message, "header"):
        return logged
    clock = message.header.stamp
    stamp: int = clock.sec * 10**9 + clock.nanosec
    return stamp


def _require_stamped(where: str, topic: str, stamps: Sequence[int], source: LogSource) -> None:
    """Reject messages whose header stamps are all 0."""
    if source.stamp != "log" and not any(stamps):
        raise DataError(
            f"{where}, topic {topic!r}: the header stamps of all {len(stamps)} messages are 0. To "
            'use the time of recording, state stamp = "log" (job file table [log], CLI --stamp '
            'log, Python source=LogSource(stamp="log"))'
        )


def _stamps(blocks: dict[Layout, _Block]) -> Array:
    """Return the stamps of all messages of a topic, sorted [s]."""
    return np.sort(np.concatenate([block.stamp for block in blocks.values()])) / 1e9


def _table(where: str, blocks: dict[Layout, _Block]) -> Table:
    """Return the table of the messages of a topic."""
    names = list(dict.fromkeys(n for layout in blocks for n in _columns(layout)))
    names.sort(key=lambda name: _FIELDS.index(name.partition("_")[0]))
    return Table(["time", *names], partial(_read, where, blocks))


def _blocks(
    path: Path,
    reader: Any,  # noqa: ANN401
    decode: Callable[[bytes, str], Any],
    topic: str,
    source: LogSource,
    fields: Sequence[str],
) -> dict[Layout, _Block]:
    """Return the messages of a topic; fields are the names of position, velocity and effort."""
    blocks: dict[Layout, _Block] = {}
    stamps = array("q")
    for number, (logged, message) in enumerate(_messages(path, reader, decode, topic)):
        layout, values = _content(path.name, topic, number, message, fields)
        block = blocks.setdefault(layout, _Block())
        block.number.append(number)
        stamps.append(_stamp(message, logged, source))
        block.stamp.append(stamps[-1])
        for part in values:
            block.values.frombytes(np.asarray(part, dtype=np.float64).tobytes())
    _require_stamped(path.name, topic, stamps, source)
    return blocks


def _with_commands(
    states: Table, commands: Table, stamps: tuple[Array, Array], topic: str
) -> Table:
    """Return states with the last command before each; rows before the first one are left out."""
    measured, sent = stamps
    note = f"a zero-order hold is applied to the commands of topic {topic!r}"
    if len(sent) > 1:
        note += f", with a median interval of {1e3 * float(np.median(np.diff(sent))):.3g} ms"
    if before := int(np.sum(measured < sent[0])):
        note += f"; messages before the first command, left out: {before}"
    if after := int(np.sum(measured > sent[-1])):
        note += f"; messages after the last command: {after}"
    command_names = commands.names[1:]  # used instead of those of a controller's state
    own_names = [name for name in states.names if name not in command_names]

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        mine = [name for name in wanted if name in own_names and name != "time"]
        theirs = [name for name in wanted if name in command_names]
        rows = states.read(["time", *mine])
        rows = {name: values[rows["time"] >= sent[0]] for name, values in rows.items()}
        for name in theirs:  # one by one: the commands of joints may be in different messages
            own = commands.read(["time", name])
            order = np.argsort(own["time"], kind="stable")
            last = np.searchsorted(own["time"][order], rows["time"], side="right") - 1
            rows[name] = np.where(last >= 0, own[name][order][np.maximum(last, 0)], np.nan)
        return {name: rows[name] for name in wanted}

    return Table([*own_names, *command_names], read, (*states.notes, note))


@contextmanager
def _open(path: Path) -> Iterator[tuple[Any, Callable[[bytes, str], Any]]]:
    """Open a bag: its reader, and a function that decodes a message."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        purpose = "reading ROS bags and MCAP files"
        raise MissingDependencyError(purpose, "rosbags", "bag") from error
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise DataError(
            f"{path.name} is a folder without metadata.yaml, so it is not a ROS 2 bag, and without "
            "meta/info.json, so it is not a LeRobot dataset; give the .mcap or .db3 file in it, or "
            "restore it with 'ros2 bag reindex'"
        )
    is_ros1 = path.suffix.lower() == ".bag" and not path.is_dir()
    types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    deserialize = types.deserialize_ros1 if is_ros1 else types.deserialize_cdr
    try:
        reader: Any = Reader1(path) if is_ros1 else Reader2(path)
        reader.open()
    except Exception as error:  # a parser of foreign bytes fails in many ways
        raise _broken(path, error) from error
    with closing(reader):
        for connection in reader.connections:
            kind = _full_name(connection.msgtype)
            if (kind == _CONTROLLER or is_low_state(kind)) and kind not in types.types:
                types.register(_definitions(path, kind, connection.msgdef, types.types))

        def decode(raw: bytes, kind: str) -> Any:  # noqa: ANN401
            if kind not in types.types:
                raise DataError(
                    f"{path.name} does not contain the definition of {kind}, as .db3 files before "
                    "ROS 2 Iron; convert it to MCAP on a machine with its package: 'ros2 bag "
                    "convert'"
                )
            return deserialize(raw, kind)

        yield reader, decode


def _definitions(
    path: Path,
    kind: str,
    definition: Any,  # noqa: ANN401
    known: Container[str],
) -> dict[str, Any]:
    """Return the unknown types that a bag defines for messages of a type."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    found: dict[str, Any] = {}
    try:
        if definition.format.name == "MSG":
            found = dict(get_types_from_msg(definition.data, kind))
        elif definition.format.name == "IDL":
            for text in definition.data.split("=" * 80 + "\n"):
                found |= get_types_from_idl(re.sub(r"^IDL: .*\n", "", text)) if text else {}
    except Exception as error:  # a parser of foreign text fails in many ways
        raise _broken(path, error) from error
    return {name: fields for name, fields in found.items() if name not in known}


def _broken(path: Path, error: Exception) -> DataError:
    """Return the error of a bag that the library cannot read."""
    reason = str(error) or type(error).__name__
    return DataError(
        f"{path.name}: broken, unfinished or foreign bag ({reason}); record it again, or "
        "restore it with 'mcap recover', 'ros2 bag reindex' or 'rosbag reindex'"
    )


def _messages(
    path: Path,
    reader: Any,  # noqa: ANN401
    decode: Callable[[bytes, str], Any],
    topic: str,
) -> Iterator[tuple[int, Any]]:
    """Yield time of recording [ns] and message; errors of the library become a DataError."""
    chosen = [c for c in reader.connections if c.topic == topic]
    try:
        for connection, logged, raw in reader.messages(chosen):
            yield logged, decode(raw, _full_name(connection.msgtype))
    except DataError:
        raise
    except Exception as error:  # a parser of foreign bytes fails in many ways
        raise _broken(path, error) from error


def _choose_topic(
    where: str,
    reader: Any,  # noqa: ANN401
    types: Mapping[str, str],
    source: LogSource,
) -> str:
    """Return the topic to read: the stated one, or the only one of joint states or a controller.

    The topic of the commands must be another one, of joint states.
    """
    filled = {c.topic for c in reader.connections if c.msgcount}
    listing = f"topics: {dict(sorted(types.items()))}"
    low = [kind for kind in types.values() if is_low_state(kind)]
    for wanted, kinds in (
        (source.topic, (_STATE, _CONTROLLER, *low)),
        (source.command, (_STATE,)),
    ):
        if wanted is None:
            continue
        if wanted not in types:
            raise DataError(
                f"{where} has no topic {wanted!r}; {listing}{suggestion(wanted, types)}"
            )
        if types[wanted] not in kinds:
            raise DataError(
                f"{where}: topic {wanted!r} has messages of {types[wanted]}, wanted "
                f"{' or '.join(kinds)}; {listing}"
            )
        if wanted not in filled:
            raise DataError(f"{where}: topic {wanted!r} has no message; {listing}")
    if source.command is not None and source.command == source.topic:
        raise DataError(
            f"{where}: topic and command are both {source.topic!r}; give the topic of the "
            "measurements and the topic of the commands"
        )
    if source.topic is not None:
        return source.topic
    for kind in (_STATE, _CONTROLLER, *low):
        found = sorted(x for x in filled if types[x] == kind and x != source.command)
        if found:
            return choose(where, found, f"topics of {kind}", listing)
    raise DataError(f"{where} has no message of {_STATE}; {listing}")


def _full_name(msgtype: str) -> str:
    """Return the name of a type in ROS 2, with "/msg/"."""
    package, _, name = msgtype.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{name}"


def _content(
    where: str,
    topic: str,
    number: int,
    message: Any,  # noqa: ANN401
    fields: Sequence[str],
) -> tuple[Layout, list[Array]]:
    """Return the joints of a message, and its fields with values."""
    motors = first_of(message, "motor_state", "motorState")
    if hasattr(message, "joint_names"):
        names, content = tuple(message.joint_names), _controlled(message)
    elif motors is not None:
        names = tuple(str(k) for k in range(len(motors)))
        torques = [first_of(motor, "tau_est", "tauEst") for motor in motors]
        values = [motor.q for motor in motors], [motor.dq for motor in motors], torques
        content = dict(zip(fields, values, strict=True))
    else:
        names = tuple(message.name)
        values = (message.position, message.velocity, message.effort)
        content = dict(zip(fields, values, strict=True))
    for name, values in content.items():
        if len(values) not in (0, len(names)):
            raise DataError(
                f"{where}: message {number} on {topic!r} names {len(names)} joints but has "
                f"{len(values)} values of {name}; correct the recording"
            )
    if len(set(names)) < len(names):
        raise DataError(
            f"{where}: message {number} on {topic!r} names {listed(repeated(names))} twice; "
            "correct the recording"
        )
    filled = {name: values for name, values in content.items() if len(values)}
    return (names, tuple(filled)), list(filled.values())


def _controlled(message: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return the fields of a controller's state; a field with NaN only is empty.

    Up to control_msgs 4 its points were called desired and actual.
    """

    def first(field: str, *points: str) -> Any:  # noqa: ANN401
        found = (getattr(getattr(message, point, None), field, ()) for point in points)
        return next((x for x in found if len(x) and not np.isnan(x).all()), ())

    measured, wanted = ("feedback", "actual"), ("reference", "desired")
    return {
        "position": first("positions", *measured),
        "velocity": first("velocities", *measured),
        "effort": first("effort", *measured),
        "qref": first("positions", "output", *wanted),
        "dqref": first("velocities", "output", *wanted),
        "tauref": first("effort", *wanted),
    }


def _columns(layout: Layout) -> list[str]:
    """Return the columns of messages of a layout, in the order of their values."""
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
    """Reject messages that have only some of the columns."""
    total = sum(len(block.number) for block in blocks.values())
    lacking: dict[int, list[str]] = {}  # by number of the first message
    count = 0
    for layout, block in blocks.items():
        own = set(_columns(layout))
        if missing := [name for name in columns if name not in own]:
            lacking[block.number[0]] = missing
            count += len(block.number)
    if lacking:
        first = min(lacking)
        raise DataError(
            f"{where}: {count} of {total} messages lack some of the required values, the first "
            f"(message {first}) lacks {listed(lacking[first])}. A row is one message; read only "
            "joints that are always published together, and leave out the others"
        )
