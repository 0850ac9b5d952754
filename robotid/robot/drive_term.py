"""What a term of a drive's torque is, and a family of terms that come together.

``drives`` has the terms and the families.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from inspect import signature
from itertools import pairwise
from typing import Any, ClassVar, TypeAlias

import numpy as np

from robotid._settings import is_number
from robotid._typing import Array
from robotid.exceptions import SettingsError

__all__ = [
    "ANYWHERE",
    "BRISTLES",
    "DIRECTED",
    "LOADED",
    "PLAIN",
    "DataRange",
    "DriveMotion",
    "DriveTerm",
    "Family",
    "Law",
    "MemorylessTerm",
    "Shape",
    "Slope",
    "linear",
]

#: A law's value and its derivative.
Slope: TypeAlias = tuple[Array | float, Array | float]
#: A law of the speed or the position, and of up to four numbers that shape it.
Law: TypeAlias = Callable[..., Slope]
#: What a term is beside a(v) b(q): nothing more; times the direction of friction; times that and
#: the size of the gear's load; or a deflection that bristles take up over a way instead.
PLAIN, DIRECTED, LOADED, BRISTLES = range(4)

#: A range without ends.
ANYWHERE = (-np.inf, np.inf)
_ENDS = (-1e9, 1e9)  # numbers of a term's shape


def linear(z: Array) -> Slope:
    """Return a law y = z and its derivative.

    Args:
        z: Speeds or positions [rad/s or m/s; rad or m].
    """
    return z, 1.0


@dataclass(frozen=True, slots=True)
class DriveMotion:
    """How drives move, and what loads them; all arrays of one shape, time along the last axis.

    Attributes:
        q: Angles or ways [rad or m].
        v: Speeds w [rad/s or m/s].
        a: Their changes dw/dt [rad/s^2 or m/s^2].
        direction: Which way friction acts: the signs of w, or what stands for them [-].
        load: Torque of the rigid bodies [N m or N].
        rate: Change of the whole torque [N m/s or N/s].
        begins: Where a segment without gaps begins, bool; None of instants that do not follow each
            other, whose drives have slid for long.
    """

    q: Array
    v: Array
    a: Array
    direction: Array
    load: Array
    rate: Array
    begins: Array | None = None

    def of(self, drive: int | list[int]) -> "DriveMotion":
        """Return the motion of one drive or of several, of arrays with a row for each.

        Args:
            drive: Which one, or which.
        """
        q, v, a = self.q[drive], self.v[drive], self.a[drive]
        direction, load, rate = self.direction[drive], self.load[drive], self.rate[drive]
        return DriveMotion(q, v, a, direction, load, rate, self.begins)


@dataclass(frozen=True)
class DriveTerm(ABC):
    """One term of a drive's torque, linear in its parameter.

    Attributes:
        data_range: From where to where the fit has seen what ``guards`` names: q, or the size of v.

    Class attributes:
        label: Its name in parameters, as ``"elbow.viscous"``.
        units: Unit of the parameter for a drive that turns, and for one that slides.
        is_nonnegative: Whether the parameter cannot be negative by physics.
        highest: The largest parameter that a drive which moves can have.
        is_shared: Whether a drive that turns with several joints has it too.
        is_inertia: Whether it multiplies the acceleration and so adds to the mass matrix.
        is_friction: Whether a job's ``friction`` chooses it; if not, it has a switch of its own.
        follows_direction: Whether its column holds the direction of friction.
        has_state: Whether its column needs more than q, v, a and direction of an instant.
        is_measured: Whether it is in what is measured alone, and does not act on the robot.
        guards: "v" or "q" if its column stays as it is beyond the range seen, else "".
        preference: How much it is favoured as the name of a base parameter [-].
        typical: From where to where it usually lies, for simulated robots.
        dynamics: Attribute of the URDF's ``<dynamics>`` that states it, or None.
        part: What it counts as where a torque is split: "friction", "spring" and the like.
        ends: Smallest and largest value of its numbers, by name; -1e9 and 1e9 of others.
        rising: Names of numbers that increase in this order.
    """

    data_range: tuple[float, float] = ANYWHERE

    label: ClassVar[str] = ""
    units: ClassVar[tuple[str, str]] = ("N m", "N")
    is_nonnegative: ClassVar[bool] = False
    highest: ClassVar[float] = np.inf
    is_shared: ClassVar[bool] = True
    is_inertia: ClassVar[bool] = False
    is_friction: ClassVar[bool] = True
    follows_direction: ClassVar[bool] = False
    has_state: ClassVar[bool] = False
    is_measured: ClassVar[bool] = False
    guards: ClassVar[str] = ""
    preference: ClassVar[float] = 1.0
    usual: ClassVar[tuple[float, float]] = (0.2, 0.9)
    dynamics: ClassVar[str | None] = None
    part: ClassVar[str] = "friction"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {}
    rising: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        kind = type(self).__name__
        if not (len(self.data_range) == 2 and self.data_range[0] <= self.data_range[1]):
            raise SettingsError(
                f"{kind}: data_range is {self.data_range!r}, wanted (lowest, highest)"
            )
        shape = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "data_range"}
        for key, value in shape.items():
            low, high = self.ends.get(key, _ENDS)
            if not isinstance(value, bool) and not (is_number(value) and low <= value <= high):
                raise SettingsError(f"{kind}: {key} is {value!r}, wanted {low:g} to {high:g}")
        if any(shape[low] >= shape[high] for low, high in pairwise(self.rising)):
            found = ", ".join(f"{key} = {shape[key]:g}" for key in self.rising)
            raise SettingsError(f"{kind}: {found}, wanted each larger than the one before")

    @property
    def name(self) -> str:
        """Its name in parameters, as ``"elbow.viscous"``."""
        return self.label

    @abstractmethod
    def column(self, motion: DriveMotion) -> Array:
        """Return what the parameter multiplies, element by element, within the range seen.

        Args:
            motion: How a drive moves.
        """

    def to_dict(self) -> dict[str, Any]:
        """Return the term as plain values, which ``term_from_dict`` reads."""
        shape = {key: value for key, value in asdict(self).items() if key != "data_range"}
        guard = {} if self.data_range == ANYWHERE else {"data_range": list(self.data_range)}
        return {"term": type(self).__name__, **shape, **guard}


@dataclass(frozen=True)
class MemorylessTerm(DriveTerm):
    """A term of the speed and position of an instant, a(v) b(q) beside direction and load.

    A law returns a(v) with da/dv, or b(q) with db/dq. Its arguments are the speed or position, and
    up to four numbers of the term by their names; it works on NumPy's arrays and, compiled by
    Numba, on single numbers. Regressor, plant and roll-outs follow from it.

    Class attributes:
        speed_law: The law a of the speed, a static method; None: 1.
        position_law: The law b of the position, likewise.
        is_loaded: Whether the size of the gear's load multiplies it, as direction does.
    """

    speed_law: ClassVar[Law | None] = None
    position_law: ClassVar[Law | None] = None
    is_loaded: ClassVar[bool] = False

    @property
    def kind(self) -> int:
        """What it is beside a(v) b(q)."""
        return LOADED if self.is_loaded else DIRECTED if self.follows_direction else PLAIN

    @property
    def affine(self) -> int | None:
        """Which of 1, the speed and its direction it multiplies by, 0, 1 or 2; None: of others."""
        if self.position_law is not None or self.guards:
            return None
        simple = {(None, PLAIN): 0, (linear, PLAIN): 1, (None, DIRECTED): 2}
        return simple.get((self.speed_law, self.kind))

    @cached_property
    def speed_shape(self) -> tuple[float, ...]:
        """The numbers that shape a(v)."""
        return self._shape(self.speed_law)

    @cached_property
    def position_shape(self) -> tuple[float, ...]:
        """The numbers that shape b(q)."""
        return self._shape(self.position_law)

    def _shape(self, law: Law | None) -> tuple[float, ...]:
        names = [] if law is None else list(signature(law).parameters)[1:]
        return tuple(float(getattr(self, name)) for name in names)

    @property
    def ranges(self) -> tuple[float, float, float]:
        """The largest size of v and the range of q beyond which it stays as it is."""
        fastest = self.data_range[1] if self.guards == "v" else np.inf
        return (fastest, *(self.data_range if self.guards == "q" else ANYWHERE))

    def amplitude(self, q: Array, v: Array) -> Array:
        """Return a(v) b(q), within the range seen: the column of positive direction and load 1.

        Args:
            q: Angles or ways [rad or m].
            v: Speeds, shape as q [rad/s or m/s].
        """
        fastest, lowest, highest = self.ranges
        y: Array | float = 1.0
        if self.speed_law is not None:
            w = np.clip(v, -fastest, fastest) if self.guards == "v" else v  # of either sign
            y = self.speed_law(w, *self.speed_shape)[0]
        if self.position_law is not None:
            p = np.clip(q, lowest, highest) if self.guards == "q" else q
            y = y * self.position_law(p, *self.position_shape)[0]
        return y if isinstance(y, np.ndarray) else np.full_like(v, y)

    def column(self, motion: DriveMotion) -> Array:
        """Return what the parameter multiplies, element by element, within the range seen.

        Args:
            motion: How a drive moves.
        """
        column = self.amplitude(motion.q, motion.v)
        if self.follows_direction:
            column = motion.direction * column
        return np.abs(motion.load) * column if self.is_loaded else column


#: Ranges of position "q" and of the size of speed "v" that a fit has seen.
DataRange = Mapping[str, tuple[float, float]]


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

    def within(self, data_range: DataRange) -> tuple[float, float]:
        """Return the bounds in the shape's own unit.

        Args:
            data_range: Ranges of position "q" and of the size of speed "v" that the fit has seen.
        """
        low, high = self.bounds
        if not self.of:
            return low, high
        first, last = data_range[self.of]
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
        code: Code of the finding that a model lacks it; empty: what a fit leaves is not tested for
            it.
        tested: Shapes at which it is tested for, speeds over their root mean square.
        instead: Families advised where the joint turned less than this one needs.
        advice: What the user can do beside adding it to the model; empty if nothing.
        has_size: Whether its parameter is its size in a finding; else its torque, root mean square.
        is_imitated: Whether a drive that sticks at its reversals looks like it behind a filter: it
            is no more than a note then.
    """

    name: str
    meaning: str
    make: Callable[..., tuple[DriveTerm, ...]]
    shapes: tuple[Shape, ...] = ()
    needs: float = 0.0
    is_automatic: bool = False
    code: str = ""
    tested: tuple[tuple[float, ...], ...] = ((),)
    instead: tuple[str, ...] = ()
    advice: str = ""
    has_size: bool = False
    is_imitated: bool = False

    def tested_terms(self, speed: float) -> tuple[DriveTerm, ...]:
        """Return the terms that what a fit leaves is tested against, of no range in particular.

        Args:
            speed: Root mean square of the speed [rad/s or m/s].
        """
        units = [speed if shape.of == "v" else 1.0 for shape in self.shapes]
        sizes = [[x * unit for x, unit in zip(own, units, strict=True)] for own in self.tested]
        anywhere = {"q": ANYWHERE, "v": ANYWHERE}
        return tuple(term for own in sizes for term in self.make(anywhere, *own))
