"""Restricted likelihood of many mixed-effects models together, in closed form.

Members of a level (runs, or units) have the information W about their parameters. A deviation with
the variance d of parameter p is integrated out of it by

    W - W_p W_p^T d / (1 + d W_pp),

without an inverse, so W may be singular. Arrays have the parameters first and the members last:
W (q, q, b, k) and W x (q, b, k) for b models of k members. A member that a model leaves out has no
information in it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robotid.base.exceptions import NotConvergedError
from robotid.base.typing import Array

_UNKNOWN = 100.0  # standard deviation of a parameter before the data, in plausible sizes
_FREEDOM = 4.0  # degrees of freedom of the half Student prior of a standard deviation
_LEAST, _MOST = -6.0, 5.0  # logarithm of the standard deviations over their plausible size
#: Logarithm of the standard deviations, over their plausible size, that are integrated.
GRID = np.linspace(_LEAST, _MOST, 45)

_STEP = 1e-5  # of the numerical curvature
_FLAT = 1e-9  # largest slope of the log density at its maximum
_SHORTEST = 1e-10  # step at which a search ends
_LONGEST = 1.0  # step of a search
_STEPS = 200  # of a search, at most
_FALLS = 0.2  # slope over that before the step, above which the curvature is computed anew
_FLATTEST = 0.1  # curvature of a step, at least
_ROUNDING = 1e-10  # of a log density


@dataclass(frozen=True, eq=False)
class Evidence:
    """Log likelihood and mean of b models.

    Attributes:
        log_likelihood: Logarithm of the restricted likelihood, shape (b,).
        slope: Its derivatives by the variances of the levels, shape (levels, q, b).
        mean: Mean of the parameters, shape (b, q).
        covariance: Covariance of the mean, shape (b, q, q).
    """

    log_likelihood: Array
    slope: Array
    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Grid:
    """Models with g standard deviations of one parameter at the highest level.

    Attributes:
        deviation: The standard deviations, shape (g,).
        log_density: Logarithm of their density, shape (b, g).
        mean: Mean of the parameter, shape (b, g).
        variance: Variance of the mean, shape (b, g).
        alone: Variance of the estimate of a typical member about its mean, shape (b, g).
    """

    deviation: Array
    log_density: Array
    mean: Array
    variance: Array
    alone: Array


def integrated(W: Array, w: Array, variance: Array) -> tuple[Array, Array, Array]:
    """Integrate the deviations of one level out of its members' information.

    W (q, q, b, k), w (q, b, k), variance (q, b) -> (b,).
    """
    shape = np.broadcast_shapes(W.shape[2:], (*variance.shape[1:], 1))
    W, w = (np.array(np.broadcast_to(x, (*x.shape[:-2], *shape))) for x in (W, w))
    total = np.zeros(shape)
    for p, d in enumerate(variance[:, :, None]):
        t = 1.0 + d * W[p, p]
        column, w_p = W[:, p] / t, w[p] / t
        total += d * w[p] * w_p - np.log(t)
        w -= d * W[:, p] * w_p
        W -= d * column[:, None] * W[p]
        W[:, p], W[p, :], w[p] = column, column, w_p
    return W, w, 0.5 * total.sum(axis=-1)


def evidence(H: Array, h: Array, unit: Array | None, scale: Array, variance: Array) -> Evidence:
    """Return the restricted likelihood and the mean of b models.

    The derivative by a variance of a level is the sum of [(W r)_p^2 - W_pp + (W C W)_pp] / 2 over
    its members with r = x - c, and c and C the mean of the member before its own deviation and
    its covariance.

    References:
        Patterson, Thompson (1971), Recovery of inter-block information when block sizes are
        unequal (restricted likelihood).

    H (q, q, b or 1, k), h (q, b or 1, k), unit (k,), scale (q,), variance (levels, q, b).
    """
    W, w, total = integrated(H, h, variance[0])
    levels = [(W, w)]
    if unit is not None:
        W, w, more = integrated(*by_unit(W, w, unit), variance[1])
        levels, total = [*levels, (W, w)], total + more
    information = np.moveaxis(W.sum(axis=-1), -1, 0) + np.diag(prior_of(scale))
    score, C = w.sum(axis=-1).T, np.linalg.inv(information)
    mean = np.einsum("bpi,bi->bp", C, score)
    total = total + 0.5 * np.einsum("bp,bp->b", score, mean)
    total -= 0.5 * np.linalg.slogdet(information)[1]
    slope, eye = np.empty(variance.shape), np.eye(len(scale))[:, :, None, None]
    around, centre = np.moveaxis(C, 0, -1)[..., None], mean.T[..., None]  # (q, q, b, 1), (q, b, 1)
    for level in reversed(range(len(levels))):
        W, w = levels[level]
        r = w - np.einsum("pibk,ibk->pbk", W, centre)  # W (x - c)
        CW = np.einsum("ijbk,jpbk->ipbk", around, W)
        terms = r**2 - np.einsum("ppbk->pbk", W) + np.einsum("ipbk,ipbk->pbk", W, CW)
        slope[level] = 0.5 * terms.sum(axis=-1)
        if level and unit is not None:  # mean of each unit, and its covariance: of its runs
            d = variance[level][..., None]
            DW = d[:, None] * W
            left = eye - DW
            own = eye * d - DW * d
            moved = np.einsum("pibk,ijbk->pjbk", left, around)
            around = own + np.einsum("pjbk,ljbk->plbk", moved, left)
            centre = centre + d * r
            around, centre = around[..., unit], centre[..., unit]
    return Evidence(total, slope, mean, C)


def most_probable(H: Array, h: Array, unit: Array | None, scale: Array, first: Array) -> Array:
    """Return the most probable standard deviations of b models, shape (levels, q, b).

    Newton's method from the start; the density never falls.

    References:
        Gelman (2006), Prior distributions for variance parameters in hierarchical models, section
        2.2 (half Student prior).

    scale (q,), first (levels, q, b).
    """
    shape = first.shape

    def deviation_of(z: Array) -> Array:
        deviation: Array = scale[:, None] * np.exp(z.reshape(*shape[:2], -1))
        return deviation

    def density(z: Array, own: Array) -> tuple[Array, Array]:
        """Return the log density of models (b,) and its slope by z (levels q, b)."""
        variance = deviation_of(z) ** 2
        at = own if H.shape[2] > 1 else np.zeros(1, dtype=int)
        found = evidence(H[:, :, at], h[:, at], unit, scale, variance)
        slope = (2.0 * variance * found.slope).reshape(z.shape)
        rises = 1.0 - (_FREEDOM + 1.0) / (1.0 + _FREEDOM * np.exp(-2.0 * z))
        return found.log_likelihood + log_prior(z).sum(axis=0), slope + rises

    z = np.clip(first, _LEAST, _MOST).reshape(-1, shape[2])
    left = np.arange(shape[2])
    (value, slope), length = density(z, left), np.ones(shape[2])
    curvature, is_old = np.zeros((shape[2], len(z), len(z))), np.ones(shape[2], dtype=bool)
    for _ in range(_STEPS):
        left = left[_steepest(z[:, left], slope[:, left]) > _FLAT]
        if not len(left):
            return deviation_of(z)
        if len(new := left[is_old[left]]):
            curvature[new] = _curvature(density, z[:, new], slope[:, new], new)
        step = length[left] * _step(curvature[left], z[:, left], slope[:, left])
        tried = np.clip(z[:, left] + step, _LEAST, _MOST)
        high, steep = density(tried, left)
        is_higher = high >= value[left] - _ROUNDING * (1.0 + np.abs(value[left]))
        falls = _steepest(tried, steep) / _steepest(z[:, left], slope[:, left])
        is_old[left] = ~is_higher | (falls > _FALLS)
        length[left] = np.where(is_higher, 1.0, 0.25 * length[left])
        moved = left[is_higher]
        z[:, moved], value[moved] = tried[:, is_higher], high[is_higher]
        slope[:, moved] = steep[:, is_higher]
        left = left[np.abs(step).max(axis=0) > _SHORTEST]
    raise NotConvergedError(
        f"the most probable spreads between runs were not found in {_STEPS} steps", "steps"
    )


def on_grid(
    H: Array, h: Array, unit: Array | None, scale: Array, deviation: Array, p: int, members: int
) -> Grid:
    """Return b models for standard deviations of parameter p at the highest level.

    scale (q,), deviation (levels, q, b).
    """
    q, d = len(scale), (scale[p] * np.exp(GRID)) ** 2
    W, w, total = H, h, np.zeros(1)
    if unit is not None:
        W, w, total = integrated(H, h, deviation[0] ** 2)
        W, w = by_unit(W, w, unit)
    variance = deviation[-1] ** 2
    variance[p] = 0.0  # integrated below
    W, w, more = integrated(W, w, variance)
    others = [o for o in range(q) if o != p]
    W_p, w_p, W_o = W[p, p], w[p], W[others, p]  # (b, k), (q - 1, b, k)
    t = 1.0 + d[:, None] * W_p[:, None]  # (b, g, k)
    logs = np.log(t).sum(axis=-1)
    x = np.concatenate(
        [W_p[None], w_p[None], w_p[None] ** 2, W_o, W_o * w_p,
         (W_o[:, None] * W_o).reshape(-1, *w_p.shape)]
    )  # fmt: skip
    sums = np.moveaxis(np.moveaxis(x, 0, 1) @ np.swapaxes(1.0 / t, 1, 2), 1, 0)  # (n, b, g)
    at = np.split(sums, np.cumsum([1, 1, 1, q - 1, q - 1]))
    information, score = np.empty((q, q, *logs.shape)), np.empty((q, *logs.shape))
    information[p, p], score[p] = at[0][0], at[1][0]
    information[others, p] = information[p, others] = at[3]
    score[others] = w[others].sum(axis=-1)[..., None] - d * at[4]
    W_oo = W[np.ix_(others, others)].sum(axis=-1)[..., None]
    information[np.ix_(others, others)] = W_oo - d * at[5].reshape(q - 1, q - 1, *logs.shape)
    own = np.diag(prior_of(scale))[:, :, None, None]
    evidence, mean, variance = _solved(information + own, score, p)
    alone = _solved(information / members + own, score, p)[2]
    likelihood = (total + more)[:, None] + 0.5 * (d * at[2][0] - logs) + evidence
    return Grid(np.sqrt(d), likelihood + log_prior(GRID), mean, variance, alone)


def by_unit(W: Array, w: Array, unit: Array) -> tuple[Array, Array]:
    """Return the sums of the information W and W x over the runs of each unit.

    W (q, q, b, k), w (q, b, k), unit (k,).
    """
    member = 1.0 * (unit[:, None] == np.arange(unit.max() + 1))
    return W @ member, w @ member


def log_prior(z: Array) -> Array:
    """Return the log density of z = log(deviation / scale), half Student's distribution."""
    log_density: Array = z - 0.5 * (_FREEDOM + 1.0) * np.log1p(np.exp(2.0 * z) / _FREEDOM)
    return log_density


