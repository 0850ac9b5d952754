"""Physically consistent fit: a convex programme on the triangular factors, any data and weight."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg

from robotid.base.exceptions import DataError
from robotid.base.typing import Array
from robotid.dynamics.factors import Factors
from robotid.estimation.estimators.batch import WLS, solve_factor
from robotid.estimation.estimators.consistent.body_constraints import Bounds, Constraints, Subspace
from robotid.estimation.estimators.consistent.interior_point import EntropicProblem, Minimum, svec
from robotid.estimation.estimators.determination import base_spread, determine
from robotid.estimation.estimators.estimator import BatchEstimator, Estimate
from robotid.robot.parameters import (
    ParameterLayout,
    inertial_from_pseudo_inertia,
    pseudo_inertia,
    pseudo_inertia_basis,
)

_EXACT = 1e-12  # relative decrease of the objective per step at which a fit is exact
_ROUGH = 1e-6  # ... and at which it is sufficient for a prediction
_TOGETHER = 2**17  # entries of the data sets that are fitted in one pass: they fit into a cache
_CONTRADICTED = 1e-7  # distance of the NNLS problem below which the inequalities contradict
_SINGULAR = 1e-12  # ratio of the axes of a body, squared, below which it is singular
_THINNEST = 0.01  # smallest relative thickness of a prior's pseudo-inertia
_FLOOR = 1e-6  # smallest noise level over the torque, for noise-free data
_LEAST_FREEDOM = 0.1  # smallest degrees of freedom of a noise level, as a share of the rows
_ACTIVE = 1e-5  # slack below which a constraint is active, dimensionless


@dataclass(frozen=True, eq=False)
class Entropic:
    """2 sum_i d(J_i || P_i) of the bodies plus |(pi - centre) / std|^2 of the drives.

    d(J || P) = tr(P^-1 J) - log det(P^-1 J) - 4 is the Bregman divergence of -log det. It does not
    depend on the frame of a body; near the prior the penalty is about |delta / std|^2.

    References:
        Lee, Wensing, Park (2019), Geometric robot dynamic identification: a convex programming
        approach, (22), (24), (32).
    """

    centre: Array  # (p,), prior values
    precision: Array  # (drives,), 1 / std^2 of the drives
    held: Array  # (10 bodies,), known part of each body

    @classmethod
    def of(cls, layout: ParameterLayout, prior: Array, std: Array, held: Array) -> "Entropic":
        """Return the penalty; relative eigenvalues of the prior's bodies are at least 1 %."""
        size = layout.n_inertial
        mass, moment = std[:size].reshape(-1, 10)[:, :2].T
        # diagonal T^-1/2, which make pseudo-inertias dimensionless
        unit = np.column_stack([mass / moment] * 3 + [np.ones_like(mass)]) / np.sqrt(mass)[:, None]
        shrink, grow = (np.eye(4) * x[:, None, :] for x in (unit, 1.0 / unit))
        P = pseudo_inertia(prior[:size] - held)
        values, vectors = np.linalg.eigh(shrink @ P @ shrink)
        floored = (vectors * np.maximum(values, _THINNEST)[:, None]) @ vectors.mT
        thin = (values[:, 0] < _THINNEST)[:, None, None]
        P = np.where(thin, grow @ floored @ grow, P)
        bodies = inertial_from_pseudo_inertia(P).reshape(-1) + held
        return cls(np.concatenate([bodies, prior[size:]]), std[size:] ** -2.0, held)

    def value(self, pi: Array) -> float:
        """Return the penalty, at least 0; infinite if a body is singular: pi (p,)."""
        values = np.linalg.eigvalsh(self._ratio(pi))  # of P^-1 J
        if (values[:, 0] <= _SINGULAR * np.maximum(values[:, 3], 1.0)).any():
            return float("inf")
        divergence = (values - np.log(values) - 1.0).sum()
        return float(2.0 * divergence + self.precision @ self._drives(pi) ** 2)

    def gradient(self, pi: Array) -> Array:
        """Return its gradient, shape (p,): pi (p,)."""
        slope = np.linalg.inv(self.prior) - np.linalg.inv(self._rest(pi))
        inertial = 2.0 * np.einsum("nij,kij->nk", slope, pseudo_inertia_basis()).reshape(-1)
        return np.concatenate([inertial, 2.0 * self.precision * self._drives(pi)])

    def root(self, pi: Array) -> Array:
        """Return S with S^T S half its second derivative at pi, shape (p, p), upper triangular.

        The second derivative of a thin body is too ill conditioned to be factorised. With
        J = L L^T it is g_kl = tr(C_k C_l), C_k = L^-1 B_k L^-T, and S is computed from C.
        """
        L = self._prior_factor @ np.linalg.cholesky(self._ratio(pi))
        C = _whitened(pseudo_inertia_basis()[None], L[:, None])  # (n, 10, 4, 4)
        bodies = np.linalg.qr(svec(C).mT, mode="r")
        return np.asarray(scipy.linalg.block_diag(*bodies, np.diag(np.sqrt(self.precision))))

    def hessian(self, pi: Array) -> Array:
        """Return its second derivative, shape (p, p), positive definite: pi (p,)."""
        S = self.root(pi)
        return np.asarray(2.0 * S.T @ S)

    @cached_property
    def prior(self) -> Array:
        """The pseudo-inertias P of the prior without the known parts, shape (n, 4, 4)."""
        return self._rest(self.centre)

    @cached_property
    def _prior_factor(self) -> Array:
        return np.linalg.cholesky(self.prior)

    def _ratio(self, pi: Array) -> Array:
        """Return L^-1 J L^-T of each body, dimensionless, 1 at the prior P = L L^T."""
        return _whitened(self._rest(pi), self._prior_factor)

    def _rest(self, pi: Array) -> Array:
        return pseudo_inertia(pi[: len(self.held)] - self.held)

    def _drives(self, pi: Array) -> Array:
        return (pi - self.centre)[len(self.held) :]


