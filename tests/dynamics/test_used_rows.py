"""Which rows of a log are used, and with which of two velocities."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.corruptions import clean_log, robot

from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import resolve
from robotid.dynamics.prepared_logs import independent_share, static_rows
from robotid.estimation.fitting.recorded import hold_log
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


@pytest.mark.parametrize(
    ("cutoff", "rate", "share"),
    [(8.0, 200.0, 0.08), (3.0, 10.0, 0.6), (49.0, 98.5, 2 * 49 / 98.5), (None, 200.0, 1.0),
     (8.0, None, 1.0), (8.0, 12.0, 1.0)],
)  # fmt: skip
def test_rows_behind_a_filter_are_independent_by_its_band_over_nyquists(cutoff, rate, share):
    settings = SignalSettings(cutoff=cutoff, rate=rate)
    assert independent_share(settings) == pytest.approx(share)


def test_stands_are_rows_of_joints_that_move_in_no_more_samples_than_there_are_stands():
    """One joint moves slowly in the second and third part of a log, another in the third alone."""
    joints = ["elbow_joint", "wrist_1_joint", "wrist_2_joint"]
    model = RobotModel.from_urdf(
        example_urdf("ur5_robot.urdf"), joints=joints, terms=("coulomb", "offset")
    )
    pose = []
    for k in range(4):  # four stands, apart by more than a gap
        pose.append(np.tile([0.1 * k, -0.2 * k, 0.3], (25, 1)))
    way = 0.02 * np.arange(700)[:, None] / 100
    late = 0.02 * np.maximum(np.arange(700)[:, None] - 625, 0) / 100
    moving = np.array([0.5, 0.4, 0.3]) + np.hstack([way, late, 0 * way])
    q = np.concatenate([*pose, moving])
    stands = np.arange(100) / 100 + np.repeat(np.arange(4), 25)
    t = 5.0 + np.concatenate([stands, 9 + np.arange(700) / 100])
    log = Log(t, q, 10.0 * q, tuple(joints), v=np.zeros_like(q))
    settings = resolve(log, SignalSettings(cutoff=None, max_gap=0.5))
    motion, used = static_rows(model, log, settings)
    assert len(motion.t) == 4 + 28
    assert not motion.v.any()
    assert not motion.a.any()
    row = np.arange(32)
    moves = np.column_stack([row >= 4, row >= 30, row < 0])
    # the first moves in more samples than there are stands, which say nothing of its friction
    wanted = np.column_stack([moves[:, 0], moves[:, 1] | (row < 4), row < 4])
    np.testing.assert_array_equal(used, wanted)
    np.testing.assert_array_equal(motion.direction[moves], 1.0)
    np.testing.assert_allclose(motion.tau, 10.0 * motion.q, atol=1e-9)


@pytest.mark.parametrize("gravity", [9.81, 3.7])
def test_a_stretch_is_slow_whose_inertia_is_two_hundredths_of_gravity(gravity):
    model = RobotModel.from_urdf(
        example_urdf("ur5_robot.urdf"), joints=["elbow_joint", "wrist_1_joint"],
        terms=("coulomb", "offset"), gravity=(0.0, 0.0, -gravity),
    )  # fmt: skip
    fastest = np.sqrt(0.02 * gravity / model.length)  # v^2 l / g
    t = 5.0 + np.arange(300) / 100
    for share, count in ((0.98, 12), (1.02, 0)):
        q = np.outer(t, [share * fastest, 0.1])
        log = Log(t, q, q, tuple(model.joints), v=np.zeros_like(q))
        motion, used = static_rows(model, log, resolve(log, SignalSettings(cutoff=None)))
        assert len(motion.t) == count
        assert used.all()


LSB = 2 * np.pi / 4096  # [rad] of a 12-bit encoder


@pytest.fixture(scope="module")
def log():
    return clean_log(robot("ur5"), 0)


def chosen(log, **settings):
    return hold_log(robot("ur5"), log, SignalSettings(**settings)).signals.velocity


def late(log, delay):
    v = np.column_stack([np.interp(log.t - delay, log.t, x) for x in log.v.T])
    return replace(log, v=v)


def noisy(log, sigma, column):
    noise = sigma * np.random.default_rng(0).standard_normal(log.q.shape)
    return replace(log, **{column: getattr(log, column) + noise})


def test_a_good_measured_velocity_is_taken_also_where_the_position_is_worse(log):
    coarse = replace(log, q=np.round(log.q / LSB) * LSB)
    assert chosen(log) == chosen(coarse) == chosen(noisy(log, 1e-3, "q")) == "measured"


def test_a_velocity_of_few_steps_or_of_noise_is_not_taken(log):
    v = np.gradient(np.round(log.q / LSB) * LSB, log.t, axis=0)
    assert chosen(replace(log, v=v)) == "differentiated"
    v = log.v.copy()
    v[:, 2] = v[:, 2].std() * np.random.default_rng(0).standard_normal(len(v))
    assert chosen(replace(log, v=v)) == "differentiated"
    assert chosen(replace(log, v=v), velocity="measured") == "measured"  # as asked


def test_a_velocity_that_predicts_worse_is_not_taken(log):
    # fine, of its position and timely by every rule, but not as good
    assert chosen(noisy(log, 0.05, "v")) == "differentiated"
    assert chosen(late(log, 0.012)) == "differentiated"
    assert chosen(late(log, 0.012), velocity_delay=0.012) == "measured"


def test_a_log_too_short_to_predict_is_judged_by_its_lag(log):
    short = log.window(2.0, 2.7)
    assert chosen(short) == "measured"
    assert chosen(late(short, 0.05)) == "differentiated"