def prior_of(scale: Array) -> Array:
    """Return the information about the mean before the data, shape (q,): scale (q,)."""
    information: Array = (_UNKNOWN * scale) ** -2.0
    return information


def _solved(information: Array, score: Array, p: int) -> tuple[Array, Array, Array]:
    """Return (s^T C s - log det I) / 2 and mean and variance of parameter p, shape (b, g) each.

    information (q, q, b, g), score (q, b, g).
    """
    left, s, total = information.copy(), score.copy(), np.zeros(score.shape[1:])
    for o in [*(o for o in range(len(s)) if o != p), p]:
        pivot, column, s_o = left[o, o].copy(), left[:, o].copy(), s[o].copy()
        total += s_o**2 / pivot - np.log(pivot)
        if o != p:
            left -= column[:, None] * column / pivot
            s -= column * (s_o / pivot)
    return 0.5 * total, s[p] / left[p, p], 1.0 / left[p, p]


def _steepest(z: Array, slope: Array) -> Array:
    """Return the largest slope of each model into the permitted range, shape (b,)."""
    is_out = ((z <= _LEAST) & (slope < 0.0)) | ((z >= _MOST) & (slope > 0.0))
    steepest: Array = np.where(is_out, 0.0, np.abs(slope)).max(axis=0)
    return steepest


