"""Smooth motion from logs: filters, gaps, parts of segments, rest, direction of friction."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth
from scipy.signal import butter, savgol_filter, sosfiltfilt

from robotid.base.exceptions import DataError, SettingsError
from robotid.data.base_motion import BaseMotion
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import (
    SPLINE,
    Segment,
    _acting,
    acting_directions,
    filter_reach,
    local_polynomial,
    process,
    process_segments,
    resolve,
    standing_motion,
    unwrap,
    zero_phase,
)
from robotid.dynamics.rows import friction_speeds
from robotid.dynamics.torque import build_problem, joint_torque_regressor
from robotid.estimation.fitting.recorded import hold_log
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling


def sine_log(t, frequency=0.5, lag=0.0, **options):
    w = 2 * np.pi * frequency
    q = np.column_stack([np.sin(w * t), 0.5 * np.cos(2 * w * t)])
    late = t - lag
    v = np.column_stack([w * np.cos(w * late), -w * np.sin(2 * w * late)])
    tau = np.column_stack([np.cos(w * t), np.sin(w * t)])
    return Log(t=t, q=q, tau=tau, joints=("a", "b"), v=v, **options)


def test_derivatives_of_a_jittered_sine_are_right():
    rng = np.random.default_rng(0)
    t = np.arange(0, 10, 0.005)
    t = t + rng.uniform(-0.002, 0.002, len(t))
    log = sine_log(t)
    out = process(log, SignalSettings(cutoff=20.0, velocity="differentiated", rate=200.0))
    w = np.pi
    np.testing.assert_allclose(np.diff(out.t), 0.005, rtol=1e-9)
    np.testing.assert_allclose(out.v[:, 0], w * np.cos(w * out.t), atol=2e-3)
    np.testing.assert_allclose(out.a[:, 0], -(w**2) * np.sin(w * out.t), atol=2e-2)


def test_a_lower_rate_is_reached_after_the_filter():
    log = sine_log(np.arange(0, 10, 0.001))
    out = process(log, SignalSettings(cutoff=8.0, rate=100.0))
    np.testing.assert_allclose(np.diff(out.t), 0.01, rtol=1e-9)
    np.testing.assert_allclose(out.v[:, 0], np.pi * np.cos(np.pi * out.t), atol=1e-3)
    late = sine_log(3.0 + np.arange(0, 10, 0.001))
    out = process(late, SignalSettings(cutoff=8.0, rate=100.0, trim=0.2034))
    assert out.t[0] == pytest.approx(3.204, abs=1e-9)  # the first point after the trim
    np.testing.assert_allclose(np.diff(out.t), 0.01, rtol=1e-9)


def test_nothing_crosses_a_gap():
    t = np.concatenate([np.arange(0, 4, 0.01), np.arange(7, 11, 0.01)])
    log = sine_log(t)
    # a step in the torque across the gap would ring if it were filtered through
    tau = log.tau + np.where(t < 5, 0.0, 100.0)[:, None]
    stepped = Log(t=t, q=log.q, tau=tau, joints=log.joints, v=log.v)
    out = process(stepped, SignalSettings(velocity="differentiated"))
    assert set(out.segment) == {0, 1}
    assert not np.any((out.t > 3.99) & (out.t < 7.0))
    first = out.segment == 0
    np.testing.assert_allclose(out.tau[first, 0], np.cos(np.pi * out.t[first]), atol=2e-3)
    np.testing.assert_allclose(out.v[:, 0], np.pi * np.cos(np.pi * out.t), atol=1e-2)


@pytest.mark.parametrize(("velocity", "lag"), [("differentiated", 0.0), ("auto", 0.05)])
def test_auto_takes_no_acceleration_without_the_measured_velocity(velocity, lag):
    t = np.arange(0, 10, 0.01)
    log = sine_log(t, lag=lag, a=np.ones((1000, 2)))
    assert resolve(log, SignalSettings(velocity=velocity)).acceleration == "differentiated"
    stated = SignalSettings(velocity=velocity, acceleration="measured")
    assert resolve(log, stated).acceleration == "measured"


@pytest.mark.parametrize("rate", [None, 200.0])
def test_what_is_stated_to_be_late_is_moved_back(rate):
    t = np.arange(0, 5, 0.01)
    w = np.pi
    late = sine_log(t, lag=0.03)  # of the velocity
    tau = np.column_stack([np.cos(w * (t - 0.05)), np.sin(w * (t - 0.05))])
    settings = SignalSettings(
        cutoff=None, rate=rate, velocity="measured", torque_delay=0.05, velocity_delay=0.03
    )
    forces = {"fz a": np.cos(w * t), "fx a": np.sin(w * t)}
    log = Log(t=t, q=late.q, v=late.v, tau=tau, joints=late.joints, wrenches=forces)
    out = process(log, settings)
    np.testing.assert_allclose(out.wrenches[:, 0], np.cos(w * out.t), atol=1e-6)
    np.testing.assert_allclose(out.wrenches[:, 1], np.sin(w * out.t), atol=1e-6)
    np.testing.assert_allclose(out.tau[:, 0], np.cos(w * out.t), atol=1e-6)
    np.testing.assert_allclose(out.v[:, 0], w * np.cos(w * out.t), atol=1e-6)
    np.testing.assert_allclose(out.q[:, 0], np.sin(w * out.t), atol=1e-6)


@pytest.mark.parametrize(("pause", "segments"), [(0.024, 1), (0.026, 2), (1.0, 2)])
def test_a_step_longer_than_two_and_a_half_others_is_a_gap(pause, segments):
    t = np.arange(400) * 0.01
    t[200:] += pause - 0.01
    out = process(sine_log(t), SignalSettings(cutoff=None, rate=100.0))
    assert len(np.unique(out.segment)) == segments
    # 0.2 s are cut off at each end of each segment
    assert out.t[0] == pytest.approx(0.2)
    assert out.t[-1] == pytest.approx(t[-1] - 0.2, abs=0.02)
    inside = (out.t > t[199] - 0.195) & (out.t < t[200] + 0.195)
    assert inside.any() == (segments == 1)


def test_full_turns_are_taken_out_of_free_joints_only():
    t = np.arange(0, 5, 0.01)
    angle = np.column_stack([2 * t, 0.1 * t])
    wrapped = np.angle(np.exp(1j * angle))
    log = Log(t=t, q=wrapped, tau=angle, joints=("a", "b"))
    out = unwrap(log, np.array([True, False]))
    np.testing.assert_allclose(out.q, angle, atol=1e-12)
    assert out.notes == ("full turns removed from the angle of a",)
    assert unwrap(log, np.array([True, True])) is out, "so that its motions are kept"
    other = replace(log, q=wrapped + np.array([0.0, 1.0]))
    wanted = angle + np.array([0.0, 1.0])
    np.testing.assert_allclose(unwrap(other, np.array([True, False])).q, wanted)
    steady = replace(log, q=0.1 * angle)
    assert unwrap(steady, np.array([True, True])) is steady
    with pytest.raises(DataError, match=r"q_a jumps by a full turn at t = 1.58 s"):
        unwrap(log, np.array([False, False]))


BAD = {
    "velocity": (dict(velocity="filtered"), "velocity is 'filtered', expected one of auto"),
    "cutoff": (dict(cutoff=-1.0), "cutoff is -1.0, expected 0.001 to 1e6"),
    "rate": (dict(rate=0.0), "rate is 0.0, expected 0.001 to 1e6"),
    "trim": (dict(trim=-0.1), "trim is -0.1, expected 0 or a positive number"),
    "order": (dict(order=0), "order is 0, expected 1 to 10"),
    "NaN": (dict(cutoff=float("nan")), "cutoff is nan"),
}


@pytest.mark.parametrize(("options", "message"), BAD.values(), ids=BAD)
def test_settings_out_of_range_are_refused(options, message):
    with pytest.raises(SettingsError, match=message):
        SignalSettings(**options)


@pytest.mark.parametrize(
    ("t", "changes", "message"),
    [
        (np.arange(200) / 1e9, {}, r"cutoff 8 Hz is less than 1e-06 of the rate 1e\+09"),
        (np.arange(0, 5, 0.01), {"cutoff": 60.0}, "60 Hz is not below half the rate 100 Hz"),
        (np.arange(0, 0.3, 0.01), {}, "none of its 1 segments without gaps is long enough"),
    ],
)
def test_a_log_that_its_filter_does_not_fit_is_refused(t, changes, message):
    with pytest.raises((DataError, SettingsError), match=message):
        process(sine_log(t), SignalSettings(**changes))


def test_a_log_without_velocity_cannot_use_it():
    log = sine_log(np.arange(0, 5, 0.01))
    bare = Log(t=log.t, q=log.q, tau=log.tau, joints=log.joints)
    with pytest.raises(DataError, match="no measured velocity for every joint"):
        process(bare, SignalSettings(velocity="measured"))
    assert resolve(bare, SignalSettings()).velocity == "differentiated"


@pytest.mark.parametrize(
    ("step", "cutoff", "gap"),
    [
        (0.01, 5.0, 0.05),  # a quarter of the filter's period
        (0.01, 20.0, 0.025),  # two and a half steps
        (0.04, 5.0, 0.1),
        (0.04, None, 0.1),
    ],
)
def test_a_gap_is_longer_than_steps_and_than_a_share_of_the_filters_period(step, cutoff, gap):
    log = sine_log(np.arange(0.0, 20.0, step) + 3.0)
    found = resolve(log, SignalSettings(cutoff=cutoff))
    assert found.max_gap == pytest.approx(gap)
    assert found.rate == (None if cutoff is None else pytest.approx(1.0 / step))
    assert resolve(log, SignalSettings(cutoff=cutoff, max_gap=0.7)).max_gap == 0.7


LEAST, FASTEST, HARDEST = np.full(2, 2e-3), np.full(2, 0.4), np.full(2, 0.3)


def log_of(t, q, tau=None):
    q = np.asarray(q, dtype=float)
    return Log(t=t, q=q, tau=10 * q if tau is None else tau, joints=("a", "b"))


def means(log, max_gap=0.1):
    return standing_motion(log, max_gap, LEAST, FASTEST, HARDEST)


def test_a_stand_is_the_mean_of_its_rows_however_long(rng):
    t = np.concatenate([np.arange(n) / 100 + start for n, start in ((40, 0), (300, 9), (1, 20))])
    poses = np.repeat([[0.1, 1.0], [0.5, -1.0], [0.5, 0.0]], [40, 300, 1], axis=0)
    tau = rng.standard_normal((341, 2))
    motion, stands = means(log_of(t, poses + 1e-5 * rng.standard_normal((341, 2)), tau))
    assert stands.tolist() == [True] * 3
    np.testing.assert_allclose(motion.q, poses[[0, 40, 340]], atol=1e-4)
    parts = np.split(np.arange(341), [40, 340])
    np.testing.assert_allclose(motion.tau, [tau[part].mean(axis=0) for part in parts])
    np.testing.assert_allclose(motion.t, [t[part].mean() for part in parts])
    assert motion.segment.tolist() == [0, 1, 2]
    assert not motion.v.any()


def test_fast_moves_between_poses_are_left_out_with_what_is_beside_them():
    s = np.linspace(0, 1, 150)[:, None]
    move = (10 * s**3 - 15 * s**4 + 6 * s**5) * [1.0, -0.8]
    hold = np.ones((150, 2))
    q = np.concatenate([0 * hold, move, hold * [1, -0.8], move[::-1], 0 * hold])
    motion, stands = means(log_of(np.arange(len(q)) / 100, q))
    assert stands.all()
    np.testing.assert_allclose(motion.q, [[0, 0], [1, -0.8], [0, 0]], atol=1e-12)
    fast, _ = means(log_of(np.arange(400) / 100, np.linspace(0, 4, 400)[:, None] * [1, 1]))
    assert fast.t.size == 0


def test_speeds_are_0_on_both_sides_of_where_a_joint_turns_round_or_sets_out():
    row = np.arange(200)  # eight segments of 25 rows
    turning = 0.03 * 0.01 * np.minimum(row, 199 - row)  # between the fourth and the fifth
    leaving = 0.04 * 0.01 * np.maximum(row - 49, 0)  # between the second and the third
    for sign in (1.0, -1.0):
        q = sign * np.column_stack([turning, leaving])
        motion, stands = means(log_of(3.7 + row / 100, q))
        assert not stands.any()
        v = [[0.03] * 3 + [0, 0] + [-0.03] * 3, [0, 0, 0] + [0.04] * 5]
        np.testing.assert_allclose(sign * motion.v, np.transpose(v), atol=1e-12)
        np.testing.assert_allclose(motion.t, 3.7 + 0.12 + 0.25 * np.arange(8))
        np.testing.assert_allclose(motion.q, q.reshape(8, 25, 2).mean(axis=1))
        assert not motion.a.any()
        assert motion.rate is None


def test_stretches_on_both_sides_of_a_jump_of_the_speed_are_left_out():
    """One joint jumps by 0.15 rad/s in a quarter of a second, which is 0.6 rad/s^2, above 0.3."""
    row = np.arange(200)  # eight segments of 25 rows
    for jump, kept in ((0.15, [0, 1, 2, 5, 6, 7]), (0.05, list(range(8)))):
        for sign in (1.0, -1.0):
            speed = np.where(row < 100, 0.1, 0.1 + jump)
            q = np.column_stack([0.05 * row, np.cumsum(speed)]) * sign / 100
            motion, stands = means(log_of(2.5 + row / 100, q))
            assert not stands.any()
            np.testing.assert_allclose(motion.t, 2.5 + 0.12 + 0.25 * np.array(kept))
            v = np.column_stack([np.full(8, 0.05), np.repeat([0.1, 0.1 + jump], 4)])
            np.testing.assert_allclose(motion.v, sign * v[kept], atol=1e-12)
            np.testing.assert_allclose(motion.q, q.reshape(8, 25, 2).mean(axis=1)[kept])


def test_two_stands_are_one_unless_a_gap_lies_between_them():
    t = np.concatenate([np.arange(30), np.arange(18) + 35, np.arange(20) + 300]) / 100
    q = np.tile([0.3, -0.2], (68, 1))
    tau = np.arange(136.0).reshape(68, 2)
    motion, stands = means(log_of(t, q, tau), max_gap=1.0)
    assert stands.tolist() == [True, True]
    assert motion.segment.tolist() == [0, 1]
    np.testing.assert_allclose(motion.tau, [tau[:48].mean(axis=0), tau[48:].mean(axis=0)])
    np.testing.assert_allclose(motion.t, [t[:48].mean(), t[48:].mean()])


def test_a_jump_of_the_speed_across_a_gap_is_no_acceleration():
    row = np.arange(200)  # four segments of 25 rows on either side of 0.2 s
    t = 2.5 + (row + 20 * (row >= 100)) / 100
    q = np.column_stack([0.05 * row, np.cumsum(np.where(row < 100, 0.1, 0.25))]) / 100
    motion, _ = means(log_of(t, q))
    assert motion.segment.tolist() == [0] * 4 + [1] * 4
    np.testing.assert_allclose(motion.v[:, 1], np.repeat([0.1, 0.25], 4))


@pytest.mark.parametrize(("step", "samples"), [(0.02, 1), (0.03, 2)])
def test_poses_are_joined_if_the_way_between_them_is_that_of_rest(step, samples):
    """At 0.1 rad/s a joint moves 0.025 rad from one block of 0.25 s to the next."""
    t = 40.0 + 0.05 * np.arange(20)
    q = np.column_stack([np.zeros(20), np.where(np.arange(20) < 10, 1.0, 1.0 + step)])
    one = np.ones(2)
    motion, resting = standing_motion(Log(t, q, q, ("a", "b")), 1.0, 0.1 * one, one, one)
    assert resting.tolist() == [True] * samples
    wanted = [[0.0, 1.0 + step / 2]] if samples == 1 else [[0.0, 1.0], [0.0, 1.0 + step]]
    np.testing.assert_allclose(motion.q, wanted)
    np.testing.assert_allclose(motion.t, np.mean(np.split(t, samples), axis=1))


def test_the_slope_of_a_short_block_is_reduced_by_its_own_duration():
    t = np.concatenate([0.05 * np.arange(20), [5.0, 5.05]])
    q = np.column_stack([0.1 * t, np.zeros(22)])
    motion, resting = means(log_of(t, q))
    assert not resting.any()
    np.testing.assert_allclose(motion.v[:-1, 0], 0.1)
    np.testing.assert_allclose(motion.v[-1, 0], 0.1 * 2 * 0.05 / 0.25)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5, 8])
@pytest.mark.parametrize(("rows", "pad"), [(400, 60), (40, 39), (12, 0)])
def test_a_low_pass_filter_run_both_ways_is_that_of_scipy(order, rows, pad, rng):
    x = rng.standard_normal((rows, 3)).cumsum(axis=0) + 5.0
    sos = butter(order, 7.0, fs=100.0, output="sos")
    wanted = sosfiltfilt(sos, x, axis=0, padlen=pad)
    np.testing.assert_allclose(zero_phase(x, order, 7.0, 100.0, pad), wanted, rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        zero_phase(x[:, 1], order, 7.0, 100.0, pad), wanted[:, 1], rtol=0, atol=1e-10
    )


@pytest.mark.parametrize(
    ("width", "degree", "derivative"),
    [(11, 3, 0), (11, 3, 1), (5, 2, 1), (5, 2, 2), (1, 0, 0), (25, 4, 2)],
)
def test_local_polynomials_are_those_of_scipy(width, degree, derivative, rng):
    x = rng.standard_normal((40, 2)).cumsum(axis=0)
    wanted = savgol_filter(x, width, degree, deriv=derivative, delta=0.02, axis=0)
    found = local_polynomial(x, width, degree, derivative=derivative, step=0.02)
    np.testing.assert_allclose(found, wanted, atol=1e-9 * np.abs(wanted).max())


RATE = 200.0  # [Hz]
PART = 700  # rows
SPEEDS = np.array([[1.0, 0.0], [0.0, 1.0], [0.5, -1.0]])  # two joints, and a drive of both


def recording(rng, *, jitter=0.2, gaps=(), start=0.0, samples=5000, pause=0.0):
    """Return a noisy log of two joints, with gaps of half a second behind some rows."""
    # Every two seconds the joints rest for a while.
    step = np.full(samples - 1, 1 / RATE) * (1 + jitter * rng.uniform(-1, 1, samples - 1))
    step[list(gaps)] = 0.5
    t = start + np.concatenate([[0.0], np.cumsum(step)])
    w = 2 * np.pi * np.array([0.4, 0.7])
    moved = (t // 2.0 * (2.0 - pause) + np.minimum(t % 2.0, 2.0 - pause))[:, None]
    moves = (t % 2.0 < 2.0 - pause)[:, None].astype(float)
    q = np.sin(moved * w) + 1e-5 * rng.standard_normal((samples, 2))
    v = moves * w * np.cos(moved * w) + 1e-3 * rng.standard_normal((samples, 2))
    a = -moves * (w**2) * np.sin(moved * w)
    return Log(t=t, q=q, tau=q + 0.1 * rng.standard_normal(q.shape), joints=("a", "b"), v=v, a=a)


def in_parts(log, settings):
    """Return the trajectory of each part of the log, made from the rows that it needs only."""
    settings = resolve(log, settings)
    cuts = np.flatnonzero(np.diff(log.t) > settings.max_gap) + 1
    edges = [0, *cuts.tolist(), len(log.t)]
    segments = [
        Segment(i, j, float(log.t[i]), float(log.t[j - 1]), k)
        for k, (i, j) in enumerate(pairwise(edges))
    ]
    for start in range(0, len(log.t), PART):
        stop = min(start + PART, len(log.t))
        mine = [s for s in segments if s.first < stop and s.stop > start]
        reach = filter_reach(settings)
        before = int(np.searchsorted(log.t, log.t[start] - reach)) - SPLINE
        after = int(np.searchsorted(log.t, log.t[stop - 1] + reach)) + SPLINE
        low, high = max(before, mine[0].first), min(after, mine[-1].stop)
        rows = slice(low, high)
        part = Log(
            t=log.t[rows], q=log.q[rows], tau=log.tau[rows], joints=log.joints,
            v=log.v[rows], a=log.a[rows], base=log.base and log.base.at(rows),
        )  # fmt: skip
        own = slice(start, stop)
        yield process_segments(part, mine, settings, first=low, own=own, speeds=SPEEDS)


CASES = {
    "plain": ({}, {}), "differentiated": ({}, {"velocity": "differentiated"}),
    "no filter": ({}, {"cutoff": None}),
    "rows as recorded": ({}, {"cutoff": None, "velocity": "differentiated"}),
    "resampled only": ({}, {"cutoff": None, "rate": 150.0}),
    "decimated": ({}, {"rate": 50.0, "cutoff": 6.0}),
    "sharp": ({}, {"order": 10, "cutoff": 15.0}),
    "near Nyquist": ({}, {"rate": 40.0, "cutoff": 19.0}),
    "slow": ({}, {"order": 2, "cutoff": 1.0, "trim": 0.0}), "no trim": ({}, {"trim": 0.0}),
    "gaps": ({"gaps": (300, 700, 720, 723, 2099, 2100, 4998)}, {}),
    "long trim and gaps": ({"gaps": (300, 700, 720, 2100)}, {"trim": 0.9}),
    "delays": ({}, {"torque_delay": 0.31, "velocity_delay": -0.13}),
    "drives that stick": ({"pause": 0.4}, {}), "long rests": ({"pause": 1.5}, {}),
    "uniform": ({"jitter": 0.0}, {}), "clock of the epoch": ({"start": 1.7e9, "jitter": 0.0}, {}),
    "delayed rows": ({}, {"cutoff": None, "torque_delay": 0.1}),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_parts_give_the_motion_of_the_whole(case, rng):
    how, given = CASES[case]
    log, settings = recording(rng, **how), SignalSettings(**given)
    whole, parts = process(log, settings, SPEEDS), list(in_parts(log, settings))
    np.testing.assert_array_equal(np.concatenate([p.t for p in parts]), whole.t)
    segment = np.concatenate([p.segment for p in parts])
    np.testing.assert_array_equal(np.unique(segment, return_inverse=True)[1], whole.segment)
    # what rounding leaves is made larger by each differentiation, by up to 2 / step
    differences = {"q": 0, "v": int(given.get("velocity") == "differentiated"), "tau": 0}
    differences["a"] = 2 * differences["v"]
    if settings.cutoff is None:
        assert [x.direction for x in (whole, *parts)] == [None] * (1 + len(parts))
    else:
        differences["direction"] = 0
    for name, count in differences.items():
        found, wanted = np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name)
        bound = 2e-12 * (100 if case == "slow" else 1) * (RATE / 2) ** count
        assert np.abs(found - wanted).max() < bound * np.abs(wanted).max(), name


def test_a_log_smoothed_before_with_other_settings_has_the_values_of_a_new_one(rng):
    log = recording(rng, samples=1500, gaps=(700,))
    plain = SignalSettings(cutoff=8.0, velocity="differentiated")
    changes = [
        {}, {"cutoff": 12.0}, {"order": 2}, {"torque_delay": 0.02}, {"rate": 150.0},
        {"velocity": "measured"}, {"velocity": "measured", "velocity_delay": 0.03},
    ]  # fmt: skip
    for change in changes:
        settings = replace(plain, **change)
        found, wanted = (process(x, settings, SPEEDS) for x in (log, replace(log)))
        for name in ("t", "q", "v", "a", "tau", "direction", "segment"):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), name)


@pytest.mark.parametrize(
    ("order", "cutoff", "rate"), [(1, 3.0, 50.0), (4, 40.0, 100.0), (5, 8.0, 300.0)]
)
def test_a_filter_reaches_until_nothing_is_left_of_its_slowest_pole(order, cutoff, rate):
    """At the rate of the log and on a grid as fine as may be, whichever is slower."""

    def slowest(rate):
        poles = butter(order, cutoff, fs=rate, output="zpk")[1]
        return -1.0 / (np.log(np.abs(poles)).max() * rate)

    settings = SignalSettings(
        order=order, cutoff=cutoff, rate=rate, torque_delay=-0.03, velocity_delay=0.02
    )
    wanted = 0.03 + 2 * 42.0 * max(slowest(rate), slowest(1e3 * rate)) + 8.0 / cutoff
    assert filter_reach(settings) == pytest.approx(wanted, rel=1e-5)
    more = replace(settings, velocity_delay=-0.25)
    assert filter_reach(more) == pytest.approx(wanted + 0.22, rel=1e-5)


JUMPS = ((1990, 0.3), (1996, -0.28), (3700, 0.05))  # a marker lost and found, and another one


def floating(log, jumps=()):
    """Return the log with a base that moves, and jumps along z from some rows on [m]."""
    pose = np.zeros((len(log.t), 7))
    pose[:, :3] = 0.1 * np.sin(np.outer(log.t, [1.0, 2.0, 3.0]))
    pose[:, 5], pose[:, 6] = np.sin(0.2 * np.sin(log.t)), np.cos(0.2 * np.sin(log.t))
    for row, size in jumps:
        pose[row:, 2] += size
    return replace(log, base=BaseMotion(pose))


@pytest.mark.parametrize("cutoff", [None, 6.0])
@pytest.mark.parametrize("rate", [None, 160.0])
def test_samples_that_a_jump_of_the_base_reaches_are_marked(rng, cutoff, rate):
    log = recording(rng, start=3.0)
    settings = SignalSettings(cutoff=cutoff, rate=rate)
    smooth, jumped = (process(floating(log, x), settings, SPEEDS) for x in ((), JUMPS))
    assert not smooth.switching.any()
    off = np.abs(jumped.a - smooth.a).max(axis=1)
    assert off[jumped.switching].max() > 10.0  # [m/s^2]
    assert off[~jumped.switching].max() < 1e-3
    assert np.mean(jumped.switching) < (0.02 if cutoff is None else 0.18)
    edges = np.flatnonzero(np.diff(jumped.switching.astype(int)))
    starts = jumped.t[edges[::2]]
    assert len(starts) == 2
    for first, row in zip(starts, (1990, 3700), strict=True):
        assert 0.0 < log.t[row] - first < (0.12 if cutoff is None else 1.1)
    whole = np.concatenate([x.switching for x in in_parts(floating(log, JUMPS), settings)])
    np.testing.assert_array_equal(whole, jumped.switching)


MOTOR = Coupling("motor", (("wrist_2_joint", 1.0), ("wrist_3_joint", -0.5)))
ROBOTS = {"plain": {}, "coupled drive": {"couplings": (MOTOR,)}}


@pytest.fixture(params=ROBOTS)
def robot(request):
    return RobotModel.from_urdf(example_urdf("ur10_robot.urdf"), **ROBOTS[request.param])


def filtered(x, cutoff, rate, order=4):
    """Return columns behind the filter: an oracle that shares no code with the package."""
    sos = butter(order, cutoff, fs=rate, output="sos")
    return sosfiltfilt(sos, x, axis=0, padlen=min(len(x) - 1, int(2 * rate / cutoff)))


def test_the_coulomb_column_is_the_filtered_sign(robot):
    rate, cutoff, trim = 200.0, 8.0, 0.5
    pi = np.where([name.endswith(".coulomb") for name in robot.layout.names], truth(robot), 0.0)
    log = exact_log(robot, pi, np.random.default_rng(2), samples=3000, rate=rate)
    motion = hold_log(robot, log, SignalSettings(cutoff=cutoff, trim=trim)).whole.trajectory
    kept = np.round(motion.t * rate).astype(int)
    w = log.v @ friction_speeds(robot.layout).T
    expected = filtered(np.sign(filtered(w, cutoff, rate)), cutoff, rate)[kept]
    np.testing.assert_allclose(motion.direction, expected, rtol=0, atol=1e-9)
    # and what it is good for: the torque of Coulomb friction alone, filtered, is the written row
    W = joint_torque_regressor(robot, motion.q, motion.v, motion.a, motion.direction)
    torque = filtered((joint_torque_regressor(robot, log.q, log.v, log.a) @ pi).reshape(-1, 6),
                      cutoff, rate)[kept]  # fmt: skip
    np.testing.assert_allclose((W @ pi).reshape(-1, 6), torque, atol=1e-6 * np.abs(torque).max())
    (rows, tau, _), *_ = build_problem(robot, motion).blocks()
    np.testing.assert_allclose(rows @ pi, tau, atol=1e-6 * np.abs(torque).max())


def test_the_sign_is_filtered_before_rows_are_left_out(ur5):
    pi = truth(ur5)
    log = exact_log(ur5, pi, np.random.default_rng(3), samples=4000, rate=400.0)
    speeds = friction_speeds(ur5.layout)
    fine = process(log, SignalSettings(cutoff=8.0), speeds)
    coarse = process(log, SignalSettings(cutoff=8.0, rate=40.0), speeds)
    same = np.searchsorted(fine.t, coarse.t[1:] - 1e-6)
    np.testing.assert_allclose(fine.t[same], coarse.t[1:], atol=1e-9)
    np.testing.assert_allclose(coarse.direction[1:], fine.direction[same], atol=1e-9)


# --- which way friction acts ----------------------------------------------------------------------

T = np.linspace(-1.0, 1.0, 401)
BAND = 0.02  # [rad/s]


def acting(w, band=BAND, longest=1.0):
    return acting_directions(T, w[:, None], band, longest)[:, 0]


@pytest.mark.parametrize("slope", [0.03, 0.5, 20.0])
def test_a_speed_that_passes_through_zero_has_a_sharp_sign(slope):
    w = slope * (T - 0.1237)
    np.testing.assert_array_equal(acting(w), np.sign(w))


@pytest.mark.parametrize("depth", [-0.015, 0.0, 0.005, 0.015])
def test_a_short_way_back_keeps_its_sign(depth):
    w = 2.0 * T**2 - depth
    expected = np.where(np.abs(w) < 1e-9, 0.0, np.sign(w))
    np.testing.assert_array_equal(acting(w), expected)


@pytest.mark.parametrize("after", [1.0, -1.0])
def test_friction_of_a_drive_that_sticks_goes_from_one_sign_to_the_other(after):
    ringing = 0.004 * np.sin(40 * T)
    w = np.where(T < -0.2, -(T + 0.2), np.where(T > 0.2, after * (T - 0.2), ringing))
    start, end = -0.2 - BAND, 0.2 + BAND  # where the speed is in the band
    expected = np.interp(T, [start, end], [1.0, after])
    np.testing.assert_allclose(acting(w), expected, atol=1e-6)
    np.testing.assert_array_equal(acting(w, longest=0.4), acting(w, band=0.0))
    assert np.count_nonzero(np.diff(np.sign(acting(w, band=0.0)))) > 3  # as the ringing has it


@pytest.mark.parametrize(("cutoff", "is_stuck"), [(4.0, True), (6.0, False)])
def test_stiction_lasts_eight_periods_of_the_filter_at_most(cutoff, is_stuck):
    t = np.arange(0.0, 4.0, 0.005)
    q = np.column_stack([np.where(t < 1.2, -(t - 1.2), np.maximum(t - 2.8, 0.0))])
    w = np.gradient(q, t, axis=0)  # -1, 0 for 1.6 s, and 1 rad/s
    settings = SignalSettings(cutoff=cutoff, min_velocity=BAND)
    found = _acting(t, w, settings)[(t > 1.3) & (t < 2.7), 0]
    wanted = (t[(t > 1.3) & (t < 2.7)] - 2.0) / 0.8
    np.testing.assert_allclose(found, wanted if is_stuck else 0.0, atol=0.01)


def test_rest_has_no_direction():
    w = np.where(np.abs(T) < 0.8, 1e-12 * np.cos(50 * T), T)
    np.testing.assert_array_equal(acting(w)[np.abs(T) < 0.8], 0.0)


@pytest.mark.parametrize(("before", "after", "factor"), [(1, -1, 2.0), (-1, 1, 2.0), (1, 1, 4.0)])
@pytest.mark.parametrize(("enters", "leaves"), [(4.0, 0.5), (0.5, 4.0)])  # [rad/s^2]
def test_a_drive_sticks_that_is_slow_for_longer_than_its_slopes_say(
    before, after, factor, enters, leaves
):
    least, dt = factor * BAND * (1 / enters + 1 / leaves), 1e-4
    for share, sticks in ((1.03, True), (0.97, False)):
        slow = share * least
        t = 7.0 + np.arange(0.0, slow + 0.2, dt)
        in_, out = 7.1, 7.1 + slow
        way_in = before * np.maximum(BAND - enters * (t - in_), BAND - 3 * enters * dt)
        way_out = after * np.maximum(BAND + leaves * (t - out), BAND - 3 * leaves * dt)
        w = np.where(t < in_ + slow / 2, way_in, way_out)
        found = acting_directions(t, w[:, None], BAND, longest=2.0)[:, 0]
        stuck = np.interp(t, [in_, out], [before, after])
        wanted = stuck if sticks else np.sign(w)
        np.testing.assert_allclose(found, wanted, atol=1e-6 if share < 1 else 2e-3)
        sharp = acting_directions(t, w[:, None], BAND, longest=0.99 * slow)[:, 0]
        np.testing.assert_array_equal(sharp, np.sign(w))
