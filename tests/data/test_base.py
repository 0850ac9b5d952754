"""Motion of a floating base and contacts in logs."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pinocchio as pin
import pytest

from robotid.base.exceptions import DataError
from robotid.data.base_motion import (
    BaseColumns,
    BaseMotion,
    ImuFrame,
    ImuMotion,
    base_state,
    bias_at_rest,
    contacts_of,
    in_base,
    inertial_state,
    motion_of_imu,
    orientation_of_imu,
    pose_jumps,
    quaternions_of_angles,
)
from robotid.data.files.read import read_log, write_log
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process


def placement(x):
    return pin.SE3(
        pin.rpy.rpyToMatrix(0.3 * np.sin(x), 0.2 * np.cos(2 * x), 1.1 * x),
        np.array([np.sin(x), x**2, 0.3 * np.cos(3 * x)]),
    )


def poses(t):
    """Return a smooth pose (N, 7), and its placements."""
    places = [placement(x) for x in t]
    return np.array([pin.SE3ToXYZQUAT(M) for M in places]), places


def differences(t, h):
    """Return twist and acceleration by differences of Pinocchio's logarithm."""
    twists = []
    for x in (t - h, t, t + h):
        before, after = poses(x - h)[1], poses(x + h)[1]
        twists.append(
            np.array([pin.log6(a.actInv(b)).vector for a, b in zip(before, after, strict=True)])
            / (2 * h)
        )
    return twists[1], (twists[2] - twists[0]) / (2 * h)


def test_a_pose_is_differentiated_as_by_pinocchio():
    t = np.linspace(0.0, 3.0, 3001)
    pose, _ = poses(t)
    pose[:, 3:] *= 1.0005  # as after a filter
    normal, twist, acceleration = base_state(t, pose, None, None)
    np.testing.assert_allclose(np.linalg.norm(normal[:, 3:], axis=1), 1.0)
    some = slice(10, -10, 300)
    v, a = differences(t[some], 1e-4)
    np.testing.assert_allclose(twist[some], v, atol=2e-5)
    np.testing.assert_allclose(acceleration[some], a, atol=2e-4)
    measured = base_state(t, pose, twist + 1.0, None)
    np.testing.assert_allclose(measured[1], twist + 1.0)
    np.testing.assert_allclose(measured[2], acceleration, atol=1e-9)
    np.testing.assert_allclose(base_state(t, pose, twist, twist * 3.0)[2], twist * 3.0)


def test_a_base_is_differentiated_by_its_own_time_stamps(rng):
    """Steps of 3 to 14 ms; differences of second order are exact for polynomials of degree 2."""
    t = 7.0 + np.cumsum(rng.uniform(0.003, 0.014, 60))
    C = rng.standard_normal((3, 6))
    quaternion = np.array([0.1, -0.7, 0.4, 0.5]) / np.linalg.norm([0.1, -0.7, 0.4, 0.5])
    x, twist = (np.vander(t, 3) @ c for c in (C[:, :3], C))
    pose = np.hstack([x, np.tile(quaternion, (60, 1))])
    _, found, acceleration = base_state(t, pose, None, None)
    R = pin.Quaternion(quaternion).toRotationMatrix()
    slope = np.column_stack([2 * t, np.ones(60)])
    np.testing.assert_allclose(found[1:-1, :3], (slope @ C[:2, :3] @ R)[1:-1], rtol=1e-7)
    np.testing.assert_allclose(found[:, 3:], 0.0, atol=1e-9)
    wanted = np.tile(2 * C[0, :3] @ R, (56, 1))
    np.testing.assert_allclose(acceleration[2:-2, :3], wanted, rtol=1e-6)
    acceleration = base_state(t, pose, twist, None)[2]
    np.testing.assert_allclose(acceleration[1:-1], (slope @ C[:2])[1:-1], rtol=1e-7)


