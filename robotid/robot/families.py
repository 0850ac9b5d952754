"""Families of drive terms, which the friction of joints is chosen from, and their shapes."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from robotid._settings import require_kind
from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.findings import listed, toml_key
from robotid.robot.drives import (
    Asymmetric,
    Cubic,
    DriveTerm,
    Harmonic,
    Hat,
    Lag,
    LoadFriction,
    LuGre,
    PositionCoulomb,
    Power,
    Presliding,
    Ramp,
    Spring,
    Stribeck,
    Tanh,
)

__all__ = [
    "AUTO",
    "COUNTERBALANCE",
    "FAMILIES",
    "Family",
    "Seen",
    "Shape",
    "drive_line",
    "has_turned",
    "spring_family",
    "wanted_families",
]

#: What ``friction`` says to have the families of each joint chosen.
AUTO = "auto"
#: Family of a counterbalance that opposes gravity.
COUNTERBALANCE = "harmonics1"
_OF_MODEL = ("none", "viscous", "coulomb")  # named in ``friction``, and terms of the model

#: Ranges of position "q" and of the size of speed "v" that a fit has seen.
Seen = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Shape:
    """A shape parameter that terms are not linear in.

    Attributes:
        name: Field of the terms that holds it.
        units: Its unit for a drive that turns, and for one that slides.
        bounds: Where it is sought, in units of what it is measured by.
        of: What it is measured by: "v", the largest speed seen, "q", the range seen; "": itself.
    """

    name: str
    units: tuple[str, str]
    bounds: tuple[float, float]
    of: str = ""

    def within(self, seen: Seen) -> tuple[float, float]:
        """Return the bounds in the shape's own unit.

        Args:
            seen: Ranges of position "q" and of the size of speed "v" that the fit has seen.
        """
        low, high = self.bounds
        if not self.of:
            return low, high
        first, last = seen[self.of]
        scale = last if self.of == "v" else last - first
        return low * scale, high * scale


@dataclass(frozen=True)
class Family:
    """Terms that come together, with the shape that they share.

    Attributes:
        name: Its name in a job's ``friction``.
        meaning: What it is, in words of a finding.
        make: Returns the terms of the ranges seen and of a shape.
        shapes: Its shape parameters.
        needs: What the motion must have seen of the position, in full turns; 0: anything.
        is_automatic: Whether ``friction = "auto"`` tries it.
    """

    name: str
    meaning: str
    make: Callable[..., tuple[DriveTerm, ...]]
    shapes: tuple[Shape, ...] = ()
    needs: float = 0.0
    is_automatic: bool = False


_SPEED = Shape("speed", ("rad/s", "m/s"), (0.005, 0.5), "v")
_RISE = Shape("speed", ("rad/s", "m/s"), (0.005, 1.0), "v")
_WAY = Shape("displacement", ("rad", "m"), (0.0005, 0.015), "q")
_KNOTS = 4  # of a piecewise-linear curve of friction
_SPARE = 1.1  # times what a family needs of the position, from which it is advised
_TABLE = 8  # entries of a tabulated spring


def _curve(seen: Seen) -> tuple[DriveTerm, ...]:
    """Return the rises of a monotone curve over the speeds seen, closer together at low speed."""
    knots = seen["v"][1] * np.linspace(0.0, 1.0, _KNOTS + 1) ** 2
    return tuple(Ramp(number=k, low=a, high=b) for k, (a, b) in enumerate(_pairs(knots), start=1))


def _pairs(knots: Array) -> list[tuple[float, float]]:
    return list(pairwise(knots.tolist()))


def _table(seen: Seen) -> tuple[DriveTerm, ...]:
    """Return the entries of a tabulated spring but the middle one, which is the offset's."""
    knots = np.linspace(*seen["q"], _TABLE + 1).tolist()
    step = knots[1] - knots[0]
    return tuple(
        Hat(seen=seen["q"], number=k, at=x, before=x - step, after=x + step)
        for k, x in enumerate(knots, start=1)
        if k != _TABLE // 2 + 1
    )


def _harmonics(highest: int) -> Callable[[Seen], tuple[DriveTerm, ...]]:
    def make(seen: Seen) -> tuple[DriveTerm, ...]:
        return tuple(
            Harmonic(seen=seen["q"], order=float(k), is_sine=is_sine)
            for k in range(1, highest + 1)
            for is_sine in (False, True)
        )

    return make


def _once_a_turn() -> tuple[DriveTerm, ...]:
    """Return cosine and sine of the position: gravity has a part of them, beyond the range, too."""
    return (Harmonic(), Harmonic(is_sine=True))


def _by_position(seen: Seen) -> tuple[DriveTerm, ...]:
    centre = 0.5 * (seen["q"][0] + seen["q"][1])
    return tuple(PositionCoulomb(seen=seen["q"], order=k, centre=centre) for k in (1, 2))


