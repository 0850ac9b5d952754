import re

import numpy as np
import pytest
from helpers.synthetic import truth

from robotid.exceptions import DataError
from robotid.regressor.torque import joint_torque_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia
from robotid.simulation.closed_loop import Noise, simulate
from robotid.simulation.motions import FourierTrajectory, random_fourier


def test_a_fourier_motion_keeps_its_derivatives(rng):
    motion = FourierTrajectory(
        np.ones(2), rng.standard_normal((3, 2)), rng.standard_normal((3, 2)), period=4.0
    )
    t, h = np.linspace(0, 4, 50), 1e-5
    q, v, a = motion.evaluate(t)
    before, after = motion.evaluate(t - h), motion.evaluate(t + h)
    np.testing.assert_allclose(v, (after[0] - before[0]) / (2 * h), atol=1e-6)
    np.testing.assert_allclose(a, (after[1] - before[1]) / (2 * h), atol=1e-6)
    np.testing.assert_allclose(motion.evaluate(t + 4.0)[0], q, atol=1e-12)


def test_a_random_motion_stays_within_limits(panda, rng):
    q, v, _ = random_fourier(panda, rng).evaluate(np.linspace(0, 10, 5000))
    for j, joint in enumerate(panda.limits):
        assert joint.lower < q[:, j].min()
        assert q[:, j].max() < joint.upper
        assert np.abs(v[:, j]).max() < joint.velocity


def test_a_centre_outside_the_limits_is_refused(panda, rng):
    centre = np.zeros(7)
    centre[3] = 0.5
    with pytest.raises(DataError, match=r"the centre 0.5 of joint 'panda_joint4' is not inside"):
        random_fourier(panda, rng, centre=centre)


def test_coefficients_of_other_shapes_are_refused():
    with pytest.raises(DataError, match=r"must have one shape \(h, 2\)"):
        FourierTrajectory(np.zeros(2), np.zeros((3, 2)), np.zeros((4, 2)), 1.0)


def test_another_robot_is_possible(ur5):
    pi = truth(ur5)
    assert np.linalg.eigvalsh(pseudo_inertia(pi[:60])).min() > 0
    assert (pi[ur5.layout.is_nonnegative()] > 0).all()
    assert pi[50] > ur5.standard_parameters()[50] * 1.3 + 0.5  # the tool on the last link


def test_the_log_of_the_plant_obeys_its_own_equation(ur5, rng):
    pi = truth(ur5)
    log = simulate(ur5, pi, random_fourier(ur5, rng), rate=1000.0, duration=2.0, rng=rng)
    a = np.gradient(log.v, log.t, axis=0)
    tau = (joint_torque_regressor(ur5, log.q, log.v, a) @ pi).reshape(log.tau.shape)
    smooth = (np.abs(log.v) > 0.02).all(axis=1)  # the plant's friction is tanh(v / 2 mm/s)
    smooth[[0, 1, -2, -1]] = False  # one-sided differences
    error = np.abs(tau - log.tau)[smooth].max()
    assert error < 2e-3 * np.abs(log.tau).max()
    np.testing.assert_allclose(np.gradient(log.q, log.t, axis=0)[5:-5], log.v[5:-5], atol=1e-3)


def test_the_controller_tracks_although_it_does_not_know_the_drives(ur5, rng):
    motion = random_fourier(ur5, rng)
    log = simulate(ur5, truth(ur5), motion, rate=200.0, duration=3.0, rng=rng)
    assert np.abs(log.q - motion.evaluate(log.t)[0]).max() < 0.3


def test_noise_is_of_the_size_asked_for(ur5, rng):
    motion = random_fourier(ur5, rng)
    clean, noisy = (
        simulate(ur5, truth(ur5), motion, rate=200.0, duration=3.0, noise=noise,
                 rng=np.random.default_rng(0))
        for noise in (None, Noise(q=1e-4, v=1e-3, tau=0.05))
    )  # fmt: skip
    assert np.std(noisy.q - clean.q) == pytest.approx(1e-4, rel=0.1)
    assert np.std(noisy.v - clean.v) == pytest.approx(1e-3, rel=0.1)
    share = np.std(noisy.tau - clean.tau, axis=0) / np.sqrt(np.mean(clean.tau**2, axis=0))
    np.testing.assert_allclose(share, 0.05, rtol=0.15)


def test_a_slow_joint_keeps_its_speed_limit(tmp_path, rng):
    text = example_urdf("ur5_robot.urdf").read_text()
    slow = tmp_path / "slow.urdf"
    slow.write_text(re.sub(r'velocity="[\d.]+"', 'velocity="0.5"', text))
    model = RobotModel.from_urdf(slow)
    assert {joint.velocity for joint in model.limits} == {0.5}
    _, v, _ = random_fourier(model, rng).evaluate(np.linspace(0, 10, 5000))
    assert 0.4 < np.abs(v).max() < 0.46  # nine tenths of it


def test_the_plant_is_integrated_in_short_steps_whatever_the_rate_of_the_log(ur5):
    motion = random_fourier(ur5, np.random.default_rng(0))
    rare, often = (
        simulate(ur5, truth(ur5), motion, rate=rate, duration=1.0, rng=np.random.default_rng(0))
        for rate in (25.0, 200.0)
    )
    np.testing.assert_allclose(rare.q, often.q[::8], atol=1e-3)
