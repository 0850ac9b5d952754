"""A segment smoothed part by part is as smooth as the whole."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import butter

from robotid.data.base_motion import BaseMotion
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import SPLINE, Segment, filter_reach, process, process_segments, resolve

RATE = 200.0  # [Hz]
PART = 700  # rows
SPEEDS = np.array([[1.0, 0.0], [0.0, 1.0], [0.5, -1.0]])  # two joints, and a drive of both


def recording(rng, *, jitter=0.2, gaps=(), start=0.0, samples=5000, pause=0.0):
    """Return a noisy log of two joints, with gaps of half a second behind some rows.

    Every two seconds the joints rest for a while.
    """
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
    "plain": ({}, {}),
    "differentiated": ({}, {"velocity": "differentiated"}),
    "no filter": ({}, {"cutoff": None}),
    "rows as recorded": ({}, {"cutoff": None, "velocity": "differentiated"}),
    "resampled only": ({}, {"cutoff": None, "rate": 150.0}),
    "decimated": ({}, {"rate": 50.0, "cutoff": 6.0}),
    "sharp": ({}, {"order": 10, "cutoff": 15.0}),
    "near Nyquist": ({}, {"rate": 40.0, "cutoff": 19.0}),
    "slow": ({}, {"order": 2, "cutoff": 1.0, "trim": 0.0}),
    "no trim": ({}, {"trim": 0.0}),
    "gaps": ({"gaps": (300, 700, 720, 723, 2099, 2100, 4998)}, {}),
    "long trim and gaps": ({"gaps": (300, 700, 720, 2100)}, {"trim": 0.9}),
    "delays": ({}, {"torque_delay": 0.31, "velocity_delay": -0.13}),
    "drives that stick": ({"pause": 0.4}, {}),
    "long rests": ({"pause": 1.5}, {}),
    "uniform": ({"jitter": 0.0}, {}),
    "clock of the epoch": ({"start": 1.7e9, "jitter": 0.0}, {}),
    "delayed rows": ({}, {"cutoff": None, "torque_delay": 0.1}),
}


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
