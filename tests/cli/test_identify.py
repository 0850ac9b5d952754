"""From job to result where the URDF or the logs are at fault: what is said of them."""

import hashlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.closed_chains import four_bar
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import file_sha256
from robotid.cli import main
from robotid.cli.identify import _job_of, run_job
from robotid.cli.job import Job, LogEntry
from robotid.data.files.read import write_log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.friction_projection import project_friction
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.pipeline import identify
from robotid.identification.result import TorqueIdentification
from robotid.output.files.urdf import DYNAMICS_TERMS
from robotid.robot.drives import Stribeck
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
    _, result = run_job(replace(job, estimator=EstimatorSettings(draws=0)), out)
    written = [out / result["outputs"][key] for key in ("urdf", "sidecar", "report")]
    assert all(path.exists() for path in written)
    noisy = replace(log, tau=log.tau + 30.0 * rng.standard_normal(log.tau.shape))
    write_log(noisy, tmp_path / "run.csv")
    _, result = run_job(replace(job, estimator=EstimatorSettings("wls"), report=False), out)
    assert result["outputs"] == {}
    assert not any(path.exists() for path in written)
    assert "of an earlier run: this run did not write it" in caplog.text


def test_each_log_is_hashed_once_and_opened_once(arm, rng, tmp_path, monkeypatch):
    log = exact_log(arm, truth(arm), rng, samples=1000, rate=100.0, noise=1.0)
    write_log(log, tmp_path / "made.csv")
    for name in ("run.csv", "keep.csv"):
        shutil.copy(tmp_path / "made.csv", tmp_path / name)
    entries = [LogEntry(tmp_path / "keep.csv", end=end) for end in (4.0, 8.0)]
    job = Job(
        Path(arm.tree.path),
        estimator=EstimatorSettings("wls"),
        report=False,
        identification=(LogEntry(tmp_path / "run.csv"),),
        validation=tuple(entries),
    )
    hashed, opened = [], []
    digest, lay_out = hashlib.file_digest, Job.lay_out
    monkeypatch.setattr(hashlib, "file_digest", lambda f, a: hashed.append(f.name) or digest(f, a))
    monkeypatch.setattr(
        Job, "lay_out", lambda j, e, m, **k: opened.append(e.path) or lay_out(j, e, m, **k)
    )
    run_job(job, tmp_path / "out")
    logs = [str(tmp_path / name) for name in ("keep.csv", "run.csv")]
    assert sorted(str(name) for name in hashed if str(name).endswith(".csv")) == logs
    assert sorted(map(str, opened)) == logs
    before = file_sha256(logs[0])
    (tmp_path / "keep.csv").write_text("other")
    assert file_sha256(logs[0]) != before


def test_a_file_in_place_of_the_folder_is_refused_before_the_fit(arm, tmp_path):
    (tmp_path / "out").write_text("")
    job = Job(Path(arm.tree.path), identification=(LogEntry(tmp_path / "none.csv"),))
    with pytest.raises(SettingsError, match="out' is a file, wanted a folder for the results"):
        run_job(job, tmp_path / "out")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b'{"schema_version":1,"verdict":{}}', "has no entry 'robotid': the file is incomplete"),
        (b"\xff\xfe", "is not JSON"),
    ],
)
def test_a_result_that_is_none_is_refused(tmp_path, capsys, content, said):
    (tmp_path / "result.json").write_bytes(content)
    assert main(["validate", str(tmp_path / "result.json"), "run.csv"]) == 1
    assert f"robotid: result.json {said}" in capsys.readouterr().err


def test_an_inertia_that_no_body_can_have_is_named_and_a_negative_mass_is_refused(
    arm, rng, tmp_path, capsys
):
    log = exact_log(arm, truth(arm), rng, samples=1000, rate=100.0, noise=1.0)
    write_log(log, tmp_path / "log.csv")
    text, urdf = Path(arm.tree.path).read_text(), tmp_path / "robot.urdf"
    command = ["identify", str(urdf), str(tmp_path / "log.csv"), "--out", str(tmp_path / "out")]
    command.append("--no-report")
    urdf.write_text(text.replace('mass value="1.9"', 'mass value="-1.9"', 1))
    assert main(command) == 1
    assert "link 'link_2': inertial mass is -1.9 kg" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    urdf.write_text(text.replace('izz="0.2578947368421053"', 'izz="-0.2578947368421053"', 1))
    assert main(command) == 0
    warnings = json.loads((tmp_path / "out" / "result.json").read_text())["warnings"]
    (finding,) = [w for w in warnings if w["code"] == "not_positive_definite"]
    assert finding["where"] == "link link_2"
    assert (
        "an inertia that no body can have: link_2. Assumed: their stated masses"
        in (finding["message"])
    )


