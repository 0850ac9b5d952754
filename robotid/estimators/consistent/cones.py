"""The set that a consistent fit keeps to, and convex solvers of |A x - d|^2 over it.

Linear inequalities, pseudo-inertias and equalities; Clarabel, and SCS as a second opinion.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.exceptions import MissingDependencyError, NotConvergedError

if TYPE_CHECKING:
    import clarabel

__all__ = [
    "SOLVERS",
    "Cone",
    "ConeSolution",
    "Subspace",
    "least_squares",
    "nearest",
    "svec",
    "unsvec",
]

_SIZE = 4  # of a pseudo-inertia
_ENTRIES = _SIZE * (_SIZE + 1) // 2
_REACHES = (1.0, 1e-3, 1e-5)  # units of the first solution and of its corrections
_SOLVED, _ALMOST, _INFEASIBLE = "Solved", "AlmostSolved", "PrimalInfeasible"
_NAMES = {"clarabel": "Clarabel", "scs": "SCS"}
_SCS_STATUS = {
    1: _SOLVED,
    2: _ALMOST,
    -1: "DualInfeasible",
    -2: _INFEASIBLE,
    -6: "DualInfeasible",
    -7: _INFEASIBLE,
}
_FAR = 1e3  # distance from the cone beyond which a longer unit is used
_NEAREST = 1e-6  # gap at which a point in units of its spread is right to 1e-3
_CONTRADICTED = 1e-7  # ratio of a first step inside to all of it, below which there is no inside
_SCS_ITERATIONS = 100  # of SCS for one of an interior-point method: each is a back-substitution


@dataclass(frozen=True, eq=False)
class Subspace:
    """The points x = origin + basis y that equalities leave.

    Attributes:
        origin: A point that meets them, shape (p,).
        basis: Directions that are left, shape (p, r), orthonormal.
    """

    origin: Array
    basis: Array

    @classmethod
    def of(cls, E: Array, e: Array) -> "Subspace":
        """Return the points with E x = e, or the nearest to it if they contradict each other.

        Args:
            E: Coefficients, shape (k, p).
            e: Right-hand side, shape (k,).
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
        """Directions that are held, shape (p, p - r), orthonormal."""
        p, r = self.basis.shape
        fixed: Array = np.zeros((p, 0)) if r == p else scipy.linalg.null_space(self.basis.T)
        return fixed


