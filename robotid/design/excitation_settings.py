"""The settings of ``robotid excite``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from robotid.base.exceptions import SettingsError
from robotid.base.settings import SIZE, Range, Settings, setting

#: Kinds of motion from posture to posture.
ROUTES = ("sweeps", "stands")
#: [m] Largest coordinate of an obstacle.
FARTHEST = 1e3


def _from(least: float, most: float, unit: str = "") -> Range:
    return Range(f"{least:g} to {most:g}{unit}", lambda x: least <= x <= most)


_PLACE = Range(f"at most {FARTHEST:g} m", lambda x: abs(x) <= FARTHEST)


@dataclass(frozen=True)
class MotionSettings(Settings):
    """Kind, criterion and constraints of the motion."""

    kind: str = setting(
        "fourier",
        "kind of motion: sweeps for friction, stands for gravity; default: fourier",
        among=("fourier", "bspline", *ROUTES),
    )
    duration: float = setting(
        10.0, "length [s] of fourier and bspline motions", within=_from(0.1, 3600.0, " s")
    )
    harmonics: int = setting(
        5,
        "harmonics of the Fourier series; B-splines have twice as many pieces",
        within=_from(2, 100),
    )
    criterion: str | None = setting(
        None,
        "optimality criterion: D (determinant of the information), A (mean variance), E (smallest "
        "eigenvalue), condition (number), or widest (the quarter of the parameters with the "
        "largest variance in RESULT); default: widest with --given, else D",
        among=("D", "A", "E", "condition", "widest"),
    )
    share: float = setting(
        0.9, "usable share of the URDF's limits", within=_from(1e-3, 1.0, " of the limits")
    )
    velocity: Mapping[str, float] = setting(
        {}, "largest velocity of a joint whose URDF states none, or a lower one [rad/s or m/s]"
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
        0,
        "seed of the random starts",
        within=Range("0 or a positive whole number", lambda x: 0 <= x < 2**63),
    )
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
        for name in ("velocity", "torque", "acceleration", "jerk", "power", "noise"):
            for joint, value in getattr(self, name).items():
                if not SIZE.holds(value):
                    raise SettingsError(f"{name} of {joint!r} is {value:g}, wanted {SIZE.words}")
