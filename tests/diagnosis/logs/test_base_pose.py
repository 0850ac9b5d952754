"""Findings on the pose of a floating base: jumps, and the order of its quaternion."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers.stands import stand

from robotid.data.base_motion import BaseMotion, base_state, in_base, quaternions_of_angles
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.base_checks import check_base, check_pose, check_twist, check_unit
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

SLOW = SignalSettings(cutoff=4.0)
FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")


@pytest.fixture(scope="module")
def log(robot):
    """Return a log at 60 Hz, with noise, of a robot that sways and lifts its feet in turn."""
    rng = np.random.default_rng(2)
    motion = stand(robot, np.tile([0.0, 0.8, -1.6], 4), 0.25, rng, length=1.5, rate=60.0)
    q = motion.q + 1e-3 * rng.standard_normal(motion.q.shape)
    pose = motion.pose.copy()
    pose[:, :3] += 5e-4 * rng.standard_normal((len(q), 3))
    flags = dict(zip(FEET, motion.contacts.T, strict=True))
    return Log(
        motion.t, q, 0.0 * q, robot.joints, has_torque=False, base=BaseMotion(pose), contacts=flags
    )


def with_quaternion(log, change):
    pose = log.base.pose.copy()
    pose[:, 3:] = change(pose[:, 3:])
    return replace(log, base=BaseMotion(pose))


def test_signs_of_quaternions_have_no_effect(robot, log):
    signs = np.where(np.random.default_rng(0).random(len(log.t)) < 0.5, -1.0, 1.0)
    flipped = with_quaternion(log, lambda q: signs[:, None] * q)
    assert not list(check_base(robot, flipped, SLOW))
    assert np.abs(flipped.base.pose - log.base.pose).max() < 1e-15


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda q: np.roll(q, 1, axis=1), "its order is qw qx qy qz"),
        (lambda q: q * [-1.0, -1.0, -1.0, 1.0], "it is the orientation of the world in the base"),
    ],
)
def test_another_order_of_the_quaternion_is_named(robot, log, change, words):
    (found,) = check_base(robot, with_quaternion(log, change), SLOW)
    assert (found.code, found.severity) == ("base_orientation", "error")
    assert words in found.message
    assert found.evidence["best"] < 0.1  # [m/s], noise of the markers


@pytest.mark.parametrize(("axis", "down"), [("y", -9.81), ("-y", 9.81)])
def test_another_vertical_axis_of_the_world_is_named(robot, log, axis, down):
    turn = pin.Quaternion(pin.rpy.rpyToMatrix(np.sign(down) * np.pi / 2, 0.0, 0.0))  # z becomes it
    pose = log.base.pose.copy()
    pose[:, :3] = pose[:, :3] @ turn.matrix().T
    pose[:, 3:] = [(turn * pin.Quaternion(x)).coeffs() for x in pose[:, 3:]]
    other = replace(log, base=BaseMotion(pose))
    (found,) = check_base(robot, other, SLOW)
    assert (found.code, found.severity) == ("base_orientation", "error")
    assert f"above them along {axis} of the world" in found.message
    assert f"state gravity = [0, {down}, 0] at the top" in found.message
    assert abs(found.evidence["height"]) < 0.2
    assert found.evidence["best"] > 0.9
    stated = RobotModel.from_urdf(
        robot.tree.path, free_flyer=True, terms=(), constraints=robot.contacts,
        gravity=(0.0, down, 0.0),
    )  # fmt: skip
    assert not list(check_base(stated, other, SLOW))


def test_a_base_that_rolls_over_has_no_wrong_axes(robot, log):
    angle = np.pi * np.clip(log.t - log.t[-1] / 2 + 0.5, 0.0, 1.0)  # the whole world turns in 1 s
    turns = [pin.Quaternion(pin.exp3(np.array([x, 0.0, 0.0]))) for x in angle]
    pose = [
        np.r_[turn * x[:3], (turn * pin.Quaternion(x[3:])).coeffs()]
        for turn, x in zip(turns, log.base.pose, strict=True)
    ]
    rolls = replace(log, base=BaseMotion(np.array(pose)))
    assert "base_orientation" not in {x.code for x in check_base(robot, rolls, SLOW)}


def test_a_position_in_millimetres_is_named(robot, log):
    pose = log.base.pose.copy()
    pose[:, :3] *= 1e3
    (found,) = check_base(robot, replace(log, base=BaseMotion(pose)), SLOW)
    assert (found.code, found.severity) == ("base_unit", "error")
    step = 12  # rows in 0.2 s
    x = pose[::step, :3]
    second = (x[2:] - 2 * x[1:-1] + x[:-2]) / 0.2**2
    size = np.sqrt(np.mean(np.sum(second**2, axis=1)))
    assert found.evidence["acceleration"] == pytest.approx(size, rel=0.05)
    (later,) = check_unit(replace(log, t=log.t + 900.0, base=BaseMotion(pose)))
    assert later.evidence["acceleration"] == pytest.approx(found.evidence["acceleration"], rel=1e-6)
    short = replace(log, base=BaseMotion(pose)).window(log.t[0], log.t[0] + 0.3)
    assert list(check_unit(short)) == []  # no acceleration over 0.2 s in it
    noisy = log.base.pose + 5e-3 * np.random.default_rng(0).standard_normal(log.base.pose.shape)
    noisy[:, 3:] = log.base.pose[:, 3:]
    assert not [x.code for x in check_base(robot, replace(log, base=BaseMotion(noisy)), SLOW)
                if x.code == "base_unit"]  # fmt: skip
    assert f"are in mm, it is {1e-3 * found.evidence['acceleration']:.2g} m/s^2" in found.message


def test_jumps_are_found_with_size_and_time(log):
    assert not list(check_pose(log))
    pose = log.base.pose.copy()
    pose[100:, 0] += 0.04
    pose[200:, 2] -= 0.06
    (found,) = check_pose(replace(log, base=BaseMotion(pose)))
    assert (found.code, found.severity) == ("base_jump", "warning")
    assert found.evidence["jumps"] == 2
    assert found.evidence["size"] == pytest.approx(0.06, rel=0.1)
    assert found.evidence["first"] == log.t[100]
    assert "jumps 2 times, first at t = 1.667 s by 0.04" in found.message
    pose[:50, 3:] = np.roll(pose[:50, 3:], 1, axis=1)  # turned before: each kind has its own time
    of_kind = list(check_pose(replace(log, base=BaseMotion(pose))))
    assert [x.evidence["first"] for x in of_kind] == [log.t[100], log.t[50]]


def test_an_impact_is_no_jump(log):
    still = BaseMotion(np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], (len(log.t), 1)))
    pose = still.pose.copy()
    pose[100:, 2] += 2.0 * (log.t[100:] - log.t[100])  # 33 mm per row from one row on
    assert not list(check_pose(replace(log, base=BaseMotion(pose))))
    pose[100:, 2] += 0.1
    (found,) = check_pose(replace(log, base=BaseMotion(pose)))
    assert found.code == "base_jump"


@pytest.fixture(scope="module")
def free():
    return RobotModel.from_urdf(example_urdf("solo12.urdf"), free_flyer=True, terms=())


def flight(free, noise=0.0):
    """Return a log at 500 Hz with pose and right twist, with noise of the position [m]."""
    t = 3.0 + 0.002 * np.arange(2000)
    pose = np.zeros((len(t), 7))
    pose[:, :3] = 0.1 * np.column_stack([np.sin(t), np.cos(2 * t), np.sin(3 * t)])
    angles = np.column_stack([0.2 * np.sin(2 * t), 0.1 * np.cos(3 * t), 0.15 * np.sin(t)])
    pose[:, 3:] = quaternions_of_angles(angles)
    twist = base_state(t, pose, None, None)[1]
    pose[:, :3] += noise * np.random.default_rng(0).standard_normal((len(t), 3))
    q = np.zeros((len(t), 12))
    return Log(t, q, q, free.joints, base=BaseMotion(pose, twist))


def changed(log, linear=1.0, angular=1.0, turned=()):
    """Return a log with a scaled twist, parts of it with the axes of the world."""
    twist, back = log.base.twist.copy(), log.base.pose[:, 3:] * [-1.0, -1.0, -1.0, 1.0]
    for part in turned:
        twist[:, part] = in_base(back, twist[:, part])
    return replace(log, base=replace(log.base, twist=twist * np.repeat([linear, angular], 3)))


def test_noise_of_the_pose_is_no_error_of_the_twist(free):
    assert not list(check_twist(flight(free, noise=5e-4), SignalSettings(cutoff=20.0)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"linear": 1e3}, ["linear", "if it is in mm/s: convert it to m/s"]),
        ({"angular": 180 / np.pi}, ["angular", "if it is in deg/s: convert it to rad/s"]),
        ({"turned": [slice(0, 3)]},
         ["linear", "State twist = 'world' in [base], and turn the angular velocity"]),
    ],
)  # fmt: skip
def test_a_wrong_part_of_the_twist_is_named(free, change, words):
    # how the identification takes its velocities has no effect
    signals = SignalSettings(cutoff=20.0, velocity="differentiated")
    (found,) = check_twist(changed(flight(free), **change), signals)
    assert (found.code, found.severity) == ("base_twist", "error")
    assert all(text in found.message for text in words)


def test_axes_of_the_world_are_named_though_the_base_hardly_turns(free):
    """By 0.1 rad: the velocities differ by less than 30 % of the motion."""
    both = changed(flight(free), turned=[slice(0, 3), slice(3, 6)])
    found = list(check_twist(both, SignalSettings(cutoff=20.0)))
    assert len(found) == 2
    for finding in found:
        assert finding.message.endswith("State twist = 'world' in [base]")
        assert 0.05 < finding.evidence["off"] / finding.evidence["size"] < 0.3


def test_a_twist_that_was_turned_though_it_had_the_axes_of_the_base_is_named(free):
    log = flight(free)
    twist = np.hstack([in_base(log.base.pose[:, 3:], log.base.twist[:, k : k + 3]) for k in (0, 3)])
    wrong = replace(log, base=replace(log.base, twist=twist))
    found = list(check_twist(wrong, SignalSettings(cutoff=20.0)))
    assert len(found) == 2
    assert all("State twist = 'base' in [base]" in x.message for x in found)


def test_a_right_twist_shows_that_the_quaternion_is_the_inverse(free):
    log = flight(free)
    pose = log.base.pose * [1, 1, 1, -1, -1, -1, 1]
    inverse = replace(log, base=replace(log.base, pose=pose))
    (found,) = check_base(free, inverse, SignalSettings(cutoff=20.0))
    assert (found.code, found.severity) == ("base_orientation", "error")
    assert "it is the orientation of the world in the base" in found.message
    assert found.evidence["best"] < 0.02 * found.evidence["speed"]
