"""Measured or differentiated velocities: which of them predict torque better where none was fitted.

Each joint's torque is fitted by itself, on every other part of the log, with either; the parts in
between are predicted.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.logs.data import Log, Trajectory
from robotid.logs.measured_velocity import coarse_velocities, is_timely, unlike_velocities
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import process
from robotid.regressor.columns import friction_speeds
from robotid.regressor.torque import joint_torque_regressor
from robotid.regressor.used_rows import row_mask
from robotid.robot.model import RobotModel

__all__ = ["prefers_measured"]

_log = logging.getLogger(__name__)
_ROWS = 1000  # instants of a log that are compared, at most
_PARTS = 8  # of the log, every other one fitted
_BETTER = 0.85  # a ratio of the errors below this is no chance
_EXACT = 1e-6  # share of a torque that is missed at least: of a simulated log nothing is
_FEW = 3.0  # rows per column from which a joint says something


def prefers_measured(model: RobotModel, logs: Sequence[Log], settings: SignalSettings) -> bool:
    """Return whether velocity = "auto" takes the measured velocities of a log.

    It never takes those that are coarse or not of their positions. Of others it takes those that
    predict torque about as well as differentiated ones, or, where too little moves to tell, those
    that are timely.

    Args:
        model: The robot.
        logs: Parts of the log, full turns taken out.
        settings: How it becomes a trajectory.
    """
    if any(coarse_velocities(log) or unlike_velocities(log) for log in logs):
        return False
    errors = np.concatenate([_errors(model, log, settings) for log in logs])
    told = np.isfinite(errors).all(axis=1)
    if not told.any():
        return all(is_timely(log, settings.velocity_delay) for log in logs)
    ratio = float(np.median(errors[told, 1] / errors[told, 0]))
    chosen = "measured" if ratio > _BETTER else "differentiated"
    _log.info(
        "%s: velocity = 'auto' is %s: in segments that were not fitted, differentiated ones miss "
        "%.2f times as much of the torque as measured ones",
        logs[0].name, chosen, ratio,
    )  # fmt: skip
    return ratio > _BETTER


def _errors(model: RobotModel, log: Log, settings: SignalSettings) -> Array:
    """Return what measured and differentiated velocities miss of each torque, shape (n, 2).

    NaN where a joint moves too little to tell, or there is no torque.
    """
    found = np.full((2, len(model.joints)), np.nan)
    if not log.has_torque:
        return found.T
    motions = []
    for velocity in ("measured", "differentiated"):
        chosen = replace(settings, velocity=velocity)
        try:
            motions.append(process(log, chosen, friction_speeds(model.layout)))
        except DataError:  # too short, which is told where the log is read
            return found.T
    masks = [row_mask(model, motion, settings.min_velocity) for motion in motions]
    sure = masks[0] & masks[1]
    every = -(-len(sure) // _ROWS)
    for errors, motion in zip(found, motions, strict=True):
        errors[:] = _missed(model, motion, sure, every)
    return found.T


def _missed(model: RobotModel, motion: Trajectory, sure: Array, every: int) -> Array:
    """Return the root mean square that is missed of each torque in the parts not fitted, (n,)."""
    rows = slice(None, None, every)
    state = motion.q[rows], motion.v[rows], motion.a[rows]
    direction = None if motion.direction is None else motion.direction[rows]
    Y = joint_torque_regressor(model, *state, direction)
    Y = Y.reshape(len(state[0]), len(model.joints), -1)
    part = np.arange(len(Y)) * _PARTS // len(Y) % 2
    missed = np.full(len(model.joints), np.nan)
    for j, support in enumerate(model.support()):
        W, tau, used = Y[:, j, support], motion.tau[rows, j], sure[rows, j]
        fitted, kept = used & (part == 0), used & (part == 1)
        if min(fitted.sum(), kept.sum()) < _FEW * W.shape[1] or not tau.any():
            continue  # a motion without torques tells nothing
        squares = 0.0
        for first, second in ((fitted, kept), (kept, fitted)):
            size = np.linalg.norm(W[first], axis=0)
            X = W / np.where(size > 0, size, 1.0)
            theta = np.linalg.lstsq(X[first], tau[first], rcond=1e-3)[0]
            squares += float(np.sum((tau[second] - X[second] @ theta) ** 2))
        missed[j] = np.sqrt(squares) + _EXACT * np.linalg.norm(tau)
    return missed
