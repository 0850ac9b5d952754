"""The terms of a drive's torque: a term adds ``parameter * column``.

To add one, write its class with its laws, and enter it in ``TERMS`` if it has no shape parameters,
else in ``TERM_CLASSES`` and ``FAMILIES``. Guarded columns are constant outside the data's range.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed, toml_key
from robotid.base.settings import is_number, require_kind
from robotid.base.tolerances import LEAST_DIVISOR
from robotid.base.typing import Array
from robotid.robot.drive_term import (
    DataRange,
    DriveMotion,
    DriveTerm,
    Family,
    MemorylessTerm,
    Shape,
    Slope,
    linear,
)
from robotid.robot.tree import LARGEST

_POSITIVE = (1.0 / LARGEST, LARGEST)  # bounds of shape parameters that are divisors
#: Value of ``friction`` with which the families of each joint are chosen.
AUTO = "auto"
_OF_MODEL = ("none", "viscous", "coulomb")  # allowed in ``friction``, and terms of the model
_SPARE = 1.1  # factor on the range that a family needs, from which it is advised


class Armature(DriveTerm):
    """Inertia of the rotor behind its gear, tau = Ia dw/dt."""

    label = "armature"
    units = ("kg m^2", "kg")
    is_nonnegative = True
    is_inertia = True
    is_friction = False
    preference = 0.3
    typical = (0.1, 0.5)
    part = "motor inertia"

    def column(self, motion: DriveMotion) -> Array:
        """Return the acceleration of the drive."""
        return motion.a


class Viscous(MemorylessTerm):
    """Viscous friction, tau = Fv w."""

    label = "viscous"
    speed_law = staticmethod(linear)
    units = ("N m s/rad", "N s/m")
    is_nonnegative = True
    typical = (0.5, 4.0)
    dynamics = "damping"


class Coulomb(MemorylessTerm):
    """Coulomb friction, tau = Fc sign(w)."""

    label = "coulomb"
    is_nonnegative = True
    follows_direction = True
    typical = (0.5, 5.0)
    dynamics = "friction"


class Offset(MemorylessTerm):
    """A constant torque: a sensor's zero error, or Coulomb friction that differs by direction."""

    label = "offset"
    is_shared = False
    is_friction = False
    typical = (-0.3, 0.3)
    part = "offset"


class Asymmetric(MemorylessTerm):
    """Viscous friction that differs by direction, tau = x |w|; for Coulomb's see ``Offset``."""

    label = "asymmetric"
    units = ("N m s/rad", "N s/m")

    @staticmethod
    def speed_law(w: Array) -> Slope:
        return np.abs(w), np.sign(w)


class LoadFriction(MemorylessTerm):
    """Friction of the joint load torque, tau = mu sign(w) |tau_rigid| (Hamon, Gautier 2010)."""

    label = "load"
    units = ("N m per N m", "N per N")
    is_nonnegative = True
    highest = 0.5  # a gear with more is self-locking
    follows_direction = True
    is_loaded = True
    needs_load = True
    has_state = True
    typical = (0.04, 0.1)


class Cubic(MemorylessTerm):
    """Friction with the cube of the speed, tau = x w^3."""

    label = "cubic"
    units = ("N m s^3/rad^3", "N s^3/m^3")
    guards = "v"

    @staticmethod
    def speed_law(w: Array) -> Slope:
        return w * w * w, 3.0 * w * w


@dataclass(frozen=True)
class Stribeck(MemorylessTerm):
    """Friction that decays with speed (Tustin 1947), or rises: tau = x sign(w) exp(-|w| / w_s)."""

    speed: float = 0.1

    label = "stribeck"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"speed": _POSITIVE}
    follows_direction = True
    guards = "v"

    @property
    def slowest(self) -> float:
        """The lowest speed of the data; the column is constant below it."""
        return self.data_range[0]

    @staticmethod
    def speed_law(w: Array, speed: float, slowest: float) -> Slope:
        size = np.maximum(np.abs(w), slowest)
        y = np.exp(-size / speed)
        return y, -np.sign(w) * (size > slowest) * y / speed


