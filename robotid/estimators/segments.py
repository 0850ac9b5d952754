"""Scatter of the scores of segments: standard errors of least squares with coloured noise.

The covariance of the score of a segment, W_s^T (tau_s - W_s theta), is that of the noise, whatever
its colour, if the segment is longer than the correlation time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.regressor.factors import Factors

__all__ = ["FEWEST_SEGMENTS", "Scatter", "at_least", "quantile", "sandwich", "scatter"]

#: Smallest number of segments for an estimate of the scatter.
FEWEST_SEGMENTS = 12
_OWN = 0.95  # leverage above which a segment determines a direction alone, without scatter


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of the scores of s segments about 0, for c parameters."""

    meat: Array  # (c, c), covariance of the score W^T S^-1 (tau - W theta) of all segments
    bread: Array  # (c, c), covariance of the parameters if rows were independent
    inflation: float  # mean ratio of the scatter to that of independent rows [-]
    factors: Array  # (s, c, c), of the weighted rows of each segment, along its eigenvectors
    adjusted: Array  # (s, c, c), the same after the correction for their leverage

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters, shape (c, c)."""
        return sandwich(self.bread, self.meat)

    def freedom(self) -> Array:
        """Return the degrees of freedom of each parameter's variance, shape (c,), at least 1.

        References:
            Bell, McCaffrey (2002), Bias reduction in standard errors for linear regression with
            multi-stage samples, section 4.
        """
        R, bread = self.factors, self.bread
        loads = self.adjusted @ bread  # (s, c, c): column l is a_s of parameter l
        back = np.einsum("sij,sil->lsj", R, loads, optimize=True)  # R_s^T a_s
        freedom = np.empty(len(bread))
        for k, Z in enumerate(back):
            # covariances of the segments' contributions to the parameter for independent noise
            gram = np.diag((loads[:, :, k] ** 2).sum(axis=1)) - Z @ bread @ Z.T
            freedom[k] = np.trace(gram) ** 2 / max(float((gram**2).sum()), 1e-300)
        return np.maximum(freedom, 1.0)


def scatter(segments: Sequence[Factors], theta: Array, sigma: Array, bread: Array) -> Scatter:
    """Return the scatter of the scores of segments.

    The residual of a fitted segment is smaller than its noise. It is multiplied by
    (I - leverage)^-1/2, which is exact for independent rows (CR2). Directions that one segment
    alone determines have no scatter; the mean scatter of all others is used for them.

    Args:
        segments: Factors of contiguous segments, at least 12, each longer than the correlation of
            the residuals.
        theta: Estimate, shape (c,).
        sigma: Noise level per joint that weighted the rows, shape (n,) [N m or N].
        bread: Covariance of the parameters if rows were independent, shape (c, c).

    Raises:
        DataError: If there are fewer than 12 segments.

    References:
        Bell, McCaffrey (2002), as above; Liang, Zeger (1986), Longitudinal data analysis using
        generalized linear models.
    """
    if len(segments) < FEWEST_SEGMENTS:
        raise DataError(
            f"{len(segments)} segments are too few to estimate the scatter of their scores, wanted "
            f"at least {FEWEST_SEGMENTS}; fit longer logs"
        )
    c = len(theta)
    meat, alone, along_squares, expected = np.zeros((c, c)), np.zeros((c, c)), 0.0, 0.0
    rotated, adjusted = np.empty((2, len(segments), c, c))
    for k, segment in enumerate(segments):  # one by one: all together are larger than a cache
        weighted = segment.weighted(sigma)
        R, u = weighted[:c, :c], weighted[:c, c] - weighted[:c, :c] @ theta
        leverage, V = np.linalg.eigh(R @ bread @ R.T)
        share = np.clip(1.0 - leverage, 0.0, 1.0)  # of the noise that is left in the residual
        gain = 1.0 / np.sqrt(np.maximum(share, 1.0 - _OWN))
        along = gain * (V.T @ u)
        # the weight of each eigenvector is its leverage
        along_squares += float(leverage @ along**2)
        expected += float(leverage @ (gain**2 * share))
        np.matmul(V.T, R, out=rotated[k])
        np.multiply(gain[:, None], rotated[k], out=adjusted[k])
        score = along @ rotated[k]
        meat += np.outer(score, score)
        missing = np.sqrt(np.maximum(1.0 - gain**2 * share, 0.0))[:, None] * rotated[k]
        alone += missing.T @ missing
    inflation = along_squares / expected
    return Scatter(meat + inflation * alone, bread, inflation, rotated, adjusted)


def sandwich(bread: Array, meat: Array) -> Array:
    """Return the covariance bread meat bread^T of parameters (sandwich estimate).

    Args:
        bread: Derivative of the parameters with respect to the score, shape (c, c).
        meat: Covariance of the score, shape (c, c).
    """
    covariance: Array = bread @ meat @ bread.T
    return covariance


def at_least(covariance: Array, variance: Array) -> Array:
    """Return a covariance with lower bounds on its variances; correlations are unchanged.

    Args:
        covariance: Covariance, shape (c, c).
        variance: Lower bounds of the variances, shape (c,).
    """
    own = np.sqrt(np.diag(covariance))
    wider = np.maximum(own, np.sqrt(variance)) / own
    grown: Array = covariance * np.outer(wider, wider)
    return grown


def quantile(freedom: Array) -> Array:
    """Return the half-width of two-sided 95 % intervals in standard errors, shape (c,).

    Args:
        freedom: Degrees of freedom of each standard error (Student's distribution), shape (c,).
    """
    quantiles: Array = scipy.special.stdtrit(freedom, 0.975)
    return quantiles
