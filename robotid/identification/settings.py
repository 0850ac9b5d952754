"""Which estimator is wanted, with its own settings; and the estimator made of them."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from dataclasses import field as dataclass_field
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
    Kalman,
    NormalisedGradient,
    RecursiveEstimator,
)
from robotid.estimators.consistent.log_cholesky import LogCholesky
from robotid.estimators.consistent.penalties import METRICS
from robotid.estimators.consistent.solvers import SOLVERS
from robotid.estimators.consistent.weighting import choose_weight
from robotid.exceptions import SettingsError
from robotid.identification.constraint_settings import ConstraintSettings
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.factors import Factors, gather
from robotid.robot.bodies import held_parameters
from robotid.robot.geometry import geometry_half_spaces
from robotid.robot.model import RobotModel

__all__ = [
    "ESTIMATORS",
    "KEYS",
    "RECURSIVE",
    "EstimatorSettings",
    "Known",
    "consistent_fit",
    "make_estimator",
]

_PROJECTION = ("margin", "prior", "prior_weight", "solver", "check", "draws", "constraints")
_WEIGHTS = ("auto", "cv", "evidence")
_FOLDS = 6  # held out in turn by prior_weight = "cv"
#: The keys that each estimator has, beside its name.
KEYS: Mapping[str, tuple[str, ...]] = {
    "ols": (),
    "wls": ("robust",),
    "tls": ("regressor_noise",),
    "consistent": ("robust", *_PROJECTION),
    "log_cholesky": ("robust", *_PROJECTION, "starts", "seed"),
    "rls": ("forgetting", "physical", *_PROJECTION),
    "kalman": ("walk", "gate", "physical", *_PROJECTION),
    "prx": ("step", "metric", "average", "passes", "seed", "physical", *_PROJECTION),
    "gradient": ("step_size", "average", "passes", "seed", "physical", *_PROJECTION),
}
ESTIMATORS = tuple(KEYS)
RECURSIVE = ("rls", "kalman", "prx", "gradient")


@dataclass(frozen=True)
class EstimatorSettings:
    """Which estimator, and its own settings. A setting of another estimator is refused.

    Attributes:
        name: "ols", "wls", "tls", "consistent", "log_cholesky", "rls", "kalman", "prx" or
            "gradient".
        robust: Of "wls", "consistent" and "log_cholesky": "none", or the loss of rows that fit
            badly, "huber" or "tukey".
        regressor_noise: Of "tls": noise of the regressor's columns over their root mean square [-].
        margin: Of "consistent" and ``physical``: smallest eigenvalue of a body's pseudo-inertia
            relative to its prior size [-].
        prior: Of the same: metric of the distance from the URDF's values, "euclidean",
            "riemannian" or "entropic".
        prior_weight: Of the same: weight of the URDF's values [-], or how it is chosen from the
            fitted logs, 1 at most: "cv" (stretches held out in turn), "evidence", or "auto" ("cv",
            or 1 for a log too short to be cut).
        solver: Of the same: "clarabel" or "scs".
        check: Of the same: whether the other solver solves it, too.
        draws: Of the same: fits to redrawn data and prior that tell the standard errors where
            bounds bind; 0 leaves the bounds out of them.
        constraints: Of the same: see ``ConstraintSettings``.
        starts: Of "log_cholesky": random starts beside the one from the cone programme.
        forgetting: Of "rls": weight of a sample relative to the next one [-].
        walk: Of "kalman": random walk per sample, as a share of the prior's spread [-].
        gate: Of "kalman": probability with which a good row passes; False for no gate.
        step: Of "prx": "exact" or "printed".
        metric: Of "prx", step "exact": "noise", "mass" or "rows".
        average: Of "prx" and "gradient": whether the iterates are averaged.
        passes: Of "prx" and "gradient": largest number of passes over the logs.
        seed: Of "prx" and "gradient": seed of the order of the samples; negative: that of time.
            Of "log_cholesky": seed of the random starts.
        step_size: Of "gradient": relaxation, above 0 and below 2 [-].
        physical: Of the recursive ones: whether the last estimate is made physically possible.
    """

    name: str = "consistent"
    robust: str = "none"
    regressor_noise: float = 0.01
    margin: float = 1e-4
    prior_weight: float | str = "auto"
    forgetting: float = 1.0
    walk: float = 0.0
    gate: float | bool = 1 - 1e-7
    step: str = "exact"
    metric: str = "noise"
    average: bool = True
    passes: int = 4
    seed: int = 0
    step_size: float = 1.0
    physical: bool = False
    prior: str = "euclidean"
    solver: str = "clarabel"
    check: bool = False
    draws: int = 64
    constraints: Mapping[str, Any] = dataclass_field(default_factory=dict)
    starts: int = 0

    def __post_init__(self) -> None:
        if self.name not in KEYS:
            raise SettingsError(f"estimator is {self.name!r}, wanted one of {list(ESTIMATORS)}")
        own = KEYS[self.name]
        for field in fields(self)[1:]:
            value = getattr(self, field.name)
            if field.name not in own and value != field.default and value != {}:
                raise SettingsError(
                    f"estimator {self.name!r} has no setting {field.name!r}; it has {list(own)}"
                )
        if isinstance(self.prior_weight, str) and self.prior_weight not in _WEIGHTS:
            raise SettingsError(
                f"prior_weight is {self.prior_weight!r}, wanted a positive number or one of "
                f"{list(_WEIGHTS)}"
            )
        for key in ("margin", "prior_weight", "passes"):
            number = getattr(self, key)
            if not isinstance(number, str) and not 0 < number < np.inf:
                raise SettingsError(f"{key} is {number}, wanted a positive, finite number")
        _check_range("forgetting", self.forgetting, 0 < self.forgetting <= 1, "0 < x <= 1")
        _check_range("regressor_noise", self.regressor_noise, self.regressor_noise > 0, "x > 0")
        _check_range("walk", self.walk, self.walk >= 0, "x >= 0")
        _check_range("step_size", self.step_size, 0 < self.step_size < 2, "0 < x < 2")
        is_gate = self.gate is False or (self.gate is not True and 0.5 <= self.gate < 1)
        _check_range("gate", self.gate, is_gate, "0.5 <= x < 1, or false")
        _check_choice("step", self.step, ("exact", "printed"))
        _check_choice("metric", self.metric, ("noise", "mass", "rows"))
        _check_choice("robust", self.robust, ("none", "huber", "tukey"))
        _check_choice("prior", self.prior, METRICS)
        _check_choice("solver", self.solver, tuple(SOLVERS))
        _check_range("draws", self.draws, self.draws == 0 or self.draws >= 10, "0, or 10 or more")
        _check_range("starts", self.starts, self.starts >= 0, "x >= 0")
        ConstraintSettings(**self.constraints)

    def to_dict(self) -> dict[str, Any]:
        """Return the name and the estimator's own settings, in the shape of the job file."""
        return {"name": self.name, **{key: getattr(self, key) for key in KEYS[self.name]}}


