"""Any robot as the paper's procedure takes it: dynamics that are linear in base parameters."""

from dataclasses import dataclass

from robotid.base.typing import Array
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.torque import joint_torque_regressor
from robotid.paper.equations import LinearDynamics
from robotid.robot.model import RobotModel


@dataclass(frozen=True, eq=False)
class BaseDynamics(LinearDynamics):
    model: RobotModel
    mapping: BaseMapping

    @property
    def names(self) -> tuple[str, ...]:
        return self.mapping.base_names

    @property
    def n_joints(self) -> int:
        return self.model.n_rows

    def regressor(self, q: Array, v: Array, a: Array) -> Array:
        W = joint_torque_regressor(self.model, q, v, a)  # (R n, p)
        return W[:, self.mapping.independent].reshape(*q.shape, -1)
