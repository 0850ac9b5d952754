import numpy as np
import pytest

from robotid.design.limits import Course, MotionLimits


def test_limits_are_those_of_the_urdf_and_those_stated(panda):
    limits = MotionLimits.of_model(panda, share=0.5, jerk=7.0, acceleration={"panda_joint4": 3.0})
    for j, joint in enumerate(panda.limits):
        assert limits.middle[j] == pytest.approx((joint.lower + joint.upper) / 2)
        half, stated = (joint.upper - joint.lower) / 2, 3.0 if j == 3 else np.inf
        np.testing.assert_allclose(
            limits.sizes[:, j],
            [half / 2, joint.velocity / 2, stated, 7.0, joint.effort / 2, np.inf],
        )
    assert abs(limits.middle[3]) > 1.0  # its range is not even


def test_shares_are_signed_and_power_is_torque_times_speed(panda):
    limits = MotionLimits.of_model(panda, power=10.0)
    x = np.full((1, 7), 2.0)
    used = limits.used((limits.middle - limits.sizes[0])[None], x, x, x, -3.0 * x)
    np.testing.assert_allclose(used[0], -1.0)
    np.testing.assert_allclose(used[1], x / limits.sizes[1])
    np.testing.assert_array_equal(used[2:4], 0.0)
    np.testing.assert_allclose(used[4], -6.0 / limits.sizes[4][None])
    np.testing.assert_allclose(used[5], -1.2)


def test_a_course_peaks_where_most_of_a_limit_is_used_either_way():
    limits = MotionLimits(np.array([1.0, 0.0]), np.full((6, 2), 2.0))
    t = np.linspace(0.0, 3.0, 1501)
    q = np.column_stack([1.0 + np.where(t > 1.0, -1.5, 1.0) * np.sin(np.pi * t), 0.2 * t])
    v, a = (np.column_stack([x, -3.0 * x]) for x in (np.cos(t), np.exp(-t)))
    torque = np.column_stack([4.0 + t, -t])
    course = Course.of_motion(t, (q, v, a, torque), limits)
    used = [q - [1.0, 0.0], v, a, np.gradient(a, t, axis=0), torque, torque * v]
    np.testing.assert_allclose(course.used, np.array(used) / 2.0)
    np.testing.assert_allclose(course.largest, np.abs(used).max(axis=1) / 2.0)
    assert course.peak("position", 0) == pytest.approx(1.5)
    assert course.peak("torque", 1) == pytest.approx(3.0)
    few = course.thinned
    np.testing.assert_array_equal(few.t, t[::2])
    np.testing.assert_array_equal(few.values, course.values[:, ::2])
    whole = Course.of_motion(t[:1000], tuple(x[:1000] for x in (q, v, a, torque)), limits)
    assert len(whole.thinned.t) == 1000
