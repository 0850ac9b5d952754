"""Ordinary, weighted and total least squares on triangular factors."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.exceptions import DataError, NotConvergedError, RankDeficientError
from robotid.base.tolerances import ROUNDING, TINY
from robotid.base.typing import Array
from robotid.dynamics.factors import Factors
from robotid.estimation.estimators.estimator import (
    MOST_EXPLAINED,
    BatchEstimator,
    Estimate,
    Weighing,
    sandwich,
)

_RANK = 1e-7  # relative singular value below which the rank is reduced, columns of unit norm
SILENT = 1e-6  # relative norm below which a column has no information
_OPEN = 1e-2  # share in undetermined directions above which a parameter is undetermined
LEAST_NOISE = 1e-9  # smallest noise level over the torque, for noise-free data
_TOLERANCE = 1e-8  # relative change of the noise levels at which WLS has converged
_MAX_ITERATIONS = 200
_SETTLED = 1e-5  # relative change that is sufficient after the largest number of iterations
_TLS_NOISE = 0.01  # [-] of the regressor's columns


@dataclass(frozen=True)
class OLS(BatchEstimator):
    """Ordinary least squares: minimise |tau - W theta|^2, with a noise level for each joint.

    The covariance is ``(W^T W)^-1 (sum_j sigma_j^2 W_j^T W_j) (W^T W)^-1``.
    """

    prior: Array | None = None  # (c,), of directions not identifiable; None: an error if any
    independent_share: float = 1.0  # 2 cutoff / rate; it divides the covariance [-]

    @property
    def weighing(self) -> Weighing:
        return "alike"

    def _fit(self, factors: Factors) -> Estimate:
        solution = solve_factor(factors, np.ones(len(factors.rows)), self.prior)
        sigma = _noise(factors, solution.theta, factors.leverages(solution.covariance))
        bread, meat = solution.covariance, factors.information(sigma**2)  # bread: (W^T W)^+
        covariance = sandwich(bread, meat) / self.independent_share
        return solution.estimate(factors.names, covariance, sigma, 1, "solved by QR")


@dataclass(frozen=True)
class WLS(BatchEstimator):
    """Weighted least squares: minimise sum_j |tau_j - W_j theta|^2 / sigma_j^2.

    The noise level sigma_j of each joint is iterated, from its residual and the effective degrees
    of freedom of its rows. Gautier (1997), Dynamic identification of robots with power model,
    section II.
    """

    prior: Array | None = None  # as in ``OLS``
    independent_share: float = 1.0  # as in ``OLS``
    levels: Array | None = None  # (n,), initial noise levels; None: those of equal weights

    def _fit(self, factors: Factors) -> Estimate:
        sigma = self.levels
        if sigma is None:
            start = solve_factor(factors, np.ones(len(factors.rows)), self.prior)
            sigma = _noise(factors, start.theta, factors.leverages(start.covariance))
        for iteration in range(1, _MAX_ITERATIONS + 1):
            solution = solve_factor(factors, sigma, self.prior)
            used = factors.leverages(solution.covariance) / sigma**2
            updated = _noise(factors, solution.theta, used)
            change = np.max(np.abs(updated - sigma) / sigma)
            sigma = updated
            is_last = iteration == _MAX_ITERATIONS
            if change < (_SETTLED if is_last else _TOLERANCE):
                covariance = solution.covariance / self.independent_share
                message = f"noise levels converged after {iteration} iterations"
                if is_last:
                    message += f", remaining relative change {change:.1e}"
                return solution.estimate(factors.names, covariance, sigma, iteration, message)
        raise NotConvergedError(
            f"the noise levels of WLS have not converged: relative change {change:.1e} after "
            f"{_MAX_ITERATIONS} iterations, expected less than {_SETTLED:g}; record more data than "
            f"these {int(factors.rows.sum())} rows, or check whether a joint has a residual of 0",
            "max_iterations",
        )


@dataclass(frozen=True)
class TLS(BatchEstimator):
    """Total least squares with exact columns, rows weighted as in WLS.

    Finds the smallest corrections E of the regressor and e of the torque with (W + E) theta = tau -
    e. Constant columns have no noise. It attributes errors of the model to noise of the regressor;
    for ``regressor_noise`` towards 0 it is WLS, whose covariance it returns. Golub, Hoffman,
    Stewart (1987), A generalization of the Eckart-Young-Mirsky matrix approximation theorem; Van
    Huffel, Vandewalle (1991), The Total Least Squares Problem, 3.6.
    """

    #: RMS noise of columns over their RMS; None: 0.01, or half of the residual's variance if less.
    regressor_noise: float | None = _TLS_NOISE
    independent_share: float = 1.0  # as in ``OLS``

    def _fit(self, factors: Factors) -> Estimate:
        wls = WLS(independent_share=self.independent_share).fit(factors)
        if wls.rank < len(factors.names):
            raise RankDeficientError(wls.rank, wls.undetermined, len(factors.names))
        R = factors.weighted(wls.sigma)
        count = max(int(factors.rows.sum()), 1)
        level = _TLS_NOISE if self.regressor_noise is None else self.regressor_noise
        noise = level * np.linalg.norm(R[:, :-1], axis=0) / np.sqrt(count)
        is_exact = [name.endswith(".offset") for name in factors.names]  # constant columns
        theta, share = self._split(R, np.where(is_exact, 0.0, noise), wls.theta)
        freedom = np.maximum(factors.rows - len(theta) / len(factors.rows), 1.0)
        sigma = np.sqrt(factors.residual_squares(theta) / freedom)
        message = f"total least squares, {wls.message}; {100 * share:.2g} % of the residual's "
        message += "variance is noise of the regressor"
        return replace(wls, theta=theta, sigma=sigma, message=message)

    def _split(self, R: Array, noise: Array, theta: Array) -> tuple[Array, float]:
        """Return the parameters and the share of the residual due to the regressor's noise."""
        # The residual of WLS, 1 in these units, is noise of torque and regressor times theta.
        for _ in range(_MAX_ITERATIONS):
            share = float(((noise * theta) ** 2).sum())
            if self.regressor_noise is None and share > MOST_EXPLAINED:
                noise, share = noise * np.sqrt(MOST_EXPLAINED / share), MOST_EXPLAINED
            elif self.regressor_noise is not None and share >= 1.0:
                raise DataError(
                    f"regressor_noise = {self.regressor_noise:g} corresponds to "
                    f"{np.sqrt(share):.3g} times the actual residual, expected less than 1; reduce "
                    "regressor_noise"
                )
            before, theta = theta, mixed_tls(R, noise / np.sqrt(1.0 - share))
            change = np.linalg.norm(R[:, :-1] @ (theta - before)) / np.linalg.norm(R[:, -1])
            if change < ROUNDING:
                return theta, share
        raise NotConvergedError(
            f"total least squares has not converged after {_MAX_ITERATIONS} steps; reduce "
            "regressor_noise",
            "max_iterations",
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """The minimiser of a weighted problem, with its covariance and rank."""

    theta: Array  # (c,)
    covariance: Array  # (c, c), (W^T S^-1 W)^+
    rank: int
    columns: Array  # (c + 1, c), factor of the columns scaled to unit norm
    undetermined: tuple[str, ...]  # names of the parameters that are not identifiable

    @cached_property
    def condition(self) -> float:
        """Condition number over the determined directions, columns scaled to unit norm."""
        s = np.linalg.svd(self.columns, compute_uv=False)
        return float(s[0] / s[self.rank - 1]) if self.rank else float("inf")

    def estimate(
        self, names: tuple[str, ...], covariance: Array, sigma: Array, n_iter: int, message: str
    ) -> Estimate:
        """Return the estimate; parameters that are not identifiable have infinite variance."""
        is_open = np.isin(names, self.undetermined)
        covariance = covariance.copy()
        covariance[is_open, is_open] = np.inf
        return Estimate(
            self.theta, covariance, names, sigma, self.rank, self.condition, self.undetermined,
            converged=True, n_iter=n_iter, message=message,
        )  # fmt: skip


def solve_factor(factors: Factors, sigma: Array, prior: Array | None) -> Solution:
    """Solve the weighted problem; directions that are not identifiable have the prior's values."""
    R = factors.weighted(sigma)
    c = len(factors.names)
    A, d = R[:, :c], R[:, c]
    norms = np.linalg.norm(A, axis=0)
    is_excited = norms > SILENT * norms.max()
    scale = np.where(is_excited, norms, 1.0)
    X = np.where(is_excited, A / scale, 0.0)
    inverse, is_singular = scipy.linalg.lapack.dtrtri(A[:c])
    # the product of the Frobenius norms of X, c^(1/2), and of its inverse bounds its condition
    if is_excited.all() and not is_singular and _RANK * np.linalg.norm(scale * inverse.T) < c**-0.5:
        return Solution(inverse @ d[:c], inverse @ inverse.T, c, X, ())
    U, s, Vt = np.linalg.svd(X)
    rank = int(np.sum(s > _RANK * s[0])) if s[0] > 0 else 0
    V, V0 = Vt[:rank].T, Vt[rank:].T
    share = np.linalg.norm(V0, axis=1)
    undetermined = tuple(np.array(factors.names)[share > _OPEN].tolist())
    if rank < c and prior is None:
        raise RankDeficientError(rank, undetermined, c)
    start = np.zeros(c) if prior is None else prior
    step = V @ ((U[:, :rank].T @ (d - A @ start)) / s[:rank])
    basis = V / s[:rank] / scale[:, None]
    return Solution(start + step / scale, basis @ basis.T, rank, X, undetermined)


def _noise(factors: Factors, theta: Array, used: Array) -> Array:
    """Return each joint's noise level, (n,) [N m or N]: ``used`` is the leverage of its rows."""
    sigma = factors.noise_levels(theta, np.maximum(factors.rows - used, 1.0))
    torque = np.sqrt(factors.torque_squares() / np.maximum(factors.rows, 1))
    floor = LEAST_NOISE * np.where(torque > 0, torque, 1.0)
    return np.asarray(np.maximum(sigma, floor))


def mixed_tls(rows: Array, noise: Array) -> Array:
    """Return the parameters (c,) of mixed total least squares: rows (k, c + 1), noise (c,)."""
    c = len(noise)
    exact, noisy = np.flatnonzero(noise == 0), np.flatnonzero(noise > 0)
    scale = np.append(noise[noisy], 1.0)
    ordered = np.column_stack([rows[:, exact], rows[:, np.append(noisy, c)] / scale])
    triangle = np.zeros((c + 1, c + 1))
    R = scipy.linalg.qr(ordered, mode="r")[0][: c + 1]
    triangle[: len(R)] = R
    k = len(exact)
    s, Vt = np.linalg.svd(triangle[k:, k:])[1:]
    v = Vt[-1]
    is_alone = len(s) == 1 or s[-2] - s[-1] > TINY * s[0]
    if not is_alone or abs(v[-1]) < TINY:
        raise DataError(
            "the solution of total least squares is not unique: the smallest singular values are "
            f"{s[-2:].tolist()}, expected one clearly below the other; record a motion with more "
            "excitation, or reduce regressor_noise"
        )
    theta = np.empty(c)
    theta[noisy] = -v[:-1] / v[-1] / scale[:-1]
    if k:
        right = triangle[:k, -1] - triangle[:k, k:-1] @ (-v[:-1] / v[-1])
        theta[exact] = scipy.linalg.solve_triangular(triangle[:k, :k], right)
    return theta
