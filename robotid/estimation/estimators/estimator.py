"""The interface of estimators, their result, and standard errors from the scatter of segments."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, Literal, TypeAlias, TypeVar

import numpy as np
import scipy.special

from robotid.base.exceptions import DataError
from robotid.base.tolerances import ROUNDING
from robotid.base.typing import Array
from robotid.dynamics.factors import Factors, Problem, compress

DataT = TypeVar("DataT", contravariant=True)

#: Weights of rows: "alike", all equal; "by joint", by the noise level; "by age", of a filter with
#: forgetting or a gate; "by step", of a gradient method, which ends near the least squares minimum.
Weighing: TypeAlias = Literal["alike", "by joint", "by age", "by step"]

FEWEST_SEGMENTS = 12  # smallest number of segments for an estimate of the scatter
#: Segments of all logs together for it: few enough that each is longer than the time for which an
#: encoder stays at one step while a joint reverses.
SEGMENTS = 48
WEAK_PRIOR = 10.0  # factor on the typical or prior spread, with which a prior hardly has an effect
ALIKE = 2.0  # standard errors within which values are equal
LEAST_FREEDOM = 0.1  # smallest degrees of freedom of a noise level, as a share of the rows
MOST_EXPLAINED = 0.5  # largest share of a squared residual that an assumed error explains
_OWN = 0.95  # leverage above which a segment determines a direction alone, without scatter


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimated parameters and their uncertainty, in SI units."""

    theta: Array  # (c,)
    covariance: Array  # (c, c); infinite variance if not identifiable
    names: tuple[str, ...]
    sigma: Array  # (n,), standard deviation of the residual per joint [N m or N]
    rank: int  # number of identifiable directions
    condition: float  # over those directions, columns scaled to unit norm
    undetermined: tuple[str, ...]  # names of the parameters that are not identifiable
    converged: bool
    n_iter: int
    message: str  # summary of the run of the estimator
    prior_std: Array | None = None  # (c,)
    details: Mapping[str, Any] = field(default_factory=dict)  # plain values: prior, constraints

    def summary(self) -> str:
        """Return the parameters with their standard errors as text, one per line."""
        width = max(len(name) for name in self.names)
        rows = [
            f"  {name:{width}} {value:12.4g} +- {error:.2g}"
            for name, value, error in zip(self.names, self.theta, self.std_error, strict=True)
        ]
        state = "converged" if self.converged else "not converged"
        head = f"{len(self.names)} parameters, rank {self.rank}, condition {self.condition:.3g}"
        return "\n".join([f"Estimate: {head}, {state}", self.message, *rows])

    __str__ = summary

    def __repr__(self) -> str:
        return f"<{self.summary().splitlines()[0]}>"

    @property
    def std_error(self) -> Array:
        """Standard error of each parameter, shape (c,); inf if not identifiable."""
        # noise-free data give a variance of rounding size, of either sign
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def quantile(self) -> Array:
        """Half-width of 95 % intervals in standard errors, of details["freedom"] if given, (c,)."""
        freedom = self.details.get("freedom", np.inf)
        return quantile(np.broadcast_to(np.asarray(freedom, dtype=float), len(self.theta)))


class Estimator(ABC, Generic[DataT]):
    """Interface of estimators: settings are constructor arguments, data arguments of ``fit``."""

    reads: ClassVar[Literal["factors", "samples", "simulator"]]  # form of the data

    @property
    def weighing(self) -> Weighing:
        """Weights of the rows, which determine how standard errors follow from their scatter."""
        return "by joint"

    @abstractmethod
    def fit(self, data: DataT) -> Estimate:
        """Estimate the parameters from a problem in base parameters, its factors or a simulator.

        Raises:
            DataError: If there are fewer rows than parameters, or a row cannot be used.
            RankDeficientError: If parameters are not identifiable and there is no prior.
            NotConvergedError: If an iteration or a solver does not converge.
        """


