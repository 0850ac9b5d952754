from dataclasses import replace

import numpy as np
import pytest

from robotid.design.clearance import Box, Clearance
from robotid.design.design import Designer, FourierBasis
from robotid.design.limits import LIMITS, Course, MotionLimits
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


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


WRIST = ["wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]


@pytest.fixture(scope="module")
def course():
    """A motion of the last three joints of a UR10, between a post and a floor."""
    model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"), joints=WRIST)
    limits = MotionLimits.of_model(model, acceleration={"wrist_2_joint": 4.0})
    post = Box("post", (1.2, 0.1, -0.5), (1.3, 0.2, 0.5))
    around = Clearance(model, least=0.03, floor=-0.5, boxes=[post])
    designer = Designer.of_model(model, FourierBasis(4.0, 3), limits)
    fine = replace(designer, finer=10)
    design = fine.checked(designer.random(np.random.default_rng(0)))
    return model, designer, design, replace(designer, clearance=around).course(design)


def test_a_course_has_the_values_of_the_motion_and_shares_of_its_limits(course):
    model, _, design, found = course
    q, v, a, jerk = design.motion.basis.derivatives(found.t, 3) @ design.motion.coefficients
    np.testing.assert_allclose(found.values[:3], [q, v, a], atol=1e-12)
    np.testing.assert_allclose(found.values[3][1:-1], jerk[1:-1], atol=0.01)  # by differences
    np.testing.assert_allclose(found.values[5], found.values[4] * v, atol=1e-12)
    speeds = np.array([j.velocity for j in model.limits])
    np.testing.assert_allclose(found.used[1], v / (0.9 * speeds), atol=1e-12)
    kinds = [k for k, kind in enumerate(LIMITS) if kind != "jerk"]
    np.testing.assert_allclose(found.largest[kinds], design.used[kinds], rtol=1e-9)
    assert np.abs(found.largest - design.used).max() < 0.01  # jerk by differences
    k = LIMITS.index("acceleration")
    assert found.largest[k, 0] == 0.0  # it has no limit
    at = found.peak("acceleration", 1)
    peak = np.abs(design.motion.evaluate(np.array([at]))[2][0, 1])
    assert peak == pytest.approx(4.0 * found.largest[k, 1], rel=1e-9)
    signs = set()
    for kind, used in zip(LIMITS, found.used, strict=True):  # the largest, of either sign
        for j in range(3):
            at = used[found.t == found.peak(kind, j), j]
            assert np.abs(at) == np.abs(used[:, j]).max()
            signs |= set(np.sign(at))
    assert {-1.0, 1.0} <= signs


def test_the_distance_of_a_course_is_that_of_all_pairs(course):
    *_, found = course
    around = found.clearance
    poses = around.placed(found.values[0])
    exact = around.near(poses, np.inf, around.everything).distance
    distance, pairs = found.nearness(around.everything)
    np.testing.assert_allclose(distance, exact.min(axis=0), atol=1e-9)
    np.testing.assert_array_equal(exact[pairs, np.arange(len(distance))], exact.min(axis=0))
    margins = (exact - around.required[:, None])[found.changes(around)]
    assert found.nearest.margin == pytest.approx(margins.min())
    assert found.nearest.time == found.t[np.unravel_index(margins.argmin(), margins.shape)[1]]
    floor = np.array(["the floor" in pair for pair in around.named])
    assert exact[floor].min() > 0.2  # farther than what is looked at first
    np.testing.assert_allclose(found.nearness(floor)[0], exact[floor].min(axis=0), atol=1e-9)
    assert found.changes(around).all()
    turned = found.values.copy()
    turned[0, :, :2] = turned[0, 0, :2]  # the last joint moves alone
    last = [any("wrist_3" in name or "ee_" in name for name in pair) for pair in around.named]
    changes = replace(found, values=turned).changes(around)
    assert changes.any()
    assert not changes[~np.array(last)].any()
    nothing = np.zeros(len(around.pairs), dtype=bool)
    assert np.isinf(found.nearness(nothing)[0]).all()
