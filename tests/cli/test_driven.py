import json
from contextlib import redirect_stdout
from io import StringIO

import numpy as np
import pytest
from helpers.mujoco_plant import plant, torque_log

from robotid.cli import main
from robotid.data.files.read import write_log


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """A job of a planar arm that its logged torque drives."""
    folder, rng = tmp_path_factory.mktemp("driven"), np.random.default_rng(5)
    robot = plant("planar", rng, delay=0.0)
    for name, duration in (("first", 5.0), ("second", 3.0)):
        log = torque_log(robot, rng, duration=duration, noise=2e-5, torque=0.05)
        write_log(log, folder / f"{name}.csv")
    path = folder / "job.toml"
    path.write_text(
        f"""urdf = "{robot.model.tree.path}"

[model]
friction = "viscous+coulomb"

[signals]
cutoff = 30.0

[estimator]
name = "simulation"

[controller]
kind = "torque"

[[identification]]
log = "first.csv"

[[validation]]
log = "second.csv"
"""
    )
    return path


@pytest.fixture(scope="module")
def found(job, tmp_path_factory):
    """The folder of its results, and what was printed."""
    folder, said = tmp_path_factory.mktemp("found") / "out", StringIO()
    with redirect_stdout(said):
        assert main(["identify", str(job), "--out", str(folder)]) == 0
    return folder, said.getvalue()


@pytest.fixture
def folder(found):
    return found[0]


@pytest.fixture
def result(folder):
    return json.loads((folder / "result.json").read_text())


def test_a_job_driven_by_its_torque_writes_errors_beside_those_of_its_rows(folder, result):
    assert result["settings"]["controller"]["kind"] == "torque"
    [run] = result["validation"]
    assert list(run["horizons"]) == ["0.1", "0.5", "2"]
    for joint, own in run["per_joint"].items():
        assert own["command_rmse"] is None
        assert own["rmse"] < 1.1 * own["rows_rmse"] < 0.1 * own["steady_rmse"]
        assert own["rmse"] == pytest.approx(run["horizons"]["0.5"][joint])
    names = {entry["name"].rpartition(".")[2] for entry in result["drive_parameters"]}
    assert names == {"armature", "viscous", "coulomb", "offset"}


def test_its_result_is_validated_on_another_log(folder, job, result, capsys):
    assert main(["validate", str(folder), str(job.parent / "second.csv"), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    [run], [before] = again["validation"], result["validation"]
    for joint, own in run["per_joint"].items():
        assert own["rmse"] == pytest.approx(before["per_joint"][joint]["rmse"], rel=1e-6)
    assert again["verdict"]["status"] != "not evaluated"
    logs = [str(job.parent / f"{name}.csv") for name in ("second", "first")]
    assert main(["validate", str(folder), *logs, "--json"]) == 0
    both = json.loads(capsys.readouterr().out)
    assert both["verdict"]["status"] == "not evaluated", "one of the two was fitted"
    assert both["validation"][0] == run