def test_vectors_and_angles_turn_as_by_pinocchio(rng):
    angles = rng.uniform(-3, 3, (5, 3))
    x = rng.standard_normal((5, 3))
    quaternions = quaternions_of_angles(angles)
    for k in range(5):
        R = pin.rpy.rpyToMatrix(*angles[k])
        np.testing.assert_allclose(pin.Quaternion(quaternions[k]).toRotationMatrix(), R, atol=1e-12)
        np.testing.assert_allclose(in_base(quaternions, x)[k], R.T @ x[k])


def test_quaternions_are_continuous_and_checked():
    t = np.linspace(0.0, 9.0, 91)
    pose, _ = poses(t)
    pose[40:60, 3:] *= -1.0
    pose[:, 3:] *= 1.0 + 5e-4
    base = BaseMotion(pose)
    assert (np.abs(np.diff(base.pose[:, 3:], axis=0)) < 0.3).all()
    np.testing.assert_allclose(np.linalg.norm(base.pose[:, 3:], axis=1), 1.0)
    pose[7, 3:] *= 1.01
    with pytest.raises(
        DataError, match=r"quaternion of the base has length 1.01.* in row 7, expected"
    ):
        BaseMotion(pose)
    with pytest.raises(DataError, match=r"twist of the base has shape \(91, 3\), expected \(N,"):
        BaseMotion(base.pose, twist=np.zeros((91, 3)))
    pose[3, 1] = np.nan
    with pytest.raises(DataError, match="pose of the base is not finite in row 3"):
        BaseMotion(pose)


@pytest.fixture
def log(rng):
    t = np.linspace(2.0, 3.0, 101)
    pose, _ = poses(t)
    flags = rng.random(101) < 0.5
    return Log(
        t, *rng.standard_normal((2, 101, 2)), ("one", "two"),
        base=BaseMotion(pose, rng.standard_normal((101, 6)), rng.standard_normal((101, 6))),
        contacts={"l_sole": flags, "r_sole": ~flags},
        wrenches={"fz l_sole": 10.0 * flags, "mx r_sole": t},
    )  # fmt: skip


WANTED = BaseColumns(True, ("l_sole", "r_sole"), ("fz l_sole", "mx r_sole"))


def test_a_log_is_read_as_it_was_written(log, tmp_path):
    write_log(log, tmp_path / "log.csv")
    again = read_log(tmp_path / "log.csv", log.joints, base=WANTED)
    for name in ("pose", "twist", "acceleration"):
        np.testing.assert_allclose(getattr(again.base, name), getattr(log.base, name), atol=1e-15)
    for kind in ("contacts", "wrenches"):
        own, other = getattr(log, kind), getattr(again, kind)
        assert list(own) == list(other)
        for name, values in own.items():
            np.testing.assert_array_equal(values, other[name])
    assert not again.notes
    world = read_log(tmp_path / "log.csv", log.joints, base=BaseColumns(True, twist="world"))
    for part in (slice(0, 3), slice(3, 6)):
        turned = in_base(log.base.pose[:, 3:], log.base.twist[:, part])
        np.testing.assert_allclose(world.base.twist[:, part], turned)
    assert not world.contacts
    part = again.window(2.2, 2.4)
    np.testing.assert_array_equal(part.base.twist, again.base.twist[20:41])
    np.testing.assert_array_equal(part.contacts["r_sole"], log.contacts["r_sole"][20:41])
    np.testing.assert_array_equal(part.wrenches["mx r_sole"], part.t)


@pytest.fixture
def table(log, tmp_path):
    """The log as a table of a file."""
    write_log(log, tmp_path / "log.csv")
    return pd.read_csv(tmp_path / "log.csv")


@pytest.mark.parametrize(("drop", "message"), [
    ("base_qz", "no column base_qz of the pose of the floating base; columns of the base found"),
    ("wrench_fz_l_sole", "no column wrench_fz_l_sole; columns of that kind found: wrench_mx_r"),
])  # fmt: skip
def test_missing_columns_are_named(log, table, drop, message):
    with pytest.raises(DataError, match=message):
        read_log(table.drop(columns=drop), log.joints, base=WANTED)


