"""Information in the fitted recordings: singular values, correlations, shares of the data."""

from dataclasses import dataclass

import numpy as np

from robotid.base.typing import Array
from robotid.estimation.estimators.batch import solve_factor
from robotid.estimation.fitting.fitted import Fit


@dataclass(frozen=True, eq=False)
class Information:
    """Information about the base parameters in the fitted recordings.

    Attributes:
        singular_values: Singular values of the weighted regressor with columns of unit norm,
            largest first, shape (b,) [-]; the condition number is the ratio of the first to the
            smallest determined one.
        correlation: Correlation of the errors of WLS if rows were independent, shape (b, b); NaN
            for parameters that are not identifiable.
        data_share: Share of the data in the information about each base parameter, shape (b,),
            0 to 1: S^2 / (S^2 + s^2) with the prior standard deviation S and the standard error s
            of WLS.
    """

    singular_values: Array
    correlation: Array
    data_share: Array


def information(found: Fit) -> Information:
    """Return the information about the base parameters in the fitted recordings."""
    A = found.factors.weighted(found.wls.sigma)[:, :-1]
    norms = np.linalg.norm(A, axis=0)
    singular_values = np.linalg.svd(A / np.where(norms > 0, norms, 1.0), compute_uv=False)
    K = found.mapping.K
    prior = np.einsum("bi,i,bi->b", K, found.prior_std**2, K)  # variances
    error = np.diag(found.wls.covariance)
    known = np.isfinite(error) & (error > 0)
    bread = solve_factor(found.factors, found.wls.sigma, found.wls.theta).covariance
    std = np.sqrt(np.where(known, np.diag(bread), np.nan))
    return Information(
        singular_values=singular_values[: len(norms)],
        correlation=bread / np.outer(std, std),
        data_share=np.where(np.isfinite(error), prior / (prior + error), 0.0),
    )
