"""Findings on an IMU: turned axes, units, gravity; and feet that slip."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

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
from robotid.diagnosis.logs.base_checks import check_base
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.robot.constraints import link_positions
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
RAW = SignalSettings(cutoff=None, trim=0.0)
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
             {"imu_axes": "are not those of the link", "imu_gravity": "deg from the vertical"}),
    "gyroscope": (lambda x: np.hstack([x[:, [0, 2, 1]] * [-1, 1, 1], x[:, 3:]]),
                  {"imu_axes": "are not those of the link"}),
    "degrees": (scaled(180 / np.pi, 1.0), {"imu_axes": "it is in deg/s"}),
    "reversed": (scaled(1.0, -1.0), {"imu_gravity": "its sign is reversed"}),
    "g": (scaled(1.0, 1 / 9.81), {"imu_gravity": "it is in units of g"}),
    "scale": (scaled(1.0, 1.3), {"imu_gravity": "its scale is wrong"}),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_an_imu_are_named(robot, sway, fault):
    change, wanted = FAULTS[fault]
    found = list(check_base(robot, measured(sway, change), RAW))
    assert {x.code for x in found} == set(wanted)
    for finding in found:
        assert finding.severity == "error"
        assert wanted[finding.code] in finding.message


def test_the_mean_specific_force_in_the_world_is_stated_for_a_robot_that_drives_a_curve():
    """1.5 m/s forwards, 0.9 rad/s about the vertical: the centripetal acceleration is in it."""
    free = RobotModel.from_urdf(example_urdf("solo12.urdf"), free_flyer=True, terms=())
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
    assert "wanted 9.81 m/s^2 upwards: its scale is wrong" in found.message
    assert not list(check_base(free, log.window(4.0, 5.9), RAW))  # too short for a mean


@pytest.mark.parametrize("has_contacts", [True, False])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda q: np.roll(q, 1, axis=1), "its order is qw qx qy qz: state"),
        (lambda q: q * [-1.0, -1.0, -1.0, 1.0], "it is the orientation of the world in the base"),
    ],
)
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
