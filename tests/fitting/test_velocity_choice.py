"""velocity = "auto" takes the velocities that predict torque better where none was fitted."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.corruptions import clean_log, robot

from robotid.fitting.survey import hold_log
from robotid.logs.settings import SignalSettings

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
