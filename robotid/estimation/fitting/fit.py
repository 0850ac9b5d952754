"""Fit of a robot's parameters to recordings: estimate, standard errors, predictions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

import numpy as np

from robotid.base.exceptions import NotConvergedError, RankDeficientError, SettingsError
from robotid.base.typing import Array
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Factors, Reduction, join
from robotid.dynamics.prediction import body_slopes_by_position, is_loaded
from robotid.estimation.estimators import WLS, Consistent, Estimate
from robotid.estimation.estimators.determination import Determination, base_spread, determine
from robotid.estimation.estimators.estimator import Weighing
from robotid.estimation.fitting.chosen_estimator import (
    Known,
    consistent_fit,
    make_estimator,
    pinned_links,
)
from robotid.estimation.fitting.estimator_settings import (
    BoundedSettings,
    EstimatorSettings,
    RecursiveSettings,
)
from robotid.estimation.fitting.evaluation import (
    FEWEST_LEFT_OUT,
    Evaluation,
    Metrics,
    evaluate_logs,
    left_out_metrics,
)
from robotid.estimation.fitting.fitted import Fit, Solution
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.fitting.regressor_noise import RegressorNoise, find_regressor_noise
from robotid.estimation.fitting.robust import reweigh
from robotid.estimation.fitting.standard_errors import (
    StandardErrors,
    measured_errors,
    standard_of,
    with_wls_errors,
)
from robotid.estimation.variation.groups import (
    FEWEST_RUNS,
    RunSums,
    groups_at,
    runs_of,
    sums_of,
    with_zeros,
)
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

_MOST_LOADS = 20  # largest number of fits until the joint load torque has converged
_DAMPED = 3  # number of fits after which only half of each change is applied
_SETTLED = 1e-3  # change of the torque, relative to it, at which the fits have converged


def rough_choice(choice: EstimatorSettings) -> EstimatorSettings:
    """Return faster settings of the estimator, for fits whose residual only is used."""
    if not isinstance(choice, BoundedSettings):
        return choice
    weight = 1.0 if isinstance(choice.prior_weight, str) else choice.prior_weight
    return replace(choice, prior_weight=weight)


def fit_recordings(recordings: Recordings, choice: EstimatorSettings) -> Fit:
    """Return the fit of a robot's parameters to recordings."""
    return solve_recordings(recordings, choice).with_errors()


def solve_recordings(
    recordings: Recordings, choice: EstimatorSettings, *, is_last: bool = True
) -> "Solved":
    """Return the parameters fitted to recordings, before their standard errors are computed."""
    recordings = _under_own_load(recordings, choice)
    ground = _ground(recordings, choice, is_last=is_last)
    if is_last:
        ground = _without_regressor_noise(ground, choice)
    try:
        estimate, in_cone, weighing = _run(choice, ground)
    except RankDeficientError as error:
        raise ground.determination.refusal(error) from error
    standard, _ = standard_of(estimate, recordings.mapping, ground.before.pi, ground.before.spread)
    if recordings.model.layout.remembering:  # predictions use the load of the written parameters
        recordings = recordings.with_model(recordings.model.with_reference(standard))
    return Solved(choice, ground, recordings, estimate, in_cone, weighing, standard)