@pytest.fixture
def logs(rng, tmp_path):
    """Two logs of a robot; `spoil` changes both."""

    def write(model, spoil=lambda log: log):
        found = []
        for name in ("run.csv", "kept.csv"):
            log = exact_log(model, truth(model), rng, samples=1500, rate=100.0, noise=0.2)
            found.append(spoil(log))
            write_log(found[-1], tmp_path / name)
        return found

    return write


def test_a_result_of_reversed_torques_is_no_urdf_and_exit_code_1(arm, logs, tmp_path, capsys):
    logs(arm, lambda log: replace(log, tau=-log.tau))
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


def test_a_mass_beyond_a_factor_of_three_is_no_urdf_but_where_it_is_ignored(
    upright, logs, tmp_path, capsys
):
    """Whoever says that a sign is right still gets no robot of another size."""
    logs(upright, lambda log: replace(log, tau=10.0 * log.tau))
    command = ["identify", upright.tree.path, str(tmp_path / "run.csv"), *PLAIN, "--json"]
    command += ["--out", str(tmp_path / "out"), "--ignore", "torque_sign"]
    assert main(command) == 1
    result = json.loads(capsys.readouterr().out)
    assert "urdf" not in result["outputs"]
    (alarm,) = result["verdict"]["log_errors"]
    before, after, _ = result["scale_check"]["masses"]
    assert before == pytest.approx(11.9)
    said = f"total mass is {after:.4g} kg, the URDF's is 11.9 kg; wanted: within a factor of 3"
    assert said in alarm
    assert main([*command, "--ignore", "total_mass"]) == 0
    assert "urdf" in json.loads(capsys.readouterr().out)["outputs"]


def test_the_unit_of_the_torque_off_by_a_thousand_is_no_urdf(arm, logs, tmp_path):
    logs(arm, lambda log: replace(log, tau=1000.0 * log.tau))
    files = [arm.tree.path, str(tmp_path / "run.csv"), "--out", str(tmp_path / "out")]
    assert main(["identify", *files, *PLAIN]) == 1  # judged or not even solved
    assert not list(tmp_path.glob("out/*.urdf"))


@pytest.mark.parametrize("delay", [0.0, 0.02])
def test_python_says_what_the_command_line_says(arm, logs, tmp_path, delay):
    def late(log):
        return replace(
            log, tau=np.column_stack([np.interp(log.t - delay, log.t, tau) for tau in log.tau.T])
        )

    run, kept = logs(arm, late)
    entries = tuple(LogEntry(tmp_path / name) for name in ("run.csv", "kept.csv"))
    settings = {"identification": entries[:1], "validation": entries[1:], "report": False}
    job = Job(Path(arm.tree.path), **settings, estimator=EstimatorSettings("wls"))
    shell = run_job(job, tmp_path / "out")[0].verdict
    named = [replace(log, path=name) for log, name in ((run, "run.csv"), (kept, "kept.csv"))]
    logs = {"logs": named[:1], "validation": named[1:], "estimator": "wls"}
    python = identify(arm, **logs).verdict
    assert {doubt.code for doubt in python.warnings} == ({"torque_delay"} if delay else set())
    assert python.status == shell.status
    assert python.warnings == shell.warnings
    if not delay:
        return
    blind = identify(arm, **logs, doctor=False)
    known = identify(arm, **logs, ignore=["torque_delay"])
    assert "torque_delay" not in {doubt.code for doubt in (*blind.warnings, *known.warnings)}
    assert known.findings != blind.findings
    with pytest.raises(SettingsError, match=r"has the code 'late', which is unknown or changes"):
        identify(arm, named[:1], ignore=["late"])


