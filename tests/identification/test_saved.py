"""What an identification made in Python writes: the files of the command line, read as such."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.synthetic import exact_log, truth

import robotid
from robotid.cli.identify import run_job
from robotid.cli.job import job_from_settings

URDF = ROOT / "urdf" / "planar_2r.urdf"


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two logs of a planar arm, in files, and the folder of these."""
    folder, rng = tmp_path_factory.mktemp("logs"), np.random.default_rng(0)
    model = robotid.RobotModel.from_urdf(URDF)
    for name in ("first", "second"):
        log = exact_log(model, truth(model), rng, samples=800, noise=0.1)
        robotid.write_log(log, folder / f"{name}.csv")
    return folder


@pytest.fixture(scope="module")
def found(logs):
    return robotid.identify(
        robotid.RobotModel.from_urdf(URDF, locked={}),
        [robotid.read_log(logs / "first.csv", ("joint_1", "joint_2"), end=12.0)],
        validation=[robotid.read_log(logs / "second.csv", ("joint_1", "joint_2"))],
        signals=robotid.SignalSettings(cutoff=6.0),
        estimator=robotid.EstimatorSettings(),
        friction={"*": "", "joint_2": "cubic"},
        ignore=["torque_sign"],
    )


@pytest.fixture(scope="module")
def saved(found, tmp_path_factory):
    return robotid.save_result(found, tmp_path_factory.mktemp("saved") / "result")


def test_the_files_are_those_of_the_command_line_and_hold_what_was_found(saved, found):
    assert {path.name for path in saved.parent.iterdir()} == {
        "result.json",
        "report.html",
        "planar_2r.identified.urdf",
        "planar_2r.identified.drive.json",
    }
    loaded = robotid.load_result(saved.parent)
    np.testing.assert_allclose(loaded.parameters, found.standard, rtol=1e-9, atol=1e-12)
    assert loaded.verdict == found.verdict.to_dict()


def test_the_settings_are_a_job_that_finds_the_same_again(saved, found, logs, tmp_path):
    settings = json.loads(saved.read_text())["settings"]
    job = job_from_settings(settings, "result.json", Path())
    assert job.signals == found.stated.signals
    assert job.estimator == found.estimator
    assert job.drives == {"joint_2": ("cubic",)}
    assert job.ignore == ("torque_sign",)
    (entry,) = job.identification
    assert (entry.path, entry.end) == (logs / "first.csv", 12.0)
    again, _ = run_job(replace(job, report=False), tmp_path)
    assert again.model.layout == found.model.layout
    np.testing.assert_allclose(again.standard, found.standard, rtol=1e-9)


def test_what_a_job_found_is_saved_with_the_job_that_was_run(logs, tmp_path):
    table = {
        "urdf": str(URDF),
        "torque": {"gains": {"joint_1": 3.0}},
        "output": {"report": False},
        "identification": [{"log": str(logs / "first.csv")}],
    }
    found, result = run_job(job_from_settings(table, "job.toml", logs), tmp_path / "one")
    path = robotid.save_result(found, tmp_path / "two", report=False)
    assert json.loads(path.read_text())["settings"] == result["settings"]
    assert result["settings"]["torque"]["gains"] == {"joint_1": 3.0}
