"""The terms of a drive's torque: one class each, and the rest of the package loops over them.

A term adds ``parameter * column`` to the torque of a drive. To add one, write its class and enter
it in ``TERMS`` if it has no shape of its own, else in ``families``: its regressor, prior spread,
plant, sidecar, tables and job key follow.

The columns of many terms are guarded: beyond the speeds or positions that the fit has seen they
stay as they were at the end of that range, for no data say how they go on.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from robotid._settings import is_number
from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.findings import listed

__all__ = [
    "DRIVE_TERMS",
    "TERMS",
    "Bristles",
    "DriveMotion",
    "DriveTerm",
    "Lag",
    "LoadFriction",
    "term_from_dict",
]

_ANYWHERE = (-np.inf, np.inf)
_POSITIVE = (1e-9, 1e9)  # numbers of a term's shape that it is divided by
_ENDS = (-1e9, 1e9)  # other numbers of a term's shape


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
        begins: Where a stretch without gaps begins, bool; None of instants that do not follow each
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
class DriveTerm:
    """One term of a drive's torque, linear in its parameter.

    Attributes:
        seen: From where to where the fit has seen what ``guards`` names: q, or the size of v.

    Class attributes:
        label: Its name in parameters, as ``"elbow.viscous"``.
        units: Unit of the parameter for a drive that turns, and for one that slides.
        is_nonnegative: Whether the parameter cannot be negative by physics.
        highest: The largest parameter that a drive which moves can have.
        is_shared: Whether a drive that turns with several joints has it too.
        is_inertia: Whether it multiplies the acceleration and so adds to the mass matrix.
        is_friction: Whether a job's ``friction`` chooses it; if not, it has a switch of its own.
        follows_direction: Whether its column holds the direction of friction.
        remembers: Whether its column needs more than q, v, a and direction of an instant.
        guards: "v" or "q" if its column stays as it is beyond the range seen, else "".
        preference: How much it is favoured as the name of a base parameter [-].
        usual: From where to where it usually lies, for simulated robots.
        dynamics: Attribute of the URDF's ``<dynamics>`` that states it, or None.
        part: What it counts as where a torque is split: "friction", "spring" and the like.
        ends: Smallest and largest value of its numbers, by name; -1e9 and 1e9 of others.
        rising: Names of numbers that increase in this order.
    """

    seen: tuple[float, float] = _ANYWHERE

    label: ClassVar[str] = ""
    units: ClassVar[tuple[str, str]] = ("N m", "N")
    is_nonnegative: ClassVar[bool] = False
    highest: ClassVar[float] = np.inf
    is_shared: ClassVar[bool] = True
    is_inertia: ClassVar[bool] = False
    is_friction: ClassVar[bool] = True
    follows_direction: ClassVar[bool] = False
    remembers: ClassVar[bool] = False
    guards: ClassVar[str] = ""
    preference: ClassVar[float] = 1.0
    usual: ClassVar[tuple[float, float]] = (0.2, 0.9)
    dynamics: ClassVar[str | None] = None
    part: ClassVar[str] = "friction"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {}
    rising: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        kind = type(self).__name__
        if not (len(self.seen) == 2 and self.seen[0] <= self.seen[1]):
            raise SettingsError(f"{kind}: seen is {self.seen!r}, wanted (lowest, highest)")
        shape = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "seen"}
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

    def column(self, motion: DriveMotion) -> Array:
        """Return what the parameter multiplies, element by element, within the range seen.

        Args:
            motion: How a drive moves.
        """
        low, high = self.seen
        if self.guards == "v":  # of either sign
            motion = replace(motion, v=np.clip(motion.v, -high, high))
        elif self.guards == "q":
            motion = replace(motion, q=np.clip(motion.q, low, high))
        return self._column(motion)

    def _column(self, motion: DriveMotion) -> Array:
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return the term as plain values, which ``term_from_dict`` reads."""
        shape = {key: value for key, value in asdict(self).items() if key != "seen"}
        guard = {} if self.seen == _ANYWHERE else {"seen": list(self.seen)}
        return {"term": type(self).__name__, **shape, **guard}


@dataclass(frozen=True)
class Armature(DriveTerm):
    """Inertia of the rotor behind its gear, tau = Ia dw/dt."""

    label = "armature"
    units = ("kg m^2", "kg")
    is_nonnegative = True
    is_inertia = True
    is_friction = False
    preference = 0.3
    usual = (0.1, 0.5)
    part = "motor inertia"

    def _column(self, motion: DriveMotion) -> Array:
        return motion.a


