"""Fit with the entropic prior between linear inequalities: a primal-dual interior-point method.

    minimise    |A x - d|^2 / 2 + w (sum_i tr(P_i^-1 J_i) - log det J_i + |D (x - c)|^2 / 2)
    subject to  G x + h >= 0,  N^T (x - o) = 0

with the pseudo-inertias J_i(x) of the bodies and D of the drives. The log det is a barrier whose
weight is not reduced: Z_i J_i = w 1 at the minimum, beside lambda_j s_j = 0 of the slacks
s = G x + h. Both are followed along one central path, Z_i J_i = t 1 and lambda_j s_j = mu. In the
coordinates z of Nesterov and Todd, J_i = R_i (diag(l_i) + z_i) R_i^T, the Hessian of the barrier
is the identity, however thin a body is.

References:
    Nesterov, Todd (1998), Primal-dual interior-point methods for self-scaled cones; Mehrotra
    (1992), On the implementation of a primal-dual interior point method; Colombo, Gondzio (2008),
    Further development of multiple centrality correctors for interior point methods.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.estimators.consistent.cones import ConeSolution, svec, unsvec
from robotid.exceptions import NotConvergedError
from robotid.robot.parameters import pseudo_inertia_basis

__all__ = ["EntropicProblem"]

_SIZE, _ENTRIES = 4, 10  # of a pseudo-inertia, and of its upper triangle
_EYE = np.arange(_SIZE)
_BASIS = pseudo_inertia_basis().reshape(_ENTRIES, _SIZE * _SIZE)  # J = sum_k pi_k B_k
_TO_PARAMETERS = np.linalg.inv(svec(pseudo_inertia_basis()))  # pi = svec(J) @ .
_UNITS = unsvec(np.eye(_ENTRIES).reshape(-1))  # (10, 4, 4), whose svec are unit vectors
_MOST = 100  # steps; 8 to 20 are usual
_BACK = 0.995  # share of the way to the boundary that a step goes at most
_FIRST = 1e-2  # t at the start, over what the prior's torque misses by, per eigenvalue
_WARM = 0.1  # mu at a start near the minimum, over the weight
_SHORT = 0.3  # share of a step below which its correction is left out, and mu reduced to ...
_CENTRED = 0.3
_LEAST = 1e-10  # slack of an inequality that binds, in units of the prior's spread


@dataclass(frozen=True, eq=False)
class EntropicProblem:
    """The problem but for its data and weight; x is in units of a scale.

    Attributes:
        scale: Unit of each parameter, shape (p,).
        held: Known share of each body's parameters, shape (10 n,), in these units.
        P: Pseudo-inertias of the prior beside what is held, shape (n, 4, 4), positive definite.
        centre: c, where the penalty is 0, shape (p,).
        stiffness: D of the drives, shape (p - 10 n,).
        G: Coefficients of the inequalities, shape (k, p).
        h: Their constants, shape (k,).
        N: Directions that equalities hold, shape (p, e), orthonormal.
        origin: o, a point that meets them, shape (p,).
    """

    scale: Array
    held: Array
    P: Array
    centre: Array
    stiffness: Array
    G: Array
    h: Array
    N: Array
    origin: Array

    def minimise(
        self, A: Array, d: Array, weight: float, tolerance: float, start: ConeSolution | None = None
    ) -> ConeSolution:
        """Return the minimum.

        Args:
            A: Coefficients of the data, shape (m, p).
            d: Their right-hand side, shape (m,).
            weight: Weight w of the prior.
            tolerance: Share of the objective by which another step would lower it at most.
            start: Minimum of nearly the same data, or at another weight.

        Raises:
            NotConvergedError: If it is not found in 100 steps, as where inequalities contradict
                each other.
        """
        point = self._first(A, d, weight) if start is None else self._near(start, weight)
        for step in range(1, _MOST + 1):
            try:
                system = _System.of(self, point, A, d, weight)
            except np.linalg.LinAlgError:  # where inequalities contradict each other
                break
            ahead = system.direction(weight, 0.0)
            share = min(1.0, system.reach(ahead))
            if system.is_settled(ahead, share, tolerance):
                x = point.x + min(share, _BACK * system.reach_of_bodies(ahead)) * ahead.x
                return ConeSolution(x, step, f"interior point, {step} steps", point.multipliers)
            point = system.corrected(ahead, share)
        raise NotConvergedError(
            f"the fit still changes after {step} steps at a prior weight of {weight:g}; use the "
            "'euclidean' prior or a larger weight",
            "max_iterations",
        )

    @property
    def inertial(self) -> int:
        """Number of inertial parameters, which come first."""
        return len(self.held)

    @cached_property
    def P_inverse(self) -> Array:
        """The inverses of the prior's pseudo-inertias, shape (n, 4, 4)."""
        return np.asarray(np.linalg.inv(self.P))

    def bodies(self, x: Array) -> Array:
        """Return the pseudo-inertias beside what is held, shape (n, 4, 4).

        Args:
            x: A point, shape (p,).
        """
        own = (x[: self.inertial] - self.held) * self.scale[: self.inertial]
        J: Array = (own.reshape(-1, _ENTRIES) @ _BASIS).reshape(-1, _SIZE, _SIZE)
        return J

    def _first(self, A: Array, d: Array, weight: float) -> "_Point":
        """Return the prior, at a t by which it is about as far from the data as from itself."""
        best = np.linalg.lstsq(A, d, rcond=None)[0]
        missed = float(np.sum((A @ (self.centre - best)) ** 2))
        t = max(weight, _FIRST * missed / max(_SIZE * len(self.P), 1))
        return self._centred(self.centre, np.zeros(len(self.h)), t, t, weight)

    def _near(self, start: ConeSolution, weight: float) -> "_Point":
        """Return a point beside a minimum."""
        multipliers = np.zeros(len(self.h)) if start.multipliers is None else start.multipliers
        return self._centred(start.x, multipliers, weight, _WARM * weight, weight)

    def _centred(
        self, x: Array, multipliers: Array, t: float, mu: float, weight: float
    ) -> "_Point":
        """Return the centred point that is nearest: Z J = t 1, and s lambda = mu of each row."""
        inverse = np.linalg.inv(np.linalg.cholesky(self.bodies(x)))
        flat = _Coordinates.of(np.linalg.inv(inverse), self, weight)
        unit = 1.0 / np.maximum((flat.into(self.G) ** 2).sum(axis=1), 1e-300)
        gap = self.G @ x + self.h - unit * multipliers
        s = 0.5 * (gap + np.hypot(gap, 2.0 * np.sqrt(unit * mu)))
        s = np.maximum(s, _LEAST / np.sqrt(unit))
        return _Point(x, t * inverse.swapaxes(1, 2) @ inverse, s, mu / s)


