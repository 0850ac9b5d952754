"""Mixed-effects model of parameters that vary between runs, and between units (robots).

    x_run = mu + u_unit + u_run + e_run,    u_unit ~ N(0, D_unit),  u_run ~ N(0, D_run),

with diagonal D. A linear effect of the temperature or the time of a run is a part of mu: a slope is
a parameter without a deviation, see ``Slope``. A run gives the information H about its own x and
the product h = H x_hat, so runs in which a parameter had no effect (singular H) need no special
case. Deviations are integrated out level by level. The restricted likelihood of the standard
deviations in D is weighted by a wide prior about a plausible size. The standard deviation that a
prediction depends on is integrated numerically: with few runs, its uncertainty is the largest part
of the prediction interval.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.optimize
import scipy.special

from robotid._typing import Array

__all__ = ["UNKNOWN", "MixedEffects", "Prediction", "Runs", "Slope"]

#: Standard deviation of a parameter before the data, in plausible sizes.
UNKNOWN = 100.0

_FREEDOM = 4.0  # degrees of freedom of the half Student prior of a standard deviation
_LEAST, _MOST = -6.0, 5.0  # logarithm of the standard deviations over their plausible size
_GRID = np.linspace(_LEAST, _MOST, 45)
_FIRST = -1.0  # the same at the start of the search
_NONE = -12.0  # ... of a slope, which has no deviation
_NEAR = 2.0  # ... and largest distance of a stated start: the gradient is small beyond
_STEP = 1e-5  # of the numerical gradient
_TAIL = 0.025  # probability beyond each end of an interval
_WIDEST = 40.0  # standard deviations that contain every end


@dataclass(frozen=True, eq=False)
class Slope:
    """A linear effect of a covariate of the runs, as their temperature, on a parameter.

    Attributes:
        parameter: Index of the parameter.
        covariate: The covariate of each run, shape (k,).
        scale: Plausible size of the slope, positive.
    """

    parameter: int
    covariate: Array
    scale: float


@dataclass(frozen=True, eq=False)
class Runs:
    """Information of k runs about q parameters that may vary.

    Attributes:
        H: Information (inverse covariance) of each run, shape (k, q, q), symmetric; singular if
            the run does not determine all.
        h: H times the estimate of each run, shape (k, q).
        unit: Index of the unit (robot) of each run, shape (k,), int, from 0.
        scale: Plausible standard deviation of each parameter, shape (q,), positive.
        slopes: The last of the q parameters that are slopes. The others are those at the covariates
            0. With x = Z (x_0, slopes), H is Z^T H Z.
    """

    H: Array
    h: Array
    unit: Array
    scale: Array
    slopes: tuple[Slope, ...] = ()

    @property
    def n_varying(self) -> int:
        """Number of parameters that are not slopes."""
        return len(self.scale) - len(self.slopes)

    def with_slopes(self, slopes: Sequence[Slope]) -> "Runs":
        """Return the same runs with other slopes.

        Args:
            slopes: The slopes, in place of the present ones.
        """
        n = self.n_varying
        Z = np.zeros((len(self.h), n, n + len(slopes)))
        Z[:, range(n), range(n)] = 1.0
        for s, slope in enumerate(slopes, start=n):
            Z[:, slope.parameter, s] = slope.covariate
        return replace(
            self,
            H=np.einsum("kia,kij,kjb->kab", Z, self.H[:, :n, :n], Z, optimize=True),
            h=np.einsum("kia,ki->ka", Z, self.h[:, :n]),
            scale=np.concatenate([self.scale[:n], [slope.scale for slope in slopes]]),
            slopes=tuple(slopes),
        )

    def seen_from(self, covariates: Sequence[float]) -> "Runs":
        """Return the runs with their parameters at other covariates than 0.

        Args:
            covariates: The covariate of each slope.
        """
        if not self.slopes:
            return self
        moved = [
            replace(slope, covariate=slope.covariate - at)
            for slope, at in zip(self.slopes, covariates, strict=True)
        ]
        return self.with_slopes(moved)

    def without(self, run: int) -> "Runs":
        """Return the runs except one.

        Args:
            run: Index of the run.
        """
        return self._only(np.arange(len(self.h)) != run)

    def without_unit(self, unit: int) -> "Runs":
        """Return the runs of the other units.

        Args:
            unit: Index of the unit.
        """
        return self._only(self.unit != unit)

    def of_unit(self, unit: int) -> "Runs":
        """Return the runs of one unit.

        Args:
            unit: Index of the unit.
        """
        return self._only(self.unit == unit)

    def _only(self, left: Array) -> "Runs":
        _, unit = np.unique(self.unit[left], return_inverse=True)
        slopes = tuple(replace(s, covariate=s.covariate[left]) for s in self.slopes)
        return replace(self, H=self.H[left], h=self.h[left], unit=unit, slopes=slopes)


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
        """Return the prediction of the parameter plus a constant.

        Args:
            centre: The constant.
        """
        moved = self.mixture + np.array([[0.0], [centre], [0.0]])
        return replace(self, mean=self.mean + centre, ends=self.ends + centre, mixture=moved)

    def quantiles(self, scores: Array) -> Array:
        """Return quantiles of the predictive distribution.

        Args:
            scores: Standard normal scores of their probabilities, shape (k,): 1.96 for 97.5 %.

        Returns:
            The quantiles, shape (k,).
        """
        wanted = scipy.special.ndtr(scores)
        return np.array([_mixture_quantile(p, *self.mixture) for p in wanted])


@dataclass(frozen=True, eq=False)
class MixedEffects:
    """The mixed-effects model of runs: of one unit, or of several.

    Attributes:
        runs: The runs.
        first: Deviations at the start of their search, shape (levels or more, q); None: typical.

    References:
        Patterson, Thompson (1971), Recovery of inter-block information when block sizes are
        unequal (restricted likelihood). Gelman (2006), Prior distributions for variance parameters
        in hierarchical models, section 2.2 (half Student prior).
    """

    runs: Runs
    first: Array | None = None

    @property
    def n_levels(self) -> int:
        """2 if there are several units, 1 otherwise."""
        return 2 if self.runs.unit.max() > 0 else 1

    @cached_property
    def deviation(self) -> Array:
        """Most probable standard deviations, shape (levels, q): between runs, between units."""
        size = self.n_levels * len(self.runs.scale)

        def objective(z: Array) -> tuple[float, Array]:
            tried = np.concatenate([z[None], z + _STEP * np.eye(size)])
            values = _log_prior(tried).sum(axis=1) + self._likelihood(self._deviation(tried))[0]
            return -values[0], -(values[1:] - values[0]) / _STEP

        first = np.full(size, _FIRST)
        if self.first is not None:
            first = np.log(self.first[: self.n_levels] / self.runs.scale).ravel()
            first = np.clip(first, _FIRST - _NEAR, _FIRST + _NEAR)
        is_slope = np.tile(np.arange(len(self.runs.scale)) >= self.runs.n_varying, self.n_levels)
        first[is_slope] = _NONE
        bounds = [(_NONE, _NONE) if own else (_LEAST, _MOST) for own in is_slope]
        found = scipy.optimize.minimize(
            objective, first, jac=True, method="L-BFGS-B", bounds=bounds
        )
        return self._deviation(found.x)

    @cached_property
    def values(self) -> tuple[Array, Array]:
        """Parameters in each run and their standard errors, shapes (k, q).

        They are means of the run's own estimate and those of its unit and of all units, weighted by
        their information (best linear unbiased prediction).
        """
        runs, deviation = self.runs, self.deviation
        _, mean, covariance = self._likelihood(deviation)
        W, w, U, _ = _integrated(runs.H, runs.h, deviation[0])
        centre, around = np.tile(mean, (len(runs.h), 1)), covariance
        if self.n_levels == 2:
            W, w = self._by_unit(W, w)
            between = _integrated(W, w, deviation[1])[2]
            means, around = _predicted(between, W, w, centre[: len(w)], covariance)
            centre, around = means[runs.unit], around[runs.unit]
        values, errors = _predicted(U, runs.H, runs.h, centre, around)
        return values, np.sqrt(np.einsum("kpp->kp", errors))

    def estimate_unit(self, runs: Runs) -> tuple[Array, Array]:
        """Return the mean of another unit from its runs alone, and its covariance.

        Its runs vary as those of these units.

        Args:
            runs: The runs of the other unit.

        Returns:
            Shapes (q,) and (q, q).
        """
        W, w, _, _ = _integrated(runs.H, runs.h, self.deviation[0])
        covariance = np.linalg.inv(W.sum(axis=0) + np.diag((UNKNOWN * runs.scale) ** -2.0))
        return covariance @ w.sum(axis=0), covariance

    def predict(
        self,
        own: Array | None = None,
        value: Array | None = None,
        *,
        is_unit: bool = False,
        at: Sequence[float] = (),
    ) -> tuple[Prediction, ...]:
        """Return the prediction of each parameter but slopes in a new run of a new unit.

        With one unit it is that of a new run. The standard deviation of the highest level is
        integrated, parameter by parameter; all others have their most probable values.

        Args:
            own: Variance of the estimates of the new run, of these parameters; 0 if None.
            value: Estimates of the new run, whose probability is computed; or None.
            is_unit: Whether the mean of a new unit is predicted, without a deviation of its run.
            at: The covariate of each slope in the new run; 0 if empty.
        """
        q, levels = self.runs.n_varying, slice(1 if is_unit else 0, None)
        own = np.zeros(q) if own is None else own
        found = []
        for p in range(q):
            tried, log_density, centres, variance, _ = self._on_grid(p, at)
            weight = _weight(log_density)
            mean, error = _moments(weight, centres, variance)
            between = (tried[:, levels, p] ** 2).sum(axis=1) + own[p]
            std = np.sqrt(variance + between)
            probability = 1.0
            if value is not None:
                below = _mixture(value[p], weight, centres, std)
                probability = 2.0 * min(below, _mixture(-value[p], weight, -centres, std))
            wanted = (_TAIL, 0.5, 1.0 - _TAIL)
            low, median, high = self.runs.scale[p] * np.exp(
                np.interp(wanted, weight.cumsum() - 0.5 * weight, _GRID)
            )
            ends = _mixture_ends(weight, centres, std)
            spread_ends = np.array([low, high])
            found.append(
                Prediction(
                    mean, error, median, spread_ends, ends, min(probability, 1.0),
                    np.array([weight, centres, std]),
                )
            )  # fmt: skip
        return tuple(found)

    def with_one_more(self) -> tuple[Prediction, ...]:
        """Return the prediction of each parameter but slopes, with what one more run would add.

        With several units it is one more unit. The new run or unit is expected to give as much
        information as the mean of the others. The information about the mean then increases by
        1 / k. The expected log likelihood of the new value, at the median of the spread, is added
        to the density of the spread.
        """
        found = []
        for p, each in enumerate(self.predict()):
            tried, log_density, centres, variance, alone = self._on_grid(p)
            total = alone + variance  # of the estimate of a new member about the mean
            expected = float(np.interp(each.spread, tried[:, -1, p], total))
            weight = _weight(log_density - 0.5 * (np.log(total) + expected / total))
            more = variance * self.n_members / (self.n_members + 1.0)
            _, error = _moments(weight, centres, more)
            std = np.sqrt(more + (tried[:, :, p] ** 2).sum(axis=1))
            width = float(np.ptp(_mixture_ends(weight, centres, std)))
            found.append(replace(each, after=(error, width)))
        return tuple(found)

    @property
    def n_members(self) -> int:
        """Number of units if there are several, of runs otherwise."""
        return int(self.runs.unit.max()) + 1 if self.n_levels == 2 else len(self.runs.h)

    def _on_grid(
        self, p: int, at: Sequence[float] = ()
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Return the model for standard deviations of parameter p at the highest level.

        The parameter is that at the covariates ``at`` of its slopes; 0 if empty.

        Returns:
            Standard deviations (g, levels, q); logarithm of their density, mean of the parameter,
            variance of the mean, and variance of the estimate of a typical member about its mean,
            each of shape (g,).
        """
        tried, log_density, means, covariances = self._tried(p)
        prior = np.diag((UNKNOWN * self.runs.scale) ** -2.0)
        members = (np.linalg.inv(covariances) - prior) / self.n_members
        alone = np.linalg.inv(members + prior)[:, p, p]
        a = 1.0 * (np.arange(len(prior)) == p)
        for s, (slope, c) in enumerate(zip(self.runs.slopes, at, strict=False)):
            a[self.runs.n_varying + s] = c * (slope.parameter == p)
        return tried, log_density, means @ a, np.einsum("i,gij,j->g", a, covariances, a), alone

    def slope(self, s: int) -> tuple[float, float, float]:
        """Return a slope, its standard error, and the two-sided p-value of a slope of 0.

        The standard deviation of its parameter is integrated between runs if its covariate varies
        most within units, else between units.

        Args:
            s: Index of the slope.
        """
        own, slope, unit = self.runs.n_varying + s, self.runs.slopes[s], self.runs.unit
        means_of = np.bincount(unit, slope.covariate) / np.bincount(unit)
        is_within = float(np.var(slope.covariate - means_of[unit])) > float(np.var(means_of[unit]))
        level = 0 if is_within else -1
        _, log_density, means, covariances = self._tried(slope.parameter, level)
        weight = _weight(log_density)
        mean, error = _moments(weight, means[:, own], covariances[:, own, own])
        below = _mixture(0.0, weight, means[:, own], np.sqrt(covariances[:, own, own]))
        return mean, error, 2.0 * min(below, 1.0 - below)

    def _tried(self, p: int, level: int = -1) -> tuple[Array, Array, Array, Array]:
        """Return the model for standard deviations of parameter p at a level.

        Returns:
            Standard deviations (g, levels, q), logarithm of their density (g,), means (g, q) and
            their covariances (g, q, q).
        """
        tried = np.repeat(self.deviation[None], len(_GRID), axis=0)
        tried[:, level, p] = self.runs.scale[p] * np.exp(_GRID)
        log_likelihood, means, covariances = self._likelihood(tried)
        return tried, log_likelihood + _log_prior(_GRID), means, covariances

    def _deviation(self, z: Array) -> Array:
        """Return standard deviations, shape (..., levels, q), from logarithms over the scale."""
        deviation: Array = self.runs.scale * np.exp(z.reshape(*z.shape[:-1], self.n_levels, -1))
        return deviation

    def _likelihood(self, deviation: Array) -> tuple[Array, Array, Array]:
        """Return the log restricted likelihood (...,), mean (..., q) and its covariance."""
        W, w, _, total = _integrated(self.runs.H, self.runs.h, deviation[..., 0, :])
        if self.n_levels == 2:
            W, w = self._by_unit(W, w)
            W, w, _, more = _integrated(W, w, deviation[..., 1, :])
            total = total + more
        information = W.sum(axis=-3) + np.diag((UNKNOWN * self.runs.scale) ** -2.0)
        score, covariance = w.sum(axis=-2), np.linalg.inv(information)
        mean = np.einsum("...pi,...i->...p", covariance, score)
        quadratic = np.einsum("...p,...p->...", score, mean)
        return total + 0.5 * (quadratic - np.linalg.slogdet(information)[1]), mean, covariance

    def _by_unit(self, W: Array, w: Array) -> tuple[Array, Array]:
        """Return the sums of the information W and W x over the runs of each unit."""
        unit = self.runs.unit
        member = 1.0 * (np.arange(unit.max() + 1)[:, None] == unit)
        return np.einsum("uk,...kij->...uij", member, W), np.einsum("uk,...ki->...ui", member, w)


