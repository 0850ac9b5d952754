"""Fit with the entropic prior between linear inequalities: a primal-dual interior-point method.

    minimise    |A x - d|^2 / 2 + w (sum_i tr(P_i^-1 J_i) - log det J_i + |D (x - c)|^2 / 2)
    subject to  G x + h >= 0,  N^T (x - o) = 0

with the pseudo-inertias J_i(x) of the bodies and D of the drives. The log det is a barrier whose
weight is not reduced: Z_i J_i = w 1 at the minimum, beside lambda_j s_j = 0 of the slacks s = G x +
h. Both are followed along one central path, Z_i J_i = t 1 and lambda_j s_j = mu. In the coordinates
z of Nesterov and Todd, J_i = R_i (diag(l_i) + z_i) R_i^T, the Hessian of the barrier is the
identity, however thin a body is. Several data sets are the first axis, f, of every array.

Nesterov, Todd (1998), Primal-dual interior-point methods for self-scaled cones; Mehrotra (1992), On
the implementation of a primal-dual interior point method; Colombo, Gondzio (2008), Further
development of multiple centrality correctors for interior point methods.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.exceptions import NotConvergedError
from robotid.base.tolerances import ROUNDING
from robotid.base.typing import Array
from robotid.robot.parameters import (
    ParameterLayout,
    inertial_from_pseudo_inertia,
    pseudo_inertia,
    pseudo_inertia_basis,
)

_ROUGH = 1e-6  # ... and at which it is sufficient for a prediction
_TOGETHER = 2**17  # entries of the data sets that are fitted in one pass: they fit into a cache
_CONTRADICTED = 1e-7  # distance of the NNLS problem below which the inequalities contradict
_THINNEST = 0.01  # smallest relative thickness of a prior's pseudo-inertia
_ENTRIES, _SIZE, _ = pseudo_inertia_basis().shape  # of an upper triangle, of a pseudo-inertia
_MOST = 100  # steps; 8 to 20 are typical
_BACK = 0.995  # largest step as a share of the step length to the boundary
_FIRST = 1e-2  # initial t over the squared torque error of the prior, per eigenvalue
_WARM = 0.1  # initial mu near the minimum, over the weight
_SHORT = 0.3  # step length below which the correction is omitted, and share of mu that then stays
_LEAST = 1e-10  # smallest slack of an active inequality, in prior standard deviations
_EYE = np.arange(_SIZE)
_COLUMNS, _ROWS = np.tril_indices(_SIZE)  # of an upper triangle by columns
_FACTORS = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(2.0))


def svec(S: Array) -> Array:
    """Return upper triangles of (..., 4, 4) by columns, (..., 10), off-diagonals times sqrt 2."""
    return S[..., _ROWS, _COLUMNS] * _FACTORS


def unsvec(vectors: Array) -> Array:
    """Return the matrices (m, 4, 4) of stacked vectors (10 m,); the inverse of ``svec``."""
    entries = vectors.reshape(-1, _ENTRIES) / _FACTORS
    S = np.zeros((len(entries), _SIZE, _SIZE))
    S[:, _ROWS, _COLUMNS] = S[:, _COLUMNS, _ROWS] = entries
    return S


_BASIS = pseudo_inertia_basis().reshape(_ENTRIES, _SIZE * _SIZE)  # J = sum_k pi_k B_k
_TO_PARAMETERS = np.linalg.inv(svec(pseudo_inertia_basis()))  # pi = svec(J) @ .
_UNITS = unsvec(np.eye(_ENTRIES))  # (10, 4, 4), whose svec are unit vectors


@dataclass(frozen=True, eq=False)
class Bounds:
    """The points x with G x + h >= 0."""

    G: Array  # (k, p)
    h: Array  # (k,)
    labels: tuple[str, ...]  # family and owner of each row, as "mass forearm"

    def active(self, x: Array, tolerance: float) -> tuple[str, ...]:
        """Return the labels of the rows that are active at x (p,)."""
        return tuple(self.labels[k] for k in np.flatnonzero(self.G @ x + self.h < tolerance))


@dataclass(frozen=True, eq=False)
class Subspace:
    """The subspace x = origin + basis y of the points that meet equalities."""

    origin: Array  # (p,), a point that meets them
    basis: Array  # (p, r), free directions, orthonormal

    @classmethod
    def of(cls, E: Array, e: Array) -> "Subspace":
        """Return the points with E x = e, in the least squares sense: E (k, p), e (k,)."""
        p = E.shape[1]
        if not len(E):
            return cls(np.zeros(p), np.eye(p))
        is_free = ~E.any(axis=0)
        inner = scipy.linalg.null_space(E[:, ~is_free])
        basis = np.zeros((p, is_free.sum() + inner.shape[1]))
        basis[is_free, : is_free.sum()] = np.eye(is_free.sum())
        basis[~is_free, is_free.sum() :] = inner
        return cls(np.linalg.lstsq(E, e, rcond=None)[0], basis)

    @cached_property
    def fixed(self) -> Array:
        """Fixed directions, shape (p, p - r), orthonormal."""
        p, r = self.basis.shape
        return np.asarray(np.zeros((p, 0)) if r == p else scipy.linalg.null_space(self.basis.T))


@dataclass(frozen=True, eq=False)
class Minimum:
    """A minimum x (p,) with the multipliers of the inequalities (k,)."""

    x: Array
    multipliers: Array
    n_iter: int
    message: str


@dataclass(frozen=True, eq=False)
class Entropic:
    """2 sum_i d(J_i || P_i) of the bodies plus |(pi - centre) / std|^2 of the drives.

    d(J || P) = tr(P^-1 J) - log det(P^-1 J) - 4 is the Bregman divergence of -log det, in any
    frame; near the prior it is about |delta / std|^2. Lee, Wensing, Park (2019), Geometric robot
    dynamic identification: a convex programming approach, (22), (24), (32).
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
        if (values[:, 0] <= ROUNDING * np.maximum(values[:, 3], 1.0)).any():
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

        With J = L L^T it is g_kl = tr(C_k C_l), C_k = L^-1 B_k L^-T: that of a thin body is too ill
        conditioned to be factorised.
        """
        L = np.linalg.cholesky(self.prior) @ np.linalg.cholesky(self._ratio(pi))
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

    def _ratio(self, pi: Array) -> Array:
        """Return L^-1 J L^-T of each body, dimensionless, 1 at the prior P = L L^T."""
        return _whitened(self._rest(pi), np.linalg.cholesky(self.prior))

    def _rest(self, pi: Array) -> Array:
        return pseudo_inertia(pi[: len(self.held)] - self.held)

    def _drives(self, pi: Array) -> Array:
        return (pi - self.centre)[len(self.held) :]


@dataclass(frozen=True, eq=False)
class Programme:
    """Minimise |rows [K pi; -1]|^2 + weight penalty(pi) between bounds: bodies stay consistent."""

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
        A, d = rows[:, :, :-1] @ (self.K * self.scale), rows[:, :, -1]
        minima: list[Minimum] = []
        most = max(1, _TOGETHER // A[0].size)
        for k in (slice(first, first + most) for first in range(0, len(A), most)):
            if starts is None:
                point = self._first(A[k], d[k], weight)
            else:
                point = self._near(starts[k], weight)
            minima += self._descended(point, A[k], d[k], weight, ROUNDING if is_exact else _ROUGH)
        return minima

    def _descended(
        self, point: "_Point", A: Array, d: Array, weight: float, tolerance: float
    ) -> list[Minimum]:
        """Return the minimum of each data set from a point: A (f, m, p), d (f, m)."""
        minima: dict[int, Minimum] = {}
        left = np.arange(len(A))  # data sets that have not converged
        for step in range(1, _MOST + 1):
            try:
                system = _System.of(self, point, A, d, weight)
            except np.linalg.LinAlgError:  # inequalities contradict each other
                break
            ahead = system.direction(weight, 0.0)
            share = np.minimum(1.0, system.to_boundary(ahead))
            settled = system.is_settled(ahead, share, tolerance)
            if settled.any():
                length = np.minimum(share, _BACK * system.bodies_to_boundary(ahead))
                x, name = point.x + length[:, None] * ahead.x, f"interior point, {step} steps"
                for k in np.flatnonzero(settled):
                    x_k = x[k] * self.scale
                    minima[left[k]] = Minimum(x_k, point.multipliers[k], step, name)
            if settled.all():
                return [minima[k] for k in range(len(minima))]
            point = system.corrected(ahead, share)
            if settled.any():
                A, d, left, point = A[~settled], d[~settled], left[~settled], point.of(~settled)
        raise NotConvergedError(
            f"the fit has not converged after {step} steps at prior_weight = {weight:g}; set a "
            "larger prior_weight, or widen the bounds in [estimator.constraints]",
            "max_iterations",
        )

    @property
    def inertial(self) -> int:
        """Number of inertial parameters; they are the first ones."""
        return len(self.penalty.held)

    @cached_property
    def centre(self) -> Array:
        """Centre of the penalty in units of the scale, shape (p,)."""
        return self.penalty.centre / self.scale

    @cached_property
    def stiffness(self) -> Array:
        """Stiffness of the penalty of the drives, D."""
        return np.sqrt(self.penalty.precision) * self.scale[self.inertial :]

    @cached_property
    def P_inverse(self) -> Array:
        """Inverse pseudo-inertias of the prior, shape (n, 4, 4)."""
        return np.asarray(np.linalg.inv(self.penalty.prior))

    def bodies(self, x: Array) -> Array:
        """Return the pseudo-inertias without the known parts, shape (f, n, 4, 4): x (f, p)."""
        scale = self.scale[: self.inertial]
        pi = (x[:, : self.inertial] - self.penalty.held / scale) * scale
        J: Array = pi.reshape(len(x), -1, _ENTRIES) @ _BASIS
        return J.reshape(*J.shape[:2], _SIZE, _SIZE)

    def _first(self, A: Array, d: Array, weight: float) -> "_Point":
        """Return the prior as a point, with a t that balances penalty and data."""
        squares = np.sum((A @ self.centre - d) ** 2, axis=1)
        t = np.maximum(weight, _FIRST * squares / max(_SIZE * len(self.penalty.prior), 1))[:, None]
        x = np.broadcast_to(self.centre, (len(A), len(self.centre)))
        return self._centred(x, np.zeros((len(A), len(self.bounds.h))), t, t, weight)

    def _near(self, starts: Sequence[Minimum], weight: float) -> "_Point":
        """Return points near minima."""
        x = np.array([start.x / self.scale for start in starts])
        multipliers = np.array([start.multipliers for start in starts])
        t = np.full((len(x), 1), weight)
        return self._centred(x, multipliers, t, _WARM * t, weight)

    def _centred(
        self, x: Array, multipliers: Array, t: Array, mu: Array, weight: float
    ) -> "_Point":
        """Return the nearest centred points: Z J = t 1, and s lambda = mu for each row."""
        inverse = np.linalg.inv(np.linalg.cholesky(self.bodies(x)))
        flat = _Coordinates.of(np.linalg.inv(inverse), self, weight)
        unit = 1.0 / np.maximum((flat.into(self.bounds.G) ** 2).sum(axis=2), 1e-300)
        gap = x @ self.bounds.G.T + self.bounds.h - unit * multipliers
        s = 0.5 * (gap + np.hypot(gap, 2.0 * np.sqrt(unit * mu)))
        s = np.maximum(s, _LEAST / np.sqrt(unit))
        return _Point(x, t[:, :, None, None] * inverse.mT @ inverse, s, mu / s)

    def redrawn(
        self, rows: Array, weight: float, pi: Array, meat: Array, weight_ratio: float, draws: int,
        rng: np.random.Generator,
    ) -> tuple[Array, list[str]]:  # fmt: skip
        """Return the distances (m, p) of fits to resampled data and prior, and failures.

        Noise of the data has the covariance of their score, meat (b, b), that of the prior the
        covariance of the plausible prior. Both move the minimum pi (p,) of rows (k, b + 1) without
        the inequalities, with the penalty expanded at the fit; the nearest point within the bounds,
        in the metric of the fit, is the minimum with them (Bardsley, Fox, 2012, An MCMC method for
        uncertainty quantification in nonnegativity constrained inverse problems, section 3).
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
        basis, K = self.space.basis, self.K * self.scale
        S = self._scaled_root(self.penalty.centre)
        # the point of the subspace nearest to the centre
        away = np.linalg.lstsq(S @ basis, S @ (self.centre - self.space.origin), rcond=None)[0]
        beta = K @ (self.space.origin + basis @ away)
        L = scipy.linalg.qr(S @ basis, mode="r")[0][: basis.shape[1]]
        M = scipy.linalg.solve_triangular(L, (K @ basis).T, trans="T").T
        return rows[:, :-1] @ M, rows[:, -1] - rows[:, :-1] @ beta

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


