"""Settings of a simulation: true parameters, controller, actuators, sensors and payload."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from robotid.base.exceptions import SettingsError
from robotid.base.files import read_toml
from robotid.base.findings import listed, suggestion
from robotid.base.settings import (
    NOT_NEGATIVE,
    POSITIVE,
    Range,
    Settings,
    check_keys,
    is_number,
    setting,
)
from robotid.base.typing import Array
from robotid.data.signal_settings import or_false

#: A number for every joint, or numbers by joint; other joints have the default.
PerJoint: TypeAlias = float | Mapping[str, float]

_SHARE = Range("0 to less than 1", lambda x: 0 <= x < 1)


def _are_within(values: Sequence[float], most: float) -> bool:
    return all(is_number(x) and abs(x) <= most for x in values)


def _all_of(is_right: Callable[[float], bool]) -> Callable[[PerJoint], bool]:
    """Return a check of a number, or of each number in a table."""

    def holds(value: PerJoint) -> bool:
        values = list(value.values()) if isinstance(value, Mapping) else [value]
        return all(is_number(x) and is_right(x) for x in values)

    return holds


def _per_joint(least: float, most: float, words: str) -> Mapping[str, Any]:
    """Return type and range of a setting that may be a table by joint."""
    check = _all_of(lambda x: least <= x <= most)
    within = Range(f"{words}: a number, or a table of numbers by joint", check)
    return {"reads": (int, float, dict), "within": within}


LEVEL = _per_joint(0.0, 1e12, "0 to 1e12")
GAIN = _per_joint(1e-9, 1e12, "1e-9 to 1e12")  # in any unit: squares do not overflow
DELAY = _per_joint(0.0, 1.0, "0 to 1 s")


@dataclass(frozen=True)
class Truth(Settings):
    """How the true robot differs from its URDF."""

    _table: ClassVar[str] = "truth"

    inertials: float = setting(
        0.1,
        "difference of the bodies from the URDF's: standard deviation of ten coordinates in the "
        "metric of pseudo-inertias, so that every draw is physically consistent; 0.1: masses "
        "differ by about 14 % [-]",
        within=Range("0 to 5", lambda x: 0 <= x <= 5),
    )
    drives: str = setting(
        "usual",
        "drive parameters: by default, each is drawn from the typical range of its term, scaled "
        "down for joints with an effort limit below 50 N m or N; 'none': all are 0",
        among=("usual", "none"),
    )
    values: Mapping[str, float] = setting(
        {}, 'given standard parameters, by name, for example "elbow.viscous" [SI units]'
    )


@dataclass(frozen=True)
class Controller(Settings):
    """The controller that tracks the motion; its model of the bodies is the URDF."""

    _table: ClassVar[str] = "controller"

    kind: str = setting(
        "feedforward",
        "feedforward: the URDF's inverse dynamics along the motion and PD; pd: PD alone; "
        "computed_torque: the URDF's inverse dynamics at the measured state; perfect: exact "
        "tracking, by the true inverse dynamics",
        among=("feedforward", "pd", "computed_torque", "perfect"),
    )
    bandwidth: float = setting(
        20.0,
        "bandwidth w of the default gains: kp = w^2 times the inertia of the joint, kd = 2 w times "
        "this inertia [rad/s]",
        within=Range("1e-3 to 1e6 rad/s", lambda x: 1e-3 <= x <= 1e6),
    )
    kp: PerJoint | None = setting(None, "position gain [N m/rad or N/m]", **GAIN)
    kd: PerJoint | None = setting(None, "speed gain [N m s/rad or N s/m]", **GAIN)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind in ("computed_torque", "perfect") and not (self.kp is self.kd is None):
            raise SettingsError(
                f"controller: kp and kd apply to kind pd or feedforward, not {self.kind}. Leave "
                "them out" + ("" if self.kind == "perfect" else ", or set bandwidth")
            )


@dataclass(frozen=True)
class Actuator(Settings):
    """Actuators: torque limits and elastic gears."""

    _table: ClassVar[str] = "actuator"

    effort: float | None = setting(
        None,
        "torque limit of each drive, relative to the URDF's effort limit; false: no limit",
        within=POSITIVE,
        **or_false(
            "effort is true, expected a factor of the URDF's effort limits, or false for no limits"
        ),
    )
    limits: Mapping[str, float] = setting(
        {},
        "torque limit of a drive, by joint, instead of the URDF's [N m or N]",
        within=Range("positive numbers by joint", _all_of(lambda x: x > 0)),
    )
    stiffness: PerJoint | None = setting(
        None, "stiffness of elastic gears [N m/rad or N/m]; default: rigid gears", **GAIN
    )
    damping: PerJoint = setting(0.0, "damping of elastic gears [N m s/rad or N s/m]", **LEVEL)
    backlash: PerJoint = setting(
        0.0, "backlash of elastic gears, from end to end [rad or m]", **LEVEL
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stiffness is None and (self.damping or self.backlash):
            what = "damping" if self.damping else "backlash"
            raise SettingsError(
                f"actuator: {what} applies only to elastic gears. Set their stiffness, for "
                "example stiffness = 2e4 [N m/rad]"
            )


@dataclass(frozen=True)
class Noise(Settings):
    """Standard deviations of white sensor noise; 0 for none."""

    _table: ClassVar[str] = "sensors.noise"

    q: PerJoint = setting(0.0, "noise of positions [rad or m]", **LEVEL)
    v: PerJoint = setting(0.0, "noise of velocities [rad/s or m/s]", **LEVEL)
    tau: PerJoint = setting(
        0.0, "noise of torques, relative to the joint's RMS torque [-]", **LEVEL
    )
    torque: PerJoint = setting(0.0, "further noise of torques, absolute [N m or N]", **LEVEL)


@dataclass(frozen=True)
class Steps(Settings):
    """Resolutions of the sensors; 0: exact."""

    _table: ClassVar[str] = "sensors.step"

    q: PerJoint = setting(0.0, "resolution of positions [rad or m]", **LEVEL)
    v: PerJoint = setting(0.0, "resolution of velocities [rad/s or m/s]", **LEVEL)
    tau: PerJoint = setting(0.0, "resolution of torques [N m or N]", **LEVEL)


@dataclass(frozen=True)
class Sensors(Settings):
    """Logged signals and sensor errors."""

    _table: ClassVar[str] = "sensors"

    velocity: bool = setting(True, "whether velocities are logged")
    acceleration: bool = setting(False, "whether accelerations are logged, without noise")
    side: str = setting(
        "motor",
        "side of an elastic gear on which position, velocity and torque are logged: motor or joint",
        among=("motor", "joint"),
    )
    noise: Noise = setting(Noise(), "white noise")
    step: Steps = setting(Steps(), "resolution; readings with noise are rounded to it")
    torque_delay: float = setting(0.0, "delay of logged torques [s]", within=NOT_NEGATIVE)
    velocity_delay: float = setting(0.0, "delay of logged velocities [s]", within=NOT_NEGATIVE)
    jitter: float = setting(
        0.0,
        "jitter: standard deviation of the time stamps about the sample times [s]",
        within=NOT_NEGATIVE,
    )
    dropped: float = setting(0.0, "share of samples dropped at random [-]", within=_SHARE)


@dataclass(frozen=True)
class Payload(Settings):
    """A payload on a link that is not in the URDF, from a time on."""

    _table: ClassVar[str] = "payload"

    link: str = setting("", "name of the link; default: the last moving link")
    mass: float = setting(
        0.0, "mass [kg]; 0: no payload", within=Range("0 to 1e9 kg", lambda x: 0 <= x <= 1e9)
    )
    com: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        "centre of mass in the link's frame [m]",
        within=Range("three numbers within 1e3 m", lambda x: len(x) == 3 and _are_within(x, 1e3)),
    )
    inertia: tuple[float, ...] = setting(
        (0.0,) * 6,
        "Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the centre of mass, along the link's axes [kg m^2]",
        within=Range("six numbers within 1e9", lambda x: len(x) == 6 and _are_within(x, 1e9)),
    )
    start: float = setting(0.0, "time at which it is attached [s]", within=NOT_NEGATIVE)


@dataclass(frozen=True)
class Simulation(Settings):
    """Settings of a simulated log, in addition to robot and motion."""

    seed: int = setting(
        0, "seed of true parameters, noise and dropped samples", within=NOT_NEGATIVE
    )
    rate: float = setting(
        1000.0, "rate of the log [Hz]", within=Range("1e-3 to 1e5", lambda x: 1e-3 <= x <= 1e5)
    )
    duration: float | None = setting(
        None, "length of the log [s]; default: the length of the motion", within=POSITIVE
    )
    truth: Truth = setting(Truth(), "differences of the true robot from its URDF")
    controller: Controller = setting(Controller(), "controller that tracks the motion")
    actuator: Actuator = setting(Actuator(), "torque limits and elastic gears")
    sensors: Sensors = setting(Sensors(), "logged signals and sensor errors")
    payload: Payload = setting(Payload(), "payload that is not in the URDF")

    def __post_init__(self) -> None:
        super().__post_init__()
        is_limited = self.actuator.effort is not None or bool(self.actuator.limits)
        is_ideal = self.actuator.stiffness is None and not is_limited
        if self.controller.kind == "perfect" and not is_ideal:
            raise SettingsError(
                "controller: kind is perfect, which has no limits and no elastic gears. Leave out "
                "[actuator], or set kind to feedforward, pd or computed_torque"
            )


def by_joint(
    value: PerJoint | None, joints: Sequence[str], name: str, other: ArrayLike = 0.0
) -> Array:
    """Return a setting of each joint, shape (n,): other if it is not given."""
    if not isinstance(value, Mapping):
        return np.array(np.broadcast_to(other if value is None else value, len(joints)), float)
    for joint in value:
        if joint not in joints:
            raise SettingsError(
                f"{name} is given for {joint!r}, which is not a moving joint: "
                f"{listed(joints)}{suggestion(joint, joints)}"
            )
    others = zip(joints, np.broadcast_to(other, len(joints)), strict=True)
    return np.array([float(value.get(joint, x)) for joint, x in others])


def read_simulation(
    path: str | Path | None, given: Mapping[str, Any]
) -> tuple[Simulation, dict[str, Any]]:
    """Return the settings in a TOML file, and its table of further drive terms by joint."""
    table = {} if path is None else read_toml(Path(path), "file of a plant")
    where = "command line" if path is None else Path(path).name
    schema = Simulation.schema() | {"drives": (dict,)}
    check_keys(table, schema, where)
    check_keys(given, schema, "command line")
    try:
        return Simulation.from_dict(_over(table, given)), table.get("drives", {})
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error


def _over(table: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table with entries replaced by those of another one, nested tables likewise."""
    merged = dict(table)
    for key, value in given.items():
        inside = merged.get(key, {})
        merged[key] = _over(inside, value) if isinstance(value, Mapping) else value
    return merged
