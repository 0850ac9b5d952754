"""The terms of a drive's torque: one class each, and the rest of the package loops over them.

A term adds ``parameter * column`` to the torque of a drive. To add one, write its class with the
laws of ``drive_laws`` that it is made of, and enter it in ``TERMS`` if it has no shape of its own,
else in ``_CLASSES`` and ``FAMILIES``: its regressor, prior spread, plant, roll-outs with their
sensitivities, choice, sidecar, tables, exports and job key follow.

The columns of many terms are guarded: beyond the speeds or positions that the fit has seen they
stay as they were at the end of that range, for no data say how they go on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from robotid._settings import is_number
from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.findings import listed
from robotid.robot.drive_laws import (
    COSINE,
    CUBIC,
    FADING,
    HAT,
    LEVER,
    LINEAR,
    POLYNOMIAL,
    POWER,
    RISE,
    SINE,
    SIZE,
    TANH,
    bristles,
)
from robotid.robot.drive_term import DriveMotion, DriveTerm, MemorylessTerm

__all__ = [
    "DRIVE_TERMS",
    "TERMS",
    "Bristles",
    "DriveMotion",
    "DriveTerm",
    "Lag",
    "LoadFriction",
    "MemorylessTerm",
    "term_from_dict",
]

_POSITIVE = (1e-9, 1e9)  # numbers of a term's shape that it is divided by


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

    def column(self, motion: DriveMotion) -> Array:
        """Return the acceleration of the drive.

        Args:
            motion: How a drive moves.
        """
        return motion.a


@dataclass(frozen=True)
class Viscous(MemorylessTerm):
    """Viscous friction, tau = Fv w."""

    label = "viscous"
    speed_law = LINEAR
    units = ("N m s/rad", "N s/m")
    is_nonnegative = True
    usual = (0.5, 4.0)
    dynamics = "damping"


@dataclass(frozen=True)
class Coulomb(MemorylessTerm):
    """Coulomb friction, tau = Fc sign(w)."""

    label = "coulomb"
    is_nonnegative = True
    follows_direction = True
    usual = (0.5, 5.0)
    dynamics = "friction"


@dataclass(frozen=True)
class Offset(MemorylessTerm):
    """A constant torque: of a sensor's zero, or of Coulomb friction that differs by direction."""

    label = "offset"
    is_shared = False
    is_friction = False
    usual = (-0.3, 0.3)
    part = "offset"


@dataclass(frozen=True)
class Asymmetric(MemorylessTerm):
    """Viscous friction that differs by direction, tau = x |w|; of Coulomb's, see ``Offset``."""

    label = "asymmetric"
    speed_law = SIZE
    units = ("N m s/rad", "N s/m")


@dataclass(frozen=True)
class LoadFriction(MemorylessTerm):
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
    bears_load = True
    remembers = True
    usual = (0.04, 0.1)


@dataclass(frozen=True)
class Cubic(MemorylessTerm):
    """Friction that bends with speed, tau = x w^3."""

    label = "cubic"
    speed_law = CUBIC
    units = ("N m s^3/rad^3", "N s^3/m^3")
    guards = "v"


@dataclass(frozen=True)
class Stribeck(MemorylessTerm):
    """Friction beside Coulomb's that fades with speed, tau = x sign(w) exp(-|w| / w_s).

    Above 0 it is Stribeck's hook at low speed; below 0 friction sets in slowly and saturates.

    References:
        Tustin (1947), The effects of backlash and of speed-dependent friction on the stability of
        closed-cycle control systems.
    """

    speed: float = 0.1

    label = "stribeck"
    speed_law = FADING
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"speed": _POSITIVE}
    follows_direction = True
    guards = "v"

    @property
    def speed_shape(self) -> tuple[float, ...]:
        """Its speed, and that below which no data show how it goes on to 0."""
        return self.speed, self.seen[0]


@dataclass(frozen=True)
class Tanh(MemorylessTerm):
    """Friction that sets in over a speed, tau = x tanh(w / w_t)."""

    speed: float = 0.1

    label = "tanh"
    speed_law = TANH
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"speed": _POSITIVE}
    is_nonnegative = True
    guards = "v"

    @property
    def speed_shape(self) -> tuple[float, ...]:
        """Its speed."""
        return (self.speed,)


@dataclass(frozen=True)
class Power(MemorylessTerm):
    """Friction that grows with a power of the speed, tau = x sign(w) |w|^p."""

    exponent: float = 1.0 / 3.0

    label = "power"
    speed_law = POWER
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"exponent": (0.0, 10.0)}
    units = ("N m (s/rad)^p", "N (s/m)^p")
    follows_direction = True
    guards = "v"

    @property
    def speed_shape(self) -> tuple[float, ...]:
        """Its exponent."""
        return (self.exponent,)


@dataclass(frozen=True)
class Ramp(MemorylessTerm):
    """One rise of a monotone piecewise-linear curve: from 0 at one speed to 1 at the next."""

    number: int = 1
    low: float = 0.0
    high: float = 1.0

    speed_law = RISE
    rising: ClassVar[tuple[str, ...]] = ("low", "high")
    is_nonnegative = True
    follows_direction = True

    @property
    def name(self) -> str:
        return f"rise{self.number}"

    @property
    def speed_shape(self) -> tuple[float, ...]:
        """Where it rises."""
        return self.low, self.high


