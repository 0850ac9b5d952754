"""The used rows of a trajectory, the base problem, and the choice between two velocities.

Measured and differentiated velocities are compared by their torque prediction errors: the torque of
each joint is fitted separately with either on every other part of the log, and predicted on the
other parts.
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
from robotid.data.signals import process, standing_motion
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.drive_columns import friction_directions, friction_speeds, sure_rows
from robotid.dynamics.problem import Problem
from robotid.dynamics.torque import build_problem, joint_torque_regressor
from robotid.robot.model import RobotModel

_MOVES = 2e-3  # [rad/s] mean speed of a segment of a slow log from which its sign is certain
_NEGLECTED = 0.02  # largest inertial torque that is neglected, over gravity's torque on a link
_ROWS = 1000  # largest number of samples of a log that are used
_PARTS = 8  # of the log, every other one fitted
_BETTER = 0.85  # ratio of the errors below which the difference is significant
_EXACT = 1e-6  # smallest relative error of a torque, for noise-free simulated logs
_FEW = 3.0  # smallest number of rows per column for a joint
_DEPENDENT = 1e-3  # relative singular value below which columns are dependent


def row_mask(model: RobotModel, trajectory: Trajectory, min_velocity: float) -> Array:
    """Return the used rows, (N, n_rows), bool: those where the sign of friction is certain."""
    return sure_rows(model.layout, trajectory.v, min_velocity)


def static_rows(model: RobotModel, log: Log, signals: SignalSettings) -> tuple[Trajectory, Array]:
    """Return the samples of a log for a static model: rest phases and slow segments, one each.

    Where a joint moves, friction has its sign. Where it is at rest, friction is anywhere within its
    limits: rest phases are used without friction, which is part of the residual then, and only for
    joints that move in fewer samples of the log than there are rest phases.
    """
    layout, n = model.layout, len(model.joints)
    unit, least = layout.drive_speeds[:n], min(signals.min_velocity, _MOVES)
    # inertial over gravity torque of a link of length l: a l / g and v^2 l / g
    largest = _NEGLECTED * float(np.linalg.norm(model.pin_model.gravity.linear)) / model.length
    size = np.where(np.isin(model.joints, list(layout.prismatic)), model.length, 1.0)
    motion, at_rest = standing_motion(
        log, signals.max_gap or np.inf, least * unit, np.sqrt(largest) * size, largest * size
    )
    moves = sure_rows(layout, motion.v, least)
    used = moves | (at_rest[:, None] & (moves.sum(axis=0) <= at_rest.sum()))
    signs, still = friction_directions(layout, motion.v, None), np.zeros_like(motion.v)
    return replace(motion, v=still, direction=signs if signs.shape[1] else None), used


def base_problem(
    model: RobotModel,
    mapping: BaseMapping,
    trajectory: Trajectory,
    weight: Array,
    *,
    with_mass: bool = False,
    compiled: bool | None = None,
) -> Problem:
    """Return the problem of a trajectory in base parameters: weight (N, n_rows)."""
    rows = weight.astype(float)
    problem = build_problem(model, trajectory, rows, with_mass=with_mass, compiled=compiled)
    return mapping.reduce(problem)


def independent_share(signals: SignalSettings) -> float:
    """The share of independent rows after the filter: its band over the Nyquist frequency."""
    if signals.cutoff is None or signals.rate is None:
        return 1.0
    return min(1.0, 2.0 * signals.cutoff / signals.rate)


_log = logging.getLogger(__name__)


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
    for j, support in enumerate(model.support):
        W, tau, used = Y[:, j, support], motion.tau[rows, j], mask[rows, j]
        even, odd = used & (part == 0), used & (part == 1)
        if min(even.sum(), odd.sum()) < _FEW * W.shape[1] or not tau.any():
            continue  # too few rows, or no torques
        squares, parts = 0.0, [(W[rows_of], tau[rows_of]) for rows_of in (even, odd)]
        for (A, known), (B, unknown) in (parts, parts[::-1]):
            size = np.linalg.norm(A, axis=0)
            size[size == 0] = 1.0
            theta = np.linalg.lstsq(A / size, known, rcond=_DEPENDENT)[0]
            squares += float(np.sum((unknown - B @ (theta / size)) ** 2))
        error[j] = np.sqrt(squares) + _EXACT * np.linalg.norm(tau)
    return error
