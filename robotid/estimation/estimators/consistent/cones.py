"""The feasible set of a consistent fit, and the minimum of |A x - d|^2 over it by Clarabel.

The set has linear inequalities, pseudo-inertias and equalities.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from robotid.base.exceptions import NotConvergedError
from robotid.base.typing import Array

if TYPE_CHECKING:
    import clarabel

_SIZE = 4  # of a pseudo-inertia
_ENTRIES = _SIZE * (_SIZE + 1) // 2
_UNITS = (1.0, 1e-3, 1e-5)  # units of the first solution and of its corrections
_SOLVED, _ALMOST, _INFEASIBLE = "Solved", "AlmostSolved", "PrimalInfeasible"
_FAR = 1e3  # distance from the cone above which a larger unit is used
_NEAREST = 1e-6  # duality gap for an error of 1e-3 standard deviations
_CONTRADICTED = 1e-7  # distance of the NNLS problem below which the inequalities contradict


@dataclass(frozen=True, eq=False)
class Subspace:
    """The subspace x = origin + basis y of the points that meet equalities.

    Attributes:
        origin: A point that meets them, shape (p,).
        basis: Free directions, shape (p, r), orthonormal.
    """

    origin: Array
    basis: Array

    @classmethod
    def of(cls, E: Array, e: Array) -> "Subspace":
        """Return the points with E x = e, in the least squares sense if they contradict.

        E (k, p), e (k,).
        """
        p = E.shape[1]
        if not len(E):
            return cls(np.zeros(p), np.eye(p))
        origin = np.linalg.lstsq(E, e, rcond=None)[0]
        touched = np.flatnonzero(E.any(axis=0))
        free = np.flatnonzero(~E.any(axis=0))
        inner = scipy.linalg.null_space(E[:, touched])
        basis = np.zeros((p, len(free) + inner.shape[1]))
        basis[free, np.arange(len(free))] = 1.0
        basis[touched, len(free) :] = inner
        return cls(origin, basis)

    @cached_property
    def fixed(self) -> Array:
        """Fixed directions, shape (p, p - r), orthonormal."""
        p, r = self.basis.shape
        fixed: Array = np.zeros((p, 0)) if r == p else scipy.linalg.null_space(self.basis.T)
        return fixed


@dataclass(frozen=True, eq=False)
class Cone:
    """The points x with G x + h >= 0 and every S_i(x) positive semidefinite.

    Attributes:
        G: Coefficients of the linear rows, shape (k, p).
        h: Constants of the linear rows, shape (k,).
        S: Coefficients of the matrices in svec form, shape (10 m, p).
        s: Their constants, shape (10 m,).
        labels: Family and owner of each linear row, then of each matrix, as "mass forearm".
    """

    G: Array
    h: Array
    S: Array
    s: Array
    labels: tuple[str, ...]

    @property
    def n_matrices(self) -> int:
        """Number m of matrices."""
        return len(self.s) // _ENTRIES

    @property
    def families(self) -> tuple[str, ...]:
        """The families of constraints in it, each once."""
        return tuple(dict.fromkeys(label.split(" ", 1)[0] for label in self.labels))

    @cached_property
    def rows(self) -> tuple[Array, Array]:
        """All coefficients and constants, linear rows first."""
        return np.vstack([self.G, self.S]), np.concatenate([self.h, self.s])

    @property
    def linear(self) -> "Cone":
        """The cone of its linear rows only."""
        return Cone(self.G, self.h, self.S[:0], self.s[:0], self.labels[: len(self.h)])

    def matrices(self, x: Array) -> Array:
        """Return the matrices S_i(x), shape (m, 4, 4): x (p,)."""
        return unsvec(self.S @ x + self.s)

    def slack(self, x: Array) -> Array:
        """Return values of rows, then smallest eigenvalues, shape (k + m,); negative if violated.

        x (p,).
        """
        eigenvalues = np.linalg.eigvalsh(self.matrices(x))[:, 0]
        return np.concatenate([self.G @ x + self.h, eigenvalues])

    def holds(self, x: Array) -> bool:
        """Return whether the cone contains a point: x (p,)."""
        return bool((self.slack(x) >= 0).all())

    def restrict(self, space: Subspace) -> "Cone":
        """Return the cone in coordinates y of a subspace: the y whose x is in this cone."""
        return Cone(
            self.G @ space.basis,
            self.h + self.G @ space.origin,
            self.S @ space.basis,
            self.s + self.S @ space.origin,
            self.labels,
        )

    def active(self, x: Array, tolerance: float) -> tuple[Array, tuple[str, ...]]:
        """Return the constraints that are active at a point, linearised there.

        A matrix with r eigenvalues at 0, with eigenvectors V, gives r (r + 1) / 2 constraints
        V^T dS V = 0, because its rank does not change on the boundary.

        x (p,) -> (a, p).
        """
        gradients, labels = [np.zeros((0, len(x)))], []
        for row, constant, label in zip(self.G, self.h, self.labels, strict=False):
            if row @ x + constant < tolerance:
                gradients.append(row[None])
                labels.append(label)
        slopes = self.S.reshape(self.n_matrices, _ENTRIES, len(x))
        for matrix, slope, label in zip(
            self.matrices(x), slopes, self.labels[len(self.h) :], strict=True
        ):
            values, vectors = np.linalg.eigh(matrix)
            V = vectors[:, values < tolerance]
            a, b = np.triu_indices(V.shape[1])
            for i, j in zip(a, b, strict=True):
                pair = 0.5 * (np.outer(V[:, i], V[:, j]) + np.outer(V[:, j], V[:, i]))
                gradients.append((svec(pair) @ slope)[None])
                labels.append(label)
        return np.vstack(gradients), tuple(labels)


def svec(S: Array) -> Array:
    """Return upper triangles by columns, shape (..., k (k + 1) / 2), off-diagonals times sqrt 2.

    S (..., k, k).
    """
    rows, columns, weight = _upper(S.shape[-1])
    return S[..., rows, columns] * weight


@cache
def _upper(k: int) -> tuple[Array, Array, Array]:
    """Return rows and columns of an upper triangle by columns, and the factors of its entries."""
    columns, rows = np.tril_indices(k)  # (j, i) with i <= j
    return rows, columns, np.where(rows == columns, 1.0, np.sqrt(2.0))


def unsvec(vector: Array) -> Array:
    """Return the matrices, shape (m, 4, 4), of stacked vectors; the inverse of ``svec``.

    vector (10 m,).
    """
    rows, columns, weight = _upper(_SIZE)
    entries = vector.reshape(-1, _ENTRIES) / weight
    S = np.zeros((len(entries), _SIZE, _SIZE))
    S[:, rows, columns] = S[:, columns, rows] = entries
    return S


@dataclass(frozen=True, eq=False)
class ConeSolution:
    """A point of the cone and the status of the solver.

    Attributes:
        x: The point, shape (p,).
        n_iter: Number of iterations of the solver.
        message: Name of the solver and its status.
        multipliers: Multipliers of the linear rows, shape (k,); None: the solver returns none.
    """

    x: Array
    n_iter: int
    message: str
    multipliers: Array | None = None


def least_squares(
    A: Array,
    d: Array,
    cone: Cone,
    *,
    max_iterations: int = 200,
    is_exact: bool = True,
) -> ConeSolution:
    """Minimise |A x - d|^2 over a cone; directly if no constraint is active.

    The tolerance of a solver is relative to the problem. The problem is therefore solved again for
    corrections in units of 1e-3 and 1e-5, which reduces the error accordingly (measured on exact
    data: 2e-7, 5e-14, 2e-15).

    A (p, p), d (p,).
    """
    x = scipy.linalg.solve_triangular(A, d)
    if cone.holds(x):
        return ConeSolution(x, 0, "no constraint is active")
    if not is_exact:
        inverse = scipy.linalg.solve_triangular(A, np.eye(len(A)))
        whitened = cone.restrict(Subspace(x, inverse))
        y, failures = nearest(np.zeros((1, len(d))), whitened, max_iterations=max_iterations)
        if not failures:  # otherwise continue with the exact solution
            status = f"{_SOLVED} at reduced precision"
            return ConeSolution(x + inverse @ y[0], 0, f"Clarabel: {status}")
    G, h = cone.rows
    x, iterations, statuses = np.zeros(len(d)), 0, []
    for unit in _UNITS:
        right, slack = (d - A @ x) / unit, (h + G @ x) / unit
        y, status, count = _clarabel(A, right, G, slack, cone, max_iterations)
        statuses.append(status)
        iterations += count
        if status not in (_SOLVED, _ALMOST):
            break
        x = x + unit * y
    if _SOLVED not in statuses:
        raise _failure(statuses[0], cone)
    return ConeSolution(x, iterations, f"Clarabel: {_described(statuses)}")


def _described(statuses: Sequence[str]) -> str:
    """Return the status of a solution and its refinements; the last one may be less exact."""
    first = _SOLVED if statuses[0] == _SOLVED else f"first {statuses[0]}"
    count = len(statuses) - 1
    refined = f", refined {'once' if count == 1 else f'{count} times'}" if count else ""
    last = statuses[-1]
    return first + refined + ("" if last == _SOLVED else f", the last one {last}")


def nearest(points: Array, cone: Cone, *, max_iterations: int = 200) -> tuple[Array, list[str]]:
    """Return the point of a cone that is nearest to each of several points.

    For linear rows an active-set method is used, with an error of rounding size. With matrices,
    Clarabel is used, with an error of about 1e-3: the unit of the coordinates should be a standard
    deviation.

    points (k, p) -> (m, p).
    """
    G, h = cone.rows
    # normalise rows and matrices: in units of a standard deviation their sizes differ widely
    size = np.linalg.norm(G, axis=1)
    k = len(cone.h)
    size[k:] = np.repeat(np.linalg.norm(size[k:].reshape(-1, _ENTRIES), axis=1), _ENTRIES)
    G, h = G / size[:, None], h / size
    if cone.n_matrices:
        unit = replace(cone, G=G[:k], h=h[:k], S=G[k:], s=h[k:])
        solved = _nearest_by_clarabel(points, unit, max_iterations)
    else:
        solved = [_step_inside(G, h + G @ point, point) for point in points]
    found = [point for point in solved if not isinstance(point, str)]
    failures = [status for status in solved if isinstance(status, str)]
    return np.array(found).reshape(-1, points.shape[1]), failures


def _step_inside(G: Array, slack: Array, point: Array) -> Array | str:
    """Return point + z with the shortest z for which G z + slack >= 0, or the solver's status.

    References:
        Lawson, Hanson (1974), Solving least squares problems, chapter 23: the shortest vector
        under inequalities is the residual of a problem of nonnegative least squares.
    """
    from scipy.optimize import nnls

    violation = -slack.min()
    if violation <= 0:
        return point
    E = np.vstack([G.T, -slack / violation])
    goal = np.zeros(len(E))
    goal[-1] = 1.0
    try:
        multipliers, distance = nnls(E, goal)
    except RuntimeError:  # too many iterations
        return "MaxIterations"
    if distance < _CONTRADICTED:
        return _INFEASIBLE
    residual = E @ multipliers - goal
    nearest_one: Array = point - violation / residual[-1] * residual[:-1]
    return nearest_one


def _nearest_by_clarabel(points: Array, cone: Cone, max_iterations: int) -> list[Array | str]:
    """Return the nearest point to each point in a cone of unit rows, or Clarabel's status."""
    import clarabel
    from scipy import sparse

    p = points.shape[1]
    G, h = cone.rows
    violations = [-cone.slack(point).min() for point in points]
    # far from the cone, a larger unit: a solver reports bounds of 1e10 as infeasible
    length = max(1.0, max(violations) / _FAR)
    settings = _clarabel_settings(max_iterations, _NEAREST)
    settings.tol_feas = _NEAREST
    # with these settings the data of a solver could not be updated
    settings.presolve_enable = settings.chordal_decomposition_enable = False
    settings.input_sparse_dropzeros = False
    rows = sparse.csc_matrix(-G)
    unit = sparse.eye(p, format="csc")
    solver = clarabel.DefaultSolver(unit, np.zeros(p), rows, h / length, _cones(cone), settings)
    solved: list[Array | str] = []
    for point, violation in zip(points, violations, strict=True):
        if violation <= 0:
            solved.append(point)
            continue
        solver.update(q=-point / length)
        x, status, _ = _solution(solver)
        solved.append(length * x if status in (_SOLVED, _ALMOST) else status)
    return solved


