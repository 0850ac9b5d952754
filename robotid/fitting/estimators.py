"""The estimator that settings describe, made for a robot and what is known of it before."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.estimators import (
    OLS,
    PRX,
    RLS,
    TLS,
    WLS,
    BatchEstimator,
    Consistent,
    Constraints,
    Kalman,
    LogCholesky,
    NormalisedGradient,
    RecursiveEstimator,
)
from robotid.estimators.consistent.weighting import Segments, choose_weight, contradicted_extents
from robotid.exceptions import SettingsError
from robotid.fitting.settings import (
    BoundedSettings,
    ConsistentSettings,
    ConstraintSettings,
    EstimatorSettings,
    GradientSettings,
    KalmanSettings,
    LogCholeskySettings,
    OLSSettings,
    PRXSettings,
    RLSSettings,
    TLSSettings,
    WLSSettings,
)
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.factors import Factors, gather
from robotid.robot.bodies import held_parameters
from robotid.robot.geometry import body_boxes, geometry_half_spaces
from robotid.robot.model import RobotModel

__all__ = ["Known", "consistent_fit", "make_constraints", "make_estimator"]

_FOLDS = 6  # held out in turn by prior_weight = "cv"


@dataclass(frozen=True, eq=False)
class Known:
    """What is known before the data."""

    pi: Array  # (p,), standard parameters of the URDF
    spread: Array  # (p,), how far they may plausibly be wrong
    share: float  # share of the rows that count as independent [-]
    sigma: Array  # (n,), noise level of each joint [N m or N]
    held_out: tuple[Factors, ...] = ()  # segments to judge weight and extents by


def make_estimator(
    settings: EstimatorSettings, model: RobotModel, mapping: BaseMapping, prior: Known
) -> BatchEstimator | RecursiveEstimator[Any]:
    """Return the estimator that settings describe.

    Args:
        settings: The settings.
        model: The robot.
        mapping: Standard to base parameters.
        prior: What is known before the data.

    Raises:
        SettingsError: If constraints contradict each other or do not fit the robot.
    """
    share, sigma, beta = prior.share, prior.sigma, mapping.to_base(prior.pi)
    KS = mapping.K * prior.spread
    C = KS @ KS.T  # (b, b), of the base parameters before the data
    match settings:
        case OLSSettings():
            return OLS(independent_share=share)
        case WLSSettings():
            return WLS(independent_share=share)
        case TLSSettings():
            return TLS(settings.regressor_noise, independent_share=share)
        case LogCholeskySettings():
            fit = consistent_fit(settings, model, mapping, prior)
            rng = np.random.default_rng(settings.seed)
            return LogCholesky(fit, starts=settings.starts, rng=rng)
        case ConsistentSettings():
            return consistent_fit(settings, model, mapping, prior)
        case RLSSettings():
            # without forgetting nothing of the prior enters: batch least squares
            std = np.sqrt(np.diag(C)) if settings.forgetting < 1 else None
            return RLS(sigma, settings.forgetting, beta, std, share)
        case KalmanSettings():
            gate = None if settings.gate is False else float(settings.gate)
            return Kalman(sigma, beta, C, settings.walk, gate, share)
        case PRXSettings() | GradientSettings():
            common: dict[str, Any] = {
                "average": settings.average,
                "passes": settings.passes,
                "rng": np.random.default_rng(settings.seed) if settings.seed >= 0 else None,
            }
            if isinstance(settings, GradientSettings):
                return NormalisedGradient(sigma, beta, step_size=settings.step_size, **common)
            return PRX(sigma, beta, step=settings.step, metric=settings.metric, **common)
    raise SettingsError(f"{settings!r} describes no estimator; take EstimatorSettings(name)")


def consistent_fit(
    settings: BoundedSettings, model: RobotModel, mapping: BaseMapping, prior: Known
) -> Consistent:
    """Return the physically consistent estimator, which also projects.

    Args:
        settings: The settings.
        model: The robot.
        mapping: Standard to base parameters.
        prior: What is known before the data.

    Raises:
        SettingsError: If constraints contradict each other or do not fit the robot.
    """
    bounds, weight = settings.bounds, settings.prior_weight
    geometry = geometry_half_spaces(model, bounds.com_within)
    extent = body_boxes(model) if bounds.extent == "box" else {}
    fit = Consistent(
        layout=model.layout,
        K=mapping.K,
        prior=prior.pi,
        prior_std=prior.spread,
        held=held_parameters(model),
        margin=settings.margin,
        prior_weight=1.0 if isinstance(weight, str) else weight,
        independent_share=prior.share,
        metric=settings.prior,
        constraints=make_constraints(bounds, geometry, extent),
        solver=settings.solver,
        check=settings.check,
        wls_noise=prior.sigma,
    )
    folds = gather(prior.held_out, _FOLDS)
    how = "" if not isinstance(weight, str) else "cv" if weight == "auto" else weight
    if how == "cv" and len(folds) < 2:
        how = ""
    if not extent and not how:
        return fit
    segments = Segments.of(fit, folds)
    if extent:
        beyond = contradicted_extents(fit, segments)
        fit = replace(fit, constraints=fit.constraints.without_extent(beyond))
    if not how:
        return fit
    choice = choose_weight(fit, segments, how)
    return replace(
        fit, prior_weight=choice.weight, plausible_weight=choice.plausible, choice=choice
    )


def make_constraints(
    bounds: ConstraintSettings,
    geometry: Mapping[str, tuple[Array, Array]],
    extent: Mapping[str, Array] = MappingProxyType({}),
) -> Constraints:
    """Return the constraints as the estimator takes them.

    Args:
        bounds: The constraints as a job states them.
        geometry: Half-spaces A c <= b of the centres of mass from the URDF's geometry, by name of
            the body; boxes stated in ``com`` go before them.
        extent: Box that holds all mass of each body, by its name.
    """
    A = np.vstack([np.eye(3), -np.eye(3)])
    com, kept = dict(geometry), dict(extent)
    for name, (low, high) in bounds.boxes.items():
        com[name] = (A, np.concatenate([high, np.negative(low)]))
        if name in kept:  # what is stated is known better
            kept[name] = np.array([np.minimum(kept[name][0], low), np.maximum(kept[name][1], high)])
    return Constraints(bounds.masses, bounds.total, com, tuple(bounds.pinned), kept)
