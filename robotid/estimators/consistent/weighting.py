"""Decisions by held-out segments of the fitted data: the prior's weight, and bodies' extents."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robotid._typing import Array
from robotid.estimators.consistent.cones import ConeSolution
from robotid.estimators.consistent.fit import Consistent
from robotid.estimators.consistent.penalties import WeightChoice
from robotid.exceptions import DataError, NotConvergedError
from robotid.regressor.factors import Factors, merge
from robotid.regressor.lapack import Triangle

__all__ = ["Segments", "choose_weight", "contradicted_extents", "held_out_errors", "log_evidence"]

_LIGHTEST, _HEAVIEST = -4.0, 2.0  # decades of the weights tried
_LIGHTEST_ENTROPIC = -1.0  # below, bodies become thin, and fits take long
_PATIENCE = 2  # decades without a better score that end the search
_ALIKE = 2.0  # standard errors by which the mean log error of a larger weight may be above the best
_MOST_LOSS = 1.02  # ratio of held-out errors that a larger weight may cost, mean over joints
_MOST_JOINT_LOSS = 1.05  # ... and at any one joint
_BEYOND = 4.0  # standard errors by which a body must leave its box
_CLEAR = 0.02  # share of the mean square by which an extent must be worse, to be left out
_STEP = 0.5  # decades by which the best one is refined


@dataclass(frozen=True, eq=False)
class Segments:
    """Contiguous segments of the fitted data, each held out of fits in turn.

    Attributes:
        kept: Their factors, K of them.
        sigma: Noise level per joint, shape (n,) [N m or N].
        rows: Information of all of them, shape (b + 1, b + 1), as of ``Consistent.rows``.
        share: Share of the rows that count as independent [-].
    """

    kept: tuple[Factors, ...]
    sigma: Array
    rows: Array
    share: float

    @classmethod
    def of(
        cls, fit: Consistent, segments: Sequence[Factors], sigma: Array | None = None
    ) -> "Segments":
        """Return segments with the noise level that a fit to all of them shows.

        Args:
            fit: The fit, whose constraints do not matter.
            segments: Factors of contiguous segments of the fitted data.
            sigma: The noise level, if it is known.
        """
        whole = merge(segments)
        level = fit.noise(whole) if sigma is None else sigma
        return cls(tuple(segments), level, fit.rows(whole, level), fit.independent_share)

    @cached_property
    def others(self) -> Array:
        """Information of all segments but one, shape (K, b + 1, b + 1)."""
        own = [factors.weighted(self.sigma / np.sqrt(self.share)) for factors in self.kept]
        rest = [Triangle(len(self.rows)) for _ in own]
        for k, total in enumerate(rest):
            for R in (*own[:k], *own[k + 1 :]):
                total.fold_triangle(R, np.arange(len(R)))
        return np.array([total.R for total in rest])


def choose_weight(fit: Consistent, segments: Segments, how: str) -> WeightChoice:
    """Return the weight of the prior that the fitted data speak for.

    * "cv": the largest weight that predicts held-out segments as well as the best one. The error of
      a joint is the RMS over all segments, that of a weight the geometric mean over joints. A
      larger weight is accepted if its error is at most 2 % above the smallest one, at most 5 % at
      any joint, and the mean log ratio of the errors by segment at most two standard errors
      above 0. The test alone would not do: of six segments, one or two bad ones do not reject.
    * "evidence": the weight with the largest ``log_evidence``.

    Weights are tried from 100 down to 1e-4 (entropic: 0.1) at most, by decades until two in a
    row are worse than those before, then around the best one. A weight beyond 1 keeps parameters
    near the prior, but not their standard errors narrow; see ``Consistent.pull``. One at which the
    fit does not converge, as bodies shrink to points, counts as infinitely bad.

    Args:
        fit: The fit, whose own weight does not matter.
        segments: The fitted data.
        how: "cv" or "evidence".

    Raises:
        DataError: If "cv" has fewer than two segments.
        NotConvergedError: If the fit does not converge at the heaviest weight.
    """
    lightest = _LIGHTEST if fit.penalty.is_quadratic else _LIGHTEST_ENTROPIC
    evidence = log_evidence(fit, segments.rows)
    by_evidence = _search(lambda w: (-evidence(w), np.zeros(0)), "evidence", lightest)
    if how == "evidence":
        return by_evidence

    starts = None  # the fits at the weight before

    def score(weight: float) -> tuple[float, Array]:
        nonlocal starts
        try:
            errors, starts = held_out_errors(fit, segments, weight, starts)
        except NotConvergedError:
            if starts is None:
                raise
            return float("inf"), np.full((len(segments.kept), len(segments.sigma)), np.inf)
        return float(np.exp(0.5 * np.log(_by_joint(errors)).mean())), errors

    return replace(_search(score, how, lightest), plausible=by_evidence.plausible)


def contradicted_extents(fit: Consistent, segments: Segments) -> tuple[str, ...]:
    """Return the bodies whose mass the data put outside the box that should hold it.

    They are those that a fit without extents, at a weight of 1, puts outside by more than four
    standard errors; if it also predicts held-out segments better than the fit with extents, by
    more than two standard errors and 2 % of the mean square.

    Args:
        fit: The fit, whose own weight does not matter.
        segments: The fitted data; one segment cannot be held out.
    """
    cone, rows, count = fit.programme.cone.linear, segments.rows, len(segments.kept)
    free = replace(fit, constraints=fit.constraints.without_extent(fit.constraints.extent))
    try:
        solution = free.programme.minimise(rows, 1.0, is_exact=False)
    except NotConvergedError:  # bodies run away: that contradicts no extent
        return ()
    G, covariance = cone.G / fit.prior_std, free.programme.covariance(1.0, rows, solution.x)
    error = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", G, covariance, G), 0.0))
    beyond = G @ solution.x + cone.h < -_BEYOND * error
    outside = [label for label, is_out in zip(cone.labels, beyond, strict=True) if is_out]
    bodies = tuple(body for body in fit.layout.bodies if f"extent {body}" in outside)
    if not bodies or count < 2:
        return bodies
    try:
        unbound = held_out_errors(free, segments, 1.0, [solution] * count)[0].sum(axis=1)
    except NotConvergedError:
        return ()
    try:
        bound = held_out_errors(fit, segments, 1.0)[0].sum(axis=1)
    except NotConvergedError:  # data without noise cannot be fitted at all
        return bodies
    is_clear = bound.sum() > (1.0 + _CLEAR) * unbound.sum() and not _is_as_good(bound, unbound)
    return bodies if is_clear else ()


def held_out_errors(
    fit: Consistent,
    segments: Segments,
    weight: float,
    starts: Sequence[ConeSolution] | None = None,
) -> tuple[Array, list[ConeSolution]]:
    """Return how well each segment is predicted by the fit to all others, constraints included.

    Args:
        fit: The fit, whose own weight does not matter.
        segments: The fitted data, at least two segments.
        weight: Weight of the prior.
        starts: Fits to start from, one without each segment.

    Returns:
        Sum of squares of the prediction errors by segment and joint, over the joint's noise level
        and its number of rows in all segments, shape (segments, n) [-]: the sum over segments is
        the mean square of each joint; and the fits, to start others.

    Raises:
        DataError: If there are fewer than two segments.
        NotConvergedError: If a fit does not converge.
    """
    if len(segments.kept) < 2:
        raise DataError(
            f"the prior's weight cannot be chosen from {len(segments.kept)} segment; fit longer "
            "logs, or use prior_weight = 'evidence'"
        )
    fits = fit.programme.minimise_each(segments.others, weight, is_exact=False, starts=starts)
    pairs = zip(segments.kept, fits, strict=True)
    squares = [kept.residual_squares(fit.K @ x.x) / segments.sigma**2 for kept, x in pairs]
    rows = np.sum([kept.rows for kept in segments.kept], axis=0)  # (n,)
    return np.array(squares) / np.maximum(rows, 1), fits


def log_evidence(fit: Consistent, rows: Array) -> Callable[[float], float]:
    """Return the log marginal likelihood of the data by the prior's weight, but for a constant.

    With x = L (pi - centre) ~ N(0, 1 / weight) before the data and r = A x + noise of unit
    variance, r ~ N(0, I + A A^T / weight). A penalty that is not quadratic is expanded at its
    centre; the inequalities are left out.

    Args:
        fit: The fit, whose own weight does not matter.
        rows: Information, shape (k, b + 1), as of ``Consistent.rows``.

    Returns:
        The function of the weight [-].

    References:
        MacKay (1992), Bayesian interpolation, section 4.
    """
    A, r = fit.programme.whitened(rows)
    U, s, _ = np.linalg.svd(A, full_matrices=False)
    along = U.T @ r

    def likelihood(weight: float) -> float:
        spread = 1.0 + s**2 / weight
        # |r|^2 outside the range of A is constant
        return float(-0.5 * ((along**2 / spread).sum() + np.log(spread).sum()))

    return likelihood


def _search(
    score: Callable[[float], tuple[float, Array]], how: str, lightest: float
) -> WeightChoice:
    """Return the weight with the smallest score, from 100 down by decades until it only grows.

    Beside the score come its parts by segment and joint, or none; the largest weight is chosen
    that ``_is_accepted`` beside the best one.
    """
    tried: dict[float, float] = {}
    parts: dict[float, Array] = {}

    def attempt(decade: float) -> None:
        tried[decade], parts[decade] = score(10.0**decade)

    decade = _HEAVIEST
    while decade >= lightest and _is_promising(tried):
        attempt(decade)
        decade -= 1.0
    best = min(tried, key=lambda k: tried[k])
    for k in (best - _STEP, best + _STEP):
        if lightest <= k <= _HEAVIEST and np.isfinite(tried.get(k - _STEP, 0.0)):
            attempt(k)
    best = min(tried, key=lambda k: tried[k])
    alike = [k for k in tried if np.isfinite(tried[k]) and _is_accepted(parts[k], parts[best])]
    curve = tuple((float(10.0**k), tried[k]) for k in sorted(tried) if np.isfinite(tried[k]))
    return WeightChoice(float(10.0 ** max([best, *alike])), how, curve, float(10.0**best))


def _is_accepted(parts: Array, best: Array) -> bool:
    """Return whether errors are as good as the best ones, each of shape (segments, n)."""
    if not parts.size:
        return False
    ratio = np.sqrt(_by_joint(parts) / _by_joint(best))  # (n,)
    if np.exp(np.log(ratio).mean()) > _MOST_LOSS or ratio.max() > _MOST_JOINT_LOSS:
        return False
    both = (parts > 0) & (best > 0)  # a joint at rest has no rows in a segment
    logs = 0.5 * np.log(np.where(both, parts, 1.0) / np.where(both, best, 1.0))
    excess = logs.sum(axis=1) / np.maximum(both.sum(axis=1), 1)  # (segments,)
    return bool(excess.mean() <= _ALIKE * excess.std(ddof=1) / np.sqrt(len(excess)))


def _by_joint(parts: Array) -> Array:
    """Return the mean squares of the joints that have rows, shape (n,), of errors by segment."""
    squares: Array = parts.sum(axis=0)
    return squares[squares > 0]


def _is_as_good(parts: Array, best: Array) -> bool:
    """Return whether a sum of parts is within two standard errors of the best one, pair by pair."""
    excess = parts - best
    if not len(excess):
        return False
    error = np.sqrt(len(excess)) * excess.std(ddof=1)
    return bool(excess.sum() <= _ALIKE * error)


def _is_promising(tried: dict[float, float]) -> bool:
    """Return whether one of the last two weights had the smallest score."""
    scores = list(tried.values())
    if scores and not np.isfinite(scores[-1]):
        return False
    return len(scores) <= _PATIENCE or min(scores[-_PATIENCE:]) < min(scores[:-_PATIENCE])
