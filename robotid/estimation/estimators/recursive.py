"""Recursive estimators: interface, recursive least squares, Kalman filter, gradient methods."""

import math
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import ClassVar, Generic, Literal, TypeVar

import numpy as np
from scipy.linalg.lapack import dtpqrt

from robotid.base.exceptions import DataError, RankDeficientError
from robotid.base.tolerances import ROUNDING
from robotid.base.typing import Array
from robotid.dynamics.factors import PANEL, Factors, Problem, Sample, shuffled
from robotid.estimation.estimators.batch import SILENT, solve_factor
from robotid.estimation.estimators.determination import PRIOR_LED
from robotid.estimation.estimators.estimator import (
    ALIKE,
    Estimate,
    Estimator,
    Weighing,
    require_rows,
)

StateT = TypeVar("StateT")

_PATIENCE = 50  # largest number of successive rows of a joint that the gate rejects
_AVERAGE = 3.0  # weight of the newest iterate: 3 / (k + 2), the initial value decays as k^-3
_MEMORY = 1000.0  # [samples] over which PRX and the residuals are averaged
_NO_PRX = 1e-9  # norm of the moving average of PRX below which it is 0, scaled parameters
_GAIN = 0.01  # relative decrease of the squared residual per pass at convergence


class RecursiveEstimator(Estimator[Problem], Generic[StateT]):
    """Interface of recursive estimators: settings in the constructor, an immutable state."""

    reads: ClassVar[Literal["samples"]] = "samples"

    @abstractmethod
    def init(self, c: int) -> StateT:
        """Return the state of c parameters before any sample."""

    @abstractmethod
    def update(self, state: StateT, sample: Sample) -> StateT:
        """Return the state after one more sample; rows of weight 0 are skipped.

        A sample that is not finite or has a wrong shape is a DataError; the state remains valid.
        """

    @abstractmethod
    def estimate(self, state: StateT, names: tuple[str, ...]) -> Estimate:
        """Return the estimate of a state, with the names of its c parameters."""


def fold(estimator: RecursiveEstimator[StateT], samples: Iterable[Sample], state: StateT) -> StateT:
    """Return the state after all samples, in the order of the updates."""
    for sample in samples:
        state = estimator.update(state, sample)
    return state


def scaled_rows(sample: Sample, sigma: Array, c: int) -> Array:
    """Return rows sqrt(weight_j) / sigma_j [Y_j tau_j] of nonzero weight, shape (k, c + 1)."""
    n = len(sigma)
    if sample.Y.shape != (n, c) or sample.tau.shape != (n,) or sample.weight.shape != (n,):
        raise DataError(
            f"the sample has Y {sample.Y.shape}, tau {sample.tau.shape}, weight "
            f"{sample.weight.shape}, expected {(n, c)}, {(n,)}, {(n,)}"
        )
    rows = np.column_stack([sample.Y, sample.tau]) * (np.sqrt(sample.weight) / sigma)[:, None]
    if not sample.weight.all():
        rows = rows[sample.weight != 0]
    # the sum is the fastest test: it is finite only if every entry is
    if not math.isfinite(rows.sum()):
        raise DataError(
            "the sample has values that are not finite and was not used; the previous state "
            "remains valid"
        )
    return rows


class Filter(RecursiveEstimator[StateT]):
    """A recursive estimator that reads the samples once, in the order of time."""

    prior: Array | None

    @abstractmethod
    def _rows_of(self, state: StateT) -> int:
        """Return the number of rows that a state depends on."""

    def fit(self, data: Problem) -> Estimate:
        c = len(data.names)
        state = fold(self, data.samples(), self.init(c))
        require_rows(self._rows_of(state), c, data.n_joints)
        estimate = self.estimate(state, data.names)
        if estimate.rank < c and self.prior is None:
            raise RankDeficientError(estimate.rank, estimate.undetermined, c)
        return estimate


@dataclass(frozen=True, eq=False)
class RLSState:
    """State of recursive least squares."""

    R: Array  # (c + 1, c + 1), upper triangular factor of the weighted rows [Y tau]
    rows: float  # effective number of rows in it, with forgetting
    steps: int  # samples used


