"""Consistency of the stated gains with bodies and torques: the scale that these indicate."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from robotid.base.typing import Array
from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.estimators.output_error import OutputError, is_at_bound
from robotid.identification.closed_loop.free_parameters import FreeParameter, LoopSimulator

_GAINS = ("kp", "kd")
_DIFFERS = 3.0  # smallest significant difference of a scale [standard errors]
_LARGE = 0.05  # smallest relevant difference of a scale; missing friction terms cause smaller ones


@dataclass(frozen=True, eq=False)
class GainScale:
    """Relative change of the gains that makes them consistent with bodies and torques.

    Attributes:
        change: Relative change of each joint's gains, shape (n,) [-].
        error: Standard errors of ``change``, shape (n,); inf where it is not identifiable.
        common: Relative change of all gains by one factor [-].
        common_error: Standard error of ``common``.
    """

    change: Array
    error: Array
    common: float
    common_error: float

    @property
    def is_wrong(self) -> bool:
        """Whether the common factor of all gains is not 1, and every joint is consistent with it.

        Different factors indicate another model error, so that the gains are not questioned.
        """
        agree = np.abs(self.change - self.common) <= _DIFFERS * np.hypot(
            self.error, self.common_error
        )
        is_other = abs(self.common) > max(_DIFFERS * self.common_error, _LARGE)
        return bool(is_other and agree.all())


def gain_scale(simulator: LoopSimulator, estimator: OutputError, estimate: Estimate) -> GainScale:
    """Return the scale of the stated gains that bodies, and fitted torques, indicate.

    All drive parameters scale with the gains; weight and inertia of the bodies do not, within their
    prior. The scale is of first order: one Gauss-Newton step of gains and all free parameters.
    """
    n, c = len(simulator.base.kp), len(estimate.theta)
    gains = tuple(_gains(simulator))
    wide = replace(simulator, free_parameters=(*simulator.free_parameters, *gains))
    theta = np.concatenate([estimate.theta, [gain.prior for gain in gains]])
    H, g = estimator.normal(wide, estimator.weights(wide, theta), theta, frees=True)
    T = np.zeros((len(theta), c + n))  # from free parameters and joint scales to all parameters
    T[:c, :c] = np.eye(c)
    for k, gain in enumerate(gains, start=c):
        T[k, c + gain.joints[0]] = gain.prior
    free = np.concatenate([~is_at_bound(simulator, estimate.theta), np.ones(n, dtype=bool)])
    T = T[:, free]
    inflation = max(float(estimate.details["inflation"]), 1.0)
    change, error = _last(T.T @ H @ T, T.T @ g, n)
    together = np.column_stack([T[:, :-n], T[:, -n:].sum(axis=1)])
    common, own = _last(together.T @ H @ together, together.T @ g, 1)
    spread = np.sqrt(inflation)
    return GainScale(change, spread * error, float(common[0]), float(spread * own[0]))


def _gains(simulator: LoopSimulator) -> Iterator[FreeParameter]:
    """Yield the gains of all joints as free parameters without a prior."""
    for what in _GAINS:
        if any(free.what == what for free in simulator.free_parameters):
            continue  # it is fitted, so that it scales with the other one
        for j, value in enumerate(getattr(simulator.base, what).tolist()):
            joint = simulator.robot.model.joints[j]
            yield FreeParameter(f"{joint}.{what} as stated", what, (j,), value, np.inf)


def _last(H: Array, g: Array, n: int) -> tuple[Array, Array]:
    """Return the last n entries of x, H x = g, and their errors; inf where H is singular."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, V = scipy.linalg.eigh(H * np.outer(scale, scale))
    regular = values > 1e-12 * values[-1]
    inverse = (V[:, regular] / values[regular]) @ V[:, regular].T
    x, variance = scale * (inverse @ (scale * g)), np.diag(inverse) * scale**2
    is_singular = (V[:, ~regular] ** 2).sum(axis=1) > 1e-6
    return x[-n:], np.where(is_singular, np.inf, np.sqrt(variance))[-n:]
