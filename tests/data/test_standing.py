"""Stands count once, slow segments once each, and what is fast is left out."""

import numpy as np
import pytest

from robotid.data.log import Log
from robotid.data.signals import standing_motion

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
