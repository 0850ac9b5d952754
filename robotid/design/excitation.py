"""The settings of ``robotid excite``, and the files that it writes.

Motions are tables like logs, ROS 2 trajectories and URScript programs.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.files import write_text
from robotid.base.settings import SIZE, Range, Settings, setting
from robotid.base.text import yaml_name
from robotid.base.typing import Array
from robotid.data.files.read import check_suffix, write_columns
from robotid.design.information import CRITERIA
from robotid.dynamics.simulation.motions import Motion

#: Kinds of motion from posture to posture.
ROUTES = ("sweeps", "stands")
#: [m] Largest coordinate of an obstacle.
FARTHEST = 1e3
_UR_JOINTS = 6
_UR_STEP = 0.008  # [s] of servoj on every UR
_SETTLES = 1.0  # [s] at rest at the first posture


def _from(least: float, most: float, unit: str = "") -> Range:
    return Range(f"{least:g} to {most:g}{unit}", lambda x: least <= x <= most)


_PLACE = Range(f"at most {FARTHEST:g} m", lambda x: abs(x) <= FARTHEST)


@dataclass(frozen=True)
class MotionSettings(Settings):
    """Kind, criterion and constraints of the motion."""

    kind: str = setting(
        "fourier", "kind of motion: sweeps for friction, stands for gravity; default: fourier",
        among=("fourier", *ROUTES),
    )  # fmt: skip
    duration: float = setting(
        10.0, "length [s] of a fourier motion", within=_from(0.1, 3600.0, " s")
    )
    harmonics: int = setting(5, "harmonics of the Fourier series", within=_from(2, 100))
    criterion: str | None = setting(
        None,
        "optimality criterion: D (determinant of the information), A (mean variance), E (smallest "
        "eigenvalue), or widest (the quarter of the parameters with the largest variance in "
        "RESULT); default: widest with --given, else D",
        among=CRITERIA,
    )
    share: float = setting(
        0.9, "usable share of the URDF's limits", within=_from(1e-3, 1.0, " of the limits")
    )
    velocity: Mapping[str, float] = setting(
        {}, "largest velocity of a joint whose URDF has none, or a lower one [rad/s or m/s]"
    )
    torque: Mapping[str, float] = setting({}, "largest torque of a joint, likewise [N m or N]")
    acceleration: Mapping[str, float] = setting(
        {}, "largest acceleration of a joint [rad/s^2 or m/s^2]"
    )
    jerk: Mapping[str, float] = setting({}, "largest jerk of a joint [rad/s^3 or m/s^3]")
    power: Mapping[str, float] = setting({}, "largest power of a joint [W]")
    clearance: float | None = setting(
        0.02, "smallest distance to a collision [m]; none: no collision check", within=_PLACE
    )
    floor: float | None = setting(
        None, "height of the floor in the root link's frame [m]", within=_PLACE
    )
    boxes: Sequence[Any] = setting((), "obstacle: a box, from its lower to its upper corner [m]")
    noise: Mapping[str, float] = setting({}, "standard deviation of a joint's torque [N m or N]")
    seed: int = setting(
        0, "seed of the random starts",
        within=Range("0 or a positive whole number", lambda x: 0 <= x < 2**63),
    )  # fmt: skip
    starts: int = setting(3, "random starts of the optimisation", within=_from(1, 1000))
    seconds: float = setting(
        float("inf"),
        "limit of the computing time [s]; the best motion found by then is written",
        within=Range("0.001 or more s", lambda x: x >= 1e-3),
    )
    points: float = setting(
        100.0, "rows per second of the file", within=_from(0.1, 1e5, " rows per second")
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.clearance is None and (self.boxes or self.floor is not None):
            raise SettingsError(
                "clearance is none, expected metres: a floor or a box is given. Set a clearance, "
                "or remove floor and boxes"
            )
        for name in ("velocity", "torque", "acceleration", "jerk", "power", "noise"):
            for joint, value in getattr(self, name).items():
                if not SIZE.holds(value):
                    raise SettingsError(f"{name} of {joint!r} is {value:g}, expected {SIZE.words}")


def check_motion_file(target: str | Path) -> None:
    """Refuse an unknown format of motion files before a design is computed."""
    if Path(target).suffix not in (".yaml", ".script"):
        check_suffix(Path(target), "motions", also=(".yaml", ".script"))


def write_motion(
    motion: Motion, joints: Sequence[str], duration: float, rate: float, target: str | Path
) -> Path:
    """Write a motion: .csv or .parquet as a log, .yaml for ROS 2, .script for Universal Robots."""
    path = Path(target)
    if not 0 < rate < np.inf:
        raise SettingsError(f"rate is {rate:g}, expected a positive number of rows per second")
    texts: Mapping[str, Callable[..., Iterator[str]]] = {".yaml": _ros, ".script": _ur}
    if path.suffix == ".script":
        rate = 1.0 / _UR_STEP
    t = np.arange(round(duration * rate) + 1) / rate
    q, v, a = motion.evaluate(np.minimum(t, duration))
    if path.suffix in texts:
        return write_text("\n".join(texts[path.suffix](joints, t, q, v, a)) + "\n", path)
    table = {"time": t}
    for kind, values in (("q", q), ("dq", v), ("ddq", a)):
        table |= {f"{kind}_{joint}": x for joint, x in zip(joints, values.T, strict=True)}
    write_columns(table, path)
    return path


def _ros(joints: Sequence[str], t: Array, q: Array, v: Array, a: Array) -> Iterator[str]:
    """Yield the lines of a trajectory_msgs/JointTrajectory."""
    yield f"joint_names: [{', '.join(map(yaml_name, joints))}]"
    yield "points:"
    for time, *state in zip(t, q, v, a, strict=True):
        seconds, nanoseconds = divmod(round(time * 1e9), 10**9)
        names = ("positions", "velocities", "accelerations")
        for k, (name, values) in enumerate(zip(names, state, strict=True)):
            yield f"{'  ' if k else '- '}{name}: [{_numbers(values)}]"
        yield f"  time_from_start: {{sec: {seconds}, nanosec: {nanoseconds}}}"


def _ur(joints: Sequence[str], t: Array, q: Array, v: Array, a: Array) -> Iterator[str]:
    """Yield the lines of a URScript program."""
    if len(joints) != _UR_JOINTS:
        raise SettingsError(
            f"a .script is for Universal Robots: this robot has {len(joints)} joints, expected "
            f"{_UR_JOINTS}; write .csv, .parquet or .yaml"
        )
    yield "def excitation():"
    yield f"  movej([{_numbers(q[0])}], a=0.5, v=0.5)"
    yield f"  sleep({_SETTLES})"
    for row in q:
        yield f"  servoj([{_numbers(row)}], t={_UR_STEP}, lookahead_time=0.1, gain=300)"
    yield "  stopj(2.0)"
    yield "end"
    yield "excitation()"


def _numbers(values: Array) -> str:
    return ", ".join(f"{x:.6f}" for x in values)