def test_the_robot_of_a_result_is_that_of_the_job_that_is_saved_with_it(arm):
    """Of an identification made in Python, whose job is made up afterwards."""
    model = RobotModel.from_urdf(
        arm.tree,
        joints=["joint_2", "joint_1"],
        gravity=(1.0, -2.0, 3.0),
        terms=("viscous", "offset"),
        couplings=(Coupling("motor", (("joint_1", 2.0), ("joint_2", -3.0))),),
        own_terms={"joint_1": [Stribeck(speed=0.3)]},
    )
    asked = SimpleNamespace(
        job=None, friction={"*": ""}, signals=SignalSettings(cutoff=5.0), ignore=("late",)
    )
    estimator = EstimatorSettings(draws=17)
    found = object.__new__(TorqueIdentification)
    vars(found).update(
        model=model, asked=asked, drives=(), estimator=estimator, fitted=(), validation=()
    )
    job = _job_of(found)
    again = job.model()
    assert again.joints == model.joints
    assert again.options == model.options
    assert again.options["gravity"] == [1.0, -2.0, 3.0]
    assert again.layout.names == model.layout.names
    assert again.layout.couplings == model.layout.couplings
    assert again.layout.own == model.layout.own
    assert (job.signals.cutoff, job.ignore, job.estimator) == (5.0, ("late",), estimator)


def test_dynamics_of_the_urdf_are_the_nearest_to_friction_of_more_terms(arm, arm_logs, tmp_path):
    job = Job(
        Path(arm.tree.path),
        identification=(LogEntry(arm_logs / "fit.csv"),),
        terms=("armature", "viscous", "coulomb", "offset"),
        drives={"joint_2": (Stribeck(speed=0.3),)},
        estimator=EstimatorSettings(draws=0, prior_weight=1.0),
        report=False,
        dynamics=True,
    )
    found, result = run_job(job, tmp_path)
    nearest = project_friction(found.model, found.standard, found.moments, DYNAMICS_TERMS)
    (drive,) = nearest.drives
    assert drive.name == "joint_2"
    value = dict(zip(found.model.layout.names, found.standard, strict=True))
    text = (tmp_path / result["outputs"]["urdf"]).read_text()
    for joint, own in (
        ("joint_1", {term: value[f"joint_1.{term}"] for term in DYNAMICS_TERMS}),
        ("joint_2", drive.values),
    ):
        (stated,) = re.findall(rf'<joint name="{joint}".*?<dynamics (.*?)/>', text, re.DOTALL)
        figures = dict(re.findall(r'(\w+)="([^"]*)"', stated))
        assert float(figures["damping"]) == pytest.approx(own["viscous"], rel=1e-9)
        assert float(figures["friction"]) == pytest.approx(own["coulomb"], rel=1e-9)
    assert abs(drive.values["viscous"] - value["joint_2.viscous"]) > 1e-4


def test_the_job_of_what_was_found_in_memory_builds_the_same_robot():
    fingers = ["panda_joint4", "panda_finger_joint1"]
    model = RobotModel.from_urdf(
        example_urdf("panda.urdf"), joints=fingers, mimic="coupled", gravity=(1.0, -2.0, -9.0),
        locked={"panda_joint1": 0.3, "*": -0.2}, terms=("viscous", "offset"),
        couplings=[Coupling("both", (("panda_joint4", 1.0), ("panda_finger_joint1", 0.5)))],
    )  # fmt: skip
    asked = SimpleNamespace(job=None, friction="none", signals=SignalSettings(), ignore=("spikes",))
    found = SimpleNamespace(
        model=model, asked=asked, loop=LoopSettings(), fitted=(), validation=(),
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


def test_the_job_of_a_closed_chain_in_memory_closes_it(tmp_path):
    model = four_bar(tmp_path)
    asked = SimpleNamespace(job=None, friction="none", signals=SignalSettings(), ignore=())
    found = SimpleNamespace(
        model=model, asked=asked, loop=LoopSettings(), fitted=(), validation=(),
        estimator=EstimatorSettings("simulation"),
    )  # fmt: skip
    again = _job_of(found).model()
    assert len(model.loops) == 1
    assert again.loops == model.loops
    assert again.passive == model.passive
