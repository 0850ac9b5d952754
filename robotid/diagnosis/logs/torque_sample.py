"""The motion of a log at a few hundred instants, with the separate parts of the model's torque."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process, resolve, unwrap
from robotid.dynamics.rows import (
    drive_values,
    friction_directions,
    friction_speeds,
    inertial_rows,
)
from robotid.robot.model import RobotModel

_MARGIN = 0.15  # [s] rows closer to the end of a segment are not used: the filter has not settled
_STILL = 0.02  # [rad/s] slower, the sign of a friction torque is unknown
_SLOW = 0.05  # ... for a slow joint: share of its largest speed


@dataclass(frozen=True, eq=False)
class _Loads:
    """The torques of links and the columns of drives at N instants, each computed at first use.

    Whole regressors are too large: 0.3 MB per instant for 60 joints.
    """

    model: RobotModel
    q: Array
    v: Array
    a: Array

    @cached_property
    def moving(self) -> tuple[Array, Array]:
        """Torques of each link by the URDF, (N, n, bodies), and four columns of the last body."""
        columns = inertial_rows(self.model, self.q, self.v, self.a).values.T
        ten = columns.reshape(len(columns), -1, 10)
        rows, bodies = self._places
        is_last = bodies == self.model.layout.n_inertial // 10 - 1
        last = np.zeros((*self.v.shape, 4))
        last[:, rows[is_last]] = ten[:, is_last, :4]
        return self._by_link(ten), last

    @cached_property
    def coupled(self) -> Array:
        """Columns of the coupled drives, shape (N, n, k)."""
        return coupled_columns(self.model, self.q, self.v, self.a)

    @cached_property
    def gravity_loads(self) -> Array:
        """Torques of links at rest, per m/s^2 of gravity in x, y, z, (3, N, n, bodies)."""
        rest = np.zeros_like(self.v)
        models = [self.model.with_gravity(axis) for axis in np.eye(3)]
        columns = (inertial_rows(model, self.q, rest, rest).values.T for model in models)
        return np.array([self._by_link(x.reshape(len(x), -1, 10)) for x in columns])

    @cached_property
    def _places(self) -> tuple[Array, Array]:
        """Rows and bodies of the carried columns, one entry for ten columns."""
        carried = self.model.support()[:, : self.model.layout.n_inertial : 10]
        rows, bodies = np.nonzero(carried)
        return rows, bodies

    def _by_link(self, ten: Array) -> Array:
        pi = self.model.standard_parameters()[: self.model.layout.n_inertial].reshape(-1, 10)
        rows, bodies = self._places
        loads = np.zeros((*self.v.shape, len(pi)))
        loads[:, rows, bodies] = np.einsum("kbi,bi->kb", ten, pi[bodies])
        return loads


@dataclass(frozen=True, eq=False)
class Probe:
    """The parts of the model's torque at some instants, linear in masses and gravity."""

    model: RobotModel  # The robot
    motion: Trajectory  # The smooth motion that contains the instants
    rows: Array  # The N instants, as rows of the motion, shape (N,), int
    q: Array  # Joint positions, shape (N, n) [rad or m]
    v: Array  # Velocities, shape (N, n)
    a: Array  # Accelerations, shape (N, n)
    tau: Array  # Torques, shape (N, n) [N m or N]
    parts: _Loads  # The parts of the model's torque at these instants
    #: Joints whose torque may also depend on their position, as with a counterbalance
    balanced: tuple[int, ...] = ()

    @property
    def gravity(self) -> Array:
        """Gravity of the model, shape (3,) [m/s^2]."""
        return np.array(self.model.pin_model.gravity.linear)

    @property
    def last_body(self) -> Array:
        """Columns of mass and first moments of the last body, shape (N, n, 4)."""
        return self.parts.moving[1]

    def loads(self, gravity: Array | None = None) -> Array:
        """Return the torque of each link on each joint by the URDF, shape (N, n, bodies)."""
        links = self.parts.moving[0]
        if gravity is None:
            return links
        more: Array = np.tensordot(gravity - self.gravity, self.parts.gravity_loads, axes=1)
        return links + more

    @cached_property
    def drives(self) -> Array:
        """Columns of the drives: inertia, frictions, offset of either sign, shape (N, n, 5 + k).

        These are a, v, sign v, 1, -1, the columns of coupled drives, and those of a counterbalance
        if there is one, 0 for other joints.
        """
        v, one = self.v, np.ones_like(self.v)
        least = _STILL * self.model.layout.drive_speeds[: v.shape[1]]
        still = np.minimum(least, _SLOW * np.abs(v).max(axis=0))
        own = [self.a, v, np.tanh(v / np.where(still > 0, still, least)), one, -one]
        swings = np.zeros((*v.shape, 4 if self.balanced else 0))
        for j in self.balanced:
            swings[:, j] = np.hstack([self.swing(j), -self.swing(j)])
        return np.concatenate([np.stack(own, axis=2), self.parts.coupled, swings], axis=2)

    def swing(self, j: int) -> Array:
        """Return the columns of a counterbalance, cos q and sin q, shape (N, 2)."""
        return np.column_stack([np.cos(self.q[:, j]), np.sin(self.q[:, j])])

    def of(self, model: RobotModel) -> "Probe":
        """Return the same motion of another robot."""
        return replace(self, model=model, parts=replace(self.parts, model=model))

    def at(self, rows: Array) -> "Probe":
        """Return the probe at other rows of the same motion: rows (N,)."""
        return replace(_probe_at(self.model, self.motion, rows), balanced=self.balanced)

    def with_motion(self, state: tuple[Array, Array, Array]) -> "Probe":
        """Return the probe with another motion and the same torques: state (N, n)."""
        moved = _probe(self.model, self.motion, self.rows, state)
        return replace(moved, balanced=self.balanced)