@dataclass(frozen=True)
class Tanh(MemorylessTerm):
    """Friction that rises with speed and saturates, tau = x tanh(w / w_t)."""

    speed: float = 0.1

    label = "tanh"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"speed": _POSITIVE}
    is_nonnegative = True
    guards = "v"

    @staticmethod
    def speed_law(w: Array, speed: float) -> Slope:
        y = np.tanh(w / speed)
        return y, (1.0 - y * y) / speed


@dataclass(frozen=True)
class Power(MemorylessTerm):
    """Friction with a power of the speed, tau = x sign(w) |w|^p."""

    exponent: float = 1.0 / 3.0

    label = "power"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"exponent": (0.0, 10.0)}
    units = ("N m (s/rad)^p", "N (s/m)^p")
    follows_direction = True
    guards = "v"

    @staticmethod
    def speed_law(w: Array, exponent: float) -> Slope:
        y = np.abs(w) ** exponent
        return y, np.sign(w) * exponent * y / np.maximum(np.abs(w), LEAST_DIVISOR)


@dataclass(frozen=True)
class Ramp(MemorylessTerm):
    """One ramp of a monotone piecewise-linear curve: from 0 at one speed to 1 at the next."""

    number: int = 1
    low: float = 0.0
    high: float = 1.0

    rising: ClassVar[tuple[str, ...]] = ("low", "high")
    is_nonnegative = True
    follows_direction = True

    @property
    def name(self) -> str:
        return f"rise{self.number}"

    @staticmethod
    def speed_law(w: Array, low: float, high: float) -> Slope:
        y = np.minimum(np.maximum((np.abs(w) - low) / (high - low), 0.0), 1.0)
        return y, np.sign(w) * (y > 0.0) * (y < 1.0) / (high - low)


@dataclass(frozen=True)
class Harmonic(MemorylessTerm):
    """A periodic torque: cos or sin of ``order`` times q; of the motor, multiples of its ratio."""

    order: float = 1.0
    is_sine: bool = False

    is_shared = False
    guards = "q"
    part = "ripple"

    @property
    def name(self) -> str:
        return f"{'sin' if self.is_sine else 'cos'}{self.order:g}"

    @staticmethod
    def position_law(q: Array, order: float, is_sine: float) -> Slope:
        c, s = np.cos(order * q), np.sin(order * q)
        return (s, order * c) if is_sine else (c, -order * s)


@dataclass(frozen=True)
class PositionCoulomb(MemorylessTerm):
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

    @property
    def units(self) -> tuple[str, str]:  # type: ignore[override]
        """Units for revolute and prismatic drives."""
        if self.order == 0:
            return "N m", "N"
        power = "" if self.order == 1 else f"^{self.order}"
        return f"N m/rad{power}", f"N/m{power}"

    @staticmethod
    def position_law(q: Array, order: float, centre: float) -> Slope:
        lower = (q - centre) ** max(order - 1.0, 0.0)
        return lower * (q - centre) if order > 0.0 else lower, order * lower


