"""From job to result where the URDF or the logs are at fault: what is said of them."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import DataError, SettingsError
from robotid.cli import main
from robotid.cli.identify import _job_of, run_job
from robotid.cli.job import Job, LogEntry
from robotid.data.files.read import write_log
from robotid.data.signal_settings import SignalSettings
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

PLAIN = ("--friction", "viscous+coulomb", "--no-report")


def test_the_error_of_a_robot_at_rest_carries_what_the_doctor_found(arm, rng, tmp_path, capsys):
    log = exact_log(arm, truth(arm), rng, samples=1000, rate=100.0)
    still = np.zeros_like(log.q)
    write_log(replace(log, q=still, v=still, a=still), tmp_path / "rest.csv")
    job = Job(Path(arm.tree.path), identification=(LogEntry(tmp_path / "rest.csv"),))
    with pytest.raises(DataError, match="0 torque rows") as caught:
        run_job(job, tmp_path / "out")
    notes = caught.value.__notes__
    assert any("static_joint" in note and "joint_2 at rest (range 0 rad)" in note for note in notes)
    out = ["--out", str(tmp_path / "out")]
    assert main(["identify", arm.tree.path, str(tmp_path / "rest.csv"), *out]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("robotid: 0 torque rows")
    assert lines[1].startswith("  doctor: warning: ")


def test_files_of_an_earlier_run_do_not_stay_beside_a_new_result(arm, rng, tmp_path, caplog):
    log = exact_log(arm, truth(arm), rng, samples=1000, rate=100.0, noise=1.0)
    write_log(log, tmp_path / "run.csv")
    job = Job(Path(arm.tree.path), identification=(LogEntry(tmp_path / "run.csv"),))
    out = tmp_path / "out"
    _, result = run_job(replace(job, estimator=EstimatorSettings()), out)
    written = [out / result["outputs"][key] for key in ("urdf", "sidecar", "report")]
    assert all(path.exists() for path in written)
    noisy = replace(log, tau=log.tau + 30.0 * rng.standard_normal(log.tau.shape))
    write_log(noisy, tmp_path / "run.csv")
    _, result = run_job(replace(job, estimator=EstimatorSettings("wls"), report=False), out)
    assert result["outputs"] == {}
    assert not any(path.exists() for path in written)
    assert "of an earlier run: this run did not write it" in caplog.text


def test_a_file_in_place_of_the_folder_is_refused_before_the_fit(arm, tmp_path):
    (tmp_path / "out").write_text("")
    job = Job(Path(arm.tree.path), identification=(LogEntry(tmp_path / "none.csv"),))
    with pytest.raises(SettingsError, match="out' is a file, wanted a folder for the results"):
        run_job(job, tmp_path / "out")


def test_a_result_of_reversed_torques_is_no_urdf_and_exit_code_1(arm, rng, tmp_path, capsys):
    for name in ("run.csv", "kept.csv"):
        log = exact_log(arm, truth(arm), rng, samples=1500, rate=100.0, noise=0.2)
        write_log(replace(log, tau=-log.tau), tmp_path / name)
    files = [arm.tree.path, str(tmp_path / "run.csv"), "--validate", str(tmp_path / "kept.csv")]
    command = ["identify", *files, "--out", str(tmp_path / "out"), "--json", *PLAIN]
    assert main(command) == 1
    result = json.loads(capsys.readouterr().out)
    assert "urdf" not in result["outputs"]
    assert not list((tmp_path / "out").glob("*.urdf"))
    assert result["verdict"]["status"] == "poor"
    (said,) = [w["message"] for w in result["warnings"] if w["code"] == "urdf_not_written"]
    assert "URDF not written: torque_sign failed" in said
    assert main([*command, "--ignore", "torque_sign"]) == 0
    assert "urdf" in json.loads(capsys.readouterr().out)["outputs"]


def test_the_job_of_what_was_found_in_memory_builds_the_same_robot():
    fingers = ["panda_joint4", "panda_finger_joint1"]
    model = RobotModel.from_urdf(
        example_urdf("panda.urdf"), joints=fingers, mimic="coupled", gravity=(1.0, -2.0, -9.0),
        locked={"panda_joint1": 0.3, "*": -0.2}, terms=("viscous", "offset"),
        couplings=[Coupling("both", (("panda_joint4", 1.0), ("panda_finger_joint1", 0.5)))],
    )  # fmt: skip
    asked = SimpleNamespace(job=None, friction="none", signals=SignalSettings(), ignore=("spikes",))
    found = SimpleNamespace(
        model=model, stated=asked, loop=LoopSettings(), fitted=(), validation=(),
        estimator=EstimatorSettings("simulation"),
    )  # fmt: skip
    job = _job_of(found)
    again = job.model()
    assert again.layout == model.layout
    assert (again.mimic, again.locked) == (model.mimic, model.locked)
    assert again.options == model.options
    np.testing.assert_array_equal(again.velocity_map, model.velocity_map)
    np.testing.assert_allclose(again.standard_parameters(), model.standard_parameters())
    assert (job.ignore, job.estimator, job.snap_angles) == (("spikes",), found.estimator, False)