def _integrated(H: Array, h: Array, deviation: Array) -> tuple[Array, Array, Array, Array]:
    """Integrate the deviations of one level out of its members' information.

    W = (H^-1 + D)^-1 = H - H U H = S^-1 G^-1 S H with U = S G^-1 S, G = I + S H S and D = S^2.

    Args:
        H: Information of the members, shape (..., k, q, q).
        h: Information times estimate, shape (..., k, q).
        deviation: Standard deviations S, shape (..., q).

    Returns:
        W (..., k, q, q), W x (..., k, q), U (..., k, q, q) with the deviation U (h - H mu), and the
        logarithm of the likelihood, shape (...,), without the part that depends on the mean.
    """
    S = deviation[..., None, :]
    G = np.eye(S.shape[-1]) + S[..., :, None] * H * S[..., None, :]
    inverse = np.linalg.inv(G)
    U = S[..., :, None] * inverse * S[..., None, :]
    # 1 - H U = S^-1 G^-1 S: the difference itself would be rounding where H is large
    left = inverse / S[..., :, None] * S[..., None, :]
    W = left @ H
    quadratic = np.einsum("...ki,...kij,...kj->...", h, U, h, optimize=True)
    log_det = np.linalg.slogdet(G)[1].sum(axis=-1)
    w = np.einsum("...pi,...i->...p", left, h)
    return 0.5 * (W + np.swapaxes(W, -1, -2)), w, U, 0.5 * (quadratic - log_det)


