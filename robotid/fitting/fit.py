"""Recordings of a robot and the estimator asked for -> Fit: its errors, and what it predicts."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robotid._typing import Array
from robotid.estimators import WLS, Consistent, Estimate
from robotid.estimators.determination import Determination, base_spread, determine
from robotid.estimators.estimator import Weighing
from robotid.exceptions import NotConvergedError, RankDeficientError, SettingsError
from robotid.fitting.baselines import urdf_with_drives
from robotid.fitting.estimators import Known, consistent_fit
from robotid.fitting.evaluation import evaluate_logs
from robotid.fitting.recordings import Recordings
from robotid.fitting.regressor_noise import RegressorNoise, find_regressor_noise
from robotid.fitting.result import Fit, Solution
from robotid.fitting.robust import reweigh
from robotid.fitting.settings import (
    BoundedSettings,
    EstimatorSettings,
    RecursiveSettings,
)
from robotid.fitting.standard_errors import (
    Redraws,
    StandardErrors,
    measured_errors,
    standard_of,
    with_wls_errors,
)
from robotid.regressor.factors import Factors, Reduction, join
from robotid.regressor.memory import is_loaded
from robotid.robot.prior import prior_spread

__all__ = ["Solved", "fit_recordings", "rough_choice", "solve_recordings"]

_MOST_LOADS = 20  # fits until the load of the gears is that of the bodies found
_DAMPED = 3  # of them, after which they go half way only
_SETTLED = 1e-3  # of the torque, by which they may still move it


def rough_choice(choice: EstimatorSettings) -> EstimatorSettings:
    """Return the estimator without what takes long and moves a fit's residual little.

    Args:
        choice: The estimator asked for.
    """
    if not isinstance(choice, BoundedSettings):
        return choice
    weight = 1.0 if isinstance(choice.prior_weight, str) else choice.prior_weight
    return replace(choice, prior_weight=weight, draws=0)


def fit_recordings(recordings: Recordings, choice: EstimatorSettings) -> Fit:
    """Return the fit of a robot's parameters to recordings.

    Args:
        recordings: The recordings.
        choice: Which estimator.

    Raises:
        DataError: If a row of a log cannot be used.
        RankDeficientError: If "ols" or "wls" is asked for and the data leave parameters open.
        NotConvergedError: If a solver fails.
    """
    return solve_recordings(recordings, choice).with_errors()


def solve_recordings(
    recordings: Recordings, choice: EstimatorSettings, *, is_last: bool = True
) -> "Solved":
    """Return the parameters of a robot that fit recordings, their errors not yet measured.

    Args:
        recordings: The recordings.
        choice: Which estimator.
        is_last: Whether the bias by the steps of the positions is taken off, and bounds that the
            data contradict are judged by held-out segments; not for fits in between.

    Raises:
        DataError, RankDeficientError, NotConvergedError: As of ``fit_recordings``.
    """
    recordings = _under_own_load(recordings, choice)
    ground = _ground(recordings, choice, is_last=is_last)
    if is_last:
        ground = _without_regressor_noise(ground, choice)
    try:
        estimate, in_cone, weighing = _run(choice, ground)
    except RankDeficientError as error:
        raise ground.determination.refusal(error) from error
    standard, _ = standard_of(estimate, recordings.mapping, ground.before.pi, ground.before.spread)
    if recordings.model.layout.remembering:  # what is written predicts the torque by its own load
        recordings = recordings.with_model(recordings.model.with_reference(standard))
    return Solved(choice, ground, recordings, estimate, in_cone, weighing, standard)


@dataclass(frozen=True, eq=False)
class Solved:
    """Parameters that fit recordings, and what their errors are measured by."""

    choice: EstimatorSettings
    ground: "_Ground"
    recordings: Recordings  # loaded by the bodies found
    estimate: Estimate
    in_cone: Consistent | None  # what made it physically consistent, if it is
    weighing: Weighing
    standard: Array  # (p,), standard parameters

    @property
    def prior_std(self) -> Array:
        """How far parameters may plausibly be wrong before the data, shape (p,)."""
        of_estimate = self.estimate.prior_std
        return self.ground.before.spread if of_estimate is None else of_estimate

    @cached_property
    def solution(self) -> Solution:
        """The parameters, with the recordings that drives are judged by."""
        own = self.recordings
        fitted, kept = evaluate_logs(own.fitted, own.kept, {}, None, plan=own.plan)
        return Solution(
            model=own.model,
            mapping=own.mapping,
            prior_std=self.prior_std,
            standard=self.standard,
            fitted=fitted,
            validation=kept,
        )

    def with_errors(self) -> Fit:
        """Return the fit: the parameters with their measured errors, and what they predict."""
        ground, recordings = self.ground, self.recordings
        model, mapping, before = recordings.model, recordings.mapping, ground.before
        estimate, wls, errors = self._measured()
        _, covariance = standard_of(estimate, mapping, before.pi, before.spread)
        base_variance = np.einsum("bi,ij,bj->b", mapping.K, covariance, mapping.K)
        wls_standard = mapping.to_standard(wls.theta, before.pi, before.spread)
        driven = urdf_with_drives(model, mapping, ground.factors, before.sigma, before.spread)
        fitted, kept = evaluate_logs(
            recordings.fitted, recordings.kept, {"estimate": self.standard, "wls": wls_standard},
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
            validation=kept,
            errors=errors,
            factors=ground.factors,
            determination=ground.determination,
            regressor_noise=ground.noise,
        )
        hidden = (mapping.K[:, ~found.at_bound] == 0).all(axis=1)  # nothing but terms at bounds
        return replace(found, base_error=np.where(hidden, np.inf, base_error))

    def _measured(self) -> tuple[Estimate, Estimate, StandardErrors]:
        """Return the estimate and that of WLS with measured standard errors, and their ground."""
        ground, choice, fit, estimate = self.ground, self.choice, self.in_cone, self.estimate
        factors, rough, mapping = ground.factors, ground.rough, ground.recordings.mapping
        segments, share, K = ground.segments, ground.before.share, mapping.K
        more = None if ground.noise is None else ground.noise.meat
        of_wls = more if self.weighing != "alike" else None  # which is of other weights
        wls, errors = measured_errors(rough, segments, factors, share, K, rough.sigma, more=of_wls)
        if self.weighing == "by step" and fit is None:
            estimate = with_wls_errors(estimate, wls)
        else:
            sigma = np.ones_like(rough.sigma) if self.weighing == "alike" else rough.sigma
            if estimate.names == mapping.names:
                sigma = estimate.sigma
            redraws, pull = None, 1.0  # of what no bound can bind
            if fit is not None and isinstance(choice, BoundedSettings):
                redraws, pull = Redraws(fit, choice.draws, np.random.default_rng(0)), fit.pull
            is_filter = self.weighing == "by age"
            estimate, errors = measured_errors(
                estimate, segments, factors, share, K, sigma,
                is_filter=is_filter, pull=pull, redraws=redraws, more=more,
            )  # fmt: skip
        if ground.grown != 1.0:
            estimate = replace(estimate, covariance=ground.grown * estimate.covariance)
            wls = replace(wls, covariance=ground.grown * wls.covariance)
        return estimate, wls, errors


def _under_own_load(recordings: Recordings, choice: EstimatorSettings) -> Recordings:
    """Return recordings whose drives are loaded by the bodies that the fit to them gives.

    Least squares are iterated until their torque is the load; the estimator takes the last step.
    """
    model, mapping = recordings.model, recordings.mapping
    if not is_loaded(model):
        return recordings
    choice = rough_choice(choice)
    own = replace(recordings, kept=())  # nothing is predicted meanwhile
    for step in range(_MOST_LOADS):
        ground = _ground(own, choice, is_last=False)
        before = ground.before
        standard, _ = standard_of(ground.rough, mapping, before.pi, before.spread)
        moved = standard - own.model.carried_by
        if step >= _DAMPED:  # friction that takes a large share of the load may overshoot
            standard = standard - 0.5 * moved
        loads = [_size_of(ground, x) for x in (moved, standard)]
        if (loads[0] <= _SETTLED * loads[1]).all():
            estimator = choice.make(before)
            if estimator.reads == "factors":
                estimate = estimator.fit(ground.factors)
                standard, _ = standard_of(estimate, mapping, before.pi, before.spread)
            return recordings.with_model(model.with_reference(standard))
        own = own.with_model(model.with_reference(standard))
    raise NotConvergedError(
        f"the load of the gears still changes after {_MOST_LOADS} fits; use friction = "
        "'viscous+coulomb', or record motion that determines more",
        "max_iterations",
    )


def _size_of(ground: "_Ground", pi: Array) -> Array:
    """Return the root mean square of the torque of parameters in each row, shape (n_rows,)."""
    factors, mapping = ground.factors, ground.recordings.mapping
    beta = mapping.to_base(pi)
    rows = zip(factors.triangles, factors.columns, strict=True)
    return np.array([float(np.linalg.norm(R[:, :-1] @ beta[own])) for R, own in rows])


@dataclass(frozen=True, eq=False)
class _Ground:
    """What every estimator stands on."""

    recordings: Recordings  # their rows weighted if a robust loss was asked for
    whole: Reduction  # what all fitted rows come down to, base parameters
    before: Known  # without them
    segments: tuple[Factors, ...]  # those of segments of the logs; none of a fit in between
    rough: Estimate  # weighted least squares on them
    pinned: Array  # (p,), bool: standard parameters that are known
    grown: float  # by how much a robust loss widens the covariance [-]
    noise: RegressorNoise | None = None  # what the steps of the positions do

    @property
    def factors(self) -> Factors:
        """The factors of all fitted rows."""
        return self.whole.factors

    @cached_property
    def determination(self) -> Determination:
        """Which base parameters the rows determine."""
        before, factors, K = self.before, self.factors, self.recordings.mapping.K
        rows = factors.weighted(before.sigma / np.sqrt(before.share))[:, :-1]
        return determine(factors.names, rows, base_spread(K, before.spread, self.pinned))


def _ground(recordings: Recordings, choice: EstimatorSettings, *, is_last: bool) -> _Ground:
    """Reduce the rows, with a robust loss reweighted, to what every estimator stands on."""
    model, mapping = recordings.model, recordings.mapping
    prior, understated = model.standard_parameters(), 1.0
    if choice.is_robust:
        recordings, understated = reweigh(recordings, choice.loss, prior)
    reductions = recordings.reduce(is_cut=is_last)
    reduction = join(reductions)
    parts = reductions if is_last else ()
    segments = tuple(part.factors for part in parts if part.factors.rows.any())
    factors, share = reduction.factors, recordings.share
    spread = prior_spread(model, reduction.squares, reduction.samples)
    rough = WLS(prior=mapping.to_base(prior), independent_share=share).fit(factors)
    held_out = segments or (factors,)
    before = Known(model, mapping, prior, spread, share, rough.sigma, held_out)
    pinned = model.layout.owned_by(choice.bounds.pinned)
    return _Ground(recordings, reduction, before, segments, rough, pinned, understated**2)


def _without_regressor_noise(ground: _Ground, choice: EstimatorSettings) -> _Ground:
    """Return the ground without the bias that the steps of the positions make.

    The torque loses what least squares find of it by that bias, W shift, so that every fit to the
    factors finds as much less. Estimators that read samples keep the bias as an error. Total least
    squares have a correction of their own.
    """
    if choice.allows_for_noise:
        return ground
    level, theta = ground.rough.sigma, ground.rough.theta
    sigma = np.ones_like(level) if choice.weighs_alike else level
    noise = find_regressor_noise(ground.recordings, ground.whole, theta, sigma, level)
    if noise is None:
        return ground
    if isinstance(choice, RecursiveSettings):
        noise = noise.uncorrected(ground.factors.information(1.0 / sigma**2))
        return replace(ground, noise=noise)
    segments = tuple(part.without(noise.shift) for part in ground.segments)
    return replace(
        ground,
        whole=replace(ground.whole, factors=ground.factors.without(noise.shift)),
        before=replace(ground.before, held_out=segments),
        segments=segments,
        rough=replace(ground.rough, theta=theta - noise.shift),
        noise=noise,
    )


def _run(
    choice: EstimatorSettings, ground: _Ground
) -> tuple[Estimate, Consistent | None, Weighing]:
    """Return the estimate, what made it physically consistent if it is, and how rows weighed."""
    recordings, before = ground.recordings, ground.before
    estimator = choice.make(before)
    if recordings.model.is_static and estimator.needs_mass:
        raise SettingsError(
            f"the estimator {choice.name!r} needs the mass matrix, which dynamics = 'static' does "
            "not identify; choose another one, or dynamics = 'full'"
        )
    if estimator.reads == "factors":
        return estimator.fit(ground.factors), estimator.in_cone, estimator.weighing
    estimate = estimator.fit(recordings.problem(with_mass=estimator.needs_mass))
    if not (isinstance(choice, RecursiveSettings) and choice.physical):
        return estimate, None, estimator.weighing
    if estimator.weighing == "by step":
        estimate = with_wls_errors(estimate, ground.rough)
    fit = consistent_fit(choice, before)
    return fit.project(estimate), fit, estimator.weighing
