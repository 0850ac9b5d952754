"""Signals of each joint over several logs, against each log by itself."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.driven import arm

from robotid.data.log import Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.estimation.fitting.drive_terms import joint_motions, travelled


def recording(model, rng, count, cutoff, start):
    t = start + np.arange(count) / 50.0
    q, v, a, tau = rng.standard_normal((4, count, 3))
    segment = (np.arange(count) >= count // 2).astype(int)
    motion = Trajectory(t, q, v, a, tau, model.joints, 50.0, segment)
    return SimpleNamespace(trajectory=motion, signals=SignalSettings(cutoff=cutoff))


def test_rows_of_two_logs_follow_each_other_with_the_time_since_each_began(rng):
    model = arm()
    logs = [recording(model, rng, *x) for x in ((40, 5.0, 3.0), (90, 8.0, 7.0))]
    rows = [np.arange(1, 40, 3), np.array([0, 7, 89])]
    load = rng.standard_normal((16, 3))
    found = joint_motions(logs, rows, load, model)
    longest = 89 / 50.0
    for j, motion in enumerate(found):
        for name in "qva":
            own = [getattr(log.trajectory, name)[k, j] for log, k in zip(logs, rows, strict=True)]
            np.testing.assert_array_equal(getattr(motion, name), np.concatenate(own))
        np.testing.assert_array_equal(motion.direction, np.sign(motion.v))
        np.testing.assert_array_equal(motion.load, load[:, j])
        np.testing.assert_allclose(motion.time, np.concatenate(rows) / 50.0 / longest, atol=1e-12)
        assert motion.passes == 8.0
        beside = {model.joints[k] for k in (j - 1, j + 1) if 0 <= k < 3}
        assert motion.others.keys() == beside
    np.testing.assert_array_equal(found[0].others[model.joints[1]].q, found[1].q)
    unfiltered = recording(model, rng, 40, None, 0.0)
    assert joint_motions([unfiltered], [rows[0]], load[:13], model)[0].passes == np.inf
    some = found[1].at(slice(2, 6))
    np.testing.assert_array_equal(some.travelled, found[1].travelled[2:6])
    assert (some.passes, some.others) == (8.0, {})


def test_the_way_is_that_since_the_last_reversal_or_the_segment_s_start():
    q = np.array([[0.0], [1.0], [3.0], [2.5], [2.0], [1.0], [5.0], [6.0]])
    v = np.array([[1.0], [1.0], [1.0], [-1.0], [-1.0], [-1.0], [-1.0], [-1.0]])
    segment = np.array([4, 4, 4, 4, 4, 4, 6, 6])
    t = np.arange(8) / 10.0
    found = travelled(Trajectory(t, q, v, v, v, ("j",), 10.0, segment))
    assert found[:, 0] == pytest.approx([0.0, 1.0, 3.0, 0.0, 0.5, 1.5, 0.0, 1.0])
