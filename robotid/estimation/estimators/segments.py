"""Scatter of the scores of segments: standard errors of least squares with coloured noise.

The covariance of the score of a segment, W_s^T (tau_s - W_s theta), is that of the noise, whatever
its colour, if the segment is longer than the correlation time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special

from robotid.base.exceptions import DataError
from robotid.base.typing import Array
from robotid.dynamics.factors import Factors

#: Smallest number of segments for an estimate of the scatter.
FEWEST_SEGMENTS = 12
_OWN = 0.95  # leverage above which a segment determines a direction alone, without scatter
_UNSEEN = 1e-12  # leverage of a direction, or share of a variance, that is rounding error


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of the scores of s segments about 0, for c parameters.

    The leverages of a segment with weighted rows W are the eigenvalues of
    L^T W^T W L = Q diag(leverage) Q^T.
    """

    meat: Array  # (c, c), covariance of the score W^T S^-1 (tau - W theta) of all segments
    bread: Array  # (c, c), covariance of the parameters if rows were independent
    inflation: float  # mean ratio of the scatter to that of independent rows [-]
    root: Array  # (c, c), L
    axes: Array  # (s, c, c), Q of each segment
    leverage: Array  # (s, c)
    gain: Array  # (s, c), correction for it

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters, shape (c, c)."""
        return sandwich(self.bread, self.meat)

    def freedom(self) -> Array:
        """Return the degrees of freedom of each parameter's variance, shape (c,), at least 1.

        They are inf for parameters that no segment sees: their variance is that of a prior. Bell,
        McCaffrey (2002), Bias reduction in standard errors for linear regression with multi-stage
        samples, section 4.
        """
        along = self.axes.mT @ self.root.T  # (s, c, c): column l is that of parameter l
        weight = (self.leverage * self.gain)[..., None]
        squares = np.sum(weight * self.gain[..., None] * along**2, axis=1)  # (s, c)
        back = self.axes @ (weight * along)
        freedom: Array = np.full(len(self.bread), np.inf)
        for k in np.flatnonzero(squares.sum(axis=0) > _UNSEEN * np.diag(self.bread)):
            # covariances of the segments' contributions to the parameter for independent noise
            Z = back[:, :, k]
            gram = np.diag(squares[:, k]) - Z @ Z.T
            total = float(np.trace(gram))
            is_rounding = total <= _UNSEEN * float(squares[:, k].sum())  # of one segment alone
            freedom[k] = 1.0 if is_rounding else total**2 / float((gram**2).sum())
        return np.maximum(freedom, 1.0)


def scatter(segments: Sequence[Factors], theta: Array, sigma: Array, bread: Array) -> Scatter:
    """Return the scatter of the scores of segments.

    The residual of a fitted segment is smaller than its noise. It is multiplied by
    (I - leverage)^-1/2, which is exact for independent rows (CR2). Directions that one segment
    alone determines have no scatter; the mean scatter of all others is used for them.

    theta (c,), sigma (n,) [N m or N], bread (c, c).
    """
    if len(segments) < FEWEST_SEGMENTS:
        raise DataError(
            f"{len(segments)} segments are too few to estimate the scatter of their scores, wanted "
            f"at least {FEWEST_SEGMENTS}; fit longer logs"
        )
    s, c = len(segments), len(theta)
    meat, alone, along_squares, expected = np.zeros((c, c)), np.zeros((c, c)), 0.0, 0.0
    root, axes, (leverages, gains) = _root(bread), np.empty((s, c, c)), np.empty((2, s, c))
    for k, segment in enumerate(segments):  # one by one: all together are larger than a cache
        W, residual = segment.weighted_rows(theta, sigma)
        B = W @ root
        leverage, Q = np.linalg.eigh(B.T @ B)
        share = np.clip(1.0 - leverage, 0.0, 1.0)  # of the noise that is left in the residual
        gain = 1.0 / np.sqrt(np.maximum(share, 1.0 - _OWN))
        along = Q.T @ (B.T @ residual)
        # the weight of each direction is its leverage
        along_squares += float(np.sum((gain * along) ** 2))
        expected += float(leverage @ (gain**2 * share))
        is_seen = leverage > _UNSEEN
        corrected = along / np.where(is_seen, leverage, 1.0) * np.where(is_seen, gain - 1.0, 0.0)
        score = W.T @ (residual + B @ (Q @ corrected))
        meat += np.outer(score, score)
        is_own = gain**2 * share < 1.0 - _UNSEEN
        missing = np.sqrt((1.0 - gain**2 * share)[is_own] / leverage[is_own]) * Q[:, is_own]
        missing = W.T @ (B @ missing)
        alone += missing @ missing.T
        axes[k], leverages[k], gains[k] = Q, leverage, gain
    inflation = along_squares / expected
    return Scatter(meat + inflation * alone, bread, inflation, root, axes, leverages, gains)


def _root(covariance: Array) -> Array:
    """Return L with L L^T = covariance, shape (c, c); variances may be 0."""
    deviation = np.sqrt(np.diag(covariance))
    scale = np.where(deviation > 0.0, deviation, 1.0)
    variances, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(variances, 0.0)))


def sandwich(bread: Array, meat: Array) -> Array:
    """Return the covariance bread meat bread^T, (c, c), of parameters (sandwich estimate)."""
    return np.asarray(bread @ meat @ bread.T)


def at_least(covariance: Array, variance: Array) -> Array:
    """Return a covariance (c, c) with lower bounds (c,) on its variances, alike correlations."""
    deviation = np.sqrt(np.diag(covariance))
    wider = np.maximum(deviation, np.sqrt(variance)) / deviation
    return np.asarray(covariance * np.outer(wider, wider))


def quantile(freedom: Array) -> Array:
    """Return the half-width of two-sided 95 % intervals in standard errors, shape (c,)."""
    return np.asarray(scipy.special.stdtrit(freedom, 0.975))
