"""Validation of a written result: what was fitted shows no prediction, and faults are named."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.cli.identify import run_job
from robotid.cli.job import job_from_settings
from robotid.cli.validate import _expected, validate
from robotid.data.files.read import write_log
from robotid.data.log import Trajectory
from robotid.dynamics.torque import joint_torque_regressor

NOISE = np.array([0.2, 0.05])  # [N m]


@pytest.fixture(scope="module")
def made(arm, tmp_path_factory):
    """A result of one log without validation, the log, and another one."""
    tmp_path = tmp_path_factory.mktemp("validate")
    rngs = np.random.default_rng(0).spawn(2)
    first, other = (
        exact_log(arm, truth(arm), rng, samples=1000, rate=100.0, noise=NOISE) for rng in rngs
    )
    write_log(first, tmp_path / "run.csv")
    table = {
        "urdf": arm.tree.path,
        "identification": [{"log": "run.csv"}],
        "model": {"friction": "viscous+coulomb"},
        "estimator": {"prior_weight": 1.0, "draws": 0},
        "output": {"report": False},
    }
    run_job(job_from_settings(table, "job.toml", tmp_path), tmp_path / "out")
    return tmp_path, first, other


@pytest.fixture
def here(made, tmp_path):
    """A copy of it that a test may change."""
    folder, first, other = made
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    result = tmp_path / "out" / "result.json"
    result.write_text(result.read_text().replace(str(folder), str(tmp_path)))
    return tmp_path, first, other


def verdict(folder, log):
    write_log(log, folder / "again.csv")
    return validate(folder / "out" / "result.json", [folder / "again.csv"])["verdict"]


def rows(log, chosen):
    return replace(log, **{key: getattr(log, key)[chosen] for key in ("t", "q", "v", "a", "tau")})


def test_another_motion_is_a_prediction(here):
    folder, _, other = here
    found = verdict(folder, other)
    assert found["status"] == "good", found["reasons"]


def test_figures_of_the_fitted_log_are_those_of_the_result(here):
    path = here[0] / "out" / "result.json"
    [found] = validate(path, [here[0] / "run.csv"])["validation"]
    stated = json.loads(path.read_text())["identification"]["per_joint"]
    assert found["per_joint"].keys() == stated.keys()
    for joint, own in stated.items():
        assert own["urdf_with_drives_relative_error_pct"] > 0
        assert own.keys() == found["per_joint"][joint].keys()
        for key, value in own.items():
            told = found["per_joint"][joint][key]
            assert told == (value if isinstance(value, str) else pytest.approx(value, rel=1e-4))


@pytest.mark.parametrize(
    "part", [slice(None), slice(None, None, 2), slice(0, 700)], ids=["all", "thinned", "cut"]
)
def test_fitted_rows_show_no_prediction(here, part):
    folder, first, _ = here
    found = verdict(folder, rows(first, part))
    assert found["status"] == "usable"
    assert "contain fitted samples" in found["reasons"][0]
    assert {joint["status"] for joint in found["per_joint"].values()} == {"not evaluated"}


def test_faults_of_the_new_log_lead_its_verdict(here):
    folder, _, other = here
    v = other.v.copy()
    v[:, 1] *= 0.5
    found = verdict(folder, replace(other, v=v))
    assert found["status"] == "poor"
    assert "dq_joint_2 is 0.5 times d(q)/dt" in found["reasons"][0]


def test_of_two_logs_the_one_that_was_fitted_shows_no_prediction_and_the_other_does(here):
    folder, first, other = here
    for name, log in (("new", other), ("old", first)):
        write_log(log, folder / f"{name}.csv")
    result = folder / "out" / "result.json"
    alone = validate(result, [folder / "new.csv"])
    for names in (("new", "old"), ("old", "new")):
        found = validate(result, [folder / f"{name}.csv" for name in names])
        assert [entry["log"] for entry in found["validation"]] == [
            str(folder / f"{name}.csv") for name in names
        ]
        own = found["validation"][names.index("new")]
        assert own["per_joint"] == alone["validation"][0]["per_joint"]
        assert found["verdict"] == alone["verdict"]
    write_log(rows(first, slice(0, 700)), folder / "cut.csv")
    found = validate(result, [folder / "old.csv", folder / "cut.csv"])
    assert (
        "old.csv 0-9.99 s, cut.csv 0-6.99 s contain fitted samples"
        in found["verdict"]["reasons"][0]
    )


def test_the_expected_error_has_the_parts_of_fit_spread_and_residual(arm, rng, monkeypatch):
    """The true errors have 1.2 times the deviation, joint by joint; some samples are not used."""
    size, count, noise = len(arm.layout.names), 300, np.array([0.3, 0.1])
    q, v, a = rng.uniform(-2.0, 2.0, (3, count, 2))
    of_fit, of_logs = (x @ x.T for x in 0.05 * rng.standard_normal((2, size, size)))
    monkeypatch.setattr(validate, "stated_covariance", lambda result, names: of_fit)
    Y = joint_torque_regressor(arm, q, v, a).reshape(count, 2, size)
    mask = rng.random((count, 2)) > 0.3
    result = {
        "identification": {
            "per_joint": {
                joint: {"rmse": x} for joint, x in zip(arm.joints, noise.tolist(), strict=True)
            }
        }
    }
    for spread in (None, of_logs):
        monkeypatch.setattr(validate, "stated_between", lambda *_, own=spread: own)
        C = of_fit if spread is None else of_fit + spread
        total = np.sqrt(np.einsum("kjp,pq,kjq->kj", Y, C, Y) + noise**2)
        z = 1.2 * rng.standard_normal((count, 2))
        tau = rng.standard_normal((count, 2))
        segment = np.zeros(count, dtype=int)
        motion = Trajectory(np.arange(count) / 100.0, q, v, a, tau, arm.joints, None, segment)
        evaluation = SimpleNamespace(
            recording=SimpleNamespace(trajectory=motion, mask=mask),
            torques={"estimate": tau - z * total},
        )
        found = _expected(result, arm, evaluation)["expected"]
        assert found["with_spread"] is (spread is not None)
        for j, own in enumerate(found["per_joint"].values()):
            assert own["rmse"] == pytest.approx(np.sqrt(np.mean(total[:, j] ** 2)), rel=1e-9)
            inside = np.abs(z[mask[:, j], j]) <= 1.96
            assert own["within_95_pct"] == pytest.approx(100 * inside.mean(), abs=0.5)