def test_a_contact_without_column_is_not_in_the_log(log, table):
    table = table.rename(columns={"contact_l_sole": "other"})
    wanted = replace(WANTED, thresholds=(0.5, None))
    again = read_log(table, log.joints, base=wanted)
    assert list(again.contacts) == ["r_sole"]
    np.testing.assert_array_equal(again.contacts["r_sole"], log.contacts["r_sole"])
    named = read_log(table, log.joints, base=wanted, columns={"contact_l_sole": "other"})
    np.testing.assert_array_equal(named.contacts["l_sole"], log.contacts["l_sole"])


def test_a_contact_is_0_or_1():
    values = np.array([[0, 1], [1, 0], [0, 0.25], [7, 1.0]])
    wanted = BaseColumns(contacts=("a", "b"))
    with pytest.raises(DataError, match=r"run: contact_a is 7 in row 3, expected 0 or 1"):
        contacts_of(values, wanted, "run")
    with pytest.raises(DataError, match=r"run: contact_b is 0.25 in row 2, expected 0 or 1"):
        contacts_of(values[:3], wanted, "run")


def test_each_contact_has_the_threshold_of_its_own_link():
    forces = np.array([[-70.0, 10.0, 0.0], [30.0, 30.0, 1.0], [60.0, 60.0, 0.0]])
    wanted = BaseColumns(contacts=("a", "b", "c"), thresholds=(20.0, 50.0, None))
    flags = {link: own.tolist() for link, own in contacts_of(forces, wanted, "run").items()}
    assert flags["a"] == [False, True, True]
    assert flags["b"] == [False, False, True]
    assert flags["c"] == [False, True, False]
    some = wanted.present(["contact_b", "contact_c", "contact_d"])  # the file lacks the first
    assert (some.contacts, some.thresholds) == (("b", "c"), (50.0, None))


def test_a_jump_is_in_the_row_after_it():
    t = 50.0 + 0.01 * np.arange(200)
    pose = np.column_stack([0.3 * (t - 50.0), np.zeros((200, 5)), np.ones(200)])
    pose[80:, 1] += 0.04
    pose[150:, 5:] = [np.sin(0.05), np.cos(0.05)]  # 0.1 rad about z
    rows, lengths, angles = pose_jumps(t, BaseMotion(pose).pose)
    np.testing.assert_array_equal(rows, [80, 150])
    np.testing.assert_allclose(lengths, [0.04, 0.0], atol=1e-12)
    np.testing.assert_allclose(angles, [0.0, 0.1], rtol=1e-3)


@pytest.mark.parametrize("is_later", [True, False])
def test_a_step_is_compared_with_those_on_both_sides_of_it(rng, is_later):
    """A vibration that starts or ends with a step of 0.04 m has steps of 0.005 m."""
    t, pose = 50.0 + 0.01 * np.arange(200), np.tile(np.append(np.zeros(6), 1.0), (200, 1))
    pose[100:, 0] = 0.04
    assert pose_jumps(t, pose)[0].tolist() == [100]
    vibrates = (np.arange(200) >= 100) == is_later
    pose[vibrates, 0] += 0.004 * rng.standard_normal(100)
    assert pose_jumps(t, pose)[0].tolist() == []


