"""Findings on the motion of a floating base and on contacts."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from scipy.special import stdtrit

from robotid.data.base_motion import BaseMotion, base_state
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.logs.contacts import (
    _check_flags,
    _contact_jacobian,
    _flags,
    _loaded,
    _of_pairs,
    _radius,
    _relative,
    _rolling,
    check_base,
    flag_delay,
)
from robotid.diagnosis.logs.slips import check_slip
from robotid.diagnosis.verdict.verdict import warnings_of
from robotid.robot.constraints import Contact, frame_id
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
    assert found[1] == pytest.approx(stdtrit(10, 0.975) * 0.002 / np.sqrt(12), rel=0.01)
    delay, error = flag_delay(*steps(0.06, 0.04), spread=0.02)
    assert delay == pytest.approx(0.05, abs=1e-3)  # half of the difference, half of the spread
    assert error == pytest.approx(0.01 + 0.01 + stdtrit(10, 0.975) * 0.002 / np.sqrt(12), abs=1e-3)
    assert flag_delay(*steps(-0.08, -0.06), spread=0.0)[0] == pytest.approx(-0.07, abs=1e-3)
    assert flag_delay(*steps(0.06, 0.06, slips=2), spread=0.0)[0] == pytest.approx(0.06, abs=1e-3)


def test_what_differs_at_lift_offs_and_touch_downs_is_no_delay():
    for late_lift, late_touch in ((0.06, -0.06), (-0.08, 0.02), (0.0, -0.05), (0.03, 0.005)):
        assert flag_delay(*steps(late_lift, late_touch), spread=0.02) is None
    assert flag_delay(*steps(0.015, 0.015), spread=0.04) is None  # within the filter
    assert flag_delay(*steps(0.0, 0.0, slips=2), spread=0.0) is None


@pytest.mark.parametrize(("slides", "is_found"), [(0.38, True), (0.42, False)])  # of 0.8 m/s
def test_a_foot_that_slides_at_half_of_its_speed_in_the_air_shows_no_delay(slides, is_found):
    t, flags, speed = steps(0.06, 0.06)
    found = flag_delay(t, flags, speed.clip(slides), spread=0.0)
    assert (found is not None) == is_found


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
    linear = np.sqrt(np.mean(np.sum(twist[:, :3] ** 2, axis=1)))  # m/s
    assert [other.evidence[x] for x in ("off", "size")] == pytest.approx([linear, linear])
    assert "Check the columns base_vx to base_wz, or remove them" in other.message


def test_a_foot_of_measured_force_is_on_the_ground_above_a_tenth_of_its_largest_force():
    t = 3.0 + 0.1 * np.arange(4)
    contact = Contact("foot", measured=("fx", "fz"))
    forces = {"fx foot": np.array([60.0, -7.0, 0.0, 3.0]), "fz foot": np.array([80.0, 8, 9, 9.9])}
    log = Log(t, np.zeros((4, 1)), np.zeros((4, 1)), ("a",), wrenches=forces)
    times = np.array([3.3, 3.25, 3.1, 3.0])
    assert _loaded(contact, log, times).tolist() == [True, False, True, True]


def test_flags_are_of_measured_forces_always_or_those_found():
    t = 3.0 + np.arange(5.0)
    kinds = {"is_measured": False, "always": False}
    feet = [SimpleNamespace(frame=name, measured=("fz",), **kinds | own) for name, own in (
        ("held", {"always": True}), ("pressed", {"is_measured": True}), ("found", {}), ("no", {}),
    )]  # fmt: skip
    zeros = np.zeros((5, 1))
    log = Log(t, zeros, zeros, ("a",), wrenches={"fz pressed": np.r_[0.0, 9.0, 1.0, 0.5, -5.0]})
    whole = replace(log, contacts={"found": np.r_[True, True, False, False, True]})
    flags = _flags(SimpleNamespace(contacts=feet), log, whole, t)
    assert flags.T.astype(int).tolist() == [
        [1, 1, 1, 1, 1], [0, 1, 1, 0, 1], [1, 1, 0, 0, 1], [1, 1, 1, 1, 1],
    ]  # fmt: skip


def slipping(cutoff, speed):
    """Return the finding on a foot that stands from 2 to 5 s of 10 s, and slips in between."""
    t = 2.0 + 0.01 * np.arange(1000)
    log = Log(t, np.zeros((1000, 1)), np.zeros((1000, 1)), ("a",), path="a/walk.csv")
    flags = (t >= 3.995) & (t < 6.995)
    rng, both = np.random.default_rng(0), np.zeros((2, 1000, 3))
    both[:, 303:401] += [[0.6 * speed, -0.8 * speed, 0.0]]
    both[1] += 0.3  # the other way to measure it is never the slower one
    return list(check_slip("foot", log, flags, t, both + 0.001 * rng.normal(size=both.shape),
                            SignalSettings(cutoff=cutoff)))  # fmt: skip


def test_a_slip_is_stated_as_a_share_of_the_time_in_contact_with_its_speed_and_distance():
    """3 s in contact less 0.03 s, and 1 / cutoff, at either end; 0.98 s in windows of 0.2 s."""
    for cutoff, inside in ((None, 2.94), (5.0, 2.54)):
        (found,) = slipping(cutoff, 0.2)
        share, speed, distance = (found.evidence[k] for k in ("share", "speed", "distance"))
        assert share == pytest.approx(0.98 / inside, abs=1e-3)
        assert speed == pytest.approx(0.2, rel=0.02)
        assert distance == pytest.approx(0.98 * 0.2, rel=0.02)
        assert found.message.startswith(
            f"walk.csv: the link foot slips in {share:.0%} of its time in contact, at {speed:.2g} "
            f"m/s (RMS), {distance:.2g} m in total"
        )
    assert slipping(None, 0.009) == []


@pytest.mark.parametrize(("size", "is_slip"), [(1.0, True), (2.0, False)])
def test_a_slip_exceeds_three_standard_errors_of_its_window(size, is_slip):
    """Mean 0.4 m/s over 20 rows; scatter of 0.45 m/s times size: 3 / sqrt(20) of it is 0.3."""
    t = 1.0 + 0.01 * np.arange(30)
    log = Log(t, np.zeros((30, 1)), np.zeros((30, 1)), ("a",))
    v = np.zeros((30, 3))
    v[:, 1] = 0.4 + 0.45 * size * np.where(np.arange(30) % 2, 1.0, -1.0)
    found = list(check_slip("foot", log, np.ones(30, dtype=bool), t, [v], RAW))
    assert [x.code for x in found] == ["slipping_foot"] * is_slip


def test_each_contact_has_the_velocity_of_its_own_point(robot):
    """Of a ball, the point below its centre; the turn is that of its link."""
    rng = np.random.default_rng(1)
    contacts = (Contact(FEET[1], "surface"), Contact(FEET[0], radius=0.04),
                Contact("FR_FOOT", radius=0.01))  # fmt: skip
    model = replace(robot, constraints=contacts)
    pose = np.r_[rng.normal(size=3), pin.Quaternion(pin.exp3(rng.normal(size=3))).coeffs()]
    q, v = np.r_[pose, rng.uniform(-1, 1, 12)][None], rng.normal(size=18)
    J, turn = _contact_jacobian(model, q)
    places = []
    for step in (-1e-6, 0.0, 1e-6):
        data = model.pin_model.createData()
        x = pin.integrate(
            model.pin_model, model.configurations(q)[0], model.velocity_map @ v * step
        )
        pin.framesForwardKinematics(model.pin_model, data, x)
        places.append([data.oMf[frame_id(model.pin_model, x.frame)].copy() for x in contacts])
    for k, contact in enumerate(contacts):
        before, now, after = (own[k] for own in places)
        point = now.actInv(now.translation - [0.0, 0.0, contact.radius])
        speed = (after.act(point) - before.act(point)) / 2e-6
        np.testing.assert_allclose(J[0, k] @ v, speed, atol=1e-7)
        w = pin.log3(after.rotation @ before.rotation.T) / 2e-6
        np.testing.assert_allclose(turn[0, k] @ v, w, atol=1e-7)


def test_the_error_of_a_delay_counts_the_scatter_from_step_to_step():
    """Delays of 0.06 s with offsets 0, +-20 and +-40 ms: their median distance is 20 ms."""
    t = 7.0 + 0.002 * np.arange(5500)
    cycle, phase = (t // 1.0).astype(int), t % 1.0
    late = 0.06 + np.array([0.0, 0.02, -0.02, 0.04, -0.04])[(cycle - 7) % 5]
    speed = np.where((phase > 0.399) & (phase < 0.799), 0.8, 0.003)
    flags = (phase < 0.399 + late) | (phase > 0.799 + late)
    delay, error = flag_delay(t, flags, speed, spread=0.0)
    assert delay == pytest.approx(0.06, abs=2e-3)
    assert error == pytest.approx(stdtrit(20, 0.975) * 1.858 * 0.02 / np.sqrt(22), abs=2e-3)


def test_velocities_are_relative_to_the_median_of_the_links_in_contact():
    v = np.array([[[1.0, 5.0, 0.0], [2.0, 3.0, 0.0], [9.0, 4.0, -6.0], [4.0, 0.0, 7.0]]] * 3)
    flags = np.array([[1, 1, 1, 0], [1, 0, 0, 1], [0, 0, 1, 0]], dtype=bool)
    found = _relative(v, flags)
    np.testing.assert_allclose(found[0], v[0] - [2.0, 4.0, 0.0])
    np.testing.assert_allclose(found[1], v[1] - [2.5, 2.5, 3.5])
    assert not found[2].any()  # of one link, nothing is relative


def test_pairs_of_links_in_contact_move_alike(robot):
    rng = np.random.default_rng(3)
    J, v = rng.normal(size=(2, 3, 3, 9)), rng.normal(size=(2, 9))
    flags = np.array([[1, 1, 1], [1, 0, 1]], dtype=bool)
    D, d = _of_pairs(J, flags, v)
    speed = np.einsum("kcij,kj->kci", J[..., 3:], v[:, 3:])  # without the velocity of the base
    for k in range(2):
        found = (D[k] @ v[k, 3:6] + d[k]).reshape(3, 3)
        for row, (i, j) in zip(found, ((0, 1), (0, 2), (1, 2)), strict=True):
            wanted = (speed[k, i] - speed[k, j]) * (flags[k, i] and flags[k, j])
            np.testing.assert_allclose(row, wanted, atol=1e-12)


def test_the_radius_has_the_smallest_sum_of_absolute_speeds():
    """A third of the samples slips; both axes count, the vertical one does not."""
    rng = np.random.default_rng(4)
    rolls = np.column_stack([rng.normal(size=(300, 2)) * [1.0, 0.3], np.zeros(300)])
    v = 0.025 * rolls + 1e-4 * rng.normal(size=(300, 3))
    v[::3, :2] += 0.2 * rng.normal(size=(100, 2))
    v[:, 2] = 5.0
    radius, frame, before, after = _radius(Contact("ball", radius=0.01), v, rolls)
    change = radius - 0.01
    tried = change + 1e-3 * np.linspace(-1.0, 1.0, 201)
    sums = [np.abs(v[:, :2] - x * rolls[:, :2]).sum() for x in tried]
    assert sums[100] == pytest.approx(min(sums), rel=1e-6)
    assert (frame, radius) == ("ball", pytest.approx(0.035, abs=2e-4))
    own = [np.median(np.linalg.norm(v[:, :2] - x * rolls[:, :2], axis=1)) for x in (0.0, change)]
    assert [before, after] == pytest.approx(own)
    assert _radius(Contact("ball", radius=0.01), v, 0.0 * rolls) is None


@pytest.mark.parametrize(
    ("on", "off", "count"),
    [(0.62, 2.0, 1), (0.58, 2.0, 0), (0.11, 0.3, 1), (0.09, 0.2, 0), (0.11, None, 1)],
)
def test_a_foot_moves_in_contact_at_a_tenth_of_a_metre_and_three_tenths_of_its_swings(
    on, off, count
):
    """By RMS speeds, of which half are 0.6 and half are 1.28 times as large."""
    t = np.arange(80) / 10
    flags = t < (9.0 if off is None else 4.0)
    speed = np.where(flags, on, off or 0.0) * np.resize([0.6, 1.28], 80) / np.sqrt(0.9992)
    log = SimpleNamespace(name="walk.csv", t=t)
    found = list(_check_flags("foot", log, flags, log, speed**2, None, has_ground=False))
    assert [(x.code, x.evidence["speed"]) for x in found] == (
        [("moving_contact", pytest.approx(on))] * count
    )
