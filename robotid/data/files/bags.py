"""Bags of ROS 1 and 2, MCAP included: a row is a message of joints; sensors are interpolated."""

import re
from array import array
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import listed, suggestion
from robotid.base.typing import Array
from robotid.data.base_motion import IMU, POSE, TWIST, continuous_signs
from robotid.data.files.table import Format, Table, choose, load_package
from robotid.data.log import repeated
from robotid.data.signal_settings import LogSource

_STATE = "sensor_msgs/msg/JointState"
_CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
_PACKAGES = ("unitree_go", "unitree_hg", "unitree_legged_msgs")  # with LowState
_MEASURED = ("position", "velocity", "effort")
_COMMANDED = ("qref", "dqref", "tauref")
_FIELDS = (*_MEASURED, *_COMMANDED)
_WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")

Layout = tuple[tuple[str, ...], tuple[str, ...]]  # names of joints, and the fields with values


@dataclass
class _Block:
    """The messages with the same joints in the same order and values in the same fields."""

    number: "array[int]" = field(default_factory=lambda: array("q"))  # place in the bag
    stamp: "array[int]" = field(default_factory=lambda: array("q"))  # [ns]
    values: "array[float]" = field(default_factory=lambda: array("d"))  # field by field


@dataclass(frozen=True)
class _Bag:
    """An open bag."""

    path: Path
    source: LogSource
    reader: Any
    decode: Callable[[bytes, str], Any]

    @property
    def types(self) -> dict[str, str]:
        """The type of each topic."""
        return {c.topic: _full_name(c.msgtype) for c in self.reader.connections}

    @property
    def filled(self) -> dict[str, str]:
        """The type of each topic with messages."""
        filled = {c.topic for c in self.reader.connections if c.msgcount}
        return {topic: kind for topic, kind in self.types.items() if topic in filled}

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yield stamp [ns], of the header if any, and message; errors become a DataError."""
        chosen, is_stamped = [c for c in self.reader.connections if c.topic == topic], False
        count = 0
        try:
            for connection, logged, raw in self.reader.messages(chosen):
                message = self.decode(raw, _full_name(connection.msgtype))
                stamp = logged
                if self.source.stamp != "log" and hasattr(message, "header"):
                    stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                is_stamped, count = is_stamped or stamp != 0, count + 1
                yield stamp, message
        except DataError:
            raise
        except Exception as error:  # a parser of foreign bytes fails in many ways
            raise _broken(self.path, error) from error
        if count and not is_stamped:
            raise DataError(
                f"{self.path.name}, topic {topic!r}: the header stamps of all {count} messages are "
                '0. To use the time of recording, set stamp = "log" in [log] (CLI --stamp log)'
            )


def _open(path: Path, source: LogSource) -> Table:
    """Return the table of a .mcap, .db3 or .bag file, or of a folder: as ``position_<joint>``."""
    with _opened(path, source) as bag:
        sensors = _sensors_of(bag)
        topic, types = _choose_topic(bag), bag.types
        blocks, commands = _blocks(bag, topic, _MEASURED), dict[Layout, _Block]()
        if source.command is not None:
            commands = _blocks(bag, source.command, _COMMANDED)
    table = _table(f"{path.name}, topic {topic!r}", blocks)
    others = sorted(x for x, kind in types.items() if kind == _CONTROLLER)
    if source.command is not None:
        where = f"{path.name}, topic {source.command!r}"
        stamps = _stamps(blocks), _stamps(commands)
        table = _with_commands(table, _table(where, commands), stamps, source.command)
    elif others and types[topic] != _CONTROLLER:
        note = (
            f"commands are in topics that are not read: {listed(others)}; topic = "
            f'"{others[0]}" reads them and their measured positions'
        )
        table = replace(table, notes=(note,))
    return _with_sensors(table, path, sensors, source)


BAG = Format((".mcap", ".db3", ".bag"), _open, topics="topic")


@contextmanager
def _opened(path: Path, source: LogSource) -> Iterator[_Bag]:
    modules = ("rosbags.rosbag1", "rosbags.rosbag2", "rosbags.typesys")
    ros1, ros2, typesys = load_package("reading ROS bags and MCAP files", "bag", *modules)
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise DataError(
            f"{path.name} is a folder without metadata.yaml, so it is not a ROS 2 bag, and without "
            "meta/info.json, so it is not a LeRobot dataset; give the .mcap or .db3 file in it, or "
            "restore it with 'ros2 bag reindex'"
        )
    is_ros1 = path.suffix.lower() == ".bag" and not path.is_dir()
    stores = typesys.Stores
    types = typesys.get_typestore(stores.ROS1_NOETIC if is_ros1 else stores.LATEST)
    deserialize = types.deserialize_ros1 if is_ros1 else types.deserialize_cdr
    try:
        reader = (ros1 if is_ros1 else ros2).Reader(path)
        reader.open()
    except Exception as error:  # a parser of foreign bytes fails in many ways
        raise _broken(path, error) from error
    with closing(reader):
        for connection in reader.connections:
            kind = _full_name(connection.msgtype)
            if (kind == _CONTROLLER or _is_low_state(kind)) and kind not in types.types:
                types.register(_definitions(path, kind, connection.msgdef, types.types))

        def decode(raw: bytes, kind: str) -> Any:  # noqa: ANN401
            if kind not in types.types:
                raise DataError(
                    f"{path.name} does not contain the definition of {kind}, as .db3 files before "
                    "ROS 2 Iron; convert it to MCAP on a machine with its package: 'ros2 bag "
                    "convert'"
                )
            return deserialize(raw, kind)

        yield _Bag(path, source, reader, decode)


def _definitions(
    path: Path,
    kind: str,
    definition: Any,  # noqa: ANN401
    known: Container[str],
) -> dict[str, Any]:
    """Return the unknown types that a bag defines for messages of a type."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    types: dict[str, Any] = {}
    try:
        if definition.format.name == "MSG":
            types = dict(get_types_from_msg(definition.data, kind))
        elif definition.format.name == "IDL":
            for text in definition.data.split("=" * 80 + "\n"):
                types |= get_types_from_idl(re.sub(r"^IDL: .*\n", "", text)) if text else {}
    except Exception as error:  # a parser of foreign text fails in many ways
        raise _broken(path, error) from error
    return {name: fields for name, fields in types.items() if name not in known}


