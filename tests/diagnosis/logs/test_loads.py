"""Another scale of the torques, another robot's URDF, an uninformative torque: told apart."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.corruptions import clean_log, controlled_log, delayed, robot
from helpers.synthetic import exact_log, truth

from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs import torque_delay
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.diagnosis.logs.probe import (
    Probe,
    coupled_columns,
    drive_columns,
    smooth_motion,
    take_probe,
)
from robotid.diagnosis.logs.readings import Reading
from robotid.diagnosis.logs.torque_checks import TorqueCheck, load_model
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling
from robotid.robot.prior import with_assumed_inertials

SIGNALS = SignalSettings()
CODES = {"current_for_torque", "urdf_mismatch", "unexplained_torque"}


def loads(model, log):
    """Return what is said of the scale and the robot, as (code, where)."""
    findings = diagnose(model, [log], [], SIGNALS)
    return [(f.code, f.where) for f in findings if f.code in CODES]


@pytest.fixture(scope="module")
def ur5_log():
    return clean_log(robot("ur5"), 100, duration=10.0, rate=50.0)


@pytest.mark.parametrize(("file", "seed"), [("ur3_robot.urdf", 100), ("ur10_robot.urdf", 102)])
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


def test_torques_that_no_physics_explains_have_no_scale(ur5, ur5_log):
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(ur5_log.tau, axis=0)
    noise = rng.standard_normal(ur5_log.tau.shape) * ur5_log.tau.std(axis=0)
    for tau in (shuffled, noise):
        (found,) = loads(ur5, replace(ur5_log, tau=tau))
        assert found == ("unexplained_torque", "run.csv")


def test_each_torque_that_no_physics_explains_has_its_own_share(ur5, ur5_log):
    tau = ur5_log.tau.copy()
    std = tau[:, [1, 2]].std(axis=0)
    tau[:, [1, 2]] += np.random.default_rng(0).standard_normal((len(tau), 2)) * std * [2.0, 4.0]
    findings = diagnose(ur5, [replace(ur5_log, tau=tau)], [], SIGNALS)
    found = {f.joints: f.evidence["share"] for f in findings if f.code == "unexplained_torque"}
    wanted = {("shoulder_lift_joint",): 0.5, ("elbow_joint",): 0.8}  # of the variance
    assert found == pytest.approx(wanted, abs=0.1)


@pytest.mark.parametrize("value", [0.0, 3.0])
def test_a_dead_torque_does_not_make_others_suspect(ur5, ur5_log, value):
    tau = ur5_log.tau.copy()
    tau[:, 4] = value
    found = loads(ur5, replace(ur5_log, tau=tau))
    assert not {"current_for_torque", "urdf_mismatch"} & {code for code, _ in found}


def test_a_reading_starts_near_the_three_points_of_its_parabola():
    shares = {-0.3: 0.1 + 1e-9, 0.0: 0.2, 0.3: 0.3}  # almost a line
    made = {x: SimpleNamespace(share=np.array([y])) for x, y in shares.items()}
    (start,) = Reading("x", (), lambda _, x: made[x], (), 0.3).started(made[0.0])
    assert start.values == pytest.approx((-3.0,))


def test_instants_are_added_until_they_show_what_is_not_explained(ur5, ur5_log):
    probe = take_probe(ur5, smooth_motion(ur5, ur5_log, SIGNALS))
    tau = probe.tau.copy()
    tau[np.arange(len(tau)) % (len(tau) // 24) > 0, 2] *= -1.0  # not in the first 24
    spoilt = TorqueCheck.of(replace(probe, tau=tau)).limbs[0][0]
    assert spoilt.share[2] > 0.1
    assert spoilt.few().share[2] > 0.5 * spoilt.share[2]


def test_the_first_second_of_a_clean_log_has_no_scale(ur5):
    assert loads(ur5, clean_log(ur5, 10).window(end=1.495)) == []


def test_masses_that_are_assumed_do_not_say_what_torques_lack(tmp_path):
    path = example_urdf("finger_edu.urdf")
    model, rng = RobotModel.from_urdf(path), np.random.default_rng(4)
    pi = model.standard_parameters()
    pi[:30].reshape(3, 10)[:, 1:4] += 0.01 * pi[:30:10, None] * rng.uniform(-1, 1, (3, 3))
    pi[30:] = np.outer([0.1, 0.066, 0.019], [0.01, 0.1, 0.05, 0.0]).ravel()
    bare = re.sub(r"<inertial>.*?</inertial>", "", path.read_text(), flags=re.DOTALL)
    (tmp_path / path.name).write_text(bare)
    assumed = with_assumed_inertials(RobotModel.from_urdf(tmp_path / path.name))
    log = replace(clean_log(model, 4, pi=pi), v=None)
    assert not [f for f in diagnose(assumed, [log], [], SIGNALS) if f.severity == "error"]


def test_the_fit_is_the_least_squares_of_all_joints_and_drives(ur5, ur5_log):
    """The small rows of links and payload fit as the whole system with free drives does."""
    probe = take_probe(ur5, smooth_motion(ur5, ur5_log, SIGNALS))
    share = TorqueCheck.of(probe).share
    model = load_model(probe, share)
    chi, theta, error = model.fit(2.0)
    assert model.misfit(2.0) == pytest.approx(chi, rel=1e-9)
    N, n, bodies = len(probe.rows), 6, 6
    drives = drive_columns(ur5, probe.q, probe.v, probe.a)
    pi = ur5.standard_parameters()[: ur5.layout.n_inertial].reshape(-1, 10)
    np.testing.assert_allclose(model.spread[6:], pi[:, 0].sum() * np.append(1, 3 * [ur5.length]))
    Y = joint_torque_regressor(ur5, probe.q, probe.v, probe.a)[:, : ur5.layout.n_inertial]
    Y = Y.reshape(N, n, bodies, 10)
    rows, right = [np.eye(10) / model.spread[:, None]], [model.mean / model.spread]
    for j in range(n):
        sigma = np.sqrt(0.05**2 + share[j]) * probe.tau[:, j].std() / np.sqrt(20.0 / N)
        own = np.column_stack([np.einsum("kbi,bi->kb", Y[:, j], pi), Y[:, j, -1, :4]])
        rows.append(np.hstack([own, np.kron(np.eye(n)[j], drives[:, j])]) / 2.0 / sigma)
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


# --- probes ---------------------------------------------------------------------------------------
def test_columns_of_coupled_drives_are_those_of_the_regressor(ur5, rng):
    coupling = Coupling("motor", (("wrist_2_joint", 1.0), ("wrist_3_joint", -2.0)))
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), couplings=(coupling,))
    q, v, a = rng.uniform(-2, 2, (3, 20, 6))
    chosen = model.layout.n_inertial + np.flatnonzero(model.layout.is_coupled)
    Y = joint_torque_regressor(model, q, v, a).reshape(20, 6, -1)
    found = coupled_columns(model, q, v, a)
    np.testing.assert_array_equal(found, Y[:, :, chosen])
    assert found.any(axis=0)[[4, 5]].all()  # a load of both joints
    assert coupled_columns(ur5, q, v, a).shape == (20, 6, 0)


@pytest.fixture(scope="module")
def probe():
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"))
    motion = smooth_motion(model, clean_log(model, 0, duration=3.0), SignalSettings())
    return take_probe(model, motion, samples=60)


def test_a_probe_at_other_rows_is_of_the_same_motion(probe):
    other = Probe.of(probe.model, probe.motion, probe.rows[3:40:5])
    for key in ("q", "v", "a", "tau"):
        np.testing.assert_array_equal(getattr(other, key), getattr(probe, key)[3:40:5])
    np.testing.assert_allclose(other.loads, probe.loads[3:40:5], atol=1e-12)
    t = probe.motion.t  # the filter settles at both ends
    inner = np.flatnonzero((t > t[0] + 0.149) & (t < t[-1] - 0.149))
    assert [probe.rows[0], probe.rows[-1]] == [inner[0], inner[-1]]


def test_the_sign_of_a_slow_joint_turns_within_a_twentieth_of_its_own_speed(probe):
    v = probe.v / np.abs(probe.v).max(axis=0) * [2.0, 0.1, 0.3, 0.5, 0.0, 1.0]
    still = [0.02, 0.005, 0.015, 0.02, 0.02, 0.02]
    found = drive_columns(probe.model, probe.q, v, probe.a)
    np.testing.assert_allclose(found[:, :, 3], np.tanh(v / still), rtol=1e-12)
    np.testing.assert_array_equal(found[:, :, 2], v)


# --- delays of the torque -------------------------------------------------------------------------
# robot, seed, duration [s]: logs whose every torque the filter alone makes look late or early
CLEAN = [("ur5", 100, 8.0), ("ur5", 101, 8.0), ("ur5", 104, 6.0), ("panda", 100, 6.0)]


def found(model, log, signals=SIGNALS):
    return list(torque_delay.check_torque_delay(model, log, signals, "run.csv"))


@pytest.mark.parametrize(("name", "seed", "duration"), CLEAN)
def test_a_short_clean_log_has_no_late_torque_but_a_delayed_one_has(name, seed, duration):
    model, log = robot(name), controlled_log(name, seed, duration=duration)
    (clean,) = found(model, log)
    assert clean.severity == "note"
    # without the filter on the regressor 6 to 9 ms and 11 to 15 %
    assert abs(clean.evidence["delay"]) < 0.006
    assert clean.evidence["gain"] < 0.09
    for delay in (0.03, -0.03):
        (spoilt,) = found(model, delayed(log, delay))
        assert spoilt.severity == "warning"
        # what was found of the clean log is the bias of the method
        assert spoilt.evidence["delay"] - clean.evidence["delay"] == pytest.approx(delay, abs=2e-3)
        assert spoilt.evidence["gain"] > 0.25


def test_a_log_without_a_filter_is_judged_too(ur5):
    signals = replace(SIGNALS, cutoff=None)
    log = exact_log(ur5, truth(ur5), np.random.default_rng(0), samples=800, rate=100.0)
    (clean,) = found(ur5, log, signals)
    (spoilt,) = found(ur5, delayed(log, 0.04), replace(signals, torque_delay=0.01))
    assert (clean.severity, spoilt.severity) == ("note", "warning")
    assert spoilt.evidence["delay"] == pytest.approx(0.03, abs=5e-3)
    total = re.search(r"set torque_delay = (\S+) \(", spoilt.message)[1]
    assert float(total) == pytest.approx(0.04, abs=5e-3)  # what is stated is part of it


def test_noise_of_a_log_without_a_filter_is_no_delay(ur5):
    # half-way between rows a spline of white noise is a quarter smaller: 10 ms here
    log = exact_log(ur5, truth(ur5), np.random.default_rng(1), samples=600, rate=50.0)
    log = replace(log, tau=log.tau + 0.1 * np.random.default_rng(1).standard_normal(log.tau.shape))
    (clean,) = found(ur5, log, replace(SIGNALS, cutoff=None, trim=0.0))
    assert clean.severity == "note"
    assert abs(clean.evidence["delay"]) < 0.005
    assert clean.evidence["gain"] < 0.05


def test_all_rows_from_the_first_to_the_last_that_moves_are_used(ur5):
    motion = smooth_motion(ur5, clean_log(ur5, 100, duration=8.0), SIGNALS)
    v = motion.v.copy()
    v[:40] = v[-30:] = 0.0
    (rows,) = torque_delay._segments(ur5, replace(motion, v=v), 1)
    np.testing.assert_array_equal(rows, np.arange(40, len(v) - 30))


def test_joints_that_hardly_move_have_no_say(ur5):
    log = clean_log(ur5, 100, duration=20.0)
    q = log.q.copy()
    q[np.abs(log.t - 8.5) > 0.95, :5] = q[850, :5]
    assert found(ur5, replace(log, q=q)) == []


@pytest.mark.parametrize(("name", "seed"), [("ur5", 100), ("ur5", 102), ("panda", 104)])
def test_a_torque_that_is_periodic_in_the_position_is_no_delay(name, seed):
    model = robot(name)
    log, rng = clean_log(model, seed), np.random.default_rng(seed)
    tau = log.tau.copy()
    for torque, q in zip(tau.T, log.q.T, strict=True):
        phase, size = rng.uniform(0, 2 * np.pi, 4), rng.standard_normal(4)
        ripple = size @ [np.cos(k * q + p) for k, p in enumerate(phase, start=1)]
        torque += 0.3 * torque.std() * ripple / ripple.std()
    for finding in found(model, replace(log, tau=tau)):
        assert finding.severity == "note"


def test_a_model_of_one_joint_is_not_judged():
    whole = robot("ur5")
    log = clean_log(whole, 100, duration=8.0)
    model = RobotModel.from_urdf(whole.tree.path, joints=["elbow_joint"])
    assert found(model, log.select(["elbow_joint"])) == []
