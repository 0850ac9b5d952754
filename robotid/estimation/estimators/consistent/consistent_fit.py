"""Physically consistent fit: a convex cone programme on the triangular factors."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.dynamics.factors import Factors
from robotid.estimation.estimators.batch import WLS, solve_factor
from robotid.estimation.estimators.consistent.body_constraints import Constraints
from robotid.estimation.estimators.consistent.cone_programme import Programme
from robotid.estimation.estimators.consistent.cones import Subspace
from robotid.estimation.estimators.consistent.penalties import (
    METRICS,
    Entropic,
    Penalty,
    WeightChoice,
    body_units,
    make_penalty,
)
from robotid.estimation.estimators.determination import base_spread, determine
from robotid.estimation.estimators.estimator import BatchEstimator, Estimate
from robotid.robot.parameters import ParameterLayout

_FLOOR = 1e-6  # smallest noise level over the torque, for noise-free data
_LEAST_FREEDOM = 0.1  # smallest degrees of freedom of a noise level, as a share of the rows
_ACTIVE = 1e-5  # slack below which a constraint is active, dimensionless


@dataclass(frozen=True, eq=False)
class Consistent(BatchEstimator):
    """Fit of physically consistent standard parameters, regularised by a prior.

    Minimises, over the standard parameters pi,

        sum_j |tau_j - W_b,j K pi|^2 / sigma_j^2 + prior_weight penalty(pi)

    subject to J(pi_i) - J(held_i) >= margin T_i for each body i, armature, viscous and Coulomb
    coefficients >= 0, and the other constraints. The noise levels sigma_j are those of weighted
    least squares.

    The estimate contains the p standard parameters. Its covariance is that of the fit without the
    inequalities; see ``Programme.redrawn`` for the covariance with them. Its rank, condition number
    and the names of undetermined parameters refer to the base parameters.

    Attributes:
        layout: The standard parameters.
        K: Map to the base parameters, shape (b, p).
        prior: Prior value of each parameter, shape (p,), as the URDF's.
        prior_std: Prior standard deviation of each parameter, shape (p,), positive.
        held: Known part of each body, as the links on locked joints, shape (10 bodies,); the rest
            of the body must be physically consistent. None: no known parts.
        margin: Smallest eigenvalue of a body's pseudo-inertia relative to its prior size [-].
        prior_weight: Weight of the prior [-].
        plausible_weight: Weight at which the prior has the plausible spread of the true parameters
            [-].
        independent_share: Share of independent rows, 2 cutoff / rate [-].
        max_iterations: Largest number of iterations of the cone solver.
        metric: Metric of the distance from the prior: "euclidean", "riemannian" or "entropic"; see
            ``make_penalty``.
        constraints: Bounds in addition to physical consistency.
        choice: How ``prior_weight`` was chosen; None: it was given.
        wls_noise: Noise levels of weighted least squares of the fitted rows, shape (n,) [N m or N];
            None: they are computed.

    References:
        Sousa, Cortesao (2014), Physical feasibility of robot base inertial parameter
        identification: a linear matrix inequality approach; Wensing, Kim, Slotine (2018), Linear
        Matrix Inequalities for Physically Consistent Inertial Parameter Identification, (8).
    """

    layout: ParameterLayout
    K: Array
    prior: Array
    prior_std: Array
    held: Array | None = None
    margin: float = 1e-4
    prior_weight: float = 1.0
    plausible_weight: float = 1.0
    independent_share: float = 1.0
    max_iterations: int = 200
    metric: str = "euclidean"
    constraints: Constraints = field(default_factory=Constraints)
    wls_noise: Array | None = None
    choice: WeightChoice | None = None

    def __post_init__(self) -> None:
        p = len(self.layout.names)
        for name, shape in (("prior", (p,)), ("prior_std", (p,)), ("K", (len(self.K), p))):
            if getattr(self, name).shape != shape:
                raise DataError(f"{name} has shape {getattr(self, name).shape}, wanted {shape}")
        if not (np.isfinite(self.prior_std) & (self.prior_std > 0)).all():
            raise DataError("prior_std must be positive and finite for every parameter")
        if not np.isfinite(self.prior).all() or not np.isfinite(self.known_share).all():
            raise DataError("prior and held must be finite for every parameter")
        if not (self.margin > 0 and self.prior_weight > 0):
            raise DataError(
                f"margin {self.margin} and prior_weight {self.prior_weight} must be positive"
            )
        if self.metric not in METRICS:
            raise DataError(f"metric is {self.metric!r}, wanted one of {listed(METRICS)}")
        self.constraints.check(self.layout, self.prior, self.known_share)

    @property
    def in_cone(self) -> "Consistent":
        return self

    def _fit(self, factors: Factors) -> Estimate:
        sigma = self.noise(factors)
        wls = solve_factor(factors, sigma, self.K @ self.prior)
        rows = self.rows(factors, sigma)
        solution = self.programme.minimise(rows, self.prior_weight)
        covariance = self.programme.covariance(self.prior_weight, rows, solution.x)
        details = self._details(solution.x)
        return Estimate(
            theta=solution.x,
            covariance=covariance,
            names=self.layout.names,
            sigma=sigma,
            rank=wls.rank,
            condition=wls.condition,
            undetermined=self.undetermined(rows, factors.names),
            converged=True,
            n_iter=solution.n_iter,
            message=solution.message,
            prior_std=self.spread_before,
            details=details,
        )

    def project(self, estimate: Estimate) -> Estimate:
        """Return the physically consistent standard parameters nearest to an estimate.

        Minimises (K pi - beta)^T C^-1 (K pi - beta) + prior_weight penalty(pi) under the
        constraints of ``fit``, with the covariance C of the estimate.

        Args:
            estimate: Base parameters, as those of a recursive estimator at any time. Parameters
                with infinite variance are not used.

        Raises:
            DataError: If no base parameter has a finite variance, or C is not positive definite.
            NotConvergedError: If the solver fails.
        """
        known = np.flatnonzero(np.isfinite(np.diag(estimate.covariance)))
        if not len(known):
            raise DataError(
                "the estimate has no covariance, so it cannot be projected onto physically "
                "consistent parameters; use the estimator 'rls' or 'kalman', which have one"
            )
        rows = _information_rows(estimate, known)  # (k, b + 1)
        solution = self.programme.minimise(rows, self.prior_weight)
        return replace(
            estimate,
            theta=solution.x,
            covariance=self.programme.covariance(self.prior_weight, rows, solution.x),
            names=self.layout.names,
            undetermined=self.undetermined(rows, estimate.names),
            n_iter=estimate.n_iter + solution.n_iter,
            message=f"{estimate.message}; projected onto physically consistent parameters, "
            f"{solution.message}",
            prior_std=self.spread_before,
            details=self._details(solution.x),
        )

    def noise(self, factors: Factors) -> Array:
        """Return the noise levels of weighted least squares, shape (n,) [N m or N].

        They do not depend on the prior: a wrong one would otherwise make the data seem noisy. The
        parameters use as many independent rows as the trace of their leverage.

        Args:
            factors: The factors, of base parameters.
        """
        sigma, prior = self.wls_noise, self.K @ self.prior
        if sigma is None:
            sigma = WLS(prior, self.independent_share).fit(factors).sigma
        rows = np.maximum(factors.rows, 1)
        used = factors.leverages(solve_factor(factors, sigma, prior).covariance) / sigma**2
        freedom = np.maximum(rows - used / self.independent_share, _LEAST_FREEDOM * rows)
        torque = np.sqrt(factors.torque_squares() / rows)
        least = _FLOOR * np.where(torque > 0, torque, 1.0)
        level: Array = np.maximum(sigma * np.sqrt(np.maximum(rows - used, 1.0) / freedom), least)
        return level

    def rows(self, factors: Factors, sigma: Array) -> Array:
        """Return rows [R d], shape (b + 1, b + 1): |R K pi - d|^2 is the weighted cost of the data.

        Args:
            factors: The factors, of base parameters.
            sigma: Noise level per joint, shape (n,) [N m or N].
        """
        return factors.weighted(sigma / np.sqrt(self.independent_share))

    def objective(self, rows: Array, pi: Array) -> float:
        """Return the objective of the fit; see ``Programme.objective``.

        Args:
            rows: Rows of the data, shape (k, b + 1), from ``rows``.
            pi: Standard parameters, shape (p,).
        """
        return self.programme.objective(rows, pi, self.prior_weight)

    def active(self, pi: Array, tolerance: float = _ACTIVE) -> tuple[Array, tuple[str, ...]]:
        """Return the inequalities that are active at given parameters, linearised there.

        Args:
            pi: Standard parameters, shape (p,).
            tolerance: Slack below which a constraint is active, dimensionless.

        Returns:
            Gradients with respect to pi of the constraint functions at 0, shape (a, p), and the
            family and owner of each constraint, as "pseudo_inertia forearm".
        """
        gradients, labels = self.programme.binding.active(pi / self.prior_std, tolerance)
        return gradients / self.prior_std, labels

    @cached_property
    def programme(self) -> Programme:
        """The convex programme, for any data and weight."""
        scale, held = self.prior_std, self.known_share
        units = body_units(scale[: self.layout.n_inertial])
        E, e = self.constraints.equalities(self.layout, self.prior)
        cone = self.constraints.cone(self.layout, scale, held, units, self.margin)
        penalty = make_penalty(self.metric, self.layout, self.prior, scale, held)
        space = Subspace.of(E * scale, e)
        return Programme(self.K, scale, penalty, cone, space, self.max_iterations)

    @property
    def penalty(self) -> Penalty:
        """The penalty on the distance from the prior."""
        return self.programme.penalty

    @property
    def weight_ratio(self) -> float:
        """Weight of the prior over its plausible weight, at least 1 [-].

        A large weight means that parameters near the prior explain the data, not that all
        parameters are near the prior: parameters that the data do not determine are as uncertain
        as at ``plausible_weight``.
        """
        return max(self.prior_weight / self.plausible_weight, 1.0)

    @property
    def spread_before(self) -> Array:
        """Plausible standard deviation of each parameter before the data, shape (p,)."""
        covariance = self.programme.covariance(self.prior_weight / self.weight_ratio)
        spread: Array = np.sqrt(np.diag(covariance))
        return spread

    @property
    def known_share(self) -> Array:
        """The known part of each body, shape (10 bodies,); 0 without one."""
        return np.zeros(self.layout.n_inertial) if self.held is None else self.held

    def undetermined(self, rows: Array, base_names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the base parameters that the data do not determine individually.

        See ``determine``. The metric and the weight of the prior have no effect.

        Args:
            rows: Rows of the data, shape (k, b + 1), from ``rows``.
            base_names: Names of the base parameters.
        """
        known = self.layout.owned_by(self.constraints.pinned)
        before = base_spread(self.K, self.prior_std, known)
        return determine(base_names, rows[:, :-1], before).undetermined

    def _details(self, pi: Array) -> dict[str, Any]:
        """Return the settings of the fit and its active constraints, as plain values."""
        is_bound = self.programme.space.basis.shape[1] < len(pi)
        prior: dict[str, Any] = {
            "metric": self.metric,
            "weight": self.prior_weight,
            "plausible_weight": self.prior_weight / self.weight_ratio,
        }
        if self.choice is not None:
            prior["chosen_by"] = self.choice.how
            prior["curve"] = [list(pair) for pair in self.choice.curve]
        return {
            "prior": prior,
            "solver": "interior point" if isinstance(self.penalty, Entropic) else "clarabel",
            "constraints": [*self.programme.cone.families, *(["equalities"] if is_bound else [])],
            "active": sorted(set(self.active(pi)[1])),
            "pinned": list(self.constraints.pinned),
            "relaxed": list(self.constraints.relaxed),
        }


def _information_rows(estimate: Estimate, known: Array) -> Array:
    """Return rows [L^-1 (beta -> known), L^-1 beta], L L^T the covariance of known parameters."""
    C = estimate.covariance[np.ix_(known, known)]
    scale = np.sqrt(np.diag(C))
    try:
        L = scale[:, None] * np.linalg.cholesky(C / np.outer(scale, scale))
    except np.linalg.LinAlgError as error:
        raise DataError(
            "the covariance of the estimate is not positive definite, so it cannot be projected "
            "onto physically consistent parameters; use more samples or a prior"
        ) from error
    chosen = np.zeros((len(known), len(estimate.theta) + 1))
    chosen[np.arange(len(known)), known] = 1.0
    chosen[:, -1] = estimate.theta[known]
    rows: Array = scipy.linalg.solve_triangular(L, chosen, lower=True)
    return rows
