"""Fit of a robot's parameters to recordings: estimate, standard errors, predictions.

Rows are reduced to factors (``_ground``), the estimator solves them (``_run``), and the scatter of
the factors of segments gives the standard errors (``Solved``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, NotConvergedError, RankDeficientError, SettingsError
from robotid.base.tolerances import CONVERGED
from robotid.base.typing import Array
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Factors, Reduction, gather, join
from robotid.dynamics.torque import body_slopes_by_position, is_loaded
from robotid.estimation import estimators
from robotid.estimation.estimators import WLS, Consistent, Constraints, Estimate
from robotid.estimation.estimators.consistent_fit import (
    AS_GOOD,
    Segments,
    choose_weight,
    contradicted_extents,
    loss_of,
)
from robotid.estimation.estimators.determination import Determination, base_spread, determine
from robotid.estimation.estimators.estimator import Weighing
from robotid.estimation.fitting import estimator_settings as settings
from robotid.estimation.fitting.estimator_settings import (
    BoundedSettings,
    ConstraintSettings,
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
from robotid.robot.bodies import body_boxes, held_parameters, negligible_bodies
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

FOLDS = 6  # of the cross-validation, prior_weight = "cv"
MOST_LOADS = 20  # largest number of fits until the joint load torque has converged
_DAMPED = 3  # number of fits after which only half of each change is applied


@dataclass(frozen=True, eq=False)
class Known:
    """A robot and the prior of its parameters."""

    model: RobotModel
    mapping: BaseMapping  # standard to base parameters
    pi: Array  # (p,), standard parameters of the URDF
    spread: Array  # (p,), prior standard deviations
    share: float  # share of the rows that count as independent [-]
    sigma: Array  # (n,), noise level of each joint [N m or N]
    held_out: tuple[Factors, ...] = ()  # segments for choosing the weight and testing extents
    repeated: float = 0.0  # share of errors of points of contact in the squared residual [-]

    @property
    def beta(self) -> Array:
        """Base parameters of the URDF, shape (b,)."""
        return self.mapping.to_base(self.pi)

    @property
    def covariance(self) -> Array:
        """Prior covariance of the base parameters, shape (b, b)."""
        KS = self.mapping.K * self.spread
        return np.asarray(KS @ KS.T)

    def standard(self, estimate: Estimate) -> Array:
        """Standard parameters of an estimate, shape (p,)."""
        return standard_of(estimate, self.mapping, self.pi, self.spread)[0]


def make_estimator(
    choice: EstimatorSettings, known: Known
) -> estimators.BatchEstimator | estimators.RecursiveEstimator[Any]:
    """Return the estimator that settings describe, for a robot and the prior of its parameters."""
    share, sigma, beta = known.share, known.sigma, known.beta
    match choice:
        case settings.OLSSettings():
            return estimators.OLS(independent_share=share)
        case settings.WLSSettings():
            return WLS(independent_share=share)
        case settings.TLSSettings():
            return estimators.TLS(choice.regressor_noise, independent_share=share)
        case settings.ConsistentSettings():
            return consistent_fit(choice, known)
        case settings.RLSSettings():
            # without forgetting the prior is not used: the result is that of batch least squares
            std = np.sqrt(np.diag(known.covariance)) if choice.forgetting < 1 else None
            return estimators.RLS(sigma, choice.forgetting, beta, std, share)
        case settings.KalmanSettings():
            gate = None if choice.gate is False else float(choice.gate)
            return estimators.Kalman(sigma, beta, known.covariance, choice.walk, gate, share)
        case settings.PRXSettings():
            return estimators.PRX(sigma, beta, rng=np.random.default_rng(0))
        case settings.GradientSettings():
            return estimators.NormalisedGradient(sigma, beta, rng=np.random.default_rng(0))
    raise SettingsError(f"{choice!r} describes no estimator of rows; use EstimatorSettings(name)")


def consistent_fit(choice: BoundedSettings, known: Known) -> Consistent:
    """Return the physically consistent estimator, which can also project an estimate."""
    bounds, stated, model = choice.bounds, choice.prior_weight, known.model
    extent = body_boxes(model) if bounds.extent == "box" else {}
    bounds = replace(bounds, pinned=pinned_links(bounds, model))
    fit = Consistent(
        layout=model.layout, K=known.mapping.K, prior=known.pi, prior_std=known.spread,
        held=held_parameters(model), prior_weight=1.0 if isinstance(stated, str) else stated,
        independent_share=known.share, constraints=make_constraints(bounds, extent),
        wls_noise=known.sigma,
    )  # fmt: skip
    folds = gather(known.held_out, FOLDS)
    how = {"auto": "cv"}.get(stated, stated) if isinstance(stated, str) else ""
    if how == "cv" and len(folds) < 2:
        how = ""
    if not extent and not how:
        return fit
    segments = Segments.of(fit, folds)
    if extent and (beyond := contradicted_extents(fit, segments)):
        fit = fit.without_extent(beyond)
    if not how:
        return fit
    weight = choose_weight(fit, segments, how, known.repeated)
    if fit.constraints.extent and weight.loss > AS_GOOD:
        unbound = fit.without_extent(fit.constraints.extent)
        if AS_GOOD * loss_of(unbound, segments, weight.weight) < weight.loss:
            fit, weight = unbound, choose_weight(unbound, segments, how, known.repeated)
    return replace(
        fit, prior_weight=weight.weight, plausible_weight=weight.plausible, choice=weight
    )


def pinned_links(bounds: ConstraintSettings, model: RobotModel) -> tuple[str, ...]:
    """Return the links that keep the URDF's values: those stated, and those of negligible mass."""
    bounded = {*bounds.pinned, *bounds.mass, *bounds.com}
    return (*bounds.pinned, *(x for x in negligible_bodies(model) if x not in bounded))


