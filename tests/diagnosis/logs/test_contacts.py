"""Findings on the motion of a floating base and on contacts."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers.legged import with_other_bodies
from helpers.stands import recorded, stand

from robotid.data.base_motion import BaseMotion, base_state
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.logs.base_checks import check_base, check_wrenches
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.dynamics.torque import predict
from robotid.robot.constraints import Contact
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_FOOT", "HR_FOOT")
RAW = SignalSettings(cutoff=None, trim=0.0)


@pytest.fixture(scope="module")
def robot():
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=(),
        constraints=[Contact(FEET[0]), Contact(FEET[1], "surface")],
    )  # fmt: skip


@pytest.fixture(scope="module")
def walk(robot):
    """Return a log in which the trunk drifts and the feet stand or swing in turn."""
    t = np.arange(0.0, 6.0, 0.01)
    q = np.zeros((len(t), 12))
    swing = np.sin(2 * np.pi * 0.9 * t)  # both stand while it is 0: half of the time
    for foot, sign in zip(FEET, (1.0, -1.0), strict=True):
        joint = robot.joints.index(f"{foot[:2]}_KFE")
        q[:, joint] = np.maximum(sign * swing, 0.0)
    still = pin.SE3(pin.rpy.rpyToMatrix(0.1, 0.2, 1.5), np.ones(3))
    pose = np.tile(pin.SE3ToXYZQUAT(still), (len(t), 1))
    contacts = {foot: q[:, robot.joints.index(f"{foot[:2]}_KFE")] == 0.0 for foot in FEET}
    return Log(t, q, 0 * q, robot.joints, base=BaseMotion(pose), contacts=contacts)


def test_a_clean_walk_has_no_finding(robot, walk):
    assert not list(check_base(robot, walk, RAW))


def test_each_contact_has_its_own_speed_whatever_is_before_it(robot, walk):
    """A surface before a point; both feet stand always, and the trunk slides and turns."""
    contacts = [Contact(FEET[1], "surface", always=True), Contact(FEET[0], always=True)]
    other = replace(robot, constraints=tuple(contacts))
    t, pose = walk.t, walk.base.pose.copy()
    pose[:, 0] += 0.3 * np.sin(2 * t)
    log = replace(walk, q=0 * walk.q, base=BaseMotion(pose), contacts={})
    found = list(check_base(other, log, RAW))
    assert [f.code for f in found] == ["moving_contact"] * 2
    speed = np.sqrt(np.mean(np.gradient(pose[:, 0], t) ** 2))
    assert [f.evidence["speed"] for f in found] == pytest.approx([speed] * 2, rel=1e-3)
    for foot, f in zip(FEET[::-1], found, strict=True):
        assert f"the link {foot} moves at {speed:.2g} m/s (RMS) while it is in contact" in f.message


@pytest.fixture(scope="module", params=[0.7, 2.3])
def ball(robot, request):
    """Return a log of a robot that rolls on one foot, a ball of 25 mm, and lifts it at times."""
    t = np.arange(0.0, 6.0, 0.01)
    angle = 0.3 * np.sin(2.0 * t)
    height = np.maximum(np.sin(5.0 * t) - 0.8, 0.0)
    data = robot.pin_model.createData()
    pin.framesForwardKinematics(robot.pin_model, data, pin.neutral(robot.pin_model))
    centre = data.oMf[robot.pin_model.getFrameId(FEET[0], pin.FrameType.BODY)].translation
    pose = []
    for x, lift in zip(angle, height, strict=True):
        turned = pin.rpy.rpyToMatrix(0.0, x, request.param) @ pin.rpy.rpyToMatrix(0.5 * x, 0.0, 0.0)
        pose.append(pin.SE3ToXYZQUAT(pin.SE3(turned, -turned @ centre + [0, 0, lift])))
    log = Log(t, np.zeros((len(t), 12)), np.zeros((len(t), 12)), robot.joints,
              base=BaseMotion(np.array(pose)), contacts={FEET[0]: height == 0.0})  # fmt: skip
    motion = process(log, replace(RAW, velocity="differentiated", acceleration="differentiated"))
    R = np.array([pin.XYZQUATToSE3(x).rotation for x in log.base.pose])
    w = np.einsum("kij,kj->ki", R, motion.v[:, 3:6])
    pace = 0.025 * np.cross(w, [0.0, 0.0, 1.0])
    way = np.cumsum(0.5 * (pace[1:] + pace[:-1]), axis=0) * 0.01
    moved = log.base.pose.copy()
    moved[1:, :3] += way
    return replace(log, base=BaseMotion(moved))


def test_the_radius_of_a_rolling_foot_is_found(robot, ball):
    def found(radius):
        contacts = (Contact(FEET[0], radius=radius),)
        return list(check_base(replace(robot, constraints=contacts), ball, RAW))

    (finding,) = found(0.0)
    assert finding.code == "rolling_contact"
    assert finding.evidence["radius"] == pytest.approx(0.025, rel=0.02)
    assert finding.evidence["after"] < 0.1 * finding.evidence["before"]
    assert "State radius = 0.025" in finding.message
    (finding,) = found(0.01)
    assert finding.evidence["radius"] == pytest.approx(0.025, rel=0.02)
    assert not found(0.025)


@pytest.mark.parametrize("part", [slice(0, 3), slice(3, 6)])
def test_a_twist_with_the_axes_of_the_world_is_found(robot, walk, part):
    t = walk.t
    R = [pin.rpy.rpyToMatrix(0.8, -0.5, 1.5 + 0.3 * np.sin(3 * x)) for x in t]
    p = np.column_stack([np.sin(t), np.cos(2 * t), 0.0 * t])
    pose = np.array([pin.SE3ToXYZQUAT(pin.SE3(*x)) for x in zip(R, p, strict=True)])
    twist = base_state(t, pose, None, None)[1]
    right = replace(walk, base=BaseMotion(pose, twist), contacts={})
    free = replace(robot, constraints=())
    assert not list(check_base(free, right, RAW))
    turned = twist.copy()
    for k, x in enumerate(pose):
        turned[k, part] = pin.XYZQUATToSE3(x).rotation @ twist[k, part]
    (found,) = check_base(free, replace(right, base=BaseMotion(pose, turned)), RAW)
    assert found.code == "base_twist"
    assert found.severity == "error"
    assert "State twist = 'world' in [base]" in found.message
    assert found.evidence["off_world"] < 1e-3 * found.evidence["off"]
    off = np.sqrt(np.mean(np.sum((turned - twist)[:, part] ** 2, axis=1)))
    assert found.evidence["off"] == pytest.approx(off)
    size = np.sqrt(np.mean(np.sum(twist[:, part] ** 2, axis=1)))
    assert found.evidence["size"] == pytest.approx(size)
    unit, what = ("m/s", "linear") if part.start == 0 else ("rad/s", "angular")
    words = f"{what} velocity of the base differs by {off:.2g} {unit} from that of its pose, "
    assert f"{words}{size:.2g} {unit} (RMS)" in found.message
    doubled = replace(right, base=BaseMotion(pose, 2.0 * twist))
    other = next(check_base(free, doubled, RAW))
    linear = np.sqrt(np.mean(np.sum(twist[:, :3] ** 2, axis=1)))  # m/s
    assert [other.evidence[x] for x in ("off", "size")] == pytest.approx([linear, linear])
    assert "Check the columns base_vx to base_wz, or remove them" in other.message


# --- measured forces ------------------------------------------------------------------------------
SLOW = SignalSettings(cutoff=4.0)
FOUR, PARTS = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"), ("fx", "fy", "fz")


@pytest.fixture(scope="module")
def stander():
    contacts = [Contact(foot, measured=PARTS) for foot in FOUR]
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=(), constraints=contacts
    )


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


def parts(model, steps):
    """Return J^T f and W pi, shape (N, n_rows)."""
    motion, whole = process(steps, SLOW), np.ones((1, len(FOUR)), dtype=bool)
    torque = predict(replace(model, constraints=()), [model.standard_parameters()], motion)[0]
    J = constraint_jacobian(model, motion.q, np.repeat(whole, len(motion.t), axis=0))
    return np.einsum("kmj,km->kj", J, motion.wrenches), torque


def unexplained(model, steps, factor=1.0):
    """Return the RMS force of W pi - factor J^T f of the base."""
    caused, torque = parts(model, steps)
    return np.sqrt(np.mean(np.sum((torque - factor * caused)[:, :3] ** 2, axis=1)))


def scaled(steps, factor):
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
    wrong = scaled(steps, size)
    (finding,) = wrench_findings(stander, wrong)
    assert (finding.code, finding.severity) == ("measured_wrench", "error")
    assert words in finding.message
    assert finding.evidence["factor"] == pytest.approx(factor, rel=0.2)
    assert finding.evidence["best"] < 0.3 * 2.5 * 9.81  # what masses of the URDF leave
    assert finding.evidence["force"] == pytest.approx(unexplained(stander, wrong))
    caused, left = (x[:, :6] for x in parts(stander, wrong))
    if factor > 1.0:  # least squares of force and moment together
        factor = np.sum(caused * left) / np.sum(caused**2)
    assert finding.evidence["factor"] == pytest.approx(factor)
    assert finding.evidence["best"] == pytest.approx(unexplained(stander, wrong, factor))


def test_vertical_forces_alone_show_their_sign(stander, steps):
    contacts = [Contact(foot, "point", ("fz",)) for foot in FOUR]
    model = replace(stander, constraints=tuple(contacts))
    vertical = replace(
        steps, wrenches={f"fz {foot}": steps.wrenches[f"fz {foot}"] for foot in FOUR}
    )
    assert not wrench_findings(model, vertical)
    (finding,) = wrench_findings(model, scaled(vertical, -1.0))
    assert "their sign is reversed" in finding.message
