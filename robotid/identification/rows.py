"""Rows of a trajectory: which of them are used, and what they count."""

import numpy as np

from robotid._typing import Array
from robotid.logs.data import Trajectory
from robotid.logs.signals import SignalSettings
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.problem import Problem
from robotid.regressor.torque import build_problem
from robotid.robot.model import RobotModel

__all__ = ["base_problem", "independent_share", "row_mask"]


def row_mask(model: RobotModel, trajectory: Trajectory, min_velocity: float) -> Array:
    """Return which rows are used: those where the sign of every friction speed is sure.

    Args:
        model: The robot. Without Coulomb friction to identify every row is used.
        trajectory: N samples.
        min_velocity: Bound on the speed of a joint or of a coupled drive [rad/s or m/s].

    Returns:
        Flags, shape (N, n_rows), bool.
    """
    mask = np.ones((len(trajectory.t), model.n_rows), dtype=bool)
    if "coulomb" not in model.layout.terms or min_velocity == 0:
        return mask
    first = model.n_rows - len(model.joints)
    v = trajectory.v[:, first:]
    mask[:, first:] = np.abs(v) >= min_velocity
    for coupling in model.layout.couplings:
        rows = [model.joints.index(joint) for joint, _ in coupling.ratios]
        w = v[:, rows] @ np.array([ratio for _, ratio in coupling.ratios])
        mask[:, [first + row for row in rows]] &= (np.abs(w) >= min_velocity)[:, None]
    return mask


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

    Returns:
        The problem.

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

    Returns:
        The share, at most 1.
    """
    if signals.cutoff is None or signals.rate is None:
        return 1.0
    return min(1.0, 2.0 * signals.cutoff / signals.rate)