def pinned_joints(bounds: ConstraintSettings, model: RobotModel) -> tuple[str, ...]:
    """Return the joints whose own links keep the prior's values."""
    links = pinned_links(bounds, model)
    return tuple(joint.name for joint in model.tree.movable if joint.child in links)


def make_constraints(bounds: ConstraintSettings, extent: Mapping[str, Array]) -> Constraints:
    """Return the constraints in the form that the estimator needs."""
    A, com, extents = np.vstack([np.eye(3), -np.eye(3)]), {}, dict(extent)
    for name, (low, high) in bounds.boxes.items():
        com[name] = (A, np.concatenate([high, np.negative(low)]))
        if name in extents:  # a stated box enlarges the box of the geometry
            lower, upper = extents[name]
            extents[name] = np.array([np.minimum(lower, low), np.maximum(upper, high)])
    return Constraints(bounds.masses, bounds.total, com, tuple(bounds.pinned), extents)


def rough_choice(choice: EstimatorSettings) -> EstimatorSettings:
    """Return faster settings of the estimator, for fits whose residual only is used."""
    if not isinstance(choice, BoundedSettings) or not isinstance(choice.prior_weight, str):
        return choice
    return replace(choice, prior_weight=1.0)


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
    standard = ground.before.standard(estimate)
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
        logs = self.recordings
        fitted, validation = evaluate_logs(logs.fitted, logs.validation, {}, None, plan=logs.plan)
        return Solution(
            model=logs.model, mapping=logs.mapping, prior_std=self.prior_std,
            standard=self.standard, fitted=fitted, validation=validation,
        )  # fmt: skip

    def with_errors(self) -> Fit:
        """Return the fit: the parameters with their standard errors and predictions."""
        ground, logs, before = self.ground, self.recordings, self.ground.before
        mapping, K = logs.mapping, logs.mapping.K
        estimate, wls, errors = self._measured(ground)
        _, covariance = standard_of(estimate, mapping, before.pi, before.spread)
        repeated: Array | float = 0.0
        if logs.repeated is not None:
            alone = self._measured(replace(ground, recordings=replace(logs, repeated=None)))[0]
            repeated = covariance - standard_of(alone, mapping, before.pi, before.spread)[1]
        driven = urdf_with_drives(logs.model, mapping, ground.factors, before.sigma, before.spread)
        fitted, validation = evaluate_logs(
            logs.fitted, logs.validation,
            {"estimate": self.standard, "wls": before.standard(wls)},
            before.pi, driven, plan=logs.plan,
        )  # fmt: skip
        base_error = estimate.std_error
        if estimate.names != mapping.base_names:
            variance = np.einsum("bi,ij,bj->b", K, covariance, K)
            base_error = np.sqrt(np.maximum(variance, 0.0))
        sums = self._sums()
        _, unit = np.unique([log.unit for log in logs.fitted], return_inverse=True)
        fit = Fit(
            model=logs.model, mapping=mapping, estimator=self.choice, estimate=estimate, wls=wls,
            prior=before.pi, urdf_with_drives=driven, prior_std=self.prior_std,
            standard=self.standard, standard_covariance=covariance, repeated=repeated,
            base=mapping.to_base(self.standard), base_error=base_error,
            fitted=fitted, validation=validation, errors=errors, factors=ground.factors,
            determination=ground.determination, regressor_noise=ground.noise, sums=sums,
            runs=() if sums is None else runs_of(logs.model, mapping, self.standard, sums, unit),
            left_out=self._left_out(fitted),
        )  # fmt: skip
        is_hidden = (K[:, ~fit.at_bound] == 0).all(axis=1)  # sums of terms at bounds only
        return replace(fit, base_error=np.where(is_hidden, np.inf, base_error))

    def _left_out(self, fitted: Sequence[Evaluation]) -> dict[str, Metrics]:
        """Return the metrics of each log by a fit to the others, with the same prior weight."""
        ground, model, before = self.ground, self.recordings.model, self.ground.before
        if self.recordings.validation or len(ground.logs) < FEWEST_LEFT_OUT:
            return {}
        estimator = self.in_cone or make_estimator(self.choice, before)
        if estimator.reads != "factors" or isinstance(self.choice, RecursiveSettings):
            return {}

        def fit(factors: Factors) -> tuple[Array, Array]:
            sigma, spread = before.sigma, before.spread
            driven = urdf_with_drives(model, before.mapping, factors, sigma, spread)
            return before.standard(estimator.fit(factors)), driven

        return left_out_metrics(model, ground.logs, fitted, fit)

    def _sums(self) -> RunSums | None:
        """Return the information of each log on parameters that may vary; None for few logs."""
        ground = self.ground
        if len(ground.logs) < FEWEST_RUNS:
            return None
        noise, shift = ground.noise, np.zeros(len(ground.rough.theta))
        if noise is not None and noise.is_corrected:
            shift = noise.shift
        sigma = ground.rough.sigma
        return run_sums(self.recordings, ground.logs, self.standard, sigma, shift)

    def _measured(self, ground: "_Ground") -> tuple[Estimate, Estimate, StandardErrors]:
        """Return the estimate and that of WLS with standard errors, and how these were found."""
        fit, estimate = self.in_cone, self.estimate
        rough, mapping = ground.rough, ground.recordings.mapping
        rows = ground.segments, ground.factors, ground.before.share, mapping.K
        are_alike = self.weighing == "alike"
        of_wls = None if ground.noise and are_alike else ground.more(rough.sigma)  # other weights
        wls, errors = measured_errors(rough, *rows, rough.sigma, more=of_wls)
        if self.weighing == "by step" and fit is None:
            estimate = with_wls_errors(estimate, wls)
        else:
            sigma = np.ones_like(rough.sigma) if are_alike else rough.sigma
            if estimate.names == mapping.names:
                sigma = estimate.sigma
            estimate, errors = measured_errors(
                estimate, *rows, sigma, is_filter=self.weighing == "by age",
                weight_ratio=1.0 if fit is None else fit.weight_ratio, bounded=fit,
                more=ground.more(sigma),
            )  # fmt: skip
        if (repeated := ground.recordings.repeated) is not None:
            errors = replace(errors, method=f"{errors.method}; {repeated.described}")
        if ground.grown != 1.0:
            estimate = replace(estimate, covariance=ground.grown * estimate.covariance)
            wls = replace(wls, covariance=ground.grown * wls.covariance)
        return estimate, wls, errors


