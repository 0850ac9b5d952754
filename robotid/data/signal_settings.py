"""Settings of reading and filtering logs, and transmissions from motor columns to joint columns."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, replace
from typing import Any, ClassVar

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.settings import (
    NOT_NEGATIVE,
    POSITIVE,
    Entries,
    Range,
    Settings,
    is_number,
    require_kind,
    setting,
)
from robotid.base.tolerances import SINGULAR
from robotid.base.typing import Array
from robotid.data.log import repeated

#: Number of each time unit in a second.
PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_HZ = Range("0.001 to 1e6", lambda x: 1e-3 <= x <= 1e6)
_MEASURED = ("auto", "measured", "differentiated")
_DELAY = Range("seconds between -1 and 1", lambda x: abs(x) <= 1)


def or_false(if_true: str) -> dict[str, Any]:
    """Return how a number is read that is None if a file states false; true is an error."""

    def load(value: float | bool) -> float | None:
        if value is True:
            raise SettingsError(if_true)
        return None if value is False else value

    def dump(value: float | None) -> float | bool:
        return False if value is None else value

    return {"reads": (int, float, bool), "load": load, "dump": dump}


@dataclass(frozen=True)
class SignalSettings(Settings):
    """Settings that convert a log to a trajectory."""

    rate: float | None = setting(
        None,
        "rate of the uniform grid [Hz]; default: the log's median rate (without a filter, "
        "the rows of the log)",
        within=_HZ,
    )
    cutoff: float | None = setting(
        8.0,
        "cut-off of the zero-phase Butterworth filter [Hz]; false for no filter",
        within=_HZ,
        **or_false("cutoff is true, expected a frequency [Hz], or false for no filter"),
    )
    order: int = setting(
        4,
        "order of the filter, which runs once forward and once backward",
        within=Range("1 to 10", lambda x: 1 <= x <= 10),
    )
    velocity: str = setting(
        "auto",
        "measured, differentiated (from the position), or auto: measured, if it agrees with the "
        "position, has sufficient resolution, and predicts the torque of held-out segments as well",
        among=_MEASURED,
    )
    acceleration: str = setting(
        "auto",
        "measured, differentiated (from the velocity), or auto: measured, if the log has it and "
        "its velocity is used",
        among=_MEASURED,
    )
    trim: float = setting(
        0.2, "time removed at each end of each segment without gaps [s]", within=NOT_NEGATIVE
    )
    min_velocity: float = setting(
        0.02,
        "joint speed below which a drive may be in stiction, so that rows are not used to identify "
        "Coulomb friction [rad/s]; the range of a prismatic joint (1 m if the URDF has none) "
        "counts as a full turn; 0 uses all rows",
        within=NOT_NEGATIVE,
    )
    friction_band: float = setting(
        0.0,
        "speed from which Coulomb friction has its full value [rad/s], for prismatic joints as in "
        "min_velocity; at lower speed it is linear; 0: it has the sign of the speed",
        within=Range("0, or 1e-9 or more", lambda x: x == 0 or x >= 1e-9),
    )
    max_gap: float | None = setting(
        None,
        "a longer time step is a gap [s]; default: 2.5 median steps, or a quarter of the "
        "filter's period if that is longer",
        within=POSITIVE,
    )
    torque_delay: float = setting(
        0.0,
        "delay of the logged torque relative to the position [s]; it is corrected",
        within=_DELAY,
    )
    velocity_delay: float = setting(
        0.0, "delay of the measured velocity relative to the position [s]", within=_DELAY
    )


@dataclass(frozen=True)
class LogUnits(Settings):
    """Units of a log file; SI by default, and an error if the numbers look like another unit."""

    _table: ClassVar[str] = "units"

    time: str | None = setting(
        None, "unit of the time stamps; velocities are per second", among=tuple(PER_SECOND)
    )
    angle: str | None = setting(
        None, "unit of q, dq and ddq of revolute joints", among=("rad", "deg")
    )
    percent: Mapping[str, Sequence[float]] = setting(
        {}, "joints logged from 0 to 100, such as grippers of LeRobot: the positions at 0 and at "
        "100 by joint [rad or m], such as { gripper = [-0.17, 1.75] }",
        reads=Entries(dict, (list,)),
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        require_kind(self.percent, Mapping, "percent", "a table of two positions by joint")
        for joint, ends in self.percent.items():
            is_pair = isinstance(ends, Sequence) and len(ends) == 2 and all(map(is_number, ends))
            if not is_pair or ends[0] == ends[1]:
                raise SettingsError(
                    f"units: percent of {joint} is {ends!r}, expected two different numbers, the "
                    "positions at 0 and at 100 [rad or m]"
                )

    def scale(self, joint: str, *, is_angle: bool) -> tuple[float, float]:
        """Return a and b of a joint's positions a + b x [rad or m], x the number in the log."""
        if joint in self.percent:
            first, last = self.percent[joint]
            return float(first), (last - first) / 100
        return 0.0, math.pi / 180 if is_angle and self.angle == "deg" else 1.0


