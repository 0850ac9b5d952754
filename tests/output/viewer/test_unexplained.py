import numpy as np
import pytest

from robotid.output.viewer.replays import find_unexplained, residual_levels

T = np.arange(2000) / 100.0  # [s]
JOINTS = ("a", "b", "c")


@pytest.fixture
def torques(rng):
    tau = 10.0 * np.sin(T[:, None] * np.array([1.0, 2.0, 0.5]))
    return tau, tau + rng.normal(0.0, 0.5, tau.shape)


def test_a_push_is_found_with_its_joint_its_time_and_its_size(torques):
    tau, predicted = torques
    tau = tau.copy()
    tau[500:560, 1] += 8.0
    tau[500:560, 2] += 5.0
    (found,) = find_unexplained(T, tau, predicted, JOINTS)
    assert found.joint == "b"
    # the mean over 0.2 s begins to rise half a window early
    assert found.start == pytest.approx(5.0, abs=0.11)
    assert found.end == pytest.approx(5.6, abs=0.11)
    assert found.residual == pytest.approx(8.0, abs=0.3)


@pytest.mark.parametrize(("usual", "limit"), [(1.0, 6.0), (0.1, 0.3 * 8.0)])
def test_a_push_is_one_above_six_medians_and_0_3_of_the_torque(usual, limit):
    tau = np.tile([8.0, -8.0], 1000)[:, None]
    for share in (0.97, 1.03):
        residual = np.full_like(tau, usual)
        residual[500:600] = share * limit
        found = find_unexplained(T, tau, tau - residual, ("a",))
        assert [x.residual for x in found] == pytest.approx([share * limit] * (share > 1))


def test_levels_are_root_mean_squares_and_say_where_there_is_nothing():
    t = np.r_[0.1, 0.3, 0.6, 0.9, 1.2, 3.0]
    residual = np.array([[3.0, 1], [4.0, np.nan], [-1, np.nan], [1, np.nan], [2, -5], [7, 0]])
    levels = residual_levels(np.array([0.0, 0.5, 1.0, 2.0, 2.5, 3.0]), t, residual)
    wanted = [[np.sqrt(12.5), 1], [1, -1], [2, 5], [np.nan, np.nan], [7, 0]]
    np.testing.assert_allclose(levels, wanted)


@pytest.mark.parametrize(("seconds", "count"), [(0.04, 0), (0.06, 1), (0.3, 1)])
def test_what_lasts_less_than_50_ms_is_a_spike(seconds, count):
    """Samples so far apart that each is its own mean, but for some about 9 s."""
    t = np.sort(np.r_[0.35 * np.arange(100), 9.0 + 0.0101 * np.arange(31)])
    tau = np.sin(t)[:, None] * [1.0, 3.0]
    pushed = (t >= 9.0) & (t <= 9.0 + 1.02 * seconds)
    predicted = tau - 0.01
    predicted[pushed, 1] -= 2.5
    found = find_unexplained(t, tau, predicted, ("a", "b"))
    assert len(found) == count
    for one in found:
        assert (one.joint, one.start) == ("b", pytest.approx(9.0))
        assert one.end == t[pushed][-1]
        assert one.residual == pytest.approx(2.51)
