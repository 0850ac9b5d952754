import numpy as np
import pytest
from helpers.paths import URDF

from robotid.dynamics.simulation.simulator import RobotPlant
from robotid.robot.drives import LoadFriction, LuGre, Presliding
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling


@pytest.fixture(scope="module")
def sticky():
    """A planar arm with a motor of both joints; friction of its own in two drives."""
    own = {
        "joint_2": (LuGre(displacement=0.05, speed=0.3, excess=0.6), LoadFriction()),
        "motor": (Presliding(displacement=0.02),),
    }
    coupling = Coupling("motor", (("joint_1", 1.0), ("joint_2", -0.5)))
    model = RobotModel.from_urdf(URDF / "planar_2r.urdf", couplings=(coupling,), own_terms=own)
    pi = model.standard_parameters()
    values = {
        "joint_1.viscous": 0.7, "joint_1.coulomb": 1.2, "joint_2.offset": 0.4, "joint_2.lugre": 2.0,
        "joint_2.load": 0.1, "motor.coulomb": 0.3, "motor.presliding": 0.8, "motor.armature": 0.2,
        "joint_1.armature": 0.1, "joint_2.armature": 0.05,
    }  # fmt: skip
    for name, value in values.items():
        pi[model.layout.names.index(name)] = value
    return RobotPlant(model, pi)


def test_presliding_is_taken_up_over_its_way_and_level(sticky):
    for v in ([0.4, -0.1], [-0.2, 0.5]):
        w = np.array([v[1], v[0] - 0.5 * v[1]])  # of joint 2 and of the motor
        level = np.array([1 + 0.6 * np.exp(-((w[0] / 0.3) ** 2)), 1.0])
        rate, end = sticky.bristle_rate(np.array(v))
        np.testing.assert_allclose(rate, np.abs(w) / ([0.05, 0.02] * level))
        np.testing.assert_allclose(end, np.sign(w) * level)


def test_friction_and_its_chord_are_those_of_the_terms(sticky, rng):
    R = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -0.5]])
    q, v, load, z = rng.uniform(0.3, 1.0, (4, 2))
    w = R @ v
    g = 1 + 0.6 * np.exp(-((w[1] / 0.3) ** 2))
    share = abs(load[1])  # joint 2 bears its own load alone
    for state, lugre, presliding in ((None, 2.0 * g * np.sign(w[1]), 0.8 * np.sign(w[2])),
                                     (z, 2.0 * z[0], 0.8 * z[1])):  # fmt: skip
        F = sticky.friction(q, v, state)
        drives = [0.7 * w[0] + 1.2 * np.sign(w[0]), 0.4 + lugre + 0.1 * share * np.sign(w[1]),
                  0.3 * np.sign(w[2]) + presliding]  # fmt: skip
        np.testing.assert_allclose(sticky.friction_torque(F, v, load), R.T @ drives, atol=1e-9)
    along = np.array([1.2, 0.1 * share, 0.3])  # by bristles in no direction
    over = (R.T * (along / np.abs(w))) @ R
    np.testing.assert_allclose(sticky.chord(F, v, load), over, rtol=1e-6)
    np.testing.assert_allclose(sticky.armature, R.T @ np.diag([0.1, 0.05, 0.2]) @ R)


def test_a_motor_of_two_joints_bears_the_load_that_its_gear_leaves_it(rng):
    coupling = Coupling("motor", (("joint_1", 2.0), ("joint_2", -0.5)))
    own = {"motor": (LoadFriction(),)}
    model = RobotModel.from_urdf(URDF / "planar_2r.urdf", couplings=(coupling,), own_terms=own)
    pi = model.standard_parameters()
    for name, value in {"motor.load": 0.15, "motor.coulomb": 0.4, "motor.armature": 0.03}.items():
        pi[model.layout.names.index(name)] = value
    plant, R = RobotPlant(model, pi), np.array([2.0, -0.5])
    q, v, u = rng.uniform(0.3, 1.0, (3, 2))
    v[1] = -v[1]
    a = plant.acceleration(q, v, u)
    load = plant.bodies_torque(q, v, a)
    borne = abs(R @ load) / 4.25  # the least torque w with R w nearest to the load
    friction = R * (0.4 + 0.15 * borne) * np.sign(R @ v)
    np.testing.assert_allclose(plant.friction_torque(plant.friction(q, v), v, load), friction)
    np.testing.assert_allclose(load + 0.03 * R * (R @ a) + friction, u, rtol=1e-9)
