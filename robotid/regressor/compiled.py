"""The compiled way to the inertial columns of the regressor, where Numba is installed.

A robot's tree is flattened to arrays that ``lanes`` works on. Any joint's placement is
R(q) = A + B cos q + C sin q, p(q) = p0 + d q, with the axis measured from Pinocchio's own joint, so
that aligned and unaligned, turning and sliding joints are one case.
"""

from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.logs.data import Trajectory
from robotid.regressor.columns import RowPlan

if TYPE_CHECKING:
    from robotid.robot.model import RobotModel

__all__ = [
    "LONG_ENOUGH",
    "Tree",
    "flatten",
    "is_installed",
    "joint_constants",
    "why_not",
    "work_per_sample",
]

#: Work, samples times ``work_per_sample``, from which the compiled path pays its start of about
#: half a second in every process (importing Numba, reading the compiled code). For seven joints in
#: a row that is 1e5 samples. Compiling it takes some 10 s, once per installation.
LONG_ENOUGH = 3_500_000


def is_installed() -> bool:
    """Return whether the extra ``fast`` is installed; nothing is imported."""
    return find_spec("numba") is not None


def work_per_sample(model: "RobotModel") -> int:
    """Return the work of one sample: pairs of a body and a joint that carries it, and a start.

    Args:
        model: The robot.

    Returns:
        The work, in units of about 0.15 us of Pinocchio's function called from Python.
    """
    return 8 + sum(len(support) - 1 for support in model.pin_model.supports[1:])


def why_not(model: "RobotModel") -> str | None:
    """Return in words why the compiled path cannot take a robot, or None if it can.

    Args:
        model: The robot.
    """
    joints, first = list(model.pin_model.joints), 2 if model.free_flyer else 1
    for name, joint in list(zip(model.pin_model.names, joints, strict=True))[first:]:
        if joint.nv != 1 or not _is_simple(_joint_axis(model.pin_model, joint.id)):
            return f"joint {name!r} is a {joint.shortname()}, which is not compiled"
    if np.any(np.sum(model.velocity_map != 0, axis=1) > 1):
        return "a joint follows several others, which is not compiled"
    try:
        _lanes()
    except (ImportError, RuntimeError) as error:  # RuntimeError: no folder to keep the code in
        return f"Numba does not run here: {error}"
    return None


class CompiledWriter:
    """Writes one block of rows after the other into the same memory: one thread, one writer."""

    def __init__(self, model: "RobotModel", tree: "Tree", plan: RowPlan, out: Array) -> None:
        """Prepare to write to ``out``, shape (C, k), k a multiple of 64; see ``why_not`` before."""
        lanes = _lanes()
        bodies, depth = tree.rows.shape
        self._model, self._tree, self._out = model, tree, out
        self._places = _places(tree, plan)
        drives = [drive for row in plan.drives for drive in row]
        self._drives = [k for _, k, _ in drives]
        self._ratios = np.array([[ratio] for _, _, ratio in drives]).reshape(-1, 1)
        self._ends = np.array([*(place for place, _, _ in drives), *plan.torques])
        self._widths = np.diff(plan.first)
        self._root = np.zeros(out.shape[1])
        self._work = np.zeros(lanes.state_size(bodies, depth))
        states = self._work[-bodies * (12 + 6 * depth) * lanes.LANES :]
        _prepare(states.reshape(bodies, 12 + 6 * depth, lanes.LANES), model, tree)

    def load(self, motion: Trajectory, part: slice, values: Array, weights: Array | None) -> None:
        """Take the samples of the next blocks, and what drive parameters multiply in them.

        Args:
            motion: The trajectory.
            part: Which of its samples.
            values: As of ``drive_values``, shape (k, N).
            weights: Weight of each row; None: all 1.
        """
        q, v, a, tau = motion.q[part], motion.v[part], motion.a[part], motion.tau[part]
        self._base = np.zeros((12, 0))
        if self._model.free_flyer:
            self._base = _base_state(self._model, q, v, a)
            q = q[:, 1:]  # the pose has one entry more than the twist
        # copies that Numba finds writable and in C order: another kind would be compiled again
        self._q, self._v, self._a = (np.array(x, dtype=float, order="C") for x in (q, v, a))
        values = values[self._drives]
        if (self._ratios != 1.0).any():
            values *= self._ratios
        self._values = np.vstack([values, tau.T])
        self._weights = np.zeros((0, 0)) if weights is None else np.array(weights, float, order="C")

    def write(self, start: int, stop: int) -> None:
        """Write the rows of samples start to stop of those loaded, at most k."""
        lanes, tree, motion = _lanes(), self._tree, (self._q, self._v, self._a)
        lanes.inertial_rows(
            tree.parents, tree.depths, tree.slots, tree.leaders, tree.joints, self._places,
            *motion, self._base, self._work, self._out, (start, stop),
        )  # fmt: skip
        lanes.finish_rows(
            self._values, self._ends, self._widths, self._weights, self._root, self._out,
            (start, stop),
        )  # fmt: skip