def _broken(path: Path, error: Exception) -> DataError:
    """Return the error of a bag that the library cannot read."""
    reason = str(error) or type(error).__name__
    return DataError(
        f"{path.name}: broken, unfinished or foreign bag ({reason}); record it again, or "
        "restore it with 'mcap recover', 'ros2 bag reindex' or 'rosbag reindex'"
    )


def _full_name(msgtype: str) -> str:
    """Return the name of a type in ROS 2, with "/msg/"."""
    package, _, name = msgtype.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{name}"


def _is_low_state(kind: str) -> bool:
    """Return whether messages of a type are the low-level states of a robot of Unitree."""
    package, _, name = kind.partition("/msg/")
    return name == "LowState" and package in _PACKAGES


def _choose_topic(bag: _Bag) -> str:
    """Return the stated topic, or the only one of joint states or of a controller."""
    where, source, types, filled = bag.path.name, bag.source, bag.types, bag.filled
    listing = f"topics: {dict(sorted(types.items()))}"
    low = [kind for kind in types.values() if _is_low_state(kind)]
    kinds = (_STATE, _CONTROLLER, *low)
    for wanted, allowed in ((source.topic, kinds), (source.command, (_STATE,))):
        if wanted is None:
            continue
        if wanted not in types:
            fault, near = f" has no topic {wanted!r}", suggestion(wanted, types)
        elif types[wanted] not in allowed:
            fault = f": topic {wanted!r} has messages of {types[wanted]}, expected "
            fault, near = fault + " or ".join(allowed), ""
        elif wanted not in filled:
            fault, near = f": topic {wanted!r} has no message", ""
        else:
            continue
        raise DataError(f"{where}{fault}; {listing}{near}")
    if source.command is not None and source.command == source.topic:
        raise DataError(
            f"{where}: topic and command are both {source.topic!r}; give the topic of the "
            "measurements and the topic of the commands"
        )
    if source.topic is not None:
        return source.topic
    for kind in kinds:
        topics = sorted(x for x in filled if types[x] == kind and x != source.command)
        if topics:
            return choose(where, topics, f"topics of {kind}", listing)
    raise DataError(f"{where} has no message of {_STATE}; {listing}")


