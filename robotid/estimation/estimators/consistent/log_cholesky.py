"""The consistent fit without a cone: nonlinear least squares in log-Cholesky parameters."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.exceptions import SettingsError
from robotid.base.typing import Array
from robotid.dynamics.factors import Factors
from robotid.estimation.estimators.consistent.body_constraints import SIGN_MARGIN, Constraints
from robotid.estimation.estimators.consistent.cones import svec, unsvec
from robotid.estimation.estimators.consistent.consistent_fit import Consistent
from robotid.estimation.estimators.consistent.penalties import body_units
from robotid.estimation.estimators.estimator import BatchEstimator, Estimate
from robotid.robot.parameters import pseudo_inertia, pseudo_inertia_basis

_INSIDE = 1e-6  # distance by which an initial value is moved off the boundary, dimensionless
_STEPS = 500
_SETTLED = 1e-14  # predicted decrease at which it has converged, relative to the objective
_FLAT = 1e-9  # smallest relative curvature used by the damping
_TOO_STIFF = 1e16  # damping at which no step reduces the objective any more
_LONGEST = 4.0  # largest change of a coordinate in one step: most are exponents
_SPREAD = 1.0  # standard deviation of random initial values, in log-Cholesky parameters
_STIFF = 10.0  # stiffness of the augmented Lagrangian, over the initial objective
_ROUNDS = 12  # largest number of updates of the multipliers ...
_PAID = 1e-7  # ... until the extents are met to this tolerance, dimensionless


@dataclass(frozen=True, eq=False)
class LogCholesky(BatchEstimator):
    """The fit of ``Consistent`` in coordinates in which every point is physically consistent.

    Without its known part and its margin, a body's pseudo-inertia is U U^T. U is an upper triangle
    with an exponential diagonal. A drive's coefficient is an exponential. The extents of bodies
    are enforced by an augmented Lagrangian. The problem is not convex in these coordinates. It is
    solved from the solution of the cone programme, moved inside, and from random initial values;
    the best solution is used. The details contain, as ``gaps``, the objective of each solution
    above that of the cone programme, relative to it.

    Attributes:
        fit_in_cone: The cone programme of the same problem.
        starts: Number of random initial values.
        rng: Random generator of the initial values.

    References:
        Rucker, Wensing (2022), Smooth parameterization of rigid-body inertia, (12)-(14); Nocedal,
        Wright (2006), Numerical Optimization, 17.4.
    """

    fit_in_cone: Consistent
    starts: int = 0
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def __post_init__(self) -> None:
        bounds: Constraints = self.fit_in_cone.constraints
        if bounds.mass or bounds.total_mass or bounds.com or bounds.pinned:
            raise SettingsError(
                "estimator 'log_cholesky' supports only the constraints extent and physical "
                "consistency; use 'consistent' for bounds and pinned links"
            )

    @property
    def in_cone(self) -> Consistent:
        return self.fit_in_cone

    def _fit(self, factors: Factors) -> Estimate:
        cone = self.fit_in_cone.fit(factors)
        rows = self.fit_in_cone.rows(factors, cone.sigma)
        lowest = self.fit_in_cone.objective(rows, cone.theta)
        first = self._coordinates(cone.theta)
        middle = self._coordinates(self.fit_in_cone.penalty.centre)
        points = [first] + [
            middle + _SPREAD * self.rng.standard_normal(len(middle)) for _ in range(self.starts)
        ]
        ends = [self._descend(rows, z) for z in points]
        best = min(ends, key=lambda end: end[1])
        return replace(
            cone,
            theta=self._parameters(best[0])[0],
            converged=best[3],
            n_iter=best[2],
            message=f"log-Cholesky, {best[2]} steps; cone programme: {cone.message}",
            details={
                **cone.details,
                "gaps": [(value - lowest) / lowest for _, value, _, _ in ends],
            },
        )

    def _descend(self, rows: Array, z: Array) -> tuple[Array, float, int, bool]:
        """Minimise from a point; return solution, value, number of steps, whether it converged."""
        fit, steps = self.fit_in_cone, 0
        value = fit.objective(rows, self._parameters(z)[0])
        price = np.zeros(len(self._extents))  # multipliers of the extents
        stiffness = _STIFF * value
        for _ in range(_ROUNDS):
            z, count, converged = self._settle(rows, z, price, stiffness)
            pi, steps = self._parameters(z)[0], steps + count
            slack = self._extents @ pi
            updated = np.maximum(price - stiffness * slack, 0.0)
            change, price = np.abs(updated - price), updated
            if (change <= _PAID * stiffness).all():
                break
        return z, fit.objective(rows, pi), steps, converged

    def _settle(
        self, rows: Array, z: Array, price: Array, stiffness: float
    ) -> tuple[Array, int, bool]:
        """Minimise by damped Newton steps at fixed multipliers; return as ``_descend``."""
        damping = 1e-3
        value = self.objective(rows, z, price, stiffness)
        for step in range(1, _STEPS + 1):
            slope, H = self.derivatives(rows, z, price, stiffness)
            unit = np.sqrt(np.maximum(np.abs(np.diag(H)), _FLAT * np.abs(np.diag(H)).max()))
            while True:
                move = _damped_step(H / np.outer(unit, unit), slope / unit, damping) / unit
                move *= min(1.0, _LONGEST / np.abs(move).max())
                predicted = -float(slope @ move)
                if predicted <= _SETTLED * value or damping > _TOO_STIFF:
                    return z, step, damping <= _TOO_STIFF
                lower = self.objective(rows, z + move, price, stiffness)
                if lower < value:
                    break
                damping = max(4.0 * damping, 1e-12)
            z, value, damping = z + move, lower, damping / 10.0
        return z, _STEPS, False

    def objective(self, rows: Array, z: Array, price: Array, stiffness: float) -> float:
        """Return the fit's objective with the augmented Lagrangian of the extents.

        f + 1/(2 s) sum_i max(0, l_i - s g_i)^2, g_i = tr(J Q_i) of ``slabs``.

        Args:
            rows: Rows of the data, shape (k, b + 1), from ``Consistent.rows``.
            z: Ten log-Cholesky parameters per body, then those of the drives, shape (p,).
            price: Multipliers l of the extents, at least 0.
            stiffness: The s.
        """
        pi = self._parameters(z)[0]
        excess = np.maximum(price - stiffness * (self._extents @ pi), 0.0)
        return self.fit_in_cone.objective(rows, pi) + float(excess @ excess) / (2.0 * stiffness)

    def derivatives(
        self, rows: Array, z: Array, price: Array, stiffness: float
    ) -> tuple[Array, Array]:
        """Return gradient, shape (p,), and Hessian, shape (p, p), of ``objective`` by coordinates.

        Args:
            rows: Rows of the data, shape (k, b + 1), from ``Consistent.rows``.
            z: Ten log-Cholesky parameters per body, then those of the drives, shape (p,).
            price: Multipliers of the extents.
            stiffness: Stiffness of the augmented Lagrangian.
        """
        fit, size = self.fit_in_cone, self.fit_in_cone.layout.n_inertial
        pi, J = self._parameters(z)
        D = rows[:, :-1] @ fit.K
        in_pi = 2.0 * D.T @ (D @ pi - rows[:, -1]) + fit.prior_weight * fit.penalty.gradient(pi)
        curvature = 2.0 * D.T @ D + fit.prior_weight * fit.penalty.hessian(pi)
        G_e = self._extents
        excess = np.maximum(price - stiffness * (G_e @ pi), 0.0)
        in_pi -= G_e.T @ excess
        curvature += stiffness * G_e[excess > 0].T @ G_e[excess > 0]
        H = J.T @ curvature @ J
        # curvature of the coordinates: tr(G d2M), G the gradient by the matrices
        grow = np.linalg.inv(self._shrink)
        G = grow @ unsvec((in_pi[:size].reshape(-1, 10) @ _TO_PI.T).reshape(-1)) @ grow
        bent = log_cholesky_curvature(z[:size].reshape(-1, 10), G)
        for i, block in enumerate(bent):
            part = slice(10 * i, 10 * i + 10)
            H[part, part] += block
        signs = size + np.flatnonzero(self._signs)
        slope: Array = J.T @ in_pi
        H[signs, signs] += slope[signs]  # the second derivative of an exponential is its first
        return slope, H

    def _coordinates(self, pi: Array) -> Array:
        """Return the coordinates of parameters, moved inside if they are on the boundary."""
        fit = self.fit_in_cone
        size, shrink = fit.layout.n_inertial, self._shrink
        rest = pseudo_inertia(pi[:size] - fit.known_share)
        values, vectors = np.linalg.eigh(shrink @ rest @ shrink - fit.margin * np.eye(4))
        inside = (vectors * np.maximum(values, _INSIDE)[:, None]) @ vectors.transpose(0, 2, 1)
        drives = (pi / fit.prior_std)[size:]
        signs = self._signs
        drives[signs] = np.log(np.maximum(drives[signs] - SIGN_MARGIN, _INSIDE))
        return np.concatenate([to_log_cholesky(inside).reshape(-1), drives])

    def _parameters(self, z: Array) -> tuple[Array, Array]:
        """Return pi, shape (p,), and its Jacobian, shape (p, p)."""
        fit, size = self.fit_in_cone, self.fit_in_cone.layout.n_inertial
        bodies = z[:size].reshape(-1, 10)
        grow = np.linalg.inv(self._shrink)
        rest = grow @ (from_log_cholesky(bodies) + fit.margin * np.eye(4)) @ grow
        slopes = grow[:, None] @ log_cholesky_jacobian(bodies) @ grow[:, None]  # (n, 10, 4, 4)
        drives = z[size:].copy()
        slope = np.ones_like(drives)
        drives[self._signs] = slope[self._signs] = np.exp(drives[self._signs])
        drives[self._signs] += SIGN_MARGIN
        scale = fit.prior_std[size:]
        pi = np.concatenate([_inertial(rest).reshape(-1) + fit.known_share, drives * scale])
        blocks = [_inertial(slopes_i).T for slopes_i in slopes]
        return pi, scipy.linalg.block_diag(*blocks, np.diag(slope * scale))

    @cached_property
    def _extents(self) -> Array:
        """Rows E of the extents, E pi >= 0, shape (k, p)."""
        cone = self.fit_in_cone.programme.cone.linear
        chosen = [i for i, label in enumerate(cone.labels) if label.startswith("extent ")]
        E: Array = cone.G[chosen] / self.fit_in_cone.prior_std
        return E

    @property
    def _shrink(self) -> Array:
        return body_units(self.fit_in_cone.prior_std[: self.fit_in_cone.layout.n_inertial])

    @property
    def _signs(self) -> Array:
        layout = self.fit_in_cone.layout
        return layout.is_nonnegative()[layout.n_inertial :]


def from_log_cholesky(z: Array) -> Array:
    """Return the matrices U U^T, shape (n, 4, 4), of log-Cholesky parameters.

    U = exp(alpha) [[exp d1, s12, s13, t1], [0, exp d2, s23, t2], [0, 0, exp d3, t3], [0, 0, 0, 1]].

    z (n, 10).
    """
    U = _factor(z)
    return U @ U.transpose(0, 2, 1)


def to_log_cholesky(J: Array) -> Array:
    """Return the parameters, shape (n, 10); the inverse of ``from_log_cholesky``."""
    U = np.linalg.cholesky(J[:, ::-1, ::-1])[:, ::-1, ::-1]  # upper: J = U U^T
    alpha = np.log(U[:, 3, 3])
    U = U / U[:, 3:, 3:]
    diagonal = np.log(np.diagonal(U, axis1=1, axis2=2)[:, :3])
    upper = [U[:, i, j] for i, j in _UPPER]
    return np.column_stack([alpha, diagonal, *upper])


def log_cholesky_jacobian(z: Array) -> Array:
    """Return the derivatives of U U^T by the parameters, shape (n, 10, 4, 4)."""
    half = _slopes(z) @ _factor(z).transpose(0, 2, 1)[:, None]
    slopes: Array = half + half.transpose(0, 1, 3, 2)
    return slopes


def log_cholesky_curvature(z: Array, G: Array) -> Array:
    """Return the second derivatives of tr(G U U^T), G (n, 4, 4), by z, shape (n, 10, 10)."""
    dU, U = _slopes(z), _factor(z)
    H: Array = 2.0 * np.einsum("nkai,nab,nlbi->nkl", dU, G, dU, optimize=True)
    along = 2.0 * np.einsum("nab,nkai,nbi->nk", G, dU, U, optimize=True)  # tr(G dU U^T), twice
    # U is exponential in alpha, and its diagonal in d
    H[:, 0, :] += along
    H[:, 1:, 0] += along[:, 1:]
    for k in range(1, 4):
        H[:, k, k] += along[:, k]
    return H


_UPPER = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))  # s12 s23 s13 t1 t2 t3


def _factor(z: Array) -> Array:
    U = np.zeros((len(z), 4, 4))
    for i in range(3):
        U[:, i, i] = np.exp(z[:, 1 + i])
    U[:, 3, 3] = 1.0
    for k, (i, j) in enumerate(_UPPER):
        U[:, i, j] = z[:, 4 + k]
    return np.exp(z[:, 0])[:, None, None] * U


def _slopes(z: Array) -> Array:
    """Return the derivatives of U, shape (n, 10, 4, 4)."""
    U = _factor(z)
    dU = np.zeros((len(z), 10, 4, 4))
    dU[:, 0] = U
    for i in range(3):
        dU[:, 1 + i, i, i] = U[:, i, i]
    for k, (i, j) in enumerate(_UPPER):
        dU[:, 4 + k, i, j] = np.exp(z[:, 0])
    return dU


def _damped_step(H: Array, slope: Array, damping: float) -> Array:
    """Return the damped Newton step with positive eigenvalues: a direction of descent."""
    values, vectors = np.linalg.eigh(H)
    bent = np.maximum(np.abs(values), 1e-15) + damping
    step: Array = -vectors @ ((vectors.T @ slope) / bent)
    return step


_TO_PI = np.linalg.inv(svec(pseudo_inertia_basis()))  # svec(J) @ _TO_PI = pi


def _inertial(J: Array) -> Array:
    """Return the inertial parameters of symmetric matrices, shape (..., 10)."""
    return svec(J) @ _TO_PI