@dataclass(frozen=True, eq=False)
class _Point:
    """Points of the paths."""

    x: Array  # (f, p)
    Z: Array  # (f, n, 4, 4)
    s: Array  # (f, k)
    multipliers: Array  # (f, k), lambda

    def of(self, which: Array) -> "_Point":
        """Return the points of some data sets."""
        return _Point(*(getattr(self, key)[which] for key in ("x", "Z", "s", "multipliers")))


@dataclass(frozen=True, eq=False)
class _Direction:
    """Steps, shaped as ``_Point``; of the bodies in coordinates in which J and Z are diag(l)."""

    z: Array  # (f, p)
    x: Array
    J: Array
    Z: Array
    s: Array
    multipliers: Array


@dataclass(frozen=True, eq=False)
class _Coordinates:
    """Coordinates z, x = M z: J = R unsvec(z) R^T of bodies, units of the penalty for drives."""

    M: Array  # (f, n, 10, 10)
    drives: Array  # (p - 10 n,)

    @classmethod
    def of(cls, R: Array, problem: Programme, weight: float) -> "_Coordinates":
        moved = svec(R[:, :, None] @ _UNITS @ R.mT[:, :, None]) @ _TO_PARAMETERS
        scale = problem.scale[: problem.inertial].reshape(-1, _ENTRIES, 1)
        return cls(moved.mT / scale, 1.0 / (np.sqrt(weight) * problem.stiffness))

    def into(self, rows: Array) -> Array:
        """Return rows of coefficients of x as coefficients of z, shape (f, k, p)."""
        f, n = self.M.shape[:2]
        k, size = rows.shape[-2], _ENTRIES * n
        by_body = rows[..., :size].reshape(*rows.shape[:-1], n, _ENTRIES).swapaxes(-3, -2)
        in_z = np.empty((f, k, rows.shape[-1]))
        in_z[:, :, :size] = (by_body @ self.M).swapaxes(1, 2).reshape(f, k, size)
        in_z[:, :, size:] = rows[..., size:] * self.drives
        return in_z

    def back(self, z: Array) -> Array:
        """Return x, shape (f, p)."""
        f, n = self.M.shape[:2]
        bodies = self.M @ z[:, : _ENTRIES * n].reshape(f, n, _ENTRIES, 1)
        return np.hstack([bodies.reshape(f, -1), self.drives * z[:, _ENTRIES * n :]])


