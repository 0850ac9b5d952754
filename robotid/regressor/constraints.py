"""Elimination of unknown constraint forces: contacts with the ground and closed chains.

With the Jacobian J of the constraints, W pi = tau + J^T f with unknown forces f. The rows are
projected orthogonally to the columns of J^T, P W pi = P tau with P = I - B B^T and B an orthonormal
basis of these columns: the force disappears, as many equations as it has components are lost.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.logs.data import Trajectory
from robotid.regressor.problem import RowSource
from robotid.robot.constraints import Contact, frame_id
from robotid.robot.model import RobotModel

__all__ = [
    "ProjectedRows",
    "constrained",
    "constraint_jacobian",
    "force_basis",
    "without_forces",
]

_RANK = 1e-8  # singular values below this share of the largest are of dependent constraints
_BLOCK = 1024  # samples whose Jacobians are in memory together


def constraint_jacobian(model: RobotModel, q: Array, contacts: Array) -> Array:
    """Return the Jacobian of a robot's constraints at each sample, shape (N, m, n_rows).

    Args:
        model: The robot; its contacts have the axes of the world, its loops likewise.
        q: Joint coordinates, shape (N, n) or (N, 7 + n) [rad, m].
        contacts: Which contacts touch the ground, shape (N, k), bool; the rows of others are 0.

    Raises:
        DataError: If the shape of q is not that of the model.
    """
    pin_model, G = model.pin_model, model.velocity_map
    data, axes = pin_model.createData(), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    frames = [[frame_id(pin_model, link) for link in x.frames] for x in model.constraints]
    edges = np.cumsum([0, *(x.sizes[x.kind] for x in model.constraints)])
    place = {x: k for k, x in enumerate(c for c in model.constraints if isinstance(c, Contact))}
    J = np.zeros((len(q), edges[-1], model.n_rows))
    for k, q_k in enumerate(np.ascontiguousarray(model.configurations(q))):
        pin.computeJointJacobians(pin_model, data, q_k)
        for x, ids, first, stop in zip(model.constraints, frames, edges, edges[1:], strict=False):
            if x in place and not contacts[k, place[x]]:
                continue
            own = [pin.getFrameJacobian(pin_model, data, i, axes) for i in ids]
            rotation = pin.updateFramePlacement(pin_model, data, ids[0]).rotation
            J[k, first:stop] = x.rows(own, rotation) @ G
    return J


def force_basis(model: RobotModel, q: Array, contacts: Array, used: Array) -> Array:
    """Return orthonormal bases of the torques that constraint forces can cause.

    Args:
        model: The robot.
        q: Joint coordinates, shape (N, n) or (N, 7 + n) [rad, m].
        contacts: As of ``constraint_jacobian``.
        used: Rows used, shape (N, n_rows), bool: the torques are those in these rows.

    Returns:
        B with columns of length 1 or 0, shape (N, n_rows, m).
    """
    parts = []
    for start in range(0, len(q), _BLOCK):
        k = slice(start, start + _BLOCK)
        A = constraint_jacobian(model, q[k], contacts[k]).swapaxes(1, 2) * used[k, :, None]
        U, s, _ = np.linalg.svd(A, full_matrices=False)
        is_independent = s > _RANK * s.max(axis=1, keepdims=True, initial=0.0)
        parts.append(U * is_independent[:, None])
    return np.concatenate(parts)


def without_forces(basis: Array, rows: Array) -> Array:
    """Return rows orthogonal to the torques of constraint forces, same shape.

    Args:
        basis: As of ``force_basis``, shape (N, n_rows, m).
        rows: Torques, shape (N, n_rows), or regressors, shape (N, n_rows, c).
    """
    if rows.ndim == 2:
        return without_forces(basis, rows[..., None])[..., 0]
    projected: Array = rows - basis @ (basis.swapaxes(1, 2) @ rows)
    return projected


@dataclass(frozen=True, eq=False)
class ProjectedRows(RowSource):
    """Rows of a trajectory without the torques of its constraint forces; see ``RowSource``.

    Every row has the columns of all rows. The count of rows is that of independent equations, the
    sum of the diagonal of P.

    Attributes:
        own: The rows before the projection, not weighted.
        basis: As of ``force_basis``.
        weights: Weight of each row, shape (N, n_rows).
    """

    own: RowSource
    basis: Array
    weights: Array

    @property
    def samples(self) -> int:
        return self.own.samples

    @property
    def is_parallel(self) -> bool:
        return self.own.is_parallel

    @cached_property
    def columns(self) -> tuple[Array, ...]:
        every = np.unique(np.concatenate(self.own.columns))
        return (every,) * self.weights.shape[1]

    def rows(self, start: int, stop: int) -> Array:
        k = slice(start, stop)
        left = 1.0 - np.sum(self.basis[k] ** 2, axis=2)  # (k, n_rows), diagonal of P
        count: Array = np.rint(np.sum(left, axis=0, where=self.weights[k] > 0)).astype(int)
        return count

    def select(self, columns: Array) -> "ProjectedRows":
        return replace(self, own=self.own.select(columns))

    def blocks(self, start: int, stop: int, segment: int | None = None) -> Iterator[list[Array]]:
        every, n = self.columns[0], self.weights.shape[1]
        places = [np.append(np.searchsorted(every, own), len(every)) for own in self.own.columns]
        for block in self.own.blocks(start, stop, segment):
            k = slice(start, start := start + len(block[0]))
            X = np.zeros((len(block[0]), n, len(every) + 1))
            for j, (place, rows) in enumerate(zip(places, block, strict=True)):
                X[:, j, place] = rows
            X = without_forces(self.basis[k], X) * np.sqrt(self.weights[k])[..., None]
            yield [np.asfortranarray(X[:, j]) for j in range(n)]


def constrained(
    model: RobotModel, motion: Trajectory, used: Array
) -> tuple[Trajectory, Array]:
    """Return a motion with torques without those of constraint forces, and the rows used.

    Rows in which nothing remains, and samples at which a contact changes, are not used.

    Args:
        model: The robot.
        motion: Its motion, with contacts.
        used: Rows used for other reasons, shape (N, n_rows), bool.
    """
    if not model.constraints:
        return motion, used
    contacts = np.zeros((len(motion.t), 0), dtype=bool)
    if motion.contacts is not None:
        contacts, used = motion.contacts, used & ~motion.switching[:, None]
    basis = force_basis(model, motion.q, contacts, used)
    used = used & (np.sum(basis**2, axis=2) < 1.0 - _RANK)
    return motion.projected(basis, without_forces(basis, motion.tau)), used
