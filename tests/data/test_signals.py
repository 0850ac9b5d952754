from dataclasses import replace

import numpy as np
import pytest

from robotid.base.exceptions import DataError, SettingsError
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process, resolve, unwrap


def sine_log(t, frequency=0.5, lag=0.0, **options):
    w = 2 * np.pi * frequency
    q = np.column_stack([np.sin(w * t), 0.5 * np.cos(2 * w * t)])
    late = t - lag
    v = np.column_stack([w * np.cos(w * late), -w * np.sin(2 * w * late)])
    tau = np.column_stack([np.cos(w * t), np.sin(w * t)])
    return Log(t=t, q=q, tau=tau, joints=("a", "b"), v=v, **options)


def test_switched_off_the_rows_stay_as_they_were():
    log = sine_log(np.arange(0, 5, 0.01))
    out = process(log, SignalSettings(cutoff=None, trim=0.0, velocity="measured"))
    np.testing.assert_array_equal(out.t, log.t)
    np.testing.assert_array_equal(out.q, log.q)
    np.testing.assert_array_equal(out.v, log.v)
    np.testing.assert_array_equal(out.tau, log.tau)
    assert out.rate is None


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


def test_noise_above_the_cutoff_is_removed():
    rng = np.random.default_rng(0)
    clean = sine_log(np.arange(0, 20, 0.002))
    noisy = Log(
        t=clean.t,
        q=clean.q,
        tau=clean.tau + 0.1 * rng.standard_normal(clean.tau.shape),
        joints=clean.joints,
    )
    out = process(noisy, SignalSettings(cutoff=5.0))
    residual = out.tau[:, 0] - np.cos(np.pi * out.t)
    # the share of white noise in the band: 0.1 sqrt(5 / 250)
    assert 0.5 < residual.std() / (0.1 * np.sqrt(5 / 250)) < 1.5


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


@pytest.mark.parametrize(("lag", "choice"), [(0.006, "measured"), (0.16, "differentiated")])
def test_auto_takes_the_measured_velocity_unless_it_is_late(lag, choice):
    log = sine_log(np.arange(0, 10, 0.01), lag=lag)
    assert resolve(log, SignalSettings()).velocity == choice


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
        cutoff=None,
        rate=rate,
        velocity="measured",
        torque_delay=0.05,
        velocity_delay=0.03,
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
    np.testing.assert_allclose(
        unwrap(other, np.array([True, False])).q, angle + np.array([0.0, 1.0])
    )
    steady = replace(log, q=0.1 * angle)
    assert unwrap(steady, np.array([True, True])) is steady
    with pytest.raises(DataError, match=r"q_a jumps by a full turn at t = 1.58 s"):
        unwrap(log, np.array([False, False]))


BAD = {
    "velocity": (dict(velocity="filtered"), "velocity is 'filtered', wanted one of auto"),
    "cutoff": (dict(cutoff=-1.0), "cutoff is -1.0, wanted 0.001 to 1e6"),
    "rate": (dict(rate=0.0), "rate is 0.0, wanted 0.001 to 1e6"),
    "trim": (dict(trim=-0.1), "trim is -0.1, wanted 0 or a positive number"),
    "order": (dict(order=0), "order is 0, wanted 1 to 10"),
    "NaN": (dict(cutoff=float("nan")), "cutoff is nan"),
}


@pytest.mark.parametrize(("options", "message"), BAD.values(), ids=BAD)
def test_settings_out_of_range_are_refused(options, message):
    with pytest.raises(SettingsError, match=message):
        SignalSettings(**options)


def test_a_cutoff_that_no_filter_reaches_is_refused():
    log = sine_log(np.arange(200) / 1e9)
    with pytest.raises(SettingsError, match=r"cutoff 8 Hz is less than 1e-06 of the rate 1e\+09"):
        process(log, SignalSettings(cutoff=8.0))


def test_a_cutoff_beyond_half_the_rate_is_refused():
    with pytest.raises(SettingsError, match=r"cutoff 60 Hz is not below half the rate 100 Hz"):
        process(sine_log(np.arange(0, 5, 0.01)), SignalSettings(cutoff=60.0))


def test_a_log_without_velocity_cannot_use_it():
    log = sine_log(np.arange(0, 5, 0.01))
    bare = Log(t=log.t, q=log.q, tau=log.tau, joints=log.joints)
    with pytest.raises(DataError, match="no measured velocity for every joint"):
        process(bare, SignalSettings(velocity="measured"))
    assert resolve(bare, SignalSettings()).velocity == "differentiated"


def test_a_log_too_short_for_its_trim_is_refused():
    with pytest.raises(DataError, match="none of its 1 segments without gaps is long enough"):
        process(sine_log(np.arange(0, 0.3, 0.01)), SignalSettings(trim=0.2))


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
