"""Gradient methods: one step per sample along the gradient, passes in random order.

They use scaled parameters x = scale theta, for which every column has unit norm. The residual is
e = Psi P^ - tau, with the sign of the paper.
"""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.typing import Array
from robotid.dynamics.problem import Problem, Sample, shuffled
from robotid.estimation.estimators.batch import SILENT
from robotid.estimation.estimators.estimator import (
    ALIKE,
    ROUNDING,
    Estimate,
    Weighing,
    require_rows,
)
from robotid.estimation.estimators.recursive import (
    RecursiveEstimator,
    fold,
    scaled_rows,
)

#: Rows of a sample: all, or the indices of the rows of positive weight.
Rows: TypeAlias = slice | Array

_AVERAGE = 3.0  # weight of the newest iterate: 3 / (k + 2), the initial value decays as k^-3
_MEMORY = 1000.0  # [samples] over which PRX and the residuals are averaged
_SMALLEST = 1e-6  # lower bound of the eigenvalues of D(q, P^), relative to the largest
_NO_PRX = 1e-9  # norm of the moving average of PRX below which it is 0, scaled parameters
_GAIN = 0.01  # relative decrease of the squared residual per pass at convergence


@dataclass(frozen=True, eq=False)
class DescentState:
    """State of a gradient method."""

    x: Array  # (c,), scaled parameters
    mean: Array  # (c,), average of the iterates
    prx: Array  # (c,), moving average of PRX (23) at the estimate, in scaled parameters
    prx_square: float  # moving average of its squared norm
    squares: Array  # (n,), moving average of the squared residual [(N m)^2 or N^2]
    steps: int  # samples read
    skipped: int  # samples without information, |Psi|^2 <= eps2
    rows: int  # rows used


@dataclass(frozen=True, eq=False)
class Descent(RecursiveEstimator[DescentState]):
    """Base class of gradient methods; subclasses define the step of the parameters by a sample.

    ``fit`` reads the samples in several passes, until PRX = 0. A gradient method has no estimate of
    its uncertainty: the covariance is infinite, rank and condition number are unknown.
    """

    sigma: Array  # (n,), noise level of each joint [N m or N]
    prior: Array | None = None  # (c,), initial values; 0 if None
    #: Column scaling, shape (c,); None: ``fit`` uses the column norms, ``init`` does not scale.
    scale: Array | None = None
    average: bool = True  # whether the estimate is the average of the iterates; better with noise
    passes: int = 4  # largest number of passes of ``fit``
    rng: np.random.Generator | None = None  # of the order of the samples; None: order of time

    @property
    def weighing(self) -> Weighing:
        return "by step"

    @abstractmethod
    def _moved(self, x: Array, Psi: Array, e: Array, used: Rows, sample: Sample) -> Array:
        """Return x, shape (c,), after rows Psi (k, c), residuals e (k,), both in units of noise."""

    def init(self, c: int) -> DescentState:
        x = np.zeros(c) if self.prior is None else self.prior * self._unit
        return DescentState(x, x, np.zeros(c), 0.0, np.zeros(len(self.sigma)), 0, 0, 0)

    def update(self, state: DescentState, sample: Sample) -> DescentState:
        c, sigma = len(state.x), self.sigma
        rows = scaled_rows(sample, sigma, c)  # (k, c + 1)
        Psi, tau = rows[:, :c], rows[:, c]
        if self.scale is not None:
            Psi = Psi / self.scale
        steps = state.steps + 1
        if np.vdot(Psi, Psi) <= ROUNDING:
            return replace(state, steps=steps, skipped=state.skipped + 1)
        # usually all rows are used, and a slice is fast
        used = slice(None) if len(rows) == len(sigma) else np.flatnonzero(sample.weight)
        x = self._moved(state.x, Psi, Psi @ state.x - tau, used, sample)
        newest = _AVERAGE / (steps + _AVERAGE - 1)
        mean = state.mean + (x - state.mean) * newest if self.average else x
        # residual of this sample for the averaged estimate before it
        e = Psi @ state.mean - tau
        prx = e @ Psi  # (23), (4): Psi^T (Psi P^ - u)
        share = 1.0 / min(steps, _MEMORY)
        squares = state.squares.copy()
        squares[used] += share * (e**2 * sigma[used] ** 2 / sample.weight[used] - squares[used])
        prx_square = state.prx_square + share * (float(prx @ prx) - state.prx_square)
        prx = state.prx + share * (prx - state.prx)
        count = state.rows + len(rows)
        return DescentState(x, mean, prx, prx_square, squares, steps, state.skipped, count)

    def estimate(self, state: DescentState, names: tuple[str, ...]) -> Estimate:
        c = len(names)
        prx = float(np.linalg.norm(state.prx))
        message = (
            f"{state.steps} steps, {state.skipped} without information, |PRX| = {prx:.3g}; "
            "a gradient method has no covariance, it is stated as infinite"
        )
        return Estimate(
            state.mean / self._unit, np.full((c, c), np.inf), names, np.sqrt(state.squares),
            rank=c, condition=float("inf"), undetermined=(), converged=self._is_zero(state),
            n_iter=state.steps, message=message,
        )  # fmt: skip

    def fit(self, data: Problem) -> Estimate:
        estimator, c = self, len(data.names)
        if self.scale is None and not self.needs_mass:
            estimator = replace(self, scale=column_scale(data, self.sigma))
        state, settled = estimator.init(c), False
        for _ in range(self.passes):
            before = state
            samples = data.samples() if self.rng is None else shuffled(data.samples(), self.rng)
            state = fold(estimator, samples, state)
            require_rows(state.rows, c, data.n_joints)
            settled = self._has_settled(before, state)
            if settled:
                break
        return replace(estimator.estimate(state, data.names), converged=settled)

    @property
    def _unit(self) -> Array | float:
        return 1.0 if self.scale is None else self.scale

    def _is_zero(self, state: DescentState) -> bool:
        """Return whether PRX = 0 (25): within rounding, or within its own scatter."""
        if state.steps < _MEMORY:
            return False
        norm = float(np.linalg.norm(state.prx))
        standard_error = np.sqrt(state.prx_square / (2 * _MEMORY))
        return norm <= _NO_PRX or norm <= ALIKE * standard_error

    def _has_settled(self, before: DescentState, after: DescentState) -> bool:
        """Return whether PRX = 0 after a pass; if it scatters, the residual must not decrease."""
        first, last = (float(np.sum(s.squares / self.sigma**2)) for s in (before, after))
        gain = 1.0 - last / first if first > 0 else 1.0
        is_small = float(np.linalg.norm(after.prx)) <= _NO_PRX
        return is_small or (self._is_zero(after) and gain < _GAIN)