def _curvature(
    density: Callable[[Array, Array], tuple[Array, Array]], z: Array, slope: Array, own: Array
) -> Array:
    """Return minus the second derivatives of the log density of models, shape (b, s, s)."""
    s, b = z.shape
    moved = z[:, None] + _STEP * np.eye(s)[:, :, None]  # (s, s, b): the second one is moved
    _, slopes = density(moved.reshape(s, -1), np.tile(own, s))
    found = -np.moveaxis((slopes.reshape(s, s, b) - slope[:, None]) / _STEP, -1, 0)
    return 0.5 * (found + np.swapaxes(found, 1, 2))


def _step(curvature: Array, z: Array, slope: Array) -> Array:
    """Return Newton's step of each model, uphill and of limited length, shape (s, b)."""
    is_out = ((z <= _LEAST) & (slope < 0.0)) | ((z >= _MOST) & (slope > 0.0))
    fixed, eye = is_out.T[:, :, None] | is_out.T[:, None], np.eye(len(z), dtype=bool)
    size, V = np.linalg.eigh(np.where(fixed, 1.0 * eye, curvature))
    uphill = np.einsum("bij,bj->bi", np.swapaxes(V, 1, 2), np.where(is_out, 0.0, slope).T)
    step = np.einsum("bij,bj->ib", V, uphill / np.maximum(np.abs(size), _FLATTEST))
    limited: Array = step / np.maximum(np.abs(step).max(axis=0) / _LONGEST, 1.0)
    return limited
