"""Errors of points of contact in the intervals."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import scipy.linalg

from robotid.data.base_motion import BaseMotion, ImuFrame, ImuMotion
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.constraint_rows import constraint_jacobian, touching
from robotid.dynamics.torque import predict
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.identification.repeated_errors import (
    EstimatedErrors,
    _roots,
    _slopes,
    _world_acceleration,
    estimated_errors,
    mean_drift,
    with_repeated_errors,
)
from robotid.robot.constraints import Contact, frame_id
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
RAW = SignalSettings(
    cutoff=None, trim=0.0, velocity="differentiated", acceleration="differentiated"
)


def robot(uncertainty, terms=(), **measured):
    contacts = [
        Contact(FEET[1], "surface", always=True),
        Contact(FEET[0], uncertainty=uncertainty),
        Contact(FEET[3], uncertainty=uncertainty, always=True, **measured),
    ]
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=terms, constraints=contacts
    )


@pytest.fixture(scope="module")
def log():
    """Return a log in which all joints and the base move, and one foot touches at times."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 0.6, 0.01)
    waves = np.sin(np.outer(t, rng.uniform(3, 9, 18)) + rng.uniform(0, 6, 18))
    pose = [
        pin.SE3ToXYZQUAT(pin.SE3(pin.rpy.rpyToMatrix(*w[3:6]), 0.1 * w[:3])) for w in 0.4 * waves
    ]
    tau = rng.standard_normal((len(t), 12))
    flags = {FEET[0]: t % 0.2 < 0.1}
    joints = robot(None).joints
    return Log(t, waves[:, 6:], tau, joints, base=BaseMotion(np.array(pose)), contacts=flags)


@pytest.mark.parametrize("axes", ["", "world", "link"])
def test_a_force_beside_its_point_leaves_the_torque_of_its_slope(log, rng, axes):
    """One vertical force may be measured, with the axes of the world or of the foot."""
    model, known = robot(None), []
    if axes:
        model, known = robot(None, measured=("fz",), axes=axes), [11]
        log = replace(log, wrenches={f"fz {FEET[3]}": np.zeros(len(log.t))})
    rows = hold_log(model, log, RAW).whole
    motion, pi, x = rows.trajectory, model.standard_parameters(), 1e-5 * rng.standard_normal(6)
    (torque,) = predict(model, [pi], replace(motion, basis=None))
    J, f = constraint_jacobian(model, motion.q, touching(model, motion)), rng.uniform(1, 2, 12)
    surfaces = tuple(Contact(c.frame, "surface", always=c.always) for c in model.contacts)
    whole = replace(model, constraints=surfaces)
    turning = constraint_jacobian(whole, motion.q, touching(whole, motion))
    data, moved = model.pin_model.createData(), J.copy()
    for k, q in enumerate(model.configurations(motion.q)):
        pin.framesForwardKinematics(model.pin_model, data, q)
        for i, first in ((1, 6), (2, 9)):
            R = data.oMf[frame_id(model.pin_model, model.contacts[i].frame)].rotation
            own = R @ x[3 * (i - 1) : 3 * i]
            w = turning[k, 6 * i + 3 : 6 * i + 6]
            turned = np.cross(w, own, axisa=0, axisc=0)
            moved[k, first : first + 3] += R.T @ turned if axes == "link" and i == 2 else turned
    loaded = torque - np.einsum("kmj,m->kj", moved, f)
    if known:
        loaded = loaded + J[:, 11] * f[11]
        motion = replace(motion, wrenches=np.full((len(motion.t), 1), f[11]))
    rows = replace(rows, trajectory=replace(motion, loaded=loaded))
    D = _slopes(model, rows, pi, [1, 2]).reshape(*torque.shape, 6)
    B = motion.basis
    left = torque - loaded
    left = left - np.einsum("kij,klj,kl->ki", B, B, left)
    np.testing.assert_allclose((D @ x)[rows.mask], left[rows.mask], atol=1e-7)
    assert np.abs(left).max() > 1e-5


def test_the_size_of_offsets_is_that_of_the_density_of_the_rows(rng):
    """Far below 3 mm, beside errors of known size: by the determinant of all rows' covariance."""
    W, D, x = rng.standard_normal((150, 3)), rng.standard_normal((150, 10)), np.zeros(10)
    D[:, :3] *= 5.0
    x[:3], x[3:] = 0.2 * rng.standard_normal(3), 4e-4 * rng.standard_normal(7)
    level = 1e-3
    sizes, before = np.array([0.3, 0.2, 0.0] + 7 * [np.nan]), np.zeros(10)
    before[:2] = 0.1, -0.2
    x[2] = 0.0
    tau = W @ np.ones(3) - D @ x + level * rng.standard_normal(150)
    R = np.linalg.qr(np.column_stack([W, -D, tau]), mode="r")
    found = estimated_errors(R, np.eye(3), np.zeros(3), 1.0, 150, sizes, before)

    def loss(s, sigma):
        wide = np.hstack([1e3 * W, D[:, :2] * sizes[:2], D[:, 3:] * s])
        V = wide @ wide.T + sigma**2 * np.eye(150)
        y = tau + D[:, :2] @ before[:2]
        return np.linalg.slogdet(V)[1] + y @ np.linalg.solve(V, y)

    rows = np.hstack([W, D[:, :2], D[:, 3:]])
    left = tau - rows @ np.linalg.lstsq(rows, tau, rcond=None)[0]
    sigma = np.linalg.norm(left) / np.sqrt(150 - 3)
    grid = np.geomspace(1e-4, 2e-3, 150)
    wanted = grid[np.argmin([loss(s, sigma) for s in grid])]
    assert found.size == pytest.approx(wanted, rel=0.05)
    np.testing.assert_allclose(found.known[:2], x[:2], atol=4 * level / np.sqrt(150) / 5)
    H = rows.T @ rows / sigma**2
    H[range(3, 5), range(3, 5)] += sizes[:2] ** -2.0
    H[range(5, 12), range(5, 12)] += found.size**-2.0
    expected = np.linalg.inv(H)[3:5, 3:5]
    np.testing.assert_allclose(found.covariance[:2, :2], expected, rtol=0.02, atol=1e-12)
    assert not found.covariance[2:].any()
    assert not found.known[2:].any()
    signs = np.where(np.arange(12) < 3, 1.0, -1.0)  # tau is W pi - D x
    H, about = signs[:, None] * H * signs, np.zeros(12)
    about[3:5] = before[:2] / sizes[:2] ** 2
    mean = np.linalg.solve(H, signs * (rows.T @ tau) / sigma**2 + about)[5:]
    np.testing.assert_allclose(
        found.squares - np.outer(mean, mean), np.linalg.inv(H)[5:, 5:], rtol=0.05, atol=2e-10
    )