@dataclass(frozen=True)
class Bristles(DriveTerm):
    """Friction x z of bristles with deflection z: dz/ds = sign(v) - z / g(v), s = |q| / s_0."""

    displacement: float = 0.01

    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"displacement": _POSITIVE}
    is_nonnegative = True
    follows_direction = True
    has_state = True

    @staticmethod
    def law(x: Sequence[float], way: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return g(v) = 1 + c exp(-(v / w)^2), dg/dv, decay: z = s g + (z_0 - s g) decay."""
        extra = x[2] * np.exp(-((v / x[1]) ** 2))
        g = 1.0 + extra
        return g, -2.0 * v / (x[1] * x[1]) * extra, np.exp(-np.abs(way) / (x[0] * g))

    @property
    def numbers(self) -> tuple[float, float, float]:
        """s_0, w and c of ``law``."""
        return self.displacement, 1.0, 0.0

    def level(self, v: Array) -> Array:
        """Return g, the steady value of abs(z), shape as v."""
        return self.law(self.numbers, np.zeros_like(v), v)[0]

    def column(self, motion: DriveMotion) -> Array:
        """Return z along segments from its steady value; exact for constant sign of v and g."""
        if motion.begins is None:
            return motion.direction * self.level(motion.v)
        from scipy.linalg.lapack import dtbtrs

        way = np.diff(motion.q, prepend=motion.q[:1])
        level, _, decay = self.law(self.numbers, way, motion.v)
        # z_k = decay_k z_k-1 + (1 - decay_k) sign(way_k) g_k: a bidiagonal system
        decay = np.where(motion.begins, 0.0, decay)
        ends = np.where(motion.begins, motion.direction, np.sign(way)) * level
        band = np.stack([np.ones_like(way), -np.roll(decay, -1)])
        z, _ = dtbtrs(band, ((1.0 - decay) * ends)[:, None], uplo="L", diag="U", overwrite_b=1)
        return np.asarray(z[:, 0])


class Presliding(Bristles):
    """Friction x z (Dahl 1968): dz/ds = 1 - z sign(v), s = q / s_0: -1 to 1 after a reversal."""

    label = "presliding"


@dataclass(frozen=True)
class LuGre(Bristles):
    """LuGre friction (Canudas de Wit 1995), no micro-damping: g = 1 + c exp(-(w/w_s)^2)."""

    speed: float = 0.1
    excess: float = 0.5

    label = "lugre"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {
        "displacement": _POSITIVE, "speed": _POSITIVE, "excess": (-0.99, 1e3),
    }  # fmt: skip

    @property
    def numbers(self) -> tuple[float, float, float]:
        """s_0, w and c of ``law``."""
        return self.displacement, self.speed, self.excess


class Spring(MemorylessTerm):
    """A linear spring, tau = k q; the torque at q = 0 is part of the offset."""

    label = "spring"
    position_law = staticmethod(linear)
    units = ("N m/rad", "N/m")
    is_shared = False
    guards = "q"
    part = "spring"


@dataclass(frozen=True)
class Hat(MemorylessTerm):
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

    @staticmethod
    def position_law(q: Array, before: float, at: float, after: float) -> Slope:
        y = np.maximum(np.minimum((q - before) / (at - before), (after - q) / (after - at)), 0.0)
        rises, falls = (q > before) & (q <= at), (q > at) & (q < after)
        return y, rises / (at - before) - falls / (after - at)


@dataclass(frozen=True)
class Counterbalance(MemorylessTerm):
    """A spring of length L, tau = k (L - L_0) dL/dq, L^2 = a^2 + b^2 - 2 a b cos(q - q_0)."""

    arm: float = 0.1  # a: from the axis to the point that moves with the joint
    base: float = 0.5  # b: from the axis to the fixed point
    angle: float = 0.0  # q_0, at which it is shortest
    rest: float = 0.0  # L_0

    label = "counterbalance"
    ends: ClassVar[Mapping[str, tuple[float, float]]] = {"arm": _POSITIVE, "base": _POSITIVE}
    units = ("N/m", "N/m")
    is_nonnegative = True
    is_shared = False
    typical = (50.0, 90.0)
    part = "spring"

    @staticmethod
    def position_law(q: Array, arm: float, base: float, angle: float, rest: float) -> Slope:
        c, s = arm * base * np.cos(q - angle), arm * base * np.sin(q - angle)
        length = np.sqrt(arm * arm + base * base - 2.0 * c)
        slope = s / length
        return (length - rest) * slope, (
            slope * slope + (length - rest) * (c - slope * slope) / length
        )


class Lag(DriveTerm):
    """A delayed torque, by a delay T or an elastic gear: to first order -T d(tau)/dt."""

    label = "lag"
    units = ("s", "s")
    has_state = True
    needs_load = True
    is_measured = True
    typical = (0.005, 0.02)
    part = "delay"

    def column(self, motion: DriveMotion) -> Array:
        """Return minus the time derivative of the whole torque."""
        return -motion.rate


#: The terms without shape parameters, by name, in the order of the parameters.
TERMS: dict[str, DriveTerm] = {
    term.name: term for term in (Armature(), Viscous(), Coulomb(), Offset())
}
#: Names of the terms that are identified by default.
DRIVE_TERMS = tuple(TERMS)

#: The terms with shape parameters, and those that a single joint may have, by class.
TERM_CLASSES: dict[str, type[DriveTerm]] = {
    kind.__name__: kind
    for kind in (
        Viscous, Coulomb, Asymmetric, LoadFriction, Cubic, Stribeck, Tanh, Power, Ramp, Harmonic,
        PositionCoulomb, Presliding, LuGre, Spring, Hat, Counterbalance, Lag,
    )
}  # fmt: skip

_SPEED = Shape("speed", ("rad/s", "m/s"), (0.005, 0.5), "v")
_RISE = Shape("speed", ("rad/s", "m/s"), (0.005, 1.0), "v")
_WAY = Shape("displacement", ("rad", "m"), (0.0005, 0.015), "q")
_KNOTS = 4  # of a piecewise-linear curve of friction
_TABLE = 8  # entries of a tabulated spring


def _curve(data_range: DataRange) -> tuple[DriveTerm, ...]:
    """Return the ramps of a monotone curve over the data's speeds, narrower at low speed."""
    knots = data_range["v"][1] * np.linspace(0.0, 1.0, _KNOTS + 1) ** 2
    pairs = enumerate(pairwise(knots.tolist()), start=1)
    return tuple(Ramp(number=k, low=a, high=b) for k, (a, b) in pairs)


def _table(data_range: DataRange) -> tuple[DriveTerm, ...]:
    """Return the entries of a tabulated spring except the middle one, which the offset covers."""
    knots = np.linspace(*data_range["q"], _TABLE + 1).tolist()
    step = knots[1] - knots[0]
    return tuple(
        Hat(data_range=data_range["q"], number=k, at=x, before=x - step, after=x + step)
        for k, x in enumerate(knots, start=1)
        if k != _TABLE // 2 + 1
    )


def _harmonics(data_range: DataRange, highest: int) -> tuple[DriveTerm, ...]:
    orders = [float(k) for k in range(1, highest + 1) for _ in range(2)]
    sines = (False, True) * highest
    return tuple(Harmonic(data_range["q"], *both) for both in zip(orders, sines, strict=True))


def _by_position(data_range: DataRange) -> tuple[DriveTerm, ...]:
    centre = 0.5 * (data_range["q"][0] + data_range["q"][1])
    return tuple(
        PositionCoulomb(data_range=data_range["q"], order=k, centre=centre) for k in (1, 2)
    )


_OTHER = "friction that is not viscous plus Coulomb"
_SLOW = "raise min_velocity to exclude the slow samples"
#: The families of a job's ``friction`` in addition to viscous and Coulomb friction, by name.
FAMILIES: dict[str, Family] = {
    family.name: family
    for family in (
        Family("load", "friction that grows with the load", lambda data_range: (LoadFriction(),),
               is_automatic=True, code="load_friction", has_size=True),
        Family("stribeck", f"{_OTHER} but increases towards zero speed (Stribeck)",
               lambda own, speed: (Stribeck(data_range=own["v"], speed=speed),), (_SPEED,),
               is_automatic=True, code="friction_shape", tested=((0.05,), (0.2,)),
               advice=f"{_SLOW[0].upper()}{_SLOW[1:]}"),
        Family("tanh", f"{_OTHER} but rises with speed and saturates, or stiction",
               lambda data_range, speed: (Tanh(data_range=data_range["v"], speed=speed),), (_RISE,),
               is_automatic=True, code="friction_shape", tested=((0.03,), (0.15,)),
               advice=f"Set friction_band, or {_SLOW}", is_imitated=True),
        Family("presliding", "friction that builds up after each reversal (presliding)",
               lambda data_range, way: (Presliding(displacement=way),), (_WAY,), is_automatic=True),
        Family("lag", "a delayed torque (a delay, an elastic gear)",
               lambda data_range: (Lag(),), is_automatic=True),
        Family("harmonics1", "a torque with one period per revolution, as of a counterbalance",
               # unguarded, since gravity contains them too
               lambda data_range: (Harmonic(), Harmonic(is_sine=True)), needs=0.1),
        Family("harmonics2", "a spring or counterbalance torque that depends on the position",
               lambda own: _harmonics(own, 2), needs=0.5, is_automatic=True, code="spring",
               instead=("harmonics1", "spring")),
        Family("harmonics4",
               "a torque that is periodic in the joint's position (cogging, an eccentric gear)",
               lambda own: _harmonics(own, 4), needs=0.5, is_automatic=True,
               code="position_periodic"),
        Family("asymmetric", "viscous friction that differs by direction",
               lambda data_range: (Asymmetric(),), is_automatic=True, code="friction_shape",
               has_size=True),
        Family("power", f"{_OTHER} but nonlinear in the speed, as |v|^(1/3)",
               lambda data_range, exponent: (Power(data_range=data_range["v"], exponent=exponent),),
               (Shape("exponent", ("-", "-"), (0.1, 0.9)),), code="friction_shape",
               tested=((1.0 / 3.0,),)),
        Family("cubic", f"{_OTHER} but nonlinear in the speed, as v^3",
               lambda data_range: (Cubic(data_range=data_range["v"]),), code="friction_shape"),
        Family("curve", "friction as a monotone curve over speed", _curve),
        Family("lugre", "presliding with Stribeck effect (LuGre)",
               lambda data_range, way, speed, excess: (
                   LuGre(displacement=way, speed=speed, excess=excess),
               ),
               (_WAY, _SPEED, Shape("excess", ("-", "-"), (0.01, 3.0)))),
        Family("position", "Coulomb friction that depends on the position", _by_position),
        Family("spring", "a linear spring at the joint", lambda own: (Spring(data_range=own["q"]),),
               code="spring", has_size=True),
        Family("spring_table", "a nonlinear spring (table)", _table),
    )
}  # fmt: skip


def has_turned(family: str, turned: float) -> bool:
    """Return whether a joint covered 1.1 times the range of positions that a family needs."""
    return _SPARE * FAMILIES[family].needs * 2 * np.pi <= turned


def drive_line(joint: str, *entries: str | DriveTerm) -> str:
    """Return the line of a job's [drives] with the families or terms of a joint."""
    return f"{toml_key(joint)} = [{', '.join(map(_toml_entry, entries))}]"


def _toml_entry(entry: str | DriveTerm) -> str:
    if isinstance(entry, str):
        return json.dumps(entry)
    table = {key: value for key, value in entry.to_dict().items() if key != "data_range"}
    return "{ " + ", ".join(f"{key} = {json.dumps(x)}" for key, x in table.items()) + " }"


def wanted_families(
    friction: str | Mapping[str, str], joints: Sequence[str]
) -> dict[str, tuple[str, ...] | None]:
    """Return the names of each joint's families; None where they are chosen from the data."""
    permitted = "auto, names of families joined by +, or a table of these by joint"
    require_kind(friction, (str, Mapping), "friction", permitted)
    stated = {"*": friction} if isinstance(friction, str) else {"*": AUTO, **friction}
    for joint, names in stated.items():
        require_kind(names, str, f"friction of {joint}", permitted)
    unknown_joints = [joint for joint in stated if joint not in (*joints, "*")]
    if unknown_joints:
        raise SettingsError(
            f"friction is given for {listed(unknown_joints)}, expected joints that are "
            f"identified: {listed(joints)}"
        )
    wanted: dict[str, tuple[str, ...] | None] = {}
    for joint in joints:
        names = stated.get(joint, stated["*"])
        families = [name for name in names.split("+") if name and name not in _OF_MODEL]
        unknown = [name for name in families if name not in FAMILIES]
        if names != AUTO and unknown:
            raise SettingsError(
                f"friction of {joint} has {listed(unknown)}, expected auto, or some of "
                f"{listed(FAMILIES)}"
            )
        wanted[joint] = None if names == AUTO else tuple(families)
    return wanted


def term_from_dict(table: Mapping[str, Any]) -> DriveTerm:
    """Return a term from its plain values, as of ``DriveTerm.to_dict``."""
    if not isinstance(table, Mapping):
        raise SettingsError(
            f"a drive term is {table!r}, expected a table, for example "
            "{ term = 'Stribeck', speed = 0.1 }"
        )
    kind = TERM_CLASSES.get(str(table.get("term")))
    if kind is None:
        raise SettingsError(f"term {table.get('term')!r} is not one of {listed(TERM_CLASSES)}")
    known: dict[str, Any] = {field.name: field.default for field in fields(kind)}
    values = {key: value for key, value in table.items() if key != "term"}
    for key, value in values.items():
        if key not in known:
            raise SettingsError(f"{kind.__name__} has no {key!r}; it has {listed(known)}")
        if isinstance(value, list):
            values[key] = tuple(value)
        elif is_number(value) and not isinstance(known[key], bool):
            values[key] = type(known[key])(value)
    return kind(**values)
