import pytest

from robotid.base.exceptions import SettingsError
from robotid.identification.closed_loop.loop_settings import LoopSettings, groups_of

JOINTS = ("FL_hip_joint", "FL_calf_joint", "FR_hip_joint", "FR_calf_joint", "tail")


def test_joints_that_are_alike_share_a_group_named_by_their_words():
    found = groups_of(LoopSettings(), JOINTS, ["a", "b", "a", "b", "c"])
    assert found == ["hip", "calf", "hip", "calf", "tail"]
    legs = ("front_left_knee", "front_right_knee", "rear_left_knee")  # words of some are not theirs
    assert groups_of(LoopSettings(), legs, "kkk") == ["knee", "knee", "knee"]


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
