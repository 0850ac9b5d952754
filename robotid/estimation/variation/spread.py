"""Spread of parameters between runs, or units (robots), on a grid, and draws of a next one.

    x_run = mu + u_unit + u_run + e_run,    u_unit ~ N(0, s_unit^2),  u_run ~ N(0, s_run^2)

A run gives the information H about the parameters of its group, possibly singular, and h = H x_hat.
Parameters are treated one by one: the deviations of the others are integrated out of each run with
the spread found for them, and their means add to the variance of its own. The standard deviations s
are integrated on a grid with a half Student prior of a plausible scale. With one unit the runs are
its members. Gelman (2006), Prior distributions for variance parameters in hierarchical models,
section 2.2.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.special

from robotid.base.typing import Array

_UNKNOWN = 100.0  # standard deviation of a mean before the data, in plausible sizes
_FREEDOM = 4.0  # degrees of freedom of the half Student prior of a standard deviation
_GRID = np.linspace(-6.0, 5.0, 45)  # log of standard deviations over their plausible size
_SWEEPS = 2  # over the parameters of a group, each with the spread of the others
_TAILS = np.array([0.025, 0.5, 0.975])
_HALVINGS = 60  # of the range of a quantile
_STEPS = 60  # of each chain; with a possible proposal, one step is an independent draw


@dataclass(frozen=True, eq=False)
class Runs:
    """Information of k runs about q parameters that may vary."""

    H: Array  # (k, q, q), information of each run (inverse covariance), may be singular
    h: Array  # (k, q), H times the estimate of each run
    unit: Array  # (k,), index of the unit (robot) of each run, int, from 0
    scale: Array  # (q,), plausible standard deviation of each parameter, positive

    def without(self, run: int) -> "Runs":
        """Return the runs except one."""
        left = np.arange(len(self.h)) != run
        _, unit = np.unique(self.unit[left], return_inverse=True)
        return replace(self, H=self.H[left], h=self.h[left], unit=unit)


@dataclass(frozen=True, eq=False)
class Mixture:
    """Mixtures of g normal distributions."""

    weight: Array  # (..., g), weights, which sum to 1
    mean: Array  # (..., g), means
    std: Array  # (..., g), standard deviations

    @classmethod
    def over_grid(cls, weight: Array, mean: Array, std: Array) -> "Mixture":
        """Return the mixtures over the last two axes."""
        parts = np.broadcast_arrays(weight, mean, std)
        return cls(*(part.reshape(*part.shape[:-2], -1) for part in parts))

    def at(self, index: int | tuple[int, ...]) -> "Mixture":
        """Return some of the mixtures."""
        return Mixture(self.weight[index], self.mean[index], self.std[index])

    @property
    def ends(self) -> Array:
        """Ends of the 95 % interval of one mixture, shape (2,)."""
        return self.quantiles(_TAILS[[0, 2]])

    @property
    def moments(self) -> tuple[Array, Array]:
        """Mean and standard deviation, shape (...)."""
        mean = (self.weight * self.mean).sum(axis=-1)
        square = (self.weight * (self.std**2 + (self.mean - mean[..., None]) ** 2)).sum(axis=-1)
        return mean, np.sqrt(square)

    def below(self, x: Array) -> Array:
        """Return the probabilities of values below x, shape (...)."""
        z = (x[..., None] - self.mean) / self.std
        return np.asarray((self.weight * scipy.special.ndtr(z)).sum(axis=-1))

    def beyond(self, x: Array) -> Array:
        """Return the two-sided probabilities of values as far out as x, shape (...)."""
        above = replace(self, mean=-self.mean).below(-x)
        return np.asarray(np.minimum(2.0 * np.minimum(self.below(x), above), 1.0))

    def quantiles(self, wanted: Array) -> Array:
        """Return the values with given probabilities of smaller ones: wanted (n,), one mixture."""
        ends = self.mean + self.std * scipy.special.ndtri(wanted)[:, None]
        low, high = ends.min(axis=1), ends.max(axis=1)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            is_low = self.below(middle) < wanted
            low, high = np.where(is_low, middle, low), np.where(is_low, high, middle)
        return np.asarray(0.5 * (low + high))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Mean and spread of one parameter, and prediction of a new run of a new unit."""

    mean: float  # mean over runs and units
    std_error: float  # its standard error
    spread: float  # standard deviation between runs, or units if there are several, median
    spread_ends: Array  # (2,), ends of its 95 % interval
    mixture: Mixture  # predictive distribution of a new run
    #: Expected standard error of the mean, and expected width of the prediction interval, with one
    #: more run, or one more unit if there are several.
    after: tuple[float, float] = (math.nan, math.nan)
    within: float | None = None  # median spread between runs of a unit, if there are several units

    @cached_property
    def ends(self) -> Array:
        """Ends of the 95 % prediction interval of a new run, shape (2,)."""
        return self.mixture.ends

    def shifted(self, centre: float) -> "Prediction":
        """Return the prediction of the parameter plus a constant."""
        moved = replace(self.mixture, mean=self.mixture.mean + centre)
        return replace(self, mean=self.mean + centre, mixture=moved)


