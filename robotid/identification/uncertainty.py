"""Standard errors that hold for coloured noise, from how much the scores of stretches scatter.

Residuals behind a low-pass filter are correlated, and what a model misses is correlated still
longer, so rows do not count as independent measurements. Stretches that are longer than the
correlation do: the score of stretch s, W_s^T (tau_s - W_s theta), scatters as the noise makes it,
whatever its colour. The factors of the stretches tell it without a second pass over the rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.regressor.factors import Factors

__all__ = ["FEWEST", "Scatter", "quantile", "scatter"]

FEWEST = 12  # fewer stretches do not show how much their scores scatter
_OWN = 0.95  # leverage above which a stretch fits a direction alone, and shows no scatter in it


@dataclass(frozen=True, eq=False)
class Scatter:
    """How much the scores of s stretches scatter about zero, over c parameters.

    Attributes:
        meat: Covariance of the score W^T S^-1 (tau - W theta) of all stretches, shape (c, c).
        bread: Covariance of the parameters if rows were independent, shape (c, c).
        inflation: Mean ratio of the scatter to that of independent rows [-].
        factors: Factors R_s of the weighted rows of each stretch, shape (s, c, c).
        adjusted: The same behind the correction for their leverage, shape (s, c, c).
    """

    meat: Array
    bread: Array
    inflation: float
    factors: Array
    adjusted: Array

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters, shape (c, c)."""
        sandwich: Array = self.bread @ self.meat @ self.bread
        return sandwich

    def freedom(self) -> Array:
        """Return how many degrees of freedom the variance of each parameter rests on.

        Returns:
            Degrees of freedom of Student's distribution, shape (c,), at least 1.

        References:
            Bell, McCaffrey (2002), Bias reduction in standard errors for linear regression with
            multi-stage samples, section 4.
        """
        R, bread = self.factors, self.bread
        loads = self.adjusted @ bread  # (s, c, c): column l is a_s of parameter l
        back = np.einsum("sij,sil->lsj", R, loads, optimize=True)  # R_s^T a_s
        freedom = np.empty(len(bread))
        for k, Z in enumerate(back):
            # of independent noise: covariances of the stretches' contributions to the parameter
            gram = np.diag((loads[:, :, k] ** 2).sum(axis=1)) - Z @ bread @ Z.T
            freedom[k] = np.trace(gram) ** 2 / max(float((gram**2).sum()), 1e-300)
        return np.maximum(freedom, 1.0)


def scatter(stretches: Sequence[Factors], theta: Array, sigma: Array, bread: Array) -> Scatter:
    """Return how much the scores of stretches scatter.

    The residual of a stretch that had a say in the fit is smaller than its noise; it is enlarged
    by (I - leverage)^-1/2, which is exact for independent rows (known as CR2). Directions that one
    stretch alone determines show nothing; they get the mean scatter of all others.

    Args:
        stretches: Factors of contiguous stretches, at least 12, each longer than the correlation of
            the residuals.
        theta: Estimate, shape (c,).
        sigma: Noise level per joint that weighted the rows, shape (n,) [N m or N].
        bread: Covariance of the parameters if rows were independent, shape (c, c).

    Returns:
        The scatter.

    Raises:
        DataError: If there are fewer than 12 stretches.

    References:
        Bell, McCaffrey (2002), as above; Liang, Zeger (1986), Longitudinal data analysis using
        generalized linear models.
    """
    if len(stretches) < FEWEST:
        raise DataError(
            f"{len(stretches)} stretches do not show how much their scores scatter; wanted at "
            f"least {FEWEST}: fit longer logs"
        )
    c = len(theta)
    weighted = np.array([stretch.weighted(sigma) for stretch in stretches])
    R, u = weighted[:, :c, :c], weighted[:, :c, c] - weighted[:, :c, :c] @ theta
    leverage, V = np.linalg.eigh(R @ bread @ R.transpose(0, 2, 1))
    kept = np.clip(1.0 - leverage, 0.0, 1.0)  # share of its own noise that a residual still shows
    gain = 1.0 / np.sqrt(np.maximum(kept, 1.0 - _OWN))
    along = gain * np.einsum("sij,si->sj", V, u)
    # each eigenvector counts by the weight it has in the fit
    inflation = float((leverage * along**2).sum() / (leverage * gain**2 * kept).sum())
    adjusted = V @ (gain[:, :, None] * (V.transpose(0, 2, 1) @ R))
    scores = np.einsum("sij,si->sj", V.transpose(0, 2, 1) @ R, along)
    missing = np.sqrt(np.maximum(1.0 - gain**2 * kept, 0.0))[:, :, None]
    alone = (missing * (V.transpose(0, 2, 1) @ R)).reshape(-1, c)
    meat = scores.T @ scores + inflation * (alone.T @ alone)
    return Scatter(meat, bread, inflation, R, adjusted)


def quantile(freedom: Array, coverage: float = 0.95) -> Array:
    """Return how many standard errors a two-sided interval reaches.

    Args:
        freedom: Degrees of freedom of each standard error, shape (c,).
        coverage: Probability that the interval holds the truth.

    Returns:
        Quantiles of Student's distribution, shape (c,).
    """
    reach: Array = scipy.special.stdtrit(freedom, 0.5 + coverage / 2)
    return reach
