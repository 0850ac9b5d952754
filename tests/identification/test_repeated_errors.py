"""Errors of points of contact in the intervals."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

from robotid.fitting.drives import DriveChoice
from robotid.fitting.recordings import Recordings
from robotid.fitting.survey import hold_log
from robotid.identification import pipeline, repeated_errors
from robotid.identification.repeated_errors import (
    _slopes,
    _slopes_of_bias,
    _world_acceleration,
    estimated_uncertainty,
    with_repeated_errors,
)
from robotid.logs.base import BaseMotion
from robotid.logs.data import Log
from robotid.logs.imu import ImuFrame, ImuMotion
from robotid.logs.settings import SignalSettings
from robotid.regressor.base_parameters import structural_mapping
from robotid.regressor.constraints import constraint_jacobian, touching
from robotid.regressor.factors import triangle_of
from robotid.regressor.prediction import predict
from robotid.regressor.used_rows import base_problem
from robotid.robot.constraints import Contact, frame_id
from robotid.robot.drives import Cubic, Viscous
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
RAW = SignalSettings(
    cutoff=None, trim=0.0, velocity="differentiated", acceleration="differentiated"
)


def robot(uncertainty):
    contacts = [
        Contact(FEET[1], "surface", always=True),
        Contact(FEET[0], uncertainty=uncertainty),
        Contact(FEET[3], uncertainty=uncertainty, always=True),
    ]
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=(), constraints=contacts
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


def test_a_force_beside_its_point_leaves_the_torque_of_its_slope(log, rng):
    model = robot(None)
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
            moved[k, first : first + 3] += np.cross(w, own, axisa=0, axisc=0)
    loaded = torque - np.einsum("kmj,m->kj", moved, f)
    rows = replace(rows, trajectory=replace(motion, loaded=loaded))
    D = _slopes(model, rows, pi, [1, 2]).reshape(*torque.shape, 6)
    B = motion.basis
    left = torque - loaded
    left = left - np.einsum("kij,klj,kl->ki", B, B, left)
    np.testing.assert_allclose((D @ x)[rows.mask], left[rows.mask], atol=1e-7)
    assert np.abs(left).max() > 1e-5


def test_the_size_of_offsets_is_found(rng):
    """Offsets of 2 mm that the rows determine, beside parameters with a wide prior."""
    W, D, x = rng.standard_normal((2000, 5)), rng.standard_normal((2000, 12)), np.zeros(12)
    x = 2e-3 * rng.standard_normal(12)
    tau = W @ np.ones(5) + D @ x + 1e-3 * rng.standard_normal(2000)
    R = np.linalg.qr(np.column_stack([W, D, tau]), mode="r")
    s = estimated_uncertainty(R, 10 * np.eye(5), np.zeros(5), 1.0, 2000)
    assert s == pytest.approx(np.sqrt(np.mean(x**2)), rel=0.02)
    tau = tau - D @ x
    R = np.linalg.qr(np.column_stack([W, D, tau]), mode="r")
    assert estimated_uncertainty(R, 10 * np.eye(5), np.zeros(5), 1.0, 2000) < 1e-4


def test_parameters_far_from_the_prior_are_no_offsets(rng):
    """What offsets cause could in part be parameters, which are 100 standard deviations away."""
    W = rng.standard_normal((2000, 5))
    D = W @ rng.standard_normal((5, 12)) + rng.standard_normal((2000, 12))
    tau = W @ np.ones(5) + 1e-3 * rng.standard_normal(2000)
    R = np.linalg.qr(np.column_stack([W, D, tau]), mode="r")
    assert estimated_uncertainty(R, 0.01 * np.eye(5), np.zeros(5), 1.0, 2000) < 1e-4


def test_the_size_of_offsets_that_rows_determine_weakly_has_the_largest_evidence(rng):
    """Offsets whose own errors are as large as they are; rows without them give the noise."""
    d, size, level = 400, 0.008, 0.5
    offsets = size * rng.standard_normal(d)
    D = np.vstack([np.eye(d) * level / size, np.zeros((2000, d))])
    W = np.zeros((len(D), 1))
    W[-1] = 1.0
    tau = D @ offsets + level * rng.standard_normal(len(D))
    R = triangle_of(np.column_stack([W, D, tau]))
    found = estimated_uncertainty(R, np.eye(1), np.zeros(1), 1.0, len(D))
    # the closed form: the variance of each determined row is level^2 (1 + s^2 / size^2)
    wanted = size * np.sqrt(np.mean(tau[:d] ** 2) / np.var(tau[d:]) - 1.0)
    assert found == pytest.approx(wanted, rel=0.1)


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


def test_contact_errors_follow_the_selected_drive_terms(log, monkeypatch):
    """Errors of the points are those of a robot that had these terms from the start."""
    model, fits = robot(2e-3), []
    plain = with_repeated_errors(
        Recordings(model, structural_mapping(model), (hold_log(model, log, RAW),))
    )
    found = SimpleNamespace(mapping=plain.mapping, standard=model.standard_parameters())
    drives = [
        DriveChoice("FR_KFE", ("cubic",), (Viscous(), Cubic())),
        DriveChoice("HL_HFE", (), (Viscous(),)),
    ]
    monkeypatch.setattr(
        pipeline, "solve_recordings", lambda *x, **_: SimpleNamespace(solution=found)
    )
    monkeypatch.setattr(pipeline, "choose_drives", lambda *x: drives)
    monkeypatch.setattr(pipeline, "rough_choice", lambda choice: choice)
    monkeypatch.setattr(pipeline, "replace", lambda fit, **_: fits.append(fit))
    monkeypatch.setattr(pipeline, "fit_recordings", lambda recordings, choice: recordings)
    pipeline.with_drives(plain, None, {})
    (changed,) = fits
    assert len(changed.mapping.base_names) == len(plain.mapping.base_names) + 3
    assert changed.repeated.root.shape == (len(changed.mapping.base_names), 6)
    fresh = with_repeated_errors(
        Recordings(changed.model, changed.mapping, (hold_log(changed.model, log, RAW),))
    )
    np.testing.assert_allclose(changed.repeated.root, fresh.repeated.root, rtol=1e-9, atol=1e-15)
    k = [changed.mapping.base_names.index(f"{x}.viscous") for x in ("FR_KFE", "HL_HFE")]
    assert (np.abs(changed.repeated.root[k]).max(axis=1) > 0.0).all()


@pytest.mark.parametrize(("cutoff", "step"), [(None, 1), (10.0, 2)])
def test_errors_are_those_of_all_rows_though_only_some_are_used(log, monkeypatch, cutoff, step):
    """Of rows filtered to a fifth of their band every second is used, with twice the weight."""
    model = robot(2e-3)
    mapping = structural_mapping(model)
    settings = replace(RAW, cutoff=cutoff)
    recordings = Recordings(model, mapping, (hold_log(model, log, settings),))
    rows = recordings.fitted[0].whole
    some = base_problem(model, mapping, rows.trajectory.every(step), rows.mask[::step])
    W, weight = (np.concatenate([block[k] for block in some.blocks()]) for k in (0, 2))
    D = np.random.default_rng(2).standard_normal((len(W), 6))
    monkeypatch.setattr(repeated_errors, "_slopes", lambda *_: D)
    found = with_repeated_errors(recordings).repeated
    root = np.sqrt(weight)[:, None]
    W, D = root * W, root * D
    np.testing.assert_allclose(found.root, -2e-3 * step * W.T @ D, atol=1e-9 * np.abs(W).max())
    left = D - W @ np.linalg.lstsq(W, D, rcond=None)[0]  # of D, what parameters cannot explain
    count = recordings.reduce(is_cut=False)[0].factors.rows.sum()
    # W has dependent columns here, whose places in the triangle hold a hundredth of D
    assert found.variance == pytest.approx(4e-6 * step * np.sum(left**2) / count, rel=0.03)


def test_only_logs_with_an_imu_have_a_bias(log, rng, monkeypatch):
    """The effect of a bias is that of the first log's rows alone; the second has no IMU."""
    model = robot(0.0)
    mapping = structural_mapping(model)
    values = rng.standard_normal((len(log.t), 6)) + np.array([0, 0, 0, 0, 0, 9.81])
    frame = ImuFrame(np.eye(4)[3], np.zeros(3), np.array([0, 0, -9.81]), np.zeros(3))
    moved = replace(log, base=replace(log.base, imu=ImuMotion(values, frame)))
    with_imu, without = (hold_log(model, x, RAW) for x in (moved, log))

    def slopes(model, rows, pi):
        return np.random.default_rng(7).standard_normal((rows.trajectory.tau.size, 3))

    monkeypatch.setattr(repeated_errors, "_slopes_of_bias", slopes)
    alone, both = (
        with_repeated_errors(Recordings(model, mapping, logs)).repeated
        for logs in ((with_imu,), (with_imu, without))
    )
    assert alone.root.shape[1] == 3
    assert alone.bias > 0.0
    assert both.bias == pytest.approx(alone.bias)
    assert with_repeated_errors(Recordings(model, mapping, (without,))).repeated is None
    # with slopes that do not depend on the parameters, those of the second log have no effect
    squares, size = (x.root @ x.root.T for x in (both, alone)), np.abs(alone.root).max()
    np.testing.assert_allclose(*squares, atol=1e-9 * size**2)