@pytest.mark.parametrize("velocity", ["measured", "differentiated"])
@pytest.mark.parametrize("acceleration", ["measured", "differentiated"])
def test_velocities_and_accelerations_of_a_base_are_measured_where_those_of_joints_are(
    log, velocity, acceleration
):
    t = log.t
    log = replace(log, v=log.q + 1.0, a=log.q - 3.0, contacts={}, wrenches={})
    how = {"velocity": velocity, "acceleration": acceleration}
    found = process(log, SignalSettings(cutoff=None, trim=0.0, **how))
    _, twist, _ = base_state(t, log.base.pose, None, None)
    v = np.hstack([twist, np.gradient(log.q, t, axis=0)])
    if velocity == "measured":
        v = np.hstack([log.base.twist, log.v])
    a = np.gradient(v, t, axis=0)
    if acceleration == "measured":
        a = np.hstack([log.base.acceleration, log.a])
    np.testing.assert_allclose(found.v, v, atol=1e-9)
    np.testing.assert_allclose(found.a, a, atol=1e-9)
    np.testing.assert_allclose(found.q, np.hstack([log.base.pose, log.q]), atol=1e-12)
    np.testing.assert_array_equal(found.tau, np.hstack([np.zeros((len(t), 6)), log.tau]))


def test_a_log_without_torque_is_read_with_wrenches(log, table):
    table = table.drop(columns=["tau_one", "tau_two"])
    assert not read_log(table, log.joints, base=WANTED).has_torque
    with pytest.raises(DataError, match="has no columns 'tau_one', 'tau_two'"):
        read_log(table, log.joints, base=BaseColumns(True))


@pytest.mark.parametrize(("order", "cutoff"), [(2, 20.0), (4, 25.0), (5, 10.0)])
def test_a_filter_leaves_no_force_where_a_contact_is_none(order, cutoff):
    """A force of 300 N at times, smoothed as measured ones are, by the filter of the torque."""
    t = 3.0 + np.arange(0.0, 4.0, 0.002)
    flags = (t % 1.7 < 0.6) | (t > 6.3)
    still = np.zeros((len(t), 1))
    force = {"fz foot": 300.0 * flags}
    own = Log(t, still, still, ("a",), contacts={"foot": flags}, wrenches=force)
    smooth = process(own, SignalSettings(order=order, cutoff=cutoff, velocity="differentiated"))
    touching, f = smooth.contacts[:, 0], np.abs(smooth.wrenches[:, 0])
    assert 0.5 < f[~touching].max() < 0.009 * 300.0
    rows = np.searchsorted(t, smooth.t)
    assert np.mean(touching) - np.mean(flags[rows]) < 4.0 / cutoff


def test_a_contact_is_extended_by_the_reach_of_the_filter(log):
    flags = (np.arange(101) >= 50) & (np.arange(101) < 53)  # 2.50 to 2.52 s
    other = np.arange(101) >= 40
    log = Log(
        log.t, log.q, log.tau, log.joints, base=log.base,
        contacts={"a": flags, "b": other, "c": ~other}, wrenches={"fz a": np.sin(log.t)},
    )  # fmt: skip
    raw = process(log, SignalSettings(cutoff=None, trim=0.0, velocity="differentiated"))
    touching = [np.flatnonzero(own).tolist() for own in raw.contacts.T]
    assert touching == [[49, 50, 51, 52, 53], list(range(39, 101)), list(range(41))]
    assert np.flatnonzero(raw.switching).tolist() == [39, 40, 49, 50, 52, 53]
    smooth = process(log, SignalSettings(cutoff=40.0, trim=0.1, velocity="differentiated"))
    a, b, c = (smooth.t[own] for own in smooth.contacts.T)
    # 15 rows: 3.6 time constants, which are long for a cutoff near half the rate
    np.testing.assert_allclose(a, np.arange(2.34, 2.685, 0.01))
    np.testing.assert_allclose([b[0], b[-1]], [2.24, smooth.t[-1]])
    np.testing.assert_allclose([c[0], c[-1]], [smooth.t[0], 2.55])
    assert not smooth.switching.any()
    np.testing.assert_allclose(smooth.wrenches[:, 0], np.sin(smooth.t), atol=2e-3)
    assert smooth.q.shape == (79, 9)
    assert smooth.v.shape == smooth.a.shape == smooth.tau.shape == (79, 8)
    assert not smooth.tau[:, :6].any()


