"""Cross-validation on segments of the fitted data: weight of the prior, extents of bodies."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robotid.base.exceptions import DataError, NotConvergedError
from robotid.base.typing import Array
from robotid.dynamics.factors import Factors, Triangle, merge
from robotid.estimation.estimators.consistent_fit import Consistent, WeightChoice
from robotid.estimation.estimators.estimator import ALIKE, MOST_EXPLAINED
from robotid.estimation.estimators.interior_point import Minimum

_SMALLEST, _LARGEST = -4.0, 2.0  # decades of the weights tried
_USUAL = -1.0  # at smaller entropic weights bodies become thin, and fits converge slowly
_PATIENCE = 2  # decades without a better score after which the search ends
_MOST_LOSS = 1.02  # largest ratio of the held-out errors of a larger weight, mean over joints
_MOST_JOINT_LOSS = 1.05  # ... and of any one joint
#: Largest ratio of the held-out error of a joint to that of least squares.
AS_GOOD = 1.1
_BEYOND = 4.0  # standard errors by which a body must be outside its box
_REESTIMATED = 8  # largest number of steps of the plausible weight
_EXPECTED = (0.5, 1.02)  # distances from the prior over the expected one at which they end
_STEP = 0.5  # decades between the best weight and the refined ones


@dataclass(frozen=True, eq=False)
class Segments:
    """Contiguous segments of the fitted data: the folds of a cross-validation."""

    folds: tuple[Factors, ...]
    sigma: Array  # (n,), noise level per joint [N m or N]
    rows: Array  # (b + 1, b + 1), rows of all segments, from ``Consistent.rows``
    share: float  # of independent rows [-]

    @classmethod
    def of(cls, fit: Consistent, segments: Sequence[Factors]) -> "Segments":
        """Return segments with the noise level of a fit to all of them."""
        factors = merge(segments)
        sigma = fit.noise(factors)
        return cls(tuple(segments), sigma, fit.rows(factors, sigma), fit.independent_share)

    @cached_property
    def others(self) -> Array:
        """Rows of all segments except one, for each segment, shape (K, b + 1, b + 1)."""
        triangles = [factors.weighted(self.sigma / np.sqrt(self.share)) for factors in self.folds]
        totals = [Triangle(len(self.rows)) for _ in triangles]
        for k, total in enumerate(totals):
            for R in (*triangles[:k], *triangles[k + 1 :]):
                total.fold_triangle(R, np.arange(len(R)))
        return np.array([total.R for total in totals])

    @cached_property
    def least_squares_errors(self) -> Array:
        """Prediction errors of each segment by least squares of all others, (segments, n)."""
        errors = []
        for fold, rows in zip(self.folds, self.others, strict=True):
            size = np.maximum(np.linalg.norm(rows[:, :-1], axis=0), 1e-300)
            scaled = np.linalg.lstsq(rows[:, :-1] / size, rows[:, -1], rcond=1e-7)[0]
            errors.append(fold.residual_squares(scaled / size))
        return self.errors(np.array(errors))

    def errors(self, squares: Array) -> Array:
        """Return squared errors (segments, n) over the squared noise level and number of rows."""
        squares = squares / self.sigma**2
        rows = np.sum([fold.rows for fold in self.folds], axis=0)  # (n,)
        if self.folds[0].is_projected:
            squares, rows = squares.sum(axis=1, keepdims=True), rows.sum(keepdims=True)
        return np.asarray(squares / np.maximum(rows, 1))


def choose_weight(
    fit: Consistent, segments: Segments, how: str, repeated: float = 0.0
) -> WeightChoice:
    """Return the weight of the prior, chosen from the fitted data.

    * "cv": the largest weight with the same prediction error on held-out segments as the best one,
      see ``_is_accepted``. A repeated error has no scatter between segments, and a smaller weight
      that only fits it is not better. The error of no joint may be more than 10 % above that of
      least squares: where the prior is wrong, as of a placeholder, the weight is smaller.
    * "evidence": the weight with the largest ``log_evidence``.

    Weights are tried from 100 down to 0.1, and to 1e-4 where least squares is better, in decades,
    until two weights in a row are worse than those before, and then around the best one. A weight
    at which the fit does not converge, because bodies shrink to points, has an infinite error.
    """
    evidence = log_evidence(fit, segments.rows)
    by_evidence = _search(lambda w: (-evidence(w), np.zeros(0)), "evidence", 0.0)
    plausible = plausible_weight(fit, segments.rows, by_evidence.plausible)
    if how == "evidence":
        return replace(by_evidence, plausible=plausible)

    fits: dict[float, list[Minimum]] = {}  # by weight, one without each segment
    least = np.sqrt(_by_joint(segments.least_squares_errors))  # (n,)

    def score(weight: float) -> tuple[float, Array]:
        starts = next(reversed(fits.values()), None)
        try:
            errors, fits[weight] = held_out_errors(fit, segments, weight, starts)
        except NotConvergedError:
            return float("inf"), np.full((len(segments.folds), len(least)), np.inf)
        return float(np.exp(0.5 * np.log(_by_joint(errors)).mean())), errors

    # a residual without the repeated error is smaller by this log ratio
    excess = -0.5 * np.log1p(-min(repeated, MOST_EXPLAINED))
    choice = replace(_search(score, how, excess, least, _USUAL), plausible=plausible)
    larger = [weight for weight, _ in choice.curve if weight >= choice.weight]
    for weight in larger[:-1]:  # the first one at which the fit to all rows converges
        near = next(iter(fits.get(weight, ())), None)
        try:
            fit.programme.minimise(segments.rows, weight, start=near)
        except NotConvergedError:
            continue
        return replace(choice, weight=weight)
    return replace(choice, weight=larger[-1])


def loss_of(fit: Consistent, segments: Segments, weight: float) -> float:
    """Return the largest ratio of the held-out error of a joint to that of least squares [-]."""
    try:
        errors, _ = held_out_errors(fit, segments, weight)
    except NotConvergedError:
        return float("inf")
    return float(np.sqrt(_by_joint(errors) / _by_joint(segments.least_squares_errors)).max())


def plausible_weight(fit: Consistent, rows: Array, weight: float) -> float:
    """Return the weight at which the distance from the prior is as expected, or the given one.

    The evidence expands the penalty at its centre. At the minimum with a weight w that agrees with
    the data, w times the penalty is the number of parameters that the data determine, g = d -
    trace(w H C / 2) of d free ones (MacKay, 1992, Bayesian interpolation, section 4). If it is
    more, or less than half, as far from the centre the penalty is not quadratic, the next weight is
    g over the penalty. The weight is reduced by half a decade at most, the distance of the weights
    tried: a larger disagreement is due to errors of the model. The steps end before a weight at
    which the fit does not converge.
    """
    programme, solution, plausible = fit.programme, None, weight
    least = weight * 10.0**-_STEP
    for _ in range(_REESTIMATED):
        try:
            solution = programme.minimise(rows, weight, is_exact=False, start=solution)
        except NotConvergedError:  # bodies shrink to points
            break
        plausible = weight
        H, C = programme.penalty.hessian(solution.x), programme.covariance(weight, rows, solution.x)
        determined = programme.space.basis.shape[1] - 0.5 * weight * float(np.sum(H * C))
        distance = weight * programme.penalty.value(solution.x)
        low, high = np.multiply(_EXPECTED, determined)
        is_least = distance > high and weight == least
        if low <= distance <= high or is_least or distance == 0.0:
            break
        weight = max(least, weight * determined / distance)
    return plausible


def contradicted_extents(fit: Consistent, segments: Segments) -> tuple[str, ...]:
    """Return the bodies whose extent is contradicted by the data.

    These are the bodies that are outside their box by more than four standard errors in a fit
    without extents, at a weight of 1. That fit must also predict held-out segments better than the
    fit with extents, by more than two standard errors and 2 % of the mean square error.
    """
    bounds, rows, count = fit.programme.bounds, segments.rows, len(segments.folds)
    free = replace(fit, constraints=fit.constraints.without_extent(fit.constraints.extent))
    try:
        solution = free.programme.minimise(rows, 1.0, is_exact=False)
    except NotConvergedError:  # bodies diverge: this contradicts no extent
        return ()
    G, covariance = bounds.G / fit.prior_std, free.programme.covariance(1.0, rows, solution.x)
    error = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", G, covariance, G), 0.0))
    beyond = G @ solution.x + bounds.h < -_BEYOND * error
    outside = [label for label, is_out in zip(bounds.labels, beyond, strict=True) if is_out]
    bodies = tuple(body for body in fit.layout.bodies if f"extent {body}" in outside)
    if not bodies or count < 2:
        return bodies
    try:
        unbound = held_out_errors(free, segments, 1.0, [solution] * count)[0].sum(axis=1)
    except NotConvergedError:
        return ()
    try:
        excess = held_out_errors(fit, segments, 1.0)[0].sum(axis=1) - unbound
    except NotConvergedError:  # noise-free data that contradict the extents
        return bodies
    error = np.sqrt(len(excess)) * excess.std(ddof=1)  # of the sum, paired
    least = max((_MOST_LOSS - 1.0) * unbound.sum(), ALIKE * error)
    return bodies if excess.sum() > least else ()


def held_out_errors(
    fit: Consistent,
    segments: Segments,
    weight: float,
    starts: Sequence[Minimum] | None = None,
) -> tuple[Array, list[Minimum]]:
    """Return the errors of each segment, (segments, n) [-], by the consistent fit to all others."""
    if len(segments.folds) < 2:
        raise DataError(
            f"prior_weight = 'cv' needs at least 2 segments, found {len(segments.folds)}; fit "
            "longer logs, or set prior_weight = 'evidence'"
        )
    fits = fit.programme.minimise_each(segments.others, weight, is_exact=False, starts=starts)
    pairs = zip(segments.folds, fits, strict=True)
    squares = np.array([fold.residual_squares(fit.K @ x.x) for fold, x in pairs])
    return segments.errors(squares), fits


def log_evidence(fit: Consistent, rows: Array) -> Callable[[float], float]:
    """Return the log marginal likelihood of the data as a function of the prior's weight.

    With the prior x = L (pi - centre) ~ N(0, 1 / weight) and r = A x + noise of unit variance,
    r ~ N(0, I + A A^T / weight). The penalty is expanded at its centre; the inequalities and a
    constant are omitted.
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
    score: Callable[[float], tuple[float, Array]],
    how: str,
    allowed: float,
    least: Array | None = None,
    usual: float = _SMALLEST,
) -> WeightChoice:
    """Return the largest weight that ``_is_accepted`` in comparison with that of smallest score.

    ``score`` returns the score and its parts by segment and joint, or no parts. The loss is the
    largest ratio of a joint's error to that of least squares, shape (n,); below the usual smallest
    weight, others are tried while it is too large and decreases.
    """
    tried: dict[float, float] = {}
    parts: dict[float, Array] = {}
    loss: dict[float, float] = {}

    def attempt(decade: float) -> None:
        tried[decade], parts[decade] = score(10.0**decade)
        ratio = 0.0 if least is None else np.sqrt(_by_joint(parts[decade])) / least
        loss[decade] = float(np.max(ratio))

    decade = _LARGEST
    while decade >= _SMALLEST and (
        (decade >= usual and _is_promising(tried.values()))
        or (min(loss.values()) > AS_GOOD and _is_promising(loss.values(), _MOST_LOSS))
    ):
        attempt(decade)
        decade -= 1.0
    best = min(tried, key=lambda k: tried[k])
    for k in (best - _STEP, best + _STEP):
        if _SMALLEST <= k <= _LARGEST:
            attempt(k)
    finite = [k for k in sorted(tried) if np.isfinite(tried[k])]
    if not finite:
        raise NotConvergedError(
            f"the fit converges at no prior_weight from {10.0**_SMALLEST:g} to {10.0**_LARGEST:g}; "
            "record a richer motion, or correct the inertials of the URDF",
            "max_iterations",
        )
    allowed_loss = max(AS_GOOD, _MOST_LOSS * min(loss.values()))
    within = [k for k in finite if loss[k] <= allowed_loss]
    best = min(within, key=lambda k: tried[k])
    chosen = max([best, *(k for k in within if _is_accepted(parts[k], parts[best], allowed))])
    curve = tuple((float(10.0**k), tried[k]) for k in finite)
    return WeightChoice(float(10.0**chosen), how, curve, float(10.0**best), loss[chosen])


