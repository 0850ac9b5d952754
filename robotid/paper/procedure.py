"""Settings of the closed-loop procedure, what disturbs it, and the record of what happened."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.paper.formulas import Bounds, Sign

__all__ = ["History", "Influences", "LoopSettings", "random_torque"]


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the procedure; alpha, beta and eps2 may differ from run to run, shape (R,).

    Attributes:
        alpha: Gain of the velocity in (15) [1/s].
        beta: Gain of the position in (15) [1/s^2].
        iterations: Most runs of the motion.
        updates: Updates per run; the torque is held in between.
        substeps: Runge-Kutta steps per update; stiff friction needs several.
        method: ``"recursive"``, (24) at each update, or ``"one_shot"``, (18) after each run.
        sign: Sign in (23); with the printed one the procedure never stops.
        eps1: Where no entry of PRX is larger, it counts as zero [N m / s^2].
        eps2: Where |Psi|^2 is not above it, nothing is updated [1/s^4].
        bounds: Omega of (8), or None.
    """

    alpha: float | Array = 20.0
    beta: float | Array = 100.0
    iterations: int = 100
    updates: int = 100
    substeps: int = 1
    method: Literal["recursive", "one_shot"] = "recursive"
    sign: Sign = "corrected"
    eps1: float = 1e-9
    eps2: float | Array = 1e-12
    bounds: Bounds | None = None

    def __post_init__(self) -> None:
        for name in ("alpha", "beta", "eps1", "eps2", "iterations", "updates", "substeps"):
            value = getattr(self, name)
            if not np.all((np.asarray(value) > 0) & (np.asarray(value) < np.inf)):
                raise SettingsError(f"{name} is {value}, wanted a positive number")
        if self.method not in ("recursive", "one_shot"):
            raise SettingsError(f"method is {self.method!r}, wanted 'recursive' or 'one_shot'")


@dataclass(frozen=True)
class Influences:
    """What acts on the plant and its sensors beside the control.

    Attributes:
        torque: v(t) of (11), from the times, shape (R,), and the control, shape (R, n), to
            torques, shape (R, n); asked for once per update and held. None for none.
        q, v, a: Standard deviations of white noise on positions [rad or m], velocities and
            accelerations; each a number or an array that fits (R, n).
        rng: Source of the noise; needed if there is any.
    """

    torque: Callable[[Array, Array], Array] | None = None
    q: float | Array = 0.0
    v: float | Array = 0.0
    a: float | Array = 0.0
    rng: np.random.Generator | None = None

    def __post_init__(self) -> None:
        if self.rng is None and any(np.any(np.asarray(x) != 0) for x in (self.q, self.v, self.a)):
            raise SettingsError("sensor noise needs rng, the source of its random numbers")

    def sense(self, value: Array, level: float | Array) -> Array:
        """Return what a sensor reads.

        Args:
            value: The true values, shape (R, n).
            level: Standard deviation of the noise.

        Returns:
            Values with noise, shape (R, n).
        """
        if self.rng is None or not np.any(np.asarray(level) != 0):
            return value
        noisy: Array = value + level * self.rng.standard_normal(value.shape)
        return noisy


@dataclass(frozen=True)
class History:
    """What happened, over L iterations of R runs.

    Attributes:
        estimates: P^ before the first iteration and after each, shape (L + 1, R, c).
        prx: Largest entry of PRX (23) during each iteration, shape (L, R) [N m / s^2].
        tracking: Largest distance from the program in each iteration, shape (L, R) [rad or m].
        NA: The iteration in which PRX was zero throughout for the first time (25), after which
            the estimate stays; 0 if there was none, shape (R,).
        lost: The iteration in which the robot ran away from its program, 0 if it did not, shape
            (R,). Its estimate stays from there on.
        skipped: Updates left out since D(q, P^) was not positive definite, shape (R,).
        torques: Control u (21), shape (L, updates, R, n) [N m or N], if it was asked for.
    """

    estimates: Array
    prx: Array
    tracking: Array
    NA: NDArray[np.int_]
    lost: NDArray[np.int_]
    skipped: NDArray[np.int_]
    torques: Array | None = field(default=None, repr=False)

    def relative_error(self, P: Array) -> Array:
        """Return |P^ - P| / |P| before the first iteration and after each.

        Args:
            P: True parameters, shape (c,).

        Returns:
            Relative errors, shape (L + 1, R).
        """
        error: Array = np.linalg.norm(self.estimates - P, axis=-1) / np.linalg.norm(P)
        return error


def random_torque(
    share: float | Array, rng: np.random.Generator
) -> Callable[[Array, Array], Array]:
    """Return a disturbance v(t), uniform within a share of the control at every update.

    Args:
        share: Largest size as a share of the control, a number or an array that fits (R, n) [-].
        rng: Source of the disturbance.

    Returns:
        A function for ``Influences``.

    References:
        Tzvetkova, (2) and (11).
    """

    def torque(t: Array, u: Array) -> Array:
        disturbance: Array = share * u * rng.uniform(-1.0, 1.0, u.shape)
        return disturbance

    return torque