@dataclass(frozen=True, eq=False)
class Solved:
    """Parameters fitted to recordings, with the data for their standard errors."""

    choice: EstimatorSettings
    ground: "_Ground"
    recordings: Recordings  # with the joint load torque of the identified bodies
    estimate: Estimate
    in_cone: Consistent | None  # the estimator that made it physically consistent, if any
    weighing: Weighing
    standard: Array  # (p,), standard parameters

    @property
    def prior_std(self) -> Array:
        """Prior standard deviations of the parameters, shape (p,)."""
        of_estimate = self.estimate.prior_std
        return self.ground.before.spread if of_estimate is None else of_estimate

    @cached_property
    def solution(self) -> Solution:
        """The parameters with the recordings on which drive terms are tested."""
        own = self.recordings
        fitted, validation = evaluate_logs(own.fitted, own.validation, {}, None, plan=own.plan)
        return Solution(
            model=own.model,
            mapping=own.mapping,
            prior_std=self.prior_std,
            standard=self.standard,
            fitted=fitted,
            validation=validation,
        )

    def with_errors(self) -> Fit:
        """Return the fit: the parameters with their standard errors and predictions."""
        ground, recordings = self.ground, self.recordings
        model, mapping, before = recordings.model, recordings.mapping, ground.before
        estimate, wls, errors = self._measured()
        _, covariance = standard_of(estimate, mapping, before.pi, before.spread)
        base_variance = np.einsum("bi,ij,bj->b", mapping.K, covariance, mapping.K)
        wls_standard = mapping.to_standard(wls.theta, before.pi, before.spread)
        driven = urdf_with_drives(model, mapping, ground.factors, before.sigma, before.spread)
        fitted, validation = evaluate_logs(
            recordings.fitted, recordings.validation,
            {"estimate": self.standard, "wls": wls_standard},
            before.pi, driven, plan=recordings.plan,
        )  # fmt: skip
        is_base = estimate.names == mapping.base_names
        base_error = estimate.std_error if is_base else np.sqrt(np.maximum(base_variance, 0.0))
        found = Fit(
            model=model,
            mapping=mapping,
            estimator=self.choice,
            estimate=estimate,
            wls=wls,
            prior=before.pi,
            urdf_with_drives=driven,
            prior_std=self.prior_std,
            standard=self.standard,
            standard_covariance=covariance,
            base=mapping.to_base(self.standard),
            base_error=base_error,
            fitted=fitted,
            validation=validation,
            errors=errors,
            factors=ground.factors,
            determination=ground.determination,
            regressor_noise=ground.noise,
        )
        found = self._with_runs(found)
        found = replace(found, left_out=self._left_out(fitted))
        hidden = (mapping.K[:, ~found.at_bound] == 0).all(axis=1)  # sums of terms at bounds only
        return replace(found, base_error=np.where(hidden, np.inf, base_error))

    def _left_out(self, fitted: Sequence[Evaluation]) -> dict[str, Metrics]:
        """Return the metrics of each log by a fit to the others, with the same prior weight."""
        ground, own, mapping = self.ground, self.recordings, self.recordings.mapping
        if own.validation or len(ground.logs) < FEWEST_LEFT_OUT:
            return {}
        before, estimator = ground.before, make_estimator(self.choice, ground.before)
        if estimator.reads != "factors":
            return {}
        fit_to = estimator if self.in_cone is None else self.in_cone

        def fit(factors: Factors) -> tuple[Array, Array]:
            standard, _ = standard_of(fit_to.fit(factors), mapping, before.pi, before.spread)
            sigma, spread = before.sigma, before.spread
            return standard, urdf_with_drives(own.model, mapping, factors, sigma, spread)

        return left_out_metrics(own.model, ground.logs, fitted, fit)

    def _with_runs(self, fit: Fit) -> Fit:
        """Return the fit with the information of each log on parameters that may vary."""
        logs, own, mapping = self.ground.logs, self.recordings, self.recordings.mapping
        if len(logs) < FEWEST_RUNS:
            return fit
        sums = sums_of(own.model, mapping, logs, self.standard, self.ground.rough.sigma)
        noise, none = self.ground.noise, np.zeros(len(mapping.base_names))
        shift = noise.shift if noise is not None and noise.is_corrected else none
        sums = sums_with_zeros(sums, own, self.standard, shift)
        _, unit = np.unique([log.unit for log in own.fitted], return_inverse=True)
        runs = runs_of(own.model, mapping, self.standard, sums, unit)
        return replace(fit, sums=sums, runs=runs)

    def _measured(self) -> tuple[Estimate, Estimate, StandardErrors]:
        """Return the estimate and that of WLS with standard errors, and how these were found."""
        ground, fit, estimate = self.ground, self.in_cone, self.estimate
        factors, rough, mapping = ground.factors, ground.rough, ground.recordings.mapping
        segments, share, K = ground.segments, ground.before.share, mapping.K
        more = ground.more(rough.sigma)
        of_wls = None if ground.noise and self.weighing == "alike" else more  # of other weights
        wls, errors = measured_errors(rough, segments, factors, share, K, rough.sigma, more=of_wls)
        if self.weighing == "by step" and fit is None:
            estimate = with_wls_errors(estimate, wls)
        else:
            sigma = np.ones_like(rough.sigma) if self.weighing == "alike" else rough.sigma
            if estimate.names == mapping.names:
                sigma = estimate.sigma
            more = ground.more(sigma)
            ratio = 1.0 if fit is None else fit.weight_ratio
            is_filter = self.weighing == "by age"
            estimate, errors = measured_errors(
                estimate, segments, factors, share, K, sigma,
                is_filter=is_filter, weight_ratio=ratio, bounded=fit, more=more,
            )  # fmt: skip
        if (repeated := ground.recordings.repeated) is not None:
            errors = replace(errors, method=f"{errors.method}; {repeated.described}")
        if ground.grown != 1.0:
            estimate = replace(estimate, covariance=ground.grown * estimate.covariance)
            wls = replace(wls, covariance=ground.grown * wls.covariance)
        return estimate, wls, errors


