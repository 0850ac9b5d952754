"""Standard errors for coloured noise, from the scatter of the scores of segments.

Filtered residuals and model errors are correlated, segments longer than the correlation time are
not: the covariance of the score of segment s, W_s^T (tau_s - W_s theta), is that of the noise.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robotid.base.tolerances import SLACK
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Factors
from robotid.dynamics.torque import trajectory_regressor
from robotid.estimation.estimators import Consistent, Estimate
from robotid.estimation.estimators.batch import solve_factor
from robotid.estimation.estimators.estimator import FEWEST_SEGMENTS, quantile, sandwich, scatter
from robotid.robot.model import RobotModel

_DRAWS = 64  # fits to resampled data and prior, for standard errors with active bounds
_LEAST_SOLVED = 0.8  # smallest share of them that must be solved
QUANTILE = 1.96  # half-width of a 95 % band in standard deviations
_MOST = 500  # largest number of samples at which a band is computed


@dataclass(frozen=True, eq=False)
class StandardErrors:
    """How the standard errors of an estimate were computed."""

    method: str  # description of the method
    segments: int  # number of segments whose scores were used
    inflation: float  # variance of the scores over that of independent rows [-]
    freedom: Array  # (b,), degrees of freedom of each base parameter's standard error
    unbounded: Array | None = None  # (p,), standard errors without the bounds; None: none is active

    @property
    def quantile(self) -> Array:
        """Half-width of each base parameter's 95 % interval in standard errors, shape (b,)."""
        return quantile(self.freedom)


def measured_errors(
    estimate: Estimate, segments: Sequence[Factors], factors: Factors, share: float, K: Array,
    sigma: Array, *, is_filter: bool = False, weight_ratio: float = 1.0,
    bounded: Consistent | None = None, more: Array | None = None,
) -> tuple[Estimate, StandardErrors]:  # fmt: skip
    """Return an estimate with its covariance from the scatter of the segments.

    With the bread B, the covariance if rows were independent, and the meat M, the covariance of the
    score, ``more`` (b, b) included:

    * base parameters: B M B, as for any least squares with correlated rows;
    * standard parameters: B (K^T M K + g L) B with B = (K^T H K + L)^-1. L is the precision of the
      prior as it was weighted, g is its ratio to the precision L / g of the plausible prior; this
      is the mean square error if the true parameters have the plausible prior. If bounds are
      active, it is computed from fits to resampled data and prior; without the fit ``bounded``
      they are neglected;
    * a filter with forgetting: its own covariance times the mean inflation.

    Too few segments have no scatter: the meat is that of a share of independent rows.
    """
    b, is_open = len(factors.names), ~np.isfinite(np.diag(estimate.covariance))
    C = np.where(np.isfinite(estimate.covariance), estimate.covariance, 0.0)
    R, more = factors.weighted(sigma)[:b, :b], np.zeros((b, b)) if more is None else more
    is_standard = len(estimate.theta) != b
    bounded = bounded if estimate.details.get("active") else None
    if len(segments) < FEWEST_SEGMENTS:
        errors = StandardErrors(
            f"the bandwidth of the filter: a share of {share:.3g} of the rows is assumed to be "
            f"independent, because the logs have only {len(segments)} segments longer than the "
            "correlation time of the filter",
            len(segments), 1 / share, np.full(b, np.inf),
        )  # fmt: skip
        meat, weight_ratio = R.T @ R / share + more, max(weight_ratio, 1.0)
        covariance = C + share**2 * C @ more @ C if not is_standard else C
    else:
        theta, bread = estimate.theta, share * C
        if is_standard:
            theta, bread = K @ theta, share * K @ C @ K.T
        elif not is_filter:
            bread = solve_factor(factors, sigma, theta).covariance
        scores = scatter(segments, theta, sigma, bread)
        method = f"the scatter of the scores of {len(segments)} segments"
        errors = StandardErrors(method, len(segments), scores.inflation, scores.freedom())
        meat = scores.meat + more
        covariance = sandwich(bread, meat)
        if is_filter:
            covariance = scores.inflation * bread + sandwich(bread, more)
    if is_standard:
        covariance = about_prior(C, K, share**2 * meat, R, share, weight_ratio)
    covariance[is_open, is_open] = np.inf
    estimate = replace(estimate, covariance=covariance)
    if bounded is None:
        return estimate, errors
    return _redrawn(estimate, errors, bounded, factors, sigma, share**2 * meat)


def with_wls_errors(estimate: Estimate, wls: Estimate) -> Estimate:
    """Return a gradient method's estimate with the errors of WLS plus its distance to it."""
    distance = estimate.theta - wls.theta
    covariance = wls.covariance + np.outer(distance, distance)
    reason = "standard errors of WLS plus the distance to WLS"
    return replace(
        estimate, covariance=covariance, rank=wls.rank, condition=wls.condition,
        undetermined=wls.undetermined,
        message=estimate.message.split("; a gradient method")[0] + f"; {reason}",
    )  # fmt: skip


def standard_of(
    estimate: Estimate, mapping: BaseMapping, prior: Array, spread: Array
) -> tuple[Array, Array]:
    """Return the standard parameters of an estimate and their covariance, prior included."""
    if estimate.names == mapping.names:
        return estimate.theta, estimate.covariance
    G, K = mapping.gain(spread), mapping.K
    before = np.diag(spread**2)
    # parameters that are not identifiable (infinite variance) keep the variance of the prior
    base = np.where(np.isfinite(estimate.covariance), estimate.covariance, K @ before @ K.T)
    covariance = before - G @ K @ before + G @ base @ G.T
    return mapping.to_standard(estimate.theta, prior, spread), covariance


