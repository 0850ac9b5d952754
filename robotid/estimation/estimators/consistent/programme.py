"""The convex programme of a consistent fit: data and entropic prior between bounds, any weight."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.typing import Array
from robotid.estimation.estimators.consistent.body_constraints import Bounds, Subspace
from robotid.estimation.estimators.consistent.interior_point import EntropicProblem, Minimum, svec
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


@dataclass(frozen=True, eq=False)
class Entropic:
    """2 sum_i d(J_i || P_i) of the bodies plus |(pi - centre) / std|^2 of the drives.

    d(J || P) = tr(P^-1 J) - log det(P^-1 J) - 4 is the Bregman divergence of -log det. It does not
    depend on the frame of a body; near the prior the penalty is about |delta / std|^2.

    Attributes:
        centre: Prior values, shape (p,).
        precision: 1 / std^2 of the drives, shape (drives,).
        held: Known part of each body, shape (10 bodies,).

    References:
        Lee, Wensing, Park (2019), Geometric robot dynamic identification: a convex programming
        approach, (22), (24), (32).
    """

    centre: Array
    precision: Array
    held: Array

    @classmethod
    def of(cls, layout: ParameterLayout, prior: Array, std: Array, held: Array) -> "Entropic":
        """Return the penalty: prior (p,), std (p,), held (10 bodies,).

        If the pseudo-inertia of a prior is not physically consistent or its relative thickness is
        below 1 %, its eigenvalues are increased to 1 % first.
        """
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

        For a thin body the root is computed directly: its second derivative has a condition number
        too large to be factorised. With J = L L^T it is g_kl = tr(C_k C_l), C_k = L^-1 B_k L^-T.
        """
        L = self._prior_factor @ np.linalg.cholesky(self._ratio(pi))
        C = _whitened(pseudo_inertia_basis()[None], L[:, None])  # (n, 10, 4, 4)
        bodies = np.linalg.qr(svec(C).mT, mode="r")
        S: Array = scipy.linalg.block_diag(*bodies, np.diag(np.sqrt(self.precision)))
        return S

    def hessian(self, pi: Array) -> Array:
        """Return its second derivative, shape (p, p), positive definite: pi (p,)."""
        S = self.root(pi)
        H: Array = 2.0 * S.T @ S
        return H

    @cached_property
    def prior(self) -> Array:
        """The pseudo-inertias P of the prior without the known parts, shape (n, 4, 4)."""
        return self._rest(self.centre)

    @cached_property
    def _prior_factor(self) -> Array:
        """The factors L of the priors P = L L^T of the bodies."""
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

    Attributes:
        K: Map to the base parameters, shape (b, p).
        scale: Unit of each parameter, shape (p,): bounds and subspace are in x = pi / scale.
        penalty: Distance from the prior.
        bounds: The inequalities.
        space: Subspace of the points that meet the equalities.
    """

    K: Array
    scale: Array
    penalty: Entropic
    bounds: Bounds
    space: Subspace

    def minimise(
        self, rows: Array, weight: float, *, is_exact: bool = True, start: Minimum | None = None
    ) -> Minimum:
        """Return the minimum of rows (k, b + 1); its x is pi, shape (p,)."""
        starts = None if start is None else [start]
        return self.minimise_each(rows[None], weight, is_exact=is_exact, starts=starts)[0]

    def minimise_each(
        self,
        rows: Array,
        weight: float,
        *,
        is_exact: bool = True,
        starts: Sequence[Minimum] | None = None,
    ) -> list[Minimum]:
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
        """Return the distances of fits to resampled data and prior from this fit.

        Noise of the data has the covariance of their score. Noise of the prior has the covariance
        of the plausible prior. Both move the minimum without the inequalities, with the penalty
        expanded at the fit; the nearest point within the bounds, in the metric of the fit, is the
        minimum with them.

        References:
            Bardsley, Fox (2012), An MCMC method for uncertainty quantification in nonnegativity
            constrained inverse problems, section 3.

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
        found = [y for y in solved if not isinstance(y, str)]
        failures = [status for status in solved if isinstance(status, str)]
        return self.scale * (np.array(found).reshape(-1, len(R)) @ prior.T), failures

    def objective(self, rows: Array, pi: Array, weight: float) -> float:
        """Return the squared residual plus the weighted penalty [-]: rows (k, b + 1), pi (p,)."""
        residual = rows[:, :-1] @ (self.K @ pi) - rows[:, -1]
        return float(residual @ residual + weight * self.penalty.value(pi))

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
        covariance: Array = spread @ spread.T
        return covariance

    def _scaled_root(self, pi: Array) -> Array:
        """Return the root of half the penalty's Hessian, in units of the scale."""
        scaled: Array = self.penalty.root(pi) * self.scale
        return scaled


def nearest(G: Array, h: Array, point: Array) -> Array | str:
    """Return the point with G x + h >= 0 nearest to a point (p,), or why there is none.

    References:
        Lawson, Hanson (1974), Solving least squares problems, chapter 23: the shortest vector
        under inequalities is the residual of a problem of nonnegative least squares.
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
    shifted: Array = point - violation / residual[-1] * residual[:-1]
    return shifted


def _whitened(S: Array, L: Array) -> Array:
    """Return L^-1 S L^-T of symmetric matrices."""
    half = np.linalg.solve(L, S)
    whitened: Array = np.linalg.solve(L, half.swapaxes(-1, -2))
    return whitened
