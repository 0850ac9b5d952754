"""A few hundred instants of a log, with separate parts of the model's torque."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process, resolve, unwrap
from robotid.data.units import AT_REST
from robotid.diagnosis.decisions import AGREES, NOTHING, ZERO
from robotid.dynamics.constraint_rows import touching
from robotid.dynamics.rows import (
    InertialRows,
    drive_values,
    friction_directions,
    friction_speeds,
    inertial_rows,
)
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

_MARGIN = 0.15  # [s] rows closer to the end of a segment are not used: the filter has not settled


@dataclass(frozen=True, eq=False)
class Probe:
    """The parts of the model's torque at N instants, linear in masses and gravity."""

    # Parts are computed at first use: whole regressors have 0.3 MB per instant for 60 joints.

    model: RobotModel
    motion: Trajectory  # The smooth motion that contains the instants
    rows: Array  # (N,), the instants as rows of the motion
    q: Array  # (N, n), joint positions [rad or m]
    v: Array  # (N, n), velocities
    a: Array  # (N, n), accelerations
    tau: Array  # (N, n), torques [N m or N]
    contacts: Array  # (N, k), those that may touch the ground

    @classmethod
    def of(cls, model: RobotModel, motion: Trajectory, rows: Array) -> "Probe":
        """Return the probe at rows of a motion."""
        q, v, a, tau = (x[rows] for x in (motion.q, motion.v, motion.a, motion.tau))
        return cls(model, motion, rows, q, v, a, tau, touching(model, motion)[rows])

    @cached_property
    def last_body(self) -> Array:
        """Columns of mass and first moments of the last body, shape (N, n, 4)."""
        return self._torques(np.eye(self.model.layout.n_inertial)[:, -10:-6])

    @cached_property
    def loads(self) -> Array:
        """Torque of each link by the URDF, shape (N, n, bodies)."""
        pi = self.model.standard_parameters()[: self.model.layout.n_inertial]
        return self._torques(pi[:, None] * np.repeat(np.eye(len(pi) // 10), 10, axis=0))

    @cached_property
    def uncertain(self) -> Array:
        """Share of each torque that errors of the URDF's centres of mass explain, shape (n,)."""
        p = self.model.layout.n_inertial
        spread = AGREES * prior_spread(self.model, np.ones((3, self.model.n_rows)), 1)[:p]
        moments = np.diag(spread)[:, np.isin(np.arange(p) % 10, (1, 2, 3))]
        squares = np.mean(np.sum(self._torques(moments) ** 2, axis=2), axis=0)
        return np.asarray(squares / np.maximum(self.tau.var(axis=0), NOTHING))

    def _torques(self, stacked: Array) -> Array:
        """Return the torques of bodies, shape (N, n, k): stacked (p, k)."""
        return np.moveaxis(self._bodies.torque(stacked), 0, 2)

    @cached_property
    def _bodies(self) -> InertialRows:
        return inertial_rows(self.model, self.q, self.v, self.a)


def drive_columns(model: RobotModel, q: Array, v: Array, a: Array) -> Array:
    """Return the columns 1, a, v and sign v of the drives, and of coupled drives, (N, n, 4 + k)."""
    least = AT_REST * model.layout.drive_speeds[: v.shape[1]]
    still = np.minimum(least, ZERO * np.abs(v).max(axis=0))
    own = [np.ones_like(v), a, v, np.tanh(v / np.where(still > 0, still, least))]
    return np.concatenate([np.stack(own, axis=2), coupled_columns(model, q, v, a)], axis=2)


def coupled_columns(model: RobotModel, q: Array, v: Array, a: Array) -> Array:
    """Return the regressor's columns of coupled drives, shape (N, n, k)."""
    layout, coupled = model.layout, np.flatnonzero(model.layout.is_coupled)
    if not len(coupled):
        return np.empty((*v.shape, 0))
    values = drive_values(layout, q, v, a, friction_directions(layout, v, None))
    return np.asarray(layout.drive_loads[:, coupled] * values[coupled].T[:, None])


def smooth_motion(model: RobotModel, log: Log, settings: SignalSettings) -> Trajectory:
    """Return the motion of a log with velocities and accelerations derived from its positions."""
    log = unwrap(log, np.array([joint.turns_freely for joint in model.limits]))
    settings = replace(settings, velocity="differentiated", acceleration="differentiated")
    return process(log, resolve(log, settings), friction_speeds(model.layout))


def take_probe(model: RobotModel, motion: Trajectory, *, samples: int = 500) -> Probe | None:
    """Return a probe of a motion, None if the motion is too small for any check."""
    parts = np.split(motion.t, np.flatnonzero(np.diff(motion.segment)) + 1)
    inner = np.concatenate([(t >= t[0] + _MARGIN) & (t <= t[-1] - _MARGIN) for t in parts])
    slow = AT_REST * model.layout.drive_speeds[: len(model.joints)]
    moves = (np.abs(motion.v[:, -len(slow) :]) > slow).any(axis=1)
    is_smooth = inner if motion.switching is None else inner & ~motion.switching
    rows = np.flatnonzero(moves & is_smooth)
    if len(rows) < 50:
        return None
    chosen = np.unique(np.linspace(0, len(rows) - 1, samples).astype(int))
    return Probe.of(model, motion, rows[chosen])
