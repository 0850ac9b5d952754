import pytest

from robotid.base.exceptions import SettingsError
from robotid.identification.closed_loop.loop_settings import LoopSettings, groups_of

JOINTS = ("FL_hip_joint", "FL_calf_joint", "FR_hip_joint", "FR_calf_joint", "tail")


def test_joints_that_are_alike_share_a_group_named_by_their_words():
    found = groups_of(LoopSettings(), JOINTS, ["a", "b", "a", "b", "c"])
    assert found == ["hip", "calf", "hip", "calf", "tail"]
    legs = ("front_left_knee", "front_right_knee", "rear_left_knee")  # words of some are not theirs
    assert groups_of(LoopSettings(), legs, "kkk") == ["knee", "knee", "knee"]


def test_alike_joints_without_a_word_in_common_have_the_first_ones_name():
    assert groups_of(LoopSettings(), ("left", "right"), [1, 1]) == ["left", "left"]


def test_stated_groups_stand_over_what_looks_alike():
    loop = LoopSettings(groups={"front": ["FL_hip_joint", "FL_calf_joint"]})
    found = groups_of(loop, JOINTS, [1] * 5)
    assert found == ["front", "front", *JOINTS[2:]]


def test_groups_of_joints_that_are_not_there_are_refused():
    loop = LoopSettings(groups={"front": ["FL_hip_jiont"]})
    with pytest.raises(SettingsError, match=r"groups.front has 'FL_hip_jiont'.*FL_hip_joint"):
        groups_of(loop, JOINTS, [1] * 5)


def test_a_joint_of_two_groups_is_refused():
    loop = LoopSettings(groups={"front": ["tail"], "back": ["tail"]})
    with pytest.raises(SettingsError, match=r"joint 'tail' is in the groups front and back"):
        groups_of(loop, JOINTS, [1] * 5)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("kp", 20.0), ("kd", {"tail": 1.0}), ("limit", "find"), ("delay", 0.01),
        ("gravity_compensation", True), ("zeros", "find"),
    ],
)  # fmt: skip
def test_a_logged_torque_closes_no_loop(name, value):
    with pytest.raises(SettingsError, match=rf"\[controller\] {name} is .*without a controller"):
        LoopSettings(kind="torque", **{name: value})
    assert LoopSettings(kind="pd", **{name: value}).kind == "pd"


@pytest.mark.parametrize("name", ["zeros", "kind", "delays"])
def test_a_word_that_is_none_of_a_setting_is_refused(name):
    with pytest.raises(SettingsError, match=rf"\[?controller\]?:? {name} is 'fnid', wanted one of"):
        LoopSettings(**{name: "fnid"})


def test_a_late_torque_is_moved_back_by_the_signals():
    with pytest.raises(SettingsError, match=r"\[signals\] torque_delay"):
        LoopSettings(kind="torque", delay=0.01)


def test_joints_may_share_a_drive_that_a_torque_moves():
    loop = LoopSettings(kind="torque", groups={"hips": ["FL_hip_joint", "FR_hip_joint"]})
    assert groups_of(loop, JOINTS, range(5))[0] == "hips"
