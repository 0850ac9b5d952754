"""Findings on the motion of a floating base and on contacts."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.special import stdtrit

from robotid.constrained.contacts import _radius, _rolling, check_base, flag_delay
from robotid.judgement.verdict import warnings_of
from robotid.logs.base import BaseMotion, base_state
from robotid.logs.data import Log
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import process
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


@pytest.mark.parametrize(("rows", "delay"), [(6, "+0.06"), (-5, "-0.05")])
@pytest.mark.parametrize("foot", FEET)
def test_a_shift_of_flags_is_found(robot, walk, foot, rows, delay):
    flags = {x: np.roll(y, rows if x == foot else 0) for x, y in walk.contacts.items()}
    (found,) = check_base(robot, replace(walk, contacts=flags), RAW)
    assert found.code == "contact_delay"
    assert found.severity == "warning"
    assert found.evidence["delay"] == pytest.approx(0.01 * rows, abs=0.011)
    assert f"the flags of the contact {foot} are delayed by {delay[0]}" in found.message


def steps(late_lift, late_touch, slips=0):
    """Return time, flags and speed of a foot that swings from 0.5 to 0.9 s of each second."""
    t = 7.0 + 0.002 * np.arange(3000)
    phase = t % 1.0
    speed = np.where((phase > 0.499) & (phase < 0.899), 0.8, 0.003)
    flags = (phase < 0.499 + late_lift) | (phase > 0.899 + late_touch)
    for k in range(slips):  # the foot stops 0.1 s after two of six touch-downs
        speed[(t > 7.899 + 3 * k) & (t < 7.999 + 3 * k)] = 0.8
    return t, flags, speed


@pytest.mark.parametrize("late", [0.08, -0.08])
def test_the_delay_of_short_swings_is_found_beside_feet_that_hesitate(late):
    """Swings of 0.12 s are shorter than twice the delay; in each second one the foot waits."""
    t = 3.0 + 0.002 * np.arange(2500)
    k = np.arange(1, 9)[:, None]
    pairs = 3.2001 + 0.5 * k + np.array([0.0, 0.12])
    moves = ((t > pairs[:, :1]) & (t < pairs[:, 1:])).any(axis=0)
    lifted = ((t > pairs[:, :1] + late) & (t < pairs[:, 1:] + late)).any(axis=0)
    waits = ((t > 3.08 + 1.0 * k[:3]) & (t < 3.12 + 1.0 * k[:3])).any(axis=0)
    found = flag_delay(t, ~lifted, np.where(moves | waits, 0.6, 0.002), spread=0.0)
    assert found[0] == pytest.approx(late, abs=2e-3)


def test_delayed_flags_are_late_at_lift_offs_and_at_touch_downs():
    found = flag_delay(*steps(0.06, 0.06), spread=0.0)
    assert found[0] == pytest.approx(0.06, abs=1e-3)
    assert found[1] == pytest.approx(stdtrit(9, 0.975) * 0.002 / np.sqrt(11), rel=0.1)
    delay, error = flag_delay(*steps(0.06, 0.04), spread=0.02)
    assert delay == pytest.approx(0.05, abs=1e-3)  # half of the difference, half of the spread
    assert error == pytest.approx(0.01 + 0.01 + stdtrit(9, 0.975) * 0.002 / np.sqrt(11), abs=1e-3)
    assert flag_delay(*steps(-0.08, -0.06), spread=0.0)[0] == pytest.approx(-0.07, abs=1e-3)
    assert flag_delay(*steps(0.06, 0.06, slips=2), spread=0.0)[0] == pytest.approx(0.06, abs=1e-3)


def test_what_differs_at_lift_offs_and_touch_downs_is_no_delay():
    for late_lift, late_touch in ((0.06, -0.06), (-0.08, 0.02), (0.0, -0.05), (0.03, 0.005)):
        assert flag_delay(*steps(late_lift, late_touch), spread=0.02) is None
    assert flag_delay(*steps(0.015, 0.015), spread=0.04) is None  # within the filter
    assert flag_delay(*steps(0.0, 0.0, slips=2), spread=0.0) is None


def test_a_vibration_in_contact_is_no_slip_and_the_same_mean_speed_is(robot, walk):
    """Both feet stand always; one of them moves relative to the other."""
    contacts = tuple(Contact(foot, "surface", always=True) for foot in FEET)
    other, t = replace(robot, constraints=contacts), walk.t
    joint = robot.joints.index("HR_HFE")

    def found(angle):
        q = np.zeros((len(t), 12))
        q[:, joint] = angle
        return list(check_base(other, replace(walk, q=q, contacts={}), RAW))

    assert not found(0.004 * np.sin(2 * np.pi * 12.0 * t))
    assert "slipping_foot" in [f.code for f in found(0.25 * t)]


def test_a_slipping_foot_is_found_with_its_speed(robot, walk):
    pose = walk.base.pose.copy()
    pose[:, 1] += 0.4 * walk.t  # [m/s] the whole robot slides
    found = list(check_base(robot, replace(walk, base=BaseMotion(pose)), RAW))
    assert [f.code for f in found] == ["moving_contact"] * 2
    assert [f.evidence["speed"] for f in found] == pytest.approx([0.4, 0.4], rel=0.01)
    assert "the link HR_FOOT moves at 0.4 m/s" in found[1].message


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


def test_a_shift_of_flags_is_stated_with_the_speeds_before_and_after_it(robot, walk):
    flags = {x: np.roll(y, 8 * (x == FEET[0])) for x, y in walk.contacts.items()}
    pose = walk.base.pose.copy()
    pose[:, 1] += 0.09 * walk.t  # [m/s] less than a slip that is reported
    log = replace(walk, base=BaseMotion(pose), contacts=flags)
    (found,) = check_base(robot, log, RAW)
    frame = robot.pin_model.getFrameId(FEET[0], pin.FrameType.BODY)
    data, places = robot.pin_model.createData(), []
    for q in robot.configurations(np.hstack([pose, walk.q])):
        pin.framesForwardKinematics(robot.pin_model, data, q)
        places.append(data.oMf[frame].translation.copy())
    squares = np.sum(np.gradient(np.array(places), walk.t, axis=0) ** 2, axis=1)
    now, then = (np.sqrt(squares[x[FEET[0]]].mean()) for x in (flags, walk.contacts))
    words = found.message.split("its speed in contact is ")[1].split(" m/s")
    assert float(words[0]) == pytest.approx(then, abs=0.03)
    assert float(words[1].removeprefix(" instead of ")) == pytest.approx(now, rel=0.06)


@pytest.fixture(scope="module")
def ball(robot):
    """Return a log of a robot that rolls on one foot, a ball of 25 mm, and lifts it at times."""
    t = np.arange(0.0, 6.0, 0.01)
    angle = 0.3 * np.sin(2.0 * t)
    height = np.maximum(np.sin(5.0 * t) - 0.8, 0.0)
    data = robot.pin_model.createData()
    pin.framesForwardKinematics(robot.pin_model, data, pin.neutral(robot.pin_model))
    centre = data.oMf[robot.pin_model.getFrameId(FEET[0], pin.FrameType.BODY)].translation
    pose = []
    for x, lift in zip(angle, height, strict=True):
        turned = pin.rpy.rpyToMatrix(0.0, x, 0.7) @ pin.rpy.rpyToMatrix(0.5 * x, 0.0, 0.0)
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


def test_feet_of_one_radius_are_one_finding():
    feet = [(0.018, "RL", 0.05, 0.002), (0.0182, "FR", 0.07, 0.001), (0.0197, "FL", 0.06, 0.004),
            (0.03, "RR", 0.08, 0.003)]  # fmt: skip
    three, one = _rolling("run.csv", feet)
    assert "the links FL, FR, RL roll on the ground as balls of radius 0.0182 m" in three.message
    assert "at most 0.004 m/s, with the stated radius at most 0.07 m/s" in three.message
    assert three.evidence == {"radius": 0.0182, "before": 0.07, "after": 0.004}
    assert "the link RR rolls on the ground as a ball of radius 0.0300 m" in one.message
    assert "is 0.003 m/s, with the stated radius 0.08 m/s" in one.message
    assert [f.where for f in (three, one)] == ["run.csv", "run.csv"]
    (reason,) = warnings_of([three, one], ["FL_HAA"])  # one line
    assert reason.message.startswith("run.csv: feet roll as balls of a radius that is not stated")
    assert list(_rolling("run.csv", [])) == []


@pytest.mark.parametrize("axis", [0, 1])
def test_a_foot_may_roll_along_either_axis(axis):
    t = np.arange(0.0, 2.0, 0.01)
    rolls = np.zeros((len(t), 3))
    rolls[:, axis] = np.sin(5.0 * t)  # the centre's speed per radius, along one axis only
    v = 0.02 * rolls
    radius, _, before, after = _radius(Contact(FEET[0], radius=0.01), v, rolls)
    assert radius == pytest.approx(0.03)
    assert before == pytest.approx(np.median(np.abs(v[:, axis])))
    assert after == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("part", [slice(0, 3), slice(3, 6)])
def test_a_twist_with_the_axes_of_the_world_is_found(robot, walk, part):
    t = walk.t
    pose = np.array(
        [
            pin.SE3ToXYZQUAT(
                pin.SE3(pin.rpy.rpyToMatrix(0.8, -0.5, 1.5 + 0.3 * np.sin(3 * x)),
                        np.array([np.sin(x), np.cos(2 * x), 0.0]))
            )
            for x in t
        ]
    )  # fmt: skip
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
    assert "Check the columns base_vx to base_wz, or remove them" in other.message