class BatchEstimator(Estimator[Problem | Factors]):
    """An estimator that needs only the triangular factors of the rows."""

    reads: ClassVar[Literal["factors"]] = "factors"

    def fit(self, data: Problem | Factors) -> Estimate:
        factors = compress(data) if isinstance(data, Problem) else data
        require_rows(int(factors.rows.sum()), len(factors.names), len(factors.rows))
        return self._fit(factors)

    @abstractmethod
    def _fit(self, factors: Factors) -> Estimate:
        """Estimate the parameters from at least as many rows."""


def require_rows(rows: int, columns: int, n_joints: int) -> None:
    """Raise an error if there are fewer rows than parameters."""
    if rows == 0:
        raise DataError(
            f"0 torque rows for {columns} parameters: no joint moves faster than min_velocity, or "
            "trim removes all rows ([signals]); record a motion of every joint"
        )
    if rows < columns:
        raise DataError(
            f"{rows} torque rows for {columns} parameters: too few rows to fit; record at least "
            f"{-(-10 * columns // n_joints)} samples, or reduce min_velocity and trim"
        )


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of the scores of s segments; (W L)^T W L = Q diag(leverage) Q^T of weighted rows."""

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
        """Return each variance's degrees of freedom, (c,), at least 1; inf for that of a prior.

        Bell, McCaffrey (2002), Bias reduction in standard errors for linear regression with
        multi-stage samples, section 4.
        """
        along = self.axes.mT @ self.root.T  # (s, c, c): column l is that of parameter l
        weight = (self.leverage * self.gain)[..., None]
        squares = np.sum(weight * self.gain[..., None] * along**2, axis=1)  # (s, c)
        back = self.axes @ (weight * along)
        freedom: Array = np.full(len(self.bread), np.inf)
        for k in np.flatnonzero(squares.sum(axis=0) > ROUNDING * np.diag(self.bread)):
            # covariances of the segments' contributions to the parameter for independent noise
            Z = back[:, :, k]
            gram = np.diag(squares[:, k]) - Z @ Z.T
            total = float(np.trace(gram))
            is_of_one = total <= ROUNDING * float(squares[:, k].sum())  # of one segment alone
            freedom[k] = 1.0 if is_of_one else total**2 / float((gram**2).sum())
        return np.maximum(freedom, 1.0)


def scatter(segments: Sequence[Factors], theta: Array, sigma: Array, bread: Array) -> Scatter:
    """Return the scatter of the scores of segments: theta (c,), sigma (n,), bread (c, c).

    The covariance of a score is that of the noise, whatever its colour, if the segment is longer
    than the correlation time. The residual of a fitted segment is multiplied by (I -
    leverage)^-1/2, which is exact for independent rows (CR2). Directions that one segment alone
    determines have no scatter; the mean scatter of all others is used for them.
    """
    if len(segments) < FEWEST_SEGMENTS:
        raise DataError(
            f"{len(segments)} segments are too few to estimate the scatter of their scores, "
            f"expected at least {FEWEST_SEGMENTS}; fit longer logs"
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
        is_seen = leverage > ROUNDING
        corrected = along / np.where(is_seen, leverage, 1.0) * np.where(is_seen, gain - 1.0, 0.0)
        score = W.T @ (residual + B @ (Q @ corrected))
        meat += np.outer(score, score)
        is_own = gain**2 * share < 1.0 - ROUNDING
        missing = np.sqrt((1.0 - gain**2 * share)[is_own] / leverage[is_own]) * Q[:, is_own]
        missing = W.T @ (B @ missing)
        alone += missing @ missing.T
        axes[k], leverages[k], gains[k] = Q, leverage, gain
    inflation = along_squares / expected
    return Scatter(meat + inflation * alone, bread, inflation, root, axes, leverages, gains)


def _root(covariance: Array) -> Array:
    """Return L with L L^T = covariance, shape (c, c); variances may be 0."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))  # rounding of a variance of 0
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