@dataclass(frozen=True, eq=False)
class Compared:
    """Runs, or units, each compared with the prediction of all others."""

    values: Array  # (m, q), their own parameters
    covariance: Array  # (m, q, q), covariance of these
    mixture: Mixture  # prediction of an estimate as uncertain as theirs, shapes (m, q, g)


@dataclass(frozen=True, eq=False)
class _Grid:
    """One parameter on a grid of standard deviations between members (units, or runs) and within.

    Arrays end with the axes (within, between).
    """

    between: Array  # (1, g), variance between members
    within: Array  # (w, 1), variance between the runs of a member
    members: Array  # (k,), member of each run
    W: Array  # (k,), information of each run
    w: Array  # (k,), score
    prior: float  # information about the mean
    others: float  # variance of the mean due to the means of the other parameters
    log_prior: Array  # (w, g)

    @classmethod
    def of(cls, W: Array, w: Array, unit: Array, scale: float, others: float) -> "_Grid":
        """Return the grid of a parameter from the information and scores of runs (k,)."""
        several = bool(unit.max() > 0)
        z = _GRID - 0.5 * (_FREEDOM + 1.0) * np.log1p(np.exp(2.0 * _GRID) / _FREEDOM)
        variance, every = (scale * np.exp(_GRID)) ** 2, slice(None, None, 2)
        return cls(
            between=variance[None], W=W, w=w,
            within=variance[every, None] if several else np.zeros((1, 1)),
            members=unit if several else np.arange(len(unit)),
            prior=(_UNKNOWN * scale) ** -2.0, others=max(others, 0.0),
            log_prior=z + (z[every, None] if several else 0.0),
        )  # fmt: skip

    @cached_property
    def of_runs(self) -> Array:
        """Information, score and log likelihood of each run, shape (3, k, w, 1)."""
        return _integrated(self.W[:, None, None], self.w[:, None, None], self.within)

    @cached_property
    def sums(self) -> Array:
        """The same, summed over the runs of each member, shape (3, u, w, 1)."""
        total = np.zeros((3, int(self.members.max()) + 1, *self.of_runs.shape[2:]))
        for part, values in zip(total, self.of_runs, strict=True):
            np.add.at(part, self.members, values)
        return total

    @cached_property
    def of_members(self) -> Array:
        """Information, score and log likelihood of each member, shape (3, u, w, g)."""
        return self.lifted(self.sums)

    def lifted(self, sums: Array) -> Array:
        """Return the sums of members with the deviation of each integrated, (3, ..., w, g)."""
        integrated = _integrated(sums[0], sums[1], self.between)
        integrated[2] += sums[2]
        return integrated

    def mean(self, total: Array) -> tuple[Array, Array, Array]:
        """Return weight, mean and variance of the mean from sums (3, ..., w, g) over members."""
        information = total[0] + self.prior
        mean = total[1] / information
        log = total[2] + 0.5 * (total[1] * mean - np.log(information)) + self.log_prior
        return _normed(log), mean, 1.0 / information + self.others

    @cached_property
    def all(self) -> tuple[Array, Array, Array]:
        """Weight, mean and variance of the mean by all members, shape (w, g)."""
        return self.mean(self.of_members.sum(axis=1))

    def median(self, axis: int, wanted: Array = _TAILS[1:2]) -> Array:
        """Return quantiles of the standard deviation within (axis 0) or between members (1)."""
        weight = self.all[0].sum(axis=1 - axis)
        variance = (self.within, self.between)[axis].ravel()
        if len(variance) == 1:
            return np.asarray(np.sqrt(np.repeat(variance, len(wanted))))
        middle = weight.cumsum() - 0.5 * weight
        return np.asarray(np.exp(np.interp(wanted, middle, 0.5 * np.log(variance))))

    def prediction(self) -> Prediction:
        """Return mean, spread, and prediction of a new run of a new member."""
        weight, mean, variance = self.all
        spread = self.between + self.within
        centre, error = Mixture.over_grid(weight, mean, np.sqrt(variance)).moments
        low, median, high = self.median(1, _TAILS).tolist()
        # with one more member of average information, at the median spread
        n = len(self.of_members[0])
        more = variance * n / (n + 1.0)
        total = 1.0 / (self.of_members[0].sum(axis=0) / n + self.prior) + variance
        at = int(np.argmin(np.abs(np.sqrt(self.between) - median)))
        log = np.log(np.maximum(weight, 1e-300))
        after = _normed(log - 0.5 * (np.log(total) + total[:, at : at + 1] / total))
        error_after = Mixture.over_grid(after, mean, np.sqrt(more)).moments[1]
        ends_after = Mixture.over_grid(after, mean, np.sqrt(more + spread)).ends
        return Prediction(
            mean=float(centre), std_error=float(error),
            spread=median, spread_ends=np.array([low, high]),
            mixture=Mixture.over_grid(weight, mean, np.sqrt(variance + spread)),
            after=(float(error_after), float(np.ptp(ends_after))),
            within=float(self.median(0)[0]) if len(self.within) > 1 else None,
        )  # fmt: skip

    def values(self) -> tuple[Array, Array]:
        """Return the parameter in each run and its standard error, shape (k,)."""
        weight, mean, variance = self.all
        mean, variance = _shrunk(self.sums[0], self.sums[1], self.between, mean, variance)
        mean, variance = mean[self.members], variance[self.members]
        W, w = self.W[:, None, None], self.w[:, None, None]
        mean, variance = _shrunk(W, w, self.within, mean, variance)
        return Mixture.over_grid(weight, mean, np.sqrt(variance)).moments

    def without(self, which: Array, *, is_member: bool, error: Array) -> Mixture:
        """Return the predictions of estimates by all runs except theirs: which, error (m,)."""
        total = self.of_members.sum(axis=1)[:, None]
        if is_member:
            left, spread = total - self.of_members[:, which], self.between
        else:
            member = self.members[which]
            rest = self.lifted(self.sums[:, member] - self.of_runs[:, which])
            left = total - self.of_members[:, member] + rest
            spread = self.between + self.within
        left[0] = np.maximum(left[0], 0.0)
        weight, mean, variance = self.mean(left)
        std = np.sqrt(variance + spread + error[:, None, None] ** 2)
        return Mixture.over_grid(weight, mean, std)