@dataclass(frozen=True, eq=False)
class NormalisedGradient(Descent):
    """Normalised gradient (NLMS), the fastest recursive estimator.

    theta <- theta - Psi^T e / |Psi|_F^2, e = Psi theta - tau, rows in units of their noise. Without
    noise |theta~| does not increase. Goodwin, Sin (1984), Adaptive Filtering, Prediction and
    Control, 3.3.
    """

    def _moved(self, x: Array, Psi: Array, e: Array, used: Rows, sample: Sample) -> Array:
        return x - 1.0 / np.vdot(Psi, Psi) * (e @ Psi)


@dataclass(frozen=True, eq=False)
class PRX(Descent):
    """The paper's update P^ <- P^ - gamma Psi^T eta (24), with e = Psi P^ - tau.

    * step "printed": eta = D^-1 e, gamma = sigma_D / |Psi|_F^2, sigma_D the smallest eigenvalue of
      D(q, P^). For an arm with six joints the steps are very small.
    * step "exact": eta = e, rows in units of their noise; gamma = e^T e / |Psi^T e|^2, the
      minimiser of |P~| along the direction.

    Without noise |P~| does not increase: with "exact" always, with "printed" if
    sigma_min(D(q, P^)) <= 2 sigma_min(D(q, P)). With column scaling this is the norm of scale * P~.

    With noise each iterate changes by about the noise of its sample: on recordings of a UR10e and a
    Panda the prediction error of the last iterate is 1.3 to 1.9 times that of weighted least
    squares, and that of the average, the k-th iterate weighted by k^2, 1.03 to 1.05 times. ``fit``
    scales the columns for step "exact" only. Tzvetkova, Extracting Inertial Parameters from Robotic
    Manipulators Dynamics, (20)-(25).
    """

    step: str = "exact"  # or "printed"

    def __post_init__(self) -> None:
        if self.step not in ("exact", "printed"):
            raise DataError(f"step is {self.step!r}, wanted 'exact' or 'printed'")

    @property
    def needs_mass(self) -> bool:
        return self.step == "printed"

    def _moved(self, x: Array, Psi: Array, e: Array, used: Rows, sample: Sample) -> Array:
        if self.step == "exact":
            direction = e @ Psi
            square = direction @ direction
            return x - ((e @ e) / square if square > 0 else 0.0) * direction
        Psi = sample.Y[used] / self._unit  # rows as in the paper
        values, vectors = self._inertia(x, sample)
        e = np.zeros(len(values))
        e[used] = Psi @ x - sample.tau[used]
        eta = vectors @ ((e @ vectors) / values)  # D^-1 e (20)
        gamma = values[0] / np.vdot(Psi, Psi)  # sigma_D / |Psi|_F^2
        return np.asarray(x - gamma * (eta[used] @ Psi))  # (24)

    def _inertia(self, x: Array, sample: Sample) -> tuple[Array, Array]:
        """Return eigenvalues and eigenvectors of D(q, P^), which is linear in P^ (11).

        The proof needs a positive definite D: smaller eigenvalues are replaced by a positive bound.
        """
        if sample.mass_regressor is None:
            raise DataError(
                "PRX needs the mass regressor of each sample, found none; build the problem with "
                "build_problem(..., with_mass=True)"
            )
        D = sample.mass_regressor @ (x / self._unit)  # (n, n)
        if not np.isfinite(D).all():
            raise DataError("the mass regressor of the sample is not finite; it was not used")
        values, vectors = np.linalg.eigh((D + D.T) / 2)
        largest = float(np.abs(values).max())
        return np.maximum(values, _SMALLEST * largest if largest > 0 else 1.0), vectors


def column_scale(problem: Problem, sigma: Array) -> Array:
    """Return the RMS of columns, (c,), rows in units of their noise (n,); 1 of a silent column."""
    n, c = problem.n_joints, len(problem.names)
    squares, count = np.zeros(c), 0
    for W, _, weight in problem.blocks():
        row_weight = (weight.reshape(-1, n) / sigma**2).reshape(-1)
        squares += row_weight @ np.where(row_weight[:, None] > 0, W, 0.0) ** 2
        count += len(W) // n
    if not np.isfinite(squares).all():
        raise DataError("the problem has a row that is not finite; check the trajectory")
    rms = np.sqrt(squares / max(count, 1))
    return np.where(rms > SILENT * rms.max(initial=0.0), rms, 1.0)
