"""Motion of a floating base and contacts in logs."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from robotid.base.exceptions import DataError
from robotid.data.base_motion import (
    BaseColumns,
    BaseMotion,
    base_state,
    contacts_of,
    in_base,
    pose_jumps,
    quaternions_of_angles,
)
from robotid.data.files.read import read_log, write_log
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process


def poses(t):
    """Return a smooth pose (N, 7), and its twist and acceleration with the axes of the base."""
    placement = [
        pin.SE3(pin.rpy.rpyToMatrix(0.3 * np.sin(x), 0.2 * np.cos(2 * x), 1.1 * x),
                np.array([np.sin(x), x**2, 0.3 * np.cos(3 * x)]))
        for x in t
    ]  # fmt: skip
    return np.array([pin.SE3ToXYZQUAT(M) for M in placement]), placement


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
    np.testing.assert_allclose(
        acceleration[2:-2, :3], np.tile(2 * C[0, :3] @ R, (56, 1)), rtol=1e-6
    )
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
        DataError, match=r"quaternion of the base has length 1.01.* in row 7, wanted"
    ):
        BaseMotion(pose)
    with pytest.raises(DataError, match=r"twist of the base has shape \(91, 3\), wanted \(N, 6\)"):
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


@pytest.mark.parametrize(
    ("drop", "message"),
    [
        (
            "base_qz",
            "no column base_qz of the pose of the floating base; columns of the base found",
        ),
        ("wrench_fz_l_sole", "no column wrench_fz_l_sole; columns of that kind found: wrench_mx_r"),
    ],
)
def test_missing_columns_are_named(log, tmp_path, drop, message):
    write_log(log, tmp_path / "log.csv")
    lines = [line.split(",") for line in (tmp_path / "log.csv").read_text().splitlines()]
    k = lines[0].index(drop)
    text = "\n".join(",".join(line[:k] + line[k + 1 :]) for line in lines)
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(DataError) as error:
        read_log(tmp_path / "log.csv", log.joints, base=WANTED)
    assert message in str(error.value)


def test_a_contact_without_column_is_not_in_the_log(log, tmp_path):
    write_log(log, tmp_path / "log.csv")
    text = (tmp_path / "log.csv").read_text().replace("contact_l_sole", "other")
    (tmp_path / "log.csv").write_text(text)
    wanted = replace(WANTED, thresholds=(0.5, None))
    again = read_log(tmp_path / "log.csv", log.joints, base=wanted)
    assert list(again.contacts) == ["r_sole"]
    np.testing.assert_array_equal(again.contacts["r_sole"], log.contacts["r_sole"])
    columns = {"contact_l_sole": "other"}
    named = read_log(tmp_path / "log.csv", log.joints, base=wanted, columns=columns)
    np.testing.assert_array_equal(named.contacts["l_sole"], log.contacts["l_sole"])


def test_a_contact_is_0_or_1(log, tmp_path):
    write_log(log, tmp_path / "log.csv")
    text = (tmp_path / "log.csv").read_text().replace("contact_r_sole", "c")
    text = text.replace("contact_l_sole", "contact_r_sole").replace(
        "wrench_mx_r_sole", "contact_l_sole"
    )
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(DataError, match="contact_l_sole is 2 in row 0, wanted 0 or 1"):
        read_log(tmp_path / "log.csv", log.joints, base=BaseColumns(contacts=("l_sole",)))
    values, wanted = (
        np.array([[0, 1], [1, 0], [0, 0.25], [7, 1.0]]),
        BaseColumns(contacts=("a", "b")),
    )
    with pytest.raises(DataError, match=r"run: contact_a is 7 in row 3, wanted 0 or 1"):
        contacts_of(values, wanted, "run")
    with pytest.raises(DataError, match=r"run: contact_b is 0.25 in row 2, wanted 0 or 1"):
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


def test_a_log_without_torque_is_read_with_wrenches(log, tmp_path):
    write_log(log, tmp_path / "log.csv")
    text = (tmp_path / "log.csv").read_text().replace("tau_", "effective_")
    (tmp_path / "log.csv").write_text(text)
    again = read_log(tmp_path / "log.csv", log.joints, base=WANTED)
    assert not again.has_torque
    with pytest.raises(DataError, match="has no columns 'tau_one', 'tau_two'"):
        read_log(tmp_path / "log.csv", log.joints, base=BaseColumns(True))


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