@dataclass(frozen=True)
class Viscous(DriveTerm):
    """Viscous friction, tau = Fv w."""

    label = "viscous"
    units = ("N m s/rad", "N s/m")
    is_nonnegative = True
    usual = (0.5, 4.0)
    dynamics = "damping"

    def _column(self, motion: DriveMotion) -> Array:
        return motion.v


@dataclass(frozen=True)
class Coulomb(DriveTerm):
    """Coulomb friction, tau = Fc sign(w)."""

    label = "coulomb"
    is_nonnegative = True
    follows_direction = True
    usual = (0.5, 5.0)
    dynamics = "friction"

    def _column(self, motion: DriveMotion) -> Array:
        return motion.direction


@dataclass(frozen=True)
class Offset(DriveTerm):
    """A constant torque: of a sensor's zero, or of Coulomb friction that differs by direction."""

    label = "offset"
    is_shared = False
    is_friction = False
    usual = (-0.3, 0.3)
    part = "offset"

    def _column(self, motion: DriveMotion) -> Array:
        return np.ones_like(motion.v)


@dataclass(frozen=True)
class Asymmetric(DriveTerm):
    """Viscous friction that differs by direction, tau = x |w|; of Coulomb's, see ``Offset``."""

    label = "asymmetric"
    units = ("N m s/rad", "N s/m")

    def _column(self, motion: DriveMotion) -> Array:
        return np.abs(motion.v)


@dataclass(frozen=True)
class LoadFriction(DriveTerm):
    """Coulomb friction that grows with the load of the gear, tau = mu sign(w) |tau_rigid|.

    References:
        Hamon, Gautier, Garrec (2010), Dynamic identification of robots with a dry friction model
        depending on load and velocity.
    """

    label = "load"
    units = ("N m per N m", "N per N")
    is_nonnegative = True
    highest = 0.5  # a gear that loses more holds what it should lower
    follows_direction = True
    remembers = True
    usual = (0.04, 0.1)

    def _column(self, motion: DriveMotion) -> Array:
        return motion.direction * np.abs(motion.load)


@dataclass(frozen=True)
class Cubic(DriveTerm):
    """Friction that bends with speed, tau = x w^3."""

    label = "cubic"
    units = ("N m s^3/rad^3", "N s^3/m^3")
    guards = "v"

    def _column(self, motion: DriveMotion) -> Array:
        return motion.v**3


@dataclass(frozen=True)
class Stribeck(DriveTerm):
    """Friction beside Coulomb's that fades with speed, tau = x sign(w) exp(-|w| / w_s).

    Above 0 it is Stribeck's hook at low speed; below 0 friction sets in slowly and saturates.

    References:
        Tustin (1947), The effects of backlash and of speed-dependent friction on the stability of
        closed-cycle control systems.
    """

    speed: float = 0.1

    label = "stribeck"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"speed": _POSITIVE}
    follows_direction = True
    guards = "v"

    def _column(self, motion: DriveMotion) -> Array:
        speed = np.maximum(np.abs(motion.v), self.seen[0])  # no data say how it goes on to 0
        return motion.direction * np.exp(-speed / self.speed)


@dataclass(frozen=True)
class Tanh(DriveTerm):
    """Friction that sets in over a speed, tau = x tanh(w / w_t)."""

    speed: float = 0.1

    label = "tanh"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"speed": _POSITIVE}
    is_nonnegative = True
    guards = "v"

    def _column(self, motion: DriveMotion) -> Array:
        return np.tanh(motion.v / self.speed)


@dataclass(frozen=True)
class Power(DriveTerm):
    """Friction that grows with a power of the speed, tau = x sign(w) |w|^p."""

    exponent: float = 1.0 / 3.0

    label = "power"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"exponent": (0.0, 10.0)}
    units = ("N m (s/rad)^p", "N (s/m)^p")
    follows_direction = True
    guards = "v"

    def _column(self, motion: DriveMotion) -> Array:
        return motion.direction * np.abs(motion.v) ** self.exponent


@dataclass(frozen=True)
class Ramp(DriveTerm):
    """One rise of a monotone piecewise-linear curve: from 0 at one speed to 1 at the next."""

    number: int = 1
    low: float = 0.0
    high: float = 1.0

    rising: ClassVar[tuple[str, ...]] = ("low", "high")
    is_nonnegative = True
    follows_direction = True

    @property
    def name(self) -> str:
        return f"rise{self.number}"

    def _column(self, motion: DriveMotion) -> Array:
        risen = (np.abs(motion.v) - self.low) / (self.high - self.low)
        return motion.direction * np.clip(risen, 0.0, 1.0)


