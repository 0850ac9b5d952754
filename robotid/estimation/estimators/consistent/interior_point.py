"""Fit with the entropic prior between linear inequalities: a primal-dual interior-point method.

    minimise    |A x - d|^2 / 2 + w (sum_i tr(P_i^-1 J_i) - log det J_i + |D (x - c)|^2 / 2)
    subject to  G x + h >= 0,  N^T (x - o) = 0

with the pseudo-inertias J_i(x) of the bodies and D of the drives. The log det is a barrier whose
weight is not reduced: Z_i J_i = w 1 at the minimum, beside lambda_j s_j = 0 of the slacks
s = G x + h. Both are followed along one central path, Z_i J_i = t 1 and lambda_j s_j = mu. In the
coordinates z of Nesterov and Todd, J_i = R_i (diag(l_i) + z_i) R_i^T, the Hessian of the barrier
is the identity, however thin a body is.

Several data sets, as the folds of a cross-validation, are fitted in one pass. They are the first
axis, f, of every array.

References:
    Nesterov, Todd (1998), Primal-dual interior-point methods for self-scaled cones; Mehrotra
    (1992), On the implementation of a primal-dual interior point method; Colombo, Gondzio (2008),
    Further development of multiple centrality correctors for interior point methods.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.exceptions import NotConvergedError
from robotid.base.typing import Array
from robotid.robot.parameters import pseudo_inertia_basis

_SIZE, _ENTRIES = 4, 10  # of a pseudo-inertia, and of its upper triangle
_MOST = 100  # steps; 8 to 20 are typical
_BACK = 0.995  # largest step as a share of the step length to the boundary
_FIRST = 1e-2  # initial t over the squared torque error of the prior, per eigenvalue
_WARM = 0.1  # initial mu near the minimum, over the weight
_SHORT = 0.3  # step length below which the correction is omitted, and mu is reduced to ...
_CENTRED = 0.3
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
class Minimum:
    """A minimum x (p,) with the multipliers of the inequalities (k,)."""

    x: Array
    multipliers: Array
    n_iter: int
    message: str


@dataclass(frozen=True, eq=False)
class EntropicProblem:
    """The problem without its data and weight; x is in units of a scale."""

    scale: Array  # (p,), unit of each parameter
    held: Array  # (10 n,), known part of each body's parameters, in these units
    P: Array  # (n, 4, 4), pseudo-inertias of the prior without the known parts
    centre: Array  # (p,), c, where the penalty is 0
    stiffness: Array  # (p - 10 n,), D of the drives
    G: Array  # (k, p), coefficients of the inequalities
    h: Array  # (k,), their constants
    N: Array  # (p, e), directions fixed by equalities, orthonormal
    origin: Array  # (p,), o, a point that meets the equalities

    def minimise(
        self,
        A: Array,
        d: Array,
        weight: float,
        tolerance: float,
        starts: Sequence[Minimum] | None = None,
    ) -> list[Minimum]:
        """Return the minimum of each data set: A (f, m, p), d (f, m)."""
        point = self._first(A, d, weight) if starts is None else self._near(starts, weight)
        found: dict[int, Minimum] = {}
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
                    found[left[k]] = Minimum(x[k], point.multipliers[k], step, name)
            if settled.all():
                return [found[k] for k in range(len(found))]
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
        return len(self.held)

    @cached_property
    def P_inverse(self) -> Array:
        """Inverse pseudo-inertias of the prior, shape (n, 4, 4)."""
        return np.asarray(np.linalg.inv(self.P))

    def bodies(self, x: Array) -> Array:
        """Return the pseudo-inertias without the known parts, shape (f, n, 4, 4): x (f, p)."""
        own = (x[:, : self.inertial] - self.held) * self.scale[: self.inertial]
        J: Array = own.reshape(len(x), -1, _ENTRIES) @ _BASIS
        return J.reshape(*J.shape[:2], _SIZE, _SIZE)

    def _first(self, A: Array, d: Array, weight: float) -> "_Point":
        """Return the prior as a point, with a t that balances penalty and data."""
        squares = np.sum((A @ self.centre - d) ** 2, axis=1)
        t = np.maximum(weight, _FIRST * squares / max(_SIZE * len(self.P), 1))[:, None]
        x = np.broadcast_to(self.centre, (len(A), len(self.centre)))
        return self._centred(x, np.zeros((len(A), len(self.h))), t, t, weight)

    def _near(self, starts: Sequence[Minimum], weight: float) -> "_Point":
        """Return points near minima."""
        x, multipliers = (
            np.array([getattr(s, key) for s in starts]) for key in ("x", "multipliers")
        )
        t = np.full((len(x), 1), weight)
        return self._centred(x, multipliers, t, _WARM * t, weight)

    def _centred(
        self, x: Array, multipliers: Array, t: Array, mu: Array, weight: float
    ) -> "_Point":
        """Return the nearest centred points: Z J = t 1, and s lambda = mu for each row."""
        inverse = np.linalg.inv(np.linalg.cholesky(self.bodies(x)))
        flat = _Coordinates.of(np.linalg.inv(inverse), self, weight)
        unit = 1.0 / np.maximum((flat.into(self.G) ** 2).sum(axis=2), 1e-300)
        gap = x @ self.G.T + self.h - unit * multipliers
        s = 0.5 * (gap + np.hypot(gap, 2.0 * np.sqrt(unit * mu)))
        s = np.maximum(s, _LEAST / np.sqrt(unit))
        return _Point(x, t[:, :, None, None] * inverse.mT @ inverse, s, mu / s)


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
    """Steps; those of the bodies are in coordinates in which J and Z are diag(l)."""

    z: Array  # (f, p)
    x: Array  # (f, p)
    J: Array  # (f, n, 4, 4)
    Z: Array  # (f, n, 4, 4)
    s: Array  # (f, k)
    multipliers: Array  # (f, k)


@dataclass(frozen=True, eq=False)
class _Coordinates:
    """Coordinates z, x = M z: J = R unsvec(z) R^T of bodies, units of the penalty for drives."""

    M: Array  # (f, n, 10, 10)
    drives: Array  # (p - 10 n,)

    @classmethod
    def of(cls, R: Array, problem: EntropicProblem, weight: float) -> "_Coordinates":
        moved = svec(R[:, :, None] @ _UNITS @ R.mT[:, :, None]) @ _TO_PARAMETERS
        own = problem.scale[: problem.inertial].reshape(-1, _ENTRIES, 1)
        return cls(moved.mT / own, 1.0 / (np.sqrt(weight) * problem.stiffness))

    def into(self, rows: Array) -> Array:
        """Return rows of coefficients of x as coefficients of z, shape (f, k, p)."""
        f, n = self.M.shape[:2]
        k, size = rows.shape[-2], _ENTRIES * n
        by_body = rows[..., :size].reshape(*rows.shape[:-1], n, _ENTRIES).swapaxes(-3, -2)
        found = np.empty((f, k, rows.shape[-1]))
        found[:, :, :size] = (by_body @ self.M).swapaxes(1, 2).reshape(f, k, size)
        found[:, :, size:] = rows[..., size:] * self.drives
        return found

    def back(self, z: Array) -> Array:
        """Return x, shape (f, p)."""
        f, n = self.M.shape[:2]
        bodies = self.M @ z[:, : _ENTRIES * n].reshape(f, n, _ENTRIES, 1)
        return np.hstack([bodies.reshape(f, -1), self.drives * z[:, _ENTRIES * n :]])


@dataclass(frozen=True, eq=False)
class _System:
    """The factorised equations of a step from each point."""

    problem: EntropicProblem
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
    def of(
        cls, problem: EntropicProblem, point: _Point, A: Array, d: Array, weight: float
    ) -> "_System":
        x, J = point.x, problem.bodies(point.x)
        L, Q = np.linalg.cholesky(J), np.linalg.cholesky(point.Z)
        U, length, Vt = np.linalg.svd(Q.mT @ L)
        R = L @ Vt.mT / np.sqrt(length)[..., None, :]
        R_inverse = (Q @ U).mT / np.sqrt(length)[..., None]
        coordinates = _Coordinates.of(R, problem, weight)
        A_z, G_z, N_z = (coordinates.into(rows) for rows in (A, problem.G, problem.N.T))
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
        self,
        t: Array | float,
        mu: Array | float,
        cross: Array | None = None,
        pairs: Array | float = 0.0,
    ) -> _Direction:
        """Return the steps to Z J = t 1, lambda s = mu: t, mu (f, 1), cross as J, pairs as s."""
        point, length, size = self.point, self.length, self.problem.inertial
        bodies = np.zeros_like(self.R_inverse)  # sum of the changes of J and Z, plus diag(l)
        if cross is not None:
            bodies -= 2.0 * cross / (length[..., :, None] + length[..., None, :])
        bodies[..., _EYE, _EYE] += np.reshape(t, (-1, 1, 1)) / length
        short = point.x @ self.problem.G.T + self.problem.h - point.s
        aim = (mu - pairs) / point.s
        right = _times(self.G.mT, aim - self.ratio * short) - self.gradient
        right[:, :size] += svec(bodies).reshape(len(right), -1)
        z = self._solve(right)
        if self.N.shape[1]:
            columns, small = self._held
            off = (point.x - self.problem.origin) @ self.problem.N
            z = z - _times(columns @ np.linalg.inv(small), _times(self.N, z) + off)
        J = unsvec(z[:, :size]).reshape(bodies.shape)
        Z = bodies - J
        Z[..., _EYE, _EYE] -= length
        s = _times(self.G, z) + short
        multipliers = aim - point.multipliers - self.ratio * s
        return _Direction(z, self.coordinates.back(z), J, Z, s, multipliers)

    @cached_property
    def _held(self) -> tuple[Array, Array]:
        """Effect of the equalities' multipliers on a step, shape (f, p, e), and on equalities."""
        columns = self._solve(self.N.mT)
        return columns, self.N @ columns

    def _solve(self, right: Array) -> Array:
        """Return the solutions of the equations of each point."""
        pairs = zip(self.roots, right, strict=True)
        return np.array([scipy.linalg.lapack.dpotrs(L, b, lower=True)[0] for L, b in pairs])

    def corrected(self, ahead: _Direction, share: Array) -> _Point:
        """Return the points after a corrected step (Mehrotra's predictor and corrector)."""
        point, share = self.point, share[:, None]
        mean = (self.length**2).mean(axis=(1, 2))[:, None]
        mu = _mean(point.multipliers * point.s)
        left, crossed = (1.0 - share) ** 3, 0.5 * (ahead.J @ ahead.Z + ahead.Z @ ahead.J)

        def aimed(left: Array, trust: Array) -> tuple[_Direction, Array]:
            pairs = trust * ahead.s * ahead.multipliers
            t = self.weight + left * np.maximum(mean - self.weight, 0.0)
            step = self.direction(t, left * mu, trust[:, :, None, None] * crossed, pairs)
            return step, np.minimum(1.0, _BACK * self.to_boundary(step))[:, None]

        step, length = aimed(left, share)
        short = length < np.minimum(_SHORT, 0.5 * share)
        if short.any():
            left = np.where(short, np.maximum(left, _CENTRED), left)
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


def _mean(x: Array) -> Array:
    """Return the means along the last axis, which stays; 0 for an empty axis."""
    return np.asarray(x.sum(axis=-1, keepdims=True) / max(x.shape[-1], 1))


def _to_zero(x: Array, step: Array) -> Array:
    """Return the step length at which positive x reaches 0, shape (f,)."""
    multiples = np.divide(-x, step, out=np.full_like(x, np.inf), where=step < 0)
    return np.asarray(multiples.min(axis=-1, initial=np.inf))


def _times(A: Array, x: Array) -> Array:
    """Return the product of each matrix and vector, shape (f, m)."""
    return np.asarray((A @ x[..., None])[..., 0])