def about_prior(
    C: Array, K: Array, meat: Array, R: Array, share: float, weight_ratio: float
) -> Array:
    """Return C (K^T meat K + weight_ratio L) C with L = C^-1 - share K^T R^T R K, shape (p, p)."""
    KC = K @ C
    RKC = R @ KC
    covariance: Array = weight_ratio * (C - share * RKC.T @ RKC) + KC.T @ meat @ KC
    return 0.5 * (covariance + covariance.T)


def _redrawn(
    estimate: Estimate, errors: StandardErrors, fit: Consistent, factors: Factors, sigma: Array,
    meat: Array,  # (b, b), covariance of the score of the rows of ``Consistent.rows``
) -> tuple[Estimate, StandardErrors]:  # fmt: skip
    """Return the estimate with the mean square distance of resampled fits as its covariance."""
    rows, rng = fit.rows(factors, sigma), np.random.default_rng(0)
    distances, failures = fit.programme.redrawn(
        rows, fit.prior_weight, estimate.theta, meat, fit.weight_ratio, _DRAWS, rng
    )
    count = len(distances)
    if count < _LEAST_SOLVED * _DRAWS:
        solved = f"only {count} of {_DRAWS} fits to resampled data were solved: {failures[0]}"
        method = f"{errors.method}; active bounds are neglected, {solved}"
        return estimate, replace(errors, method=method)
    unsolved = f" ({len(failures)} more not solved: {failures[0]})" if failures else ""
    errors = StandardErrors(
        f"{errors.method}; bounds are active: {count} fits to resampled data and prior{unsolved}",
        errors.segments, errors.inflation, 1.0 / (1.0 / errors.freedom + 1.0 / count),
        unbounded=estimate.std_error,
    )  # fmt: skip
    return replace(estimate, covariance=distances.T @ distances / count), errors


@dataclass(frozen=True, eq=False)
class TorqueBand:
    """Standard deviations of predicted torques at some samples of a trajectory."""

    samples: Array  # (k,), indices of these samples, int
    parameters: Array  # (k, n_rows), part due to the uncertainty of the parameters [N m, N]
    noise: Array  # (n_rows,), part due to the residual of the model [N m, N]

    @property
    def total(self) -> Array:
        """Standard deviation of measured torque minus prediction, shape (k, n_rows) [N m, N]."""
        return np.asarray(np.hypot(self.parameters, self.noise))

    def coverage(self, tau: Array, prediction: Array, mask: Array) -> Array:
        """Return the share of torques (N, n_rows) in the 95 % band or on its edge, (n_rows,)."""
        used = mask[self.samples]
        error = np.abs(tau[self.samples] - prediction[self.samples])
        is_inside = (error <= (1.0 + SLACK) * QUANTILE * self.total) & used
        count = used.sum(axis=0)
        return np.where(count > 0, is_inside.sum(axis=0) / np.maximum(count, 1), np.nan)


def torque_band(
    model: RobotModel,
    mapping: BaseMapping,
    trajectory: Trajectory,
    covariance: Array,  # (b, b)
    noise: Array,  # (n_rows,) [N m, N]
    errors: Callable[[Array], Sequence[tuple[Array, Array]]] = lambda rows: (),
) -> TorqueBand:
    """Return the band of predicted torques, at up to 500 samples.

    Its variance is diag(W C W^T) + sum (W x + z)^2: an error (x, z) changes the base parameters by
    x and, with them, the torque by z.
    """
    count = len(trajectory.t)
    samples = np.unique(np.linspace(0, count - 1, min(count, _MOST)).round().astype(int))
    W = trajectory_regressor(model, trajectory, samples)[:, mapping.independent]
    variance = np.einsum("ij,ij->i", W @ covariance, W)
    for x, z in errors(samples):
        variance += (W @ x + z.ravel()) ** 2
    std = np.sqrt(np.maximum(variance, 0.0)).reshape(len(samples), -1)
    return TorqueBand(samples, std, np.asarray(noise))


def rms_error(bands: Sequence[TorqueBand]) -> Array:
    """Return the expected RMS error of predicted torques, shape (n_rows,) [N m, N]."""
    return np.asarray(np.sqrt(np.mean(np.vstack([b.total for b in bands]) ** 2, axis=0)))


@dataclass(frozen=True, eq=False)
class FrictionCurve:
    """Friction and offset of a drive at constant speed."""

    v: Array  # (k,), speeds [rad/s or m/s]
    torque: Array  # (k,), friction plus offset [N m or N]
    std: Array  # (k,), standard deviation due to the uncertainty of the parameters [N m or N]
    load: float  # joint load torque at which the friction is evaluated [N m or N]

    def __str__(self) -> str:
        rows = zip(self.v.tolist(), self.torque.tolist(), self.half_width.tolist(), strict=True)
        return "\n".join(
            [
                f"friction and offset against speed, joint load torque {self.load:.3g}",
                f"{'speed':>10} {'torque':>10} {'95 %':>9}",
                *(f"{v:10.4g} {torque:10.4g} +-{half:7.2g}" for v, torque, half in rows),
            ]
        )

    def __repr__(self) -> str:
        if not len(self.v):
            return "<FrictionCurve: no speeds>"
        return f"<FrictionCurve: {len(self.v)} speeds, {self.v.min():.4g} to {self.v.max():.4g}>"

    @property
    def half_width(self) -> Array:
        """Half-width of the 95 % band, shape (k,) [N m or N]."""
        return QUANTILE * self.std

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as ``curve`` of a joint's friction in result.json has them."""
        return {
            "v": self.v.tolist(),
            "torque": self.torque.tolist(),
            "std_error": self.std.tolist(),
            "load": self.load,
        }