def test_a_bias_of_the_accelerometer_acts_on_the_mass_of_the_robot(log):
    """The torque per acceleration of the base is three columns of the mass matrix, projected."""
    model = robot(0.0)
    rows = hold_log(model, log, RAW).whole
    motion, pi, pin_model = rows.trajectory, model.standard_parameters(), model.pin_model
    D = _slopes_of_bias(model, rows, pi).reshape(*motion.tau.shape, 3)
    data = pin_model.createData()
    for k, q in enumerate(model.configurations(motion.q)):
        M = pin.crba(pin_model, data, q)
        M = model.velocity_map.T @ (np.triu(M) + np.triu(M, 1).T) @ model.velocity_map
        B = motion.basis[k]
        np.testing.assert_allclose(D[k], M[:, :3] - B @ (B.T @ M[:, :3]), atol=1e-9)


def test_the_bias_is_the_mean_acceleration_in_the_world_of_each_log(log, rng):
    """A base that turns by 0.4 rad, twice: the RMS of the two logs' mean accelerations."""
    model, frame = robot(0.0), ImuFrame(np.eye(4)[3], np.zeros(3), np.array([0, 0, -9.81]),
                                        np.zeros(3))  # fmt: skip
    held, means = [], []
    for size in (1.0, 3.0):
        values = size * rng.standard_normal((len(log.t), 6)) + np.array([0, 0, 0, size, 0, 9.81])
        own = replace(log, base=replace(log.base, imu=ImuMotion(values, frame)))
        held.append(hold_log(model, own, RAW))
        motion = held[-1].whole.trajectory
        R = np.array([pin.XYZQUATToSE3(x).rotation for x in motion.q[:, :7]])
        local = motion.a[:, :3] + np.cross(motion.v[:, 3:6], motion.v[:, :3])
        world = np.einsum("kij,kj->ki", R, local)
        np.testing.assert_allclose(_world_acceleration(motion), world, atol=1e-9)
        means.append(np.linalg.norm(world.mean(axis=0)))
    found = with_repeated_errors(Recordings(model, structural_mapping(model), tuple(held)))
    assert found.repeated.bias == pytest.approx(np.sqrt(np.mean(np.square(means))))
    assert means[0] > 2.0 * means[1] > 0.1
