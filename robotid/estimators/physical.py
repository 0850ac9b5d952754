"""Physically consistent fit: a convex cone programme on the factors.

Every body gets a positive definite pseudo-inertia, every drive armature and friction of the right
sign; where the data say nothing the parameters stay near their prior.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.estimators.estimator import Estimate, Estimator, as_factors
from robotid.estimators.least_squares import WLS
from robotid.exceptions import DataError, NotConvergedError
from robotid.factors import Factors
from robotid.parameters import ParameterLayout, pseudo_inertia, pseudo_inertia_basis
from robotid.problem import Problem

__all__ = ["Consistent"]

_SIGN_MARGIN = 1e-9  # drive terms stay above this share of their scale, so that rounding cannot
# make them negative
_REACHES = (1.0, 1e-3, 1e-5)  # units of the first solution and of its corrections
_PRIOR_LED = 0.9  # a base parameter whose spread shrinks by less than this is undetermined


@dataclass(frozen=True, eq=False)
class Consistent(Estimator):
    """Physically consistent estimate of the standard parameters.

    Minimises, over the standard parameters pi,

        sum_j |tau_j - W_b,j K pi|^2 / sigma_j^2 + prior_weight |(pi - prior) / prior_std|^2

    subject to J(pi_i) - J(held_i) >= margin T_i for each body i, and armature, viscous and Coulomb
    coefficients >= 0. The noise levels sigma_j come from weighted least squares.

    Attributes:
        layout: The standard parameters.
        K: Map to the base parameters, shape (b, p).
        prior: Prior value of each parameter, shape (p,), as the URDF's.
        prior_std: How far a parameter may plausibly lie from its prior, shape (p,), positive.
        held: Share of each body that is known and may not be negative beside it, as the links on
            locked joints, shape (10 bodies,); None for nothing.
        margin: Smallest eigenvalue of a body's pseudo-inertia relative to its prior size [-].
        prior_weight: Weight of the prior [-].
        independent_share: Share of the rows that count as independent, 2 cutoff / rate.
        max_iterations: Bound on the iterations of the cone solver.

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
    independent_share: float = 1.0
    max_iterations: int = 200

    def __post_init__(self) -> None:
        p = len(self.layout.names)
        for name, shape in (("prior", (p,)), ("prior_std", (p,)), ("K", (len(self.K), p))):
            if getattr(self, name).shape != shape:
                raise DataError(f"{name} has shape {getattr(self, name).shape}, wanted {shape}")
        if not (np.isfinite(self.prior_std) & (self.prior_std > 0)).all():
            raise DataError("prior_std must be positive and finite for every parameter")
        if not np.isfinite(self.prior).all() or not np.isfinite(self._held).all():
            raise DataError("prior and held must be finite for every parameter")
        if not (self.margin > 0 and self.prior_weight > 0):
            raise DataError(
                f"margin {self.margin} and prior_weight {self.prior_weight} must be positive"
            )

    def fit(self, data: Problem | Factors) -> Estimate:
        """Estimate the standard parameters; see :meth:`Estimator.fit`.

        Args:
            data: A problem in base parameters, or its factors.

        Returns:
            The estimate over the p standard parameters. The covariance is that of the fit without
            the constraints, an upper bound where one is active; rank, condition number and the
            names of undetermined parameters are those of the base parameters.

        Raises:
            DataError: If there are fewer rows than parameters.
            NotConvergedError: If the cone solver does not solve it.
        """
        factors = as_factors(data)
        wls = WLS(prior=self.K @ self.prior, independent_share=self.independent_share).fit(factors)
        R = factors.weighted(wls.sigma / np.sqrt(self.independent_share))
        theta, covariance, n_iter, message = self._minimise(R)
        return Estimate(
            theta=theta,
            covariance=covariance,
            names=self.layout.names,
            sigma=wls.sigma,
            rank=wls.rank,
            condition=wls.condition,
            undetermined=self._undetermined(covariance, factors.names),
            converged=True,
            n_iter=n_iter,
            message=message,
        )

    def project(self, estimate: Estimate) -> Estimate:
        """Return the possible standard parameters nearest to an estimate of the base parameters.

        Nearest in the metric of its covariance C, the prior beside it, with the constraints of
        :meth:`fit`: minimises (K pi - beta)^T C^-1 (K pi - beta) + prior_weight
        |(pi - prior) / prior_std|^2.

        Args:
            estimate: Base parameters, as a recursive estimator has them at any moment. Those of
                infinite variance count as unknown.

        Returns:
            The estimate over the p standard parameters.

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
        theta, covariance, n_iter, message = self._minimise(rows)
        return replace(
            estimate,
            theta=theta,
            covariance=covariance,
            names=self.layout.names,
            undetermined=self._undetermined(covariance, estimate.names),
            n_iter=estimate.n_iter + n_iter,
            message=f"{estimate.message}; made physically possible, {message}",
        )

    def _minimise(self, rows: Array) -> tuple[Array, Array, int, str]:
        """Minimise |rows [K pi; -1]|^2 and the prior over the cone, rows (k, b + 1).

        Returns pi, its covariance without the constraints, iterations and what the solver said.
        """
        # in units of the prior's spread, x = pi / prior_std, the data rows stand over prior rows
        root = np.sqrt(self.prior_weight)
        A = np.vstack([rows[:, :-1] @ self.K * self.prior_std, root * np.eye(len(self.prior))])
        d = np.concatenate([rows[:, -1], root * self.prior / self.prior_std])
        triangle = scipy.linalg.qr(np.column_stack([A, d]), mode="r")[0][: len(self.prior) + 1]
        x, n_iter, message = self._solve(triangle[:-1, :-1], triangle[:-1, -1])
        covariance = self.prior_std[:, None] * _inverse_gram(triangle[:-1, :-1]) * self.prior_std
        return x * self.prior_std, covariance, n_iter, message

    def _undetermined(self, covariance: Array, base_names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the base parameters about which the data say next to nothing."""
        after = np.einsum("bi,ij,bj->b", self.K, covariance, self.K)
        before = (self.K**2) @ (self.prior_std**2 / self.prior_weight)
        return tuple(np.array(base_names)[after > _PRIOR_LED**2 * before].tolist())

    @property
    def _held(self) -> Array:
        return np.zeros(self.layout.n_inertial) if self.held is None else self.held

    def _solve(self, A: Array, d: Array) -> tuple[Array, int, str]:
        """Minimise |A x - d|^2 over the cone; without it, and exactly, if it does not bind."""
        x = scipy.linalg.solve_triangular(A, d)
        pi = x * self.prior_std
        signs = x[self.layout.is_nonnegative()]
        shrink = self._shrink()
        J = shrink @ pseudo_inertia(pi[: self.layout.n_inertial] - self._held) @ shrink
        if np.linalg.eigvalsh(J).min() >= self.margin and (signs >= _SIGN_MARGIN).all():
            return x, 0, "no constraint binds"
        return self._solve_cone(A, d)

    def _solve_cone(self, A: Array, d: Array) -> tuple[Array, int, str]:
        """Minimise |A x - d|^2 over the cone, then again for ever smaller corrections of x.

        The solver's tolerance is relative to the problem: solved for a correction in units of
        1e-3 and 1e-5, its error shrinks likewise (measured on exact data: 2e-7, 5e-14, 2e-15).
        """
        G, h = self._cone_rows()
        x, iterations, statuses = np.zeros(len(d)), 0, []
        for reach in _REACHES:
            y, status, count = self._call_solver(A, (d - A @ x) / reach, G, (h + G @ x) / reach)
            statuses.append(status)
            iterations += count
            if status not in ("Solved", "AlmostSolved"):
                break
            x = x + reach * y
        if "Solved" not in statuses:
            raise NotConvergedError(
                "the physically consistent fit was not solved by Clarabel; check the URDF's "
                "inertials with 'robotid inspect', or use the 'wls' estimator",
                statuses[-1],
            )
        return x, iterations, f"Clarabel: {', then '.join(statuses)}"

    def _call_solver(self, A: Array, d: Array, G: Array, h: Array) -> tuple[Array, str, int]:
        """Minimise |z|^2 with z = (A x - d) / size and h + G x in the cone (residual form)."""
        import clarabel
        from scipy import sparse

        p = len(d)
        size = np.linalg.norm(A, axis=0).max()
        P = sparse.block_diag([sparse.csc_matrix((p, p)), sparse.eye(p)], format="csc")
        rows = sparse.bmat([[A / size, -sparse.eye(p)], [-G, None]], format="csc")
        right = np.concatenate([d / size, h])
        signs = int(self.layout.is_nonnegative().sum())
        cones = [clarabel.ZeroConeT(p), clarabel.NonnegativeConeT(signs)]
        cones += [clarabel.PSDTriangleConeT(4)] * len(self.layout.bodies)
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        settings.max_iter = self.max_iterations
        # at the default 1e-8 it stalls on easy problems, at an optimum right to 1e-9
        settings.tol_gap_abs = settings.tol_gap_rel = 1e-7
        solver = clarabel.DefaultSolver(P, np.zeros(2 * p), rows, right, cones, settings)
        solution = solver.solve()
        return np.array(solution.x[:p]), str(solution.status), int(solution.iterations)

    def _cone_rows(self) -> tuple[Array, Array]:
        """Return G, h with h + G x in the cone: signs first, then svec of each pseudo-inertia."""
        p = len(self.prior)
        signs = np.flatnonzero(self.layout.is_nonnegative())
        G, h = [np.eye(p)[signs]], [np.full(len(signs), -_SIGN_MARGIN)]
        basis = pseudo_inertia_basis()
        scaled = zip(pseudo_inertia(self._held), self._shrink(), strict=True)
        for i, (J_held, shrink) in enumerate(scaled):
            part = slice(10 * i, 10 * i + 10)
            block = np.zeros((10, p))
            for k in range(10):
                block[:, 10 * i + k] = _svec(shrink @ basis[k] @ shrink)
            block[:, part] *= self.prior_std[part]
            G.append(block)
            h.append(-_svec(shrink @ J_held @ shrink + self.margin * np.eye(4)))
        return np.vstack(G), np.concatenate(h)

    def _shrink(self) -> Array:
        """Return T_i^-1/2 per body, which makes its pseudo-inertia free of units, (bodies, 4, 4).

        The size of a body is that of its prior's spread: mass m and radius r from m and m r.
        """
        spread = self.prior_std[: self.layout.n_inertial].reshape(-1, 10)
        mass, radius = spread[:, 0], spread[:, 1] / spread[:, 0]
        diagonal = np.column_stack([1 / radius] * 3 + [np.ones_like(mass)])
        shrink: Array = np.eye(4) * (diagonal / np.sqrt(mass)[:, None])[:, None, :]
        return shrink


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


def _svec(S: Array) -> Array:
    """Return the upper triangle of a symmetric matrix by columns, off-diagonals times sqrt 2."""
    weight = np.where(np.eye(len(S), dtype=bool), 1.0, np.sqrt(2.0))
    columns, rows = np.tril_indices(len(S))  # (j, i) with i <= j
    values: Array = (S * weight)[rows, columns]
    return values


def _inverse_gram(R: Array) -> Array:
    """Return (R^T R)^-1 of a triangular R."""
    inverse = scipy.linalg.solve_triangular(R, np.eye(len(R)))
    gram: Array = inverse @ inverse.T
    return gram
