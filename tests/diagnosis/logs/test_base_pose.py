"""Findings on a floating base: pose, twist, IMU, contacts and measured forces."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers.legged import SOLO_FEET as FEET
from helpers.legged import solo_on_points, with_other_bodies
from helpers.stands import recorded, stand

from robotid.data.base_motion import (
    BaseMotion,
    ImuFrame,
    ImuMotion,
    base_state,
    in_base,
    quaternions_of_angles,
)
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.logs.base_checks import (
    check_pose,
    check_twist,
    check_unit,
    check_wrenches,
    examine_base,
)
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.dynamics.torque import predict
from robotid.robot.constraints import Contact, link_positions
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

SLOW, RAW = SignalSettings(cutoff=4.0), SignalSettings(cutoff=None, trim=0.0)


def check_base(model, log, signals):
    return examine_base(model, log, signals)[0]


@pytest.fixture(scope="module")
def robot():
    return solo_on_points()


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


QUATERNIONS = [
    (lambda q: np.roll(q, 1, axis=1), "its order is qw qx qy qz"),
    (lambda q: q * [-1.0, -1.0, -1.0, 1.0], "it is the orientation of the world in the base"),
]


@pytest.mark.parametrize(("change", "words"), QUATERNIONS)
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
    assert f"set gravity = [0, {down}, 0] at the top" in found.message
    assert abs(found.evidence["height"]) < 0.2
    assert found.evidence["best"] > 0.9
    (found,) = check_base(robot, with_quaternion(other, QUATERNIONS[0][0]), SLOW)
    assert "its order is qw qx qy qz" in found.message
    assert f"gravity = [0, {down}, 0]" in found.message
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


def flight(free, noise=0.0, about=(0.0, 0.0, 0.0)):
    """Return a log at 500 Hz with pose about angles, right twist, noise of the position [m]."""
    t = 3.0 + 0.002 * np.arange(2000)
    pose = np.zeros((len(t), 7))
    pose[:, :3] = 0.1 * np.column_stack([np.sin(t), np.cos(2 * t), np.sin(3 * t)])
    angles = np.column_stack([0.2 * np.sin(2 * t), 0.1 * np.cos(3 * t), 0.15 * np.sin(t)])
    pose[:, 3:] = quaternions_of_angles(about + angles)
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
         ["linear", "Set twist = 'world' in [base], and turn the angular velocity"]),
    ],
)  # fmt: skip
def test_a_wrong_part_of_the_twist_is_named(free, change, words):
    # how the identification takes its velocities has no effect
    signals = SignalSettings(cutoff=20.0, velocity="differentiated")
    (found,) = check_twist(changed(flight(free), **change), signals)
    assert (found.code, found.severity) == ("base_twist", "error")
    assert all(text in found.message for text in words)


@pytest.mark.parametrize("part", [slice(0, 3), slice(3, 6)])
def test_a_twist_with_the_axes_of_the_world_is_found(free, part):
    right = flight(free, about=(0.8, -0.5, 1.5))
    wrong, twist = changed(right, turned=[part]), right.base.twist
    assert not list(check_base(free, right, RAW))
    (found,) = check_base(free, wrong, RAW)
    assert (found.code, found.severity) == ("base_twist", "error")
    assert "Set twist = 'world' in [base]" in found.message
    assert found.evidence["off_world"] < 1e-3 * found.evidence["off"]
    off = np.sqrt(np.mean(np.sum((wrong.base.twist - twist)[:, part] ** 2, axis=1)))
    size = np.sqrt(np.mean(np.sum(twist[:, part] ** 2, axis=1)))
    assert [found.evidence[x] for x in ("off", "size")] == pytest.approx([off, size])
    unit, what = ("m/s", "linear") if part.start == 0 else ("rad/s", "angular")
    words = f"{what} velocity of the base differs by {off:.2g} {unit} (RMS) from the derivative of "
    assert f"{words}its pose, {size:.2g} {unit};" in found.message
    other = check_base(free, changed(right, 2.0, 2.0), RAW)[0]
    linear = np.sqrt(np.mean(np.sum(twist[:, :3] ** 2, axis=1)))  # m/s
    assert [other.evidence[x] for x in ("off", "size")] == pytest.approx([linear, linear])
    assert "Check the columns base_vx to base_wz, or remove them" in other.message


def test_axes_of_the_world_are_named_though_the_base_hardly_turns(free):
    """By 0.1 rad: the velocities differ by less than 30 % of the motion."""
    both = changed(flight(free), turned=[slice(0, 3), slice(3, 6)])
    found = list(check_twist(both, SignalSettings(cutoff=20.0)))
    assert len(found) == 2
    for finding in found:
        assert finding.message.endswith("Set twist = 'world' in [base]")
        assert 0.05 < finding.evidence["off"] / finding.evidence["size"] < 0.3


def test_a_twist_that_was_turned_though_it_had_the_axes_of_the_base_is_named(free):
    log = flight(free)
    twist = np.hstack([in_base(log.base.pose[:, 3:], log.base.twist[:, k : k + 3]) for k in (0, 3)])
    wrong = replace(log, base=replace(log.base, twist=twist))
    found = list(check_twist(wrong, SignalSettings(cutoff=20.0)))
    assert len(found) == 2
    assert all("Set twist = 'base' in [base]" in x.message for x in found)


def test_a_right_twist_shows_that_the_quaternion_is_the_inverse(free):
    log = flight(free)
    pose = log.base.pose * [1, 1, 1, -1, -1, -1, 1]
    inverse = replace(log, base=replace(log.base, pose=pose))
    (found,) = check_base(free, inverse, SignalSettings(cutoff=20.0))
    assert (found.code, found.severity) == ("base_orientation", "error")
    assert "it is the orientation of the world in the base" in found.message
    assert found.evidence["best"] < 0.02 * found.evidence["speed"]


# --- IMU ------------------------------------------------------------------------------------------
G = np.array([0.0, 0.0, -9.81])
TURN = pin.rpy.rpyToMatrix(0.4, 0.2, 1.0)  # axes of the IMU in the base
ALIKE = np.eye(3)
FRAME = ImuFrame(pin.Quaternion(TURN).coeffs(), np.zeros(3), G, np.zeros(3))


@pytest.fixture(scope="module")
def sway(robot):
    """Return the log of a robot whose trunk moves in all directions while its feet stand."""
    t = np.arange(0.0, 4.0, 0.02)
    waves = [np.sin(x * t) for x in (1.6, 2.3, 3.1)]
    pose = np.zeros((len(t), 7))
    pose[:, :3] = np.column_stack([0.02 * waves[2], 0.02 * waves[0], 0.25 + 0.01 * waves[1]])
    pose[:, 3:] = quaternions_of_angles(np.column_stack([0.2 * w for w in waves]))
    q = np.hstack([pose, np.tile([0.1, 0.8, -1.6], (len(t), 4))])
    every = np.ones((len(t), 4), dtype=bool)

    def positions(q):
        return link_positions(robot.pin_model, robot.configurations(q), FEET).reshape(-1, 12)

    target = positions(q)[:1]
    for _ in range(6):  # Newton
        J = constraint_jacobian(robot, q, every)[:, :, 6:]
        q[:, 7:] += np.linalg.solve(J, (target - positions(q))[..., None])[..., 0]
    assert np.abs(positions(q) - target).max() < 1e-9
    _, v, a = base_state(t, pose, None, None)
    f = a[:, :3] + np.cross(v[:, 3:], v[:, :3]) - in_base(pose[:, 3:], G)
    imu = ImuMotion(np.hstack([v[:, 3:], f]), FRAME)
    contacts = {foot: every[:, 0] for foot in FEET}
    joints = q[:, 7:]
    return Log(t, joints, 0 * joints, robot.joints, base=BaseMotion(pose, imu=imu),
               contacts=contacts)  # fmt: skip


def measured(log, change):
    """Return a log whose IMU measured changed values, with the axes of the IMU."""
    values = log.base.imu.values
    own = change(np.hstack([values[:, :3] @ TURN, values[:, 3:] @ TURN]))
    turned = np.hstack([own[:, :3] @ TURN.T, own[:, 3:] @ TURN.T])
    return replace(log, base=replace(log.base, imu=ImuMotion(turned, FRAME)))


def without_position(log, turn=ALIKE):
    """Return a log with an IMU only; turn: axes of the base by the orientation, in the base."""
    q = [pin.Quaternion(pin.XYZQUATToSE3(x).rotation @ turn).coeffs() for x in log.base.pose]
    pose = np.hstack([np.zeros((len(q), 3)), np.array(q)])
    return replace(log, base=replace(log.base, pose=pose))


def test_a_right_imu_has_no_finding(robot, sway):
    for log in (sway, without_position(sway)):
        assert not list(check_base(robot, log, RAW))
        assert not list(check_base(replace(robot, constraints=()), log, RAW))


def scaled(angular, linear):
    return lambda values: values * np.repeat([angular, linear], 3)


FAULTS = {
    "axes": (lambda x: np.hstack([x[:, [1, 0, 2]], x[:, [4, 3, 5]]]) * ([1, -1, 1] * 2),
             {"imu_axes": "from the axes of the link", "imu_gravity": "deg from the vertical"}),
    "gyroscope": (lambda x: np.hstack([x[:, [0, 2, 1]] * [-1, 1, 1], x[:, 3:]]),
                  {"imu_axes": "from the axes of the link"}),
    "degrees": (scaled(180 / np.pi, 1.0), {"imu_axes": "it is in deg/s"}),
    "reversed": (scaled(1.0, -1.0), {"imu_gravity": "its sign is reversed"}),
    "g": (scaled(1.0, 1 / 9.81), {"imu_gravity": "it is in units of g"}),
    "scale": (scaled(1.0, 1.3), {"imu_gravity": "its scale is wrong"}),
    "subtracted": (lambda x: np.hstack([x[:, :3], x[:, 3:] - x[:, 3:].mean(axis=0)]),
                   {"imu_gravity": "gravity was subtracted"}),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_an_imu_are_named(robot, sway, fault):
    change, wanted = FAULTS[fault]
    found = list(check_base(robot, measured(sway, change), RAW))
    assert {x.code for x in found} == set(wanted)
    for finding in found:
        assert finding.severity == "error"
        assert wanted[finding.code] in finding.message


def test_the_mean_specific_force_in_the_world_is_stated_for_a_robot_that_drives_a_curve(free):
    """1.5 m/s forwards, 0.9 rad/s about the vertical: the centripetal acceleration is in it."""
    t = 4.0 + 0.02 * np.arange(150)
    yaw = 0.9 * (t - 4.0)
    pose = np.zeros((len(t), 7))
    pose[:, :2] = 1.5 / 0.9 * np.column_stack([np.sin(yaw), 1.0 - np.cos(yaw)])
    pose[:, 3:] = quaternions_of_angles(np.column_stack([0 * t + 0.05, 0 * t - 0.1, yaw]))
    _, v, a = base_state(t, pose, None, None)
    f = a[:, :3] + np.cross(v[:, 3:], v[:, :3]) - in_base(pose[:, 3:], G)
    q = np.zeros((len(t), 12))
    log = Log(t, q, q, free.joints, base=BaseMotion(pose, imu=ImuMotion(
        np.hstack([v[:, 3:], 1.4 * f]), FRAME)))  # fmt: skip
    (found,) = check_base(free, log, RAW)
    world = [pin.XYZQUATToSE3(x).rotation @ y for x, y in zip(pose, f, strict=True)]
    mean = 1.4 * np.mean(world, axis=0)
    size = np.linalg.norm(mean)
    angle = np.degrees(np.arccos(mean[2] / size))
    assert angle > 4.0
    assert found.evidence["size"] == pytest.approx(size, rel=5e-3)
    assert found.evidence["angle"] == pytest.approx(angle, abs=0.3)
    assert f"is {size:.3g} m/s^2 on average, {angle:.0f} deg from the vertical" in found.message
    assert "expected 9.81 m/s^2 upwards: its scale is wrong" in found.message
    assert not list(check_base(free, log.window(4.0, 5.9), RAW))  # too short for a mean


@pytest.mark.parametrize("has_contacts", [True, False])
@pytest.mark.parametrize(("change", "words"), QUATERNIONS)
def test_another_quaternion_is_named_without_a_position(robot, sway, change, words, has_contacts):
    """By the feet relative to each other, or by the gyroscopes."""
    log = without_position(sway)
    pose = log.base.pose.copy()
    pose[:, 3:] = change(pose[:, 3:])
    model = robot if has_contacts else replace(robot, constraints=())
    wrong = replace(log, base=replace(log.base, pose=pose))
    found = [x for x in check_base(model, wrong, RAW) if x.code != "imu_gravity"]
    assert [(x.code, x.severity) for x in found] == [("base_orientation", "error")]
    assert words in found[0].message
    assert found[0].evidence["best"] < 0.02 * found[0].evidence["speed"]


# --- contacts -------------------------------------------------------------------------------------
PAIR = (FEET[0], FEET[3])


@pytest.fixture(scope="module")
def walker(robot):
    return replace(robot, constraints=(Contact(PAIR[0]), Contact(PAIR[1], "surface")))


@pytest.fixture(scope="module")
def walk(walker):
    """Return a log in which the trunk drifts and the feet stand or swing in turn."""
    t = np.arange(0.0, 6.0, 0.01)
    q = np.zeros((len(t), 12))
    swing = np.sin(2 * np.pi * 0.9 * t)  # both stand while it is 0: half of the time
    for foot, sign in zip(PAIR, (1.0, -1.0), strict=True):
        joint = walker.joints.index(f"{foot[:2]}_KFE")
        q[:, joint] = np.maximum(sign * swing, 0.0)
    still = pin.SE3(pin.rpy.rpyToMatrix(0.1, 0.2, 1.5), np.ones(3))
    pose = np.tile(pin.SE3ToXYZQUAT(still), (len(t), 1))
    contacts = {foot: q[:, walker.joints.index(f"{foot[:2]}_KFE")] == 0.0 for foot in PAIR}
    return Log(t, q, 0 * q, walker.joints, base=BaseMotion(pose), contacts=contacts)


def test_a_clean_walk_has_no_finding(walker, walk):
    assert not list(check_base(walker, walk, RAW))


def test_each_contact_has_its_own_speed_whatever_is_before_it(walker, walk):
    """A surface before a point; both feet stand always, and the trunk slides and turns."""
    contacts = [Contact(PAIR[1], "surface", always=True), Contact(PAIR[0], always=True)]
    other = replace(walker, constraints=tuple(contacts))
    t, pose = walk.t, walk.base.pose.copy()
    pose[:, 0] += 0.3 * np.sin(2 * t)
    log = replace(walk, q=0 * walk.q, base=BaseMotion(pose), contacts={})
    found = list(check_base(other, log, RAW))
    assert [f.code for f in found] == ["moving_contact"] * 2
    speed = np.sqrt(np.mean(np.gradient(pose[:, 0], t) ** 2))
    assert [f.evidence["speed"] for f in found] == pytest.approx([speed] * 2, rel=1e-3)
    for foot, f in zip(PAIR[::-1], found, strict=True):
        assert f"the link {foot} moves at {speed:.2g} m/s (RMS) while it is in contact" in f.message


@pytest.fixture(scope="module", params=[0.7, 2.3])
def ball(walker, request):
    """Return a log of a robot that rolls on one foot, a ball of 25 mm, and lifts it at times."""
    t = np.arange(0.0, 6.0, 0.01)
    angle = 0.3 * np.sin(2.0 * t)
    height = np.maximum(np.sin(5.0 * t) - 0.8, 0.0)
    data = walker.pin_model.createData()
    pin.framesForwardKinematics(walker.pin_model, data, pin.neutral(walker.pin_model))
    centre = data.oMf[walker.pin_model.getFrameId(PAIR[0], pin.FrameType.BODY)].translation
    pose = []
    for x, lift in zip(angle, height, strict=True):
        turned = pin.rpy.rpyToMatrix(0.0, x, request.param) @ pin.rpy.rpyToMatrix(0.5 * x, 0.0, 0.0)
        pose.append(pin.SE3ToXYZQUAT(pin.SE3(turned, -turned @ centre + [0, 0, lift])))
    log = Log(t, np.zeros((len(t), 12)), np.zeros((len(t), 12)), walker.joints,
              base=BaseMotion(np.array(pose)), contacts={PAIR[0]: height == 0.0})  # fmt: skip
    motion = process(log, replace(RAW, velocity="differentiated", acceleration="differentiated"))
    R = np.array([pin.XYZQUATToSE3(x).rotation for x in log.base.pose])
    w = np.einsum("kij,kj->ki", R, motion.v[:, 3:6])
    pace = 0.025 * np.cross(w, [0.0, 0.0, 1.0])
    way = np.cumsum(0.5 * (pace[1:] + pace[:-1]), axis=0) * 0.01
    moved = log.base.pose.copy()
    moved[1:, :3] += way
    return replace(log, base=BaseMotion(moved))


def test_the_radius_of_a_rolling_foot_is_found(walker, ball):
    def found(radius):
        contacts = (Contact(PAIR[0], radius=radius),)
        return list(check_base(replace(walker, constraints=contacts), ball, RAW))

    (finding,) = found(0.0)
    assert finding.code == "rolling_contact"
    assert finding.evidence["radius"] == pytest.approx(0.025, rel=0.02)
    assert finding.evidence["after"] < 0.1 * finding.evidence["before"]
    assert "Set radius = 0.025" in finding.message
    (finding,) = found(0.01)
    assert finding.evidence["radius"] == pytest.approx(0.025, rel=0.02)
    assert not found(0.025)


# --- measured forces ------------------------------------------------------------------------------
PARTS = ("fx", "fy", "fz")


@pytest.fixture(scope="module")
def stander(robot):
    return replace(robot, constraints=tuple(Contact(foot, measured=PARTS) for foot in FEET))


@pytest.fixture(scope="module")
def steps(stander):
    """Return a log with forces of a robot on its feet whose bodies differ from the URDF's."""
    rng = np.random.default_rng(3)
    other = with_other_bodies(stander, rng)
    motion = stand(stander, np.tile([0.0, 0.8, -1.6], 4), 0.25, rng, parts=2)
    return recorded(
        other, other.standard_parameters(), motion, rng, rate=80.0, duration=6.0,
        acceleration=False,
    )  # fmt: skip