def _under_own_load(recordings: Recordings, choice: EstimatorSettings) -> Recordings:
    """Return recordings with the load torque of the bodies that least squares fit to them."""
    if not is_loaded(recordings.model):
        return recordings
    choice = rough_choice(choice)
    trial, spread = replace(recordings, validation=()), None  # no predictions are needed here
    for step in range(MOST_LOADS):
        ground = _ground(trial, choice, is_last=False, spread=spread)
        before, levels = ground.before, ground.rough.sigma
        spread = before.spread  # the same for any load
        standard = before.standard(ground.rough)
        moved = standard - trial.model.carried_by
        if step >= _DAMPED:  # friction that depends strongly on the load may overshoot
            standard = standard - 0.5 * moved
        changes, torques = (_torque_norms(ground, x) for x in (moved, standard))
        if (changes <= CONVERGED * torques).all():
            estimator = make_estimator(choice, before)
            if estimator.reads == "factors":
                standard = before.standard(estimator.fit(ground.factors))
            recordings = replace(recordings, levels=levels)
            return recordings.with_model(recordings.model.with_reference(standard))
        trial = replace(trial, levels=levels).with_model(trial.model.with_reference(standard))
    raise NotConvergedError(
        f"the joint load torque has not converged after {MOST_LOADS} fits; set friction = "
        "'viscous+coulomb', or record a motion that excites more parameters",
        "max_iterations",
    )