#: What a job's ``friction`` may name beside viscous and Coulomb friction, by name.
FAMILIES: dict[str, Family] = {
    family.name: family
    for family in (
        Family("load", "friction that grows with the load", lambda seen: (LoadFriction(),),
               is_automatic=True),
        Family("stribeck", "friction that changes with speed and levels off",
               lambda seen, speed: (Stribeck(seen=seen["v"], speed=speed),), (_SPEED,),
               is_automatic=True),
        Family("tanh", "friction that sets in with speed",
               lambda seen, speed: (Tanh(seen=seen["v"], speed=speed),), (_RISE,),
               is_automatic=True),
        Family("presliding", "friction that is taken up after each reversal",
               lambda seen, way: (Presliding(displacement=way),), (_WAY,), is_automatic=True),
        Family("lag", "a torque that comes late (a delay, an elastic gear)",
               lambda seen: (Lag(),), is_automatic=True),
        Family(COUNTERBALANCE, "a torque that repeats once a turn, as a counterbalance's",
               lambda seen: _once_a_turn(), needs=0.1),
        Family("harmonics2", "a torque that repeats once and twice a turn", _harmonics(2),
               needs=0.5, is_automatic=True),
        Family("harmonics4", "a torque that repeats one to four times a turn", _harmonics(4),
               needs=0.5, is_automatic=True),
        Family("asymmetric", "viscous friction that differs by direction",
               lambda seen: (Asymmetric(),), is_automatic=True),
        Family("power", "friction that bends with speed",
               lambda seen, exponent: (Power(seen=seen["v"], exponent=exponent),),
               (Shape("exponent", ("-", "-"), (0.1, 0.9)),)),
        Family("cubic", "friction that grows with the cube of the speed",
               lambda seen: (Cubic(seen=seen["v"]),)),
        Family("curve", "friction by a monotone curve over speed", _curve),
        Family("lugre", "presliding with a hook at low speed",
               lambda seen, way, speed, excess: (
                   LuGre(displacement=way, speed=speed, excess=excess),
               ),
               (_WAY, _SPEED, Shape("excess", ("-", "-"), (0.01, 3.0)))),
        Family("position", "Coulomb friction that depends on the position", _by_position),
        Family("spring", "a linear spring", lambda seen: (Spring(seen=seen["q"]),)),
        Family("spring_table", "a spring of any curve", _table),
    )
}  # fmt: skip


def spring_family(turned: float, *families: str) -> str:
    """Return the first family of a spring that a joint turned far enough for.

    Args:
        turned: Range of its positions [rad].
        families: Names of families, those that need most first; "spring" needs nothing.
    """
    return next((name for name in families if has_turned(name, turned)), "spring")


def has_turned(family: str, turned: float) -> bool:
    """Return whether a joint turned as far as a family of its torque needs, with room to spare.

    Args:
        family: Its name.
        turned: Range of the joint's positions [rad]; 0 of a prismatic joint.
    """
    return _SPARE * FAMILIES[family].needs * 2 * np.pi <= turned


def drive_line(joint: str, *entries: str | DriveTerm) -> str:
    """Return the line of a job's [drives] that gives a joint families or terms.

    Args:
        joint: The joint.
        entries: Names of families, or terms.
    """
    return f"{toml_key(joint)} = [{', '.join(map(_toml_entry, entries))}]"


def _toml_entry(entry: str | DriveTerm) -> str:
    if isinstance(entry, str):
        return json.dumps(entry)
    table = {key: value for key, value in entry.to_dict().items() if key != "seen"}
    return "{ " + ", ".join(f"{key} = {json.dumps(x)}" for key, x in table.items()) + " }"


def wanted_families(
    friction: str | Mapping[str, str], joints: Sequence[str]
) -> dict[str, tuple[str, ...] | None]:
    """Return the names of the families each joint is to have; None where they are to be chosen.

    Args:
        friction: "auto", or names of friction with + between them; or that by joint, "*" for all
            joints that are not named ("auto" if it is left out). Viscous and Coulomb friction are
            the model's terms.
        joints: Names of the joints.

    Raises:
        SettingsError: If a name or a joint is unknown.
    """
    wanted_kind = "auto, names of families joined by +, or a table of these by joint"
    require_kind(friction, (str, Mapping), "friction", wanted_kind)
    for joint, names in friction.items() if isinstance(friction, Mapping) else ():
        require_kind(names, str, f"friction of {joint}", wanted_kind)
    stated = {"*": friction} if isinstance(friction, str) else {"*": AUTO, **friction}
    strangers = [joint for joint in stated if joint not in (*joints, "*")]
    if strangers:
        raise SettingsError(
            f"friction is stated for {listed(strangers)}, not among the joints to identify: "
            f"{listed(joints)}"
        )
    wanted: dict[str, tuple[str, ...] | None] = {}
    for joint in joints:
        names = stated.get(joint, stated["*"])
        own = [name for name in names.split("+") if name and name not in _OF_MODEL]
        unknown = [name for name in own if name not in FAMILIES]
        if names != AUTO and unknown:
            raise SettingsError(
                f"friction of {joint} has {listed(unknown)}, wanted auto, or some of "
                f"{listed(FAMILIES)}"
            )
        wanted[joint] = None if names == AUTO else tuple(own)
    return wanted
