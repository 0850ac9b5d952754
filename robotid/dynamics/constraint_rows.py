"""Elimination of unknown constraint forces: contacts with the ground and closed chains.

W pi = tau + J^T f with the Jacobian J of the constraints and forces f. With an orthonormal basis B
of the columns of J^T of unknown forces and P = I - B B^T, P W pi = P tau: the forces disappear, and
as many equations as they have components. A force of 1 N counts as much as a torque of 1 N m.

Shapes: q (N, n), J (N, m, n_rows), contacts (N, k) and used (N, n_rows) bool, B (N, n_rows, r).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import DataError, ModelError
from robotid.base.findings import listed, suggestion
from robotid.base.typing import Array
from robotid.data.base_motion import BaseColumns, ImuFrame
from robotid.data.log import Trajectory
from robotid.data.signal_settings import BaseSource
from robotid.dynamics.factors import RowSource
from robotid.robot.constraints import Contact, frame_id
from robotid.robot.model import RobotModel

_RANK = 1e-8  # singular values below this share of the largest are of dependent constraints ...
_WEAK = 0.01  # ... in rows of the base alone, which feet that press against each other hardly load
_AS_IS = BaseSource()
_BLOCK = 1024  # samples whose Jacobians are in memory together
_CACHED = 64  # samples that are projected together
_AXES = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


def constraint_jacobian(model: RobotModel, q: Array, contacts: Array) -> Array:
    """Return the Jacobian J of a robot's constraints at each sample, 0 of links in the air."""
    pin_model, data = model.pin_model, model.pin_model.createData()
    frames = [[frame_id(pin_model, link) for link in x.frames] for x in model.constraints]
    edges = np.cumsum([0, *(x.sizes[x.kind] for x in model.constraints)])
    place = {x: k for k, x in enumerate(model.contacts)}
    J = np.zeros((len(q), edges[-1], pin_model.nv))
    for k, q_k in enumerate(np.ascontiguousarray(model.configurations(q))):
        pin.computeJointJacobians(pin_model, data, q_k)
        for x, ids, first, stop in zip(model.constraints, frames, edges, edges[1:], strict=False):
            if x in place and not contacts[k, place[x]]:
                continue
            own = [pin.getFrameJacobian(pin_model, data, i, _AXES) for i in ids]
            J[k, first:stop] = x.rows(own, pin.updateFramePlacement(pin_model, data, ids[0]))
    return J @ model.velocity_map


def contact_links(model: RobotModel, q: Array) -> tuple[Array, Array]:
    """Return axes (N, k, 3, 3) and Jacobians of rotation (N, k, 3, n_rows) of links of contacts."""
    pin_model, data = model.pin_model, model.pin_model.createData()
    frames = [frame_id(pin_model, x.frame) for x in model.contacts]
    rotation = np.empty((len(q), len(frames), 3, 3))
    turning = np.empty((len(q), len(frames), 3, pin_model.nv))
    for k, q_k in enumerate(np.ascontiguousarray(model.configurations(q))):
        pin.computeJointJacobians(pin_model, data, q_k)
        for i, frame in enumerate(frames):
            rotation[k, i] = pin.updateFramePlacement(pin_model, data, frame).rotation
            turning[k, i] = pin.getFrameJacobian(pin_model, data, frame, _AXES)[3:]
    return rotation, turning @ model.velocity_map


def force_basis(J: Array, used: Array, floats: bool = False) -> Array:
    """Return orthonormal bases B of the torques that unknown constraint forces can cause."""
    A = J.swapaxes(1, 2) * used[:, :, None]
    parts, least = [], _least(used, floats)
    for start in range(0, len(A), _BLOCK):
        U, s, _ = np.linalg.svd(A[start : start + _BLOCK], full_matrices=False)
        is_independent = s > least * s.max(axis=1, keepdims=True, initial=1e-300)
        parts.append(U * is_independent[:, None])
    return np.concatenate(parts) if parts else A


def _least(used: Array, floats: bool) -> float:
    """Return the smallest relative singular value of forces that have an effect."""
    return _WEAK if floats and not used[:, 6:].any() else _RANK