@dataclass(frozen=True, eq=False)
class Known:
    """What is known before the data.

    Attributes:
        pi: Standard parameters of the URDF, shape (p,).
        spread: How far they may plausibly be wrong, shape (p,).
        share: Share of the rows that count as independent [-].
        sigma: Noise level of each joint, shape (n,) [N m or N].
        stretches: Factors of the stretches of the fitted logs, to choose a weight with.
    """

    pi: Array
    spread: Array
    share: float
    sigma: Array
    stretches: tuple[Factors, ...] = ()


def make_estimator(
    settings: EstimatorSettings, model: RobotModel, mapping: BaseMapping, prior: Known
) -> BatchEstimator | RecursiveEstimator[Any]:
    """Return the estimator that settings describe.

    Args:
        settings: The settings.
        model: The robot.
        mapping: Standard to base parameters.
        prior: What is known before the data.

    Returns:
        The estimator.
    """
    if settings.name == "ols":
        return OLS(independent_share=prior.share)
    if settings.name == "tls":
        return TLS(settings.regressor_noise, independent_share=prior.share)
    if settings.name == "wls":
        return WLS(independent_share=prior.share)
    if settings.name in RECURSIVE:
        return _recursive(settings, mapping, prior)
    fit = consistent_fit(settings, model, mapping, prior)
    if settings.name == "log_cholesky":
        rng = np.random.default_rng(settings.seed)
        return LogCholesky(fit, starts=settings.starts, rng=rng)
    return fit


def consistent_fit(
    settings: EstimatorSettings, model: RobotModel, mapping: BaseMapping, prior: Known
) -> Consistent:
    """Return the physically consistent estimator, which also projects.

    Args:
        settings: The settings.
        model: The robot.
        mapping: Standard to base parameters.
        prior: What is known before the data.

    Returns:
        The estimator.

    Raises:
        SettingsError: If constraints contradict each other or do not fit the robot.
    """
    constraints = ConstraintSettings(**settings.constraints)
    geometry = geometry_half_spaces(model, constraints.com_within)
    weight = settings.prior_weight
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
        constraints=constraints.to_constraints(geometry),
        solver=settings.solver,
        check=settings.check,
    )
    folds = gather(prior.stretches, _FOLDS)
    if not isinstance(weight, str) or (weight == "auto" and len(folds) < 2):
        return fit
    choice = choose_weight(fit, folds, "cv" if weight == "auto" else weight)
    return replace(fit, prior_weight=choice.weight, choice=choice)


def _recursive(
    settings: EstimatorSettings, mapping: BaseMapping, prior: Known
) -> RecursiveEstimator[Any]:
    beta, sigma = mapping.to_base(prior.pi), prior.sigma
    KS = mapping.K * prior.spread
    C = KS @ KS.T  # (b, b), of the base parameters before the data
    if settings.name == "rls":
        # without forgetting nothing of the prior enters: batch least squares
        is_held = settings.forgetting < 1
        std = np.sqrt(np.diag(C)) if is_held else None
        return RLS(sigma, settings.forgetting, beta, std, prior.share)
    if settings.name == "kalman":
        gate = None if settings.gate is False else float(settings.gate)
        return Kalman(sigma, beta, C, settings.walk, gate, prior.share)
    rng = np.random.default_rng(settings.seed) if settings.seed >= 0 else None
    passes, average = settings.passes, settings.average
    if settings.name == "prx":
        return PRX(
            sigma,
            beta,
            step=settings.step,
            metric=settings.metric,
            average=average,
            passes=passes,
            rng=rng,
        )
    return NormalisedGradient(
        sigma, beta, step_size=settings.step_size, average=average, passes=passes, rng=rng
    )


def _check_range(key: str, value: object, is_right: bool, wanted: str) -> None:
    if not is_right:
        raise SettingsError(f"{key} is {value}, wanted {wanted}")


def _check_choice(key: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise SettingsError(f"{key} is {value!r}, wanted one of {list(known)}")