@dataclass(frozen=True, eq=False)
class Cone:
    """The points x with G x + h >= 0 and every S_i(x) positive semidefinite.

    Attributes:
        G: Coefficients of the linear rows, shape (k, p).
        h: Constants of the linear rows, shape (k,).
        S: Coefficients of the matrices, svec by svec, shape (10 m, p).
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
        """The kinds of constraints in it, each once."""
        return tuple(dict.fromkeys(label.split(" ", 1)[0] for label in self.labels))

    @cached_property
    def rows(self) -> tuple[Array, Array]:
        """All coefficients and constants, linear rows first."""
        return np.vstack([self.G, self.S]), np.concatenate([self.h, self.s])

    @property
    def linear(self) -> "Cone":
        """Its linear rows alone."""
        return Cone(self.G, self.h, self.S[:0], self.s[:0], self.labels[: len(self.h)])

    def matrices(self, x: Array) -> Array:
        """Return the matrices S_i(x), shape (m, 4, 4).

        Args:
            x: A point, shape (p,).
        """
        return unsvec(self.S @ x + self.s)

    def slack(self, x: Array) -> Array:
        """Return values of rows, then smallest eigenvalues, shape (k + m,); negative beyond bounds.

        Args:
            x: A point, shape (p,).
        """
        eigenvalues = np.linalg.eigvalsh(self.matrices(x))[:, 0]
        return np.concatenate([self.G @ x + self.h, eigenvalues])

    def holds(self, x: Array) -> bool:
        """Return whether a point lies in it.

        Args:
            x: A point, shape (p,).
        """
        return bool((self.slack(x) >= 0).all())

    def restrict(self, space: Subspace) -> "Cone":
        """Return the cone in coordinates y of a subspace: the points y whose x lies in this one.

        Args:
            space: The subspace.
        """
        return Cone(
            self.G @ space.basis,
            self.h + self.G @ space.origin,
            self.S @ space.basis,
            self.s + self.S @ space.origin,
            self.labels,
        )

    def active(self, x: Array, tolerance: float) -> tuple[Array, tuple[str, ...]]:
        """Return the constraints that bind at a point, linearised there.

        A matrix with r eigenvalues at 0, of eigenvectors V, holds the r (r + 1) / 2 directions
        V^T dS V = 0, as its rank does not change on the boundary.

        Args:
            x: A point, shape (p,).
            tolerance: Slack below which a constraint counts as active.

        Returns:
            Gradients of what is held at 0, shape (a, p), and the label of each.
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

    Args:
        S: Symmetric matrices, shape (..., k, k).
    """
    rows, columns, weight = _upper(S.shape[-1])
    return S[..., rows, columns] * weight


@cache
def _upper(k: int) -> tuple[Array, Array, Array]:
    """Return rows and columns of an upper triangle by columns, and the weights of its entries."""
    columns, rows = np.tril_indices(k)  # (j, i) with i <= j
    return rows, columns, np.where(rows == columns, 1.0, np.sqrt(2.0))


def unsvec(vector: Array) -> Array:
    """Return the matrices, shape (m, 4, 4), of stacked vectors; the inverse of ``svec``.

    Args:
        vector: Vectors of 10 entries, one after the other, shape (10 m,).
    """
    rows, columns, weight = _upper(_SIZE)
    entries = vector.reshape(-1, _ENTRIES) / weight
    S = np.zeros((len(entries), _SIZE, _SIZE))
    S[:, rows, columns] = S[:, columns, rows] = entries
    return S


@dataclass(frozen=True, eq=False)
class ConeSolution:
    """A point of the cone and what the solver said of it.

    Attributes:
        x: The point, shape (p,).
        n_iter: Iterations of the solver.
        message: Name of the solver and its status.
        multipliers: Those of the linear rows, shape (k,), if the solver states them.
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
    solver: str = "clarabel",
    max_iterations: int = 200,
    is_exact: bool = True,
) -> ConeSolution:
    """Minimise |A x - d|^2 over a cone; without it, and exactly, if it does not bind.

    A solver's tolerance is relative to the problem: solved again for a correction in units of
    1e-3 and 1e-5, its error shrinks likewise (measured on exact data: 2e-7, 5e-14, 2e-15).

    Args:
        A: Upper triangular factor, shape (p, p), not singular.
        d: Right-hand side, shape (p,).
        cone: Where x must lie.
        solver: One of ``SOLVERS``.
        max_iterations: Bound on its iterations.
        is_exact: Whether to solve for the corrections, too. If not, Clarabel solves it to 1e-3 of
            the unit of A x, in half the time; of weighted rows that is a standard deviation. A
            cone of linear rows alone takes a fiftieth of the time.

    Raises:
        MissingDependencyError: If the solver is not installed.
        NotConvergedError: If it does not solve the problem, or finds that no point meets the
            constraints.
    """
    x = scipy.linalg.solve_triangular(A, d)
    if cone.holds(x):
        return ConeSolution(x, 0, "no constraint binds")
    if not is_exact:
        inverse = scipy.linalg.solve_triangular(A, np.eye(len(A)))
        whitened = cone.restrict(Subspace(x, inverse))
        y, failures = nearest(np.zeros((1, len(d))), whitened, max_iterations=max_iterations)
        if not failures:  # where data contradict the cone, the exact way goes on
            return ConeSolution(x + inverse @ y[0], 0, f"{_NAMES['clarabel']}: {_SOLVED} roughly")
    call, name = SOLVERS[solver], _NAMES[solver]
    G, h = cone.rows
    x, iterations, statuses = np.zeros(len(d)), 0, []
    for reach in _REACHES:
        y, status, count = call(
            A, (d - A @ x) / reach, G, (h + G @ x) / reach, cone, max_iterations
        )
        statuses.append(status)
        iterations += count
        if status not in (_SOLVED, _ALMOST):
            break
        x = x + reach * y
    if _SOLVED not in statuses:
        raise _failure(name, statuses[0], cone)
    return ConeSolution(x, iterations, f"{name}: {_described(statuses)}")


def _described(statuses: Sequence[str]) -> str:
    """Return how a solution and its refinements ended, the last of which may be less exact."""
    first = _SOLVED if statuses[0] == _SOLVED else f"first {statuses[0]}"
    count = len(statuses) - 1
    refined = f", refined {'once' if count == 1 else f'{count} times'}" if count else ""
    last = statuses[-1]
    return first + refined + ("" if last == _SOLVED else f", the last time to {last} only")


def nearest(points: Array, cone: Cone, *, max_iterations: int = 200) -> tuple[Array, list[str]]:
    """Return the point of a cone that is nearest to each of several points.

    Among linear rows alone to rounding, by their active set; beside matrices to 1e-3 or so, by
    Clarabel: coordinates are wanted whose unit is a standard deviation.

    Args:
        points: The points, shape (k, p).
        cone: The cone.
        max_iterations: Bound on Clarabel's iterations for one point.

    Returns:
        The nearest points, shape (m, p), and the solver's status of each of the k - m that it did
        not find.
    """
    G, h = cone.rows
    # rows, and matrices, of unit size: they come in units of a standard deviation, great or small
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
    """Return point + z with the shortest z whose G z + slack >= 0, or why there is none.

    References:
        Lawson, Hanson (1974), Solving least squares problems, chapter 23: the shortest vector
        under inequalities is the residual of a problem of nonnegative least squares.
    """
    from scipy.optimize import nnls

    reach = -slack.min()
    if reach <= 0:
        return point
    E = np.vstack([G.T, -slack / reach])
    goal = np.zeros(len(E))
    goal[-1] = 1.0
    try:
        multipliers, distance = nnls(E, goal)
    except RuntimeError:  # it says so of its iterations
        return "MaxIterations"
    if distance < _CONTRADICTED:
        return _INFEASIBLE
    residual = E @ multipliers - goal
    nearest_one: Array = point - reach / residual[-1] * residual[:-1]
    return nearest_one


