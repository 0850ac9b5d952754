"""Another scale of the torques, another robot's URDF, an uninformative torque: told apart."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.corruptions import clean_log, robot

from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.diagnosis.logs.hypotheses import explanations, smooth_motion, take_probe
from robotid.diagnosis.logs.torque_checks import load_model
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

SIGNALS = SignalSettings()
CODES = {"current_for_torque", "urdf_mismatch", "unexplained_torque"}


def loads(model, log):
    """Return what is said of the scale and the robot, as (code, where)."""
    findings = diagnose(model, [log], [], SIGNALS)
    return [(f.code, f.where) for f in findings if f.code in CODES]


@pytest.fixture(scope="module")
def ur5_log():
    return clean_log(robot("ur5"), 100, duration=10.0, rate=50.0)


@pytest.mark.parametrize("file", ["ur3_robot.urdf", "ur10_robot.urdf"])
@pytest.mark.parametrize("seed", [100, 102])
def test_the_urdf_of_another_robot_is_no_scale_of_the_torque(file, seed):
    log = clean_log(robot("ur5"), seed, duration=8.0)
    assert loads(RobotModel.from_urdf(example_urdf(file)), log) == [("urdf_mismatch", "run.csv")]


@pytest.mark.parametrize("factor", [0.08, 1000.0])
def test_a_scale_that_all_joints_share_is_said_once(ur5, ur5_log, factor):
    findings = diagnose(ur5, [replace(ur5_log, tau=factor * ur5_log.tau)], [], SIGNALS)
    (found,) = [f for f in findings if f.code in CODES]
    assert (found.code, found.where) == ("current_for_torque", "run.csv")
    assert found.evidence["factor"] == pytest.approx(1 / factor, rel=0.3)
    assert found.evidence["joints"] == 6


def test_one_current_among_torques_is_said_of_its_joint(ur5, ur5_log):
    scale = np.array([1.0, 0.08, 1.0, 1.0, 1.0, 1.0])
    found = loads(ur5, replace(ur5_log, tau=scale * ur5_log.tau))
    assert found == [("current_for_torque", "run.csv: shoulder_lift_joint")]


def test_torques_that_no_physics_explains_have_no_scale(ur5, ur5_log):
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(ur5_log.tau, axis=0)
    noise = rng.standard_normal(ur5_log.tau.shape) * ur5_log.tau.std(axis=0)
    for tau in (shuffled, noise):
        (found,) = loads(ur5, replace(ur5_log, tau=tau))
        assert found == ("unexplained_torque", "run.csv")


@pytest.mark.parametrize("value", [0.0, 3.0])
def test_a_dead_torque_does_not_make_others_suspect(ur5, ur5_log, value):
    tau = ur5_log.tau.copy()
    tau[:, 4] = value
    found = loads(ur5, replace(ur5_log, tau=tau))
    assert not {"current_for_torque", "urdf_mismatch"} & {code for code, _ in found}


def test_the_first_second_of_a_clean_log_has_no_scale(ur5):
    log = clean_log(ur5, 10)
    assert loads(ur5, replace(log, t=log.t[:150], q=log.q[:150], v=log.v[:150], tau=log.tau[:150])
                 ) == []  # fmt: skip


def test_the_fit_is_the_least_squares_of_all_joints_and_drives(ur5, ur5_log):
    """The small rows of links and payload fit as the whole system with free drives does."""
    probe = take_probe(ur5, smooth_motion(ur5, ur5_log, SIGNALS))
    share = explanations(probe)[1].share
    model = load_model(probe, share)
    scale = np.array([1.0, 2.0, 1.0, 0.5, 1.0, 1.0])
    chi, theta, error = model.fit(scale)
    assert model.misfits(scale[None])[0] == pytest.approx(chi, rel=1e-9)
    N, n, bodies = len(probe.rows), 6, 6
    pi = ur5.standard_parameters()[: ur5.layout.n_inertial].reshape(-1, 10)
    Y = joint_torque_regressor(ur5, probe.q, probe.v, probe.a)[:, : ur5.layout.n_inertial]
    Y = Y.reshape(N, n, bodies, 10)
    rows, right = [np.eye(10) / model.spread[:, None]], [model.mean / model.spread]
    for j in range(n):
        sigma = np.sqrt(0.05**2 + share[j]) * probe.tau[:, j].std() / np.sqrt(20.0 / N)
        own = np.column_stack([np.einsum("kbi,bi->kb", Y[:, j], pi), Y[:, j, -1, :4]])
        drive = np.delete(probe.drives[:, j], 4, axis=1)
        others = np.zeros((N, n * drive.shape[1]))
        others[:, j * drive.shape[1] : (j + 1) * drive.shape[1]] = drive
        rows.append(np.hstack([own, others]) / scale[j] / sigma)
        right.append(probe.tau[:, j] / sigma)
    rows[0] = np.hstack([rows[0], np.zeros((10, rows[1].shape[1] - 10))])
    A, b = np.vstack(rows), np.concatenate(right)
    size = np.linalg.norm(A, axis=0)
    found, *_ = np.linalg.lstsq(A / size, b, rcond=1e-12)
    assert (found[:6] > 0).all()
    np.testing.assert_allclose(theta, (found / size)[:10], atol=1e-6)
    assert chi == pytest.approx(np.sum((A / size @ found - b) ** 2), rel=1e-6)
    covariance = np.linalg.inv((A / size).T @ (A / size)) / np.outer(size, size)
    np.testing.assert_allclose(error, np.sqrt(np.diag(covariance))[:10], rtol=1e-4)