def loop_basis(model: RobotModel, q: Array) -> Array:
    """Return bases of the torques that the forces of loops can cause, as of ``force_basis``."""
    J = constraint_jacobian(replace(model, constraints=model.loops), q, np.ones((len(q), 0)))
    return force_basis(J, np.ones((len(q), model.n_rows), dtype=bool))


def without_forces(basis: Array, rows: Array) -> Array:
    """Return rows (N, n_rows) or (N, n_rows, c) orthogonal to the torques of constraint forces."""
    if rows.ndim == 2:
        return without_forces(basis, rows[..., None])[..., 0]
    projected: Array = basis @ (basis.swapaxes(1, 2) @ rows)
    return np.subtract(rows, projected, out=projected)


def mixed_rows(basis: Array, weights: Array) -> Array:
    """Return the rows that are used or projected into used rows, shape (n_rows,), bool."""
    return np.asarray(np.any(weights, axis=0) | np.any(basis, axis=(0, 2)))


@dataclass(frozen=True, eq=False)
class ProjectedRows(RowSource):
    """Rows without constraint forces: each has the columns of all rows, or none without weight."""

    own: RowSource  # the rows before the projection, not weighted
    basis: Array  # as of ``force_basis``
    weights: Array  # weight of each row, shape (N, n_rows)

    @property
    def samples(self) -> int:
        return self.own.samples

    @property
    def is_parallel(self) -> bool:
        return self.own.is_parallel

    @cached_property
    def columns(self) -> tuple[Array, ...]:
        every, is_used = self._every, np.any(self.weights, axis=0)
        return tuple(every if used else every[:0] for used in is_used)

    @cached_property
    def _every(self) -> Array:
        return np.unique(np.concatenate(self.own.columns))

    def rows(self, start: int, stop: int) -> Array:
        B = self.basis[start:stop]
        left = 1.0 - np.einsum("kij,kij->ki", B, B)  # (k, n_rows), diagonal of P: its trace counts
        count: Array = np.rint(np.sum(left, axis=0, where=self.weights[start:stop] > 0))
        return count.astype(int)

    def select(self, columns: Array) -> "ProjectedRows":
        return replace(self, own=self.own.select(columns))

    def blocks(self, start: int, stop: int, segment: int | None = None) -> Iterator[list[Array]]:
        every = self._every
        places = [np.append(np.searchsorted(every, own), len(every)) for own in self.own.columns]
        mixed = np.flatnonzero(mixed_rows(self.basis, self.weights))
        room, done = np.zeros((2, _CACHED, len(mixed), len(every) + 1))
        out: list[Array] = []
        for block in self.own.blocks(start, stop, segment):
            size = len(block[0])
            if not out or len(out[0]) < size:
                out = [np.zeros((size, len(own) + 1), order="F") for own in self.columns]
            for first in range(0, size, _CACHED):  # as many as the cache of a core holds
                some = slice(first, min(first + _CACHED, size))
                k = slice(start + some.start, start + some.stop)
                X, Y = (x[: some.stop - some.start] for x in (room, done))
                for i, j in enumerate(mixed):
                    X[:, i, places[j]] = block[j][some]  # other columns of the room remain 0
                B, root = self.basis[k][:, mixed], np.sqrt(self.weights[k][:, mixed, None])
                P = root * (np.eye(len(mixed)) - B @ B.swapaxes(1, 2))
                np.matmul(P, X, out=Y)
                for j, rows in zip(mixed, Y.swapaxes(0, 1), strict=True):
                    if len(self.columns[j]):
                        out[j][some] = rows
            start += size
            yield [rows[:size] for rows in out]


def constrained(
    model: RobotModel, motion: Trajectory, used: Array, *, has_torque: bool = True
) -> tuple[Trajectory, Array]:
    """Return a motion without measured forces (subtracted) and unknown ones, and the rows used."""
    if not has_torque:
        used = used & (np.arange(model.n_rows) < model.n_rows - len(model.joints))
    if motion.switching is not None:
        used = used & ~motion.switching[:, None]
    if not model.constraints:
        return motion, used
    known, tau, parts = measured_rows(model), motion.tau.copy(), []
    contacts, floats = touching(model, motion), model.free_flyer and not used[:, 6:].any()
    for start in range(0, max(len(tau), 1), _BLOCK):
        k = slice(start, start + _BLOCK)
        J = constraint_jacobian(model, motion.q[k], contacts[k])
        if motion.wrenches is not None:
            tau[k] += np.einsum("kmj,km->kj", J[:, known], motion.wrenches[k])
        parts.append(force_basis(np.delete(J, known, axis=1), used[k], floats))
    basis = np.concatenate(parts)
    used = used & (np.sum(basis**2, axis=2) < 1.0 - _RANK)  # rows in which something remains
    return replace(motion, basis=basis, tau=without_forces(basis, tau), loaded=tau), used