@dataclass(frozen=True, eq=False)
class RLS(Filter[RLSState]):
    """Recursive least squares with exponential forgetting: the triangular factor R of all rows.

        R <- triangle of [sqrt(forgetting) R; [Y tau] / sigma].

    Nothing is inverted until an estimate is computed, and the initial state has no information:
    without forgetting the result is that of batch least squares. With forgetting, information that
    motion does not update would vanish (wind-up): each step adds one row of the prior, one
    parameter after the other, so that the prior information of each stays between forgetting^c and
    1 times that of the prior. Parameters that are not identifiable have infinite variance. Bierman
    (1977), Factorization Methods for Discrete Sequential Estimation, chapter IV.
    """

    sigma: Array  # (n,), noise levels [N m or N]; only the ratios matter
    forgetting: float = 1.0  # weight of a sample relative to the next one, 0 < forgetting <= 1
    #: Parameter values for directions that are not identifiable, shape (c,); None: 0, and ``fit``
    #: raises an error if there are any.
    prior: Array | None = None
    prior_std: Array | None = None  # (c,), prior standard deviations; None: no prior information
    independent_share: float = 1.0  # 2 cutoff / rate

    def __post_init__(self) -> None:
        if not 0 < self.forgetting <= 1:
            raise DataError(f"forgetting is {self.forgetting}, expected above 0 and at most 1")
        if not (np.isfinite(self.sigma).all() and (self.sigma > 0).all()):
            raise DataError(f"sigma is {self.sigma}, expected positive finite numbers")
        if self.prior_std is not None and self.prior is None:
            raise DataError("prior_std was given without prior; give both, or neither")
        if self.forgetting < 1 and self.prior_std is None:
            raise DataError(
                f"forgetting is {self.forgetting}, which needs prior and prior_std, as information "
                "that no motion updates vanishes; give both"
            )

    @property
    def weighing(self) -> Weighing:
        return "by joint" if self.forgetting == 1 else "by age"

    def init(self, c: int) -> RLSState:
        R = np.zeros((c + 1, c + 1), order="F")
        if self.prior is not None and self.prior_std is not None:
            R[:c, :c] = np.diag(1.0 / self.prior_std)
            R[:c, c] = self.prior / self.prior_std
        return RLSState(R, 0.0, 0)

    def update(self, state: RLSState, sample: Sample) -> RLSState:
        rows = scaled_rows(sample, self.sigma, len(state.R) - 1)  # (k, c + 1)
        if not len(rows):
            return state
        count = self.forgetting * state.rows + len(rows)
        before = state.R
        if self.forgetting < 1 and self.prior is not None and self.prior_std is not None:
            before = np.sqrt(self.forgetting) * before
            # a row of the prior that replaces the information forgotten in c steps
            c = len(before) - 1
            i = state.steps % c
            row = np.zeros(c + 1)
            row[i] = np.sqrt(1.0 - self.forgetting**c) / self.prior_std[i]
            row[c] = row[i] * self.prior[i]
            rows = np.vstack([rows, row])
        R = dtpqrt(0, min(PANEL, len(before)), before, rows)[0]
        return RLSState(R, count, state.steps + 1)

    def estimate(self, state: RLSState, names: tuple[str, ...]) -> Estimate:
        c = len(names)
        factors = Factors((state.R,), (np.arange(c),), np.array([int(state.rows)]), names)
        start = np.zeros(c) if self.prior is None else self.prior
        solution = solve_factor(factors, np.ones(1), start)
        freedom = max(state.rows - solution.rank, 1.0)
        scale = max(abs(float(state.R[c, c])) / np.sqrt(freedom), ROUNDING)
        covariance = scale**2 / self.independent_share * solution.covariance
        message = (
            f"{state.steps} samples used, forgetting {self.forgetting:g}; noise levels "
            f"{scale:.3g} times the given ones"
        )
        return solution.estimate(names, covariance, scale * self.sigma, state.steps, message)

    def _rows_of(self, state: RLSState) -> int:
        # forgotten rows count, too
        return int(state.rows) if self.forgetting == 1 else state.steps * len(self.sigma)


@dataclass(frozen=True, eq=False)
class KalmanState:
    """State of the Kalman filter."""

    theta: Array  # (c,)
    P: Array  # (c, c), its covariance
    products: Array  # (n,), sum of innovation times residual: rows times variance
    rows: Array  # (n,), rows used
    gated: Array  # (n,), rows rejected by the gate
    in_a_row: Array  # (n,), rows rejected since the last one used
    steps: int  # samples read


