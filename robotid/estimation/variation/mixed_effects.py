"""Mixed-effects model of parameters that vary between runs, and between units (robots).

    x_run = mu + u_unit + u_run + e_run,    u_unit ~ N(0, D_unit),  u_run ~ N(0, D_run),

with diagonal D. A run gives the information H about its own x and the product h = H x_hat, so runs
in which a parameter had no effect (singular H) need no special case. Deviations are integrated out
level by level. The restricted likelihood of the standard deviations in D is weighted by a wide
prior about a plausible size. The standard deviation that a prediction depends on is integrated
numerically: with few runs, its uncertainty is the largest part of the prediction interval.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.special

from robotid.base.typing import Array
from robotid.estimation.variation.restricted_likelihood import (
    GRID,
    Grid,
    by_unit,
    evidence,
    integrated,
    most_probable,
    on_grid,
    prior_of,
)

_FIRST = -1.0  # logarithm of the standard deviations over their plausible size, at the start
_NEAR = 2.0  # ... and largest distance of a stated start: the slope is small beyond
_TAIL = 0.025  # probability beyond each end of an interval
_ENDS = np.array([_TAIL, 1.0 - _TAIL])
_ELEMENTS = 1_000_000  # of an array that compares runs, at most
_HALVINGS = 200  # of the range of a quantile, at most
_CLOSE = 1e-15  # change of a quantile that rounding decides


@dataclass(frozen=True, eq=False)
class Runs:
    """Information of k runs about q parameters that may vary.

    Attributes:
        H: Information (inverse covariance) of each run, shape (k, q, q), symmetric; singular if
            the run does not determine all.
        h: H times the estimate of each run, shape (k, q).
        unit: Index of the unit (robot) of each run, shape (k,), int, from 0.
        scale: Plausible standard deviation of each parameter, shape (q,), positive.
    """

    H: Array
    h: Array
    unit: Array
    scale: Array

    def without(self, run: int) -> "Runs":
        """Return the runs except one."""
        return self._only(np.arange(len(self.h)) != run)

    def without_unit(self, unit: int) -> "Runs":
        """Return the runs of the other units."""
        return self._only(self.unit != unit)

    def of_unit(self, unit: int) -> "Runs":
        """Return the runs of one unit."""
        return self._only(self.unit == unit)

    def _only(self, left: Array) -> "Runs":
        _, unit = np.unique(self.unit[left], return_inverse=True)
        return replace(self, H=self.H[left], h=self.h[left], unit=unit)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Mean, standard deviation and prediction interval of one parameter.

    Attributes:
        mean: Mean over runs and units.
        std_error: Its standard error.
        spread: Standard deviation between runs or units, median.
        spread_ends: Ends of its 95 % interval, shape (2,).
        ends: Ends of the 95 % prediction interval of a new run or unit, shape (2,).
        probability: Two-sided probability of a deviation as large as that of a given value; 1 if
            none was given.
        mixture: Predictive distribution of a new run or unit, a mixture of normal distributions:
            weights, means and standard deviations, shape (3, g).
        after: Expected standard error of the mean, and expected width of the prediction interval,
            with one more run, or one more unit if there are several; NaN if not computed.
    """

    mean: float
    std_error: float
    spread: float
    spread_ends: Array
    ends: Array
    probability: float = 1.0
    mixture: Array = field(default_factory=lambda: np.zeros((3, 0)))
    after: tuple[float, float] = (math.nan, math.nan)

    def shifted(self, centre: float) -> "Prediction":
        """Return the prediction of the parameter plus a constant."""
        moved = self.mixture + np.array([[0.0], [centre], [0.0]])
        return replace(self, mean=self.mean + centre, ends=self.ends + centre, mixture=moved)

    def quantiles(self, scores: Array) -> Array:
        """Return quantiles of the predictive distribution: scores (k,) -> (k,)."""
        return _mixture_quantiles(scipy.special.ndtr(scores), *self.mixture)


