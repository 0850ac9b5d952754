"""The weight of the prior, chosen from the fitted data alone."""

from collections.abc import Callable, Sequence

import numpy as np

from robotid._typing import Array
from robotid.estimators.physical import Consistent
from robotid.estimators.priors import WeightChoice
from robotid.exceptions import DataError
from robotid.factors import Factors, merge

__all__ = ["choose_weight", "held_out_error", "log_evidence"]

_LIGHTEST, _HEAVIEST = -4.0, 0.0  # decades of the weights tried
_LIGHTEST_ENTROPIC = -1.0  # below, each fit of a penalty that is not quadratic takes a second
_PATIENCE = 2  # decades without a better score that end the search
_STEPS = (0.5, 0.25)  # decades by which the best one is refined


def choose_weight(fit: Consistent, stretches: Sequence[Factors], how: str) -> WeightChoice:
    """Return the weight of the prior that the fitted data speak for.

    * "cv": the weight with the smallest :func:`held_out_error`.
    * "evidence": the weight with the largest :func:`log_evidence`.

    Weights are tried from 1 down to 1e-4 (entropic: 0.1) at most, by decades until two in a row
    are worse than those before, then around the best one. None is heavier than 1: a good
    prediction shows that most parameters are near the prior, not that all are, and standard
    errors must hold for those that are not, as of a link with a tool.

    Args:
        fit: The fit, whose own weight does not matter.
        stretches: Factors of contiguous stretches of the fitted data.
        how: "cv" or "evidence".

    Returns:
        The choice.

    Raises:
        DataError: If "cv" has fewer than two stretches.
        NotConvergedError: If a fit does not converge.
    """
    sigma = fit.noise(merge(stretches))
    lightest = _LIGHTEST if fit.penalty.is_quadratic else _LIGHTEST_ENTROPIC
    if how == "cv":
        return _search(lambda w: held_out_error(fit, stretches, sigma, w), how, lightest)
    rows = fit.rows(merge(stretches), sigma)
    return _search(lambda w: -log_evidence(fit, rows, w), how, lightest)


def held_out_error(
    fit: Consistent, stretches: Sequence[Factors], sigma: Array, weight: float
) -> float:
    """Return how well each stretch is predicted by the fit to all others, constraints included.

    Args:
        fit: The fit, whose own weight does not matter.
        stretches: Factors of contiguous stretches, at least two.
        sigma: Noise level per joint, shape (n,) [N m or N].
        weight: Weight of the prior.

    Returns:
        Root of the mean square of the prediction errors, each over its joint's noise level [-].

    Raises:
        DataError: If there are fewer than two stretches.
        NotConvergedError: If a fit does not converge.
    """
    if len(stretches) < 2:
        raise DataError(
            f"the prior's weight cannot be chosen from {len(stretches)} stretch; fit longer logs, "
            "or use prior_weight = 'evidence'"
        )
    squares, count = 0.0, 0
    for k, kept in enumerate(stretches):
        others = merge([*stretches[:k], *stretches[k + 1 :]])
        solution, _ = fit.programme.minimise(fit.rows(others, sigma), weight, is_exact=False)
        squares += float((kept.residual_squares(fit.K @ solution.x) / sigma**2).sum())
        count += int(kept.rows.sum())
    return float(np.sqrt(squares / count))


def log_evidence(fit: Consistent, rows: Array, weight: float) -> float:
    """Return the log marginal likelihood of the data as a function of the prior's weight.

    With x = L (pi - centre) ~ N(0, 1 / weight) before the data and r = A x + noise of unit
    variance, r ~ N(0, I + A A^T / weight). A penalty that is not quadratic is expanded at its
    centre; the inequalities are left out.

    Args:
        fit: The fit, whose own weight does not matter.
        rows: Information, shape (k, b + 1), as of :meth:`Consistent.rows`.
        weight: Weight of the prior.

    Returns:
        The logarithm, but for a constant that does not depend on the weight.

    References:
        MacKay (1992), Bayesian interpolation, section 4.
    """
    A, r = fit.programme.whitened(rows)
    U, s, _ = np.linalg.svd(A, full_matrices=False)
    spread = 1.0 + s**2 / weight
    along = U.T @ r
    # |r|^2 outside the range of A is constant
    return float(-0.5 * ((along**2 / spread).sum() + np.log(spread).sum()))


def _search(score: Callable[[float], float], how: str, lightest: float) -> WeightChoice:
    """Return the weight with the smallest score, from 1 down by decades until it only grows."""
    tried: dict[float, float] = {}
    decade = _HEAVIEST
    while decade >= lightest and _is_promising(tried):
        tried[decade] = score(10.0**decade)
        decade -= 1.0
    for step in _STEPS:
        best = min(tried, key=lambda k: tried[k])
        for k in (best - step, best + step):
            if lightest <= k <= _HEAVIEST and k not in tried:
                tried[k] = score(10.0**k)
    best = min(tried, key=lambda k: tried[k])
    curve = tuple((float(10.0**k), tried[k]) for k in sorted(tried))
    return WeightChoice(float(10.0**best), how, curve)


def _is_promising(tried: dict[float, float]) -> bool:
    """Return whether one of the last two weights had the smallest score."""
    scores = list(tried.values())
    return len(scores) <= _PATIENCE or min(scores[-_PATIENCE:]) < min(scores[:-_PATIENCE])
