"""Rows of a trajectory's problem joint by joint: regressor, torque and weight, block by block.

Inertial columns are computed by Pinocchio or by compiled code, drive columns by the terms of the
drives. Shapes: q (N, n), v and a (N, n_rows).
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from itertools import pairwise
from types import ModuleType
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.base_motion import in_base
from robotid.data.log import Trajectory
from robotid.dynamics.factors import RowSource
from robotid.robot.drive_term import DriveMotion
from robotid.robot.model import RobotModel
from robotid.robot.parameters import ParameterLayout

BLOCK = 512  # samples per block: with 100 columns it fits in the cache
COMPILED = "compiled by Numba"

BLOCK_SIZE = 2**18  # numbers per block, 2 MiB, but at least one group of samples
_GROUP = 64  # samples: a multiple of those that compiled code computes together
_LOADED = 8  # blocks that a writer loads together
_MOST_BYTES = 2**25  # of inertial columns that are stored with a trajectory

_log = logging.getLogger(__name__)

#: Samples times ``work_per_sample`` from which the compiled path is faster despite its start of
#: 0.5 s per process: 1e5 samples of seven joints. Compiling takes 10 s, once per installation.
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
    """Return A, B, C, p0, d and the axis (39,): R = A + B cos q + C sin q, p = p0 + d q of any."""
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


def choose_engine(model: RobotModel, samples: int, compiled: bool | None) -> str:
    """Return the name of the code that computes the rows, and log why it is not the faster one."""
    is_short = compiled is None and samples < LONG_ENOUGH / work_per_sample(model)
    if compiled is False or is_short:
        return "Pinocchio"
    reason = why_not(model)
    if reason is None and not compiled and not tree_lanes().inertial_rows.stats.cache_path:
        reason = "no folder for compiled code; set one as NUMBA_CACHE_DIR"
    if reason is None:
        return COMPILED
    _log.info("%s: regressor of %d samples: Pinocchio (%s)", model.name, samples, reason)
    return f"Pinocchio ({reason})"


def drive_values(
    layout: ParameterLayout,
    q: Array,
    v: Array,
    a: Array,
    direction: Array,
    memory: Array | None = None,
) -> Array:
    """Return the columns of drive parameters, (k, N); ``drive_loads[j]`` times these: row j."""
    motion = drive_motion(layout, q, v, a, direction)
    states, wanted = np.empty((len(v), 0)) if memory is None else memory, layout.remembering
    if states.shape != (len(v), len(wanted)):
        raise DataError(
            f"memory has shape {states.shape}, expected {(len(v), len(wanted))}: a column for each "
            "drive parameter with internal state or load; call remember() with the trajectory first"
        )
    values = np.empty((len(layout.drive_parameters), len(v)))
    for k, (d, term) in enumerate(layout.drive_parameters):
        if k not in wanted:
            values[k] = term.column(motion.of(d))
    values[list(wanted)] = states.T
    return values


def trajectory_values(
    layout: ParameterLayout, motion: Trajectory, part: slice = slice(None)
) -> Array:
    """Return the columns of drive parameters along a trajectory, (k, N); see ``drive_values``."""
    direction, memory = (None if x is None else x[part] for x in (motion.direction, motion.memory))
    signs = friction_directions(layout, motion.v[part], direction)
    state = motion.q[part], motion.v[part], motion.a[part]
    return drive_values(layout, *state, signs, memory)


def drive_motion(
    layout: ParameterLayout,
    q: Array,
    v: Array,
    a: Array,
    direction: Array,
    load: Array | None = None,
    rate: Array | None = None,
    begins: Array | None = None,
) -> DriveMotion:
    """Return the motion and load of drives, arrays of shape (d, N): load and rate (N, n)."""
    R = layout.drive_ratios
    n = R.shape[1]
    w = R @ v[:, v.shape[1] - n :].T
    still = np.broadcast_to(0.0, w.shape)
    share = R / np.sum(R**2, axis=1, keepdims=True).clip(min=1e-300)  # a drive's part of the load
    return DriveMotion(
        q=R @ q[:, q.shape[1] - n :].T,
        v=w,
        a=R @ a[:, a.shape[1] - n :].T,
        direction=direction.T if direction.shape[1] else w,
        load=still if load is None else share @ load.T,
        rate=still if rate is None else share @ rate.T,
        begins=begins,
    )


def remembered(layout: ParameterLayout, motion: DriveMotion) -> Array:
    """Return the columns of drive parameters with internal state or load, shape (N, m)."""
    own = [layout.drive_parameters[k] for k in layout.remembering]
    return np.column_stack([term.column(motion.of(d)) for d, term in own])


def friction_speeds(layout: ParameterLayout) -> Array:
    """Return the speeds (c, n) whose sign is the direction of friction: joints, then couplings."""
    ratios: Array = layout.drive_ratios / layout.drive_speeds[:, None]
    return ratios if layout.follows_direction else ratios[:0]


def sure_rows(layout: ParameterLayout, v: Array, least: float) -> Array:
    """Return the rows in which the sign of friction is certain, shape (N, n_rows), bool."""
    ratios = friction_speeds(layout)
    first = v.shape[1] - ratios.shape[1]
    slow = np.abs(v[:, first:] @ ratios.T) < least  # (N, c)
    certain = np.ones(v.shape, dtype=bool)
    certain[:, first:] = ~(slow @ (ratios != 0.0))
    return certain


def friction_directions(layout: ParameterLayout, v: Array, direction: Array | None) -> Array:
    """Return the directions of friction, shape (N, c): those given, or the signs of the speeds."""
    speeds = friction_speeds(layout)
    if direction is None:
        return np.asarray(np.sign(v[:, v.shape[1] - speeds.shape[1] :] @ speeds.T))
    wanted = (len(v), len(speeds))
    if direction.shape != wanted:
        raise DataError(
            f"direction has shape {direction.shape}, expected {wanted}: a column for each Coulomb "
            "parameter of the model; process the log with the speeds of this model"
        )
    return direction


class RowPlan(NamedTuple):
    """The columns of a block of rows and their places, joint by joint."""

    inertial: list[Array]  # per row its inertial columns, n arrays of shape (c_j,)
    places: list[Array]  # per row their places in the block, likewise
    drive_places: Array  # places of the E drive columns, shape (E,), int
    drive_numbers: Array  # their drive parameters, shape (E,), int
    ratios: Array  # their ratios, shape (E, 1)
    torques: Array  # per row the place of the torque, the last one of the row, shape (n,), int
    first: Array  # first place of each row, and the end, shape (n + 1,), int


class _Sources(NamedTuple):
    """Where Pinocchio's regressor has the inertial columns of a block of rows."""

    wanted: Array  # entries of the flat regressor, int
    parts: list[tuple[Array | slice, float, slice, bool]]  # places, ratio, entries, whether added
    G: Array | None  # Pinocchio's speeds by those of the joints; None if they are the same

    @classmethod
    def of(cls, model: RobotModel, plan: RowPlan) -> "_Sources":
        """Return the sources of a plan."""
        G, size = model.velocity_map, 10 * (model.pin_model.njoints - 1)
        is_same = np.array_equal(G, np.eye(model.pin_model.nv))
        # tau = G^T tau_pinocchio: row j is the sum of the Pinocchio rows that its joint moves
        wanted, parts, end = [], [], 0
        for j, (columns, places) in enumerate(zip(plan.inertial, plan.places, strict=True)):
            for k, r in enumerate(np.array([j]) if is_same else np.flatnonzero(G[:, j])):
                wanted.append(size * r + columns)
                part = slice(end, end := end + len(columns))
                parts.append((_as_slice(places), G[r, j], part, k > 0))
        return cls(np.concatenate(wanted), parts, None if is_same else G)