def _predicted(
    U: Array, H: Array, h: Array, centre: Array, covariance: Array
) -> tuple[Array, Array]:
    """Return the values of the members of a level, shape (k, q), and their errors' covariance.

    Args:
        U: As of ``_integrated``, shape (k, q, q).
        H: Information of the members, shape (k, q, q).
        h: Information times estimate, shape (k, q).
        centre: Mean of each member before its own information, shape (k, q).
        covariance: Its covariance, shape (k, q, q) or (q, q).
    """
    left = np.eye(h.shape[1]) - U @ H
    values = centre + np.einsum("kpi,ki->kp", U, h - np.einsum("kpi,ki->kp", H, centre))
    return values, U + left @ covariance @ np.swapaxes(left, 1, 2)


def _log_prior(z: Array) -> Array:
    """Return the log density of z = log(deviation / scale), half Student's distribution."""
    log_density: Array = z - 0.5 * (_FREEDOM + 1.0) * np.log1p(np.exp(2.0 * z) / _FREEDOM)
    return log_density


def _mixture(x: float, weight: Array, means: Array, std: Array) -> float:
    """Return the probability of values below x in a mixture of normal distributions."""
    return float(weight @ scipy.special.ndtr((x - means) / std))


def _mixture_quantile(probability: float, weight: Array, means: Array, std: Array) -> float:
    """Return the value with a probability of smaller values in a mixture of normals."""
    middle, widest = float(weight @ means), _WIDEST * float(std.max())
    found: float = scipy.optimize.brentq(
        lambda x: _mixture(x, weight, means, std) - probability, middle - widest, middle + widest
    )
    return found


def _mixture_ends(weight: Array, means: Array, std: Array) -> Array:
    """Return the ends of the 95 % interval of a mixture of normal distributions, shape (2,)."""
    ends = [_mixture_quantile(p, weight, means, std) for p in (_TAIL, 1.0 - _TAIL)]
    return np.array(ends)


def _weight(log_density: Array) -> Array:
    """Return weights that sum to 1, shape (g,), from the logarithm of a density."""
    weight = np.exp(log_density - log_density.max())
    normed: Array = weight / weight.sum()
    return normed


def _moments(weight: Array, centres: Array, variance: Array) -> tuple[float, float]:
    """Return the mean of a mixture, and its standard deviation."""
    mean = float(weight @ centres)
    return mean, float(np.sqrt(weight @ (variance + (centres - mean) ** 2)))
