"""The convex programme of a consistent fit: data and prior over the cone, at any weight."""

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.estimators.consistent.cones import Cone, ConeSolution, Subspace, least_squares, nearest
from robotid.estimators.consistent.penalties import Penalty
from robotid.exceptions import NotConvergedError
from robotid.regressor.factors import Factors

__all__ = ["Programme"]

_STEPS = 400  # of Newton's method at one weight
_SETTLED = 1e-12  # decrease of the objective below which it has converged, relative
_NEAR = 1e-6  # ... and below which the steps are computed exactly
_ROUGH = 0.1  # ... and at which it goes on to a smaller weight, in units of the penalty
_HEAVY = 100.0  # weight at which a fit stays near its prior, from which Newton's method sets out
_DECADE = 10.0
_PATIENCE = 25  # steps from a weight to a lighter one before a shorter way is tried
_SHORTEST = 1.05  # ratio of weights below which it is given up
_HALVINGS = 40
_ROOM = 0.1  # share of the prior's pseudo-inertias that the first point has at least
_INSIDE = 0.9  # share of the way to where a penalty is infinite that a step goes at most
_NOISE_STEPS, _NOISE_SETTLED = 50, 1e-4  # a noise level need not be known better
_FLOOR = 1e-6  # smallest noise level, as a share of the torque: noise-free data have none
_LEAST_FREEDOM = 0.1  # share of the rows that are left to tell the noise


