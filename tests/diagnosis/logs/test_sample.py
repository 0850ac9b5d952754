from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers.corruptions import clean_log

from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.hypotheses import (
    Probe,
    compensated,
    coupled_columns,
    own_share,
    smooth_motion,
    take_probe,
)
from robotid.dynamics.torque import joint_torque_regressor
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


@pytest.fixture(scope="module")
def probe():
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"))
    motion = smooth_motion(model, clean_log(model, 0, duration=3.0), SignalSettings())
    return take_probe(model, motion, samples=60)


def test_a_probe_at_other_rows_is_of_the_same_motion(probe):
    other = Probe.of(probe.model, probe.motion, probe.rows[3:40:5])
    for key in ("q", "v", "a", "tau"):
        np.testing.assert_array_equal(getattr(other, key), getattr(probe, key)[3:40:5])
    np.testing.assert_allclose(other.loads(), probe.loads()[3:40:5], atol=1e-12)
    t = probe.motion.t  # the filter settles at both ends
    inner = np.flatnonzero((t > t[0] + 0.149) & (t < t[-1] - 0.149))
    assert [probe.rows[0], probe.rows[-1]] == [inner[0], inner[-1]]


def test_torques_without_gravity_are_judged_by_their_own_size(probe, rng):
    robot = probe.model.pin_model
    data = robot.createData()
    weight = np.array([pin.computeGeneralizedGravity(robot, data, q) for q in probe.q])
    noise = 0.5 * weight.std(axis=0).clip(1e-3) * rng.standard_normal(weight.shape)
    logged = replace(probe, tau=noise - 0.8 * weight)
    whole, left = compensated(logged)
    np.testing.assert_allclose(whole.tau, logged.tau + weight, atol=1e-9)
    size = np.var(whole.tau, axis=0) / np.var(logged.tau, axis=0)
    wanted = np.minimum(own_share(whole) * size, 1.0)
    np.testing.assert_allclose(left, wanted, rtol=1e-6)
    assert np.abs(size - 1.0).max() > 0.3


def test_the_sign_of_a_slow_joint_turns_within_a_twentieth_of_its_own_speed(probe):
    v = probe.v / np.abs(probe.v).max(axis=0) * [2.0, 0.1, 0.3, 0.5, 0.0, 1.0]
    still = [0.02, 0.005, 0.015, 0.02, 0.02, 0.02]
    found = replace(probe, v=v).drives
    np.testing.assert_allclose(found[:, :, 2], np.tanh(v / still), rtol=1e-12)
    np.testing.assert_array_equal(found[:, :, 1], v)