def touching(model: RobotModel, motion: Trajectory) -> Array:
    """Return which contacts of a robot may touch the ground, shape (N, k), bool."""
    contacts = np.ones((len(motion.t), len(model.contacts)), dtype=bool)
    if motion.contacts is not None:
        flagged = [not x.always for x in model.contacts]
        if motion.contacts.shape[1] != sum(flagged):
            raise DataError(
                f"the log has contact flags of {motion.contacts.shape[1]} contacts, expected "
                f"{sum(flagged)}, one for each contact that may be in the air and is not measured "
                "completely; leave out the others"
            )
        contacts[:, flagged] = motion.contacts
    return contacts


def constraint_forces(model: RobotModel, motion: Trajectory, torque: Array, used: Array) -> Array:
    """Return forces (N, m) [N, N m] for which a robot has a torque; unknown: least squares."""
    J = constraint_jacobian(model, motion.q, touching(model, motion))
    known, tau = measured_rows(model), motion.tau if motion.loaded is None else motion.loaded
    f = np.zeros(J.shape[:2])
    if motion.wrenches is not None:
        f[:, known] = motion.wrenches
    A = np.delete(J, known, axis=1).swapaxes(1, 2) * used[:, :, None]
    inverse = np.linalg.pinv(A, rcond=_least(used, model.free_flyer))
    others = np.delete(np.arange(J.shape[1]), known)
    f[:, others] = (inverse @ ((torque - tau) * used)[..., None])[..., 0]
    return f


def logged_base(model: RobotModel, source: BaseSource = _AS_IS) -> BaseColumns:
    """Return the columns of a floating base and of contacts that logs of a robot have."""
    link, flagged = source.link or "", [x for x in model.contacts if not x.always]
    if link:
        _require_link(model, link, "link")
    return BaseColumns(
        model.free_flyer,
        tuple(x.frame for x in flagged),
        tuple(f"{part} {x.frame}" for x in model.contacts for part in x.measured),
        source.twist,
        thresholds=tuple(x.threshold for x in flagged),
        local=tuple(x.frame for x in model.contacts if x.axes == "link"),
        imu=None if source.imu is None or not model.free_flyer else _imu_frame(model, source.imu),
        link="" if link == model.tree.root else link,
    )


def _require_link(model: RobotModel, link: str, key: str) -> None:
    if link not in model.tree.links:
        raise ModelError(
            f"{key} in [base] is {link!r}, which is not a link of {model.name}; links: "
            f"{listed(model.tree.links)}{suggestion(link, model.tree.links)}"
        )


def _imu_frame(model: RobotModel, link: str) -> ImuFrame:
    """Return the place of an IMU in the base."""
    _require_link(model, link, "imu")
    frame = model.pin_model.frames[frame_id(model.pin_model, link)]
    if frame.parentJoint != 1:
        raise ModelError(
            f"imu in [base] is {link!r}, which moves relative to the root link "
            f"{model.tree.root!r}; expected a link that is fixed to it"
        )
    place = frame.placement
    gravity: Array = model.pin_model.gravity.linear
    turn = np.array(pin.Quaternion(place.rotation).coeffs())
    return ImuFrame(turn, place.translation.copy(), gravity.copy())


def measured_rows(model: RobotModel) -> list[int]:
    """Return the rows of the Jacobian whose forces are measured."""
    edges = np.cumsum([0, *(x.sizes[x.kind] for x in model.constraints)]).tolist()
    pairs = zip(model.constraints, edges, strict=False)
    contacts = [(x, first) for x, first in pairs if isinstance(x, Contact)]
    return [first + x.components.index(y) for x, first in contacts for y in x.measured]