G = np.array([0.0, 0.3, -9.8])
TURN = pin.rpy.rpyToMatrix(0.4, -1.1, 2.9)  # axes of the IMU in the base
FRAME = ImuFrame(pin.Quaternion(TURN).coeffs(), np.array([0.2, -0.1, 0.05]), G)
BIAS = np.array([0.01, -0.02, 0.005])  # [rad/s] with the axes of the IMU
JOINTS = ("hip",)


def measured(t, h=1e-4):
    """Return what an IMU measures (N, 6), and its orientation (N, 4), by differences."""
    values, orientation = [], []
    for x in t:
        place = [placement(x + k * h) * pin.SE3(TURN, FRAME.lever) for k in (-1, 0, 1)]
        before, now, after = (M.translation for M in place)
        R = place[1].rotation
        w = pin.log3(place[0].rotation.T @ place[2].rotation) / (2 * h)
        values.append(np.append(w, R.T @ ((before - 2 * now + after) / h**2 - G)))
        orientation.append(pin.Quaternion(R).coeffs())
    return np.array(values), np.array(orientation)


@pytest.fixture(scope="module")
def motion():
    """Return time, pose, its twist and acceleration, and the values of the IMU."""
    t = np.linspace(0.0, 2.0, 1001)
    pose = np.array([pin.SE3ToXYZQUAT(placement(x)) for x in t])
    _, twist, acceleration = base_state(t, pose, None, None)
    return t, pose, twist, acceleration, *measured(t)


def specific_force(pose, twist, acceleration):
    """Return the acceleration of the origin minus gravity, with the axes of the base."""
    down = np.array([pin.XYZQUATToSE3(x).rotation.T @ G for x in pose])
    return acceleration[:, :3] + np.cross(twist[:, 3:], twist[:, :3]) - down


def test_an_imu_has_the_acceleration_of_the_base(motion):
    t, pose, twist, acceleration, values, _ = motion
    frame = replace(FRAME, bias=np.zeros(3))
    imu, note = motion_of_imu(t, np.zeros((len(t), 1)), values, frame)
    assert note == ""
    some = slice(5, -5)
    for position in (1.0, 0.0):  # with and without a position
        own = pose * np.append([position] * 3, np.ones(4))
        found = base_state(t, own, None, None, imu)
        assert np.abs(found[1][:, :3]).max() * (1 - position) == 0.0
        np.testing.assert_allclose(found[1][some, 3:], twist[some, 3:], atol=2e-4)
        np.testing.assert_allclose(found[2][some, 3:], acceleration[some, 3:], atol=2e-2)
        wanted = specific_force(pose, twist, acceleration)[some]
        np.testing.assert_allclose(specific_force(*found)[some], wanted, atol=5e-3)
    whole = base_state(t, pose, None, None, imu)
    np.testing.assert_allclose(whole[2][some], acceleration[some], atol=2e-2)
    offset = np.array([0.3, -0.2, 0.1])  # of the accelerometers, with the axes of the base
    biased = replace(imu, values=imu.values + np.append(np.zeros(3), offset),
                     frame=replace(imu.frame, offset=offset))  # fmt: skip
    np.testing.assert_allclose(base_state(t, pose, None, None, biased)[2], whole[2], atol=1e-12)


def test_the_bias_is_estimated_at_rest(rng):
    t = np.arange(0.0, 4.0, 0.01)
    moves = t > 1.6
    q = np.where(moves, np.sin(5 * t), 0.0)[:, None]
    values = np.tile(np.append(BIAS, [1.0, 2.0, 9.0]), (len(t), 1))
    values[moves, :3] += 1.0
    values[:, :3] += 1e-3 * rng.standard_normal((len(t), 3))
    imu, note = motion_of_imu(t, q, values, FRAME)
    np.testing.assert_allclose(imu.frame.bias, TURN @ BIAS, atol=3e-4)
    np.testing.assert_allclose(imu.values[~moves].mean(axis=0)[:3], 0.0, atol=3e-4)
    np.testing.assert_allclose(imu.values[0, 3:], TURN @ [1.0, 2.0, 9.0])
    shown = ", ".join(f"{1e3 * x:+.2f}" for x in imu.frame.bias)
    assert note.startswith("bias of the gyroscopes, estimated in 1.5 s at rest and subtracted: ")
    assert f"{shown} mrad/s" in note
    imu, note = motion_of_imu(t, np.sin(5 * t)[:, None], values, FRAME)
    assert not imu.frame.bias.any()
    assert note.endswith("the bias of the gyroscopes is not estimated; record 1 s at rest")


