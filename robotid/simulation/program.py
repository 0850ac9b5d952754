"""The program motion: a quintic from rest to rest, for any number of joints and of runs."""

from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError, SettingsError

__all__ = ["ProgramMotion"]


@dataclass(frozen=True)
class ProgramMotion:
    """The motion q(t) = q0 + A (a1 t^5 + a2 t^4 + a3 t^3), from rest to rest.

    The coefficients a1 = 6 / T^5, a2 = -15 / T^4, a3 = 10 / T^3 take q from q0 to q0 + A and leave
    no velocity and no acceleration at either end. Before 0 and after T the robot rests.

    Attributes:
        amplitude: A, the way each joint goes, shape (n,), or (R, n) for R motions [rad or m].
        duration: T, one for all or one per motion, shape () or (R,) [s].
        start: q0, of the shape of the amplitude or that of one motion [rad or m]; 0 if left out.

    References:
        Tzvetkova, (28).
    """

    amplitude: Array
    duration: float | Array
    start: float | Array = 0.0

    def __post_init__(self) -> None:
        A, T = np.asarray(self.amplitude, dtype=float), np.asarray(self.duration, dtype=float)
        if A.ndim not in (1, 2) or not np.isfinite(A).all():
            raise DataError(f"amplitude has shape {A.shape}, wanted (n,) or (R, n), finite")
        if T.ndim > 0 and T.shape != A.shape[:-1]:
            raise DataError(f"duration has shape {T.shape}, wanted () or {A.shape[:-1]}")
        if not np.all((T > 0) & (np.inf > T)):
            raise SettingsError(f"duration is {self.duration}, wanted a positive number")

    def evaluate(self, t: Array | float) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration.

        Args:
            t: Times of one motion, any shape, or one per motion, shape (R,) [s].

        Returns:
            q [rad], v [rad/s] and a [rad/s^2] (or m), each of shape t.shape + (n,), or (R, n).
        """
        A, T = np.asarray(self.amplitude, dtype=float), np.asarray(self.duration)[..., None]
        s = np.clip(np.asarray(t, dtype=float)[..., None] / T, 0.0, 1.0)  # t / T
        q = self.start + A * (6 * s**5 - 15 * s**4 + 10 * s**3)
        v = A * (30 * s**4 - 60 * s**3 + 30 * s**2) / T
        a = A * (120 * s**3 - 180 * s**2 + 60 * s) / T**2
        return q, v, a
