"""Least squares on triangular factors: ordinary, weighted, and total for a noisy regressor."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.estimators.estimator import BatchEstimator, Estimate, Weighing
from robotid.estimators.segments import sandwich
from robotid.exceptions import DataError, NotConvergedError, RankDeficientError
from robotid.regressor.factors import Factors

__all__ = ["OLS", "TLS", "WLS", "Solution", "mixed_tls", "solve_factor"]

_RANK = 1e-7  # singular values below this share of the largest, of unit columns, count as 0
_SILENT = 1e-6  # columns smaller than this share of the largest carry no information
_OPEN = 1e-2  # a parameter with a larger share in an undetermined direction is undetermined
_FLOOR = 1e-9  # smallest noise level, as a share of the torque: noise-free data have none
_TOLERANCE = 1e-8  # relative change of the noise levels at which WLS has converged
_MAX_ITERATIONS = 200
_SETTLED = 1e-5  # ... and at which it is good enough after so many iterations
_TLS_ITERATIONS = 100
_TLS_TOLERANCE = 1e-12  # change of the torque, relative to all of it
_ALONE = 1e-6  # relative gap of the two smallest singular values below which neither is meant


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
        sigma = _noise(factors, solution.theta, factors.leverages(solution.covariance))
        bread, meat = solution.covariance, factors.information(sigma**2)  # bread: (W^T W)^+
        covariance = sandwich(bread, meat) / self.independent_share
        return solution.estimate(factors.names, covariance, sigma, 1, "solved by QR")


@dataclass(frozen=True)
class WLS(BatchEstimator):
    """Weighted least squares: minimise sum_j |tau_j - W_j theta|^2 / sigma_j^2.

    The noise level sigma_j of each joint comes from its own residual, with the degrees of freedom
    its rows spend, and is iterated to convergence. Of few rows it may settle slowly; the message
    of the estimate says so.

    Attributes:
        prior: As of ``OLS``.
        independent_share: As of ``OLS``.

    References:
        Gautier (1997), Dynamic identification of robots with power model, section II.
    """

    prior: Array | None = None
    independent_share: float = 1.0

    def _fit(self, factors: Factors) -> Estimate:
        start = solve_factor(factors, np.ones(len(factors.rows)), self.prior)
        sigma = _noise(factors, start.theta, factors.leverages(start.covariance))
        for iteration in range(1, _MAX_ITERATIONS + 1):
            solution = solve_factor(factors, sigma, self.prior)
            spent = factors.leverages(solution.covariance) / sigma**2
            updated = _noise(factors, solution.theta, spent)
            change = np.max(np.abs(updated - sigma) / sigma)
            sigma = updated
            is_last = iteration == _MAX_ITERATIONS
            if change < (_SETTLED if is_last else _TOLERANCE):
                covariance = solution.covariance / self.independent_share
                message = f"noise levels settled after {iteration} iterations"
                if is_last:
                    message += f", where they still change by {change:.1e}"
                return solution.estimate(factors.names, covariance, sigma, iteration, message)
        raise NotConvergedError(
            f"the noise levels of WLS still change by {change:.1e} after {_MAX_ITERATIONS} "
            f"iterations with {int(factors.rows.sum())} rows for {len(factors.names)} parameters; "
            "record more, or look for a joint that is fitted exactly",
            "max_iterations",
        )


@dataclass(frozen=True)
class TLS(BatchEstimator):
    """Total least squares with exact columns, rows weighted as by WLS.

    Finds the smallest corrections E of the regressor and e of the torque with
    (W + E) theta = tau - e, where the noise of a column is ``regressor_noise`` times its root mean
    square and columns of constants have none. It is right where positions are noisy and their
    derivatives more so, and wrong where the residual is what the model lacks: it then blames the
    regressor for it. With ``regressor_noise`` towards 0 it is WLS, whose covariance it states. It
    refuses data of which no single solution is smallest, and a regressor's noise larger than the
    residual allows (``DataError``).

    Attributes:
        regressor_noise: Noise of the columns over their root mean square [-].
        exact: Columns without noise, by the last word of their names.
        independent_share: As of ``OLS``.

    References:
        Golub, Hoffman, Stewart (1987), A generalization of the Eckart-Young-Mirsky matrix
        approximation theorem; Van Huffel, Vandewalle (1991), The Total Least Squares Problem, 3.6.
    """

    regressor_noise: float = 0.01
    exact: Sequence[str] = ("offset",)
    independent_share: float = 1.0

    def _fit(self, factors: Factors) -> Estimate:
        wls = WLS(independent_share=self.independent_share).fit(factors)
        if wls.rank < len(factors.names):
            raise RankDeficientError(wls.rank, wls.undetermined, len(factors.names))
        R = factors.weighted(wls.sigma)
        count = max(int(factors.rows.sum()), 1)
        noise = self.regressor_noise * np.linalg.norm(R[:, :-1], axis=0) / np.sqrt(count)
        is_exact = [name.rsplit(".", 1)[-1] in self.exact for name in factors.names]
        theta, share = self._split(R, np.where(is_exact, 0.0, noise), wls.theta)
        freedom = np.maximum(factors.rows - len(theta) / len(factors.rows), 1.0)
        return replace(
            wls,
            theta=theta,
            sigma=np.sqrt(factors.residual_squares(theta) / freedom),
            message=f"total least squares, {wls.message}; {100 * share:.2g} % of the residual's "
            "variance is noise of the regressor",
        )

    def _split(self, R: Array, noise: Array, theta: Array) -> tuple[Array, float]:
        """Return the parameters and the share of the residual that the regressor's noise makes.

        The residual of WLS, 1 in these units, is the torque's noise and the regressor's seen
        through theta; how much is whose follows from theta, and theta from that.
        """
        for _ in range(_TLS_ITERATIONS):
            share = float(((noise * theta) ** 2).sum())
            if share >= 1.0:
                raise DataError(
                    f"regressor_noise {self.regressor_noise:g} alone would make "
                    f"{np.sqrt(share):.3g} times the residual that there is; lower it"
                )
            found = mixed_tls(R, noise / np.sqrt(1.0 - share))
            change = np.linalg.norm(R[:, :-1] @ (found - theta)) / np.linalg.norm(R[:, -1])
            theta = found
            if change < _TLS_TOLERANCE:
                return theta, share
        raise NotConvergedError(
            f"total least squares does not settle in {_TLS_ITERATIONS} steps; lower "
            "regressor_noise",
            "max_iterations",
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """The minimiser of a weighted problem, and what its factor says of it.

    Attributes:
        theta: Parameters, shape (c,).
        covariance: (W^T S^-1 W)^+, shape (c, c).
        rank: Number of directions that the data determine.
        columns: Factor of the columns scaled to unit norm, shape (c + 1, c).
        undetermined: Names of the parameters that the data leave open.
    """

    theta: Array
    covariance: Array
    rank: int
    columns: Array
    undetermined: tuple[str, ...]

    @cached_property
    def condition(self) -> float:
        """Condition number over the determined directions, columns scaled to unit norm."""
        s = np.linalg.svd(self.columns, compute_uv=False)
        return float(s[0] / s[self.rank - 1]) if self.rank else float("inf")

    def estimate(
        self, names: tuple[str, ...], covariance: Array, sigma: Array, n_iter: int, message: str
    ) -> Estimate:
        """Return the estimate; what the data leave open has infinite variance.

        Args:
            names: Names of the parameters.
            covariance: Covariance of the others, shape (c, c).
            sigma: Standard deviation of the torque residual per joint, shape (n,) [N m or N].
            n_iter: Number of iterations.
            message: What the estimator says of its run.
        """
        is_open = np.isin(names, self.undetermined)
        covariance = covariance.copy()
        covariance[is_open, is_open] = np.inf
        return Estimate(
            theta=self.theta,
            covariance=covariance,
            names=names,
            sigma=sigma,
            rank=self.rank,
            condition=self.condition,
            undetermined=self.undetermined,
            converged=True,
            n_iter=n_iter,
            message=message,
        )


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
    X = np.where(heard, A / scale, 0.0)
    inverse, is_singular = scipy.linalg.lapack.dtrtri(A[:c])
    # the product of Frobenius' norms of X, c^(1/2), and of its inverse bounds its condition
    if heard.all() and not is_singular and _RANK * np.linalg.norm(scale * inverse.T) < c**-0.5:
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


def _noise(factors: Factors, theta: Array, spent: Array) -> Array:
    """Return the standard deviation of each joint's residual, never quite zero.

    As many of its rows are spent as parameters that they determine: the trace of their leverage.
    """
    freedom = np.maximum(factors.rows - spent, 1.0)
    sigma = np.sqrt(factors.residual_squares(theta) / freedom)
    torque = np.sqrt(factors.torque_squares() / np.maximum(factors.rows, 1))
    floor = _FLOOR * np.where(torque > 0, torque, 1.0)
    noise: Array = np.maximum(sigma, floor)
    return noise


def mixed_tls(rows: Array, noise: Array) -> Array:
    """Return the parameters, shape (c,), that mixed total least squares finds.

    Args:
        rows: Rows [W tau] in units of the torque's noise, or their factor, shape (k, c + 1).
        noise: Noise of each column in the same units, shape (c,); 0 of columns without.

    Raises:
        DataError: If no single solution is smallest.
    """
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
    is_alone = len(s) == 1 or s[-2] - s[-1] > _ALONE * s[0]
    if not is_alone or abs(v[-1]) < _ALONE:
        raise DataError(
            "total least squares has no single smallest solution: its smallest singular values are "
            f"{s[-2:].tolist()}; the data say too little, or regressor_noise is too large"
        )
    theta = np.empty(c)
    theta[noisy] = -v[:-1] / v[-1] / scale[:-1]
    if k:
        right = triangle[:k, -1] - triangle[:k, k:-1] @ (-v[:-1] / v[-1])
        theta[exact] = scipy.linalg.solve_triangular(triangle[:k, :k], right)
    return theta
