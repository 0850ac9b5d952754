"""A robot's tree as arrays for compiled code.

Any joint's placement is R(q) = A + B cos q + C sin q, p(q) = p0 + d q, with the axis from
Pinocchio's own joint, so that revolute and prismatic joints, aligned or not, are one case.
"""

from functools import cache
from types import ModuleType
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from robotid.base.typing import Array
from robotid.robot.model import RobotModel

#: Work, samples times ``work_per_sample``, from which the compiled path is faster despite its start
#: of about 0.5 s per process (importing Numba, reading the compiled code). For seven joints in
#: series that is 1e5 samples. Compiling it takes some 10 s, once per installation.
LONG_ENOUGH = 3_500_000


def work_per_sample(model: RobotModel) -> int:
    """Return the work of one sample: pairs of a body and a joint that moves it, plus a constant."""
    return 8 + sum(len(support) - 1 for support in model.pin_model.supports[1:])


def why_not(model: RobotModel) -> str | None:
    """Return why the compiled path does not support a robot, or None if it does."""
    joints, first = list(model.pin_model.joints), 2 if model.free_flyer else 1
    for name, joint in list(zip(model.pin_model.names, joints, strict=True))[first:]:
        # prismatic, or revolute with an axis of length 1
        axis = _joint_axis(model.pin_model, joint.id).reshape(2, -1)
        if joint.nv != 1 or not np.allclose(np.sort(np.linalg.norm(axis, axis=1)), [0.0, 1.0]):
            return f"the compiled code does not support joint {name!r} ({joint.shortname()})"
    try:
        tree_lanes()
    except ImportError as error:
        return f"Numba cannot be imported: {error}"
    return None


def keeps_code() -> bool:
    """Return whether there is a cache folder for compiled code."""
    return tree_lanes().inertial_rows.stats.cache_path is not None


class Tree(NamedTuple):
    """A robot's B bodies as arrays for compiled code. Parents come before their children."""

    parents: Array  # parent of each body, shape (B,), int; -1: the world
    joints: Array  # constants of each joint, its ratio and offset to its coordinate, (B, 41)
    leaders: Array  # coordinate that moves each joint, shape (B,), int
    rows: Array  # row of the regressor of each slot of each body, shape (B, D), int; -1 if unused
    depths: Array  # number of rows that each body affects, shape (B,), int
    slots: Array  # slot of a body's own joint, shape (B,), int; -1: floating base
    is_below: Array  # whether joint k moves body i, its own included, shape (B, B), bool, [i, k]
    gravity: Array  # shape (3,) [m/s^2]

    @property
    def prismatic(self) -> Array:
        """Which joints are prismatic, shape (B,), bool."""
        return np.asarray(np.any(self.joints[:, 33:36], axis=1))

    @property
    def axes(self) -> Array:
        """Directions of the joints in the frames of their bodies, shape (B, 3)."""
        return np.asarray(self.joints[:, 33:36] + self.joints[:, 36:39])  # of which one is 0

    def work_space(self) -> Array:
        """Return a new work space for ``tree_lanes``."""
        return np.asarray(tree_lanes().work_of(*self.rows.shape))

    def places(self, wanted: Array) -> Array:
        """Return the places (B, D, 10) of the columns of each body in each of its rows."""
        by_body = wanted.reshape(len(wanted), -1, 10).swapaxes(0, 1)  # (B, n_rows, 10)
        places = np.take_along_axis(by_body, self.rows.clip(min=0)[..., None], axis=1)
        return np.where(self.rows[..., None] >= 0, places, -1)

    def part(self, bodies: Array) -> "Tree":
        """Return some bodies as a separate tree: bodies (k,)."""
        place = {-1: -1} | {int(body): k for k, body in enumerate(bodies)}
        parents = np.array([place[int(i)] for i in self.parents[bodies]])
        own = {name: getattr(self, name)[bodies] for name in self._fields[1:-2]}
        is_below = np.ascontiguousarray(self.is_below[np.ix_(bodies, bodies)])
        return self._replace(parents=parents, is_below=is_below, **own)


def own_motion(
    q: Array, v: Array, a: Array, base: Array | None = None
) -> tuple[Array, Array, Array, Array]:
    """Return writable copies in C order, base (12, N): for others Numba would compile again."""
    base = np.zeros((12, 0)) if base is None else base
    q, v, a, base = (np.array(x, dtype=float, order="C") for x in (q, v, a, base))
    return q, v, a, base


def flatten(model: RobotModel) -> Tree:
    """Return a robot as arrays."""
    pin_model, G = model.pin_model, model.velocity_map
    size = pin_model.njoints - 1
    parents = np.array([int(parent) - 1 for parent in pin_model.parents])[1:]
    slots, leaders = np.zeros((2, size), dtype=int)
    joints, is_below = np.zeros((size, 41)), np.eye(size, dtype=bool)
    rows: list[list[int]] = []
    for i, parent in enumerate(parents):
        above = rows[parent] if parent >= 0 else []
        is_below[i] |= is_below[parent] if parent >= 0 else False
        joint = pin_model.joints[i + 1]
        if joint.nv == 6:
            rows.append(list(range(6)))
            slots[i] = -1
            continue
        leader = int(np.flatnonzero(G[joint.idx_v])[0]) if G[joint.idx_v].any() else 0
        rows.append(above if leader in above else [*above, leader])
        slots[i], leaders[i] = rows[-1].index(leader), leader
        ratio, offset = G[joint.idx_v, leader], model.position_offset[joint.idx_v]
        joints[i] = np.append(joint_constants(pin_model, i + 1), [ratio, offset])
    table = np.full((size, max(map(len, rows))), -1)
    for i, own in enumerate(rows):
        table[i, : len(own)] = own
    depths = np.array([len(own) for own in rows])
    gravity = np.array(pin_model.gravity.linear)
    return Tree(parents, joints, leaders, table, depths, slots, is_below, gravity)


def joint_constants(pin_model: pin.Model, body: int) -> Array:
    """Return A, B, C (by columns), p0, d and the axis (v, w) of a joint, shape (39,)."""
    linear, angular = _joint_axis(pin_model, body).reshape(2, 3)
    P, p0 = pin_model.jointPlacements[body].rotation, pin_model.jointPlacements[body].translation
    along = np.outer(angular, angular)
    about = np.eye(3) - along if angular.any() else np.zeros((3, 3))
    A = P @ (np.eye(3) - about)
    rotation = [(P @ M).T.reshape(-1) for M in (about, pin.skew(angular))]
    return np.concatenate([A.T.reshape(-1), *rotation, p0, P @ linear, linear, angular])


def _joint_axis(pin_model: pin.Model, body: int) -> Array:
    """Return the axis (v, w) of a joint in its own frame, at its neutral position, shape (6,)."""
    data, q = pin_model.createData(), pin.neutral(pin_model)
    joint = pin_model.joints[body]
    jacobian = pin.computeJointJacobian(pin_model, data, q, body)
    return np.asarray(jacobian.reshape(6, -1)[:, joint.idx_v])  # of one joint it is a vector


@cache
def tree_lanes() -> ModuleType:
    """Return the compiled code of rows; it imports Numba."""
    import robotid.dynamics.kernels.tree_lanes

    return robotid.dynamics.kernels.tree_lanes