@dataclass(frozen=True, eq=False)
class Programme:
    """Minimise |rows [K pi; -1]|^2 + weight penalty(pi) over the cone.

    Attributes:
        K: Map to the base parameters, shape (b, p).
        scale: Unit of each parameter, shape (p,): cone and subspace are those of x = pi / scale.
        penalty: Distance from the prior.
        cone: The inequalities.
        space: What the equalities leave.
        solver: "clarabel" or "scs".
        max_iterations: Bound on the iterations of each solve.
    """

    K: Array
    scale: Array
    penalty: Penalty
    cone: Cone
    space: Subspace
    solver: str = "clarabel"
    max_iterations: int = 200

    @property
    def binding(self) -> Cone:
        """The inequalities that can bind: the log det of a penalty keeps matrices inside."""
        return self.cone.linear if self.penalty.keeps_positive else self.cone

    def minimise(
        self, rows: Array, weight: float, *, is_exact: bool = True, start: Array | None = None
    ) -> tuple[ConeSolution, Array]:
        """Return the minimum.

        A penalty that is not quadratic is minimised by Newton's method: its expansion to second
        order is a fit like any other, and a step keeps to the cone since that is convex. It sets
        out near the prior, at a weight that outweighs what the data say against it, and goes down
        by decades: from afar a light one would creep along the boundary. Or from a start.

        Args:
            rows: Information on the base parameters, shape (k, b + 1).
            weight: Weight of the penalty [-].
            is_exact: Whether to solve beyond 1e-3 standard deviations.
            start: Minimum of nearly the same rows, at up to ten times the weight, shape (p,).

        Returns:
            The solution, its x being pi, shape (p,); and the covariance without the inequalities.

        Raises:
            NotConvergedError: If the cone solver or Newton's method does not solve it.
        """
        centre = self.penalty.centre
        if self.penalty.is_quadratic:
            solution, R = self._expanded(rows, weight, centre, self.cone, is_exact)
            return solution, self._covariance(R)
        if start is None:
            heavy = max(weight, _HEAVY, self._against(rows, centre))
            solution, _, steps = self._settle(rows, heavy, self._start(rows, heavy), _ROUGH * heavy)
        else:
            solution, heavy, steps = ConeSolution(start, 0, ""), _DECADE * weight, 0
        solution, count = self._lighten(rows, heavy, weight, solution)
        steps += count
        value = self.objective(rows, solution.x, weight)
        solution, R, count = self._settle(rows, weight, solution, _NEAR * (1.0 + value))
        if is_exact:
            steps += count
            tolerance = _SETTLED * (1.0 + value)
            solution, R, count = self._settle(rows, weight, solution, tolerance, is_exact=True)
        message = f"{solution.message}, after {steps + count} Newton steps"
        return replace(solution, message=message), self._covariance(R)

    def redrawn(
        self,
        rows: Array,
        weight: float,
        pi: Array,
        meat: Array,
        pull: float,
        draws: int,
        rng: np.random.Generator,
    ) -> tuple[Array, list[str]]:
        """Return how fits lie about this one whose data and prior are drawn anew.

        Noise of the data with the covariance that their score has, and of the prior with that of
        the penalty over its pull, moves the minimum without the inequalities; its nearest point in
        the cone, in the metric of the fit, is the minimum with them. A penalty that is not
        quadratic is expanded at the fit.

        Args:
            rows: Information on the base parameters, shape (k, b + 1).
            weight: Weight of the penalty [-].
            pi: The fit, shape (p,).
            meat: Covariance of the score of the rows, shape (b, b).
            pull: How much heavier the penalty weighs than the truth's plausible spread says [-].
            draws: How many.
            rng: Source of the noise.

        Returns:
            Distances of the fits from pi, shape (m, p), and the solver's status of those that it
            did not find, draws - m of them.

        References:
            Bardsley, Fox (2012), An MCMC method for uncertainty quantification in nonnegativity
            constrained inverse problems, section 3.
        """
        triangle, cone = self._system(rows, weight, pi, self.binding)
        R, space = triangle[:, :-1], self.space
        at = space.basis.T @ (pi / self.scale - space.origin)
        inverse = scipy.linalg.solve_triangular(R, np.eye(len(R)))
        # y = R (x - at): of independent rows, whose meat is their information, the noise is white
        data = self.K * self.scale @ space.basis @ inverse
        prior = space.basis @ inverse
        # the score of the prior: weight H (pi - truth), the truth of covariance pull / (weight H)
        S = np.sqrt(pull * weight) * self._scaled_root(pi) @ prior
        size, axes = np.linalg.eigh(data.T @ meat @ data + S.T @ S)
        noise = rng.standard_normal((draws, len(R))) * np.sqrt(np.maximum(size, 0.0)) @ axes.T
        lowest = triangle[:, -1] - R @ at
        y, failures = nearest(
            lowest + noise, cone.restrict(Subspace(at, inverse)), max_iterations=self.max_iterations
        )
        return self.scale * (y @ prior.T), failures

    def _start(self, rows: Array, weight: float) -> ConeSolution:
        """Return a first point whose bodies have room, a tenth of the prior's, if bounds allow."""
        centre = self.penalty.centre
        inside = self.cone.around(centre / self.scale, _ROOM)
        try:
            return self._expanded(rows, weight, centre, inside, False)[0]
        except NotConvergedError:  # bounds leave no such room
            return self._expanded(rows, weight, centre, self.cone, False)[0]

    def _against(self, rows: Array, pi: Array) -> float:
        """Return by how much the squares of the residual exceed those of least squares."""
        A, d = rows[:, :-1], rows[:, -1]
        best = np.linalg.lstsq(A, d, rcond=None)[0]
        return float(np.sum((A @ (self.K @ pi - best)) ** 2))

    def objective(self, rows: Array, pi: Array, weight: float) -> float:
        """Return what is minimised: the squares of the residual plus the weighted penalty [-].

        Args:
            rows: Information on the base parameters, shape (k, b + 1).
            pi: Standard parameters, shape (p,).
            weight: Weight of the penalty [-].
        """
        residual = rows[:, :-1] @ (self.K @ pi) - rows[:, -1]
        return float(residual @ residual + weight * self.penalty.value(pi))

    def whitened(self, rows: Array) -> tuple[Array, Array]:
        """Return A, r with r = A x + noise, x being what the prior gives mean 0 and variance 1.

        Args:
            rows: Information on the base parameters, shape (k, b + 1).

        Returns:
            A, shape (k, r), and r, shape (k,), at a weight of 1, with the penalty expanded at its
            centre and r the number of directions that the equalities leave.
        """
        centre, basis = self.penalty.centre / self.scale, self.space.basis
        S = self._scaled_root(self.penalty.centre)
        # the point of the subspace that is nearest to the centre
        away = np.linalg.lstsq(S @ basis, S @ (centre - self.space.origin), rcond=None)[0]
        nearest = self.space.origin + basis @ away
        A = rows[:, :-1] @ self.K * self.scale
        L = scipy.linalg.qr(S @ basis, mode="r")[0][: basis.shape[1]]
        directions = scipy.linalg.solve_triangular(L, (A @ basis).T, trans="T").T
        return directions, rows[:, -1] - A @ nearest

    def noise(self, factors: Factors, sigma: Array, share: float, weight: float) -> Array:
        """Return the noise levels, shape (n,) [N m or N], by the fit without inequalities, never 0.

        sigma_j^2 = |tau_j - W_j pi|^2 / (rows_j - spent_j / share): rows behind a filter repeat
        each other, so that few of them are spent soon; spent_j counts the parameters that the
        rows of joint j determine beside the prior, the trace of their leverage.

        Args:
            factors: The factors, of base parameters.
            sigma: Noise levels to start from, shape (n,) [N m or N].
            share: Share of the rows that count as independent [-].
            weight: Weight of the penalty [-].
        """
        n, size, _ = factors.R.shape
        A, r = self.whitened(factors.R.reshape(n * size, size))
        A, r = A.reshape(n, size, -1), r.reshape(n, size)
        rows, p = np.maximum(factors.rows, 1), A.shape[2]
        torque = np.sqrt(factors.torque_squares() / rows)
        least = _FLOOR * np.where(torque > 0, torque, 1.0)
        sigma = np.maximum(sigma, least)
        for _ in range(_NOISE_STEPS):
            root = (np.sqrt(share) / sigma)[:, None, None]
            stacked = np.vstack([(A * root).reshape(-1, p), np.sqrt(weight) * np.eye(p)])
            right = np.concatenate([(r * root[:, 0]).reshape(-1), np.zeros(p)])
            triangle = scipy.linalg.qr(np.column_stack([stacked, right]), mode="r")[0][:p]
            inverse = scipy.linalg.solve_triangular(triangle[:, :-1], np.eye(p))
            residual = r - A @ (inverse @ triangle[:, -1])
            spent = ((A @ inverse * root) ** 2).sum(axis=(1, 2))
            freedom = np.maximum(rows - spent / share, _LEAST_FREEDOM * rows)
            updated = np.maximum(np.sqrt((residual**2).sum(axis=1) / freedom), least)
            change = float(np.max(np.abs(updated / sigma - 1.0)))
            sigma = updated
            if change < _NOISE_SETTLED:
                break
        return sigma

    def covariance_at_prior(self, weight: float, rows: Array | None = None) -> Array:
        """Return the covariance, shape (p, p), with the penalty expanded at its centre.

        Args:
            weight: Weight of the penalty [-].
            rows: Information on the base parameters, shape (k, b + 1); that of the prior alone if
                None.
        """
        S = np.sqrt(weight) * self._scaled_root(self.penalty.centre)
        data = [] if rows is None else [rows[:, :-1] @ self.K * self.scale]
        stacked = np.vstack([*data, S]) @ self.space.basis
        return self._covariance(scipy.linalg.qr(stacked, mode="r")[0][: stacked.shape[1]])

    def _lighten(
        self, rows: Array, heavy: float, weight: float, solution: ConeSolution
    ) -> tuple[ConeSolution, int]:
        """Go from near the minimum at a heavy weight to near that at a weight; count the steps.

        By decades, or less where a decade takes too many steps.
        """
        ratio, steps = _DECADE, 0
        while heavy > weight:
            lighter = max(heavy / ratio, weight)
            value = self.objective(rows, solution.x, lighter)
            rough = max(_ROUGH * lighter, _NEAR * (1.0 + value))
            try:
                moved, _, count = self._settle(rows, lighter, solution, rough, limit=_PATIENCE)
            except NotConvergedError:
                ratio = np.sqrt(ratio)
                if ratio < _SHORTEST:
                    raise
                steps += _PATIENCE
            else:
                solution, heavy, steps = moved, lighter, steps + count
        return solution, steps

    def _settle(
        self,
        rows: Array,
        weight: float,
        start: ConeSolution,
        tolerance: float,
        *,
        limit: int = _STEPS,
        is_exact: bool = False,
    ) -> tuple[ConeSolution, Array, int]:
        """Go from a point of the cone to the minimum at a weight; return also R and the steps."""
        pi, value, before = start.x, self.objective(rows, start.x, weight), np.inf
        for step in range(1, limit + 1):
            solution, R = self._expanded(rows, weight, pi, self.binding, is_exact)
            direction = solution.x - pi
            decrease = float(np.sum((R @ self.space.basis.T @ (direction / self.scale)) ** 2))
            share, lower = self._along(rows, weight, pi, direction, value)
            pi, value = pi + share * direction, lower
            # steps that no longer shrink are as short as the solver can tell
            is_stuck = decrease <= _NEAR * (1.0 + value) and decrease > 0.5 * before
            if decrease <= tolerance or share == 0 or is_stuck:
                return replace(solution, x=pi), R, step
            before = decrease
        raise NotConvergedError(
            f"the fit still changes after {limit} Newton steps at a prior weight of {weight:g}; "
            "use the 'euclidean' prior or a larger weight",
            "max_iterations",
        )

    def _along(
        self, rows: Array, weight: float, pi: Array, direction: Array, value: float
    ) -> tuple[float, float]:
        """Return the share of a step that lowers the objective, and the objective there."""
        share = min(1.0, _INSIDE * self.penalty.reach(pi, direction))
        best, lowest = 0.0, value
        for _ in range(_HALVINGS):
            lower = self.objective(rows, pi + share * direction, weight)
            if best > 0 and lower >= lowest:
                break
            if lower <= lowest:
                best, lowest = share, lower
            share *= 0.5
        return best, lowest

    def _expanded(
        self, rows: Array, weight: float, pi: Array, cone: Cone, is_exact: bool
    ) -> tuple[ConeSolution, Array]:
        """Minimise with the penalty expanded at pi; return also R, R^T R half the Hessian."""
        triangle, cone = self._system(rows, weight, pi, cone)
        solution = least_squares(
            triangle[:, :-1],
            triangle[:, -1],
            cone,
            solver=self.solver,
            max_iterations=self.max_iterations,
            is_exact=is_exact,
        )
        space = self.space
        x = solution.x if len(triangle) == len(pi) else space.origin + space.basis @ solution.x
        return replace(solution, x=x * self.scale), triangle[:, :-1]

    def _system(self, rows: Array, weight: float, pi: Array, cone: Cone) -> tuple[Array, Cone]:
        """Return the triangle [R d] and a cone of what the equalities leave, expanded at pi."""
        L = np.sqrt(weight) * self._scaled_root(pi)  # half the Hessian is L^T L
        slope = 0.5 * weight * self.penalty.gradient(pi) * self.scale
        lowest = pi / self.scale - scipy.linalg.cho_solve((L, False), slope)
        # the data rows stand over prior rows, both in units of the scale
        A = np.vstack([rows[:, :-1] @ self.K * self.scale, L])
        d = np.concatenate([rows[:, -1], L @ lowest])
        space = self.space
        free = space.basis.shape[1]
        if free < len(pi):
            A, d, cone = A @ space.basis, d - A @ space.origin, cone.restrict(space)
        triangle: Array = scipy.linalg.qr(np.column_stack([A, d]), mode="r")[0][:free]
        return triangle, cone

    def _scaled_root(self, pi: Array) -> Array:
        """Return the root of half the Hessian of the penalty in units of the scale."""
        scaled: Array = self.penalty.root(pi) * self.scale
        return scaled

    def _covariance(self, R: Array) -> Array:
        """Return (R^T R)^-1 of a triangular R, from what the equalities leave to all of pi."""
        inverse = scipy.linalg.solve_triangular(R, np.eye(len(R)))
        spread = self.scale[:, None] * self.space.basis @ inverse
        covariance: Array = spread @ spread.T
        return covariance