def sums_of_logs(
    recordings: Recordings, choice: EstimatorSettings, standard: Array, sigma: Array, shift: Array
) -> RunSums:
    """Return the sums of logs that are not fitted, about the parameters of a fit to others.

    standard (p,), sigma (n,) [N m or N], shift (b,).
    """
    model, mapping = recordings.model, recordings.mapping
    if choice.is_robust:
        recordings, _ = reweigh(recordings, choice.loss, model.standard_parameters())
    logs = [
        [part.factors.without(shift) for part in parts if part.factors.rows.any()]
        for parts in recordings.reduce_logs()
    ]
    sums = sums_of(model, mapping, logs, standard, sigma)
    return sums_with_zeros(sums, recordings, standard, shift)


def _under_own_load(recordings: Recordings, choice: EstimatorSettings) -> Recordings:
    """Return recordings with the joint load torque of the bodies fitted to them.

    Least squares fits are iterated until the load torque has converged; the last step uses the
    estimator itself.
    """
    model, mapping = recordings.model, recordings.mapping
    if not is_loaded(model):
        return recordings
    choice = rough_choice(choice)
    own = replace(recordings, validation=())  # no predictions are needed here
    spread = None
    for step in range(_MOST_LOADS):
        ground = _ground(own, choice, is_last=False, spread=spread)
        before = ground.before
        spread = before.spread  # the same for any load
        standard, _ = standard_of(ground.rough, mapping, before.pi, before.spread)
        moved = standard - own.model.carried_by
        if step >= _DAMPED:  # friction that depends strongly on the load may overshoot
            standard = standard - 0.5 * moved
        loads = [_size_of(ground, x) for x in (moved, standard)]
        if (loads[0] <= _SETTLED * loads[1]).all():
            estimator = make_estimator(choice, before)
            if estimator.reads == "factors":
                estimate = estimator.fit(ground.factors)
                standard, _ = standard_of(estimate, mapping, before.pi, before.spread)
            recordings = replace(recordings, levels=ground.rough.sigma)
            return recordings.with_model(model.with_reference(standard))
        own = replace(own, levels=ground.rough.sigma).with_model(model.with_reference(standard))
    raise NotConvergedError(
        f"the joint load torque has not converged after {_MOST_LOADS} fits; set friction = "
        "'viscous+coulomb', or record a motion that excites more parameters",
        "max_iterations",
    )


def _size_of(ground: "_Ground", pi: Array) -> Array:
    """Return the norm of the torque of parameters over all rows of each joint, shape (n_rows,)."""
    factors, mapping = ground.factors, ground.recordings.mapping
    beta = mapping.to_base(pi)
    rows = zip(factors.triangles, factors.columns, strict=True)
    return np.array([float(np.linalg.norm(R[:, :-1] @ beta[own])) for R, own in rows])


