"""From job to result, from files or in memory: what is said of URDF and logs, what can be moved."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.mujoco_plant import plant, torque_log
from helpers.synthetic import exact_log, truth

import robotid
from robotid.base.exceptions import DataError, SettingsError
from robotid.cli import main
from robotid.cli.identify import _job_of, run_job
from robotid.cli.job import Job, LogEntry, read_job
from robotid.data.files.read import write_log
from robotid.data.signal_settings import SignalSettings
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.identification.closed_loop.from_commands import PositionIdentification
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
    assert any("static_joint" in note and "joint_2 did not move (range 0" in note for note in notes)
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
    with pytest.raises(SettingsError, match="out' is a file, expected a folder for the results"):
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


def test_a_simulation_finds_in_memory_what_a_job_finds_of_the_same_logs(tmp_path):
    settings = {"bodies": 0.0, "step": 4e-3, "torques": False}
    rng = np.random.default_rng(5)
    robot = plant("planar", rng, delay=0.0)
    logs = [torque_log(robot, rng, duration=d, noise=2e-5, torque=0.05) for d in (3.0, 2.0)]
    found = robotid.identify(
        robot.model, logs[0], validation=logs[1], controller={"kind": "torque"}, doctor=False,
        friction="viscous+coulomb", estimator=EstimatorSettings("simulation", **settings),
    )  # fmt: skip
    for name, log in zip(("log", "kept"), logs, strict=True):
        robotid.write_log(log, tmp_path / f"{name}.csv")
    (tmp_path / "job.toml").write_text(
        f"urdf = '{robot.model.tree.path}'\n[model]\nfriction = 'viscous+coulomb'\n"
        "[estimator]\nname = 'simulation'\nbodies = 0.0\nstep = 4e-3\ntorques = false\n"
        "[controller]\nkind = 'torque'\n[[identification]]\nlog = 'log.csv'\n"
        "[[validation]]\nlog = 'kept.csv'\n[output]\nreport = false\n"
    )
    again, _ = run_job(read_job(tmp_path / "job.toml"), tmp_path / "out")
    assert isinstance(found, PositionIdentification)
    np.testing.assert_allclose(found.standard, again.standard, rtol=1e-6, atol=1e-9)
    assert len(found.validation) == 1
    assert found.verdict.status == again.verdict.status
    alone = replace(again, stated=replace(again.stated, job=None))  # as if it came of these files
    saved = robotid.load_result(robotid.save_result(alone, tmp_path / "alone", report=False))
    for role, log in zip(("identification", "validation"), logs, strict=True):
        (entry,) = saved.content["settings"][role]
        assert (entry["start"], entry["end"]) == pytest.approx((log.t[0], log.t[-1]), abs=1e-6)


def test_a_simulation_selects_friction_that_is_not_stated(arm, arm_logs, monkeypatch):
    place, chooses = "robotid.identification.closed_loop.from_commands.identify_loops", []
    monkeypatch.setattr(place, lambda *_, **stated: chooses.append(stated["chooses"]))
    for friction in ("auto", "viscous+coulomb"):
        robotid.identify(
            arm, arm_logs / "fit.csv", estimator="simulation", controller={"kind": "torque"},
            friction=friction, doctor=False,
        )  # fmt: skip
    assert chooses == [True, False]


def test_a_job_file_and_its_settings_in_python_find_the_same(arm, arm_logs, tmp_path):
    urdf, log, job = arm.tree.path, arm_logs / "fit.csv", tmp_path / "job.toml"
    job.write_text(
        f'urdf = "{urdf}"\n[model]\nfriction = "viscous+coulomb"\n'
        f'[[identification]]\nlog = "{log}"\n'
    )
    found = robotid.identify(job)
    same = robotid.identify(urdf, log, friction="viscous+coulomb")
    np.testing.assert_allclose(same.base, found.base, rtol=1e-9)
    assert same.verdict.status == found.verdict.status
    codes = [[f.code for f in robotid.doctor(*given)] for given in ((job,), (urdf, log))]
    assert codes[0] == codes[1]
    for given, options, words in (
        (job, {"signals": robotid.SignalSettings()}, "set validation, signals, controller"),
        (job, {"validation": log}, "set validation"),
        (urdf, {}, "no log is given"),
    ):
        with pytest.raises(SettingsError, match=words):
            robotid.identify(given, **options)


def test_a_result_is_exported_from_memory_as_from_its_folder(arm, arm_logs, tmp_path):
    found = robotid.identify(arm, arm_logs / "fit.csv", friction="viscous+coulomb")
    robotid.save_result(found, tmp_path / "out", report=False)
    robotid.export(tmp_path / "out", "sdf", tmp_path / "a.sdf")
    robotid.export(found, "sdf", tmp_path / "b.sdf")
    texts = [(tmp_path / name).read_text() for name in ("a.sdf", "b.sdf")]
    assert texts[0] == texts[1]
    verdict = robotid.validate(tmp_path / "out", [arm_logs / "keep.csv"])["verdict"]
    assert verdict["status"] in ("good", "usable")
    compared = robotid.compare([tmp_path / "out"] * 2, tmp_path / "page.html")
    assert not any(x["differences"][-1] for x in compared["base_parameters"])
    assert (tmp_path / "page.html").is_file()


def test_a_renamed_project_works(arm, tmp_path, monkeypatch, capsys):
    """Robot, logs and results have the same relative places; ``$`` in a flag is no variable."""
    old, new, rng = tmp_path / "old", tmp_path / "new $TODAY", np.random.default_rng(0)
    (old / "logs").mkdir(parents=True)
    shutil.copy(arm.tree.path, old / "robot.urdf")
    for name in ("fit", "check", "later"):
        log = exact_log(arm, truth(arm), rng, samples=400, noise=0.1)
        robotid.write_log(log, old / "logs" / f"{name}.csv")
    robotid.write_log(log, old / "logs" / "later.parquet")
    monkeypatch.chdir(old)
    fit = ["robot.urdf", "logs/fit.csv", "--validate", "logs/check.csv", "--out", "out"]
    assert main(["identify", *fit, "--no-report"]) == 0
    old.rename(new)
    urdf, result = str(new / "robot.urdf"), str(new / "out")
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    for words in (
        ["validate", result + "/result.json", str(new / "logs/later.parquet")],
        ["preview", urdf, str(new / "logs/later.csv"), "--given", result],
        ["replay", urdf, str(new / "logs/later.csv"), result],
        ["export", result, "--format", "mjcf", "--out", str(new / "robot.xml")],
        ["identify", urdf, str(new / "logs/fit.csv"), "--no-report", "--out", str(new / "again")],
    ):
        assert main(words) == 0, capsys.readouterr().err
    inputs = robotid.load_result(result).content["inputs"]
    assert [entry["path"] for entry in inputs] == [
        str(new / name) for name in ("robot.urdf", "logs/fit.csv", "logs/check.csv")
    ]
    assert "old" in json.loads((new / "out" / "result.json").read_text())["settings"]["urdf"]
    (new / "logs" / "fit.csv").write_text("another log")
    assert main(["preview", urdf, str(new / "logs/later.csv"), "--given", result]) == 1
    assert f"{old / 'logs/fit.csv'}, a fitted log of" in " ".join(capsys.readouterr().err.split())
