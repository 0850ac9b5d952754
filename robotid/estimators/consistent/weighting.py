"""The weight of the prior, chosen from the fitted data alone."""

from collections.abc import Callable, Sequence

import numpy as np

from robotid._typing import Array
from robotid.estimators.consistent.fit import Consistent
from robotid.estimators.consistent.penalties import WeightChoice
from robotid.exceptions import DataError
from robotid.regressor.factors import Factors, merge

__all__ = ["choose_weight", "held_out_errors", "log_evidence"]

_LIGHTEST, _HEAVIEST = -4.0, 0.0  # decades of the weights tried
_LIGHTEST_ENTROPIC = -1.0  # below, each fit of a penalty that is not quadratic takes a second
_PATIENCE = 2  # decades without a better score that end the search
_ALIKE = 2.0  # standard errors of the difference by which a heavier weight may be worse
_STEPS = (0.5, 0.25)  # decades by which the best one is refined


def choose_weight(fit: Consistent, stretches: Sequence[Factors], how: str) -> WeightChoice:
    """Return the weight of the prior that the fitted data speak for.

    * "cv": the heaviest weight whose ``held_out_errors`` are within two standard errors of the
      smallest ones, stretch by stretch: a weight that wins by chance follows the noise.
    * "evidence": the weight with the largest ``log_evidence``.

    Weights are tried from 1 down to 1e-4 (entropic: 0.1) at most, by decades until two in a row
    are worse than those before, then around the best one. None is heavier than 1: a good
    prediction shows that most parameters are near the prior, not that all are, and standard
    errors must hold for those that are not, as of a link with a tool.

    Args:
        fit: The fit, whose own weight does not matter.
        stretches: Factors of contiguous stretches of the fitted data.
        how: "cv" or "evidence".

    Raises:
        DataError: If "cv" has fewer than two stretches.
        NotConvergedError: If a fit does not converge.
    """
    sigma = fit.noise(merge(stretches))
    lightest = _LIGHTEST if fit.penalty.is_quadratic else _LIGHTEST_ENTROPIC
    if how == "evidence":
        rows = fit.rows(merge(stretches), sigma)
        return _search(lambda w: (-log_evidence(fit, rows, w), np.zeros(0)), how, lightest)

    def score(weight: float) -> tuple[float, Array]:
        errors = held_out_errors(fit, stretches, sigma, weight)
        return float(np.sqrt(errors.sum())), errors

    return _search(score, how, lightest)


def held_out_errors(
    fit: Consistent, stretches: Sequence[Factors], sigma: Array, weight: float
) -> Array:
    """Return how well each stretch is predicted by the fit to all others, constraints included.

    Args:
        fit: The fit, whose own weight does not matter.
        stretches: Factors of contiguous stretches, at least two.
        sigma: Noise level per joint, shape (n,) [N m or N].
        weight: Weight of the prior.

    Returns:
        Sum of squares of the prediction errors of each stretch, each over its joint's noise level,
        over the number of all rows, shape (stretches,) [-]: their sum is the mean square.

    Raises:
        DataError: If there are fewer than two stretches.
        NotConvergedError: If a fit does not converge.
    """
    if len(stretches) < 2:
        raise DataError(
            f"the prior's weight cannot be chosen from {len(stretches)} stretch; fit longer logs, "
            "or use prior_weight = 'evidence'"
        )
    squares = []
    for k, kept in enumerate(stretches):
        others = merge([*stretches[:k], *stretches[k + 1 :]])
        solution, _ = fit.programme.minimise(fit.rows(others, sigma), weight, is_exact=False)
        squares.append((kept.residual_squares(fit.K @ solution.x) / sigma**2).sum())
    return np.array(squares) / sum(int(kept.rows.sum()) for kept in stretches)


def log_evidence(fit: Consistent, rows: Array, weight: float) -> float:
    """Return the log marginal likelihood of the data by the prior's weight, but for a constant.

    With x = L (pi - centre) ~ N(0, 1 / weight) before the data and r = A x + noise of unit
    variance, r ~ N(0, I + A A^T / weight). A penalty that is not quadratic is expanded at its
    centre; the inequalities are left out.

    Args:
        fit: The fit, whose own weight does not matter.
        rows: Information, shape (k, b + 1), as of ``Consistent.rows``.
        weight: Weight of the prior.

    References:
        MacKay (1992), Bayesian interpolation, section 4.
    """
    A, r = fit.programme.whitened(rows)
    U, s, _ = np.linalg.svd(A, full_matrices=False)
    spread = 1.0 + s**2 / weight
    along = U.T @ r
    # |r|^2 outside the range of A is constant
    return float(-0.5 * ((along**2 / spread).sum() + np.log(spread).sum()))


def _search(
    score: Callable[[float], tuple[float, Array]], how: str, lightest: float
) -> WeightChoice:
    """Return the weight with the smallest score, from 1 down by decades until it only grows.

    Beside the score come its parts, one per stretch or none; the heaviest weight wins that is not
    worse by more than two standard errors of the parts' differences.
    """
    tried: dict[float, float] = {}
    parts: dict[float, Array] = {}

    def attempt(decade: float) -> None:
        tried[decade], parts[decade] = score(10.0**decade)

    decade = _HEAVIEST
    while decade >= lightest and _is_promising(tried):
        attempt(decade)
        decade -= 1.0
    for step in _STEPS:
        best = min(tried, key=lambda k: tried[k])
        for k in (best - step, best + step):
            if lightest <= k <= _HEAVIEST and k not in tried:
                attempt(k)
    best = min(tried, key=lambda k: tried[k])
    alike = [k for k in tried if _is_as_good(parts[k], parts[best])]
    curve = tuple((float(10.0**k), tried[k]) for k in sorted(tried))
    return WeightChoice(float(10.0 ** max([best, *alike])), how, curve)


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
    return len(scores) <= _PATIENCE or min(scores[-_PATIENCE:]) < min(scores[:-_PATIENCE])
