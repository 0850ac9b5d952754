"""Estimators, choices of friction and payloads: figures as stored, and beside what is true."""

import numpy as np
import pytest
from helpers.figure_runs import CURRENTS, ESTIMATORS, LOAD
from helpers.hoist import DRIVES, NOISE, motion, parameters, regressor_torque, standardised


@pytest.mark.parametrize("name", ["estimators", "choice", "payload"])
def test_all_figures_are_those_that_are_stored(same, name):
    same(name)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_estimates_scatter_about_the_truth_as_their_errors_say(ran, name):
    known = ran("estimators")[1]
    z = standardised(known["results"][name], parameters(known["hoist"]))
    assert len(z) == 13
    assert 0.3 < np.sqrt(np.mean(z**2)) < 2.0
    assert np.abs(z).max() < 4.5


def test_least_squares_are_those_of_numpy_on_the_true_motion(ran):
    """No filter there: estimates differ by what noise does, standard errors by what it leaves."""
    known = ran("estimators")[1]
    hoist, found = known["hoist"], known["results"]["ols"]["base_parameters"]
    names = [entry["name"] for entry in found]
    none = dict.fromkeys(parameters(hoist), 0.0)
    blocks, torques = [], []
    for seed, seconds, rate, noise in ((31, 8, 100, 1.0), (32, 5, 80, 1.5)):
        t = np.arange(seconds * rate) / rate
        q, v, a = motion(hoist.joints, seed, t, 1.4)
        W = [regressor_torque(hoist, none | {name: 1.0}, q, v, a) for name in names]
        blocks.append(np.stack(W, axis=-1).reshape(-1, len(names)))
        rng = np.random.default_rng(seed + 1000)
        levels = noise * np.array([NOISE[joint] for joint in hoist.joints])
        torques.append((hoist.torque(q, v, a) + levels * rng.standard_normal(q.shape)).ravel())
    W, tau = np.vstack(blocks), np.concatenate(torques)
    theta, residual = np.linalg.lstsq(W, tau)[:2]
    variance = residual[0] / (len(tau) - len(names))
    error = np.sqrt(variance * np.diag(np.linalg.inv(W.T @ W)))
    own = np.array([[entry["value"], entry["std_error"]] for entry in found])
    assert np.abs((own[:, 0] - theta) / error).max() < 2
    ratios = own[:, 1] / error
    assert 0.7 < np.median(ratios) < 1.8
    assert ratios.min() > 0.3
    assert ratios.max() < 2.5


def test_friction_that_drives_have_is_found(ran):
    results = ran("choice")[1]["results"]
    assert results["chosen"]["friction"]["lift"]["families"] == ["load"]
    assert {f["code"] for f in results["stated"]["warnings"]} >= {"load_friction", "spring"}
    for name, joint, term, true in (
        ("chosen", "lift", "load", 0.12), ("pieces", "lift", "load", 0.12),
        ("pieces", "reach", "spring", 35.0), ("pieces", "reach", "cubic", 0.0),
        ("pieces", "reach", "armature", DRIVES["reach"].armature),
    ):  # fmt: skip
        [entry] = [
            e for e in results[name]["drive_parameters"] if e["name"] == f"{joint}.{term}"
        ]  # fmt: skip
        assert abs(entry["value"] - true) < 4 * entry["std_error"], (name, joint, term)
    [line] = [f["message"] for f in results["stated"]["warnings"] if f["code"] == "spring"]
    size, error = line.partition("joint: ")[2].partition(" N/m")[0].split(" +- ")
    assert abs(float(size) - 35.0) < 3 * float(error)
    assert float(error) < 2


def test_payload_and_gains_are_those_of_the_robot(ran):
    known = ran("payload")[1]
    [found] = known["payload"]["payloads"]
    assert abs(found["mass"] - LOAD[0]) < 3 * found["mass_std_error"]
    assert 0.005 < found["mass_std_error"] < 0.05
    low, high = found["mass_interval"]
    assert (high - low) / 2 == pytest.approx(1.96 * found["mass_std_error"], rel=0.1)
    assert set(known["gains"]["gains"]) == {"lift", "reach"}
    for joint, gain in known["gains"]["gains"].items():
        assert abs(gain["gain"] - CURRENTS[joint]) < 3.5 * gain["std_error"]
        assert gain["std_error"] < 0.03 * CURRENTS[joint]