@pytest.mark.parametrize(("rate", "is_known"), [(8.0, False), (10.0, True)])
def test_a_window_of_rest_has_five_samples(rate, is_known):
    t = 70.0 + np.arange(30) / rate
    still, w = np.zeros((30, 1)), np.tile(40 * BIAS, (30, 1))
    bias, note = bias_at_rest([(t, still, w)])
    np.testing.assert_allclose(bias, is_known * 40 * BIAS, atol=1e-15)
    assert ("never at rest" in note) != is_known
    swings = np.sin(6 * t)[:, None]
    for q, turn in ((still, w + swings * [0, 0, 0.5]), (np.hstack([still, swings]), w)):
        assert not bias_at_rest([(t, q, turn)])[0].any()


def test_an_imu_is_read_with_or_without_an_orientation_of_its_own(motion, tmp_path):
    t, pose, _, _, values, orientation = motion
    q = np.zeros((len(t), 1))
    write_log(Log(t, q, q, JOINTS, base=BaseMotion(pose)), tmp_path / "log.csv")
    lines = (tmp_path / "log.csv").read_text().splitlines()
    columns = {
        k: x
        for k, x in zip(lines[0].split(","), np.loadtxt(lines[1:], delimiter=",").T, strict=True)
    }
    names = ("qx", "qy", "qz", "qw", "wx", "wy", "wz", "ax", "ay", "az")
    columns |= {
        f"imu_{x}": y for x, y in zip(names, np.hstack([orientation, values]).T, strict=True)
    }
    wanted = BaseColumns(True, imu=replace(FRAME, bias=np.zeros(3)))

    def read(names):
        table = np.column_stack([columns[x] for x in names])
        path = tmp_path / "some.csv"
        np.savetxt(path, table, delimiter=",", header=",".join(names), comments="")
        return read_log(path, JOINTS, base=wanted)

    every = list(columns)
    both = read(every)
    np.testing.assert_allclose(both.base.pose, BaseMotion(pose).pose, atol=1e-9)
    assert both.base.has_position
    own = read([x for x in every if not x.startswith("base_")])
    alike = np.abs(np.sum(own.base.pose[:, 3:] * both.base.pose[:, 3:], axis=1))
    np.testing.assert_allclose(alike, 1.0, atol=1e-12)
    assert not own.base.has_position
    other = read([x for x in every if not x.startswith(("imu_q", "base_x"))])
    np.testing.assert_allclose(other.base.pose[:, 3:], both.base.pose[:, 3:], atol=1e-9)
    for log in (both, own, other):
        np.testing.assert_allclose(log.base.imu.values, np.hstack(
            [values[:, :3] @ TURN.T, values[:, 3:] @ TURN.T]), atol=1e-9)  # fmt: skip
    part = own.window(0.5, 1.0)
    np.testing.assert_array_equal(part.base.imu.values, own.base.imu.values[250:501])
    with pytest.raises(DataError, match=r"no column imu_ax of the IMU.* Record imu_wx"):
        read([x for x in every if x != "imu_ax"])
    level = read([x for x in every if not x.startswith(("imu_q", "base_"))])
    np.testing.assert_array_equal(  # the values alone; for horizontal forces see below
        level.base.pose[:, 3:], BaseMotion(np.hstack(
            [np.zeros((len(t), 3)), orientation_of_imu(t, level.base.imu.values, G)]
        )).pose[:, 3:],
    )  # fmt: skip


