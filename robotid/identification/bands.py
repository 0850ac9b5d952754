"""How far predicted torques can be trusted: their bands from the covariance of the parameters."""

from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.logs.data import Trajectory
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.torque import trajectory_regressor
from robotid.robot.model import RobotModel

__all__ = ["REACH", "TorqueBand", "torque_band"]

#: Standard deviations that a 95 % band reaches.
REACH = 1.96
_MOST = 500  # samples that a band is computed at, spread over the trajectory


@dataclass(frozen=True, eq=False)
class TorqueBand:
    """Standard deviations of predicted torques at some samples of a trajectory.

    Attributes:
        samples: Numbers of these samples, shape (k,), int.
        parameters: From the uncertainty of the parameters, shape (k, n_rows) [N m, N].
        noise: From what the model leaves of the torque, shape (n_rows,) [N m, N].
    """

    samples: Array
    parameters: Array
    noise: Array

    @property
    def total(self) -> Array:
        """Standard deviation of a measured torque about its prediction, shape (k, n_rows)."""
        return np.asarray(np.hypot(self.parameters, self.noise))

    def held(self, tau: Array, prediction: Array, mask: Array) -> Array:
        """Return which share of each joint's torques lies in the 95 % band; NaN without a row.

        Args:
            tau: Measured torques of the whole trajectory, shape (N, n_rows) [N m, N].
            prediction: Predicted ones, shape (N, n_rows) [N m, N].
            mask: Rows used, shape (N, n_rows), bool.
        """
        used = mask[self.samples]
        miss = np.abs(tau[self.samples] - prediction[self.samples])
        is_held, count = (miss <= REACH * self.total) & used, used.sum(axis=0)
        return np.where(count > 0, is_held.sum(axis=0) / np.maximum(count, 1), np.nan)


def torque_band(
    model: RobotModel, mapping: BaseMapping, trajectory: Trajectory, covariance: Array, noise: Array
) -> TorqueBand:
    """Return the band of predicted torques, at up to 500 samples: the root of diag(W C W^T).

    Args:
        model: The robot.
        mapping: Standard to base parameters.
        trajectory: N samples.
        covariance: Of the base parameters, shape (b, b), finite.
        noise: Standard deviation of the torque's residual, shape (n_rows,) [N m, N].
    """
    count = len(trajectory.t)
    samples = np.unique(np.linspace(0, count - 1, min(count, _MOST)).round().astype(int))
    W = trajectory_regressor(model, trajectory.at(samples))[:, mapping.independent]
    variance = np.einsum("ij,ij->i", W @ covariance, W)
    std = np.sqrt(np.maximum(variance, 0.0)).reshape(len(samples), -1)
    return TorqueBand(samples, std, np.asarray(noise))
