"""Standard errors that hold for coloured noise, from how much the scores of segments scatter.

Residuals behind a low-pass filter are correlated, and what a model misses is correlated still
longer, so rows do not count as independent measurements. Segments that are longer than the
correlation do: the score of segment s, W_s^T (tau_s - W_s theta), scatters as the noise makes it,
whatever its colour. The factors of the segments tell it without a second pass over the rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid._typing import Array
from robotid.estimators import Consistent, Estimate
from robotid.estimators.batch import solve_factor
from robotid.estimators.segments import FEWEST_SEGMENTS, quantile, scatter
from robotid.exceptions import NotConvergedError
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.factors import Factors

__all__ = [
    "Redraws",
    "StandardErrors",
    "about_prior",
    "measured_errors",
    "standard_of",
    "with_wls_errors",
]

_LEAST_SOLVED = 0.8  # share of the redrawn fits below which they tell nothing


@dataclass(frozen=True, eq=False)
class StandardErrors:
    """What the standard errors of an estimate depend on.

    Attributes:
        method: In words.
        segments: Number of segments whose scores were compared.
        inflation: How much more the scores scatter than those of independent rows would [-].
        freedom: Degrees of freedom of each base parameter's standard error, shape (b,).
        unbounded: Standard errors of the standard parameters with the bounds left out, shape (p,);
            None if no bound binds.
    """

    method: str
    segments: int
    inflation: float
    freedom: Array
    unbounded: Array | None = None

    @property
    def quantile(self) -> Array:
        """Standard errors that a 95 % interval of each base parameter reaches, shape (b,)."""
        return quantile(self.freedom)


@dataclass(frozen=True, eq=False)
class Redraws:
    """How the spread of a physically consistent fit is told where its bounds bind."""

    fit: Consistent
    draws: int  # fits to data and prior drawn anew; 0 leaves the bounds out
    rng: np.random.Generator  # source of the noise


def measured_errors(
    estimate: Estimate,
    segments: Sequence[Factors],
    factors: Factors,
    share: float,
    K: Array,
    sigma: Array,
    *,
    is_filter: bool = False,
    pull: float = 1.0,
    redraws: Redraws | None = None,
    more: Array | None = None,
) -> tuple[Estimate, StandardErrors]:
    """Return an estimate with the covariance that the scatter of the segments shows.

    With bread B, the covariance if rows were independent, and meat M, the covariance of the score:

    * of base parameters: B M B, as of any least squares on correlated rows;
    * of standard parameters, with the prior's information L in B = (K^T H K + L)^-1 and that of
      the truth's plausible spread, L over the pull g: B (K^T M K + g L) B, the mean square error
      about a truth so spread. Where inequalities bind, fits to redrawn data and prior tell it;
      without ``redraws`` they are left out;
    * of a filter that forgets: its own covariance, grown by the mean inflation.

    Args:
        estimate: Base parameters, shape (b,), or standard ones, shape (p,), with the covariance
            that rows would leave of which ``share`` are independent.
        segments: Factors of the segments, base parameters.
        factors: Those of all segments together.
        share: Share of the rows that the covariance takes to be independent [-].
        K: Map to the base parameters, shape (b, p).
        sigma: Noise level per joint that weighted the rows, shape (n,) [N m or N].
        is_filter: Whether it weighs rows otherwise, too, as a filter that forgets or gates.
        pull: How much heavier the prior weighs than the truth's plausible spread says [-].
        redraws: How the spread is told of an estimate whose details name active bounds.
        more: Covariance of the score that segments do not show, shape (b, b); None: nothing.

    Returns:
        The estimate, and what its standard errors depend on. With fewer than 12 segments rows count
        as independent by that share.

    Raises:
        NotConvergedError: If more than a fifth of the redrawn fits are not solved.
    """
    b = len(factors.names)
    if not (estimate.details.get("active") and redraws is not None and redraws.draws > 0):
        redraws = None  # no bound binds, or it is left out
    if len(segments) < FEWEST_SEGMENTS:
        method = (
            f"the filter's band: {share:.3g} of the rows count as independent, since the logs have "
            f"only {len(segments)} segments longer than the filter's memory"
        )
        errors = StandardErrors(method, len(segments), 1 / share, np.full(b, np.inf))
        R = factors.weighted(sigma)[:b, :b]
        if redraws is not None:
            return _bounded(estimate, errors, redraws, factors, sigma, share * R.T @ R)
        if pull > 1.0:
            C = about_prior(estimate.covariance, K, share * R.T @ R, R, share, pull)
            estimate = replace(estimate, covariance=C)
        return estimate, errors
    is_open = ~np.isfinite(np.diag(estimate.covariance))
    C = np.where(np.isfinite(estimate.covariance), estimate.covariance, 0.0)
    if len(estimate.theta) != b:
        found = scatter(segments, K @ estimate.theta, sigma, share * K @ C @ K.T)
        found = found if more is None else replace(found, meat=found.meat + more)
        R = factors.weighted(sigma)[:b, :b]
        covariance = about_prior(C, K, share**2 * found.meat, R, share, pull)
    elif not is_filter:
        bread = solve_factor(factors, sigma, estimate.theta).covariance
        found = scatter(segments, estimate.theta, sigma, bread)
        found = found if more is None else replace(found, meat=found.meat + more)
        covariance = found.covariance
    else:
        found = scatter(segments, estimate.theta, sigma, share * C)
        covariance = C * (share * found.inflation)
        if more is not None:
            covariance += share**2 * C @ more @ C
    covariance[is_open, is_open] = np.inf
    estimate = replace(estimate, covariance=covariance)
    method = f"the scatter of the scores of {len(segments)} segments"
    errors = StandardErrors(method, len(segments), found.inflation, found.freedom())
    if redraws is not None:
        return _bounded(estimate, errors, redraws, factors, sigma, share**2 * found.meat)
    return estimate, errors


def with_wls_errors(estimate: Estimate, wls: Estimate) -> Estimate:
    """Return a gradient method's estimate with the covariance that the factors know.

    It ends beside the minimum of least squares: its mean square error is the covariance of that
    minimum plus the square of the distance to it, which is measured.

    Args:
        estimate: Base parameters, shape (b,).
        wls: Weighted least squares of the same rows.
    """
    distance = estimate.theta - wls.theta
    covariance = wls.covariance + np.outer(distance, distance)
    reason = "standard errors are those of wls plus the distance to it"
    return replace(
        estimate,
        covariance=covariance,
        rank=wls.rank,
        condition=wls.condition,
        undetermined=wls.undetermined,
        message=estimate.message.split("; a gradient method")[0] + f"; {reason}",
    )


def standard_of(
    estimate: Estimate, mapping: BaseMapping, prior: Array, spread: Array
) -> tuple[Array, Array]:
    """Return the standard parameters of an estimate and their covariance, prior included.

    Args:
        estimate: Base parameters, shape (b,), or standard ones, shape (p,).
        mapping: Standard to base parameters.
        prior: What those of the URDF are, shape (p,).
        spread: How far they may plausibly be wrong, shape (p,).
    """
    if estimate.names == mapping.names:
        return estimate.theta, estimate.covariance
    G, K = mapping.gain(spread), mapping.K
    before = np.diag(spread**2)
    # what the data leave open (infinite variance) stays as wide as the prior has it
    base = np.where(np.isfinite(estimate.covariance), estimate.covariance, K @ before @ K.T)
    covariance = before - G @ K @ before + G @ base @ G.T
    return mapping.to_standard(estimate.theta, prior, spread), covariance


def about_prior(C: Array, K: Array, meat: Array, R: Array, share: float, pull: float) -> Array:
    """Return C (K^T meat K + pull L) C with L = C^-1 - share K^T R^T R K, shape (p, p).

    Args:
        C: Covariance of the standard parameters if a share of the rows is independent, (p, p).
        K: Map to the base parameters, shape (b, p).
        meat: Covariance of the score of these rows, shape (b, b).
        R: Weighted factor of all rows, base parameters, shape (b, b).
        share: Share of the rows that the covariance takes to be independent [-].
        pull: How much heavier the prior weighs than the truth's plausible spread says [-].
    """
    KC = K @ C
    RKC = R @ KC
    covariance: Array = pull * (C - share * RKC.T @ RKC) + KC.T @ meat @ KC
    return 0.5 * (covariance + covariance.T)


def _bounded(
    estimate: Estimate,
    errors: StandardErrors,
    redraws: Redraws,
    factors: Factors,
    sigma: Array,
    meat: Array,
) -> tuple[Estimate, StandardErrors]:
    """Return the estimate with the mean square distance of redrawn fits as its covariance.

    The meat is that of the rows as ``Consistent.rows`` has them, of which a share counts.
    """
    fit = redraws.fit
    rows = fit.rows(factors, sigma)
    found, failures = fit.programme.redrawn(
        rows, fit.prior_weight, estimate.theta, meat, fit.pull, redraws.draws, redraws.rng
    )
    if len(found) < _LEAST_SOLVED * redraws.draws:
        raise NotConvergedError(
            f"the spread of the fit where its bounds bind is not known: Clarabel solved "
            f"{len(found)} of {redraws.draws} fits to redrawn data; set draws = 0 for standard "
            "errors without the bounds",
            failures[0],
        )
    missing = f" ({len(failures)} more not solved: {failures[0]})" if failures else ""
    method = f"{errors.method}; bounds bind: {len(found)} fits to redrawn data and prior{missing}"
    freedom = 1.0 / (1.0 / errors.freedom + 1.0 / len(found))
    covariance = found.T @ found / len(found)
    return (
        replace(estimate, covariance=covariance),
        replace(errors, method=method, freedom=freedom, unbounded=estimate.std_error),
    )