@dataclass(frozen=True, eq=False)
class Compared:
    """Runs, or units, each compared with the prediction of all others.

    Attributes:
        values: Their own parameters, shape (m, q).
        covariance: Covariance of these, shape (m, q, q).
        mean: Mean of the others, shape (m, q).
        probability: Two-sided probability of such a deviation, shape (m, q).
    """

    values: Array
    covariance: Array
    mean: Array
    probability: Array


@dataclass(frozen=True, eq=False)
class MixedEffects:
    """The mixed-effects model of runs: of one unit, or of several.

    Attributes:
        runs: The runs.
        first: Deviations at the start of their search, shape (levels or more, q); None: typical.
    """

    runs: Runs
    first: Array | None = None

    @property
    def n_levels(self) -> int:
        """2 if there are several units, 1 otherwise."""
        return 2 if self.runs.unit.max() > 0 else 1

    @property
    def n_members(self) -> int:
        """Number of units if there are several, of runs otherwise."""
        return int(self.runs.unit.max()) + 1 if self.n_levels == 2 else len(self.runs.h)

    @cached_property
    def deviation(self) -> Array:
        """Most probable standard deviations, shape (levels, q): between runs, between units."""
        first = np.full((self.n_levels, len(self.runs.scale)), _FIRST)
        if self.first is not None:
            first = self._near(self.first[: self.n_levels])
        found = most_probable(*self._members, self.runs.scale, first[:, :, None])
        return found[:, :, 0]

    @cached_property
    def values(self) -> tuple[Array, Array]:
        """Parameters in each run and their standard errors, shapes (k, q).

        They are means of the run's own estimate and those of its unit and of all units, weighted by
        their information (best linear unbiased prediction).
        """
        runs, deviation = self.runs, self.deviation
        found = evidence(*self._members, runs.scale, deviation[:, :, None] ** 2)
        centre, around = np.tile(found.mean[0], (len(runs.h), 1)), found.covariance[0]
        if self.n_levels == 2:
            W, w, _ = integrated(*self._members[:2], deviation[0][:, None] ** 2)
            W, w = by_unit(W, w, runs.unit)
            W, w = np.moveaxis(W[:, :, 0], -1, 0), w[:, 0].T
            means, around = _predicted(deviation[1], W, w, centre[: len(w)], around)
            centre, around = means[runs.unit], around[runs.unit]
        values, errors = _predicted(deviation[0], runs.H, runs.h, centre, around)
        return values, np.sqrt(np.einsum("kpp->kp", errors))

    def predict(
        self,
        own: Array | None = None,
        value: Array | None = None,
        *,
        is_unit: bool = False,
    ) -> tuple[Prediction, ...]:
        """Return the prediction of each parameter in a new run of a new unit.

        With one unit it is that of a new run. The standard deviation of the highest level is
        integrated, parameter by parameter; all others have their most probable values.
        """
        q = len(self.runs.scale)
        own = np.zeros(q) if own is None else own
        found = []
        for p in range(q):
            grid = self._on_grid(p)
            weight = _weight(grid.log_density[0])
            mean, error = _moments(weight, grid.mean[0], grid.variance[0])
            levels = slice(1 if is_unit else 0, -1)
            between = grid.deviation**2 + (self.deviation[levels, p] ** 2).sum() + own[p]
            mixture = np.array([weight, grid.mean[0], np.sqrt(grid.variance[0] + between)])
            probability = 1.0 if value is None else float(_beyond(value[p], *mixture))
            wanted = (_TAIL, 0.5, 1.0 - _TAIL)
            low, median, high = self.runs.scale[p] * np.exp(
                np.interp(wanted, weight.cumsum() - 0.5 * weight, GRID)
            )
            ends = _mixture_quantiles(_ENDS, *mixture)
            found.append(
                Prediction(
                    mean, error, median, np.array([low, high]), ends, probability, mixture
                )
            )  # fmt: skip
        return tuple(found)

    def with_one_more(self) -> tuple[Prediction, ...]:
        """Return the prediction of each parameter, with what one more run would add.

        With several units it is one more unit. The new run or unit is expected to give as much
        information as the mean of the others. The information about the mean then increases by
        1 / k. The expected log likelihood of the new value, at the median of the spread, is added
        to the density of the spread.
        """
        found = []
        for p, each in enumerate(self.predict()):
            grid = self._on_grid(p)
            variance = grid.variance[0]
            total = grid.alone[0] + variance  # of the estimate of a new member about the mean
            expected = float(np.interp(each.spread, grid.deviation, total))
            weight = _weight(grid.log_density[0] - 0.5 * (np.log(total) + expected / total))
            more = variance * self.n_members / (self.n_members + 1.0)
            _, error = _moments(weight, grid.mean[0], more)
            lower = (self.deviation[:-1, p] ** 2).sum()
            std = np.sqrt(more + grid.deviation**2 + lower)
            width = float(np.ptp(_mixture_quantiles(_ENDS, weight, grid.mean[0], std)))
            found.append(replace(each, after=(error, width)))
        return tuple(found)

    def against_others(self, which: Array, *, is_unit: bool) -> Compared:
        """Compare runs, or units, each with the prediction of all others: which (m,)."""
        unit = self.runs.unit
        own = which[:, None] == (unit if is_unit else np.arange(len(unit)))  # (m, k)
        found: list[tuple[Array, tuple[Array, ...]]] = []
        several = np.array([len(np.unique(unit[~each])) > 1 for each in own])
        most = max(1, _ELEMENTS // (len(GRID) * len(unit)))
        for levels in (1, 2):
            left = np.flatnonzero(several == (levels == 2))
            for some in np.split(left, range(most, len(left), most)) if len(left) else ():
                found.append((some, self._compared(own[some], levels, is_unit=is_unit)))
        order = np.argsort(np.concatenate([some for some, _ in found]))
        parts = zip(*(part for _, part in found), strict=True)
        return Compared(*(np.concatenate(each)[order] for each in parts))

    def _compared(
        self, own: Array, levels: int, *, is_unit: bool
    ) -> tuple[Array, Array, Array, Array]:
        """Return the arrays of ``Compared`` for b runs or units: own (b, k)."""
        scale, (H, h, _) = self.runs.scale, self._members
        unit = self.runs.unit if levels == 2 else None
        rest = H * ~own, h * ~own, unit
        first = np.repeat(self._near(self.deviation[:levels])[:, :, None], len(own), axis=2)
        deviation = most_probable(*rest, scale, first)
        W, w = H * own, h * own
        if is_unit:
            W, w, _ = integrated(W, w, deviation[0] ** 2)
        covariance = covariance_of(np.moveaxis(W.sum(axis=-1), -1, 0), scale)
        x = np.einsum("bpi,ib->bp", covariance, w.sum(axis=-1))
        mean, probability = np.empty(x.shape), np.empty(x.shape)
        for p in range(len(scale)):
            grid = on_grid(*rest, scale, deviation, p, 1)
            weight = _weight(grid.log_density)
            mean[:, p] = (weight * grid.mean).sum(axis=-1)
            variance = grid.variance + grid.deviation**2 + covariance[:, p, p, None]
            if levels == 2 and not is_unit:
                variance = variance + deviation[0, p][:, None] ** 2
            probability[:, p] = _beyond(x[:, p], weight, grid.mean, np.sqrt(variance))
        return x, covariance, mean, probability

    def _near(self, deviation: Array) -> Array:
        """Return the start of a search near deviations (levels, q), as of ``most_probable``."""
        first: Array = np.log(deviation / self.runs.scale)
        return np.clip(first, _FIRST - _NEAR, _FIRST + _NEAR)

    @cached_property
    def _members(self) -> tuple[Array, Array, Array | None]:
        """Runs as in ``evidence``, one model."""
        H, h = np.moveaxis(self.runs.H, 0, -1)[:, :, None], self.runs.h.T[:, None]
        return H, h, self.runs.unit if self.n_levels == 2 else None

    def _on_grid(self, p: int) -> Grid:
        """Return the model for standard deviations of parameter p at the highest level."""
        deviation = self.deviation[:, :, None]
        return on_grid(*self._members, self.runs.scale, deviation, p, self.n_members)


def covariance_of(H: Array, scale: Array) -> Array:
    """Return the covariance of parameters from their information, with almost no prior.

    H (..., q, q), scale (q,).
    """
    covariance: Array = np.linalg.inv(H + np.diag(prior_of(scale)))
    return covariance


def _predicted(
    deviation: Array, H: Array, h: Array, centre: Array, covariance: Array
) -> tuple[Array, Array]:
    """Return the values of the members of a level, shape (k, q), and their errors' covariance.

    The deviation of a member is U (h - H centre) with U = (H + D^-1)^-1.

    deviation (q,), H (k, q, q), h (k, q), centre (k, q), covariance (k, q, q).
    """
    U = _posterior(H, deviation)
    left = np.eye(h.shape[1]) - U @ H
    values = centre + np.einsum("kpi,ki->kp", U, h - np.einsum("kpi,ki->kp", H, centre))
    return values, U + left @ covariance @ np.swapaxes(left, 1, 2)


def _posterior(H: Array, S: Array) -> Array:
    """Return (H + S^-2)^-1 = S (1 + S H S)^-1 S, shape (k, q, q)."""
    U: Array = S[:, None] * np.linalg.inv(np.eye(len(S)) + S[:, None] * H * S) * S
    return U


def _beyond(x: Array, weight: Array, means: Array, std: Array) -> Array:
    """Return the two-sided probability of values as far out as x in mixtures of normals, (...)."""
    z = (x[..., None] - means) / std
    tails = [(weight * scipy.special.ndtr(side)).sum(axis=-1) for side in (z, -z)]
    beyond: Array = np.minimum(2.0 * np.minimum(*tails), 1.0)
    return beyond


def _mixture_quantiles(wanted: Array, weight: Array, means: Array, std: Array) -> Array:
    """Return the values with given probabilities of smaller values in a mixture of normals.

    Newton's method within the quantiles of the normal distributions, halved where it leaves them.

    wanted (n,), weight (g,), means (g,), std (g,).
    """
    each = means + std * scipy.special.ndtri(wanted)[:, None]  # (n, g)
    low, high = each.min(axis=1), each.max(axis=1)
    x = np.clip(each @ weight, low, high)
    for _ in range(_HALVINGS):
        z = (x[:, None] - means) / std
        off = scipy.special.ndtr(z) @ weight - wanted
        density = np.exp(-0.5 * z**2) @ (weight / std) / math.sqrt(2.0 * math.pi)
        low, high = np.where(off <= 0.0, x, low), np.where(off >= 0.0, x, high)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            tried = x - off / density
        tried = np.where((tried > low) & (tried < high), tried, 0.5 * (low + high))
        if np.all(np.abs(tried - x) <= _CLOSE * (high - low + np.abs(x))):
            break
        x = tried
    return np.asarray(tried)


def _weight(log_density: Array) -> Array:
    """Return weights that sum to 1, shape (..., g), from the logarithm of a density."""
    weight = np.exp(log_density - log_density.max(axis=-1, keepdims=True))
    normed: Array = weight / weight.sum(axis=-1, keepdims=True)
    return normed


def _moments(weight: Array, centres: Array, variance: Array) -> tuple[float, float]:
    """Return the mean of a mixture, and its standard deviation."""
    mean = float(weight @ centres)
    return mean, float(np.sqrt(weight @ (variance + (centres - mean) ** 2)))