@dataclass(frozen=True)
class Harmonic(DriveTerm):
    """A torque that repeats with the angle of joint or motor: cos or sin of ``order`` turns.

    With ``order`` the gear ratio, or a multiple of it, the angle is that of the motor.
    """

    order: float = 1.0
    is_sine: bool = False

    is_shared = False
    guards = "q"
    part = "ripple"

    @property
    def name(self) -> str:
        return f"{'sin' if self.is_sine else 'cos'}{self.order:g}"

    def _column(self, motion: DriveMotion) -> Array:
        angle = self.order * motion.q
        return np.sin(angle) if self.is_sine else np.cos(angle)


@dataclass(frozen=True)
class PositionCoulomb(DriveTerm):
    """Coulomb friction that depends on position, tau = x sign(w) (q - q_0)^k, q_0 mid-range."""

    order: int = 1
    centre: float = 0.0

    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"order": (0, 10)}
    follows_direction = True
    is_shared = False
    guards = "q"

    @property
    def name(self) -> str:
        return f"coulomb_q{self.order}"

    def _column(self, motion: DriveMotion) -> Array:
        return motion.direction * (motion.q - self.centre) ** self.order


@dataclass(frozen=True)
class Bristles(DriveTerm):
    """Friction x z that is taken up over a way: dz/ds = sign(v) - z / g(v) along s = |q| / s_0."""

    displacement: float = 0.01

    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"displacement": _POSITIVE}
    is_nonnegative = True
    follows_direction = True
    remembers = True

    def level(self, v: Array) -> Array:
        """Return g, what z ends at beside its sign, as v.

        Args:
            v: Speeds [rad/s or m/s].
        """
        raise NotImplementedError

    def _column(self, motion: DriveMotion) -> Array:
        if motion.begins is None:
            return motion.direction * self.level(motion.v)
        return _taken_up(motion, self.level, self.displacement)


@dataclass(frozen=True)
class Presliding(Bristles):
    """Friction that a drive takes up over a way after each reversal, tau = x z.

    dz/ds = 1 - z sign(v) along the way s = q / s_0: z goes from -1 to 1 after a reversal.

    References:
        Dahl (1968), A solid friction model.
    """

    label = "presliding"

    def level(self, v: Array) -> Array:
        return np.ones_like(v)


@dataclass(frozen=True)
class LuGre(Bristles):
    """Presliding with Stribeck's hook: dz/ds = 1 - z sign(v) / g(v), g = 1 + c exp(-(w/w_s)^2).

    References:
        Canudas de Wit, Olsson, Astrom, Lischinsky (1995), A new model for control of systems with
        friction; without its micro-damping.
    """

    speed: float = 0.1
    excess: float = 0.5

    label = "lugre"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {
        "displacement": _POSITIVE, "speed": _POSITIVE, "excess": (-0.99, 1e3),
    }  # fmt: skip

    def level(self, v: Array) -> Array:
        return 1.0 + self.excess * np.exp(-((v / self.speed) ** 2))


def _taken_up(motion: DriveMotion, level: Callable[[Array], Array], displacement: float) -> Array:
    """Return the state z of presliding along stretches, from sliding where they begin.

    Exact between two samples if v keeps its sign and level there.
    """
    way = np.diff(motion.q, prepend=motion.q[:1])
    towards = np.sign(way) * level(motion.v)
    kept = np.exp(-np.abs(way) / (displacement * level(motion.v)))
    begins = np.zeros(len(way), dtype=bool) if motion.begins is None else motion.begins
    start = motion.direction * level(motion.v)
    z, state = np.empty(len(way)), 0.0
    steps = zip(towards.tolist(), kept.tolist(), start.tolist(), begins.tolist(), strict=True)
    for k, (end, share, first, is_first) in enumerate(steps):
        state = first if is_first else end + (state - end) * share if share < 1.0 else state
        z[k] = state
    return z


@dataclass(frozen=True)
class Spring(DriveTerm):
    """A linear spring, tau = k q; the torque at q = 0 is the offset's."""

    label = "spring"
    units = ("N m/rad", "N/m")
    is_shared = False
    is_friction = True
    guards = "q"
    part = "spring"

    def _column(self, motion: DriveMotion) -> Array:
        return motion.q