@dataclass(frozen=True, eq=False)
class Programme:
    """Minimise |rows [K pi; -1]|^2 + weight penalty(pi) between bounds.

    The log det of the penalty is a barrier: the bodies of a minimum are physically consistent.
    """

    K: Array  # (b, p), map to the base parameters
    scale: Array  # (p,), unit of each parameter: bounds and subspace are in x = pi / scale
    penalty: Entropic
    bounds: Bounds
    space: Subspace  # of the points that meet the equalities

    def minimise(
        self, rows: Array, weight: float, *, is_exact: bool = True, start: Minimum | None = None
    ) -> Minimum:
        """Return the minimum of rows (k, b + 1); its x is pi, shape (p,)."""
        starts = None if start is None else [start]
        return self.minimise_each(rows[None], weight, is_exact=is_exact, starts=starts)[0]

    def minimise_each(
        self, rows: Array, weight: float, *, is_exact: bool = True,
        starts: Sequence[Minimum] | None = None,
    ) -> list[Minimum]:  # fmt: skip
        """Return the minimum of each of f data sets, as ``minimise``: rows (f, k, b + 1)."""
        tolerance = _EXACT if is_exact else _ROUGH
        if starts is not None:
            starts = [replace(start, x=start.x / self.scale) for start in starts]
        A, d = rows[:, :, :-1] @ (self.K * self.scale), rows[:, :, -1]
        minima: list[Minimum] = []
        most = max(1, _TOGETHER // A[0].size)
        for k in (slice(first, first + most) for first in range(0, len(A), most)):
            near = None if starts is None else starts[k]
            minima += self._problem.minimise(A[k], d[k], weight, tolerance, near)
        return [replace(minimum, x=minimum.x * self.scale) for minimum in minima]

    @cached_property
    def _problem(self) -> EntropicProblem:
        """The problem in units of the scale."""
        penalty, size = self.penalty, len(self.penalty.held)
        return EntropicProblem(
            scale=self.scale,
            held=penalty.held / self.scale[:size],
            P=penalty.prior,
            centre=penalty.centre / self.scale,
            stiffness=np.sqrt(penalty.precision) * self.scale[size:],
            G=self.bounds.G,
            h=self.bounds.h,
            N=self.space.fixed,
            origin=self.space.origin,
        )

    def redrawn(
        self,
        rows: Array,
        weight: float,
        pi: Array,
        meat: Array,
        weight_ratio: float,
        draws: int,
        rng: np.random.Generator,
    ) -> tuple[Array, list[str]]:
        """Return the distances of fits to resampled data and prior from this fit, and failures.

        Noise of the data has the covariance of their score. Noise of the prior has the covariance
        of the plausible prior. Both move the minimum without the inequalities, with the penalty
        expanded at the fit; the nearest point within the bounds, in the metric of the fit, is the
        minimum with them (Bardsley, Fox, 2012, An MCMC method for uncertainty quantification in
        nonnegativity constrained inverse problems, section 3).

        rows (k, b + 1), pi (p,), meat (b, b) -> (m, p).
        """
        S, space = self._scaled_root(pi), self.space
        L = np.sqrt(weight) * S  # half the Hessian of the weighted penalty is L^T L
        slope = 0.5 * weight * self.penalty.gradient(pi) * self.scale
        lowest = pi / self.scale - scipy.linalg.cho_solve((L, False), slope)
        A = np.vstack([rows[:, :-1] @ self.K * self.scale, L])
        d = np.concatenate([rows[:, -1], L @ lowest])
        free = space.basis.shape[1]
        stacked = np.column_stack([A @ space.basis, d - A @ space.origin])
        triangle = scipy.linalg.qr(stacked, mode="r")[0][:free]
        # signs of rows depend on rounding: make the diagonal positive
        triangle = np.sign(np.diag(triangle))[:, None] * triangle
        R = triangle[:, :-1]
        at = space.basis.T @ (pi / self.scale - space.origin)
        # y = R (x - at): with independent rows, whose meat is their information, noise is white
        prior = space.basis @ scipy.linalg.solve_triangular(R, np.eye(len(R)))
        data = self.K * self.scale @ prior
        # score of the prior: weight H (pi - true pi), covariance of pi: weight_ratio / (weight H)
        score = np.sqrt(weight_ratio) * L @ prior
        size, axes = np.linalg.eigh(data.T @ meat @ data + score.T @ score)
        root = axes * np.sqrt(np.maximum(size, 0.0)) @ axes.T
        noise = rng.standard_normal((draws, len(R))) @ root
        G = self.bounds.G @ prior
        slack = self.bounds.h + self.bounds.G @ (space.origin + space.basis @ at)
        solved = [nearest(G, slack, y) for y in triangle[:, -1] - R @ at + noise]
        moved = np.array([y for y in solved if not isinstance(y, str)])
        failures = [status for status in solved if isinstance(status, str)]
        return self.scale * (moved.reshape(-1, len(R)) @ prior.T), failures

    def whitened(self, rows: Array) -> tuple[Array, Array]:
        """Return A (k, m), r (k,), r = A x + noise, for coordinates x whose prior is N(0, 1)."""
        beta, M = self._plausible
        return rows[:, :-1] @ M, rows[:, -1] - rows[:, :-1] @ beta

    @cached_property
    def _plausible(self) -> tuple[Array, Array]:
        """Prior of the base parameters, beta + M x, shapes (b,) and (b, m); see ``whitened``."""
        centre, basis = self.penalty.centre / self.scale, self.space.basis
        S = self._scaled_root(self.penalty.centre)
        # the point of the subspace nearest to the centre
        away = np.linalg.lstsq(S @ basis, S @ (centre - self.space.origin), rcond=None)[0]
        nearest = self.space.origin + basis @ away
        L = scipy.linalg.qr(S @ basis, mode="r")[0][: basis.shape[1]]
        K = self.K * self.scale
        return K @ nearest, scipy.linalg.solve_triangular(L, (K @ basis).T, trans="T").T

    def covariance(
        self, weight: float, rows: Array | None = None, pi: Array | None = None
    ) -> Array:
        """Return the covariance without inequalities, (p, p), of rows (k, b + 1) at pi (p,)."""
        S = np.sqrt(weight) * self._scaled_root(self.penalty.centre if pi is None else pi)
        data = [] if rows is None else [rows[:, :-1] @ self.K * self.scale]
        stacked = np.vstack([*data, S]) @ self.space.basis
        R = scipy.linalg.qr(stacked, mode="r")[0][: stacked.shape[1]]
        inverse = scipy.linalg.solve_triangular(R, np.eye(len(R)))
        spread = self.scale[:, None] * self.space.basis @ inverse
        return np.asarray(spread @ spread.T)

    def _scaled_root(self, pi: Array) -> Array:
        """Return the root of half the penalty's Hessian, in units of the scale."""
        return np.asarray(self.penalty.root(pi) * self.scale)


def nearest(G: Array, h: Array, point: Array) -> Array | str:
    """Return the point with G x + h >= 0 nearest to a point (p,), or why there is none.

    The shortest vector under inequalities is the residual of a problem of nonnegative least squares
    (Lawson, Hanson, 1974, Solving least squares problems, chapter 23).
    """
    from scipy.optimize import nnls

    size = np.linalg.norm(G, axis=1)
    G, slack = G / size[:, None], (h + G @ point) / size
    violation = -slack.min(initial=np.inf)
    if violation <= 0:
        return point
    E = np.vstack([G.T, -slack / violation])
    goal = np.append(np.zeros(len(point)), 1.0)
    try:
        multipliers, distance = nnls(E, goal)
    except RuntimeError:  # too many iterations
        return "MaxIterations"
    if distance < _CONTRADICTED:
        return "infeasible"
    residual = E @ multipliers - goal
    return np.asarray(point - violation / residual[-1] * residual[:-1])


def _whitened(S: Array, L: Array) -> Array:
    """Return L^-1 S L^-T of symmetric matrices."""
    return np.asarray(np.linalg.solve(L, np.linalg.solve(L, S).swapaxes(-1, -2)))


@dataclass(frozen=True)
class WeightChoice:
    """How the weight of the prior was chosen."""

    weight: float
    how: str  # "cv" or "evidence"
    #: Pairs of weight and score, by ascending weight: the prediction error of held-out segments
    #: over the noise level ("cv"), or minus the log evidence.
    curve: tuple[tuple[float, float], ...]
    plausible: float  # weight with the largest log evidence
    loss: float = 0.0  # largest ratio of the held-out error of a joint to that of least squares


@dataclass(frozen=True, eq=False)
class Consistent(BatchEstimator):
    """Fit of physically consistent standard parameters, regularised by a prior.

    Minimises, over the standard parameters pi,

        sum_j |tau_j - W_b,j K pi|^2 / sigma_j^2 + prior_weight penalty(pi)

    subject to armature, viscous and Coulomb coefficients >= 0, and the other constraints. The
    penalty, twice the Bregman divergence of -log det from the prior's pseudo-inertias, is infinite
    unless each J(pi_i) - J(held_i) is positive definite; for the drives it is quadratic. The noise
    levels sigma_j are those of weighted least squares.

    The estimate contains the p standard parameters. Its covariance is that without the inequalities
    (see ``Programme.redrawn``). Its rank, condition number and undetermined names refer to the base
    parameters.

    References:
        Sousa, Cortesao (2014), Physical feasibility of robot base inertial parameter
        identification: a linear matrix inequality approach; Wensing, Kim, Slotine (2018), Linear
        Matrix Inequalities for Physically Consistent Inertial Parameter Identification, (8); Lee,
        Wensing, Park (2019), Geometric robot dynamic identification: a convex programming approach.
    """

    layout: ParameterLayout
    K: Array  # (b, p), map to the base parameters
    prior: Array  # (p,), prior values, as the URDF's
    prior_std: Array  # (p,), prior standard deviations, positive
    #: Known part of each body, as the links on locked joints, shape (10 bodies,); the rest of the
    #: body must be physically consistent. None: no known parts.
    held: Array | None = None
    prior_weight: float = 1.0
    plausible_weight: float = 1.0  # at which the prior has the spread of the true parameters
    independent_share: float = 1.0  # 2 cutoff / rate
    constraints: Constraints = field(default_factory=Constraints)
    wls_noise: Array | None = None  # (n,), noise levels of WLS [N m or N]; None: computed
    choice: WeightChoice | None = None  # of ``prior_weight``; None: it was given

    def __post_init__(self) -> None:
        p = len(self.layout.names)
        for name, shape in (("prior", (p,)), ("prior_std", (p,)), ("K", (len(self.K), p))):
            if getattr(self, name).shape != shape:
                raise DataError(f"{name} has shape {getattr(self, name).shape}, wanted {shape}")
        if not (np.isfinite(self.prior_std) & (self.prior_std > 0)).all():
            raise DataError("prior_std must be positive and finite for every parameter")
        if not np.isfinite(self.prior).all() or not np.isfinite(self._held).all():
            raise DataError("prior and held must be finite for every parameter")
        if not self.prior_weight > 0:
            raise DataError(f"prior_weight is {self.prior_weight}, wanted a positive number")
        self.constraints.check(self.layout, self.prior, self._held)

    def _fit(self, factors: Factors) -> Estimate:
        sigma = self.noise(factors)
        wls = solve_factor(factors, sigma, self.K @ self.prior)
        least_squares = wls.estimate(factors.names, wls.covariance, sigma, 0, "")
        return self._minimised(self.rows(factors, sigma), least_squares)

    def project(self, estimate: Estimate) -> Estimate:
        """Return the physically consistent standard parameters nearest to an estimate.

        Minimises (K pi - beta)^T C^-1 (K pi - beta) + prior_weight penalty(pi) under the
        constraints of ``fit``, with the covariance C of the estimate of base parameters, as that of
        a recursive estimator at any time. Parameters with infinite variance are not used.

        Raises:
            DataError: If no base parameter has a finite variance, or C is not positive definite.
            NotConvergedError: If the solver fails.
        """
        known = np.flatnonzero(np.isfinite(np.diag(estimate.covariance)))
        if not len(known):
            raise DataError(
                "the estimate has no covariance and cannot be projected; use 'rls' or "
                "'kalman', which have one"
            )
        projected = self._minimised(_information_rows(estimate, known), estimate)
        words = f"{estimate.message}; projected onto physically consistent parameters"
        return replace(projected, message=f"{words}, {projected.message}")

    def _minimised(self, rows: Array, base: Estimate) -> Estimate:
        """Return the minimum of rows (k, b + 1), from an estimate of the base parameters."""
        minimum = self.programme.minimise(rows, self.prior_weight)
        return replace(
            base,
            theta=minimum.x,
            covariance=self.programme.covariance(self.prior_weight, rows, minimum.x),
            names=self.layout.names,
            undetermined=self._undetermined(rows, base.names),
            n_iter=base.n_iter + minimum.n_iter,
            message=minimum.message,
            prior_std=self.spread_before,
            details=self._details(minimum.x),
        )

    def noise(self, factors: Factors) -> Array:
        """Return the noise levels of weighted least squares, shape (n,) [N m or N].

        They do not depend on the prior: a wrong one would otherwise make the data seem noisy. The
        parameters use as many independent rows as the trace of their leverage.
        """
        sigma, prior = self.wls_noise, self.K @ self.prior
        if sigma is None:
            sigma = WLS(prior, self.independent_share).fit(factors).sigma
        rows = np.maximum(factors.rows, 1)
        used = factors.leverages(solve_factor(factors, sigma, prior).covariance) / sigma**2
        freedom = np.maximum(rows - used / self.independent_share, _LEAST_FREEDOM * rows)
        torque = np.sqrt(factors.torque_squares() / rows)
        least = _FLOOR * np.where(torque > 0, torque, 1.0)
        level = sigma * np.sqrt(np.maximum(rows - used, 1.0) / freedom)
        return np.asarray(np.maximum(level, least))

    def rows(self, factors: Factors, sigma: Array) -> Array:
        """Return rows [R d], shape (b + 1, b + 1): |R K pi - d|^2 is the weighted cost of the data.

        The noise level of joints, sigma, has shape (n,) [N m or N].
        """
        return factors.weighted(sigma / np.sqrt(self.independent_share))

    @cached_property
    def programme(self) -> Programme:
        """The convex programme, for any data and weight."""
        E, e = self.constraints.equalities(self.layout, self.prior)
        return Programme(
            self.K,
            self.prior_std,
            Entropic.of(self.layout, self.prior, self.prior_std, self._held),
            self.constraints.bounds(self.layout, self.prior_std),
            Subspace.of(E * self.prior_std, e),
        )

    @property
    def weight_ratio(self) -> float:
        """Weight of the prior over its plausible weight, at least 1 [-].

        A large weight means that parameters near the prior explain the data: those that the data do
        not determine are as uncertain as at ``plausible_weight``.
        """
        return max(self.prior_weight / self.plausible_weight, 1.0)

    @property
    def spread_before(self) -> Array:
        """Plausible standard deviation of each parameter before the data, shape (p,)."""
        covariance = self.programme.covariance(self.prior_weight / self.weight_ratio)
        return np.asarray(np.sqrt(np.diag(covariance)))

    @property
    def _held(self) -> Array:
        """The known part of each body, shape (10 bodies,); 0 without one."""
        return np.zeros(self.layout.n_inertial) if self.held is None else self.held

    def _undetermined(self, rows: Array, base_names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the base parameters that rows (k, b + 1) do not determine individually."""
        known = self.layout.owned_by(self.constraints.pinned)
        before = base_spread(self.K, self.prior_std, known)
        return determine(base_names, rows[:, :-1], before).undetermined

    def _details(self, pi: Array) -> dict[str, Any]:
        """Return the settings of the fit and its active constraints, as plain values."""
        programme, pinned = self.programme, self.constraints.pinned
        families = [label.split(" ", 1)[0] for label in programme.bounds.labels]
        if set(self.layout.bodies) - set(pinned):
            families.append("pseudo_inertia")
        if programme.space.basis.shape[1] < len(pi):
            families.append("equalities")
        prior: dict[str, Any] = {
            "metric": "entropic",
            "weight": self.prior_weight,
            "plausible_weight": self.prior_weight / self.weight_ratio,
        }
        if self.choice is not None:
            prior["chosen_by"] = self.choice.how
            prior["curve"] = [list(pair) for pair in self.choice.curve]
        return {
            "prior": prior,
            "solver": "interior point",
            "constraints": list(dict.fromkeys(families)),
            "active": sorted(set(programme.bounds.active(pi / self.prior_std, _ACTIVE))),
            "pinned": list(pinned),
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
            "the covariance of the estimate is not positive definite, so it cannot be projected; "
            "use more samples or a prior"
        ) from error
    chosen = np.zeros((len(known), len(estimate.theta) + 1))
    chosen[np.arange(len(known)), known] = 1.0
    chosen[:, -1] = estimate.theta[known]
    return np.asarray(scipy.linalg.solve_triangular(L, chosen, lower=True))