@dataclass(frozen=True, eq=False)
class SpreadModel:
    """The spread of each parameter of a group between runs, or between units."""

    runs: Runs

    @cached_property
    def centred(self) -> tuple[Array, list[_Grid]]:
        """The mean of all parameters, shape (q,), and each parameter about it."""
        runs, spread = self.runs, self.runs.scale
        for _ in range(_SWEEPS):
            H, h = lifted(runs.H, runs.h, np.diag(spread**2))
            information = H.sum(axis=0) + _prior_of(runs.scale)
            covariance = np.linalg.inv(information)
            centre = covariance @ h.sum(axis=0)
            more = np.diag(covariance) - 1.0 / np.diag(information)
            h = runs.h - runs.H @ centre
            grids = [
                _Grid.of(*_alone(runs.H, h, spread, p), runs.unit, float(scale), float(more[p]))
                for p, scale in enumerate(runs.scale)
            ]
            spread = np.array([np.hypot(grid.median(0), grid.median(1))[0] for grid in grids])
        return centre, grids

    @cached_property
    def deviation(self) -> Array:
        """Medians of the standard deviations of runs and units about the mean, shape (2, q)."""
        return np.array([[x.median(level)[0] for x in self.centred[1]] for level in (0, 1)])

    def predict(self) -> Iterator[Prediction]:
        """Yield the prediction of each parameter in a new run of a new unit."""
        for centre, grid in zip(*self.centred, strict=True):
            yield grid.prediction().shifted(float(centre))

    @cached_property
    def values(self) -> tuple[Array, Array]:
        """Parameters and standard errors by run, (k, q): own estimate and others by information."""
        centre, grids = self.centred
        values, errors = zip(*(grid.values() for grid in grids), strict=True)
        return centre + np.transpose(values), np.transpose(errors)

    def against_others(self, which: Array, *, is_unit: bool) -> Compared:
        """Compare runs, or units, each with the prediction of all others: which (m,)."""
        (centre, grids), H, h = self.centred, self.runs.H, self.runs.h
        if is_unit:
            H, h = lifted(H, h, np.diag(self.deviation[0] ** 2))
            H, h = (np.array([x[self.runs.unit == u].sum(axis=0) for u in which]) for x in (H, h))
        else:
            H, h = H[which], h[which]
        covariance = covariance_of(H, self.runs.scale)
        errors = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        others = [
            grid.without(which, is_member=is_unit, error=error)
            for grid, error in zip(grids, errors.T, strict=True)
        ]
        parts = ([x.weight, x.mean, x.std] for x in others)
        weight, mean, std = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
        mixture = Mixture(weight, mean + centre[:, None], std)
        return Compared(np.einsum("mpi,mi->mp", covariance, h), covariance, mixture)