def _nearest_by_clarabel(points: Array, cone: Cone, max_iterations: int) -> list[Array | str]:
    """Return what is nearest to each point in a cone of rows of unit size, or Clarabel's status."""
    import clarabel
    from scipy import sparse

    p = points.shape[1]
    G, h = cone.rows
    lacking = [-cone.slack(point).min() for point in points]
    # far from the cone, a longer unit: a solver holds bounds of 1e10 for contradictory
    reach = max(1.0, max(lacking) / _FAR)
    settings = _clarabel_settings(max_iterations, _NEAREST)
    settings.tol_feas = _NEAREST
    # without these the data of a solver cannot change
    settings.presolve_enable = settings.chordal_decomposition_enable = False
    settings.input_sparse_dropzeros = False
    rows = sparse.csc_matrix(-G)
    unit = sparse.eye(p, format="csc")
    solver = clarabel.DefaultSolver(unit, np.zeros(p), rows, h / reach, _cones(cone), settings)
    solved: list[Array | str] = []
    for point, beyond in zip(points, lacking, strict=True):
        if beyond <= 0:
            solved.append(point)
            continue
        solver.update(q=-point / reach)
        x, status, _ = _solution(solver)
        solved.append(reach * x if status in (_SOLVED, _ALMOST) else status)
    return solved


def _failure(name: str, status: str, cone: Cone) -> NotConvergedError:
    families = ", ".join(cone.families)
    if _INFEASIBLE in status:
        return NotConvergedError(
            f"no parameters meet all constraints ({families}, beside known masses and pinned "
            f"links), says {name}; loosen the bounds in [estimator.constraints], or the margin",
            status,
        )
    return NotConvergedError(
        f"the physically consistent fit was not solved by {name}, with the constraints "
        f"{families}; check the URDF's inertials with 'robotid inspect', or use the 'wls' "
        "estimator",
        status,
    )


def _clarabel(
    A: Array, d: Array, G: Array, h: Array, cone: Cone, max_iterations: int
) -> tuple[Array, str, int]:
    """Minimise |z|^2 with z = (A x - d) / size and h + G x in the cone (residual form)."""
    import clarabel
    from scipy import sparse

    p = len(d)
    size = np.linalg.norm(A, axis=0).max()
    P = sparse.block_diag([sparse.csc_matrix((p, p)), sparse.eye(p)], format="csc")
    rows = sparse.bmat([[A / size, -sparse.eye(p)], [-G, None]], format="csc")
    right = np.concatenate([d / size, h])
    cones = [clarabel.ZeroConeT(p), *_cones(cone)]
    # at the default 1e-8 it stalls on easy problems, at an optimum right to 1e-9
    settings = _clarabel_settings(max_iterations, 1e-7)
    solver = clarabel.DefaultSolver(P, np.zeros(2 * p), rows, right, cones, settings)
    x, status, iterations = _solution(solver)
    return x[:p], status, iterations


def _solution(solver: Any) -> tuple[Array, str, int]:  # noqa: ANN401
    """Return the point, the status and the iterations of Clarabel, "Panic" where it gave up so."""
    try:
        solution = solver.solve()
    except BaseException as error:  # of Rust: it is no Exception
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


def _scs(
    A: Array, d: Array, G: Array, h: Array, cone: Cone, max_iterations: int
) -> tuple[Array, str, int]:
    """Solve the same problem by SCS, whose matrices are stored as lower triangles."""
    try:
        import scs
    except ImportError as error:
        raise MissingDependencyError("solver = 'scs'", "scs", "scs") from error
    from scipy import sparse

    p = len(d)
    size = np.linalg.norm(A, axis=0).max()
    columns, rows_of = np.tril_indices(4)
    lower = np.argsort(4 * rows_of + columns)  # by columns of the lower triangle
    linear = len(cone.h)
    blocks = np.arange(10 * cone.n_matrices).reshape(-1, 10)[:, lower].reshape(-1)
    order = np.concatenate([np.arange(linear), linear + blocks])
    P = sparse.block_diag([sparse.csc_matrix((p, p)), sparse.eye(p)], format="csc")
    rows = sparse.bmat([[A / size, -sparse.eye(p)], [-G[order], None]], format="csc")
    solver = scs.SCS(
        {"P": P, "A": rows, "b": np.concatenate([d / size, h[order]]), "c": np.zeros(2 * p)},
        {"z": p, "l": linear, "s": [4] * cone.n_matrices},
        verbose=False,
        max_iters=_SCS_ITERATIONS * max_iterations,
        eps_abs=1e-9,
        eps_rel=1e-9,
    )
    solution = solver.solve()
    info = solution["info"]
    status = _SCS_STATUS.get(info["status_val"], str(info["status"]))
    return np.array(solution["x"][:p]), status, int(info["iter"])


#: The solvers by name.
SOLVERS: Mapping[str, Callable[[Array, Array, Array, Array, Cone, int], tuple[Array, str, int]]] = {
    "clarabel": _clarabel,
    "scs": _scs,
}
