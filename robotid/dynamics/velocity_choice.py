"""Choice between measured and differentiated velocities, by their torque prediction errors.

The torque of each joint is fitted separately with either velocity on every other part of the log,
and predicted on the other parts.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.data.measured_velocity import coarse_velocities, is_timely, unlike_velocities
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.dynamics.drive_columns import friction_speeds
from robotid.dynamics.torque import joint_torque_regressor
from robotid.dynamics.used_rows import row_mask
from robotid.robot.model import RobotModel

_log = logging.getLogger(__name__)
_ROWS = 1000  # largest number of samples of a log that are used
_PARTS = 8  # of the log, every other one fitted
_BETTER = 0.85  # ratio of the errors below which the difference is significant
_EXACT = 1e-6  # smallest relative error of a torque, for noise-free simulated logs
_FEW = 3.0  # smallest number of rows per column for a joint
_DEPENDENT = 1e-3  # relative singular value below which columns are dependent


def prefers_measured(model: RobotModel, logs: Sequence[Log], settings: SignalSettings) -> bool:
    """Return whether velocity = "auto" uses the measured velocities of a log.

    Measured velocities that are coarsely quantised or inconsistent with the positions are not used.
    Others are used if they predict the torque about as well as differentiated velocities. If the
    log has too little motion for this comparison, they are used if they are not delayed.
    """
    if any(coarse_velocities(log) or unlike_velocities(log) for log in logs):
        return False
    errors = np.concatenate([_errors(model, log, settings) for log in logs])
    is_known = np.isfinite(errors).all(axis=1)
    if not is_known.any():
        return all(is_timely(log, settings.velocity_delay) for log in logs)
    ratio = float(np.median(errors[is_known, 1] / errors[is_known, 0]))
    chosen = "measured" if ratio > _BETTER else "differentiated"
    _log.info(
        "%s: velocity = 'auto' uses %s velocities: the torque prediction error on held-out "
        "segments with differentiated velocities is %.2f times that with measured velocities",
        logs[0].name, chosen, ratio,
    )  # fmt: skip
    return ratio > _BETTER


def _errors(model: RobotModel, log: Log, settings: SignalSettings) -> Array:
    """Return the torque prediction errors with measured and differentiated velocities, (n, 2).

    NaN for a joint with too little motion or without torque.
    """
    found = np.full((2, len(model.joints)), np.nan)
    if not log.has_torque or model.free_flyer or model.constraints:
        return found.T
    motions = []
    for velocity in ("measured", "differentiated"):
        chosen = replace(settings, velocity=velocity)
        try:
            motions.append(process(log, chosen, friction_speeds(model.layout)))
        except DataError:  # too short: the error is raised again when the log is read
            return found.T
    masks = [row_mask(model, motion, settings.min_velocity) for motion in motions]
    mask = masks[0] & masks[1]
    every = -(-len(mask) // _ROWS)
    for errors, motion in zip(found, motions, strict=True):
        errors[:] = _held_out_error(model, motion, mask, every)
    return found.T


def _held_out_error(model: RobotModel, motion: Trajectory, mask: Array, every: int) -> Array:
    """Return the norm of each torque's prediction error in the parts not fitted, shape (n,)."""
    rows = slice(None, None, every)
    state = motion.q[rows], motion.v[rows], motion.a[rows]
    direction = None if motion.direction is None else motion.direction[rows]
    Y = joint_torque_regressor(model, *state, direction)
    Y = Y.reshape(len(state[0]), len(model.joints), -1)
    part = np.arange(len(Y)) * _PARTS // len(Y) % 2
    error = np.full(len(model.joints), np.nan)
    for j, support in enumerate(model.support()):
        W, tau, used = Y[:, j, support], motion.tau[rows, j], mask[rows, j]
        even, odd = used & (part == 0), used & (part == 1)
        if min(even.sum(), odd.sum()) < _FEW * W.shape[1] or not tau.any():
            continue  # too few rows, or no torques
        squares, parts = 0.0, [(W[rows_of], tau[rows_of]) for rows_of in (even, odd)]
        for (A, known), (B, unknown) in (parts, parts[::-1]):
            size = np.linalg.norm(A, axis=0)
            size[size == 0] = 1.0
            X = A / size
            squared, V = np.linalg.eigh(X.T @ X)  # of singular values
            kept = squared > _DEPENDENT**2 * squared[-1]
            theta = V[:, kept] @ (V[:, kept].T @ (X.T @ known) / squared[kept])
            squares += float(np.sum((unknown - B @ (theta / size)) ** 2))
        error[j] = np.sqrt(squares) + _EXACT * np.linalg.norm(tau)
    return error
