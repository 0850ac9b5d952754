"""The torque regressor along motions, its gradient, and the poses of bodies, by compiled code."""

from dataclasses import dataclass

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.typing import Array
from robotid.dynamics.compiled import Tree, flatten, own_motion, row_lanes, why_not
from robotid.robot.model import RobotModel


def fixed_tree(model: RobotModel) -> Tree:
    """Return a robot with a fixed base as arrays."""
    model.require_fixed("motion design")
    if (why := why_not(model)) is not None:
        raise SettingsError(f"{model.name}: no motion can be designed: {why}")
    return flatten(model)


class MotionRegressor:
    """Columns of the torque regressor of a robot's bodies along motions, and their gradient.

    columns (b,).
    """

    def __init__(self, model: RobotModel, columns: Array) -> None:
        self._tree = fixed_tree(model)
        self._shape = model.n_rows, len(columns)
        wanted = np.full((model.n_rows, model.layout.n_inertial), -1)
        is_inertial = columns < model.layout.n_inertial
        places = np.arange(model.n_rows * len(columns)).reshape(self._shape)
        wanted[:, columns[is_inertial]] = places[:, is_inertial]
        self._places = self._tree.places(wanted)
        self._work = self._tree.work_space()

    def __call__(self, q: Array, v: Array, a: Array) -> Array:
        """Return the columns at N samples, shape (n, b, N).

        q (N, n) [rad, m], v (N, n) [rad/s, m/s], a (N, n) [rad/s^2, m/s^2].
        """
        N, lanes = len(q), row_lanes()
        block = lanes.LANES
        out = np.zeros((self._shape[0] * self._shape[1], -(-N // block) * block))
        motion = own_motion(q, v, a)
        lanes.inertial_rows(self._tree, self._places, motion, self._work, out, (0, N))
        return out.reshape(*self._shape, -1)[..., :N]

    def pull(self, q: Array, v: Array, a: Array, weights: Array) -> Array:
        """Return the gradient of sum(weights * columns) by q, v and a, shape (3, N, n).

        q (N, n) [rad, m], v (N, n) [rad/s, m/s], a (N, n) [rad/s^2, m/s^2], weights (n, b,
        N).
        """
        by_column = np.array(weights.reshape(-1, len(q)), order="C")
        motion, out = own_motion(q, v, a), np.zeros((3, *q.shape))
        row_lanes().pull_rows(self._tree, self._places, motion, by_column, self._work, out)
        return out


@dataclass(frozen=True, eq=False)
class Placements:
    """Poses of the m bodies of a robot at N samples, in the frame of its root link.

    Attributes:
        R: Their rotations, shape (3, 3, m, N).
        p: The origins of their joints, shape (3, m, N) [m].
    """

    R: Array
    p: Array

    @classmethod
    def along(cls, tree: Tree, q: Array) -> "Placements":
        """Return the poses of the bodies: q (N, n) [rad, m]."""
        R = np.empty((3, 3, len(tree.parents), len(q)))
        p = np.empty(R.shape[1:])
        row_lanes().placements(tree, np.array(q, order="C"), tree.work_space(), R, p)
        return cls(R, p)