@dataclass(frozen=True, eq=False)
class _Point:
    """A point of the path, or a step along it."""

    x: Array  # (p,)
    Z: Array  # (n, 4, 4)
    s: Array  # (k,)
    multipliers: Array  # (k,), lambda


@dataclass(frozen=True, eq=False)
class _Direction:
    """A step, of the bodies in coordinates in which J and Z are diag(l)."""

    z: Array  # (p,)
    x: Array  # (p,)
    J: Array  # (n, 4, 4)
    Z: Array  # (n, 4, 4)
    s: Array  # (k,)
    multipliers: Array  # (k,)


@dataclass(frozen=True, eq=False)
class _Coordinates:
    """x = M z: of bodies J = R unsvec(z) R^T, of drives in units of their penalty."""

    M: Array  # (n, 10, 10)
    drives: Array  # (p - 10 n,)

    @classmethod
    def of(cls, R: Array, problem: EntropicProblem, weight: float) -> "_Coordinates":
        moved = svec(R[:, None] @ _UNITS @ R.swapaxes(1, 2)[:, None]) @ _TO_PARAMETERS
        own = problem.scale[: problem.inertial].reshape(-1, _ENTRIES, 1)
        return cls(moved.swapaxes(1, 2) / own, 1.0 / (np.sqrt(weight) * problem.stiffness))

    def into(self, rows: Array) -> Array:
        """Return rows of coefficients of x as those of z, shape (k, p)."""
        n = len(self.M)
        found = rows.copy()
        by_body = rows[:, : _ENTRIES * n].reshape(-1, n, _ENTRIES).swapaxes(0, 1)
        found[:, : _ENTRIES * n] = (by_body @ self.M).swapaxes(0, 1).reshape(-1, _ENTRIES * n)
        found[:, _ENTRIES * n :] *= self.drives
        return found

    def back(self, z: Array) -> Array:
        """Return x, shape (p,)."""
        n = len(self.M)
        bodies = self.M @ z[: _ENTRIES * n].reshape(n, _ENTRIES, 1)
        return np.concatenate([bodies.reshape(-1), self.drives * z[_ENTRIES * n :]])