@dataclass(frozen=True)
class Harmonic(MemorylessTerm):
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

    @property
    def position_law(self) -> int:  # type: ignore[override]
        """Sine or cosine."""
        return SINE if self.is_sine else COSINE

    @property
    def position_shape(self) -> tuple[float, ...]:
        """Its order."""
        return (self.order,)


@dataclass(frozen=True)
class PositionCoulomb(MemorylessTerm):
    """Coulomb friction that depends on position, tau = x sign(w) (q - q_0)^k, q_0 mid-range."""

    order: int = 1
    centre: float = 0.0

    position_law = POLYNOMIAL
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"order": (0, 10)}
    follows_direction = True
    is_shared = False
    guards = "q"

    @property
    def name(self) -> str:
        return f"coulomb_q{self.order}"

    @property
    def position_shape(self) -> tuple[float, ...]:
        """Its order and centre."""
        return self.order, self.centre


@dataclass(frozen=True)
class Bristles(DriveTerm):
    """Friction x z that is taken up over a way: dz/ds = sign(v) - z / g(v) along s = |q| / s_0."""

    displacement: float = 0.01

    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"displacement": _POSITIVE}
    is_nonnegative = True
    follows_direction = True
    remembers = True

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Way, speed and excess of ``drive_laws.bristles``."""
        return self.displacement, 1.0, 0.0

    def level(self, v: Array) -> Array:
        """Return g, what z ends at beside its sign, as v.

        Args:
            v: Speeds [rad/s or m/s].
        """
        return bristles(self.numbers, np.zeros_like(v), v)[0]

    def column(self, motion: DriveMotion) -> Array:
        """Return z along stretches, from sliding where they begin.

        Exact between two samples if v keeps its sign and level there.

        Args:
            motion: How a drive moves; of instants that do not follow each other z is that of
                sliding.
        """
        if motion.begins is None:
            return motion.direction * self.level(motion.v)
        way = np.diff(motion.q, prepend=motion.q[:1])
        level, _, kept = bristles(self.numbers, way, motion.v)
        ends, start = np.sign(way) * level, motion.direction * level
        z, state = np.empty(len(way)), 0.0
        steps = zip(*(x.tolist() for x in (ends, kept, start, motion.begins)), strict=True)
        for k, (end, share, first, is_first) in enumerate(steps):
            state = first if is_first else end + (state - end) * share if share < 1.0 else state
            z[k] = state
        return z


@dataclass(frozen=True)
class Presliding(Bristles):
    """Friction that a drive takes up over a way after each reversal, tau = x z.

    dz/ds = 1 - z sign(v) along the way s = q / s_0: z goes from -1 to 1 after a reversal.

    References:
        Dahl (1968), A solid friction model.
    """

    label = "presliding"


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

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Way, speed and excess of ``drive_laws.bristles``."""
        return self.displacement, self.speed, self.excess


@dataclass(frozen=True)
class Spring(MemorylessTerm):
    """A linear spring, tau = k q; the torque at q = 0 is the offset's."""

    label = "spring"
    position_law = POLYNOMIAL
    units = ("N m/rad", "N/m")
    is_shared = False
    is_friction = True
    guards = "q"
    part = "spring"

    @property
    def position_shape(self) -> tuple[float, ...]:
        """Its order and centre."""
        return 1.0, 0.0


@dataclass(frozen=True)
class Hat(MemorylessTerm):
    """One entry of a tabulated spring: 1 at its position, 0 at its neighbours', linear between."""

    number: int = 1
    at: float = 0.0
    before: float = -1.0
    after: float = 1.0

    position_law = HAT
    rising: ClassVar[tuple[str, ...]] = ("before", "at", "after")
    is_shared = False
    guards = "q"
    part = "spring"

    @property
    def name(self) -> str:
        return f"spring{self.number}"

    @property
    def position_shape(self) -> tuple[float, ...]:
        """Its position and its neighbours'."""
        return self.before, self.at, self.after


@dataclass(frozen=True)
class Counterbalance(MemorylessTerm):
    """A spring between two points of stated place, tau = k (L - L_0) dL/dq.

    One point turns with the joint at a distance a from its axis, the other stands at a distance b;
    L^2 = a^2 + b^2 - 2 a b cos(q - q_0) is the length of the spring, shortest at q_0.
    """

    arm: float = 0.1
    base: float = 0.5
    angle: float = 0.0
    rest: float = 0.0

    label = "counterbalance"
    position_law = LEVER
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"arm": _POSITIVE, "base": _POSITIVE}
    units = ("N/m", "N/m")
    is_nonnegative = True
    is_shared = False
    usual = (50.0, 90.0)
    part = "spring"

    @property
    def position_shape(self) -> tuple[float, ...]:
        """Its arm, base, angle and rest."""
        return self.arm, self.base, self.angle, self.rest


@dataclass(frozen=True)
class Lag(DriveTerm):
    """A torque that comes late, by a delay or an elastic gear: to first order -T d(tau)/dt."""

    label = "lag"
    units = ("s", "s")
    remembers = True
    is_measured = True
    is_friction = True
    usual = (0.005, 0.02)
    part = "delay"

    def column(self, motion: DriveMotion) -> Array:
        """Return the change of the whole torque.

        Args:
            motion: How a drive moves.
        """
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