def test_an_imu_is_filtered_as_the_joints(motion):
    t, pose, twist, _, values, _ = motion
    imu = ImuMotion(np.hstack([values[:, :3] @ TURN.T, values[:, 3:] @ TURN.T]), FRAME)
    q = np.zeros((len(t), 1))
    log = Log(t, q, q, JOINTS, base=BaseMotion(pose, twist=9.0 * twist, imu=imu))
    smooth = process(log, SignalSettings(cutoff=30.0, velocity="differentiated"))
    rows = np.searchsorted(t, smooth.t - 1e-9)
    np.testing.assert_allclose(smooth.v[:, 3:6], twist[rows, 3:], atol=2e-3)
    np.testing.assert_allclose(smooth.v[:, :3], twist[rows, :3], atol=2e-3)


def swaying(x):
    turn = pin.rpy.rpyToMatrix(2.0 + 0.15 * np.sin(1.9 * x), 0.2 * np.cos(2.3 * x), 0.3 * x)
    return pin.SE3(turn, 0.05 * np.array([np.sin(2.5 * x), np.cos(1.7 * x), np.sin(3.1 * x)]))


@pytest.fixture(scope="module")
def sway():
    """Return stamps with a pause, values with the axes of the base, and orientations (N,)."""
    t, h = np.delete(4.0 + 0.01 * np.arange(2000), slice(900, 950)), 1e-4
    values, turns = [], []
    for x in t:
        before, now, after = (swaying(x + k * h) for k in (-1, 0, 1))
        w = pin.log3(before.rotation.T @ after.rotation) / (2 * h)
        a = (before.translation - 2 * now.translation + after.translation) / h**2
        values.append(np.append(w, now.rotation.T @ (a - G)))
        turns.append(now.rotation)
    return t, np.array(values), np.array(turns)


def test_the_orientation_of_an_imu_alone_has_its_tilt_and_turns(sway):
    t, values, turns = sway
    values = values + np.array([1e-3, -1e-3, 5e-4, 0.0, 0.0, 0.0])  # bias that remains
    found = orientation_of_imu(t, values, G)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
    R = np.array([pin.Quaternion(x).matrix() for x in found])
    up = -G / np.linalg.norm(G)
    tilt = np.linalg.norm(up @ R - up @ turns, axis=1)
    assert np.sqrt(np.mean(tilt**2)) < 0.01  # [rad]
    assert tilt.max() < 0.04  # at the ends, where the mean is that of 2 s
    for part in (slice(0, 900), slice(900, None)):  # the heading of each part is its own
        heading = np.array(
            [pin.log3(a @ b.T) @ up for a, b in zip(R[part], turns[part], strict=True)]
        )
        assert np.ptp(np.unwrap(heading)) < 0.05


def test_the_turn_between_two_samples_is_that_of_their_mean_angular_velocity():
    t = 30.0 + 0.01 * np.arange(101)
    values = np.zeros((101, 6))
    values[:, 2], values[:, 5] = 3.0 * (t - 30.0), 9.81  # [rad/s] from rest, about the vertical
    x, y, z, w = orientation_of_imu(t, values, np.array([0.0, 0.0, -9.81])).T
    np.testing.assert_allclose([x, y], 0.0, atol=1e-12)
    np.testing.assert_allclose(2 * np.arctan2(z, w), 1.5 * (t - 30.0) ** 2, atol=1e-9)
    after = orientation_of_imu(  # what turned in a gap is not known: each part starts anew
        np.append(t, t + 1.2), np.vstack([values, values]), np.array([0.0, 0.0, -9.81])
    )
    np.testing.assert_allclose(after, np.tile(np.column_stack([x, y, z, w]), (2, 1)), atol=1e-12)