@dataclass(frozen=True)
class Tree:
    """A robot as arrays over its bodies, the world first, as ``inertial_rows`` takes them.

    Attributes:
        rows: Row of the regressor of each slot of each body, shape (B, D), int; -1 beyond.
    """

    parents: Array
    depths: Array
    slots: Array
    leaders: Array
    joints: Array
    rows: Array


def flatten(model: "RobotModel") -> Tree:
    """Return a robot as arrays.

    Args:
        model: The robot; ``why_not`` must return None for it.
    """
    pin_model, G = model.pin_model, model.velocity_map
    bodies = pin_model.njoints
    parents = np.array([int(parent) for parent in pin_model.parents])
    rows: list[list[int]] = [[]]
    slots, leaders = np.zeros(bodies, dtype=int), np.zeros(bodies, dtype=int)
    joints = np.zeros((bodies, 41))
    for body in range(1, bodies):
        joint, above = pin_model.joints[body], rows[parents[body]]
        if joint.nv == 6:
            rows.append(list(range(6)))
            slots[body] = -1
            continue
        leader = int(np.flatnonzero(G[joint.idx_v])[0]) if G[joint.idx_v].any() else 0
        rows.append(above if leader in above else [*above, leader])
        slots[body], leaders[body] = rows[-1].index(leader), leader
        ratio, offset = G[joint.idx_v, leader], model.position_offset[joint.idx_v]
        joints[body] = np.append(joint_constants(pin_model, body), [ratio, offset])
    table = np.full((bodies, max(map(len, rows))), -1)
    for body, own in enumerate(rows):
        table[body, : len(own)] = own
    depths = np.array([len(own) for own in rows])
    return Tree(parents, depths, slots, leaders, joints, table)


def _places(tree: Tree, plan: RowPlan) -> Array:
    """Return where each body's columns in each of its rows go, shape (B, D, 10); -1: nowhere."""
    table = np.full((*tree.rows.shape, 10), -1)
    for j, (wanted, place) in enumerate(zip(plan.inertial, plan.places, strict=True)):
        body = wanted // 10 + 1
        slot = np.argmax(tree.rows[body] == j, axis=1)
        table[body, slot, wanted % 10] = place
    return table


def _prepare(state: Array, model: "RobotModel", tree: Tree) -> None:
    """Write what never changes: the world's acceleration, axes in their own bodies."""
    state[0, 9:12] = -model.pin_model.gravity.linear[:, None]
    for body in range(1, len(state)):
        slot = tree.slots[body]
        if slot < 0:
            state[body, 12:48] = np.eye(6).reshape(36, 1)
        elif slot >= tree.depths[tree.parents[body]]:
            axis = tree.joints[body, 33:39] * tree.joints[body, 39]
            state[body, 12 + 6 * slot : 18 + 6 * slot] = axis[:, None]


def joint_constants(pin_model: pin.Model, body: int) -> Array:
    """Return A, B, C (by columns), p0, d and the axis (v, w) of a joint, shape (39,).

    Args:
        pin_model: The robot.
        body: Number of the joint.
    """
    slide, turn = _joint_axis(pin_model, body).reshape(2, 3)
    P, p0 = pin_model.jointPlacements[body].rotation, pin_model.jointPlacements[body].translation
    along = np.outer(turn, turn)
    about = np.eye(3) - along if turn.any() else np.zeros((3, 3))
    A = P @ (np.eye(3) - about)
    rotation = [(P @ M).T.reshape(-1) for M in (about, pin.skew(turn))]
    return np.concatenate([A.T.reshape(-1), *rotation, p0, P @ slide, slide, turn])


def _joint_axis(pin_model: pin.Model, body: int) -> Array:
    """Return the axis (v, w) of a joint in its own frame, at its neutral position, shape (6,)."""
    data, q = pin_model.createData(), pin.neutral(pin_model)
    joint = pin_model.joints[body]
    jacobian = pin.computeJointJacobian(pin_model, data, q, body)
    axis: Array = jacobian.reshape(6, -1)[
        :, joint.idx_v
    ]  # Pinocchio has one dimension of one joint
    return axis


def _is_simple(axis: Array) -> bool:
    """Return whether a joint either slides along or turns about its axis of length 1."""
    lengths = np.linalg.norm(axis.reshape(2, 3), axis=1)
    return bool(np.allclose(np.sort(lengths), [0.0, 1.0]))


def _base_state(model: "RobotModel", q: Array, v: Array, a: Array) -> Array:
    """Return w, v, dw, a - g of the floating base in its own frame, shape (12, k)."""
    g = model.pin_model.gravity.linear
    # R^T g with the rotation matrix of the quaternion, as Pinocchio forms it
    u = np.cross(g, q[:, 3:6])
    gravity = g + 2 * (q[:, 6:7] * u + np.cross(u, q[:, 3:6]))
    return np.vstack([v[:, 3:6].T, v[:, :3].T, a[:, 3:6].T, (a[:, :3] - gravity).T])


@cache
def _lanes() -> ModuleType:
    import robotid.regressor.lanes  # imports Numba

    return robotid.regressor.lanes