def _failure(status: str, cone: Cone) -> NotConvergedError:
    families = ", ".join(cone.families)
    if _INFEASIBLE in status:
        return NotConvergedError(
            f"Clarabel found that no parameters meet all constraints ({families}, known masses and "
            "pinned links); widen the bounds in [estimator.constraints], or reduce the margin",
            status,
        )
    return NotConvergedError(
        f"Clarabel failed to solve the physically consistent fit with the constraints {families}; "
        "check the URDF's inertials with 'robotid inspect', or use the estimator 'wls'",
        status,
    )


def _clarabel(
    A: Array, d: Array, G: Array, h: Array, cone: Cone, max_iterations: int
) -> tuple[Array, str, int]:
    """Minimise |z|^2 with z = (A x - d) / size and h + G x in the cone, by Clarabel."""
    import clarabel
    from scipy import sparse

    p = len(d)
    size = np.linalg.norm(A, axis=0).max()
    P = sparse.block_diag([sparse.csc_matrix((p, p)), sparse.eye(p)], format="csc")
    rows = sparse.bmat([[A / size, -sparse.eye(p)], [-G, None]], format="csc")
    right = np.concatenate([d / size, h])
    cones = [clarabel.ZeroConeT(p), *_cones(cone)]
    # at the default of 1e-8 it stalls on easy problems, although the optimum is exact to 1e-9
    settings = _clarabel_settings(max_iterations, 1e-7)
    solver = clarabel.DefaultSolver(P, np.zeros(2 * p), rows, right, cones, settings)
    x, status, iterations = _solution(solver)
    return x[:p], status, iterations


def _solution(solver: Any) -> tuple[Array, str, int]:  # noqa: ANN401
    """Return the point, the status and the iterations of Clarabel; "Panic" if its code panics."""
    try:
        solution = solver.solve()
    except BaseException as error:  # a panic of Rust is not an Exception
        if type(error).__name__ != "PanicException":
            raise
        return np.empty(0), "Panic", 0
    return np.array(solution.x), str(solution.status), int(solution.iterations)


def _cones(cone: Cone) -> list[Any]:
    """Return a cone's rows as Clarabel's cones."""
    import clarabel

    matrices = [clarabel.PSDTriangleConeT(4)] * cone.n_matrices
    return [clarabel.NonnegativeConeT(len(cone.h)), *matrices]


def _clarabel_settings(max_iterations: int, gap: float) -> "clarabel.DefaultSettings":
    """Return Clarabel's settings: silent, one thread, a tolerance on the duality gap."""
    import clarabel

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.max_iter = max_iterations
    settings.tol_gap_abs = settings.tol_gap_rel = gap
    return settings