def wrench_findings(model, steps):
    return list(check_wrenches(model, steps.name, process(steps, SLOW)))


def caused_and_left(model, steps):
    """Return J^T f and W pi, shape (N, n_rows)."""
    motion, whole = process(steps, SLOW), np.ones((1, len(FEET)), dtype=bool)
    torque = predict(replace(model, constraints=()), [model.standard_parameters()], motion)[0]
    J = constraint_jacobian(model, motion.q, np.repeat(whole, len(motion.t), axis=0))
    return np.einsum("kmj,km->kj", J, motion.wrenches), torque


def unexplained(model, steps, factor=1.0):
    """Return the RMS force of W pi - factor J^T f of the base."""
    caused, torque = caused_and_left(model, steps)
    return np.sqrt(np.mean(np.sum((torque - factor * caused)[:, :3] ** 2, axis=1)))


def times(steps, factor):
    return replace(steps, wrenches={x: factor * y for x, y in steps.wrenches.items()})


def test_right_forces_have_no_finding(stander, steps):
    assert not list(check_base(stander, steps, SLOW))


@pytest.mark.parametrize(
    ("size", "words", "factor"),
    [
        (-1.0, "their sign is reversed", -1.0),
        (1e-3, "another unit, kN", 1e3),
        (1 / 9.81, "another unit, kgf", 9.81),
        (0.2, "another unit. Correct", 5.0),
    ],
)
def test_a_fault_of_the_columns_is_named(stander, steps, size, words, factor):
    wrong = times(steps, size)
    (finding,) = wrench_findings(stander, wrong)
    assert (finding.code, finding.severity) == ("measured_wrench", "error")
    assert words in finding.message
    assert finding.evidence["factor"] == pytest.approx(factor, rel=0.2)
    assert finding.evidence["best"] < 0.3 * 2.5 * 9.81  # what masses of the URDF leave
    assert finding.evidence["force"] == pytest.approx(unexplained(stander, wrong))
    caused, left = (x[:, :6] for x in caused_and_left(stander, wrong))
    if factor > 1.0:  # least squares of force and moment together
        factor = np.sum(caused * left) / np.sum(caused**2)
    assert finding.evidence["factor"] == pytest.approx(factor)
    assert finding.evidence["best"] == pytest.approx(unexplained(stander, wrong, factor))


def test_vertical_forces_alone_show_their_sign(stander, steps):
    contacts = [Contact(foot, "point", ("fz",)) for foot in FEET]
    model = replace(stander, constraints=tuple(contacts))
    vertical = replace(
        steps, wrenches={f"fz {foot}": steps.wrenches[f"fz {foot}"] for foot in FEET}
    )
    assert not wrench_findings(model, vertical)
    (finding,) = wrench_findings(model, times(vertical, -1.0))
    assert "their sign is reversed" in finding.message
