import numpy as np

from robotid.doctor.sample import coupled_columns
from robotid.regressor.torque import joint_torque_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling


def test_columns_of_coupled_drives_are_those_of_the_regressor(ur5, rng):
    coupling = Coupling("motor", (("wrist_2_joint", 1.0), ("wrist_3_joint", -2.0)))
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), couplings=(coupling,))
    q, v, a = rng.uniform(-2, 2, (3, 20, 6))
    chosen = model.layout.n_inertial + np.flatnonzero(model.layout.is_coupled)
    Y = joint_torque_regressor(model, q, v, a).reshape(20, 6, -1)
    found = coupled_columns(model, q, v, a)
    np.testing.assert_array_equal(found, Y[:, :, chosen])
    assert found.any(axis=0)[[4, 5]].all()  # a load of both joints
    assert coupled_columns(ur5, q, v, a).shape == (20, 6, 0)