def covariance_of(H: Array, scale: Array) -> Array:
    """Return the covariance of parameters (q,) from information (..., q, q), almost no prior."""
    return np.asarray(np.linalg.inv(H + _prior_of(scale)))


def _prior_of(scale: Array) -> Array:
    return np.diag((_UNKNOWN * scale) ** -2.0)


def lifted(H: Array, h: Array, D: Array) -> tuple[Array, Array]:
    """Return (H^-1 + D)^-1 and its product with x, of H and h = H x, for singular H, too."""
    G = np.linalg.inv(np.eye(len(D)) + H @ D)
    return G @ H, np.einsum("...ij,...j->...i", G, h)


def _alone(H: Array, h: Array, spread: Array, p: int) -> tuple[Array, Array]:
    """Return information and score of runs about one parameter, the others N(0, spread^2)."""
    others = np.arange(len(spread)) != p
    inverse = np.diag(np.maximum(spread[others], 1e-150) ** -2.0)
    G = np.linalg.solve(H[:, others][:, :, others] + inverse, H[:, others, p, None])[..., 0]
    W = H[:, p, p] - np.einsum("ko,ko->k", G, H[:, p, others])
    return np.maximum(W, 0.0), h[:, p] - np.einsum("ko,ko->k", G, h[:, others])


def _integrated(W: Array, w: Array, d: Array) -> Array:
    """Return information, score and log likelihood without a deviation of variance d."""
    t = 1.0 + d * W
    return np.array([W / t, w / t, 0.5 * (d * w**2 / t - np.log(t))])


def _shrunk(W: Array, w: Array, d: Array, mean: Array, variance: Array) -> tuple[Array, Array]:
    """Return mean and variance of values about a mean with deviations of variance d."""
    left = 1.0 / (1.0 + d * W)
    return mean + d * left * (w - W * mean), d * left + left**2 * variance


def _normed(log: Array) -> Array:
    """Return weights that sum to 1 over the last two axes, from the log of a density."""
    weight = np.exp(log - log.max(axis=(-2, -1), keepdims=True))
    return np.asarray(weight / weight.sum(axis=(-2, -1), keepdims=True))


def root_of(covariance: Array) -> Array:
    """Return L with L L^T = C, lower triangular, shape (p, p): covariance (p, p)."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
    w, V = np.linalg.eigh(inverse[:, None] * covariance * inverse)
    least = len(w) * np.finfo(float).eps * float(w.max(initial=0.0))  # rounding error
    w = np.where(w > max(least, 0.0), w, 0.0)
    R = np.linalg.qr((scale[:, None] * V * np.sqrt(w)).T, mode="r")
    sign = np.where(np.diag(R) < 0.0, -1.0, 1.0)
    return np.asarray(np.tril((sign[:, None] * R).T))


def possible_draws(
    root: Array, is_possible: Callable[[Array], Array], count: int, rng: np.random.Generator
) -> Array:
    """Return draws of x ~ N(0, L L^T), L (p, r), given that they are possible, shape (count, p).

    Each ends a chain of elliptical slice sampling from x = 0, which must be possible (Murray,
    Adams, MacKay, 2010, Elliptical slice sampling, figure 2).
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
    """Return sqrt(share) * scores + sqrt(1 - share) * w, w ~ N(0, R) of a run: (k, m) scores."""
    w = drawn @ np.linalg.cholesky(correlation).T
    return np.asarray(np.sqrt(share) * scores + np.sqrt(1.0 - share) * w)


def scores_to_values(z: Array, scores: Array, quantiles: Array, least: float) -> Array:
    """Return the values at scores z (k,) of quantiles (s,) at scores (s,), none below the least."""
    slope = np.diff(quantiles) / np.diff(scores)
    if least > quantiles[0]:
        below = scipy.special.ndtr(np.interp(least, quantiles, scores))
        z = scipy.special.ndtri(below + (1.0 - below) * scipy.special.ndtr(z))
    values = np.interp(z, scores, quantiles)
    values = values + slope[0] * np.minimum(z - scores[0], 0.0)
    values = values + slope[-1] * np.maximum(z - scores[-1], 0.0)
    return np.asarray(np.maximum(values, least))