@dataclass(frozen=True, eq=False)
class _System:
    """The factorised equations of a step from each point."""

    problem: Programme
    point: _Point
    weight: float
    R_inverse: Array  # (f, n, 4, 4): R^-1 J R^-T = R^T Z R = diag(l)
    length: Array  # (f, n, 4), l
    coordinates: _Coordinates
    A: Array  # coefficients in z
    G: Array
    N: Array
    gradient: Array  # (f, p), without log det and inequalities, in z
    value: Array  # (f,), twice the objective
    ratio: Array  # (f, k), lambda / s
    roots: list[Array]  # lower triangles of the Hessians

    @classmethod
    def of(cls, problem: Programme, point: _Point, A: Array, d: Array, weight: float) -> "_System":
        x, J = point.x, problem.bodies(point.x)
        L, Q = np.linalg.cholesky(J), np.linalg.cholesky(point.Z)
        U, length, Vt = np.linalg.svd(Q.mT @ L)
        R = L @ Vt.mT / np.sqrt(length)[..., None, :]
        R_inverse = (Q @ U).mT / np.sqrt(length)[..., None]
        coordinates = _Coordinates.of(R, problem, weight)
        A_z, G_z, N_z = (
            coordinates.into(rows) for rows in (A, problem.bounds.G, problem.space.fixed.T)
        )
        residual = _times(A, x) - d
        drives = problem.stiffness * (x - problem.centre)[:, problem.inertial :]
        slope = weight * svec(R.mT @ problem.P_inverse @ R).reshape(len(x), -1)
        gradient = _times(A_z.mT, residual)
        gradient += np.hstack([slope, np.sqrt(weight) * drives])
        ratio = point.multipliers / point.s
        rows = np.concatenate([A_z, np.sqrt(ratio)[:, :, None] * G_z], axis=1)
        PJ = problem.P_inverse @ J
        divergence = PJ.trace(axis1=2, axis2=3) - np.linalg.slogdet(PJ)[1] - _SIZE
        penalty = 2.0 * divergence.sum(axis=1) + (drives**2).sum(axis=1)
        return cls(
            problem, point, weight, R_inverse, length, coordinates, A_z, G_z, N_z, gradient,
            (residual**2).sum(axis=1) + weight * penalty, ratio,
            [_root(B.T @ B) for B in rows],
        )  # fmt: skip

    def direction(
        self, t: Array | float, mu: Array | float, cross: Array | None = None,
        pairs: Array | float = 0.0,
    ) -> _Direction:  # fmt: skip
        """Return the steps to Z J = t 1, lambda s = mu: t, mu (f, 1), cross as J, pairs as s."""
        point, length, size = self.point, self.length, self.problem.inertial
        bodies = np.zeros_like(self.R_inverse)  # sum of the changes of J and Z, plus diag(l)
        if cross is not None:
            bodies -= 2.0 * cross / (length[..., :, None] + length[..., None, :])
        bodies[..., _EYE, _EYE] += np.reshape(t, (-1, 1, 1)) / length
        short = point.x @ self.problem.bounds.G.T + self.problem.bounds.h - point.s
        aim = (mu - pairs) / point.s
        right = _times(self.G.mT, aim - self.ratio * short) - self.gradient
        right[:, :size] += svec(bodies).reshape(len(right), -1)
        z = self._solve(right)
        if self.N.shape[1]:
            off = (point.x - self.problem.space.origin) @ self.problem.space.fixed
            z = z - _times(self._to_fixed, _times(self.N, z) + off)
        J = unsvec(z[:, :size]).reshape(bodies.shape)
        Z = bodies - J
        Z[..., _EYE, _EYE] -= length
        s = _times(self.G, z) + short
        multipliers = aim - point.multipliers - self.ratio * s
        return _Direction(z, self.coordinates.back(z), J, Z, s, multipliers)

    @cached_property
    def _to_fixed(self) -> Array:
        """The smallest step, in the Hessian's metric, per violation of equalities, (f, p, e)."""
        columns = self._solve(self.N.mT)
        return np.asarray(columns @ np.linalg.inv(self.N @ columns))

    def _solve(self, right: Array) -> Array:
        """Return the solutions of the equations of each point."""
        pairs = zip(self.roots, right, strict=True)
        return np.array([scipy.linalg.lapack.dpotrs(L, b, lower=True)[0] for L, b in pairs])

    def corrected(self, ahead: _Direction, share: Array) -> _Point:
        """Return the points after a corrected step (Mehrotra's predictor and corrector)."""
        point, share = self.point, share[:, None]
        mean = (self.length**2).mean(axis=(1, 2))[:, None]
        products = point.multipliers * point.s
        mu = products.sum(axis=1, keepdims=True) / max(products.shape[1], 1)
        left, crossed = (1.0 - share) ** 3, 0.5 * (ahead.J @ ahead.Z + ahead.Z @ ahead.J)

        def aimed(left: Array, trust: Array) -> tuple[_Direction, Array]:
            pairs = trust * ahead.s * ahead.multipliers
            t = self.weight + left * np.maximum(mean - self.weight, 0.0)
            step = self.direction(t, left * mu, trust[:, :, None, None] * crossed, pairs)
            return step, np.minimum(1.0, _BACK * self.to_boundary(step))[:, None]

        step, length = aimed(left, share)
        short = length < np.minimum(_SHORT, 0.5 * share)
        if short.any():
            left = np.where(short, np.maximum(left, _SHORT), left)
            step, length = aimed(left, np.where(short, 0.0, share))
        Z = self.R_inverse.mT @ step.Z @ self.R_inverse
        return _Point(
            point.x + length * step.x,
            point.Z + length[:, :, None, None] * Z,
            np.maximum(point.s + length * step.s, _LEAST * np.sqrt((self.G**2).sum(axis=2))),
            point.multipliers + length * step.multipliers,
        )

    def to_boundary(self, step: _Direction) -> Array:
        """Return the step length to the boundary for each step, shape (f,)."""
        x = np.hstack([self.point.s, self.point.multipliers])
        rows = _to_zero(x, np.hstack([step.s, step.multipliers]))
        return np.minimum(self.bodies_to_boundary(step), rows)

    def bodies_to_boundary(self, step: _Direction) -> Array:
        """Return the step length to the boundary of positive definite J and Z, shape (f,)."""
        root = np.sqrt(self.length)
        unit = root[..., :, None] * root[..., None, :]
        lowest = np.linalg.eigvalsh(np.hstack([step.J / unit, step.Z / unit]))[..., 0]
        return _to_zero(np.ones_like(lowest), lowest)

    def is_settled(self, ahead: _Direction, share: Array, tolerance: float) -> Array:
        """Return whether the step to each minimum is negligible, shape (f,), bool: share (f,)."""
        nothing = tolerance * (1.0 + self.value)
        decrease = (_times(self.A, ahead.z) ** 2).sum(axis=1) + (ahead.z**2).sum(axis=1)
        return np.asarray((share > 0.5) & (decrease <= nothing))


def _root(A: Array) -> Array:
    """Return L with L L^T = A + 1, shape (p, p), in the lower triangle."""
    A.flat[:: len(A) + 1] += 1.0
    L, info = scipy.linalg.lapack.dpotrf(A.T, lower=True, clean=False, overwrite_a=True)
    if info:
        raise np.linalg.LinAlgError(f"the Hessian is not positive definite in row {info}")
    return np.asarray(L)


def _to_zero(x: Array, step: Array) -> Array:
    """Return the step length at which positive x reaches 0, shape (f,)."""
    multiples = np.divide(-x, step, out=np.full_like(x, np.inf), where=step < 0)
    return np.asarray(multiples.min(axis=-1, initial=np.inf))


def _times(A: Array, x: Array) -> Array:
    """Return the product of each matrix and vector, shape (f, m)."""
    return np.asarray((A @ x[..., None])[..., 0])


def nearest(G: Array, h: Array, point: Array) -> Array | str:
    """Return the point with G x + h >= 0 nearest to a point (p,), or why there is none.

    It is the residual of nonnegative least squares (Lawson, Hanson, 1974, Solving least squares
    problems, chapter 23).
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
