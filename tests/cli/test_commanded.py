import json
from contextlib import redirect_stdout
from io import StringIO

import pytest
from helpers.replay_data import leave_out_meshes, shown

from robotid.cli import main
from robotid.robot.examples import example_urdf

LEG = ("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint")


@pytest.fixture(scope="module")
def job(recordings, tmp_path_factory):
    """A job of one leg and some seconds of a chirp that a Go2 was told."""
    path = tmp_path_factory.mktemp("commanded") / "job.toml"
    log = recordings / "commands" / "go2" / "chirp.parquet"
    path.write_text(
        f"""urdf = "{example_urdf("go2.urdf")}"
joints = {list(LEG)}

[estimator]
name = "simulation"
window = 1.0
lead = 0.3

[controller]
kp = 20.0
kd = 1.5

[output]
replay = true

[[identification]]
log = "{log}"
start = 6.0
end = 10.0

[[validation]]
log = "{log}"
start = 10.001
end = 12.0
"""
    )
    return path


@pytest.fixture(scope="module")
def found(job, tmp_path_factory):
    """The folder of its results, and what was printed."""
    folder, said = tmp_path_factory.mktemp("found") / "out", StringIO()
    with redirect_stdout(said), pytest.MonkeyPatch.context() as patch:
        leave_out_meshes(patch)
        assert main(["identify", str(job), "--out", str(folder), "--json"]) == 0
    return folder, said.getvalue()


@pytest.fixture
def folder(found):
    return found[0]


@pytest.fixture
def result(folder):
    return json.loads((folder / "result.json").read_text())


def test_a_job_of_commands_writes_what_other_jobs_write(folder, result):
    named = {*result["outputs"].values(), "result.json"}
    assert {path.name for path in folder.iterdir()} == named
    assert {"report.html", "go2.identified.urdf", "go2.identified.drive.json"} <= named
    data = shown((folder / "replay.html").read_text(encoding="utf-8"))
    assert (data["log"], data["torques"]["labels"][1]) == ("chirp.parquet", "simulated")
    assert 10.0 < data["start"] < 10.02  # the validation window
    assert result["joints"] == list(LEG)
    assert {"kind": "pd", "kp": 20.0, "kd": 1.5}.items() <= result["settings"]["controller"].items()
    assert [entry["role"] for entry in result["inputs"]] == ["urdf", "identification", "validation"]


def test_drives_of_a_real_leg_are_as_large_as_they_can_be(result):
    values = {entry["name"]: entry for entry in result["drive_parameters"]}
    for joint in LEG:
        armature = values[f"{joint}.armature"]  # the hip's is not known to differ from 0
        assert 0.0 < armature["value"] < 0.2
        assert armature["value"] + 2.0 * armature["std_error"] > 0.01
        assert armature["std_error"] < 0.01
        assert 0.0 <= values[f"{joint}.coulomb"]["value"] < 2.0
        assert values[f"{joint}.kp"] == {
            "name": f"{joint}.kp", "value": 20.0, "std_error": None, "quantile": None,
            "unit": "N m/rad", "source": "stated",
        }  # fmt: skip
        assert values[f"{joint}.kd"]["std_error"] is None
        delay = values[f"{joint}.delay"]  # not known to differ from 0, its bound
        assert 0.0 <= delay["value"] < 0.01
        assert 0.0 < delay["std_error"] < 0.003
        assert 1.96 <= values[f"{joint}.delay"]["quantile"] < 2.3


def test_a_log_without_commands_ends_with_one_sentence(tmp_path, job, capsys, ur5):
    (tmp_path / "log.csv").write_text(
        "t," + ",".join(f"q_{j}" for j in LEG) + "\n"
        + "".join(f"{k / 500},{0.1 * k},0,0\n" for k in range(20))
    )  # fmt: skip
    text = job.read_text().split("[[identification]]")[0]
    bad = tmp_path / "job.toml"
    bad.write_text(text + '[[identification]]\nlog = "log.csv"\n')
    assert main(["identify", str(bad), "--out", str(tmp_path / "out")]) != 0
    assert "qref_FL_hip_joint" in capsys.readouterr().err
    assert not (tmp_path / "out" / "result.json").exists()
