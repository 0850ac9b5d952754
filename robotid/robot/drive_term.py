"""Base classes of the terms and families of terms of a drive's torque that ``drives`` has."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cache, cached_property
from inspect import signature
from itertools import pairwise
from typing import Any, ClassVar, TypeAlias

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.settings import is_number
from robotid.base.typing import Array
from robotid.robot.tree import LARGEST

#: A law's value and its derivative.
Slope: TypeAlias = tuple[Array | float, Array | float]
#: A law of the speed or the position, and of up to four shape parameters.
Law: TypeAlias = Callable[..., Slope]
#: Factors of a term's column: a(v) b(q) only; times the direction of friction; times that and the
#: absolute joint load torque; or the deflection of bristles instead.
PLAIN, DIRECTED, LOADED, BRISTLES = range(4)

#: A range without ends.
ANYWHERE = (-np.inf, np.inf)


def linear(z: Array) -> Slope:
    """Return a law y = z and its derivative."""
    return z, 1.0


@dataclass(frozen=True, slots=True)
class DriveMotion:
    """Motion and load of drives; all arrays of one shape, time along the last axis."""

    q: Array  # positions [rad or m]
    v: Array  # velocities w [rad/s or m/s]
    a: Array  # accelerations dw/dt [rad/s^2 or m/s^2]
    direction: Array  # direction of friction: the signs of w, or smooth values for them [-]
    load: Array  # joint load torque of the rigid bodies [N m or N]
    rate: Array  # time derivative of the whole torque [N m/s or N/s]
    # first samples of segments without gaps, bool; None if the samples are not in a sequence:
    # internal states are at their steady value then
    begins: Array | None = None

    def of(self, drive: int | list[int]) -> "DriveMotion":
        """Return the motion of one drive or of several, from arrays with a row for each drive."""
        arrays = (self.q, self.v, self.a, self.direction, self.load, self.rate)
        q, v, a, direction, load, rate = (x[drive] for x in arrays)
        return DriveMotion(q, v, a, direction, load, rate, self.begins)


@dataclass(frozen=True)
class DriveTerm(ABC):
    """One term of a drive's torque, linear in its parameter."""

    data_range: tuple[float, float] = ANYWHERE  # of the data, of what ``guards`` names: q or |v|

    label: ClassVar[str] = ""  # its name in parameters, as ``"elbow.viscous"``
    units: ClassVar[tuple[str, str]] = ("N m", "N")  # of the parameter of a rotary, a linear drive
    is_nonnegative: ClassVar[bool] = False  # whether the parameter cannot be negative by physics
    highest: ClassVar[float] = np.inf  # largest parameter of a drive that can move
    is_shared: ClassVar[bool] = True  # whether couplings have it too
    is_inertia: ClassVar[bool] = False  # whether it multiplies the acceleration
    is_friction: ClassVar[bool] = True  # whether a job's ``friction`` chooses it; else a switch
    follows_direction: ClassVar[bool] = False  # whether its column has the direction of friction
    has_state: ClassVar[bool] = False  # whether it depends on more than q, v, a and direction
    needs_load: ClassVar[bool] = False  # whether its column depends on the torque of its drive
    is_measured: ClassVar[bool] = False  # whether it affects only the measured torque, no motion
    guards: ClassVar[str] = ""  # "v" or "q" if its column is constant outside the data's range
    preference: ClassVar[float] = 1.0  # preference as the name of a base parameter [-]
    typical: ClassVar[tuple[float, float]] = (0.2, 0.9)  # typical range, for simulated robots
    dynamics: ClassVar[str | None] = None  # attribute of a URDF's ``<dynamics>`` that states it
    part: ClassVar[str] = "friction"  # its share of a split torque, or "spring" and the like
    # smallest and largest value of its shape parameters, by name; -1e9 and 1e9 of others
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {}
    rising: ClassVar[tuple[str, ...]] = ()  # names of shape parameters that increase in this order

    def __post_init__(self) -> None:
        kind = type(self).__name__
        for f in fields(self):
            value, (low, high) = getattr(self, f.name), self.ends.get(f.name, (-LARGEST, LARGEST))
            if f.name == "data_range":
                is_right, wanted = _is_range(value), "(lowest, highest)"
            elif isinstance(f.default, bool):
                is_right, wanted = isinstance(value, bool), "true or false"
            else:
                is_right = is_number(value) and low <= value <= high
                wanted = f"{low:g} to {high:g}"
            if not is_right:
                raise SettingsError(f"{kind}: {f.name} is {value!r}, expected {wanted}")
        if any(getattr(self, low) >= getattr(self, high) for low, high in pairwise(self.rising)):
            values = ", ".join(f"{key} = {getattr(self, key):g}" for key in self.rising)
            raise SettingsError(f"{kind}: {values}, expected increasing values")

    @property
    def name(self) -> str:
        """Its name in parameters, as ``"elbow.viscous"``."""
        return self.label

    @abstractmethod
    def column(self, motion: DriveMotion) -> Array:
        """Return the factor of the parameter, element by element, within the range of the data."""

    def to_dict(self) -> dict[str, Any]:
        """Return the term as plain values for ``term_from_dict``."""
        shape = {key: value for key, value in asdict(self).items() if key != "data_range"}
        guard = {} if self.data_range == ANYWHERE else {"data_range": list(self.data_range)}
        return {"term": type(self).__name__, **shape, **guard}