@dataclass(frozen=True)
class LogSource(Settings):
    """Place of the signals in a log file; the defaults are for files with one log."""

    _table: ClassVar[str] = "log"

    topic: str | None = setting(
        None,
        "the topic of a bag, the group or struct of an HDF5, MAT or NPZ file, or the episode of "
        "a LeRobot dataset, such as episode_3; not needed if there is only one",
    )
    command: str | None = setting(
        None,
        "the topic of a bag with commanded joint states, if it is not the topic of the measured "
        "ones",
    )
    joints: Mapping[str, str] = setting({}, "name in the file by joint, if they differ")
    names: tuple[str, ...] = setting(
        (),
        "names of all columns in their order, of a file without a header or with other names",
        dump=lambda names: list(names) or None,
    )
    rate: float | None = setting(
        None, "rate of the rows of a log without time stamps [Hz]", within=_HZ
    )
    effort: str = setting(
        "torque",
        "quantity of effort columns: torque [N m or N], or current [A], which needs a gain",
        among=("torque", "current"),
    )
    stamp: str = setting(
        "header",
        "source of the time stamps: even (equal steps, for a recorder that stamps bunches of rows "
        "on arrival); for a bag also header (the stamp in the message) or log (the time of "
        "recording)",
        among=("header", "log", "even"),
    )
    sensors: tuple[str, ...] = setting(
        (),
        "the topics of a bag with odometry, IMU, wrenches or foot forces; default: all topics of "
        "these kinds",
        dump=lambda topics: list(topics) or None,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require_kind(self.joints, Mapping, "joints", "a table of names by joint")
        for name, topic in (("topic", self.topic), ("command", self.command)):
            require_kind(topic, (str, type(None)), name, "the name of a topic or group, or none")
        if len(set(self.names)) != len(self.names):
            raise SettingsError("log: names has a name twice; expected one for each column")
        for joint, name in self.joints.items():
            if not isinstance(name, str):
                raise SettingsError(f"log: joints.{joint} is {name!r}, expected a name")


@dataclass(frozen=True)
class BaseSource(Settings):
    """The motion of a floating base in a log file."""

    _table: ClassVar[str] = "base"

    twist: str = setting(
        "base",
        "axes of the velocities base_vx to base_wz: base (axes of the base link) or world",
        among=("base", "world"),
    )
    link: str | None = setting(
        None,
        "the link whose pose base_x to base_qw are; default: the root link. Velocities of another "
        "link are not read",
    )
    imu: str | None = setting(
        None,
        "the link of an IMU, fixed to the root link; its angular velocity and specific force, "
        "imu_wx to imu_az, are used instead of velocities and accelerations of the base, and its "
        "orientation, imu_qx to imu_qw, if the base has none",
    )


def _load_matrix(value: Any) -> Any:  # noqa: ANN401
    rows = (tuple(row) if isinstance(row, list) else row for row in value)
    return value if isinstance(value, str) else tuple(rows)


def _dump_matrix(value: Any) -> Any:  # noqa: ANN401
    rows = (list(row) if isinstance(row, tuple) else row for row in value)
    return value if isinstance(value, str) else list(rows)


@dataclass(frozen=True)
class Transmission(Settings):
    """Motors and joints: w = T v, q = T^-1 q_m + offset and tau = T^T (efficiency tau_m)."""

    _table: ClassVar[str] = "transmission"

    joints: tuple[str, ...] = setting(MISSING, "the joints that the motors drive, by name")
    matrix: Any = setting(
        MISSING,
        "angle of each motor per angle of each joint [-, or rad/m], a row per motor; or a list of "
        "gear ratios, if each motor drives one joint; or urdf: the joints' mechanicalReduction",
        reads=(list, str),
        load=_load_matrix,
        dump=_dump_matrix,
    )
    motors: tuple[str, ...] = setting(
        (), "names of the motors in the columns, one per joint; default: the joints' names"
    )
    efficiency: tuple[float, ...] = setting((), "efficiency of each motor's gear [-]; default: 1")
    offset: tuple[float, ...] = setting(
        (), "positions of the joints at motor position 0 [rad or m]; default: 0"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        count = len(self.joints)
        if not count:
            raise SettingsError("transmission: joints is empty, expected names of driven joints")
        for noun in ("joints", "motors"):
            if twice := repeated(getattr(self, noun)):
                raise SettingsError(
                    f"transmission: {noun} contains {listed(twice)} twice; name each once"
                )
        for key in ("motors", "efficiency", "offset"):
            if (given := len(getattr(self, key))) not in (0, count):
                raise SettingsError(
                    f"transmission of {listed(self.joints)}: {key} has {given} entries, expected "
                    f"{count}, one per joint"
                )
        for motor, share in zip(self.names, self.efficiency, strict=False):
            if not 0 < share <= 1:
                raise SettingsError(
                    f"transmission: efficiency of {motor!r} is {share:g}, expected more than 0 and "
                    "at most 1"
                )
        if not isinstance(self.matrix, str):
            self._check_matrix()
        elif self.matrix != "urdf":
            raise SettingsError(
                f"transmission: matrix is {self.matrix!r}, expected rows of numbers, a list of "
                "gear ratios, or 'urdf'"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the motors."""
        return self.motors or self.joints

    @property
    def T(self) -> Array:
        """Speeds of the motors over those of the joints, shape (n, n) [-, or rad/m]."""
        T = np.asarray(self.matrix, dtype=float)
        return np.diag(T) if T.ndim == 1 else T

    @property
    def shared(self) -> dict[str, tuple[tuple[str, float], ...]]:
        """Joints and ratios, over the largest, of each shared motor, by the joint in its place."""
        is_coupled = np.abs(self.T) > 0
        alone = is_coupled.sum(axis=1) == 1
        has_own = is_coupled[alone].any(axis=0)  # joints with a motor of their own
        places = [joint for joint, is_own in zip(self.joints, has_own, strict=True) if not is_own]
        shared = np.flatnonzero(~alone).tolist()
        return {
            place: tuple(
                (self.joints[j], float(self.T[i, j] / self._ratio(i)))
                for j in np.flatnonzero(is_coupled[i])
            )
            for i, place in zip(shared, places, strict=True)
        }

    @property
    def gears(self) -> dict[str, float]:
        """Gear ratio of each joint's drive, its largest ratio [-, or rad/m], by the joint."""
        places = iter(self.shared)
        alone = np.count_nonzero(self.T, axis=1) == 1
        return {
            self.joints[int(np.argmax(np.abs(row)))] if is_own else next(places): self._ratio(i)
            for i, (row, is_own) in enumerate(zip(self.T, alone, strict=True))
        }

    def _ratio(self, i: int) -> float:
        """Return the largest ratio of a motor [-, or rad/m]."""
        return float(self.T[i, np.argmax(np.abs(self.T[i]))])

    def stated(self, reductions: Mapping[str, float]) -> "Transmission":
        """Return the transmission with the gear ratios of the URDF, if its matrix is "urdf"."""
        if self.matrix != "urdf":
            return self
        if missing := [joint for joint in self.joints if joint not in reductions]:
            raise SettingsError(
                f"transmission: matrix is 'urdf', but the URDF has no <transmission> with a "
                f"<mechanicalReduction> only for {listed(missing)}; it has one for "
                f"{listed(reductions) or 'no joint'}. Set the gear ratios: matrix = [...]"
            )
        return replace(self, matrix=tuple(reductions[joint] for joint in self.joints))

    def _check_matrix(self) -> None:
        count, shown = len(self.joints), _dump_matrix(self.matrix)
        try:
            T = np.asarray(self.matrix, dtype=float)
        except (TypeError, ValueError):
            T = np.empty(0)
        if T.shape not in ((count,), (count, count)) or not (np.abs(T) <= 1e30).all():
            raise SettingsError(
                f"transmission of {listed(self.joints)}: matrix is {shown}, expected {count} rows "
                f"of {count} numbers, one row per motor, or {count} gear ratios"
            )
        size = np.linalg.norm(self.T, axis=1, keepdims=True)
        sizes = np.linalg.svd(self.T / np.where(size > 0, size, 1.0), compute_uv=False)
        if not sizes[-1] > SINGULAR * sizes[0]:
            raise SettingsError(
                f"transmission of {listed(self.joints)}: matrix {shown} is singular, expected "
                "linearly independent rows, one for each motor, as [0, 32, 32] for a motor with a "
                "ratio of 32 to each of the last two joints"
            )


def check_transmissions(
    transmissions: Sequence[Transmission], joints: Sequence[str] | None = None
) -> None:
    """Reject joints and motors that are in several transmissions, and joints that are not read."""
    driven = [joint for gear in transmissions for joint in gear.joints]
    motors = [motor for gear in transmissions for motor in gear.names]
    for noun, names in (("joints", driven), ("motors", motors)):
        if twice := repeated(names):
            raise SettingsError(
                f"several transmissions contain the {noun} {listed(twice)}; write coupled joints "
                "in one transmission, with a row of the matrix per motor"
            )
    if joints is not None and (others := [joint for joint in driven if joint not in joints]):
        raise SettingsError(
            f"transmission: {listed(others)} are not among the joints identified: "
            f"{listed(joints)}. Leave them and their motors out, or identify them"
        )
