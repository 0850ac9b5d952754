import numpy as np
import pytest

from robotid.identification.online import LiveSignals

FIXED = np.array([False])


def run(signals, t, q, tau):
    found = [i for k in range(len(t)) for i in signals.push(t[k], q[k], tau[k])]
    return [np.array(x) for x in zip(*found, strict=True)]


def test_the_delay_is_as_stated_and_the_same_for_motion_and_torque():
    w = 2 * np.pi  # [rad/s]
    t = np.arange(3000) * 1e-3
    signals = LiveSignals(1, 1000.0, 8.0, FIXED)
    at, q, v, a, tau = run(signals, t, np.sin(w * t)[:, None], np.cos(2 * w * t)[:, None])
    # 1 and 2 Hz of 8 Hz: the amplitude is 0.5 and 2 % low, the phase is right to 1 ms
    np.testing.assert_allclose(q[:, 0], np.sin(w * at), atol=0.006)
    np.testing.assert_allclose(v[:, 0], w * np.cos(w * at), atol=0.006 * w)
    np.testing.assert_allclose(a[-1000:, 0], -(w**2) * np.sin(w * at[-1000:]), atol=0.006 * w**2)
    np.testing.assert_allclose(tau[:, 0], np.cos(2 * w * at), atol=0.025)


def test_uneven_time_stamps_are_put_on_the_grid(rng):
    t = np.arange(3000) * 1e-3 + rng.uniform(-4e-4, 4e-4, 3000)
    signals = LiveSignals(1, 1000.0, 8.0, FIXED)
    at, q, *_ = run(signals, t, np.sin(6 * t)[:, None], np.zeros((3000, 1)))
    np.testing.assert_allclose(np.diff(at), 1e-3, rtol=1e-9)
    np.testing.assert_allclose(q[:, 0], np.sin(6 * at), atol=0.006)


def test_nothing_is_filtered_across_a_gap():
    t = np.concatenate([np.arange(1000), 3000 + np.arange(1000)]) * 1e-3
    q = np.where(t < 2, 1.0, 2.0)[:, None]
    at, found, v, *_ = run(LiveSignals(1, 1000.0, 8.0, FIXED), t, q, 0 * q)
    assert not ((at > 1.0) & (at < 3.0)).any()
    np.testing.assert_allclose(v, 0.0, atol=1e-8)
    np.testing.assert_allclose(found[:, 0], np.where(at < 2, 1.0, 2.0), atol=1e-9)


@pytest.mark.parametrize(
    ("rate", "cutoff", "longest"),
    [(1000.0, 8.0, 0.25 / 8.0), (100.0, 20.0, 2.5 / 100.0)],  # of a period, of the samples
)
def test_a_pause_is_a_gap_from_a_quarter_period_or_two_and_a_half_samples_on(rate, cutoff, longest):
    for pause, is_gap in ((0.9 * longest, False), (1.1 * longest, True)):
        t = np.arange(800) / rate
        t[400:] += pause - 1 / rate
        signals = LiveSignals(1, rate, cutoff, FIXED)
        at, *_ = run(signals, t, 0.5 + t[:, None], t[:, None])
        assert (np.diff(at).max() > 1.5 / rate) == is_gap


def test_full_turns_are_taken_out_of_joints_that_turn_freely():
    t = np.arange(2000) * 1e-3
    wrapped = (np.pi + 4 * t) % (2 * np.pi) - np.pi
    _, _, v, *_ = run(
        LiveSignals(1, 1000.0, 8.0, np.array([True])), t, wrapped[:, None], 0 * t[:, None]
    )
    np.testing.assert_allclose(v[500:], 4.0, atol=0.01)
    # and of no others
    both, alone = (
        run(LiveSignals(len(turns), 1000.0, 8.0, np.array(turns)), t, q, 0 * q)
        for turns, q in (
            ([True, False], np.column_stack(2 * [wrapped])),
            ([False], wrapped[:, None]),
        )
    )
    np.testing.assert_allclose(both[2][:, 0], v[:, 0], atol=1e-9)
    np.testing.assert_allclose(both[2][:, 1], alone[2][:, 0], atol=1e-9)
    assert np.abs(alone[2]).max() > 50.0