@dataclass(frozen=True, eq=False)
class _Ground:
    """The input of every estimator."""

    recordings: Recordings  # rows weighted if the loss is robust
    whole: Reduction  # reduction of all fitted rows, base parameters
    before: Known  # the prior
    logs: tuple[tuple[Factors, ...], ...]  # segments of each log; none in intermediate fits
    rough: Estimate  # weighted least squares
    pinned: Array  # (p,), bool: fixed standard parameters
    grown: float  # factor of the covariance for a robust loss [-]
    noise: RegressorNoise | None = None  # effect of the position quantisation

    @property
    def factors(self) -> Factors:
        """The factors of all fitted rows."""
        return self.whole.factors

    @property
    def segments(self) -> tuple[Factors, ...]:
        """The factors of the segments of all logs."""
        return tuple(chain.from_iterable(self.logs))

    def more(self, sigma: Array) -> Array | None:
        """Return the covariance of the score in addition to the scatter, (b, b); None: 0."""
        if (repeated := self.recordings.repeated) is not None:  # all rows have one noise level
            return np.asarray(repeated.root @ repeated.root.T / sigma[-1] ** 4)
        return None if self.noise is None else self.noise.meat

    @cached_property
    def determination(self) -> Determination:
        """Which base parameters the rows determine."""
        before, factors, K = self.before, self.factors, self.recordings.mapping.K
        rows = factors.weighted(before.sigma / np.sqrt(before.share))[:, :-1]
        return determine(factors.names, rows, base_spread(K, before.spread, self.pinned))


def _ground(
    recordings: Recordings,
    choice: EstimatorSettings,
    *,
    is_last: bool,
    spread: Array | None = None,
) -> _Ground:
    """Reduce the rows, reweighted if the loss is robust, to the input of every estimator.

    The prior standard deviations, shape (p,), are computed if they are None.
    """
    model, mapping = recordings.model, recordings.mapping
    prior, understated = model.standard_parameters(), 1.0
    if choice.is_robust:
        recordings, understated = reweigh(recordings, choice.loss, prior)
    reductions = recordings.reduce_logs(is_cut=is_last)
    reduction = join(tuple(chain.from_iterable(reductions)))
    logs = tuple(
        tuple(part.factors for part in parts if part.factors.rows.any())
        for parts in (reductions if is_last else ())
    )
    factors, share = reduction.factors, recordings.share
    if spread is None:
        spread = prior_spread(model, reduction.squares, reduction.samples)
    rough = WLS(mapping.to_base(prior), share, recordings.levels).fit(factors)
    held_out = tuple(chain.from_iterable(logs)) or (factors,)
    errors = recordings.repeated
    repeated = 0.0 if errors is None else errors.variance / rough.sigma[-1] ** 2
    before = Known(model, mapping, prior, spread, share, rough.sigma, held_out, repeated)
    pinned = model.layout.owned_by(pinned_links(choice.bounds, model))
    return _Ground(recordings, reduction, before, logs, rough, pinned, understated**2)


def _without_regressor_noise(ground: _Ground, choice: EstimatorSettings) -> _Ground:
    """Return the input without the bias due to position quantisation.

    The term W shift is subtracted from the torque, so that every fit to the factors is corrected
    by the shift. For estimators that read samples the bias is counted as an error. Total least
    squares has a correction of its own.
    """
    if choice.allows_for_noise:
        return ground
    level, theta = ground.rough.sigma, ground.rough.theta
    sigma = np.ones_like(level) if choice.has_equal_weights else level
    noise = find_regressor_noise(ground.recordings, ground.whole, theta, sigma, level)
    if noise is None:
        return ground
    if isinstance(choice, RecursiveSettings):
        noise = noise.uncorrected(ground.factors.information(1.0 / sigma**2))
        return replace(ground, noise=noise)
    logs = tuple(tuple(part.without(noise.shift) for part in log) for log in ground.logs)
    return replace(
        ground,
        whole=replace(ground.whole, factors=ground.factors.without(noise.shift)),
        before=replace(ground.before, held_out=tuple(chain.from_iterable(logs))),
        logs=logs,
        rough=replace(ground.rough, theta=theta - noise.shift),
        noise=noise,
    )


