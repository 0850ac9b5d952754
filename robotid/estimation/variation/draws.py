"""Draws from the joint distribution of parameters, each of them physically possible."""

from collections.abc import Callable

import numpy as np
import scipy.special

from robotid.base.typing import Array

_STEPS = 60  # of each chain; with a possible proposal, one step is an independent draw
_SMALLEST = 1e-12  # eigenvalue over the largest that counts as 0


def root_of(covariance: Array) -> Array:
    """Return L with L L^T = C, lower triangular, shape (p, p): covariance (p, p)."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    inverse = np.where(scale > 0.0, 1.0 / np.where(scale > 0.0, scale, 1.0), 0.0)
    w, V = np.linalg.eigh(inverse[:, None] * covariance * inverse)
    w = np.where(w > _SMALLEST * max(float(w.max(initial=0.0)), 0.0), w, 0.0)
    R = np.linalg.qr((scale[:, None] * V * np.sqrt(w)).T, mode="r")
    sign = np.where(np.diag(R) < 0.0, -1.0, 1.0)
    lower: Array = np.tril((sign[:, None] * R).T)
    return lower


def possible_draws(
    root: Array,
    is_possible: Callable[[Array], Array],
    count: int,
    rng: np.random.Generator,
) -> Array:
    """Return draws of x ~ N(0, L L^T), given that they are possible, shape (count, p).

    Each draw is the end of its own chain of elliptical slice sampling from x = 0, which must be
    possible.

    References:
        Murray, Adams, MacKay (2010), Elliptical slice sampling, figure 2.

    root (p, r), is_possible (k, p).
    """
    x = np.zeros((count, len(root)))
    for _ in range(_STEPS):
        other = rng.standard_normal((count, root.shape[1])) @ root.T
        angle = rng.uniform(0.0, 2.0 * np.pi, count)
        low, high, left = angle - 2.0 * np.pi, angle.copy(), np.arange(count)
        moved = x.copy()
        while len(left):
            a = angle[left, None]
            tried = x[left] * np.cos(a) + other[left] * np.sin(a)
            accepted = is_possible(tried)
            moved[left[accepted]] = tried[accepted]
            left = left[~accepted]
            low[left] = np.where(angle[left] < 0.0, angle[left], low[left])
            high[left] = np.where(angle[left] < 0.0, high[left], angle[left])
            angle[left] = rng.uniform(low[left], high[left])
        x = moved
    return x


def correlated_scores(scores: Array, share: Array, correlation: Array, drawn: Array) -> Array:
    """Return standard normal scores of a new run: error of the fit, and deviation of the run.

    z = sqrt(share) * scores + sqrt(1 - share) * w with w ~ N(0, R).

    scores (k, m), share (m,), correlation (m, m), drawn (k, m).
    """
    w = drawn @ np.linalg.cholesky(correlation).T
    found: Array = np.sqrt(share) * scores + np.sqrt(1.0 - share) * w
    return found


def scores_to_values(z: Array, scores: Array, quantiles: Array, least: float) -> Array:
    """Return the values at standard normal scores of a predictive distribution, shape (k,).

    z (k,), scores (s,), quantiles (s,).
    """
    slope = np.diff(quantiles) / np.diff(scores)
    if least > quantiles[0]:
        below = scipy.special.ndtr(np.interp(least, quantiles, scores))
        z = scipy.special.ndtri(below + (1.0 - below) * scipy.special.ndtr(z))
    values = np.interp(z, scores, quantiles)
    values = values + slope[0] * np.minimum(z - scores[0], 0.0)
    values = values + slope[-1] * np.maximum(z - scores[-1], 0.0)
    return np.asarray(np.maximum(values, least))
