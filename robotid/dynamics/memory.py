"""Columns of drive terms with internal state, joint load torque or torque rate on a trajectory."""

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.drive_columns import (
    drive_motion,
    friction_directions,
    remembered,
    trajectory_values,
)
from robotid.dynamics.prediction import predict
from robotid.robot.drives import DriveMotion, Lag
from robotid.robot.model import RobotModel


def is_loaded(model: RobotModel) -> bool:
    """Return whether these columns depend on the torque of a robot's reference.

    Those of bristles do not: they depend on the displacement only.
    """
    return any(term.needs_load for _, term in model.layout.drive_parameters)


def remember(model: RobotModel, trajectory: Trajectory) -> Trajectory:
    """Return a trajectory with the columns of drive terms with internal state or load."""
    if not model.layout.remembering:
        return trajectory
    is_lagging = any(isinstance(term, Lag) for _, term in model.layout.drive_parameters)
    motion = drive_motion_along(model, trajectory, has_rate=is_lagging)
    return trajectory.with_states(remembered(model.layout, motion))


def drive_motion_along(
    model: RobotModel, trajectory: Trajectory, *, has_rate: bool = True
) -> DriveMotion:
    """Return the motion and load of the drives of a robot along a trajectory.

    The load is the torque of the bodies, and the rate that of the whole torque, by the model's
    reference; a delayed torque itself is not included.

    -> (d, N).
    """
    key, known = (model.pin_model, model.layout, has_rate), trajectory.derived.get("drive motion")
    if known is None or known[0] != key or not np.array_equal(known[1], model.carried_by):
        found = _drive_motion(model, trajectory, has_rate)
        trajectory.derived["drive motion"] = known = key, model.carried_by, found
    motion: DriveMotion = known[2]
    return motion


def _load_torque(model: RobotModel, trajectory: Trajectory) -> Array:
    """Return the torque of the bodies by the model's reference, shape (N, n_rows) [N m, N].

    The last one is stored with the trajectory: it is that of any terms of the drives.
    """
    pi = model.carried_by[: model.layout.n_inertial]
    known = trajectory.derived.get("load torque")
    if known is None or known[0] is not model.pin_model or not np.array_equal(known[1], pi):
        plain = model.with_terms({})
        bodies = np.zeros(len(plain.layout.names))
        bodies[: len(pi)] = pi
        (load,) = predict(plain, [bodies], trajectory)
        trajectory.derived["load torque"] = known = model.pin_model, pi, load
    torque: Array = known[2]
    return torque


def _drive_motion(model: RobotModel, trajectory: Trajectory, has_rate: bool) -> DriveMotion:
    """Return the motion and load of drives as of ``drive_motion_along``."""
    layout, pi = model.layout, model.carried_by
    m = trajectory.with_states(None)  # that of another reference, if it has one
    first = model.n_rows - len(model.joints)
    signs = friction_directions(layout, m.v, m.direction)
    begins = np.diff(m.segment, prepend=m.segment[:1] - 1) != 0
    load = _load_torque(model, m)[:, first:]
    motion = drive_motion(layout, m.q, m.v, m.a, signs, load, None, begins)
    if not has_rate:
        return motion
    if layout.remembering:
        m = m.with_states(remembered(layout, motion))
    drives = trajectory_values(layout, m).T @ (layout.drive_loads * pi[layout.n_inertial :]).T
    rate = _rate(load + drives, m)
    return drive_motion(layout, m.q, m.v, m.a, signs, load, rate, begins)


def _rate(torque: Array, motion: Trajectory) -> Array:
    """Return the change of torques within each segment, shape (N, n) [N m/s, N/s]."""
    rate = np.zeros_like(torque)
    edges = np.flatnonzero(np.diff(motion.segment)) + 1
    for part in np.split(np.arange(len(motion.t)), edges):
        if len(part) > 1:
            rate[part] = np.gradient(torque[part], motion.t[part], axis=0)
    return rate
