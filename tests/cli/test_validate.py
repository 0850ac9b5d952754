"""Validation of a written result: what was fitted shows no prediction, and faults are named."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.base.findings import Finding
from robotid.cli.identify import run_job
from robotid.cli.job import Job, job_from_settings
from robotid.cli.logs import result_run
from robotid.cli.validate import validate
from robotid.data.files.read import write_log

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
        "estimator": {"prior_weight": 1.0},
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
    noisy = other.tau + 30 * NOISE * np.random.default_rng(1).standard_normal(other.tau.shape)
    found = verdict(folder, replace(other, tau=noisy))
    assert found["status"] == "usable"
    assert "0.2 % on the fitted recordings" in found["reasons"][0]


def test_the_weights_of_the_prior_of_a_result_are_those_of_its_logs(arm, here):
    path = here[0] / "out" / "result.json"
    prior = json.loads(path.read_text())["consistency"]["fit"]["prior"]
    *_, run = result_run(Job(Path(arm.tree.path)), path)
    assert run.weight == (1.0, prior["plausible_weight"])


@pytest.mark.parametrize(
    "part", [slice(None), slice(None, None, 2), slice(0, 700)], ids=["all", "thinned", "cut"]
)
def test_fitted_rows_show_no_prediction(here, part):
    folder, first, _ = here
    found = verdict(folder, rows(first, part))
    assert found["status"] == "usable"
    assert "fitted samples are in" in found["reasons"][0]
    assert {joint["status"] for joint in found["per_joint"].values()} == {"not evaluated"}


def test_faults_of_the_new_log_lead_its_verdict(here):
    folder, _, other = here
    v = other.v.copy()
    v[:, 1] *= 0.5
    found = verdict(folder, replace(other, v=v))
    assert found["status"] == "poor"
    assert "dq of joint_2 is 0.5 times d(q)/dt" in found["reasons"][0]


def test_warnings_are_those_of_the_result_and_findings_those_of_the_new_log(here, monkeypatch):
    """A motion that its own validation log repeated says nothing of another log."""
    folder, _, other = here
    path = folder / "out" / "result.json"
    content = json.loads(path.read_text())
    warned = [{"code": code, "joint": "", "message": code} for code in ("repeated_motion", "drift")]
    content["verdict"]["warnings"] = warned
    path.write_text(json.dumps(content))
    for name, status in (("run.csv", "usable"), ("again.csv", "poor")):
        fault = Finding("torque_sign", "error", f"{name}: joint_1", "the torque is reversed")
        monkeypatch.setattr("robotid.cli.validate.diagnose", lambda *_, f=fault: [f])
        found = verdict(folder, other)
        assert found["status"] == status, found["reasons"]
        assert [warning["code"] for warning in found["warnings"]] == ["drift"]


def test_of_two_logs_the_one_that_was_fitted_shows_no_prediction_and_the_other_does(
    here, monkeypatch
):
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
        fault = Finding("torque_sign", "error", "old.csv: joint_1", "the torque is reversed")
        monkeypatch.setattr("robotid.cli.validate.diagnose", lambda *_, f=fault: [f])
    write_log(rows(first, slice(0, 700)), folder / "cut.csv")
    found = validate(result, [folder / "old.csv", folder / "cut.csv"])
    assert (
        "fitted samples are in old.csv 0-9.99 s, cut.csv 0-6.99 s" in found["verdict"]["reasons"][0]
    )
