"""Parts of the URDF that were not mounted, loads that only the validation log has."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.corruptions import NOISE, clean_log, robot
from helpers.synthetic import perfect

from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulation_settings import Sensors
from robotid.dynamics.simulation.truth import another_robot
from robotid.robot.bodies import link_places

CODES = {"unmounted_part", "payload_change", "payload"}


def loud(model, fitted, kept=()):
    found = diagnose(model, [fitted], list(kept), SignalSettings())
    return [f for f in found if f.code in CODES and f.severity != "note"]


def recorded(model, seed, without=0.0):
    """Simulate an arm whose links are 10 to 30 % off, without some parameters of the last one."""
    rng = np.random.default_rng(seed)
    size, pi = model.layout.n_inertial, model.standard_parameters()
    links = pi[:size].reshape(-1, 10)
    links[-1] -= without
    links *= 1 + rng.uniform(0.1, 0.3, (len(links), 1)) * rng.choice([-1, 1], (len(links), 1))
    pi[size:] = [rng.uniform(*term.typical) for _, term in model.layout.drive_parameters]
    motion = random_fourier(model, rng, period=5.0)
    sensors = Sensors(noise=NOISE)
    return perfect(model, pi, motion, rng, rate=100.0, duration=10.0, sensors=sensors)


def test_a_hand_that_was_not_mounted_is_named():
    panda = robot("panda")
    parts = [p for p in link_places(panda) if p.body == 6 and p.role != "moved"]
    hand = np.sum([p.parameters for p in parts], axis=0)
    (found,) = loud(panda, recorded(panda, 0, hand))
    assert (found.code, found.where) == ("unmounted_part", "log: panda_link7")
    assert found.evidence["mass"] == pytest.approx(0.76)
    assert "without panda_hand, panda_leftfinger, panda_rightfinger" in found.message
    assert loud(panda, recorded(panda, 0)) == []


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
