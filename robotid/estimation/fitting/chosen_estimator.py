"""The estimator that settings describe, for a robot and the prior of its parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.typing import Array
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Factors, gather
from robotid.estimation.estimators import (
    OLS,
    PRX,
    RLS,
    TLS,
    WLS,
    BatchEstimator,
    Consistent,
    Constraints,
    Kalman,
    NormalisedGradient,
    RecursiveEstimator,
)
from robotid.estimation.estimators.consistent_fit import (
    AS_GOOD,
    Segments,
    choose_weight,
    contradicted_extents,
    loss_of,
)
from robotid.estimation.fitting.estimator_settings import (
    BoundedSettings,
    ConsistentSettings,
    ConstraintSettings,
    EstimatorSettings,
    GradientSettings,
    KalmanSettings,
    OLSSettings,
    PRXSettings,
    RLSSettings,
    TLSSettings,
    WLSSettings,
)
from robotid.robot.bodies import held_parameters, negligible_bodies
from robotid.robot.geometry import body_boxes, geometry_half_spaces
from robotid.robot.model import RobotModel

_FOLDS = 6  # of the cross-validation, prior_weight = "cv"


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
        covariance: Array = KS @ KS.T
        return covariance


def make_estimator(
    choice: EstimatorSettings, known: Known
) -> BatchEstimator | RecursiveEstimator[Any]:
    """Return the estimator that reads rows or samples.

    Raises:
        SettingsError: If constraints contradict each other or do not match the robot, or the
            estimator reads a simulator.
    """
    share, sigma, beta = known.share, known.sigma, known.beta
    match choice:
        case OLSSettings():
            return OLS(independent_share=share)
        case WLSSettings():
            return WLS(independent_share=share)
        case TLSSettings():
            return TLS(choice.regressor_noise, independent_share=share)
        case ConsistentSettings():
            return consistent_fit(choice, known)
        case RLSSettings():
            # without forgetting the prior is not used: the result is that of batch least squares
            std = np.sqrt(np.diag(known.covariance)) if choice.forgetting < 1 else None
            return RLS(sigma, choice.forgetting, beta, std, share)
        case KalmanSettings():
            gate = None if choice.gate is False else float(choice.gate)
            return Kalman(sigma, beta, known.covariance, choice.walk, gate, share)
        case PRXSettings():
            return PRX(sigma, beta, rng=np.random.default_rng(0), step=choice.step)
        case GradientSettings():
            return NormalisedGradient(sigma, beta, rng=np.random.default_rng(0))
    raise SettingsError(f"{choice!r} describes no estimator of rows; use EstimatorSettings(name)")


def consistent_fit(settings: BoundedSettings, known: Known) -> Consistent:
    """Return the physically consistent estimator, which can also project an estimate."""
    bounds, weight, model = settings.bounds, settings.prior_weight, known.model
    geometry = geometry_half_spaces(model, bounds.com_within)
    extent = body_boxes(model) if bounds.extent == "box" else {}
    bounds = replace(bounds, pinned=pinned_links(bounds, model))
    fit = Consistent(
        layout=model.layout,
        K=known.mapping.K,
        prior=known.pi,
        prior_std=known.spread,
        held=held_parameters(model),
        prior_weight=1.0 if isinstance(weight, str) else weight,
        independent_share=known.share,
        constraints=make_constraints(bounds, geometry, extent),
        wls_noise=known.sigma,
    )
    folds = gather(known.held_out, _FOLDS)
    how = "" if not isinstance(weight, str) else "cv" if weight == "auto" else weight
    if how == "cv" and len(folds) < 2:
        how = ""
    if not extent and not how:
        return fit
    segments = Segments.of(fit, folds)
    if extent:
        beyond = contradicted_extents(fit, segments)
        if beyond:  # else the programme that is set up already remains
            fit = replace(fit, constraints=fit.constraints.without_extent(beyond))
    if not how:
        return fit
    choice = choose_weight(fit, segments, how, known.repeated)
    if fit.constraints.extent and choice.loss > AS_GOOD:
        unbound = replace(fit, constraints=fit.constraints.without_extent(fit.constraints.extent))
        if AS_GOOD * loss_of(unbound, segments, choice.weight) < choice.loss:
            fit, choice = unbound, choose_weight(unbound, segments, how, known.repeated)
    return replace(
        fit, prior_weight=choice.weight, plausible_weight=choice.plausible, choice=choice
    )


def pinned_links(bounds: ConstraintSettings, model: RobotModel) -> tuple[str, ...]:
    """Return the links that keep the URDF's values: those stated, and those of negligible mass."""
    bounded = {*bounds.pinned, *bounds.mass, *bounds.com}
    return (*bounds.pinned, *(x for x in negligible_bodies(model) if x not in bounded))


def make_constraints(
    bounds: ConstraintSettings,
    geometry: Mapping[str, tuple[Array, Array]],
    extent: Mapping[str, Array] = MappingProxyType({}),
) -> Constraints:
    """Return the constraints in the form that the estimator needs."""
    A = np.vstack([np.eye(3), -np.eye(3)])
    com, extents = dict(geometry), dict(extent)
    for name, (low, high) in bounds.boxes.items():
        com[name] = (A, np.concatenate([high, np.negative(low)]))
        if name in extents:  # a stated box enlarges the box of the geometry
            lower, upper = extents[name]
            extents[name] = np.array([np.minimum(lower, low), np.maximum(upper, high)])
    return Constraints(bounds.masses, bounds.total, com, tuple(bounds.pinned), extents)