def _is_accepted(parts: Array, best: Array, allowed: float) -> bool:
    """Return whether errors are about as small as the best ones, both of shape (segments, n).

    The RMS error over segments, its geometric mean over joints, is at most 2 % larger, and that of
    any joint 5 %. The mean log ratio by segment is at most the allowed one, or two standard errors.
    """
    if not parts.size:
        return False
    ratio = np.sqrt(_by_joint(parts) / _by_joint(best))  # (n,)
    if np.exp(np.log(ratio).mean()) > _MOST_LOSS or ratio.max() > _MOST_JOINT_LOSS:
        return False
    both = (parts > 0) & (best > 0)  # a joint at rest has no rows in a segment
    logs = 0.5 * np.log(np.where(both, parts, 1.0) / np.where(both, best, 1.0))
    excess = logs.sum(axis=1) / np.maximum(both.sum(axis=1), 1)  # (segments,)
    error = excess.std(ddof=1) / np.sqrt(len(excess))
    return bool(excess.mean() <= max(allowed, ALIKE * error))


def _by_joint(parts: Array) -> Array:
    """Return the mean squares of the joints with rows, shape (n,), from errors by segment."""
    squares = parts.sum(axis=0)
    return np.asarray(squares[squares > 0])


def _is_promising(values: Iterable[float], factor: float = 1.0) -> bool:
    """Return whether one of the last two values is the smallest, clearly by a factor."""
    scores = list(values)
    if len(scores) <= _PATIENCE or not np.isfinite(scores).any():
        return True
    return factor * min(scores[-_PATIENCE:]) < min(scores[:-_PATIENCE])
