"""Standard errors of estimates, from how much the scores of stretches of the logs scatter."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid._typing import Array
from robotid.estimators import Estimate
from robotid.estimators.least_squares import solve_factor
from robotid.factors import Factors
from robotid.uncertainty import FEWEST, Scatter, quantile, scatter

__all__ = ["StandardErrors", "measured_errors"]


@dataclass(frozen=True, eq=False)
class StandardErrors:
    """What the standard errors of an estimate rest on.

    Attributes:
        method: In words.
        stretches: Number of stretches whose scores were compared.
        inflation: How much more the scores scatter than those of independent rows would [-].
        freedom: Degrees of freedom of each base parameter's standard error, shape (b,).
    """

    method: str
    stretches: int
    inflation: float
    freedom: Array

    @property
    def reach(self) -> Array:
        """Standard errors that a 95 % interval of each base parameter reaches, shape (b,)."""
        return quantile(self.freedom)


def measured_errors(
    estimate: Estimate,
    stretches: Sequence[Factors],
    factors: Factors,
    share: float,
    K: Array,
    sigma: Array,
    *,
    is_filter: bool = False,
) -> tuple[Estimate, StandardErrors]:
    """Return an estimate with the covariance that the scatter of the stretches shows.

    With bread B, the covariance if rows were independent, and meat M, the covariance of the score:

    * of base parameters: B M B, as of any least squares on correlated rows;
    * of standard parameters, with the prior's information L in B = (K^T H K + L)^-1:
      B (K^T M K + L) B, the mean square error about a truth that the prior describes. Inequalities
      are left out: they can only make it smaller;
    * of a filter that forgets: its own covariance, grown by the mean inflation.

    Args:
        estimate: Base parameters, shape (b,), or standard ones, shape (p,), with the covariance
            that rows would leave of which ``share`` are independent.
        stretches: Factors of the stretches, base parameters.
        factors: Those of all stretches together.
        share: Share of the rows that the covariance takes to be independent [-].
        K: Map to the base parameters, shape (b, p).
        sigma: Noise level per joint that weighted the rows, shape (n,) [N m or N].
        is_filter: Whether it weighs rows otherwise, too, as a filter that forgets or gates.

    Returns:
        The estimate, and what its standard errors rest on. With fewer than 12 stretches it is as
        it was.
    """
    b = len(factors.names)
    if len(stretches) < FEWEST:
        method = (
            f"the filter's band: {share:.3g} of the rows count as independent, since the logs have "
            f"only {len(stretches)} stretches longer than the filter's memory"
        )
        return estimate, StandardErrors(method, len(stretches), 1 / share, np.full(b, np.inf))
    is_open = ~np.isfinite(np.diag(estimate.covariance))
    C = np.where(np.isfinite(estimate.covariance), estimate.covariance, 0.0)
    if len(estimate.theta) != b:
        found = scatter(stretches, K @ estimate.theta, sigma, share * K @ C @ K.T)
        covariance = _about_prior(C, K, found, factors.weighted(sigma)[:b, :b], share)
    elif not is_filter:
        bread = solve_factor(factors, sigma, estimate.theta).covariance
        found = scatter(stretches, estimate.theta, sigma, bread)
        covariance = found.covariance
    else:
        found = scatter(stretches, estimate.theta, sigma, share * C)
        covariance = C * (share * found.inflation)
    covariance[is_open, is_open] = np.inf
    method = f"the scatter of the scores of {len(stretches)} stretches"
    errors = StandardErrors(method, len(stretches), found.inflation, found.freedom())
    return replace(estimate, covariance=covariance), errors


def _about_prior(C: Array, K: Array, found: Scatter, R: Array, share: float) -> Array:
    """Return C (share^2 K^T M K + L) C with L = C^-1 - share K^T R^T R K."""
    KC = K @ C
    RKC = R @ KC
    covariance: Array = C - share * RKC.T @ RKC + share**2 * KC.T @ found.meat @ KC
    return 0.5 * (covariance + covariance.T)
