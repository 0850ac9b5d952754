"""Loads that only the validation log has."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.corruptions import clean_log, robot

from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.dynamics.simulation.truth import another_robot

CODES = {"payload_change", "payload"}


def loud(model, fitted, kept=()):
    found = diagnose(model, [fitted], list(kept), SignalSettings())
    return [f for f in found if f.code in CODES and f.severity != "note"]


def test_a_load_in_the_validation_log_only_is_weighed(arm_and_log):
    model, fitted, other = arm_and_log
    size, pi = model.layout.n_inertial, another_robot(model, np.random.default_rng(0))
    assert loud(model, fitted, [other]) == []
    loaded = pi.copy()
    last = loaded[:size].reshape(-1, 10)[-1]
    last += np.array([1, 0, 0.05, 0.1, 0.02, 0, 0.02, 0, 0, 0.02])
    kept = clean_log(model, 2, pi=loaded, rate=50.0, duration=10.0)
    (change,) = [f for f in loud(model, fitted, [kept]) if f.code == "payload_change"]
    assert change.where == f"run.csv: {model.layout.bodies[-1]}"
    assert change.evidence["mass"] == pytest.approx(1.0, abs=3 * change.evidence["std_error"])
    assert change.evidence["std_error"] < 0.05
    assert " kg more than in the fitted logs" in change.message
    (change,) = [f for f in loud(model, kept, [fitted]) if f.code == "payload_change"]
    assert change.evidence["mass"] == pytest.approx(-1.0, abs=3 * change.evidence["std_error"])
    assert " kg less than in the fitted logs" in change.message


@pytest.mark.parametrize(
    "change",
    [
        lambda log: replace(log, tau=1.05 * log.tau),
        lambda log: replace(log, tau=log.tau * [1, 1, 1, 1.5, 1.5, 1.5]),
        lambda log: replace(log, tau=log.tau * [1, 1, -1, 1, 1, 1]),
        lambda log: replace(log, q=log.q + 0.05 * np.eye(6)[2]),
    ],
    ids=["all torques x 1.05", "wrist torques x 1.5", "elbow reversed", "elbow zero moved"],
)
def test_what_else_makes_a_validation_log_another_one_is_no_load(arm_and_log, change):
    model, fitted, other = arm_and_log
    assert "payload_change" not in [f.code for f in loud(model, fitted, [change(other)])]


@pytest.fixture(scope="module")
def arm_and_log():
    model = robot("ur5")
    pi = another_robot(model, np.random.default_rng(0))
    return model, *(clean_log(model, seed, pi=pi, rate=50.0, duration=10.0) for seed in (0, 1))


def test_a_load_is_named_beside_a_urdf_of_another_robot(arm_and_log):
    """Links that weigh half or twice what the URDF says are no reason to miss a load."""
    model, *_ = arm_and_log
    rng = np.random.default_rng(4)
    size, pi = model.layout.n_inertial, another_robot(model, rng)
    links = pi[:size].reshape(-1, 10)
    links *= rng.choice([0.5, 2.0], (len(links), 1))
    loaded = pi.copy()
    loaded[:size].reshape(-1, 10)[-1] += [1, 0.03, 0.02, 0.06, 0.006, 0, 0.006, 0, 0, 0.003]
    fitted, kept = (
        clean_log(model, seed, pi=x, rate=50.0, duration=10.0) for seed, x in ((5, pi), (6, loaded))
    )
    (change,) = [f for f in loud(model, fitted, [kept]) if f.code == "payload_change"]
    mass, error = change.evidence["mass"], change.evidence["std_error"]
    assert mass == pytest.approx(1.0, abs=4 * error)
    assert error < 0.05
