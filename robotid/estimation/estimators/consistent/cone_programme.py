"""The convex programme of a consistent fit: data and prior over a cone, at any weight."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.exceptions import NotConvergedError
from robotid.base.typing import Array
from robotid.estimation.estimators.consistent.cones import (
    Cone,
    ConeSolution,
    Subspace,
    least_squares,
    nearest,
)
from robotid.estimation.estimators.consistent.interior_point import EntropicProblem
from robotid.estimation.estimators.consistent.penalties import Entropic, Penalty

_EXACT = 1e-12  # relative decrease of the objective per step at which a fit is exact
_ROUGH = 1e-6  # ... and at which it is sufficient for a prediction
_TOGETHER = 2**17  # entries of the data sets that are fitted in one pass: they fit into a cache


@dataclass(frozen=True, eq=False)
class Programme:
    """Minimise |rows [K pi; -1]|^2 + weight penalty(pi) over the cone.

    Attributes:
        K: Map to the base parameters, shape (b, p).
        scale: Unit of each parameter, shape (p,): cone and subspace are in x = pi / scale.
        penalty: Distance from the prior.
        cone: The inequalities.
        space: Subspace of the points that meet the equalities.
        max_iterations: Largest number of iterations of each solve.
    """

    K: Array
    scale: Array
    penalty: Penalty
    cone: Cone
    space: Subspace
    max_iterations: int = 200

    @property
    def binding(self) -> Cone:
        """The inequalities that can be active: the log det of a penalty is a barrier."""
        return self.cone.linear if self.penalty.keeps_positive else self.cone

    def minimise(
        self,
        rows: Array,
        weight: float,
        *,
        is_exact: bool = True,
        start: ConeSolution | None = None,
    ) -> ConeSolution:
        """Return the minimum; its x is pi, shape (p,).

        With a quadratic penalty the cone solver is used; with the entropic penalty the
        interior-point method of ``EntropicProblem``.

        rows (k, b + 1).
        """
        starts = None if start is None else [start]
        return self.minimise_each(rows[None], weight, is_exact=is_exact, starts=starts)[0]

    def minimise_each(
        self,
        rows: Array,
        weight: float,
        *,
        is_exact: bool = True,
        starts: Sequence[ConeSolution] | None = None,
    ) -> list[ConeSolution]:
        """Return the minimum of each of f data sets, as ``minimise``, in one pass.

        rows (f, k, b + 1).
        """
        if not isinstance(self.penalty, Entropic):
            centre = self.penalty.centre
            return [self.expanded(own, weight, centre, is_exact=is_exact) for own in rows]
        tolerance = _EXACT if is_exact else _ROUGH
        if starts is not None:
            starts = [replace(start, x=start.x / self.scale) for start in starts]
        A, d = rows[:, :, :-1] @ (self.K * self.scale), rows[:, :, -1]
        solutions: list[ConeSolution] = []
        most = max(1, _TOGETHER // A[0].size)
        try:
            for k in (slice(first, first + most) for first in range(0, len(A), most)):
                near = None if starts is None else starts[k]
                solutions += self._entropic.minimise(A[k], d[k], weight, tolerance, near)
        except NotConvergedError:
            # the cone solver detects bounds that no physically consistent body can meet
            self.expanded(rows[0], weight, self.penalty.centre, within=self.cone)
            raise
        return [replace(solution, x=solution.x * self.scale) for solution in solutions]

    @cached_property
    def _entropic(self) -> EntropicProblem:
        """The problem with the entropic penalty, in units of the scale."""
        penalty, space, cone = self.penalty, self.space, self.cone.linear
        assert isinstance(penalty, Entropic)
        size = len(penalty.held)
        return EntropicProblem(
            scale=self.scale,
            held=penalty.held / self.scale[:size],
            P=penalty.prior,
            centre=penalty.centre / self.scale,
            stiffness=np.sqrt(penalty.precision) * self.scale[size:],
            G=cone.G,
            h=cone.h,
            N=space.fixed,
            origin=space.origin,
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
        of the plausible prior. Both move the minimum without the inequalities; the nearest point in
        the cone, in the metric of the fit, is the minimum with them. A penalty that is not
        quadratic is expanded at the fit.

        References:
            Bardsley, Fox (2012), An MCMC method for uncertainty quantification in nonnegativity
            constrained inverse problems, section 3.

        rows (k, b + 1), pi (p,), meat (b, b) -> (m, p).
        """
        triangle, cone = self._system(rows, weight, pi, self.binding)
        # signs of rows depend on rounding: make the diagonal positive
        triangle = np.sign(np.diag(triangle))[:, None] * triangle
        R, space = triangle[:, :-1], self.space
        at = space.basis.T @ (pi / self.scale - space.origin)
        inverse = scipy.linalg.solve_triangular(R, np.eye(len(R)))
        # y = R (x - at): with independent rows, whose meat is their information, noise is white
        data = self.K * self.scale @ space.basis @ inverse
        prior = space.basis @ inverse
        # score of the prior: weight H (pi - true pi), covariance of pi: weight_ratio / (weight H)
        S = np.sqrt(weight_ratio * weight) * self._scaled_root(pi) @ prior
        size, axes = np.linalg.eigh(data.T @ meat @ data + S.T @ S)
        root = axes * np.sqrt(np.maximum(size, 0.0)) @ axes.T
        noise = rng.standard_normal((draws, len(R))) @ root
        lowest = triangle[:, -1] - R @ at
        y, failures = nearest(
            lowest + noise, cone.restrict(Subspace(at, inverse)), max_iterations=self.max_iterations
        )
        return self.scale * (y @ prior.T), failures

    def objective(self, rows: Array, pi: Array, weight: float) -> float:
        """Return the objective: the squared residual plus the weighted penalty [-].

        rows (k, b + 1), pi (p,).
        """
        residual = rows[:, :-1] @ (self.K @ pi) - rows[:, -1]
        return float(residual @ residual + weight * self.penalty.value(pi))

    def whitened(self, rows: Array) -> tuple[Array, Array]:
        """Return A, r with r = A x + noise, for coordinates x whose prior is N(0, 1).

        rows (k, b + 1) -> (k, m), (k,).
        """
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
        """Return the covariance without the inequalities, shape (p, p).

        rows (k, b + 1), pi (p,).
        """
        S = np.sqrt(weight) * self._scaled_root(self.penalty.centre if pi is None else pi)
        data = [] if rows is None else [rows[:, :-1] @ self.K * self.scale]
        stacked = np.vstack([*data, S]) @ self.space.basis
        R = scipy.linalg.qr(stacked, mode="r")[0][: stacked.shape[1]]
        inverse = scipy.linalg.solve_triangular(R, np.eye(len(R)))
        spread = self.scale[:, None] * self.space.basis @ inverse
        covariance: Array = spread @ spread.T
        return covariance

    def expanded(
        self,
        rows: Array,
        weight: float,
        pi: Array,
        *,
        is_exact: bool = True,
        within: Cone | None = None,
    ) -> ConeSolution:
        """Return the minimum with the penalty expanded at a point, by the cone solver.

        rows (k, b + 1), pi (p,).
        """
        triangle, cone = self._system(rows, weight, pi, self.binding if within is None else within)
        solution = least_squares(
            triangle[:, :-1],
            triangle[:, -1],
            cone,
            max_iterations=self.max_iterations,
            is_exact=is_exact,
        )
        space = self.space
        x = solution.x if len(triangle) == len(pi) else space.origin + space.basis @ solution.x
        return replace(solution, x=x * self.scale)

    def _system(self, rows: Array, weight: float, pi: Array, cone: Cone) -> tuple[Array, Cone]:
        """Return the triangle [R d] and the cone in free coordinates, expanded at pi."""
        L = np.sqrt(weight) * self._scaled_root(pi)  # half the Hessian is L^T L
        slope = 0.5 * weight * self.penalty.gradient(pi) * self.scale
        lowest = pi / self.scale - scipy.linalg.cho_solve((L, False), slope)
        # rows of the data above rows of the prior, both in units of the scale
        A = np.vstack([rows[:, :-1] @ self.K * self.scale, L])
        d = np.concatenate([rows[:, -1], L @ lowest])
        space = self.space
        free = space.basis.shape[1]
        if free < len(pi):
            A, d, cone = A @ space.basis, d - A @ space.origin, cone.restrict(space)
        triangle: Array = scipy.linalg.qr(np.column_stack([A, d]), mode="r")[0][:free]
        return triangle, cone

    def _scaled_root(self, pi: Array) -> Array:
        """Return the root of half the penalty's Hessian, in units of the scale."""
        scaled: Array = self.penalty.root(pi) * self.scale
        return scaled
