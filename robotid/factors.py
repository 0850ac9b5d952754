"""The compressed problem: one triangular factor per joint, by sequential QR.

All that least squares, weighted least squares and convex fits need of W and tau is the
triangular factor R_j of each joint's rows, with R_j^T R_j = [W_j tau_j]^T [W_j tau_j].
Factors of two logs merge into the factor of both.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg.lapack

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.problem import Problem

__all__ = ["Factors", "compress", "merge"]


@dataclass(frozen=True, eq=False)
class Factors:
    """Triangular factors of [W_j tau_j], joint by joint.

    Attributes:
        R: Upper triangular factors, shape (n, c + 1, c + 1).
        rows: Number of rows folded in per joint, shape (n,), int.
        names: Names of the c columns.
    """

    R: Array
    rows: Array
    names: tuple[str, ...]

    def select(self, columns: Array) -> "Factors":
        """Return the factors of fewer columns.

        Args:
            columns: Indices of the columns kept, shape (b,).

        Returns:
            Factors over the same rows.
        """
        kept = np.append(np.asarray(columns, dtype=int), len(self.names))
        R = np.array([_triangle(R_j[:, kept]) for R_j in self.R])
        return Factors(R, self.rows, tuple(self.names[i] for i in columns))

    def weighted(self, sigma: Array) -> Array:
        """Return one factor of all joints, the rows of joint j divided by sigma_j.

        Args:
            sigma: Noise level per joint, shape (n,) [N m or N], positive.

        Returns:
            Triangular factor of the stacked [W_j tau_j] / sigma_j, shape (c + 1, c + 1).
        """
        stacked = self.R / np.asarray(sigma)[:, None, None]
        return _triangle(stacked.reshape(-1, self.R.shape[2]))

    def residual_squares(self, theta: Array) -> Array:
        """Return the sum of squared residuals |tau_j - W_j theta|^2 of each joint.

        Args:
            theta: Parameters, shape (c,).

        Returns:
            Sums, shape (n,) [(N m)^2 or N^2].
        """
        residual = self.R[:, :, -1] - self.R[:, :, :-1] @ theta
        squares: Array = np.einsum("ji,ji->j", residual, residual)
        return squares

    def torque_squares(self) -> Array:
        """Return the sum of squared torques |tau_j|^2, shape (n,) [(N m)^2 or N^2]."""
        squares: Array = np.einsum("ji,ji->j", self.R[:, :, -1], self.R[:, :, -1])
        return squares


def compress(problem: Problem) -> Factors:
    """Fold a problem into its factors, block by block.

    Args:
        problem: The rows; each is scaled by the square root of its weight, and left out where the
            weight is 0.

    Returns:
        The factors.

    Raises:
        DataError: If a row is not finite.
    """
    n, c = problem.n_joints, len(problem.names)
    active = [np.append(np.flatnonzero(problem.support[j]), c) for j in range(n)]
    R = [np.zeros((len(columns), len(columns))) for columns in active]
    rows = np.zeros(n, dtype=int)
    for W, tau, weight in problem.blocks():
        augmented = np.column_stack([W, tau]) * np.sqrt(weight)[:, None]  # (k n, c + 1)
        if not np.isfinite(augmented).all():
            raise DataError("the problem holds a row that is not finite; check the trajectory")
        by_joint = augmented.reshape(-1, n, c + 1)
        used = weight.reshape(-1, n) > 0
        rows += used.sum(axis=0)
        for j, columns in enumerate(active):
            R[j] = _triangle(np.vstack([R[j], by_joint[used[:, j], j][:, columns]]))
    dense = np.zeros((n, c + 1, c + 1))
    for j, columns in enumerate(active):
        dense[j][np.ix_(columns, columns)] = R[j]
    return Factors(dense, rows, problem.names)


def merge(factors: Sequence[Factors]) -> Factors:
    """Return the factors of all rows of several logs.

    Args:
        factors: At least one; all with the same columns and joints.

    Returns:
        Factors as if the rows had been folded in one pass.

    Raises:
        DataError: If there is none, or their columns or joints differ.
    """
    if not factors:
        raise DataError("no factors were given; at least one log is needed")
    first = factors[0]
    for other in factors[1:]:
        if other.names != first.names or other.R.shape != first.R.shape:
            raise DataError(
                f"factors differ: {first.R.shape[0]} joints x {len(first.names)} columns and "
                f"{other.R.shape[0]} joints x {len(other.names)} columns"
            )
    stacked = np.concatenate([f.R for f in factors], axis=1)
    R = np.array([_triangle(stack) for stack in stacked])
    return Factors(R, np.sum([f.rows for f in factors], axis=0), first.names)


def _triangle(rows: Array) -> Array:
    """Return the square upper triangular factor R of rows (m, k), padded with zeros if m < k."""
    k = rows.shape[1]
    if len(rows) == 0:
        return np.zeros((k, k))
    packed = scipy.linalg.lapack.dgeqrf(np.asfortranarray(rows), overwrite_a=True)[0]
    R = np.zeros((k, k))
    filled = min(k, len(rows))
    R[:filled] = np.triu(packed[:filled])
    return R
