"""Rows of a trajectory: which of them are used, and what they count."""

from robotid._typing import Array
from robotid.logs.data import Trajectory
from robotid.logs.settings import SignalSettings
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.columns import sure_rows
from robotid.regressor.problem import Problem
from robotid.regressor.torque import build_problem
from robotid.robot.model import RobotModel

__all__ = ["base_problem", "independent_share", "row_mask"]


def row_mask(model: RobotModel, trajectory: Trajectory, min_velocity: float) -> Array:
    """Return which rows are used, (N, n_rows): those where every friction speed's sign is sure.

    Args:
        model: The robot. Without Coulomb friction to identify every row is used.
        trajectory: N samples.
        min_velocity: Bound on the speed of a joint or of a coupled drive [rad/s or m/s].
    """
    return sure_rows(model.layout, trajectory.v, min_velocity)


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
