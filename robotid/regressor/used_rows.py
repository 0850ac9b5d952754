"""Rows of a trajectory: which of them are used, and what they count."""

from dataclasses import replace

import numpy as np

from robotid._typing import Array
from robotid.logs.data import Log, Trajectory
from robotid.logs.settings import SignalSettings
from robotid.logs.standing import standing_motion
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.columns import friction_directions, sure_rows
from robotid.regressor.problem import Problem
from robotid.regressor.torque import build_problem
from robotid.robot.model import RobotModel

__all__ = ["base_problem", "independent_share", "row_mask", "static_rows"]

_MOVES = 2e-3  # [rad/s] the mean over a segment of a slow log tells the sign from this on
_NEGLECTED = 0.02  # share of gravity's torque on a link that its inertia may have


def row_mask(model: RobotModel, trajectory: Trajectory, min_velocity: float) -> Array:
    """Return which rows are used, (N, n_rows): those where every friction speed's sign is sure.

    Args:
        model: The robot. Without Coulomb friction to identify every row is used.
        trajectory: N samples.
        min_velocity: Bound on the speed of a joint or of a coupled drive, as of ``sure_rows``.
    """
    return sure_rows(model.layout, trajectory.v, min_velocity)


def static_rows(model: RobotModel, log: Log, signals: SignalSettings) -> tuple[Trajectory, Array]:
    """Return what a static model uses of a log: stands and slow segments, one sample each.

    Where a joint moves, friction has its sign. Where it stands, friction holds anything between
    its two bounds: stands are used without friction, which leaves that in the residual, and only
    of joints that move in fewer samples of the log than there are stands.

    Args:
        model: The robot, static.
        log: The log, without full turns.
        signals: The settings, resolved; of them, gaps and the least speed are used.

    Returns:
        The samples, without velocities and accelerations, with directions of friction; and which
        rows are used, shape (N, n_rows), bool.
    """
    layout, n = model.layout, len(model.joints)
    unit, least = layout.drive_speeds[:n], min(signals.min_velocity, _MOVES)
    # a length's inertia against its gravity: a l / g and v^2 l / g
    hardest = _NEGLECTED * float(np.linalg.norm(model.pin_model.gravity.linear)) / model.length
    reach = np.where(np.isin(model.joints, list(layout.prismatic)), model.length, 1.0)
    motion, stands = standing_motion(
        log, signals.max_gap or np.inf, least * unit, np.sqrt(hardest) * reach, hardest * reach
    )
    moves = sure_rows(layout, motion.v, least)
    used = moves | (stands[:, None] & (moves.sum(axis=0) <= stands.sum()))
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
    """Return the problem of a trajectory in base parameters.

    Args:
        model: The robot.
        mapping: Standard to base parameters.
        trajectory: N samples.
        weight: Weight of each row, shape (N, n_rows); or which rows are used, bool.
        with_mass: As of ``build_problem``.
        compiled: As of ``build_problem``.

    Raises:
        DataError: If the trajectory's joints are not the model's.
    """
    rows = weight.astype(float)
    problem = build_problem(model, trajectory, rows, with_mass=with_mass, compiled=compiled)
    return mapping.reduce(problem)


def independent_share(signals: SignalSettings) -> float:
    """Return the share of rows that are independent behind the filter: its band over Nyquist's.

    Args:
        signals: The settings, resolved.
    """
    if signals.cutoff is None or signals.rate is None:
        return 1.0
    return min(1.0, 2.0 * signals.cutoff / signals.rate)