@dataclass(frozen=True)
class Hat(DriveTerm):
    """One entry of a tabulated spring: 1 at its position, 0 at its neighbours', linear between."""

    number: int = 1
    at: float = 0.0
    before: float = -1.0
    after: float = 1.0

    rising: ClassVar[tuple[str, ...]] = ("before", "at", "after")
    is_shared = False
    guards = "q"
    part = "spring"

    @property
    def name(self) -> str:
        return f"spring{self.number}"

    def _column(self, motion: DriveMotion) -> Array:
        knots, values = [self.before, self.at, self.after], [0.0, 1.0, 0.0]
        hat: Array = np.interp(motion.q, knots, values)
        return hat


@dataclass(frozen=True)
class Counterbalance(DriveTerm):
    """A spring between two points of stated place, tau = k (L - L_0) dL/dq.

    One point turns with the joint at a distance a from its axis, the other stands at a distance b;
    L^2 = a^2 + b^2 - 2 a b cos(q - q_0) is the length of the spring, shortest at q_0.
    """

    arm: float = 0.1
    base: float = 0.5
    angle: float = 0.0
    rest: float = 0.0

    label = "counterbalance"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"arm": _POSITIVE, "base": _POSITIVE}
    units = ("N/m", "N/m")
    is_nonnegative = True
    is_shared = False
    usual = (50.0, 90.0)
    part = "spring"

    def _column(self, motion: DriveMotion) -> Array:
        turned = motion.q - self.angle
        length = np.sqrt(self.arm**2 + self.base**2 - 2 * self.arm * self.base * np.cos(turned))
        change = self.arm * self.base * np.sin(turned) / length
        column: Array = (length - self.rest) * change
        return column


@dataclass(frozen=True)
class Lag(DriveTerm):
    """A torque that comes late, by a delay or an elastic gear: to first order -T d(tau)/dt."""

    label = "lag"
    units = ("s", "s")
    remembers = True
    is_friction = True
    usual = (0.005, 0.02)
    part = "delay"

    def _column(self, motion: DriveMotion) -> Array:
        return -motion.rate


#: The terms without a shape of their own, by name, in the order of the parameters.
TERMS: dict[str, DriveTerm] = {
    term.name: term for term in (Armature(), Viscous(), Coulomb(), Offset())
}
#: Names of the terms that are identified unless told otherwise.
DRIVE_TERMS = tuple(TERMS)


_CLASSES: dict[str, type[DriveTerm]] = {
    kind.__name__: kind
    for kind in (
        Asymmetric, LoadFriction, Cubic, Stribeck, Tanh, Power, Ramp, Harmonic, PositionCoulomb,
        Presliding, LuGre, Spring, Hat, Counterbalance, Lag,
    )
}  # fmt: skip


def term_from_dict(table: Mapping[str, Any]) -> DriveTerm:
    """Return a term of its plain values, as ``DriveTerm.to_dict`` gives them.

    Args:
        table: Its class under "term", and the fields that are not left as they are.

    Raises:
        SettingsError: If there is no such term, or a field of it is unknown or no number.
    """
    if not isinstance(table, Mapping):
        raise SettingsError(
            f"a drive term is {table!r}, wanted a table, as {{ term = 'Stribeck', speed = 0.1 }}"
        )
    kind = _CLASSES.get(str(table.get("term")))
    if kind is None:
        raise SettingsError(f"term is {table.get('term')!r}, wanted one of {listed(_CLASSES)}")
    known = {field.name: field.default for field in fields(kind)}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key == "term":
            continue
        if key not in known:
            raise SettingsError(f"{kind.__name__} has no {key!r}; it has {listed(known)}")
        values[key] = _read_field(kind, key, value, known[key])
    return kind(**values)


def _read_field(kind: type[DriveTerm], key: str, value: object, default: object) -> object:
    if key == "seen":
        if isinstance(value, Sequence) and len(value) == 2 and all(map(is_number, value)):
            return (float(value[0]), float(value[1]))
        raise SettingsError(f"{kind.__name__}: seen is {value!r}, wanted [lowest, highest]")
    is_flag = isinstance(default, bool)
    if is_flag is not isinstance(value, bool) or not (is_flag or is_number(value)):
        wanted = "true or false" if is_flag else "a finite number"
        raise SettingsError(f"{kind.__name__}: {key} is {value!r}, wanted {wanted}")
    return type(default)(value)  # type: ignore[call-arg]
