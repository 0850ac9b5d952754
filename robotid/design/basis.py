"""Motions linear in their coefficients, at rest at both ends: q(t) = Phi(t) C."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.linalg

from robotid.base.exceptions import SettingsError
from robotid.base.typing import Array
from robotid.dynamics.simulation.motions import Motion

_DEGREE = 5  # of B-splines: their jerk is continuous


class Basis(Protocol):
    """Basis functions of a joint's motion; the first one is constant 1."""

    duration: float  # [s]

    @property
    def size(self) -> int:
        """Number of functions."""

    @property
    def shortest(self) -> float:
        """Shortest period [s]."""

    def derivatives(self, t: Array, order: int) -> Array:
        """Return the functions and their derivatives, shape (order + 1, N, size): t (N,) [s]."""


@dataclass(frozen=True)
class FourierBasis(Basis):
    """Sines and cosines of the first harmonics of 1 / duration, at rest at both ends.

    Two of the 2 h coefficients of a joint are fixed by the ends: sum k s_k = 0 makes its velocity 0
    there, and sum k^2 c_k = 0 its acceleration.

    References:
        Swevers et al. (1997), Optimal robot excitation and identification.
    """

    duration: float
    harmonics: int = 5

    def __post_init__(self) -> None:
        if self.harmonics < 2:
            raise SettingsError(
                f"harmonics is {self.harmonics}, wanted 2 or more: one cannot start at rest"
            )

    @property
    def size(self) -> int:
        return 2 * self.harmonics - 1

    @property
    def shortest(self) -> float:
        return self.duration / self.harmonics

    @cached_property
    def _free(self) -> Array:
        """The sums of sines and cosines that are at rest at the ends, shape (2 h, 2 h - 2)."""
        k, none = np.arange(1.0, self.harmonics + 1), np.zeros(self.harmonics)
        return np.asarray(scipy.linalg.null_space([np.r_[k, none], np.r_[none, k**2]]))

    def derivatives(self, t: Array, order: int) -> Array:
        w = 2 * np.pi / self.duration * np.arange(1, self.harmonics + 1)
        turn = np.exp(1j * np.outer(t, w))
        out = np.empty((order + 1, len(t), self.size))
        for d in range(order + 1):
            waves = turn * (1j * w) ** d
            out[d, :, 0] = float(d == 0)
            out[d, :, 1:] = np.hstack([waves.imag, waves.real]) @ self._free
        return out


@dataclass(frozen=True)
class BSplineBasis(Basis):
    """B-splines of degree 5 on uniform knots; three equal coefficients at each end: at rest."""

    duration: float
    pieces: int = 12

    def __post_init__(self) -> None:
        if self.pieces < 3:
            raise SettingsError(f"pieces is {self.pieces}, wanted 3 or more")

    @property
    def size(self) -> int:
        return self.pieces + _DEGREE - 4

    @property
    def shortest(self) -> float:
        return 2.0 * self.duration / self.pieces

    def derivatives(self, t: Array, order: int) -> Array:
        from scipy.interpolate import BSpline

        inner = np.linspace(0.0, self.duration, self.pieces + 1)
        knots = np.r_[[0.0] * _DEGREE, inner, [self.duration] * _DEGREE]
        splines = BSpline(knots, np.eye(self.pieces + _DEGREE), _DEGREE)
        out = np.empty((order + 1, len(t), self.size))
        for d in range(order + 1):
            values = splines(np.clip(t, 0.0, self.duration), nu=d)
            first, last = values[:, :3].sum(axis=1), values[:, -3:].sum(axis=1)
            free = np.column_stack([first, values[:, 3:-3], last])
            out[d] = np.column_stack([np.full(len(t), float(d == 0)), free[:, 1:]])
        return out


@dataclass(frozen=True, eq=False)
class DesignedMotion(Motion):
    """A motion q(t) = Phi(t) C."""

    basis: Basis  # the functions Phi of time
    coefficients: Array  # C, shape (size, n) [rad or m]

    def evaluate(self, t: Array) -> tuple[Array, Array, Array]:
        q, v, a = self.basis.derivatives(t, 2) @ self.coefficients
        return q, v, a