def plan_rows(layout: ParameterLayout, columns: Sequence[Array]) -> RowPlan:
    """Return the plan of a block of rows: each row's columns in that order, then its torque."""
    loads, size = layout.drive_loads, layout.n_inertial
    base = len(columns) - len(loads)  # rows of a floating base, without drives
    first = np.concatenate([[0], np.cumsum([len(row) + 1 for row in columns])])
    inertial = [np.flatnonzero(row < size) for row in columns]
    drives = [
        (first[j] + k, g - size, loads[j - base, g - size])
        for j, row in enumerate(columns)
        for k, g in enumerate(row)
        if g >= size
    ]
    places, numbers, ratios = np.array(drives).reshape(-1, 3).T
    return RowPlan(
        [row[k] for row, k in zip(columns, inertial, strict=True)],
        [start + k for start, k in zip(first, inertial, strict=False)],
        places.astype(int), numbers.astype(int), ratios[:, None], first[1:] - 1, first,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class InertialRows:
    """Inertial columns of a trajectory's regressor, which are independent of drives."""

    pin_model: pin.Model  # the robot
    columns: tuple[Array, ...]  # inertial parameters of each row, n_rows arrays (c_j,), int
    values: Array  # the columns of each row, one row after another, shape (sum of c_j, N)

    @cached_property
    def first(self) -> Array:
        """First place of each row, and the end, shape (n_rows + 1,), int."""
        return np.concatenate([[0], np.cumsum([len(own) for own in self.columns])])

    def write(self, samples: Array | slice, Y: Array) -> None:
        """Write those of N samples into regressors, shape (N, n_rows, p)."""
        rows = zip(self.columns, pairwise(self.first), strict=True)
        for j, (own, (first, stop)) in enumerate(rows):
            Y[:, j, _as_slice(own)] = self.values[first:stop, samples].T

    def torque(self, stacked: Array) -> Array:
        """Return the torques of bodies, shape (k, N, n_rows) [N m, N]: stacked (p, k)."""
        rows = zip(self.columns, pairwise(self.first), strict=True)
        return np.stack([stacked[own].T @ self.values[i:j] for own, (i, j) in rows], axis=-1)


def inertial_rows(model: RobotModel, q: Array, v: Array, a: Array) -> InertialRows:
    """Return the inertial columns that affect each row; of many joints they are few."""
    plan, sources = _inertial_plan(model)
    out = np.empty((plan.first[-1], min(BLOCK, len(q))))
    writer, places = _PinocchioWriter(model, plan, out, sources), np.concatenate(plan.places)
    values = np.empty((len(places), len(q)))
    for start in range(0, len(q), BLOCK):
        k = slice(start, min(start + BLOCK, len(q)))
        writer.write_inertial(q[k], v[k], a[k])
        values[:, k] = out[places, : k.stop - k.start]
    return InertialRows(model.pin_model, tuple(plan.inertial), values)


def write_inertial(
    model: RobotModel, q: Array, v: Array, a: Array, Y: Array, data: pin.Data | None = None
) -> None:
    """Write the inertial columns into the regressors of N samples, shape (N, n_rows, p)."""
    regressor, pin_model = pin.computeJointTorqueRegressor, model.pin_model
    data = data or pin_model.createData()
    G = _inertial_plan(model)[1].G
    v, a = (v, a) if G is None else (v @ G.T, a @ G.T)
    states = zip(Y[:, :, : model.layout.n_inertial], model.configurations(q), v, a, strict=True)
    for Y_k, q_k, v_k, a_k in states:
        inertial = regressor(pin_model, data, q_k, v_k, a_k)
        Y_k[:] = inertial if G is None else G.T @ inertial


def keep_inertial_rows(model: RobotModel, trajectory: Trajectory) -> None:
    """Store the inertial columns of a trajectory with it, unless they are many or compiled."""
    columns, samples = _inertial_support(model), len(trajectory.t)
    is_large = 8 * samples * sum(map(len, columns)) > _MOST_BYTES
    is_stored = kept_rows(model, trajectory) is not None
    if is_stored or is_large or choose_engine(model, samples, None) == COMPILED:
        return
    rows = inertial_rows(model, trajectory.q, trajectory.v, trajectory.a)
    trajectory.derived["inertial rows"] = rows


@lru_cache(maxsize=2)  # for many short motions of one robot
def _inertial_plan(model: RobotModel) -> tuple[RowPlan, _Sources]:
    """Return the plan of rows with inertial columns alone, and their sources."""
    plan = plan_rows(model.layout, _inertial_support(model))
    return plan, _Sources.of(model, plan)


def _inertial_support(model: RobotModel) -> tuple[Array, ...]:
    """Return the indices of the inertial parameters of each row, n_rows arrays."""
    return tuple(np.flatnonzero(row[: model.layout.n_inertial]) for row in model.support)


def kept_rows(model: RobotModel, trajectory: Trajectory) -> InertialRows | None:
    """Return the inertial columns that are stored with a trajectory, None if of another robot."""
    rows: InertialRows | None = trajectory.derived.get("inertial rows")
    return rows if rows is not None and rows.pin_model is model.pin_model else None


@dataclass(frozen=True, eq=False)
class TrajectoryRows(RowSource):
    """Rows of a robot's trajectory; see ``RowSource``."""

    model: RobotModel  # the robot
    trajectory: Trajectory  # N samples
    weights: Array  # weight of each row, shape (N, n_rows)
    support: Array  # shape (n_rows, p), bool: False where row j is zero for every motion
    selected: Array  # indices of its columns among the p columns, shape (c,)
    engine: str  # name of the code that computes the regressor, as of ``choose_engine``
    inertial: InertialRows | None = None  # if they are stored with the trajectory

    @property
    def samples(self) -> int:
        return len(self.trajectory.t)

    @property
    def is_parallel(self) -> bool:  # Pinocchio's Python function holds the interpreter's lock
        return self.engine == COMPILED

    @cached_property
    def columns(self) -> tuple[Array, ...]:
        return tuple(np.flatnonzero(row) for row in self.support[:, self.selected])

    def rows(self, start: int, stop: int) -> Array:
        return np.asarray(np.count_nonzero(self.weights[start:stop] > 0, axis=0))

    def select(self, columns: Array) -> "TrajectoryRows":
        return replace(self, selected=self.selected[columns])

    def blocks(self, start: int, stop: int, segment: int | None = None) -> Iterator[list[Array]]:
        plan, segment = self._plan, segment or stop - start
        fitting = BLOCK_SIZE // int(plan.first[-1]) // _GROUP * _GROUP  # into the cache
        length = max(_GROUP, min(BLOCK, fitting))
        out = np.empty((plan.first[-1], length))
        motion, is_weighted = self.trajectory, bool((self.weights != 1.0).any())
        writer = (
            _CompiledWriter(self.model, self._tree, plan, out)
            if self.engine == COMPILED
            else _PinocchioWriter(
                self.model, plan, out, _Sources.of(self.model, plan), self.inertial
            )
        )
        for first in range(start, stop, _LOADED * length):
            last = min(first + _LOADED * length, stop)
            part = slice(first, last)
            weights = self.weights[part] if is_weighted else None
            values = trajectory_values(self.model.layout, motion, part)
            writer.load(motion, part, values, weights)
            ends = range(start + segment, last, segment)  # of segments
            edges = {*range(first, last, length), *(end for end in ends if end > first), last}
            for k, end in pairwise(sorted(edge - first for edge in edges)):
                writer.write(k, end)
                yield [out[i:j, : end - k].T for i, j in pairwise(plan.first)]

    @cached_property
    def _tree(self) -> Tree:
        return flatten(self.model)

    @cached_property
    def _plan(self) -> RowPlan:
        return plan_rows(self.model.layout, [self.selected[columns] for columns in self.columns])


def trajectory_rows(
    model: RobotModel, trajectory: Trajectory, weight: Array | None, compiled: bool | None
) -> TrajectoryRows:
    """Return all rows of a trajectory with all standard parameters: weight (N, n_rows)."""
    if trajectory.joints != model.joints:
        raise DataError(
            f"the trajectory has the joints {listed(trajectory.joints)}, expected the model's, "
            f"{listed(model.joints)}; read the log with joints=model.joints"
        )
    shape = (len(trajectory.t), model.n_rows)
    weights = np.broadcast_to(1.0, shape) if weight is None else weight
    if weights.shape != shape:
        raise DataError(f"weight has shape {weights.shape}, expected {shape}")
    every, engine = np.arange(len(model.layout.names)), choose_engine(model, shape[0], compiled)
    inertial = kept_rows(model, trajectory)
    return TrajectoryRows(model, trajectory, weights, model.support, every, engine, inertial)


class _PinocchioWriter:
    """Writes inertial columns: stored ones, or by Pinocchio's function, sample by sample."""

    def __init__(
        self, model: RobotModel, plan: RowPlan, out: Array, sources: _Sources,
        inertial: InertialRows | None = None,
    ) -> None:  # fmt: skip
        self._model, self._plan, self._out, self._sources = model, plan, out, sources
        self._stored: Array | None = None
        if inertial is not None:
            own = zip(inertial.first, inertial.columns, plan.inertial, strict=False)
            self._stored = inertial.values
            self._from = np.concatenate([i + np.searchsorted(x, wanted) for i, x, wanted in own])
            self._to = _as_slice(np.concatenate(plan.places))
        self._data = model.pin_model.createData()
        self._raw = np.empty((out.shape[1], len(sources.wanted)))

    def load(self, motion: Trajectory, part: slice, values: Array, weights: Array | None) -> None:
        """Load the samples of the next blocks, and their drive columns."""
        self._motion, self._first, self._weights, self._values = motion, part.start, weights, values

    def write(self, start: int, stop: int) -> None:
        """Write the rows of samples start to stop of those loaded."""
        part, m, plan = slice(start, stop), self._motion, self._plan
        own = slice(self._first + start, self._first + stop)  # in the trajectory
        if self._stored is None:
            self.write_inertial(m.q[own], m.v[own], m.a[own])
        else:
            self._out[self._to, : stop - start] = self._stored[self._from, own]
        out = self._out[:, : stop - start]
        out[plan.drive_places] = plan.ratios * self._values[plan.drive_numbers, part]
        out[plan.torques] = m.tau[own].T
        if self._weights is not None:
            roots = np.sqrt(self._weights[part]).T
            for root, (i, j) in zip(roots, pairwise(plan.first), strict=True):
                out[i:j] *= root

    def write_inertial(self, q: Array, v: Array, a: Array) -> None:
        """Write the inertial columns of some samples at the beginning of the block."""
        regressor, model, data = pin.computeJointTorqueRegressor, self._model.pin_model, self._data
        wanted, parts, G = self._sources
        if G is not None:
            v, a = v @ G.T, a @ G.T
        x = np.ascontiguousarray(self._model.configurations(q))
        for raw_k, q_k, v_k, a_k in zip(self._raw, x, v, a, strict=False):
            # only the wanted entries, while the regressor is in the cache; without bound checks
            regressor(model, data, q_k, v_k, a_k).take(wanted, None, raw_k, "clip")
        out, raw = self._out[:, : len(q)], self._raw[: len(q)].T
        for places, ratio, part, is_added in parts:
            values = raw[part] if ratio == 1.0 else ratio * raw[part]
            out[places] = out[places] + values if is_added else values


class _CompiledWriter:
    """Writes blocks of rows into the same memory; one writer per thread."""

    def __init__(self, model: RobotModel, tree: Tree, plan: RowPlan, out: Array) -> None:
        self._model, self._tree, self._out = model, tree, out
        table = np.full((len(plan.inertial), 10 * len(tree.parents)), -1)
        for row, wanted, place in zip(table, plan.inertial, plan.places, strict=True):
            row[wanted] = place
        self._places = tree.places(table)
        self._ends = np.append(plan.drive_places, plan.torques)
        self._plan, self._widths = plan, np.diff(plan.first)
        self._root = np.zeros(out.shape[1])
        self._work = tree.work_space()

    def load(self, motion: Trajectory, part: slice, values: Array, weights: Array | None) -> None:
        """Load the samples of the next blocks, and their drive columns: values (k, N)."""
        q, v, a, tau = motion.q[part], motion.v[part], motion.a[part], motion.tau[part]
        if self._model.free_flyer:  # the pose has one more entry than the twist
            falling = in_base(q[:, 3:7], self._model.pin_model.gravity.linear)
            base = np.vstack([v[:, :6].T, (a[:, :3] - falling).T, a[:, 3:6].T])
            self._motion = own_motion(q[:, 1:], v, a, base)
        else:
            self._motion = own_motion(q, v, a)
        values = values[self._plan.drive_numbers]
        if (self._plan.ratios != 1.0).any():
            values *= self._plan.ratios
        self._values = np.array(np.vstack([values, tau.T]), order="C")  # as of ``own_motion``
        self._weights = np.zeros((0, 0)) if weights is None else np.array(weights, float, order="C")

    def write(self, start: int, stop: int) -> None:
        """Write the rows of samples start to stop of those loaded, at most k."""
        lanes, span = tree_lanes(), (start, stop)
        lanes.inertial_rows(self._tree, self._places, self._motion, self._work, self._out, span)
        lanes.finish_rows(
            self._values, self._ends, self._widths, self._weights, self._root, self._out, span
        )


def _as_slice(places: Array) -> Array | slice:
    """Return increasing places as a slice if none is left out: writing is faster then."""
    if len(places) and places[-1] - places[0] == len(places) - 1:
        return slice(int(places[0]), int(places[-1]) + 1)
    return places