def test_a_vertical_vector_upside_down_is_turned_upwards():
    values = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, -9.81], (5, 1))
    found = orientation_of_imu(0.01 * np.arange(5), values, np.array([0.0, 0.0, -9.81]))
    R = pin.Quaternion(found[2]).matrix()
    np.testing.assert_allclose(R @ [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_an_imu_needs_no_orientation_unless_horizontal_forces_of_the_world_are_measured(
    sway, tmp_path
):
    t, values, _ = sway
    names = ("imu_wx", "imu_wy", "imu_wz", "imu_ax", "imu_ay", "imu_az")
    parts = ("wrench_fz_foot", "wrench_fx_foot")
    table = {"time": t, "q_hip": np.sin(t)} | dict(zip(names, values.T, strict=True))
    path = tmp_path / "log.csv"
    pd.DataFrame(table | {part: np.ones(len(t)) for part in parts}).to_csv(path, index=False)
    frame = ImuFrame(np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), G)

    def read(*wrenches, **more):
        wanted = BaseColumns(floats=True, imu=frame, wrenches=wrenches, **more)
        return read_log(path, JOINTS, base=wanted)

    log = read("fz foot")
    assert not log.base.has_position
    wanted = orientation_of_imu(t, log.base.imu.values, G)
    np.testing.assert_allclose(np.abs(np.sum(log.base.pose[:, 3:] * wanted, axis=1)), 1.0)
    assert "the orientation is estimated from angular velocity" in log.notes[-1]
    assert read("fx foot", local=("foot",)).base is not None
    with pytest.raises(DataError, match="no column imu_qx, imu_qy, imu_qz, imu_qw of the IMU"):
        read("fz foot", "fx foot")
    other = replace(frame, gravity=np.array([0.0, -9.81, 0.0]))
    with pytest.raises(DataError, match="no column imu_qx"):
        read_log(path, JOINTS, base=BaseColumns(floats=True, imu=other, wrenches=("fz foot",)))


def test_the_acceleration_of_the_base_is_that_of_a_lever_at_uneven_stamps(rng):
    t = 50.0 + np.cumsum(rng.uniform(0.5e-3, 3e-3, 1500))
    rate, size, start = np.array([3.0, 2.0, 4.0]), np.array([2.0, -1.5, 1.0]), [0.3, 1.0, 2.0]
    angle = t[:, None] * rate + start
    w, alpha = size * np.sin(angle), size * rate * np.cos(angle)
    r, offset = np.array([0.3, -0.2, 0.5]), np.array([0.4, -0.3, 0.2])
    f, v = rng.normal(size=(2, len(t), 3))
    down = np.tile([1.0, -2.0, -9.0], (len(t), 1))
    at_imu = f + np.cross(alpha, r) + np.cross(w, np.cross(w, r)) + offset
    frame = ImuFrame(np.array([0, 0, 0, 1.0]), r, np.array([0, 0, -9.81]), np.zeros(3), offset)
    twist, found = inertial_state(t, v, down, np.hstack([at_imu, w])[:, [3, 4, 5, 0, 1, 2]], frame)
    np.testing.assert_array_equal(twist, np.hstack([v, w]))
    wanted = np.hstack([f + down - np.cross(w, v), alpha])
    np.testing.assert_allclose(found[1:-1], wanted[1:-1], atol=1e-3)


def test_the_vertical_is_the_mean_force_within_one_second_to_each_side_taken_twice(rng):
    t = 100.0 + np.sort(rng.uniform(0.0, 8.0, 4000))
    x = 0.5 * (t - 104.0) ** 2  # [m/s^2]; its mean over +-1 s is larger by 0.5 / 3
    force = np.column_stack([x, np.zeros_like(t), np.full_like(t, 9.0)])
    q = orientation_of_imu(t, np.hstack([0.0 * force, force]), np.array([0.0, 0.0, -9.81]))
    inner = (t > 102.0) & (t < 106.0)
    half = np.arctan2(x + 2 * 0.5 / 3, 9.0) / 2
    wanted = np.column_stack([0 * t, -np.sin(half), 0 * t, np.cos(half)])
    np.testing.assert_allclose(q[inner], wanted[inner], atol=2e-4)