def _torque_norms(ground: "_Ground", pi: Array) -> Array:
    """Return the norm of the torque of parameters over all rows of each joint, shape (n_rows,)."""
    beta = ground.before.mapping.to_base(pi)
    rows = zip(ground.factors.triangles, ground.factors.columns, strict=True)
    return np.array([float(np.linalg.norm(R[:, :-1] @ beta[columns])) for R, columns in rows])


@dataclass(frozen=True, eq=False)
class _Ground:
    """The input of every estimator."""

    recordings: Recordings  # rows weighted if the loss is robust
    reduction: Reduction  # of all fitted rows, base parameters
    before: Known  # the prior
    logs: tuple[tuple[Factors, ...], ...]  # segments of each log; none in intermediate fits
    rough: Estimate  # weighted least squares
    pinned: Array  # (p,), bool: fixed standard parameters
    grown: float  # factor of the covariance for a robust loss [-]
    noise: RegressorNoise | None = None  # effect of the position quantisation

    @property
    def factors(self) -> Factors:
        """The factors of all fitted rows."""
        return self.reduction.factors

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
        before, factors = self.before, self.factors
        rows = factors.weighted(before.sigma / np.sqrt(before.share))[:, :-1]
        spread = base_spread(before.mapping.K, before.spread, self.pinned)
        return determine(factors.names, rows, spread)