@dataclass(frozen=True, eq=False)
class Kalman(Filter[KalmanState]):
    """Kalman filter: theta_k+1 = theta_k + w, tau = Y theta + noise.

    The covariance is updated in Joseph's form, P <- (1 - K Y) P (1 - K Y)^T + K R K^T, multiplied
    out: P - A - A^T with A = K (P Y^T - K T / 2)^T and T = Y P Y^T + R, exactly symmetric, with
    products of n columns only. A row with an improbable innovation is rejected; after 50 in a row
    the next row of the joint is used. A parameter with almost no information is undetermined.
    Bierman (1977), Factorization Methods for Discrete Sequential Estimation, II; Bar-Shalom, Li,
    Kirubarajan (2001), Estimation with Applications to Tracking, 5.4.
    """

    sigma: Array  # (n,), noise levels [N m or N]
    prior: Array  # (c,), prior values
    prior_std: Array  # (c,), prior standard deviations, positive; or (c, c), the prior covariance
    walk: float = 0.0  # standard deviation of the random walk per sample, over prior_std [-]
    gate: float | None = 1 - 1e-7  # probability that a row without a fault passes; None: no gate
    independent_share: float = 1.0  # 2 cutoff / rate

    def __post_init__(self) -> None:
        for name in ("sigma", "prior_std"):
            values = getattr(self, name)
            diagonal = np.diag(values) if values.ndim == 2 else values
            if not (np.isfinite(values).all() and (diagonal > 0).all()):
                raise DataError(f"{name} is {diagonal}, expected positive finite numbers")
        if not np.isfinite(self.prior).all():
            raise DataError(f"prior is {self.prior}, expected finite numbers")
        if not self.walk >= 0:
            raise DataError(f"walk is {self.walk}, expected 0 or a positive number")
        if self.gate is not None and not 0.5 <= self.gate < 1:
            raise DataError(f"gate is {self.gate}, expected at least 0.5 and below 1, or None")

    @property
    def weighing(self) -> Weighing:
        return "by age"

    def init(self, c: int) -> KalmanState:
        if self.prior.shape != (c,) or len(self.prior_std) != c:
            raise DataError(
                f"prior has shape {self.prior.shape} and prior_std {self.prior_std.shape}, "
                f"expected {c} parameters"
            )
        n = len(self.sigma)
        P = self.prior_std if self.prior_std.ndim == 2 else np.diag(self.prior_std**2)
        none = np.zeros(n, dtype=int)
        return KalmanState(self.prior, P, np.zeros(n), none, none, none, 0)

    def update(self, state: KalmanState, sample: Sample) -> KalmanState:
        c = len(state.theta)
        used = np.flatnonzero(sample.weight)
        # in units of each row's noise, increased for rows that are not independent
        scale = self.sigma / np.sqrt(self.independent_share)
        rows = scaled_rows(sample, scale, c)
        Y, e = rows[:, :c], rows[:, c] - rows[:, :c] @ state.theta  # (k, c), (k,)
        P = state.P
        if self.walk:
            P = P.copy()
            P.flat[:: len(P) + 1] += (self.walk * self._prior_spread()) ** 2
        PY = P @ Y.T  # (c, k)
        T = Y @ PY  # (k, k), covariance of the prediction, then of the innovation
        passed = np.ones(len(e), dtype=bool)
        if self.gate is not None:  # chi-square test of the innovation
            bound = NormalDist().inv_cdf((1 + self.gate) / 2) ** 2
            passed = (e**2 <= bound * (np.diag(T) + 1)) | (state.in_a_row[used] >= _PATIENCE)
        if not passed.all():
            Y, e, PY, T = Y[passed], e[passed], PY[:, passed], T[np.ix_(passed, passed)]
        T.flat[:: len(T) + 1] += 1.0
        solved = np.linalg.solve(T, np.column_stack([PY.T, e])) if len(T) else np.zeros((0, c + 1))
        K, residual = solved[:, :c].T, solved[:, c]  # (c, k), (k,): tau - Y theta afterwards
        A = K @ (PY - K @ T / 2).T
        products = state.products.copy()
        k = used[passed]
        products[k] += scale[k] ** 2 / sample.weight[k] * e * residual
        P = P - (A + A.T)  # exactly symmetric
        rows_used, gated, in_a_row = state.rows.copy(), state.gated, state.in_a_row
        rows_used[used] += passed
        if not passed.all() or in_a_row.any():
            gated, in_a_row = gated.copy(), in_a_row.copy()
            gated[used] += ~passed
            in_a_row[used] = np.where(passed, 0, in_a_row[used] + 1)
        counts = (rows_used, gated, in_a_row, state.steps + 1)
        return KalmanState(state.theta + K @ e, P, products, *counts)

    def estimate(self, state: KalmanState, names: tuple[str, ...]) -> Estimate:
        std = self._prior_spread()
        after = np.sqrt(np.maximum(np.diag(state.P), 0.0))
        # the mean of innovation times residual is the noise variance, independent of P
        variance = np.maximum(state.products, 0.0) / np.maximum(state.rows, 1)
        is_open = after > PRIOR_LED * std
        eigenvalues = np.linalg.eigvalsh(state.P / np.outer(std, std))
        return Estimate(
            state.theta, state.P, names, np.sqrt(variance),
            rank=int(np.sum(eigenvalues < PRIOR_LED**2)),
            condition=float(np.sqrt(eigenvalues[-1] / max(eigenvalues[0], 1e-300))),
            undetermined=tuple(np.array(names)[is_open].tolist()),
            converged=True,
            n_iter=state.steps,
            message=f"{state.steps} samples, {int(state.gated.sum())} rows rejected by the gate, "
            f"{int(state.rows.sum())} used",
        )  # fmt: skip

    def _rows_of(self, state: KalmanState) -> int:
        return int(state.rows.sum())

    def _prior_spread(self) -> Array:
        is_matrix = self.prior_std.ndim == 2
        return np.asarray(np.sqrt(np.diag(self.prior_std)) if is_matrix else self.prior_std)


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
    """Base class of gradient methods: one step per sample along the gradient, in random order.

    Parameters x = scale theta, for which every column has unit norm; residual e = Psi P^ - tau,
    with the sign of the paper. ``fit`` reads the samples in several passes, until PRX = 0. The
    covariance is infinite, rank and condition number are unknown.
    """

    sigma: Array  # (n,), noise level of each joint [N m or N]
    prior: Array | None = None  # (c,), initial values; 0 if None
    scale: Array | None = None  # (c,), of columns; None: ``fit`` uses their norms, ``init`` none
    average: bool = True  # whether the estimate is the average of the iterates; better with noise
    passes: int = 4  # largest number of passes of ``fit``
    rng: np.random.Generator | None = None  # of the order of the samples; None: order of time

    @property
    def weighing(self) -> Weighing:
        return "by step"

    @abstractmethod
    def _moved(self, x: Array, Psi: Array, e: Array) -> Array:
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
        x = self._moved(state.x, Psi, Psi @ state.x - tau)
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
            "a gradient method has no covariance, its errors are infinite"
        )
        return Estimate(
            state.mean / self._unit, np.full((c, c), np.inf), names, np.sqrt(state.squares),
            rank=c, condition=float("inf"), undetermined=(), converged=self._is_zero(state),
            n_iter=state.steps, message=message,
        )  # fmt: skip

    def fit(self, data: Problem) -> Estimate:
        estimator, c = self, len(data.names)
        if self.scale is None:
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
    """Normalised gradient (NLMS): theta <- theta - Psi^T e / |Psi|_F^2, rows over their noise.

    Without noise |theta~| does not increase. Goodwin, Sin (1984), Adaptive Filtering, Prediction
    and Control, 3.3.
    """

    def _moved(self, x: Array, Psi: Array, e: Array) -> Array:
        return x - 1.0 / np.vdot(Psi, Psi) * (e @ Psi)


@dataclass(frozen=True, eq=False)
class PRX(Descent):
    """The paper's update P^ <- P^ - gamma Psi^T e (24), with e = Psi P^ - tau and the exact step.

    Rows are in units of their noise; gamma = e^T e / |Psi^T e|^2 minimises |P~| along the
    direction, so that without noise |P~| (with scaling, scale * P~) does not increase. On
    recordings of a UR10e and a Panda the prediction error of the last iterate is 1.3 to 1.9 times
    that of weighted least squares, that of the average, the k-th iterate weighted by k^2, 1.03 to
    1.05 times. Tzvetkova, Extracting Inertial Parameters from Robotic Manipulators Dynamics,
    (20)-(25).
    """

    def _moved(self, x: Array, Psi: Array, e: Array) -> Array:
        direction = e @ Psi
        square = direction @ direction
        return x - ((e @ e) / square if square > 0 else 0.0) * direction


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
