import numpy as np
import pytest

from robotid.base.exceptions import SettingsError
from robotid.design.excitation_settings import MotionSettings
from robotid.design.limits import Course, MotionLimits
from robotid.dynamics.simulation.simulation_settings import Payload
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


def test_robots_without_limits_are_told_what_to_state(tmp_path):
    text = example_urdf("ur5_robot.urdf").read_text()
    (tmp_path / "bare.urdf").write_text(text.replace('velocity="3.15"', 'velocity="0"'))
    with pytest.raises(SettingsError, match=r"no limit of .*\(velocity\).*add <limit"):
        MotionLimits.of_model(RobotModel.from_urdf(tmp_path / "bare.urdf"))


def test_bad_numbers_are_refused(panda):
    with pytest.raises(SettingsError, match=r"share is 1\.2, wanted more than 0 and at most 1"):
        MotionLimits.of_model(panda, share=1.2)
    with pytest.raises(SettingsError, match="jerk of panda_joint1 is -1, wanted a positive number"):
        MotionLimits.of_model(panda, jerk={"panda_joint1": -1})
    with pytest.raises(SettingsError, match="power is stated for 'x', which is not a moving joint"):
        MotionLimits.of_model(panda, power={"x": 1})


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


def test_settings_of_a_motion_have_safe_defaults_and_ranges():
    own = MotionSettings()
    assert (own.share, own.clearance) == (0.9, 0.02)
    assert (own.kind, own.duration, own.harmonics, own.points) == ("fourier", 10.0, 5, 100.0)
    assert (own.starts, own.seconds, own.seed) == (3, np.inf, 0)
    for name, low, high, words in (
        ("share", 1e-3, 1.0, "0.001 to 1 of the limits"),
        ("duration", 0.1, 3600.0, "0.1 to 3600 s"),
        ("harmonics", 2, 100, "2 to 100"),
        ("starts", 1, 1000, "1 to 1000"),
        ("points", 0.1, 1e5, "0.1 to 100000 rows per second"),
    ):
        for value in (low, high):
            assert getattr(MotionSettings(**{name: value}), name) == value
        for value in (low - 1e-4 if isinstance(low, float) else low - 1, high + 1):
            with pytest.raises(SettingsError) as caught:
                MotionSettings(**{name: value})
            assert str(caught.value) == f"{name} is {value}, wanted {words}"
    for name in ("acceleration", "jerk", "power", "noise"):
        MotionSettings(**{name: {"a": 1e-9, "b": 1e12}})
        with pytest.raises(
            SettingsError, match=f"^{name} of 'b' is 2e\\+12, wanted 1e-09 to 1e\\+12$"
        ):
            MotionSettings(**{name: {"a": 1.0, "b": 2e12}})
        with pytest.raises(SettingsError, match=f"^{name} of 'a' is 5e-10, wanted"):
            MotionSettings(**{name: {"a": 5e-10, "b": 1.0}})
    for stated in ({"moving": ["a"]}, {"payload": Payload(link="tool")}):
        MotionSettings(kind="payload", **stated)
        with pytest.raises(SettingsError, match="but kind is 'bspline', wanted payload"):
            MotionSettings(kind="bspline", **stated)