def _ground(
    recordings: Recordings,
    choice: EstimatorSettings,
    *,
    is_last: bool,
    spread: Array | None = None,  # (p,), prior standard deviations if they are known
) -> _Ground:
    """Reduce the rows, reweighted if the loss is robust, to the input of every estimator."""
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
    if factors.rows.any() and not any(R[:, -1].any() for R in factors.triangles):
        raise DataError(
            "the torque of every joint is 0 in all fitted logs, which identifies nothing; check "
            "which columns have the torques, and whether the drives were on"
        )
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
    """Return the input with the bias by position quantisation, W shift, subtracted from tau."""
    # For estimators that read samples the bias is counted as an error.
    if isinstance(choice, settings.TLSSettings):
        return ground
    level, theta = ground.rough.sigma, ground.rough.theta
    sigma = np.ones_like(level) if isinstance(choice, settings.OLSSettings) else level
    noise = find_regressor_noise(ground.recordings, ground.reduction, theta, sigma, level)
    if noise is None:
        return ground
    if isinstance(choice, RecursiveSettings):
        noise = noise.uncorrected(ground.factors.information(1.0 / sigma**2))
        return replace(ground, noise=noise)
    logs = tuple(tuple(part.without(noise.shift) for part in log) for log in ground.logs)
    return replace(
        ground, logs=logs, noise=noise,
        reduction=replace(ground.reduction, factors=ground.factors.without(noise.shift)),
        before=replace(ground.before, held_out=tuple(chain.from_iterable(logs))),
        rough=replace(ground.rough, theta=theta - noise.shift),
    )  # fmt: skip


def _run(
    choice: EstimatorSettings, ground: _Ground
) -> tuple[Estimate, Consistent | None, Weighing]:
    """Return the estimate, the estimator that made it consistent, if any, and the weighting."""
    before = ground.before
    estimator = make_estimator(choice, before)
    if estimator.reads == "factors":
        in_cone = estimator if isinstance(estimator, Consistent) else None
        return estimator.fit(ground.factors), in_cone, estimator.weighing
    estimate = estimator.fit(ground.recordings.problem())
    if not (isinstance(choice, RecursiveSettings) and choice.physical):
        return estimate, None, estimator.weighing
    if estimator.weighing == "by step":
        estimate = with_wls_errors(estimate, ground.rough)
    fit = consistent_fit(choice, before)
    return fit.project(estimate), fit, estimator.weighing


def sums_of_logs(
    recordings: Recordings, choice: EstimatorSettings, standard: Array, sigma: Array, shift: Array
) -> RunSums:
    """Return the sums of logs that are not fitted, about the parameters of a fit to others."""
    if choice.is_robust:
        recordings, _ = reweigh(recordings, choice.loss, recordings.model.standard_parameters())
    logs = [
        [part.factors.without(shift) for part in parts if part.factors.rows.any()]
        for parts in recordings.reduce_logs()
    ]
    return run_sums(recordings, logs, standard, sigma, shift)


def run_sums(
    recordings: Recordings,
    logs: Sequence[Sequence[Factors]],  # segments of each log, without the shift
    standard: Array,  # (p,)
    sigma: Array,  # (n,) [N m or N]
    shift: Array,  # (b,)
) -> RunSums:
    """Return the sums of logs, with those over the rows of the zeros of the positions.

    A log whose positions are x too large has the torque tau(q - x) = tau(q) - d tau / dq x. Logs in
    files, and robots with a floating base or constraints, have no such rows.
    """
    model, mapping = recordings.model, recordings.mapping
    sums = sums_of(model, mapping, logs, standard, sigma)
    z = sum(group.kind == "zero" for group, _ in groups_at(model, mapping, standard))
    if not (z and recordings.is_in_memory):
        return sums
    theta, parts = mapping.to_base(standard) + shift, []
    for k, log in enumerate(recordings.fitted):
        motion, start = log.whole.trajectory, 0
        slopes = body_slopes_by_position(model, standard, motion).reshape(-1, z)
        r, scale = np.empty((2, len(slopes)))
        for W, tau, weight in recordings.problem_of(k, motion).blocks():
            rows = slice(start, start + len(tau))
            scale[rows] = np.sqrt(weight) / np.resize(sigma, len(tau))
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

    Weighted least squares of drive terms d >= 0 (offsets of either sign), bodies pi_I as in the
    URDF: min sum_j |R_j K_I pi_I + R_j K_D d - tau_j|^2 / sigma_j^2.
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
    solution = lsq_linear(X, tau - R @ mapping.to_base(pi), bounds=(lowest, np.inf), method="bvls")
    pi[size:] = scale * solution.x
    return pi
