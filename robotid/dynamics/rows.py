"""Rows of a trajectory's problem joint by joint: regressor, torque and weight, block by block."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.compiled import (
    LONG_ENOUGH,
    CompiledWriter,
    Tree,
    flatten,
    keeps_code,
    why_not,
    work_per_sample,
)
from robotid.dynamics.drive_columns import RowPlan, plan_rows, trajectory_values
from robotid.dynamics.problem import RowSource
from robotid.robot.model import RobotModel

BLOCK = 512  # samples per block: with 100 columns it fits in the cache
COMPILED = "compiled by Numba"

_LANES = 64  # the compiled path works on whole groups of so many samples
_BLOCK_SIZE = 2**18  # numbers per block, 2 MiB, but at least one group of samples
_LOADED = 8  # blocks that a writer loads together
_MOST_BYTES = 2**25  # of inertial columns that are stored with a trajectory

_log = logging.getLogger(__name__)


def choose_engine(model: RobotModel, samples: int, compiled: bool | None) -> str:
    """Return the name of the code that computes the rows, and log it."""
    enough = -(-LONG_ENOUGH // work_per_sample(model))
    engine = "Pinocchio"
    if compiled is None and samples < enough:
        engine += f" (the compiled path is slower below {enough} samples)"
    elif compiled is not False:
        reason = why_not(model)
        if reason is None and compiled is None and not keeps_code():
            reason = "no folder for compiled code; set one as NUMBA_CACHE_DIR"
        engine = COMPILED if reason is None else f"{engine} ({reason})"
    _log.info("%s: regressor of %d samples: %s", model.name, samples, engine)
    return engine


@dataclass(frozen=True, eq=False)
class InertialRows:
    """Inertial columns of a trajectory's regressor, which are independent of drives."""

    pin_model: pin.Model  # the robot
    # indices of the inertial parameters of each row, n_rows arrays of shape (c_j,)
    columns: tuple[Array, ...]
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


def inertial_columns(model: RobotModel, q: Array, v: Array, a: Array) -> Array:
    """Return the inertial columns that affect each row, row by row, shape (sum of c_j, N)."""
    columns = _inertial_support(model)
    plan = plan_rows(model.layout, columns)
    out = np.empty((plan.first[-1], min(BLOCK, len(q))))
    writer, places = _PinocchioWriter(model, plan, out), np.concatenate(plan.places)
    values = np.empty((len(places), len(q)))
    for start in range(0, len(q), BLOCK):
        k = slice(start, min(start + BLOCK, len(q)))
        writer.write_inertial(q[k], v[k], a[k])
        values[:, k] = out[places, : k.stop - k.start]
    return values


def keep_inertial_rows(model: RobotModel, trajectory: Trajectory) -> None:
    """Compute the inertial columns of a trajectory once and store them with it.

    They are not stored if they are too many, or if compiled code computes them faster than they can
    be read from memory.
    """
    columns, samples = _inertial_support(model), len(trajectory.t)
    is_large = 8 * samples * sum(map(len, columns)) > _MOST_BYTES
    is_stored = kept_rows(model, trajectory) is not None
    if is_stored or is_large or choose_engine(model, samples, None) == COMPILED:
        return
    values = inertial_columns(model, trajectory.q, trajectory.v, trajectory.a)
    trajectory.derived["inertial rows"] = InertialRows(model.pin_model, columns, values)


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
    # its inertial columns if they are stored with the trajectory
    inertial: InertialRows | None = None

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
        length = _block_length(int(plan.first[-1]))
        out = np.empty((plan.first[-1], length))
        motion = self.trajectory
        writer = (
            CompiledWriter(self.model, self._tree, plan, out)
            if self.engine == COMPILED
            else _PinocchioWriter(self.model, plan, out, self.inertial)
        )
        for first in range(start, stop, _LOADED * length):
            last = min(first + _LOADED * length, stop)
            part = slice(first, last)
            weights = self.weights[part] if self._is_weighted else None
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

    @cached_property
    def _is_weighted(self) -> bool:
        return bool((self.weights != 1.0).any())