def coupled_columns(model: RobotModel, q: Array, v: Array, a: Array) -> Array:
    """Return the regressor's columns of coupled drives, shape (N, n, k)."""
    layout, coupled = model.layout, np.flatnonzero(model.layout.is_coupled)
    if not len(coupled):
        return np.empty((*v.shape, 0))
    values = drive_values(layout, q, v, a, friction_directions(layout, v, None))
    columns: Array = layout.drive_loads[:, coupled] * values[coupled].T[:, None]
    return columns


def smooth_motion(model: RobotModel, log: Log, settings: SignalSettings) -> Trajectory:
    """Return the motion of a log with velocities and accelerations derived from its positions."""
    free = np.array([joint.turns_freely for joint in model.limits])
    log = unwrap(log, free)
    own = replace(settings, velocity="differentiated", acceleration="differentiated")
    return process(log, resolve(log, own), friction_speeds(model.layout))


def take_probe(model: RobotModel, motion: Trajectory, *, samples: int = 500) -> Probe | None:
    """Return a probe of a motion, None if the motion is too small for any check."""
    slow = _STILL * model.layout.drive_speeds[: len(model.joints)]
    rows = np.flatnonzero((np.abs(motion.v) > slow).any(axis=1) & _inner(motion))
    if len(rows) < 50:
        return None
    chosen = np.unique(np.linspace(0, len(rows) - 1, samples).astype(int))
    return _probe_at(model, motion, rows[chosen])


def _inner(motion: Trajectory) -> Array:
    """Return which rows are far from the ends of their segment, shape (N,), bool."""
    inner = np.ones(len(motion.t), dtype=bool)
    for number in np.unique(motion.segment):
        part = motion.segment == number
        t = motion.t[part]
        inner[part] = (t >= t[0] + _MARGIN) & (t <= t[-1] - _MARGIN)
    return inner


def _probe_at(model: RobotModel, motion: Trajectory, rows: Array) -> Probe:
    return _probe(model, motion, rows, (motion.q[rows], motion.v[rows], motion.a[rows]))


def _probe(
    model: RobotModel, motion: Trajectory, rows: Array, state: tuple[Array, Array, Array]
) -> Probe:
    return Probe(model, motion, rows, *state, motion.tau[rows], _Loads(model, *state))
