"""A log that contradicts the others is named, with the gain, zero, clock, delay or load."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.corruptions import clean_log, robot

from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.residual.discrepancies import explain_residual
from robotid.diagnosis.residual.log_differences import unlike_log
from robotid.diagnosis.residual.term_trials import take_sample
from robotid.dynamics.simulation.simulator import another_robot
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.identification.pipeline import in_memory, with_drives
from robotid.robot.drives import wanted_families

MODEL = robot("ur5")
PI = another_robot(MODEL, np.random.default_rng(0))


@pytest.fixture(scope="module")
def logs():
    how = {"pi": PI, "rate": 50.0, "duration": 10.0}
    return [clean_log(MODEL, k, **how, path=f"run{k}.csv") for k in range(3)]


def with_load(mass, pi=PI):
    loaded = pi.copy()
    last = loaded[: MODEL.layout.n_inertial].reshape(-1, 10)[-1]
    last += mass * np.array([1, 0, 0.05, 0.1, 0.02, 0, 0.02, 0, 0, 0.02])
    return clean_log(MODEL, 2, pi=loaded, rate=50.0, duration=10.0, path="run2.csv")


def sample_of(fitted, validation=()):
    recordings = in_memory(MODEL, SignalSettings(), fitted, validation)
    plain = wanted_families("viscous+coulomb", MODEL.joints)
    fit = with_drives(recordings, EstimatorSettings(prior_weight=1.0), plain)
    return fit, take_sample(fit)


def differences(fitted, validation=()):
    findings = explain_residual(*sample_of(fitted, validation))[1]
    return [f for f in findings if f.code == "log_differs"]


def test_a_load_in_the_validation_log_only_is_weighed(logs):
    assert differences(logs[:1], logs[1:2]) == []
    loaded = with_load(1.0)
    (change,) = differences(logs[:1], [loaded])
    assert (change.where, change.severity) == ("run2.csv", "warning")
    assert change.evidence["size"] == pytest.approx(1.0, rel=0.1)
    assert change.evidence["std_error"] < 0.05
    (change,) = differences([loaded], logs[:1])
    assert change.evidence["size"] == pytest.approx(-1.0, rel=0.1)
    (change,) = differences([with_load(0.5), *logs[:2]])
    assert (change.where, round(change.evidence["size"], 1)) == ("run2.csv", 0.5)


def test_a_load_is_named_beside_a_urdf_of_another_robot():
    rng = np.random.default_rng(4)
    size, pi = MODEL.layout.n_inertial, another_robot(MODEL, rng)
    links = pi[:size].reshape(-1, 10)
    links *= rng.choice([0.5, 2.0], (len(links), 1))
    fitted = replace(clean_log(MODEL, 5, pi=pi, rate=50.0, duration=10.0), path="run5.csv")
    (change,) = differences([fitted], [with_load(1.0, pi)])
    assert change.evidence["std_error"] < 0.05
    assert change.evidence["size"] == pytest.approx(1.0, abs=4 * change.evidence["std_error"])


@pytest.mark.parametrize(
    ("change", "where", "size", "words"),
    [
        (lambda log: replace(log, tau=1.2 * log.tau), "run1.csv", 0.2, "the torque of all joints"),
        (lambda log: replace(log, tau=log.tau * [1, 1, 1, 1.5, 1.5, 1.5]),
         "run1.csv: wrist_1_joint, wrist_2_joint, wrist_3_joint", 0.5, "is 1.5"),
        (lambda log: replace(log, tau=log.tau * [1, 0.8, 1, 1, 1, 1]),
         "run1.csv: shoulder_lift_joint", -0.2, "is 0.80"),
        (lambda log: replace(log, q=log.q + 0.2 * np.eye(6)[2]),
         "run1.csv: elbow_joint", -0.2, "zero position"),
        (lambda log: replace(log, t=1.25 * log.t, v=None), "run1.csv", None, "run 1.2"),
        (lambda log: replace(log, tau=np.transpose(
            [np.interp(log.t - 0.03, log.t, tau) for tau in log.tau.T])),
         "run1.csv", 0.03, "of all joints is delayed by"),
    ],
)  # fmt: skip
def test_what_differs_in_one_log_is_named_with_its_size(logs, change, where, size, words):
    (found,) = differences([logs[0], change(logs[1])], logs[2:])
    assert found.where == where
    assert words in found.message
    if size is not None:
        assert found.evidence["size"] == pytest.approx(size, rel=0.06)


def test_a_log_with_other_friction_or_another_offset_is_named(logs):
    typical = np.sqrt(np.mean(logs[1].tau ** 2, axis=0)) * np.eye(6)[2]
    v = logs[1].v / np.std(logs[1].v, axis=0)
    for change in (0.3 * v, -0.3, 0.3 * np.tanh(v / 0.05) * (0.8 + np.exp(-((v / 0.3) ** 2)))):
        other = replace(logs[1], tau=logs[1].tau + change * typical)
        for fitted, validation in (([logs[0], other], logs[2:]), (logs[:1], [other])):
            (found,) = differences(fitted, validation)
            assert "friction or offset of elbow_joint" in found.message
            assert found.evidence["change_pct"] == pytest.approx(30, rel=0.25)


def test_the_fit_to_the_other_logs_is_the_prior_of_a_log(logs):
    """What a log changes of it gives the fit to all logs, by matrices of all their rows."""
    gain = np.array([1, 0.8, 1, 1, 1, 1])
    sample = sample_of([logs[0], replace(logs[1], tau=gain * logs[1].tau)], logs[2:])[1]
    others, _ = unlike_log(sample)
    own = others.left_out(sample)[0]
    assert list(others.is_out) == [False, True, False]
    b = len(sample.U)
    change = np.linalg.solve(own.normal.A.sum(axis=0)[:b, :b] + np.eye(b), own.normal.B.sum(0)[:b])
    X, y = (others.scale[:, None] * sample.W).reshape(-1, b), (others.scale * sample.r).ravel()
    together = np.linalg.solve(X.T @ X + np.eye(b), X.T @ y)
    found = others.change + np.linalg.solve(others.L.T, change)
    np.testing.assert_allclose(found, together, rtol=1e-6, atol=1e-9)
