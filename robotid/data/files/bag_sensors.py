"""Topics of bags with the motion of a base, an IMU, wrenches or foot forces, as columns.

Their messages have other stamps than those of the joints: columns are interpolated linearly.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.base_motion import POSE, TWIST
from robotid.data.files.table import Table
from robotid.data.imu_frame import IMU
from robotid.data.log import suggestion
from robotid.data.signal_settings import LogSource

_WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
_PACKAGES = ("unitree_go", "unitree_hg", "unitree_legged_msgs")


@dataclass(frozen=True)
class Sensor:
    """A topic whose messages are values of columns."""

    topic: str
    columns: tuple[str, ...]
    values: Callable[[Any], Sequence[float]]  # of a message, in the order of the columns


def is_low_state(kind: str) -> bool:
    """Return whether messages of a type are the low-level states of a robot of Unitree."""
    package, _, name = kind.partition("/msg/")
    return name == "LowState" and package in _PACKAGES


def first_of(message: Any, *names: str) -> Any:  # noqa: ANN401
    """Return the first of some fields that a message has, None without any."""
    return next((getattr(message, name) for name in names if hasattr(message, name)), None)


def sensors_of(
    where: str, types: Mapping[str, str], first: Callable[[str], Any], source: LogSource
) -> list[Sensor]:
    """Return the topics with columns of sensors."""
    for topic in source.sensors:
        if topic not in types:
            raise DataError(
                f"{where} has no message of a topic {topic!r}, which sensors states; topics: "
                f"{dict(sorted(types.items()))}{suggestion(topic, types)}"
            )
        if types[topic] not in _SENSORS and not is_low_state(types[topic]):
            raise DataError(
                f"{where}: topic {topic!r}, which sensors states, has messages of {types[topic]}, "
                f"wanted one of {listed([*_SENSORS, 'unitree_go/msg/LowState'])}"
            )
    found = []
    for topic in source.sensors or sorted(types):
        make = _low_state if is_low_state(types[topic]) else _SENSORS.get(types[topic])
        if make is not None:
            found.append(make(topic, first(topic)))
    return found


def with_sensors(
    states: Table, where: str, sensors: Sequence[Sensor], load: Callable[[Sensor], tuple[Any, Any]]
) -> Table:
    """Return a table with the columns of sensors, interpolated at its time stamps.

    Rows before the first or after the last message of a topic that is read are left out.
    """
    by_column: dict[str, list[Sensor]] = {}
    for sensor in sensors:
        for name in sensor.columns:
            by_column.setdefault(name, []).append(sensor)

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        used: dict[str, Sensor] = {}
        for name in wanted:
            for sensor in by_column.get(name, ()):
                used[sensor.topic] = sensor
            if len(several := by_column.get(name, ())) > 1:
                raise _ambiguous(where, name, several)
        mine = [name for name in wanted if name not in by_column and name != "time"]
        rows = states.read(["time", *mine])
        loaded = {topic: load(sensor) for topic, sensor in used.items()}
        inside = np.ones(len(rows["time"]), dtype=bool)
        for topic, (t, _) in loaded.items():
            inside &= (rows["time"] >= t[0]) & (rows["time"] <= t[-1])
            if not inside.any():
                raise DataError(
                    f"{where}: no message of the joints lies between the first and the last "
                    f"message of topic {topic!r}, {t[0]:.3f} s to {t[-1]:.3f} s; the joints have "
                    f"{rows['time'][0]:.3f} s to {rows['time'][-1]:.3f} s. If the stamps are of "
                    'different clocks, state stamp = "log"'
                )
        rows = {name: values[inside] for name, values in rows.items()}
        for topic, (t, values) in loaded.items():
            columns = used[topic].columns
            rows |= _interpolated(t, dict(zip(columns, values.T, strict=True)), rows["time"])
        return {name: rows[name] for name in wanted}

    topics = {name: f"topic {own[0].topic!r}" for name, own in by_column.items()}
    axes = {"wrench": "link"}
    return replace(states, names=[*states.names, *topics], read=read, sensors=topics, axes=axes)


def _interpolated(t: Array, columns: Mapping[str, Array], at: Array) -> dict[str, Array]:
    """Return columns at other times, linear between messages; quaternions of length 1."""
    found: dict[str, Array] = {}
    for name, values in columns.items():
        start = name.removesuffix("qx")
        if name.endswith("_qx"):
            q = np.column_stack([columns[f"{start}{end}"] for end in ("qx", "qy", "qz", "qw")])
            is_opposite = np.sum(q[1:] * q[:-1], axis=1) < 0
            q *= np.where(np.append(0, np.cumsum(is_opposite)) % 2, -1.0, 1.0)[:, None]
            q = np.column_stack([np.interp(at, t, x) for x in q.T])
            q /= np.linalg.norm(q, axis=1, keepdims=True)
            found |= {f"{start}{end}": q[:, k] for k, end in enumerate(("qx", "qy", "qz", "qw"))}
        elif name not in found:
            found[name] = np.interp(at, t, values)
    return found


def _ambiguous(where: str, name: str, several: Sequence[Sensor]) -> DataError:
    topics = [sensor.topic for sensor in several]
    return DataError(
        f"{where} has {len(topics)} topics with {name}: {listed(topics)}. State all topics of "
        f'sensors to read: sensors = ["{topics[0]}"] (job file table [log], Python '
        "source=LogSource(sensors=...))"
    )


def _xyz(vector: Any) -> list[float]:  # noqa: ANN401
    return [vector.x, vector.y, vector.z]


def _xyzw(quaternion: Any) -> list[float]:  # noqa: ANN401
    return [*_xyz(quaternion), quaternion.w]


def _odometry(topic: str, first: Any) -> Sensor:  # noqa: ANN401
    """Return pose in the frame of the header, and twist with the axes of the child frame."""

    def values(message: Any) -> list[float]:  # noqa: ANN401
        pose, twist = message.pose.pose, message.twist.twist
        place = [*_xyz(pose.position), *_xyzw(pose.orientation)]
        return [*place, *_xyz(twist.linear), *_xyz(twist.angular)]

    return Sensor(topic, tuple(f"base_{end}" for end in (*POSE, *TWIST)), values)


def _imu(topic: str, first: Any) -> Sensor:  # noqa: ANN401
    """Return orientation, angular velocity and specific force; -1 marks what is not measured."""
    parts = {
        "orientation": (IMU[:4], _xyzw),
        "angular_velocity": (IMU[4:7], _xyz),
        "linear_acceleration": (IMU[7:], _xyz),
    }
    known = [name for name in parts if getattr(first, f"{name}_covariance")[0] != -1.0]
    columns = [f"imu_{end}" for name in known for end in parts[name][0]]

    def values(message: Any) -> list[float]:  # noqa: ANN401
        return [x for name in known for x in parts[name][1](getattr(message, name))]

    return Sensor(topic, tuple(columns), values)


def _wrench(topic: str, first: Any) -> Sensor:  # noqa: ANN401
    """Return force and moment with the axes and the origin of the frame of the header."""
    frame = first.header.frame_id.lstrip("/")

    def values(message: Any) -> list[float]:  # noqa: ANN401
        return [*_xyz(message.wrench.force), *_xyz(message.wrench.torque)]

    return Sensor(topic, tuple(f"wrench_{part}_{frame}" for part in _WRENCH), values)


def _low_state(topic: str, first: Any) -> Sensor:  # noqa: ANN401
    """Return the IMU, whose quaternion starts with w, and the forces of the feet, if any."""

    def feet(message: Any) -> list[float]:  # noqa: ANN401
        forces = first_of(message, "foot_force", "footForce")
        return [] if forces is None else list(forces)

    def values(message: Any) -> list[float]:  # noqa: ANN401
        imu = first_of(message, "imu_state", "imu")
        w, *xyz = imu.quaternion
        return [*xyz, w, *imu.gyroscope, *imu.accelerometer, *feet(message)]

    forces = [f"foot_force_{k}" for k in range(len(feet(first)))]
    return Sensor(topic, (*(f"imu_{end}" for end in IMU), *forces), values)


_SENSORS: dict[str, Callable[[str, Any], Sensor]] = {
    "nav_msgs/msg/Odometry": _odometry,
    "sensor_msgs/msg/Imu": _imu,
    "geometry_msgs/msg/WrenchStamped": _wrench,
}