def trajectory_rows(
    model: RobotModel, trajectory: Trajectory, weight: Array | None, compiled: bool | None
) -> TrajectoryRows:
    """Return all rows of a trajectory with all standard parameters: weight (N, n_rows)."""
    if trajectory.joints != model.joints:
        raise DataError(
            f"the trajectory has the joints {listed(trajectory.joints)}, wanted those of the "
            f"model, {listed(model.joints)}; read the log with joints=model.joints"
        )
    shape = (len(trajectory.t), model.n_rows)
    weights = np.broadcast_to(1.0, shape) if weight is None else weight
    if weights.shape != shape:
        raise DataError(f"weight has shape {weights.shape}, wanted {shape}")
    every, engine = np.arange(len(model.layout.names)), choose_engine(model, shape[0], compiled)
    inertial = kept_rows(model, trajectory)
    return TrajectoryRows(model, trajectory, weights, model.support, every, engine, inertial)


class _PinocchioWriter:
    """Writes inertial columns: stored ones, or by Pinocchio's function, sample by sample."""

    def __init__(
        self, model: RobotModel, plan: RowPlan, out: Array, inertial: InertialRows | None = None
    ) -> None:
        G, nv = model.velocity_map, model.pin_model.nv
        self._model, self._plan, self._out = model, plan, out
        self._stored: Array | None = None
        if inertial is not None:
            own = zip(inertial.first, inertial.columns, plan.inertial, strict=False)
            self._stored = inertial.values
            self._from = np.concatenate([i + np.searchsorted(x, wanted) for i, x, wanted in own])
            self._to = _as_slice(np.concatenate(plan.places))
        self._data = model.pin_model.createData()
        size = 10 * (model.pin_model.njoints - 1)
        self._map = None if np.array_equal(G, np.eye(nv)) else G
        # tau = G^T tau_pinocchio: row j is the sum of the Pinocchio rows that its joint moves
        wanted, end = [], 0
        self._sources: list[tuple[Array | slice, float, slice, bool]] = []
        for j, (columns, places) in enumerate(zip(plan.inertial, plan.places, strict=True)):
            for k, r in enumerate(np.flatnonzero(G[:, j])):
                wanted.append(size * r + columns)
                part = slice(end, end := end + len(columns))
                self._sources.append((_as_slice(places), G[r, j], part, k > 0))
        self._wanted = np.concatenate(wanted)
        self._raw = np.empty((out.shape[1], end))

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
            for root, (i, j) in zip(
                np.sqrt(self._weights[part]).T, pairwise(self._plan.first), strict=True
            ):
                out[i:j] *= root

    def write_inertial(self, q: Array, v: Array, a: Array) -> None:
        """Write the inertial columns of some samples at the beginning of the block."""
        regressor, model, data = pin.computeJointTorqueRegressor, self._model.pin_model, self._data
        wanted = self._wanted
        if self._map is not None:
            v, a = v @ self._map.T, a @ self._map.T
        instants = zip(
            self._raw, np.ascontiguousarray(self._model.configurations(q)), v, a, strict=False
        )
        for raw_k, q_k, v_k, a_k in instants:
            # only the wanted entries, while the regressor is in the cache; without bound checks
            regressor(model, data, q_k, v_k, a_k).take(wanted, None, raw_k, "clip")
        out, raw = self._out[:, : len(q)], self._raw[: len(q)].T
        for places, ratio, part, is_added in self._sources:
            values = raw[part] if ratio == 1.0 else ratio * raw[part]
            out[places] = out[places] + values if is_added else values


def _as_slice(places: Array) -> Array | slice:
    """Return consecutive places as a slice, for which writing is faster."""
    if len(places) and (np.diff(places) == 1).all():
        return slice(int(places[0]), int(places[-1]) + 1)
    return places


def _block_length(columns: int) -> int:
    """Return the samples per block, a multiple of 64, such that it fits in the cache."""
    return max(_LANES, min(BLOCK, _BLOCK_SIZE // columns // _LANES * _LANES))
