"""The set that a consistent fit keeps to: linear inequalities, pseudo-inertias and equalities."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid._typing import Array

__all__ = ["Cone", "Subspace", "svec", "unsvec"]

_SIZE = 4  # of a pseudo-inertia
_ENTRIES = _SIZE * (_SIZE + 1) // 2


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
    k = S.shape[-1]
    weight = np.where(np.eye(k, dtype=bool), 1.0, np.sqrt(2.0))
    columns, rows = np.tril_indices(k)  # (j, i) with i <= j
    return (S * weight)[..., rows, columns]


def unsvec(vector: Array) -> Array:
    """Return the matrices, shape (m, 4, 4), of stacked vectors; the inverse of ``svec``.

    Args:
        vector: Vectors of 10 entries, one after the other, shape (10 m,).
    """
    columns, rows = np.tril_indices(_SIZE)
    entries = vector.reshape(-1, _ENTRIES) / np.where(rows == columns, 1.0, np.sqrt(2.0))
    S = np.zeros((len(entries), _SIZE, _SIZE))
    S[:, rows, columns] = S[:, columns, rows] = entries
    return S