def _blocks(bag: _Bag, topic: str, fields: Sequence[str]) -> dict[Layout, _Block]:
    """Return the messages of a topic; fields are the names of position, velocity and effort."""
    blocks: dict[Layout, _Block] = {}
    for number, (stamp, message) in enumerate(bag.messages(topic)):
        where = f"{bag.path.name}: message {number} on {topic!r} names"
        layout, values = _content(where, message, fields)
        block = blocks.setdefault(layout, _Block())
        block.number.append(number)
        block.stamp.append(stamp)
        for part in values:
            block.values.frombytes(np.asarray(part, dtype=np.float64).tobytes())
    return blocks


def _content(
    where: str,
    message: Any,  # noqa: ANN401
    fields: Sequence[str],
) -> tuple[Layout, list[Array]]:
    """Return the joints of a message, and its fields with values."""
    motors = _first_of(message, "motor_state", "motorState")
    if hasattr(message, "joint_names"):
        names, content = tuple(message.joint_names), _controlled(message)
    elif motors is not None:
        names = tuple(str(k) for k in range(len(motors)))
        torques = [_first_of(motor, "tau_est", "tauEst") for motor in motors]
        values = [motor.q for motor in motors], [motor.dq for motor in motors], torques
        content = dict(zip(fields, values, strict=True))
    else:
        names = tuple(message.name)
        values = (message.position, message.velocity, message.effort)
        content = dict(zip(fields, values, strict=True))
    for name, own in content.items():
        if len(own) not in (0, len(names)):
            raise DataError(
                f"{where} {len(names)} joints but has {len(own)} values of {name}; correct the "
                "recording"
            )
    if twice := repeated(names):
        raise DataError(f"{where} {listed(twice)} twice; correct the recording")
    filled = {name: own for name, own in content.items() if len(own)}
    return (names, tuple(filled)), list(filled.values())


