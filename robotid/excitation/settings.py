"""What motion is wanted: the settings of ``robotid excite``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from robotid._settings import Range, Settings, setting
from robotid.exceptions import SettingsError
from robotid.simulation.settings import Payload

__all__ = ["FARTHEST", "ROUTES", "MotionSettings"]

#: Kinds of motion that go from place to place.
ROUTES = ("sweeps", "stands")
#: [m] Distance within which things stand around a robot.
FARTHEST = 1e3
_SIZES = 1e-9, 1e12  # of limits and noise, in any unit


def _from(least: float, most: float, unit: str = "") -> Range:
    return Range(f"{least:g} to {most:g}{unit}", lambda x: least <= x <= most)


_PLACE = Range(f"at most {FARTHEST:g} m", lambda x: abs(x) <= FARTHEST)


@dataclass(frozen=True)
class MotionSettings(Settings):
    """What motion is wanted."""

    kind: str = setting(
        "fourier",
        "of motion: sweeps show friction, stands gravity, payload what hangs on a link; default: "
        "fourier",
        among=("fourier", "bspline", "payload", *ROUTES),
    )
    duration: float = setting(
        10.0, "length [s]; sweeps and stands take what they need", within=_from(0.1, 3600.0, " s")
    )
    harmonics: int = setting(
        5, "of the series; B-splines have twice as many pieces", within=_from(2, 100)
    )
    criterion: str | None = setting(
        None,
        "of the information: D (volume), A (mean), E (weakest), condition, or widest (the quarter "
        "that RESULT knows the least); default: widest with --given, else D",
        among=("D", "A", "E", "condition", "widest"),
    )
    share: float = setting(0.9, "of the URDF's limits", within=_from(1e-3, 1.0, " of the limits"))
    acceleration: Mapping[str, float] = setting(
        {}, "largest acceleration of a joint [rad/s^2 or m/s^2]"
    )
    jerk: Mapping[str, float] = setting({}, "largest jerk of a joint [rad/s^3 or m/s^3]")
    power: Mapping[str, float] = setting({}, "largest power of a joint [W]")
    clearance: float | None = setting(
        0.02, "distance kept from collisions [m], or none to leave them unlooked at", within=_PLACE
    )
    floor: float | None = setting(
        None, "height of the floor in the root link's frame [m]", within=_PLACE
    )
    boxes: Sequence[Any] = setting(
        (), "a box beside the robot, from its lower to its upper corner [m]"
    )
    noise: Mapping[str, float] = setting({}, "standard deviation of a joint's torque [N m or N]")
    seed: int = setting(
        0,
        "of the random starts",
        within=Range("0 or a positive whole number", lambda x: 0 <= x < 2**63),
    )
    starts: int = setting(3, "random starts that are followed to the end", within=_from(1, 1000))
    seconds: float = setting(
        float("inf"),
        "time after which the best so far is taken [s]",
        within=Range("0.001 or more s", lambda x: x >= 1e-3),
    )
    points: float = setting(
        100.0, "rows per second that are written", within=_from(0.1, 1e5, " rows per second")
    )
    payload: Payload = setting(Payload(), "what hangs on which link, as far as it is known")
    moving: Sequence[str] = setting(
        (), "joints that move for a payload, by comma; default: the fewest that suffice"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("acceleration", "jerk", "power", "noise"):
            for joint, value in getattr(self, name).items():
                if not _SIZES[0] <= value <= _SIZES[1]:
                    raise SettingsError(
                        f"{name} of {joint!r} is {value:g}, wanted {_SIZES[0]:g} to {_SIZES[1]:g}"
                    )
        if self.kind != "payload" and (self.moving or self.payload != Payload()):
            raise SettingsError(
                f"a payload or joints that move are stated, but kind is {self.kind!r}; wanted "
                "payload"
            )