@dataclass(frozen=True, eq=False)
class _System:
    """The equations of a step from a point, factorised."""

    problem: EntropicProblem
    point: _Point
    weight: float
    R: Array  # (n, 4, 4): R^-1 J R^-T = R^T Z R = diag(l)
    R_inverse: Array
    length: Array  # (n, 4), l
    coordinates: _Coordinates
    A: Array  # coefficients in z
    G: Array
    N: Array
    gradient: Array  # (p,), of all but log det and inequalities, in z
    value: float  # of the objective, its square of the residual not halved
    ratio: Array  # (k,), lambda / s
    factor: tuple[Array, bool]  # of the Hessian

    @classmethod
    def of(
        cls, problem: EntropicProblem, point: _Point, A: Array, d: Array, weight: float
    ) -> "_System":
        x, J = point.x, problem.bodies(point.x)
        L, Q = np.linalg.cholesky(J), np.linalg.cholesky(point.Z)
        U, length, Vt = np.linalg.svd(Q.swapaxes(1, 2) @ L)
        R = L @ Vt.swapaxes(1, 2) / np.sqrt(length)[:, None, :]
        R_inverse = U.swapaxes(1, 2) @ Q.swapaxes(1, 2) / np.sqrt(length)[:, :, None]
        coordinates = _Coordinates.of(R, problem, weight)
        A_z, G_z, N_z = (coordinates.into(rows) for rows in (A, problem.G, problem.N.T))
        residual, drives = A @ x - d, problem.stiffness * (x - problem.centre)[problem.inertial :]
        slope = weight * svec(R.swapaxes(1, 2) @ problem.P_inverse @ R).reshape(-1)
        gradient = A_z.T @ residual + np.concatenate([slope, np.sqrt(weight) * drives])
        ratio = point.multipliers / point.s
        rows = np.concatenate([A_z, np.sqrt(ratio)[:, None] * G_z])
        H = rows.T @ rows
        H[np.diag_indices(len(x))] += 1.0
        divergence = (
            np.vdot(problem.P_inverse, J) - np.linalg.slogdet(problem.P_inverse @ J)[1].sum()
        )
        penalty = 2.0 * (divergence - length.size) + drives @ drives
        return cls(
            problem, point, weight, R, R_inverse, length, coordinates, A_z, G_z, N_z, gradient,
            float(residual @ residual + weight * penalty), ratio,
            scipy.linalg.cho_factor(H, lower=True, check_finite=False),
        )  # fmt: skip

    def direction(
        self, t: float, mu: float, cross: Array | None = None, pairs: Array | float = 0.0
    ) -> _Direction:
        """Return the step to where Z J = t 1 and lambda s = mu.

        Args:
            t: Product of the bodies that is aimed at.
            mu: That of the inequalities.
            cross: Products of the changes of J and Z that are expected, shape (n, 4, 4).
            pairs: Those of s and lambda, shape (k,).
        """
        point, length = self.point, self.length
        bodies = np.zeros_like(self.R)  # what J and Z change by together, but for -diag(l)
        if cross is not None:
            bodies -= 2.0 * cross / (length[:, :, None] + length[:, None, :])
        bodies[:, _EYE, _EYE] += t / length
        short = self.problem.G @ point.x + self.problem.h - point.s
        aim = (mu - pairs) / point.s
        right = self.G.T @ (aim - self.ratio * short) - self.gradient
        right[: self.problem.inertial] += svec(bodies).reshape(-1)
        z = scipy.linalg.cho_solve(self.factor, right, check_finite=False)
        if len(self.N):
            columns, small = self._held
            off = self.problem.N.T @ (point.x - self.problem.origin)
            z = z - columns @ np.linalg.solve(small, self.N @ z + off)
        J = unsvec(z[: self.problem.inertial])
        Z = bodies - J
        Z[:, _EYE, _EYE] -= length
        s = self.G @ z + short
        multipliers = aim - point.multipliers - self.ratio * s
        return _Direction(z, self.coordinates.back(z), J, Z, s, multipliers)

    @cached_property
    def _held(self) -> tuple[Array, Array]:
        """What the equalities' multipliers do to a step, shape (p, e), and to the equalities."""
        columns = scipy.linalg.cho_solve(self.factor, self.N.T, check_finite=False)
        return columns, self.N @ columns

    def corrected(self, ahead: _Direction, share: float) -> _Point:
        """Return the point after a step that counts what the step ahead shows.

        Args:
            ahead: The step to the minimum.
            share: How much of it keeps inside.
        """
        point = self.point
        mean, mu = float((self.length**2).mean()), _mean(point.multipliers * point.s)
        left = (1.0 - share) ** 3

        def aimed(left: float, trust: float) -> tuple[_Direction, float]:
            cross = 0.5 * trust * (ahead.J @ ahead.Z + ahead.Z @ ahead.J)
            pairs = trust * ahead.s * ahead.multipliers
            t = self.weight + left * max(mean - self.weight, 0.0)
            step = self.direction(t, left * mu, cross, pairs)
            return step, min(1.0, _BACK * self.reach(step))

        step, length = aimed(left, share)
        if length < min(_SHORT, 0.5 * share):
            step, length = aimed(max(left, _CENTRED), 0.0)
        inverse = self.R_inverse
        return _Point(
            point.x + length * step.x,
            point.Z + length * inverse.swapaxes(1, 2) @ step.Z @ inverse,
            np.maximum(point.s + length * step.s, _LEAST * np.sqrt((self.G**2).sum(axis=1))),
            point.multipliers + length * step.multipliers,
        )

    def reach(self, step: _Direction) -> float:
        """Return the largest multiple of a step that keeps all positive."""
        pairs = ((self.point.s, step.s), (self.point.multipliers, step.multipliers))
        shortest = [float((-x[dx < 0] / dx[dx < 0]).min(initial=np.inf)) for x, dx in pairs]
        return min(self.reach_of_bodies(step), *shortest)

    def reach_of_bodies(self, step: _Direction) -> float:
        """Return the largest multiple of a step that keeps J and Z positive definite."""
        root = np.sqrt(self.length)
        unit = root[:, :, None] * root[:, None, :]
        both = np.concatenate([step.J / unit, step.Z / unit])
        lowest = float(np.linalg.eigvalsh(both)[:, 0].min(initial=0.0))
        return -1.0 / lowest if lowest < 0 else float("inf")

    def is_settled(self, ahead: _Direction, share: float, tolerance: float) -> bool:
        """Return whether the step to the minimum changes nothing any more.

        Args:
            ahead: The step.
            share: How much of it keeps inside.
            tolerance: Share of the objective that counts as nothing.
        """
        nothing = tolerance * (1.0 + self.value)
        decrease = float(np.sum((self.A @ ahead.z) ** 2) + ahead.z @ ahead.z)
        return share > 0.5 and decrease <= nothing


def _mean(x: Array) -> float:
    return float(x.mean()) if len(x) else 0.0