def _controlled(message: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return the fields of a controller's state, also up to control_msgs 4; NaN only is empty."""

    def first(name: str, *points: str) -> Any:  # noqa: ANN401
        candidates = (getattr(getattr(message, point, None), name, ()) for point in points)
        return next((x for x in candidates if len(x) and not np.isnan(x).all()), ())

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


def _table(where: str, blocks: dict[Layout, _Block]) -> Table:
    """Return the table of the messages of a topic."""
    names = list(dict.fromkeys(n for layout in blocks for n in _columns(layout)))
    names.sort(key=lambda name: _FIELDS.index(name.partition("_")[0]))
    return Table(["time", *names], partial(_read, where, blocks))


def _read(where: str, blocks: dict[Layout, _Block], wanted: Sequence[str]) -> dict[str, Array]:
    """Return columns, in the order of the messages; reject messages with only some of them."""
    columns = [name for name in wanted if name != "time"]
    used = [layout for layout in blocks if not set(columns).isdisjoint(_columns(layout))]
    lacking = {
        blocks[layout].number[0]: (missing, len(blocks[layout].number))
        for layout in used
        if (missing := [name for name in columns if name not in _columns(layout)])
    }
    number = np.concatenate([blocks[layout].number for layout in used])
    if lacking:
        first = min(lacking)
        raise DataError(
            f"{where}: {sum(n for _, n in lacking.values())} of {len(number)} messages lack some, "
            f"message {first} lacks {listed(lacking[first][0])}. A row is one message; "
            "read only joints that are always published together"
        )
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


def _stamps(blocks: dict[Layout, _Block]) -> Array:
    """Return the stamps of all messages of a topic, sorted [s]."""
    return np.sort(np.concatenate([block.stamp for block in blocks.values()])) / 1e9


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
    state_names = [name for name in states.names if name not in command_names]

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        rows = states.read(["time", *(x for x in wanted if x in state_names and x != "time")])
        rows = {name: values[rows["time"] >= sent[0]] for name, values in rows.items()}
        for name in filter(command_names.__contains__, wanted):
            own = commands.read(["time", name])  # the commands of joints may be in other messages
            order = np.argsort(own["time"], kind="stable")
            last = np.searchsorted(own["time"][order], rows["time"], side="right") - 1
            rows[name] = np.where(last >= 0, own[name][order][np.maximum(last, 0)], np.nan)
        return {name: rows[name] for name in wanted}

    return Table([*state_names, *command_names], read, (*states.notes, note))


# --- topics of sensors ----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Sensor:
    """A topic whose messages are values of columns."""

    topic: str
    columns: tuple[str, ...]
    values: Callable[[Any], Sequence[float]]  # of a message, in the order of the columns

    def load(self, path: Path, source: LogSource) -> tuple[Array, Array]:
        """Return stamps (N,) [s], sorted, and values (N, k)."""
        with _opened(path, source) as bag:
            rows = [(stamp, self.values(message)) for stamp, message in bag.messages(self.topic)]
        t = np.array([stamp for stamp, _ in rows]) / 1e9
        order = np.argsort(t, kind="stable")
        return t[order], np.array([values for _, values in rows], dtype=np.float64)[order]


def _sensors_of(bag: _Bag) -> list[_Sensor]:
    """Return the topics with columns of sensors."""
    where, types, stated = bag.path.name, bag.filled, bag.source.sensors
    for topic in stated:
        if topic not in types:
            raise DataError(
                f"{where} has no message of a topic {topic!r}, given in sensors; topics: "
                f"{dict(sorted(types.items()))}{suggestion(topic, types)}"
            )
        if types[topic] not in _SENSORS and not _is_low_state(types[topic]):
            raise DataError(
                f"{where}: topic {topic!r}, given in sensors, has messages of {types[topic]}, "
                f"expected one of {listed([*_SENSORS, 'unitree_go/msg/LowState'])}"
            )
    sensors = []
    for topic in stated or sorted(types):
        if types[topic] in _SENSORS or _is_low_state(types[topic]):
            sensors.append(_sensor(topic, types[topic], next(bag.messages(topic))[1]))
    return sensors


def _with_sensors(
    states: Table, path: Path, sensors: Sequence[_Sensor], source: LogSource
) -> Table:
    """Return a table with columns of sensors, interpolated; rows outside them are left out."""
    by_column: dict[str, list[_Sensor]] = {}
    for sensor in sensors:
        for name in sensor.columns:
            by_column.setdefault(name, []).append(sensor)

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        sensed = [name for name in wanted if name in by_column]
        used = {by_column[name][0].topic: by_column[name][0] for name in sensed}
        for name in sensed:
            topics = [sensor.topic for sensor in by_column[name]]
            if len(topics) > 1:
                raise DataError(
                    f"{path.name} has {len(topics)} topics with {name}: {listed(topics)}. Set "
                    f'all topics of sensors to read: sensors = ["{topics[0]}"] (in [log] of a job)'
                )
        others = [name for name in wanted if name not in by_column and name != "time"]
        rows = states.read(["time", *others])
        loaded = {topic: sensor.load(path, source) for topic, sensor in used.items()}
        inside = np.ones(len(rows["time"]), dtype=bool)
        for topic, (t, _) in loaded.items():
            inside &= (rows["time"] >= t[0]) & (rows["time"] <= t[-1])
            if not inside.any():
                raise DataError(
                    f"{path.name}: topic {topic!r} has times {t[0]:.3f} s to {t[-1]:.3f} s, "
                    f"the joints {rows['time'][0]:.3f} s to {rows['time'][-1]:.3f} s. If these "
                    'are different clocks, set stamp = "log"'
                )
        rows = {name: values[inside] for name, values in rows.items()}
        for topic, (t, values) in loaded.items():
            columns = dict(zip(used[topic].columns, values.T, strict=True))
            rows |= _interpolated(t, columns, rows["time"])
        return {name: rows[name] for name in wanted}

    sources = {name: f"topic {having[0].topic!r}" for name, having in by_column.items()}
    axes = {"wrench": "link"}
    return replace(states, names=[*states.names, *sources], read=read, sensors=sources, axes=axes)


def _interpolated(t: Array, columns: Mapping[str, Array], at: Array) -> dict[str, Array]:
    """Return columns at other times, linear between messages; quaternions of length 1."""
    columns = dict(columns)
    starts = [name.removesuffix("qx") for name in columns if name.endswith("_qx")]
    quaternions = [[f"{start}{end}" for end in ("qx", "qy", "qz", "qw")] for start in starts]
    for names in quaternions:
        q = np.column_stack([columns[name] for name in names])
        columns |= dict(zip(names, (continuous_signs(q) * q).T, strict=True))
    values = {name: np.interp(at, t, x) for name, x in columns.items()}
    for names in quaternions:
        size = np.linalg.norm(np.column_stack([values[name] for name in names]), axis=1)
        values |= {name: values[name] / size for name in names}
    return values


def _first_of(message: Any, *names: str) -> Any:  # noqa: ANN401
    """Return the first of some fields that a message has, None without any."""
    return next((getattr(message, name) for name in names if hasattr(message, name)), None)


def _parts(path: str, ends: Sequence[str] = "xyz") -> list[str]:
    return [f"{path}.{end}" for end in ends]


_ODOMETRY, _IMU = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu"
#: Values of a message, in the order of the columns: twist with the axes of the child frame, wrench
#: with the axes and the origin of the frame of the header.
_SENSORS = {
    _ODOMETRY: [
        *_parts("pose.pose.position"), *_parts("pose.pose.orientation", "xyzw"),
        *_parts("twist.twist.linear"), *_parts("twist.twist.angular"),
    ],
    _IMU: [
        *_parts("orientation", "xyzw"), *_parts("angular_velocity"), *_parts("linear_acceleration"),
    ],
    "geometry_msgs/msg/WrenchStamped": [*_parts("wrench.force"), *_parts("wrench.torque")],
}  # fmt: skip


def _sensor(topic: str, kind: str, first: Any) -> _Sensor:  # noqa: ANN401
    """Return the columns of a topic from its first message."""
    if _is_low_state(kind):
        return _low_state(topic, first)
    fields = _SENSORS[kind]
    columns = [f"base_{end}" for end in (*POSE, *TWIST)]
    if kind == _IMU:  # a covariance of -1 marks what is not measured
        places = [k for k, x in enumerate(fields)
                  if getattr(first, f"{x.partition('.')[0]}_covariance")[0] != -1.0]  # fmt: skip
        columns, fields = [f"imu_{IMU[k]}" for k in places], [fields[k] for k in places]
    elif kind != _ODOMETRY:
        columns = [f"wrench_{part}_{first.header.frame_id.lstrip('/')}" for part in _WRENCH]
    return _Sensor(topic, tuple(columns), attrgetter(*fields) if fields else lambda _: ())


def _low_state(topic: str, first: Any) -> _Sensor:  # noqa: ANN401
    """Return the IMU, whose quaternion starts with w, and the forces of the feet, if any."""

    def feet(message: Any) -> list[float]:  # noqa: ANN401
        forces = _first_of(message, "foot_force", "footForce")
        return [] if forces is None else list(forces)

    def values(message: Any) -> list[float]:  # noqa: ANN401
        imu = _first_of(message, "imu_state", "imu")
        w, *xyz = imu.quaternion
        return [*xyz, w, *imu.gyroscope, *imu.accelerometer, *feet(message)]

    forces = [f"foot_force_{k}" for k in range(len(feet(first)))]
    return _Sensor(topic, (*(f"imu_{end}" for end in IMU), *forces), values)
