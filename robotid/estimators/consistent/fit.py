"""Physically consistent fit: a convex cone programme on the factors."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.estimators.batch import WLS, solve_factor
from robotid.estimators.consistent.cone_programme import Programme
from robotid.estimators.consistent.cones import SOLVERS, Subspace
from robotid.estimators.consistent.constraints import Constraints
from robotid.estimators.consistent.penalties import (
    METRICS,
    Entropic,
    Penalty,
    WeightChoice,
    body_units,
    make_penalty,
)
from robotid.estimators.determination import base_spread, determine
from robotid.estimators.estimator import BatchEstimator, Estimate
from robotid.exceptions import DataError, NotConvergedError
from robotid.findings import listed
from robotid.regressor.factors import Factors
from robotid.robot.parameters import ParameterLayout

__all__ = ["Consistent"]

_ACTIVE = 1e-5  # slack below which a constraint counts as active, free of units


@dataclass(frozen=True, eq=False)
class Consistent(BatchEstimator):
    """Physically consistent standard parameters, near their prior where the data say nothing.

    Minimises, over the standard parameters pi,

        sum_j |tau_j - W_b,j K pi|^2 / sigma_j^2 + prior_weight penalty(pi)

    subject to J(pi_i) - J(held_i) >= margin T_i for each body i, armature, viscous and Coulomb
    coefficients >= 0, and the further constraints. The noise levels sigma_j are those of the fit
    without the inequalities, from weighted least squares onwards.

    An estimate is over the p standard parameters, its covariance that of the fit without the
    inequalities; ``Programme.redrawn`` tells that with them. Its rank, condition number and the
    names of undetermined parameters are those of the base parameters.

    Attributes:
        layout: The standard parameters.
        K: Map to the base parameters, shape (b, p).
        prior: Prior value of each parameter, shape (p,), as the URDF's.
        prior_std: How far a parameter may plausibly lie from its prior, shape (p,), positive.
        held: Share of each body that is known and may not be negative beside it, as the links on
            locked joints, shape (10 bodies,); None for nothing.
        margin: Smallest eigenvalue of a body's pseudo-inertia relative to its prior size [-].
        prior_weight: Weight of the prior [-].
        plausible_weight: Weight whose spread about the prior the truth plausibly has [-].
        independent_share: Share of the rows that count as independent, 2 cutoff / rate.
        max_iterations: Bound on the iterations of the cone solver.
        metric: How the distance from the prior is measured: "euclidean",
            "riemannian" or "entropic"; see ``make_penalty``.
        constraints: Bounds beside physical consistency.
        solver: "clarabel" or "scs", of priors that are not entropic and of the check.
        choice: How ``prior_weight`` was chosen, if it was.
        check: Whether the other solver solves it, too; its difference is stated in the details.
        wls_noise: Noise levels of weighted least squares of the rows that are fitted, shape (n,)
            [N m or N]; None: to be found.

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
    solver: str = "clarabel"
    check: bool = False
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
        if self.metric not in METRICS or self.solver not in SOLVERS:
            raise DataError(
                f"metric is {self.metric!r}, wanted one of {listed(METRICS)}; solver is "
                f"{self.solver!r}, wanted one of {listed(SOLVERS)}"
            )
        self.constraints.check(self.layout, self.prior, self.known_share)

    @property
    def in_cone(self) -> "Consistent":
        return self

    def _fit(self, factors: Factors) -> Estimate:
        start = self._wls_noise(factors)
        wls = solve_factor(factors, start, self.K @ self.prior)
        sigma = self.programme.noise(factors, start, self.independent_share, self.prior_weight)
        rows = self.rows(factors, sigma)
        solution = self.programme.minimise(rows, self.prior_weight)
        covariance = self.programme.covariance(self.prior_weight, rows, solution.x)
        details = self._details(solution.x)
        if self.check:
            details["check"] = self._second_opinion(rows, solution.x, factors)
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
        """Return the possible standard parameters nearest to an estimate of the base parameters.

        Nearest in the metric of its covariance C, the prior beside it, with the constraints of
        ``fit``: minimises (K pi - beta)^T C^-1 (K pi - beta) + prior_weight penalty(pi).

        Args:
            estimate: Base parameters, as a recursive estimator has them at any moment. Those of
                infinite variance count as unknown.

        Raises:
            DataError: If no base parameter has a finite variance, or C is not positive definite.
            NotConvergedError: If the cone solver does not solve it.
        """
        known = np.flatnonzero(np.isfinite(np.diag(estimate.covariance)))
        if not len(known):
            raise DataError(
                "an estimate without a covariance cannot be projected: it has no metric; use 'rls' "
                "or 'kalman', which have one"
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
            message=f"{estimate.message}; made physically possible, {solution.message}",
            prior_std=self.spread_before,
            details=self._details(solution.x),
        )

    def noise(self, factors: Factors) -> Array:
        """Return the noise levels, shape (n,) [N m or N], by the fit without the inequalities.

        Args:
            factors: The factors, of base parameters.
        """
        start = self._wls_noise(factors)
        return self.programme.noise(factors, start, self.independent_share, self.prior_weight)

    def rows(self, factors: Factors, sigma: Array) -> Array:
        """Return rows [R d], shape (b + 1, b + 1), |R K pi - d|^2 the weighted squared residual.

        Args:
            factors: The factors, of base parameters.
            sigma: Noise level per joint, shape (n,) [N m or N].
        """
        return factors.weighted(sigma / np.sqrt(self.independent_share))

    def objective(self, rows: Array, pi: Array) -> float:
        """Return what the fit minimises; see ``Programme.objective``.

        Args:
            rows: Information, shape (k, b + 1).
            pi: Standard parameters, shape (p,).
        """
        return self.programme.objective(rows, pi, self.prior_weight)

    def active(self, pi: Array, tolerance: float = _ACTIVE) -> tuple[Array, tuple[str, ...]]:
        """Return the constraints that bind at parameters, linearised there.

        Args:
            pi: Standard parameters, shape (p,).
            tolerance: Slack below which a constraint counts as active, free of units.

        Returns:
            Gradients with respect to pi, shape (a, p), of what the constraints hold at 0, and the
            family and owner of each, as "pseudo_inertia forearm"; equalities are not among them.
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
        return Programme(self.K, scale, penalty, cone, space, self.solver, self.max_iterations)

    @property
    def penalty(self) -> Penalty:
        """The penalty on the distance from the prior."""
        return self.programme.penalty

    @property
    def pull(self) -> float:
        """How much heavier the prior weighs than its plausible spread says, at least 1 [-].

        A heavy weight says that the data are explained near the prior, not that all parameters
        are: what they leave open stays as uncertain as at ``plausible_weight``.
        """
        return max(self.prior_weight / self.plausible_weight, 1.0)

    @property
    def spread_before(self) -> Array:
        """Plausible standard deviation of each parameter by the prior alone, shape (p,)."""
        covariance = self.programme.covariance(self.prior_weight / self.pull)
        spread: Array = np.sqrt(np.diag(covariance))
        return spread

    @property
    def known_share(self) -> Array:
        """The share of each body that is held, shape (10 bodies,); 0 for nothing."""
        return np.zeros(self.layout.n_inertial) if self.held is None else self.held

    def undetermined(self, rows: Array, base_names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the base parameters that the data do not determine by themselves.

        See ``determine``; whatever metric and weight the prior has.

        Args:
            rows: Information, shape (k, b + 1), as of ``rows``.
            base_names: Names of the base parameters.
        """
        known = self.layout.owned_by(self.constraints.pinned)
        before = base_spread(self.K, self.prior_std, known)
        return determine(base_names, rows[:, :-1], before).undetermined

    def _wls_noise(self, factors: Factors) -> Array:
        """Return the noise levels of weighted least squares, shape (n,) [N m or N]."""
        if self.wls_noise is not None:
            return self.wls_noise
        return WLS(self.K @ self.prior, self.independent_share).fit(factors).sigma

    def _details(self, pi: Array) -> dict[str, Any]:
        """Return how it was fitted, as plain values."""
        is_bound = self.programme.space.basis.shape[1] < len(pi)
        prior: dict[str, Any] = {
            "metric": self.metric,
            "weight": self.prior_weight,
            "plausible_weight": self.prior_weight / self.pull,
        }
        if self.choice is not None:
            prior["chosen_by"] = self.choice.how
            prior["curve"] = [list(pair) for pair in self.choice.curve]
        return {
            "prior": prior,
            "solver": "interior point" if isinstance(self.penalty, Entropic) else self.solver,
            "constraints": [*self.programme.cone.families, *(["equalities"] if is_bound else [])],
            "active": sorted(set(self.active(pi)[1])),
            "pinned": list(self.constraints.pinned),
            "relaxed": list(self.constraints.relaxed),
        }

    def _second_opinion(self, rows: Array, pi: Array, factors: Factors) -> dict[str, Any]:
        """Return what the other solver makes of it, as plain values."""
        (other,) = (name for name in SOLVERS if name != self.solver)
        try:
            programme = replace(self.programme, solver=other)
            solution = programme.expanded(rows, self.prior_weight, pi)
        except NotConvergedError as error:
            return {"solver": other, "status": error.status}
        objective = self.objective(rows, pi)
        change = factors.R[:, :, :-1] @ (self.K @ (solution.x - pi))
        torque = np.sqrt((change**2).sum() / factors.torque_squares().sum())
        return {
            "solver": other,
            "status": solution.message,
            "objective_difference": (self.objective(rows, solution.x) - objective) / objective,
            "torque_difference": float(torque),
        }


def _information_rows(estimate: Estimate, known: Array) -> Array:
    """Return rows [L^-1 (beta -> known), L^-1 beta] with L L^T the covariance of what is known."""
    C = estimate.covariance[np.ix_(known, known)]
    scale = np.sqrt(np.diag(C))
    try:
        L = scale[:, None] * np.linalg.cholesky(C / np.outer(scale, scale))
    except np.linalg.LinAlgError as error:
        raise DataError(
            "the covariance of the estimate is not positive definite, so it has no metric to "
            "project in; give the estimator more samples or a prior"
        ) from error
    chosen = np.zeros((len(known), len(estimate.theta) + 1))
    chosen[np.arange(len(known)), known] = 1.0
    chosen[:, -1] = estimate.theta[known]
    rows: Array = scipy.linalg.solve_triangular(L, chosen, lower=True)
    return rows
