"""What a simulated robot is, how it is driven, and what its sensors do: the settings, checked."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import numpy as np

from robotid._files import missing_file
from robotid._settings import NOT_NEGATIVE, POSITIVE, Range, Settings, check_keys, setting
from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.findings import listed
from robotid.logs.data import suggestion

__all__ = [
    "DELAY",
    "GAIN",
    "LEVEL",
    "Actuator",
    "Controller",
    "Noise",
    "Payload",
    "PerJoint",
    "Sensors",
    "Simulation",
    "Truth",
    "by_joint",
    "read_simulation",
]

#: A number for every joint, or one by joint; joints that are not named have none.
PerJoint: TypeAlias = float | Mapping[str, float]

_SHARE = Range("0 to less than 1", lambda x: 0 <= x < 1)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _are_within(values: Sequence[float], most: float) -> bool:
    return all(_is_number(x) and abs(x) <= most for x in values)


def _all_of(is_right: Any) -> Any:  # noqa: ANN401
    """Return whether a number, or each of a table of numbers, is right."""

    def holds(value: PerJoint) -> bool:
        values = list(value.values()) if isinstance(value, Mapping) else [value]
        return all(_is_number(x) and is_right(x) for x in values)

    return holds


_NUMBERS = "a number, or a table of numbers by joint"
_LEAST, _LARGEST = 1e-9, 1e12  # of gains, in any unit: their squares are numbers, too
_LONGEST = 1.0  # [s] of delays
LEVEL: Mapping[str, Any] = {
    "reads": (int, float, dict),
    "within": Range(f"0 to 1e12: {_NUMBERS}", _all_of(lambda x: 0 <= x <= _LARGEST)),
}
GAIN: Mapping[str, Any] = {
    "reads": (int, float, dict),
    "within": Range(f"1e-9 to 1e12: {_NUMBERS}", _all_of(lambda x: _LEAST <= x <= _LARGEST)),
}
DELAY: Mapping[str, Any] = {
    "reads": (int, float, dict),
    "within": Range(f"0 to 1 s: {_NUMBERS}", _all_of(lambda x: 0 <= x <= _LONGEST)),
}


def _effort_from(value: float | bool) -> float | None:
    if value is True:
        raise SettingsError("effort is true, wanted times of the URDF's limits, or false for none")
    return None if value is False else value


@dataclass(frozen=True)
class Truth(Settings):
    """How the true robot differs from its URDF."""

    _table: ClassVar[str] = "truth"

    inertials: float = setting(
        0.1,
        "how far each body is from the URDF's: standard deviation along each of ten directions in "
        "the metric of pseudo-inertias, so that every draw is a possible body; 0.1: masses differ "
        "by about 14 % [-]",
        within=Range("0 to 5", lambda x: 0 <= x <= 5),
    )
    drives: str = setting(
        "usual",
        "usual: each drive parameter is drawn from its term's usual range, scaled down for joints "
        "of less than 50 N m or N; none: all are 0",
        among=("usual", "none"),
    )
    values: Mapping[str, float] = setting(
        {}, 'standard parameters that are stated instead, by name, as "elbow.viscous" [SI]'
    )


@dataclass(frozen=True)
class Controller(Settings):
    """What makes the robot follow the motion; of its bodies it knows what the URDF says."""

    _table: ClassVar[str] = "controller"

    kind: str = setting(
        "feedforward",
        "feedforward: the URDF's inverse dynamics along the motion and PD; pd: PD alone; "
        "computed_torque: the URDF's inverse dynamics of the state; perfect: the robot follows "
        "exactly, by its true inverse dynamics",
        among=("feedforward", "pd", "computed_torque", "perfect"),
    )
    bandwidth: float = setting(
        20.0,
        "w of the error's w^2 e + 2 w de/dt, which makes the gains that are not stated, times the "
        "inertia of the joint [rad/s]",
        within=Range("1e-3 to 1e6 rad/s", lambda x: 1e-3 <= x <= 1e6),
    )
    kp: PerJoint | None = setting(None, "torque per error [N m/rad or N/m]", **GAIN)
    kd: PerJoint | None = setting(None, "torque per speed's error [N m s/rad or N s/m]", **GAIN)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind in ("computed_torque", "perfect") and not (self.kp is self.kd is None):
            raise SettingsError(
                f"controller: kp and kd are for kind pd or feedforward, not {self.kind}; leave "
                "them out" + ("" if self.kind == "perfect" else ", or state bandwidth")
            )


@dataclass(frozen=True)
class Actuator(Settings):
    """What is between the controller and the joints."""

    _table: ClassVar[str] = "actuator"

    effort: float | None = setting(
        None,
        "times the URDF's effort limit that each drive can give; false (None in Python): any",
        within=POSITIVE,
        reads=(int, float, bool),
        load=_effort_from,
        dump=lambda value: False if value is None else value,
    )
    limits: Mapping[str, float] = setting(
        {},
        "the most torque that a drive gives, by joint, instead of the URDF's [N m or N]",
        within=Range("positive numbers by joint", _all_of(lambda x: x > 0)),
    )
    stiffness: PerJoint | None = setting(
        None, "of elastic gears [N m/rad or N/m]; rigid if not stated", **GAIN
    )
    damping: PerJoint = setting(0.0, "of elastic gears [N m s/rad or N s/m]", **LEVEL)
    backlash: PerJoint = setting(0.0, "play of elastic gears, from end to end [rad or m]", **LEVEL)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stiffness is None and (self.damping or self.backlash):
            what = "damping" if self.damping else "backlash"
            raise SettingsError(
                f"actuator: {what} is of elastic gears; state their stiffness too, as "
                "stiffness = 2e4 [N m/rad]"
            )

    @property
    def is_elastic(self) -> bool:
        """Whether motors and joints have positions of their own."""
        return self.stiffness is not None


@dataclass(frozen=True)
class Noise(Settings):
    """Standard deviations of white sensor noise; 0 for none."""

    _table: ClassVar[str] = "sensors.noise"

    q: PerJoint = setting(0.0, "of positions [rad or m]", **LEVEL)
    v: PerJoint = setting(0.0, "of velocities [rad/s or m/s]", **LEVEL)
    tau: PerJoint = setting(
        0.0, "of torques, share of the joint's root mean square torque [-]", **LEVEL
    )
    torque: PerJoint = setting(0.0, "of torques, beside that share [N m or N]", **LEVEL)


@dataclass(frozen=True)
class Steps(Settings):
    """Smallest steps that sensors show; 0 for none."""

    _table: ClassVar[str] = "sensors.step"

    q: PerJoint = setting(0.0, "of positions [rad or m]", **LEVEL)
    v: PerJoint = setting(0.0, "of velocities [rad/s or m/s]", **LEVEL)
    tau: PerJoint = setting(0.0, "of torques [N m or N]", **LEVEL)


@dataclass(frozen=True)
class Sensors(Settings):
    """What is logged, and what is wrong with it."""

    _table: ClassVar[str] = "sensors"

    velocity: bool = setting(True, "whether velocities are logged")
    acceleration: bool = setting(False, "whether accelerations are logged, without noise")
    side: str = setting(
        "motor",
        "of an elastic gear, whose position, velocity and torque are logged: motor, or joint",
        among=("motor", "joint"),
    )
    noise: Noise = setting(Noise(), "white noise")
    step: Steps = setting(Steps(), "resolution; readings are rounded to it, noise included")
    torque_delay: float = setting(0.0, "delay of logged torques [s]", within=NOT_NEGATIVE)
    velocity_delay: float = setting(0.0, "delay of logged velocities [s]", within=NOT_NEGATIVE)
    jitter: float = setting(
        0.0,
        "standard deviation of the time stamps about the times of the samples [s]",
        within=NOT_NEGATIVE,
    )
    dropped: float = setting(0.0, "share of samples that the log lacks, at random", within=_SHARE)


@dataclass(frozen=True)
class Payload(Settings):
    """A load that the URDF does not know and that hangs on a link, from a time on."""

    _table: ClassVar[str] = "payload"

    link: str = setting("", "name of the link; the last moving one if not stated")
    mass: float = setting(
        0.0,
        "its mass [kg]; 0: no payload",
        within=Range("0 to 1e9 kg", lambda x: 0 <= x <= 1e9),
    )
    com: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        "its centre of mass in the link's frame [m]",
        within=Range("three numbers within 1e3 m", lambda x: len(x) == 3 and _are_within(x, 1e3)),
    )
    inertia: tuple[float, ...] = setting(
        (0.0,) * 6,
        "Ixx, Ixy, Iyy, Ixz, Iyz, Izz about its centre of mass, along the link's axes [kg m^2]",
        within=Range("six numbers within 1e9", lambda x: len(x) == 6 and _are_within(x, 1e9)),
    )
    start: float = setting(0.0, "when it is taken up [s]", within=NOT_NEGATIVE)


@dataclass(frozen=True)
class Simulation(Settings):
    """All that a simulated log is made from, beside robot and motion."""

    seed: int = setting(0, "of the truth, the noise, and what is dropped", within=NOT_NEGATIVE)
    rate: float = setting(
        1000.0, "rate of the log [Hz]", within=Range("1e-3 to 1e5", lambda x: 1e-3 <= x <= 1e5)
    )
    duration: float | None = setting(
        None, "length of the log [s]; that of the motion if not stated", within=POSITIVE
    )
    truth: Truth = setting(Truth(), "how the true robot differs from its URDF")
    controller: Controller = setting(Controller(), "what makes the robot follow the motion")
    actuator: Actuator = setting(Actuator(), "what is between the controller and the joints")
    sensors: Sensors = setting(Sensors(), "what is logged, and what is wrong with it")
    payload: Payload = setting(Payload(), "a load that the URDF does not know")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.controller.kind == "perfect" and (
            self.actuator.is_elastic or self.actuator.effort is not None or self.actuator.limits
        ):
            raise SettingsError(
                "controller: kind is perfect, which knows no limits and no elastic gears; leave "
                "out [actuator], or choose feedforward, pd or computed_torque"
            )


def by_joint(value: PerJoint | None, joints: Sequence[str], name: str, other: float = 0.0) -> Array:
    """Return a setting of each joint, shape (n,).

    Args:
        value: A number for all, or numbers by joint; None: the other.
        joints: Names of the n joints.
        name: Name of the setting, for errors.
        other: What joints have that are not named.

    Raises:
        SettingsError: If a joint is named that is not there.
    """
    if not isinstance(value, Mapping):
        return np.full(len(joints), other if value is None else float(value))
    for joint in value:
        if joint not in joints:
            raise SettingsError(
                f"{name} is stated for {joint!r}, which is not among the joints that move: "
                f"{listed(joints)}{suggestion(joint, joints)}"
            )
    return np.array([float(value.get(joint, other)) for joint in joints])


def read_simulation(
    path: str | Path | None, given: Mapping[str, Any]
) -> tuple[Simulation, dict[str, Any]]:
    """Return the settings in a TOML file, and its table of further drive terms by joint.

    Args:
        path: The file; ``drives`` in it is that of a job file. None: all is as usual.
        given: Settings that stand over those of the file, in its shape.

    Raises:
        SettingsError: If the file is missing, is no TOML, or a key or a value is wrong.
    """
    table: dict[str, Any] = {}
    if path is not None:
        if not Path(path).is_file():
            raise SettingsError(missing_file(Path(path), "file of a plant"))
        try:
            table = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
        except (ValueError, RecursionError) as error:
            raise SettingsError(f"{Path(path).name} is not valid TOML: {error}") from error
    where = "command line" if path is None else Path(path).name
    schema = Simulation.schema() | {"drives": (dict,)}
    check_keys(table, schema, where)
    check_keys(given, schema, "command line")
    try:
        return Simulation.from_dict(_over(table, given)), table.get("drives", {})
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error


def _over(table: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table with others' entries in the place of its own, tables inside it likewise."""
    merged = dict(table)
    for key, value in given.items():
        inside = merged.get(key, {})
        merged[key] = _over(inside, value) if isinstance(value, Mapping) else value
    return merged