def _run(
    choice: EstimatorSettings, ground: _Ground
) -> tuple[Estimate, Consistent | None, Weighing]:
    """Return the estimate, the estimator that made it consistent, if any, and the weighting."""
    recordings, before = ground.recordings, ground.before
    estimator = make_estimator(choice, before)
    if recordings.model.is_static and estimator.needs_mass:
        raise SettingsError(
            f"the estimator {choice.name!r} needs the mass matrix, which dynamics = 'static' does "
            "not identify; use another estimator, or set dynamics = 'full'"
        )
    if estimator.reads == "factors":
        in_cone = estimator if isinstance(estimator, Consistent) else None
        return estimator.fit(ground.factors), in_cone, estimator.weighing
    estimate = estimator.fit(recordings.problem(with_mass=estimator.needs_mass))
    if not (isinstance(choice, RecursiveSettings) and choice.physical):
        return estimate, None, estimator.weighing
    if estimator.weighing == "by step":
        estimate = with_wls_errors(estimate, ground.rough)
    fit = consistent_fit(choice, before)
    return fit.project(estimate), fit, estimator.weighing


def sums_with_zeros(
    sums: RunSums, recordings: Recordings, standard: Array, shift: Array
) -> RunSums:
    """Return the sums of logs with those over the rows of the zeros of the positions.

    The torque of a log whose positions are x too large is tau(q - x) = tau(q) - d tau / dq x. Logs
    in files, and robots with a floating base or constraints, have no such rows.

    standard (p,), shift (b,).
    """
    model, mapping = recordings.model, recordings.mapping
    groups = [group for group, _ in groups_at(model, mapping, standard)]
    z = sum(group.kind == "zero" for group in groups)
    if not (z and recordings.is_in_memory):
        return sums
    theta, parts = mapping.to_base(standard) + shift, []
    for k, log in enumerate(recordings.fitted):
        motion, start = log.whole.trajectory, 0
        slopes = body_slopes_by_position(model, standard, motion).reshape(-1, z)
        r, scale = np.empty((2, len(slopes)))
        for W, tau, weight in recordings.problem_of(k, motion).blocks():
            rows = slice(start, start + len(tau))
            scale[rows] = np.sqrt(weight) / np.resize(sums.sigma, len(tau))
            r[rows] = scale[rows] * (tau - W @ theta)
            start += len(tau)
        D = -scale[:, None] * slopes
        firsts = np.arange(0, start, recordings.segment_length(k) * model.n_rows)
        parts.append(np.array([np.add.reduceat(x, firsts) for x in (D**2, D * r[:, None])]))
    return with_zeros(sums, parts)


def urdf_with_drives(
    model: RobotModel, mapping: BaseMapping, factors: Factors, sigma: Array, spread: Array
) -> Array:
    """Return the URDF's inertial parameters with fitted drive terms, shape (p,).

    Weighted least squares of the drive terms d >= 0 (offsets of either sign) with the bodies' pi_I
    as in the URDF: min sum_j |R_j K_I pi_I + R_j K_D d - tau_j|^2 / sigma_j^2.

    sigma (n,) [N m or N], spread (p,).
    """
    from scipy.optimize import lsq_linear

    pi = model.standard_parameters()
    size = model.layout.n_inertial
    pi[size:] = 0.0
    if size == len(pi):
        return pi
    rows = factors.weighted(sigma)
    R, tau = rows[:, :-1], rows[:, -1]
    scale = spread[size:]
    lowest = np.where(model.layout.is_nonnegative()[size:], 0.0, -np.inf)
    X = R @ mapping.K[:, size:] * scale
    found = lsq_linear(X, tau - R @ mapping.to_base(pi), bounds=(lowest, np.inf), method="bvls")
    pi[size:] = scale * found.x
    return pi
