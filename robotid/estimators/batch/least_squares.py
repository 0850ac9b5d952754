"""Ordinary and weighted least squares, on triangular factors."""

from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.estimators.estimator import BatchEstimator, Estimate, Weighing
from robotid.exceptions import NotConvergedError, RankDeficientError
from robotid.regressor.factors import Factors

__all__ = ["OLS", "WLS", "Solution", "solve_factor"]

_RANK = 1e-7  # singular values below this share of the largest, of unit columns, count as 0
_SILENT = 1e-6  # columns smaller than this share of the largest carry no information
_OPEN = 1e-2  # a parameter with a larger share in an undetermined direction is undetermined
_FLOOR = 1e-9  # smallest noise level, as a share of the torque: noise-free data have none
_TOLERANCE = 1e-8  # relative change of the noise levels at which WLS has converged
_MAX_ITERATIONS = 200
_SETTLED = 1e-5  # ... and at which it is good enough after so many iterations


@dataclass(frozen=True)
class OLS(BatchEstimator):
    """Ordinary least squares: minimise |tau - W theta|^2.

    The covariance allows for a noise level of its own on each joint,
    ``(W^T W)^-1 (sum_j sigma_j^2 W_j^T W_j) (W^T W)^-1``.

    Attributes:
        prior: Parameters kept where the data say nothing, shape (c,); None: data that leave
            something open are refused.
        independent_share: Share of the rows that count as independent, 2 cutoff / rate for rows
            behind a low-pass filter: the covariance grows by its inverse.

    References:
        Gautier (1997), Dynamic identification of robots with power model, section II.
    """

    prior: Array | None = None
    independent_share: float = 1.0

    @property
    def weighing(self) -> Weighing:
        return "alike"

    def _fit(self, factors: Factors) -> Estimate:
        solution = solve_factor(factors, np.ones(len(factors.rows)), self.prior)
        sigma = _noise(factors, solution.theta, _effective_parameters(factors, solution, None))
        bread, meat = solution.covariance, factors.information(sigma**2)  # bread: (W^T W)^+
        covariance = bread @ meat @ bread / self.independent_share
        return _estimate(factors, solution, covariance, sigma, 1, "solved by QR")


@dataclass(frozen=True)
class WLS(BatchEstimator):
    """Weighted least squares: minimise sum_j |tau_j - W_j theta|^2 / sigma_j^2.

    The noise level sigma_j of each joint comes from its own residual, with the degrees of freedom
    its rows spend, and is iterated to convergence. Of few rows it may settle slowly; the message
    of the estimate says so.

    Attributes:
        prior: Parameters kept where the data say nothing, shape (c,); None: data that leave
            something open are refused.
        independent_share: Share of the rows that count as independent, 2 cutoff / rate for rows
            behind a low-pass filter: the covariance grows by its inverse.

    References:
        Gautier (1997), Dynamic identification of robots with power model, section II.
    """

    prior: Array | None = None
    independent_share: float = 1.0

    def _fit(self, factors: Factors) -> Estimate:
        sigma = OLS(prior=self.prior).fit(factors).sigma
        for iteration in range(1, _MAX_ITERATIONS + 1):
            solution = solve_factor(factors, sigma, self.prior)
            spent = _effective_parameters(factors, solution, sigma)
            updated = _noise(factors, solution.theta, spent)
            change = np.max(np.abs(updated - sigma) / sigma)
            sigma = updated
            is_last = iteration == _MAX_ITERATIONS
            if change < (_SETTLED if is_last else _TOLERANCE):
                covariance = solution.covariance / self.independent_share
                message = f"noise levels settled after {iteration} iterations"
                if is_last:
                    message += f", where they still change by {change:.1e}"
                return _estimate(factors, solution, covariance, sigma, iteration, message)
        raise NotConvergedError(
            f"the noise levels of WLS still change by {change:.1e} after {_MAX_ITERATIONS} "
            f"iterations with {int(factors.rows.sum())} rows for {len(factors.names)} parameters; "
            "record more, or look for a joint that is fitted exactly",
            "max_iterations",
        )


@dataclass(frozen=True)
class Solution:
    """The minimiser of a weighted problem, and what its factor says of it.

    Attributes:
        theta: Parameters, shape (c,).
        covariance: (W^T S^-1 W)^+, shape (c, c).
        rank: Number of directions that the data determine.
        condition: Condition number over them, columns scaled to unit norm.
        undetermined: Names of the parameters that the data leave open.
    """

    theta: Array
    covariance: Array
    rank: int
    condition: float
    undetermined: tuple[str, ...]


def solve_factor(factors: Factors, sigma: Array, prior: Array | None) -> Solution:
    """Solve the weighted problem; directions that the data leave open keep the prior.

    Args:
        factors: The factors.
        sigma: Noise level per joint, shape (n,) [N m or N].
        prior: Parameters kept where the data say nothing, shape (c,); None: refuse such data.

    Raises:
        RankDeficientError: If the data leave parameters open and there is no prior.
    """
    R = factors.weighted(sigma)
    c = len(factors.names)
    A, d = R[:, :c], R[:, c]
    norms = np.linalg.norm(A, axis=0)
    heard = norms > _SILENT * norms.max()
    scale = np.where(heard, norms, 1.0)
    U, s, Vt = np.linalg.svd(np.where(heard, A / scale, 0.0))
    rank = int(np.sum(s > _RANK * s[0])) if s[0] > 0 else 0
    V, V0 = Vt[:rank].T, Vt[rank:].T
    share = np.linalg.norm(V0, axis=1)
    undetermined = tuple(np.array(factors.names)[share > _OPEN].tolist())
    if rank < c and prior is None:
        raise RankDeficientError(rank, undetermined, c)
    start = np.zeros(c) if prior is None else prior
    step = V @ ((U[:, :rank].T @ (d - A @ start)) / s[:rank])
    basis = V / s[:rank] / scale[:, None]
    condition = float(s[0] / s[rank - 1]) if rank else float("inf")
    return Solution(start + step / scale, basis @ basis.T, rank, condition, undetermined)


def _effective_parameters(factors: Factors, solution: Solution, sigma: Array | None) -> Array:
    """Return how many parameters the rows of each joint determine: the trace of their leverage."""
    leverages = factors.leverages(solution.covariance)
    return leverages if sigma is None else leverages / sigma**2


def _noise(factors: Factors, theta: Array, spent: Array) -> Array:
    """Return the standard deviation of each joint's residual, never quite zero."""
    freedom = np.maximum(factors.rows - spent, 1.0)
    sigma = np.sqrt(factors.residual_squares(theta) / freedom)
    torque = np.sqrt(factors.torque_squares() / np.maximum(factors.rows, 1))
    floor = _FLOOR * np.where(torque > 0, torque, 1.0)
    noise: Array = np.maximum(sigma, floor)
    return noise


def _estimate(
    factors: Factors,
    solution: Solution,
    covariance: Array,
    sigma: Array,
    n_iter: int,
    message: str,
) -> Estimate:
    is_open = np.isin(factors.names, solution.undetermined)
    covariance = covariance.copy()
    covariance[is_open, is_open] = np.inf
    return Estimate(
        theta=solution.theta,
        covariance=covariance,
        names=factors.names,
        sigma=sigma,
        rank=solution.rank,
        condition=solution.condition,
        undetermined=solution.undetermined,
        converged=True,
        n_iter=n_iter,
        message=message,
    )
