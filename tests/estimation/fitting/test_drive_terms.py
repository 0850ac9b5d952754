"""Shapes of a drive's terms, and the motion of each joint over several logs."""

from types import SimpleNamespace

import numpy as np
import pytest

from robotid.data.log import Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.estimation.fitting.drive_terms import DriveChoice, FoundShape, joint_motions, travelled
from robotid.robot.drives import LuGre, Stribeck

SEEN = {"v": (0.0, 2.0), "q": (-0.3, 0.4)}
SIZES = ((0.1,), (0.01, 0.2, 0.5))


def choice():
    names = ("stribeck.speed", "lugre.displacement", "lugre.speed", "lugre.excess")
    flat = [size for own in SIZES for size in own]
    shapes = tuple(FoundShape(n, x, 0.0, "-", False) for n, x in zip(names, flat, strict=True))
    return DriveChoice("a", ("stribeck", "lugre"), (), shapes=shapes, sizes=SIZES, data_range=SEEN)


def terms(speed, *own):
    return Stribeck(data_range=SEEN["v"], speed=speed), LuGre(
        displacement=own[0], speed=own[1], excess=own[2]
    )


def test_one_shape_of_all_is_larger_by_a_share():
    found = choice()
    assert found.altered(0, 0.5) == terms(0.1 * 1.5, 0.01, 0.2, 0.5)
    assert found.altered(1, 0.5) == terms(0.1, 0.01 * 1.5, 0.2, 0.5)
    assert found.altered(2, 0.5) == terms(0.1, 0.01, 0.2 * 1.5, 0.5)
    assert found.altered(3, -0.25) == terms(0.1, 0.01, 0.2, 0.5 * 0.75)
    assert found.sizes == SIZES


def test_shapes_move_by_a_third_at_most_and_within_their_bounds():
    """A displacement is at most 0.015 of the range of positions, 0.7 rad here."""
    root = np.diag([0.5, 0.25, 2.0, 3.0])
    covariance = root @ (np.eye(4) + 0.1) @ root
    found = choice().moved(np.array([0.5, 0.002, -0.15, 0.05]), covariance)
    sizes = [0.1 * 1.33, 0.015 * 0.7, 0.2 / 1.33, 0.55]
    np.testing.assert_allclose([x for own in found.sizes for x in own], sizes, rtol=1e-12)
    assert found.terms == terms(*(x for own in found.sizes for x in own))
    np.testing.assert_allclose([shape.value for shape in found.shapes], sizes, rtol=1e-12)
    errors = np.sqrt(1.1) * np.array([0.5, 0.25, 2.0, 3.0])
    np.testing.assert_allclose([shape.std_error for shape in found.shapes], errors, rtol=1e-12)
    np.testing.assert_array_equal(found.shape_covariance, covariance)
    assert [shape.name for shape in found.shapes] == [shape.name for shape in choice().shapes]


def recording(model, rng, count, cutoff, start):
    t = start + np.arange(count) / 50.0
    q, v, a, tau = rng.standard_normal((4, count, 3))
    segment = (np.arange(count) >= count // 2).astype(int)
    motion = Trajectory(t, q, v, a, tau, model.joints, 50.0, segment)
    return SimpleNamespace(trajectory=motion, signals=SignalSettings(cutoff=cutoff))


def test_rows_of_two_logs_follow_each_other_with_the_time_since_each_began(model, rng):
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
