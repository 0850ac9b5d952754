"""Reference motions: Fourier series, quintics from rest to rest, samples."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.typing import Array
from robotid.robot.model import RobotModel

_ORDER = 5  # of the polynomials through samples
_HARMONICS = 5  # of a random motion
# largest amplitude and peak speed of a revolute [rad, rad/s] and of a prismatic joint [m, m/s]
_LARGEST = ((1.2, 1.5), (0.15, 0.3))


class Motion(Protocol):
    """A motion that a controller can track."""

    def evaluate(self, t: Array) -> tuple[Array, Array, Array]:
        """Return q, v, a, each of shape (N, n) [rad, rad/s, rad/s^2 or m, m/s, m/s^2]."""


@dataclass(frozen=True, eq=False)
class FourierTrajectory(Motion):
    """A motion q0 + sum s_k sin(k w t) + c_k cos(k w t), w = 2 pi / period (Swevers 1997)."""

    q0: Array  # mean position, shape (n,) [rad or m]
    sine: Array  # coefficients s_k, shape (h, n) [rad or m]
    cosine: Array  # coefficients c_k, shape (h, n) [rad or m]
    period: float  # [s]

    def evaluate(self, t: Array) -> tuple[Array, Array, Array]:
        w = 2 * np.pi / self.period * np.arange(1, len(self.sine) + 1)  # (h,)
        sin, cos = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))  # (N, h)
        q = self.q0 + sin @ self.sine + cos @ self.cosine
        v = (cos * w) @ self.sine - (sin * w) @ self.cosine
        a = -(sin * w**2) @ self.sine - (cos * w**2) @ self.cosine
        return q, v, a


@dataclass(frozen=True)
class ProgramMotion(Motion):
    """The motion q0 + A (6 s^5 - 15 s^4 + 10 s^3), s = t / T within 0 and 1 (Tzvetkova, (28))."""

    amplitude: Array  # A, displacement of each joint, (n,), or (R, n) for R motions [rad or m]
    duration: float | Array  # T, one for all or one per motion, shape () or (R,) [s]
    start: float | Array = 0.0  # q0, of the amplitude's shape or that of one motion [rad or m]

    def __post_init__(self) -> None:
        A, T = np.asarray(self.amplitude, dtype=float), np.asarray(self.duration, dtype=float)
        if A.ndim not in (1, 2) or not np.isfinite(A).all():
            raise DataError(f"amplitude has shape {A.shape}, expected (n,) or (R, n), finite")
        if T.ndim > 0 and T.shape != A.shape[:-1]:
            raise DataError(f"duration has shape {T.shape}, expected () or {A.shape[:-1]}")
        if not np.all((T > 0) & (np.inf > T)):
            raise SettingsError(f"duration is {self.duration}, expected a positive number")

    def evaluate(self, t: Array | float) -> tuple[Array, Array, Array]:
        """Return q, v and a as in ``Motion``, each of shape t.shape + (n,), or (R, n): t (R,)."""
        A, T = np.asarray(self.amplitude, dtype=float), np.asarray(self.duration)[..., None]
        s = np.clip(np.asarray(t, dtype=float)[..., None] / T, 0.0, 1.0)  # t / T
        q = self.start + A * (6 * s**5 - 15 * s**4 + 10 * s**3)
        v = A * (30 * s**4 - 60 * s**3 + 30 * s**2) / T
        a = A * (120 * s**3 - 180 * s**2 + 60 * s) / T**2
        return q, v, a


@dataclass(frozen=True, eq=False)
class SampledMotion(Motion):
    """A motion through samples from time 0: quintics through q, v, a, or a spline through q."""

    t: Array  # shape (N,) [s]
    q: Array  # shape (N, n) [rad or m]
    v: Array | None = None  # [rad/s or m/s]
    a: Array | None = None  # [rad/s^2 or m/s^2]

    def __post_init__(self) -> None:
        if len(self.t) < _ORDER + 1:
            raise DataError(f"the motion has {len(self.t)} rows, expected at least {_ORDER + 1}")

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.t[-1] - self.t[0])

    @cached_property
    def _curves(self) -> tuple[Any, Any, Any]:
        """The position and its derivatives, functions of time since the start."""
        from scipy.interpolate import BPoly, make_interp_spline

        t = self.t - self.t[0]
        if self.v is None or self.a is None:
            curve = make_interp_spline(t, self.q, k=_ORDER)
        else:
            curve = BPoly.from_derivatives(t, np.stack([self.q, self.v, self.a], axis=1))
        return curve, curve.derivative(1), curve.derivative(2)

    def evaluate(self, t: Array) -> tuple[Array, Array, Array]:
        q, v, a = (curve(t) for curve in self._curves)
        return q, v, a


def random_fourier(
    model: RobotModel, rng: np.random.Generator, *, period: float = 10.0
) -> FourierTrajectory:
    """Return a random motion about the middle of a robot's limits, or 0, within these limits."""
    n = len(model.joints)
    sine, cosine = rng.standard_normal((2, _HARMONICS, n)) / np.arange(1, _HARMONICS + 1)[:, None]
    mean = np.array([(j.lower + j.upper) / 2 if j.has_limits else 0.0 for j in model.limits])
    amplitude, speed = np.empty(n), np.empty(n)
    for j, joint in enumerate(model.limits):
        size, highest = _LARGEST[joint.type == "prismatic"]
        room = min(joint.upper - mean[j], mean[j] - joint.lower) if joint.has_limits else np.inf
        amplitude[j] = min(size, 0.9 * room)
        speed[j] = min(highest, 0.9 * joint.velocity) if joint.velocity > 0 else highest
    unit = FourierTrajectory(np.zeros(n), sine, cosine, period)
    q, v, _ = unit.evaluate(np.linspace(0.0, period, 1000))
    scale = np.minimum(amplitude / np.abs(q).max(axis=0), speed / np.abs(v).max(axis=0))
    return FourierTrajectory(mean, sine * scale, cosine * scale, period)
