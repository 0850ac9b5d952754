"""Whether bodies and torques agree with the gains that were stated: the scale that they show."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.closed_loop.free_parameters import FreeParameter, LoopSimulator
from robotid.estimators.estimator import Estimate
from robotid.estimators.output_error import OutputError

__all__ = ["GainScale", "gain_scale"]

_GAINS = ("kp", "kd")
_DIFFERS = 3.0  # standard errors, from which a scale is another ...
_LARGE = 0.05  # ... if it is off by this share, too: friction that the model lacks shows as less


@dataclass(frozen=True, eq=False)
class GainScale:
    """By how much gains would have to be larger to agree with bodies and torques, 0 if they do.

    Attributes:
        change: Of each joint's gains by itself, shape (n,) [-].
        error: Their standard errors, shape (n,); inf where nothing shows them.
        common: Of all gains by one factor [-].
        common_error: Its standard error.
    """

    change: Array
    error: Array
    common: float
    common_error: float

    @property
    def is_wrong(self) -> bool:
        """Whether one factor of all gains is not 1, and every joint by itself shows it.

        Where joints show different ones, the model lacks something else: no gain is concluded.
        """
        agree = np.abs(self.change - self.common) <= _DIFFERS * np.hypot(
            self.error, self.common_error
        )
        is_other = abs(self.common) > max(_DIFFERS * self.common_error, _LARGE)
        return bool(is_other and agree.all())


def gain_scale(simulator: LoopSimulator, estimator: OutputError, estimate: Estimate) -> GainScale:
    """Return the scale of the stated gains that bodies, and torques if they weigh, would show.

    All drive parameters scale with the gains; the bodies' weight and inertia do not, as far as they
    are known. It is to first order: one step of all parameters beside the gains.

    Args:
        simulator: What was fitted, with stated gains.
        estimator: How residuals weigh.
        estimate: The estimate.

    Raises:
        NotConvergedError: If it cannot be simulated.
    """
    n, c = len(simulator.base.kp), len(estimate.theta)
    gains = tuple(_gains(simulator))
    wide = replace(simulator, free_parameters=(*simulator.free_parameters, *gains))
    theta = np.concatenate([estimate.theta, [gain.prior for gain in gains]])
    H, g = estimator.normal(wide, estimator.weights(wide, theta), theta, frees=True)
    T = np.zeros((len(theta), c + n))  # parameters of the scales of joints
    T[:c, :c] = np.eye(c)
    for k, gain in enumerate(gains, start=c):
        T[k, c + gain.joints[0]] = gain.prior
    free = np.concatenate([estimate.theta > simulator.lowest, np.ones(n, dtype=bool)])
    T = T[:, free]
    inflation = max(float(estimate.details["inflation"]), 1.0)
    change, error = _last(T.T @ H @ T, T.T @ g, n)
    together = np.column_stack([T[:, :-n], T[:, -n:].sum(axis=1)])
    common, own = _last(together.T @ H @ together, together.T @ g, 1)
    spread = np.sqrt(inflation)
    return GainScale(change, spread * error, float(common[0]), float(spread * own[0]))


def _gains(simulator: LoopSimulator) -> Iterator[FreeParameter]:
    """Yield the gains of all joints as unknowns, of which nothing else is known."""
    for what in _GAINS:
        if any(unknown.what == what for unknown in simulator.free_parameters):
            continue  # it is found, and follows the other one by itself
        for j, value in enumerate(getattr(simulator.base, what).tolist()):
            joint = simulator.robot.model.joints[j]
            yield FreeParameter(f"{joint}.{what} as stated", what, (j,), value, np.inf)


def _last(H: Array, g: Array, n: int) -> tuple[Array, Array]:
    """Return the last n unknowns of H x = g and their errors, inf of what H leaves open."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, V = scipy.linalg.eigh(H * np.outer(scale, scale))
    kept = values > 1e-12 * values[-1]
    inverse = (V[:, kept] / values[kept]) @ V[:, kept].T
    x, variance = scale * (inverse @ (scale * g)), np.diag(inverse) * scale**2
    is_open = (V[:, ~kept] ** 2).sum(axis=1) > 1e-6
    return x[-n:], np.where(is_open, np.inf, np.sqrt(variance))[-n:]
