"""What measured velocities are worth: how late, how coarse, whether of their positions."""

from dataclasses import replace

import numpy as np
import pytest

from robotid.data.log import Log
from robotid.data.units import (
    coarse_velocities,
    is_timely,
    is_trustworthy,
    quantum,
    unlike_velocities,
    velocity_lags,
)

T = np.arange(0, 10, 0.01)


def log_of_two(t=T):
    q = np.column_stack([np.sin(2 * t), np.cos(3 * t)])
    v = np.column_stack([2 * np.cos(2 * t), -3 * np.sin(3 * t)])
    return Log(t, q, np.ones_like(q), ("a", "b"), v=v)


def test_a_gap_or_a_clock_that_was_set_costs_neither_memory_nor_the_lag():
    log = log_of_two()
    late = replace(log, v=np.column_stack([np.interp(log.t - 0.03, log.t, x) for x in log.v.T]))
    jumped = replace(late, t=late.t + np.where(late.t > 5, 1e9, 0.0))
    assert velocity_lags(jumped)[0] == pytest.approx(0.03, abs=2e-3)


def test_full_turns_are_no_motion():
    log = log_of_two()
    far = np.column_stack([3 * T, np.cos(3 * T)])
    turned = replace(log, q=(far + np.pi) % (2 * np.pi) - np.pi, v=np.gradient(far, T, axis=0))
    assert abs(velocity_lags(turned)[0]) < 1e-3
    assert unlike_velocities(turned) == {}


@pytest.mark.parametrize("step", [0.01, 0.013])
def test_lags_of_joints_minimise_the_mean_distance_to_the_delayed_derivative(step):
    log, lags = log_of_two(np.arange(0.0, 4.0, step)), [0.105, -0.048]
    late = np.column_stack(
        [np.interp(log.t - lag, log.t, x) for lag, x in zip(lags, log.v.T, strict=True)]
    )
    log = replace(log, v=late)
    common, single = velocity_lags(log)
    assert single == pytest.approx([velocity_lags(log.select([joint]))[0] for joint in "ab"])
    step = float(np.median(np.diff(log.t)))
    grid = np.arange(log.t[0], log.t[-1], step)
    slopes = [np.gradient(np.interp(grid, log.t, x), step) for x in log.q.T]
    late = [np.interp(grid, log.t, x) for x in late.T]
    pairs = list(zip(slopes, late, strict=True))
    distances = np.array([[distance(*pair, k) for k in range(-20, 21)] for pair in pairs])
    for found, own in zip([common, *single], [distances.sum(axis=0), *distances], strict=True):
        k = int(np.argmin(own))
        square, slope, _ = np.polyfit([-1, 0, 1], own[k - 1 : k + 2], 2)
        assert found == pytest.approx((k - 20 - slope / (2 * square)) * step, abs=1e-9)


def test_stretches_between_gaps_count_by_their_rows_and_the_shortest_not():
    step, rows, lags = 0.01, (160, 520, 100), (0.104, 0.027, 0.2)
    parts = [7.0 * k + step * np.arange(n) for k, n in enumerate(rows)]
    log = log_of_two(np.concatenate(parts))
    v = [
        np.column_stack([2 * np.cos(2 * (t - lag)), -3 * np.sin(3 * (t - lag))])
        for t, lag in zip(parts, lags, strict=True)
    ]
    common, single = velocity_lags(replace(log, v=np.concatenate(v)))
    summed = np.zeros((2, 63))
    for t, x in zip(parts[:2], v[:2], strict=True):
        slopes = np.gradient(np.column_stack([np.sin(2 * t), np.cos(3 * t)]), step, axis=0)
        for own, pair in zip(summed, zip(slopes.T, x.T, strict=True), strict=True):
            own += [len(t) * distance(*pair, k) for k in range(-31, 32)]
    for found, own in zip([common, *single], [summed.sum(axis=0), *summed], strict=True):
        k = int(np.argmin(own))
        square, slope, _ = np.polyfit([-1, 0, 1], own[k - 1 : k + 2], 2)
        # the grid of a segment may lack its last row
        assert found == pytest.approx((k - 31 - slope / (2 * square)) * step, abs=2e-4)
    assert 0.027 < common < 0.06


def distance(slope, v, shift):
    """Return the mean square of v - slope delayed by a number of rows."""
    pairs = [(v[i], slope[i - shift]) for i in range(len(v)) if 0 <= i - shift < len(v)]
    return np.mean([(x - y) ** 2 for x, y in pairs])


@pytest.mark.parametrize("lag", [0.0, 0.1, 0.2])
def test_a_late_velocity_is_its_positions_and_noise_is_not(lag):
    log = log_of_two()
    late = np.column_stack([np.interp(log.t - lag, log.t, x) for x in log.v.T])
    assert unlike_velocities(replace(log, v=late)) == {}
    late[:, 1] = np.random.default_rng(0).standard_normal(len(T))
    (joint, alike), *others = unlike_velocities(replace(log, v=late)).items()
    assert (joint, others) == ("b", [])
    assert alike < 0.5
    assert not is_trustworthy(replace(log, v=late))


@pytest.mark.parametrize(
    ("lag", "stated", "is_used"),
    [(0.03, 0.0, False), (0.03, 0.005, False), (0.03, 0.02, True), (0.015, 0.0, True),
     (0.0, -0.05, False)],
)  # fmt: skip
def test_what_a_velocity_is_stated_to_be_late_does_not_count(lag, stated, is_used):
    log = log_of_two()
    truth = np.column_stack([2 * np.cos(2 * (T - lag)), -3 * np.sin(3 * (T - lag))])
    late = replace(log, v=truth)
    assert is_timely(late, stated) is is_used
    assert is_trustworthy(late, stated) is is_used


def test_a_velocity_of_few_steps_is_coarse():
    log = log_of_two()
    assert coarse_velocities(log) == ()
    v = log.v.copy()
    v[:, 0] = np.round(v[:, 0] / 0.05) * 0.05  # 80 of them
    assert coarse_velocities(replace(log, v=v)) == ("a",)
    assert not is_trustworthy(replace(log, v=v))
    assert is_trustworthy(log)


def test_a_step_is_found_of_values_that_hardly_repeat_if_they_need_not():
    x = np.round(np.sin(T) / 2e-3) * 2e-3 + 0.1
    assert quantum(x) == 0.0  # most values are there once
    assert quantum(x, repeats=False) == pytest.approx(2e-3)
    assert quantum(np.sin(T), repeats=False) == 0.0
    coarse = np.round(np.sin(T) / 0.05) * 0.05
    assert quantum(coarse) == quantum(coarse, repeats=False) == pytest.approx(0.05)