def _is_range(value: Any) -> bool:  # noqa: ANN401
    is_pair = isinstance(value, tuple) and len(value) == 2
    return is_pair and all(isinstance(x, int | float) for x in value) and value[0] <= value[1]


@dataclass(frozen=True)
class MemorylessTerm(DriveTerm):
    """A term without internal state: a(v) b(q), times direction and load."""

    # A law returns a(v) with da/dv, or b(q) with db/dq, from the speed or position and up to four
    # shape parameters of the term by their names: of NumPy's arrays and, by Numba, of scalars.
    speed_law: ClassVar[Law | None] = None  # the law a of the speed, a static method; None: 1
    position_law: ClassVar[Law | None] = None  # the law b of the position, likewise
    is_loaded: ClassVar[bool] = False  # whether the absolute joint load torque multiplies it

    @property
    def kind(self) -> int:
        """Its factors besides a(v) b(q)."""
        return LOADED if self.is_loaded else DIRECTED if self.follows_direction else PLAIN

    @property
    def affine(self) -> int | None:
        """0, 1 or 2 if its column is 1, the speed or its direction; None if it is another one."""
        if self.position_law is not None or self.guards:
            return None
        simple = {(None, PLAIN): 0, (linear, PLAIN): 1, (None, DIRECTED): 2}
        return simple.get((self.speed_law, self.kind))

    @cached_property
    def speed_shape(self) -> tuple[float, ...]:
        """The shape parameters of a(v)."""
        return self._shape(self.speed_law)

    @cached_property
    def position_shape(self) -> tuple[float, ...]:
        """The shape parameters of b(q)."""
        return self._shape(self.position_law)

    def _shape(self, law: Law | None) -> tuple[float, ...]:
        return () if law is None else tuple(float(getattr(self, name)) for name in _shapes(law))

    @cached_property
    def ranges(self) -> tuple[float, float, float]:
        """The largest abs(v) and the range of q outside which it is constant."""
        fastest = self.data_range[1] if self.guards == "v" else np.inf
        return (fastest, *(self.data_range if self.guards == "q" else ANYWHERE))

    def amplitude(self, q: Array, v: Array) -> Array:
        """Return a(v) b(q) within the range of the data: the column for direction and load 1."""
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
        """Return the factor of the parameter, element by element, within the range of the data."""
        column = self.amplitude(motion.q, motion.v)
        if self.follows_direction:
            column = motion.direction * column
        return np.abs(motion.load) * column if self.is_loaded else column


@cache
def _shapes(law: Law) -> tuple[str, ...]:
    """Return the names of a law's shape parameters."""
    return tuple(signature(law).parameters)[1:]


#: Ranges of the data: of position "q" and of the absolute speed "v".
DataRange = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Shape:
    """A shape parameter: terms are nonlinear in it."""

    name: str  # field of the terms
    units: tuple[str, str]  # its unit for a rotary drive, and for a linear one
    bounds: tuple[float, float]  # search bounds, relative to its reference
    of: str = ""  # its reference: "v", the data's largest speed, "q", the range of positions; or 1

    def within(self, data_range: DataRange) -> tuple[float, float]:
        """Return the bounds in the shape's own unit."""
        first, last = data_range[self.of] if self.of else (0.0, 1.0)
        scale = last if self.of == "v" else last - first
        return self.bounds[0] * scale, self.bounds[1] * scale


@dataclass(frozen=True)
class Family:
    """Terms that are chosen together, with their common shape parameters."""

    name: str  # its name in a job's ``friction``
    meaning: str  # its description in a finding
    make: Callable[..., tuple[DriveTerm, ...]]  # terms from ranges of data and shape parameters
    shapes: tuple[Shape, ...] = ()  # its shape parameters
    needs: float = 0.0  # range of positions that the motion must cover, in revolutions; 0: any
    is_automatic: bool = False  # whether ``friction = "auto"`` tries it
    code: str = ""  # of the finding that a model lacks it; empty: residuals are not tested for it
    tested: tuple[tuple[float, ...], ...] = ((),)  # shapes of the test; speeds relative to the RMS
    instead: tuple[str, ...] = ()  # families advised where the joint moved less than this one needs
    advice: str = ""  # advice in addition to adding it to the model; empty if none
    has_size: bool = False  # whether its parameter is its size in a finding; else its RMS torque
    is_imitated: bool = False  # whether filtered stiction resembles it: its finding is a note then

    def tested_terms(self, speed: float) -> tuple[DriveTerm, ...]:
        """Return the terms for which the residual of a fit is tested, without a range."""
        units = np.array([speed if shape.of == "v" else 1.0 for shape in self.shapes])
        anywhere = {"q": ANYWHERE, "v": ANYWHERE}
        sizes = (np.multiply(tested, units).tolist() for tested in self.tested)
        return tuple(term for shapes in sizes for term in self.make(anywhere, *shapes))
