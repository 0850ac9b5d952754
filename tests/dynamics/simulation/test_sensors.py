"""Each fault of the sensors is of the size that was stated."""

import re

import numpy as np
import pytest

from robotid.base.exceptions import DataError, SettingsError
from robotid.dynamics.simulation.simulation_settings import Noise, Sensors, Steps
from robotid.dynamics.simulation.simulator import Run, measure

JOINTS = ("a", "b")
N = 4000


@pytest.fixture
def run():
    t = 3.0 + np.arange(N) / 500.0
    w = np.array([2.0, 3.0])
    q, v = np.sin(np.outer(t, w)), w * np.cos(np.outer(t, w))
    return Run(t, q, v, -(w**2) * q, np.array([10.0, 1.0]) * v, q, np.zeros(2))


def of(run, **stated):
    return measure(run, Sensors(**stated), JOINTS, np.random.default_rng(0))


def test_without_faults_the_log_is_the_motion(run):
    log = of(run, acceleration=True)
    for name in ("t", "q", "v", "a", "tau"):
        np.testing.assert_array_equal(getattr(log, name), getattr(run, name))
    assert of(run, velocity=False).v is None
    assert of(run).a is None


def test_noise_has_its_standard_deviation_by_joint(run):
    log = of(run, noise=Noise(q=1e-3, v={"b": 0.1}, tau=0.05, torque={"a": 0.3}))
    np.testing.assert_allclose((log.q - run.q).std(axis=0), 1e-3, rtol=0.05)
    np.testing.assert_allclose((log.v - run.v).std(axis=0), [0.0, 0.1], rtol=0.05)
    share = 0.05 * np.sqrt(np.mean(run.tau**2, axis=0))
    np.testing.assert_allclose(
        (log.tau - run.tau).std(axis=0), np.hypot(share, [0.3, 0.0]), rtol=0.05
    )


def test_readings_are_rounded_to_steps_noise_included(run):
    log = of(run, step=Steps(q=0.01, v={"a": 0.1}, tau=0.5), noise=Noise(q=0.02))
    np.testing.assert_allclose(log.q / 0.01, np.round(log.q / 0.01), atol=1e-9)
    np.testing.assert_array_equal(log.v[:, 1], run.v[:, 1])
    assert np.abs(log.v[:, 0] - run.v[:, 0]).max() == pytest.approx(0.05, rel=0.05)
    np.testing.assert_allclose(log.tau, np.round(run.tau / 0.5) * 0.5)


def test_what_is_late_shows_what_was(run):
    log = of(run, torque_delay=0.01, velocity_delay=0.004)
    np.testing.assert_allclose(log.tau[5:], run.tau[:-5], atol=1e-9)
    np.testing.assert_allclose(log.v[2:], run.v[:-2], atol=1e-9)
    np.testing.assert_array_equal(log.q, run.q)
    drive = measure(run, Sensors(), JOINTS, np.random.default_rng(0), delay=np.array([0.0, 0.02]))
    np.testing.assert_allclose(drive.tau[10:, 1], run.tau[:-10, 1], atol=1e-9)
    np.testing.assert_array_equal(drive.tau[:, 0], run.tau[:, 0])


def test_time_stamps_err_and_still_increase(run):
    log = of(run, jitter=2e-4)
    assert (log.t - run.t).std() == pytest.approx(2e-4, rel=0.05)
    np.testing.assert_array_equal(log.q, run.q)  # what they err about
    rough = of(run, jitter=0.01)  # five sample times
    assert np.diff(rough.t).min() > 0.0


def test_samples_are_lost_at_random(run):
    log = of(run, dropped=0.2)
    assert len(log.t) == pytest.approx(0.8 * N, abs=4 * np.sqrt(0.16 * N))
    kept = np.searchsorted(run.t, log.t)
    np.testing.assert_array_equal(log.tau, run.tau[kept])
    two = Run(*(x[:3] for x in (run.t, run.q, run.v, run.a, run.tau, run.q)), np.zeros(2))
    with pytest.raises(DataError, match=r"of 3 samples remain, wanted at least 2. Set a smaller"):
        of(two, dropped=0.999)


def test_settings_that_cannot_be_are_named(run):
    with pytest.raises(SettingsError, match=re.escape(
        "sensors: noise.q is stated for 'c', which is not a moving joint: a, b"
    )):  # fmt: skip
        of(run, noise=Noise(q={"c": 1.0}))
    with pytest.raises(SettingsError, match=r"sensors.noise: q is -1.0, wanted 0 to 1e12"):
        Noise(q=-1.0)
    with pytest.raises(SettingsError, match=r"sensors: dropped is 1.0, wanted 0 to less than 1"):
        Sensors(dropped=1.0)