def test_offsets_of_unknown_size_have_the_mean_square_of_all_points(rng):
    x, one = rng.standard_normal((20, 6)), 0.3 * np.eye(1)
    fit = EstimatedErrors(0.1, np.zeros(7), np.diag([0.0] * 6 + [0.09]), x.T @ x)
    root = _roots(fit, np.array([np.nan] * 6 + [0.5]), 6)
    mean = (x[:, :3].T @ x[:, :3] + x[:, 3:].T @ x[:, 3:]) / 2
    wanted = scipy.linalg.block_diag(mean, mean, one**2)
    np.testing.assert_allclose(root @ root.T, wanted, atol=1e-12)


def test_a_drift_is_neither_the_speed_at_the_ends_nor_that_of_a_walk():
    t = np.arange(0.0, 16.0, 0.01)
    sway = -0.02 * (2 * np.pi * 0.9) ** 2 * np.sin(2 * np.pi * 0.9 * t + 0.3)
    a = np.column_stack([sway + 0.03, 0.0 * t - 0.04, 0.5 * sway])
    segment = (t > 5.3).astype(int)
    assert np.linalg.norm(a.mean(axis=0) - [0.03, -0.04, 0.0]) > 0.01
    assert mean_drift(a, segment) == pytest.approx(0.05 / np.sqrt(3.0), rel=0.02)


def test_the_covariance_of_the_score_is_that_of_the_stated_uncertainty(log):
    def errors(uncertainty):
        model = robot(uncertainty)
        found = with_repeated_errors(
            Recordings(model, structural_mapping(model), (hold_log(model, log, RAW),))
        )
        return found.repeated

    once, twice = errors(1e-3), errors(2e-3)
    assert once.root.shape[1] == 6
    np.testing.assert_allclose(twice.root, 2.0 * once.root)
    assert twice.variance == pytest.approx(4.0 * once.variance)
    assert once.variance > 0.0
    assert errors(0.0) is None
    assert 0.0 < np.abs(errors(None).root).max() < np.inf


def test_offsets_without_torques_of_joints_are_two_centimetres_if_not_stated(log):
    def size(log, uncertainty, has_torque, terms=()):
        model = robot(uncertainty, terms, measured=("fz",))
        model = replace(model, constraints=model.contacts[1:])
        forces = {f"fz {FEET[3]}": np.full(len(log.t), 5.0)}
        log = replace(log, tau=log.tau * has_torque, wrenches=forces, has_torque=has_torque)
        held = (hold_log(model, log, RAW),)
        return with_repeated_errors(Recordings(model, structural_mapping(model), held)).repeated

    assert size(log, None, has_torque=False).points == 0.02
    assert size(log, 0.005, has_torque=False).points == 0.005
    assert size(log, None, has_torque=True).points != 0.02
    still = log.q.copy()
    still[:, 4] = 0.1  # a joint at rest: with Coulomb friction, its rows are not used
    assert size(replace(log, q=still), None, has_torque=True, terms=("coulomb",)).points != 0.02


def test_the_acceleration_in_the_world_is_turned_and_has_the_bias_back(log, rng):
    """Of the origin of a base that turns by 0.4 rad."""
    model, frame = robot(0.0), ImuFrame(np.eye(4)[3], np.zeros(3), np.array([0, 0, -9.81]),
                                        np.zeros(3))  # fmt: skip
    values = rng.standard_normal((len(log.t), 6)) + np.array([0, 0, 0, 1.0, 0, 9.81])
    own = replace(log, base=replace(log.base, imu=ImuMotion(values, frame)))
    motion = hold_log(model, own, RAW).whole.trajectory
    R = np.array([pin.XYZQUATToSE3(x).rotation for x in motion.q[:, :7]])
    bias = np.array([0.3, -0.2, 0.1])
    local = motion.a[:, :3] + np.cross(motion.v[:, 3:6], motion.v[:, :3])
    world = np.einsum("kij,kj->ki", R, local + bias)
    np.testing.assert_allclose(_world_acceleration(motion, bias), world, atol=1e-9)
