"""Feet that slip slowly, beside wrong zeros of joints, noise, and errors of the pose."""

from dataclasses import replace

import numpy as np
import pytest

from robotid.data.base_motion import BaseMotion, quaternions_of_angles
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.contacts import check_base
from robotid.diagnosis.logs.slips import check_slip, without_zeros
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.robot.constraints import link_positions

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
SETTINGS = SignalSettings(cutoff=10.0, trim=0.2)


def standing(robot, seed, slide=0.0):
    """Return a log of a trunk that moves over its feet, one of which slides at a speed [m/s].

    It slides along x from 3 to 6 s. Zeros of the joints are wrong by 1 deg, the pose of the base
    has noise of 0.5 mm and 1 mrad.
    """
    rng, t = np.random.default_rng(seed), np.arange(2.0, 10.0, 0.02)
    w, phase = rng.uniform(0.8, 3.0, 6), rng.uniform(0.0, 6.0, 6)
    waves = np.sin(np.outer(t, w) + phase)
    pose = np.zeros((len(t), 7))
    pose[:, :3] = [0.0, 0.0, 0.25] + 0.015 * waves[:, :3]
    pose[:, 3:] = quaternions_of_angles(0.1 * waves[:, 3:])
    q = np.hstack([pose, np.tile([0.1, 0.8, -1.6], (len(t), 4))])
    every = np.ones((len(t), 4), dtype=bool)

    def positions(q):
        return link_positions(robot.pin_model, robot.configurations(q), FEET).reshape(-1, 12)

    target = np.tile(positions(q)[:1], (len(t), 1))
    target[:, 3] += slide * np.clip(t - 3.0, 0.0, 3.0)
    for _ in range(6):  # Newton
        J = constraint_jacobian(robot, q, every)[:, :, 6:]
        q[:, 7:] += np.linalg.solve(J, (target - positions(q))[..., None])[..., 0]
    assert np.abs(positions(q) - target).max() < 1e-9
    pose[:, :3] += 5e-4 * rng.standard_normal((len(t), 3))
    noise = quaternions_of_angles(0.1 * waves[:, 3:] + 1e-3 * rng.standard_normal((len(t), 3)))
    joints = q[:, 7:] + np.radians(1.0) * rng.standard_normal(12)
    base = BaseMotion(np.hstack([pose[:, :3], noise]))
    flags = {foot: every[:, 0] for foot in FEET}
    return Log(t, joints, 0 * joints, robot.joints, base=base, contacts=flags)


def test_feet_that_stand_have_no_finding_though_zeros_are_wrong(robot):
    for seed in range(3):
        assert not list(check_base(robot, standing(robot, seed), SETTINGS))


@pytest.mark.parametrize(("speed", "seed"), [(0.015, 7), (0.04, 8)])
def test_a_slow_slip_is_named_with_speed_and_share(robot, speed, seed):
    (found,) = check_base(robot, standing(robot, seed, speed), SETTINGS)
    assert (found.code, found.severity) == ("slipping_foot", "note")
    assert "the link FR_FOOT slips" in found.message
    assert found.evidence["speed"] == pytest.approx(speed, rel=0.2)
    assert found.evidence["share"] == pytest.approx(3.0 / 7.6, abs=0.07)
    assert found.evidence["distance"] == pytest.approx(3.0 * speed, rel=0.25)


def test_a_drift_of_the_pose_that_all_feet_share_is_no_slip(robot):
    log = standing(robot, 9)
    pose = log.base.pose.copy()
    pose[:, 1] += 0.03 * (log.t - 2.0)  # [m/s]
    assert not list(check_base(robot, replace(log, base=BaseMotion(pose)), SETTINGS))


def test_the_velocity_due_to_zeros_is_removed_and_a_slip_is_not(rng):
    """Of a planar arm with two joints: J d by hand; the base has six columns before them."""
    t = np.arange(1.0, 9.0, 0.01)
    a, b = 0.5 * np.sin(1.1 * t), 1.0 + 0.6 * np.cos(1.7 * t)
    d, slip, flags = np.array([0.06, -0.05]), np.array([0.02, 0.0, 0.01]), t % 2.0 < 1.5
    J = np.zeros((len(t), 3, 8))
    J[:, 0, 6] = -0.3 * np.sin(a) - 0.2 * np.sin(a + b)
    J[:, 1, 6] = 0.3 * np.cos(a) + 0.2 * np.cos(a + b)
    J[:, 0, 7], J[:, 1, 7] = -0.2 * np.sin(a + b), 0.2 * np.cos(a + b)
    J[:, :, :6] = rng.standard_normal((len(t), 3, 6))
    due = np.gradient(J[:, :, 6:] @ d, t, axis=0)
    v = due + np.where(flags, 0.0, 1.0)[:, None]  # it swings
    left = without_zeros(t, v, J, flags)
    assert np.abs(due[flags]).max() > 0.01
    assert np.abs(left[flags]).max() < 0.15 * np.abs(due[flags]).max()
    assert np.abs(left[~flags] - 1.0).max() < 0.15 * np.abs(due).max()
    left = without_zeros(t, v + slip, J, flags)
    np.testing.assert_allclose(left[flags].mean(axis=0), slip, atol=2e-3)
    np.testing.assert_array_equal(without_zeros(t, v, J, flags & False), v)


@pytest.mark.parametrize(("speed", "is_slip"), [(0.095, False), (0.105, True)])
def test_a_slip_in_a_short_contact_is_one_of_a_centimetre(robot, speed, is_slip):
    """0.1 s of each contact are examined, in which 0.1 m/s are 1 cm."""
    step = 0.005
    flags = np.abs(np.arange(400) % 50 - 24.5) < 16  # contacts of 0.16 s, less 0.03 s at each end
    t, n = 8.0 + step * np.arange(400), len(robot.joints)
    log = Log(t, np.zeros((400, n)), np.zeros((400, n)), robot.joints)
    way = np.tile([speed, 0.0, 0.0], (400, 1))
    found = list(check_slip("FOOT", log, flags, t, [way], SignalSettings(cutoff=None)))
    assert len(found) == is_slip
    for finding in found:
        assert finding.evidence["speed"] == pytest.approx(speed)
        assert finding.evidence["share"] == 1.0
