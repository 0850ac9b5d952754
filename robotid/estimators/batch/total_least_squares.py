"""Total least squares: for a regressor that is noisy, too."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.estimators.batch.least_squares import WLS
from robotid.estimators.estimator import BatchEstimator, Estimate
from robotid.exceptions import DataError, NotConvergedError, RankDeficientError
from robotid.regressor.factors import Factors

__all__ = ["TLS"]

_MAX_ITERATIONS = 100
_TOLERANCE = 1e-12  # change of the torque, relative to all of it
_ALONE = 1e-6  # relative gap of the two smallest singular values below which neither is meant


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
        independent_share: As of ``WLS``.

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
        for _ in range(_MAX_ITERATIONS):
            share = float(((noise * theta) ** 2).sum())
            if share >= 1.0:
                raise DataError(
                    f"regressor_noise {self.regressor_noise:g} alone would make "
                    f"{np.sqrt(share):.3g} times the residual that there is; lower it"
                )
            found = mixed_tls(R, noise / np.sqrt(1.0 - share))
            change = np.linalg.norm(R[:, :-1] @ (found - theta)) / np.linalg.norm(R[:, -1])
            theta = found
            if change < _TOLERANCE:
                return theta, share
        raise NotConvergedError(
            f"total least squares does not settle in {_MAX_ITERATIONS} steps; lower "
            "regressor_noise",
            "max_iterations",
        )


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
