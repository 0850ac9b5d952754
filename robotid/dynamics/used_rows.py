"""The used rows of a trajectory, and the base problem."""

from dataclasses import replace

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import standing_motion
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.drive_columns import friction_directions, sure_rows
from robotid.dynamics.problem import Problem
from robotid.dynamics.torque import build_problem
from robotid.robot.model import RobotModel

_MOVES = 2e-3  # [rad/s] mean speed of a segment of a slow log from which its sign is certain
_NEGLECTED = 0.02  # largest inertial torque that is neglected, over gravity's torque on a link


def row_mask(model: RobotModel, trajectory: Trajectory, min_velocity: float) -> Array:
    """Return the used rows, (N, n_rows), bool: those where the sign of friction is certain."""
    return sure_rows(model.layout, trajectory.v, min_velocity)


def static_rows(model: RobotModel, log: Log, signals: SignalSettings) -> tuple[Trajectory, Array]:
    """Return the samples of a log for a static model: rest phases and slow segments, one each.

    Where a joint moves, friction has its sign. Where it is at rest, friction is anywhere within its
    limits: rest phases are used without friction, which is part of the residual then, and only for
    joints that move in fewer samples of the log than there are rest phases.

    -> (N, n_rows).
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
