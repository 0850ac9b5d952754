"""A stretch smoothed part by part is as smooth as the whole."""

from itertools import pairwise

import numpy as np
import pytest

from robotid.logs.data import Log
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import process, resolve
from robotid.logs.smoothing import SPLINE, Stretch, filter_reach, process_stretches

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
    stretches = [
        Stretch(i, j, float(log.t[i]), float(log.t[j - 1]), k)
        for k, (i, j) in enumerate(pairwise(edges))
    ]
    for start in range(0, len(log.t), PART):
        stop = min(start + PART, len(log.t))
        mine = [s for s in stretches if s.first < stop and s.stop > start]
        reach = filter_reach(settings)
        before = int(np.searchsorted(log.t, log.t[start] - reach)) - SPLINE
        after = int(np.searchsorted(log.t, log.t[stop - 1] + reach)) + SPLINE
        low, high = max(before, mine[0].first), min(after, mine[-1].stop)
        rows = slice(low, high)
        part = Log(
            t=log.t[rows], q=log.q[rows], tau=log.tau[rows], joints=log.joints,
            v=log.v[rows], a=log.a[rows],
        )  # fmt: skip
        own = slice(start, stop)
        yield process_stretches(part, mine, settings, first=low, own=own, speeds=SPEEDS)


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


def test_rows_that_a_part_does_not_own_are_cut_off_behind_the_filter(rng):
    log = recording(rng)
    settings = resolve(log, SignalSettings())
    reach = filter_reach(settings)
    # an order of 4 at 8 Hz forgets by 1 / e in 0.05 s; signs of smooth speeds are filtered again
    assert 3.0 < reach < 6.0
    assert filter_reach(resolve(log, SignalSettings(cutoff=None))) == 0.0
    assert filter_reach(resolve(log, SignalSettings(torque_delay=-0.4))) == pytest.approx(
        reach + 0.4
    )
