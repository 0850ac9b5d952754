"""A project folder that is moved or renamed still works; ``$`` in names stands for itself."""

import json
import shutil

import numpy as np
from helpers.paths import URDF
from helpers.synthetic import exact_log, truth

import robotid
from robotid.cli import main


def test_a_renamed_project_works(tmp_path, monkeypatch, capsys):
    """Robot, logs and results have the same relative places; ``$`` in a flag is no variable."""
    old, new, rng = tmp_path / "old", tmp_path / "new $TODAY", np.random.default_rng(0)
    (old / "logs").mkdir(parents=True)
    shutil.copy(URDF / "planar_2r.urdf", old / "robot.urdf")
    model = robotid.RobotModel.from_urdf(old / "robot.urdf")
    for name in ("fit", "check", "later"):
        log = exact_log(model, truth(model), rng, samples=400, noise=0.1)
        robotid.write_log(log, old / "logs" / f"{name}.csv")
    robotid.write_log(log, old / "logs" / "later.parquet")
    monkeypatch.chdir(old)
    fit = ["robot.urdf", "logs/fit.csv", "--validate", "logs/check.csv", "--out", "out"]
    assert main(["identify", *fit]) == 0
    old.rename(new)
    urdf, result = str(new / "robot.urdf"), str(new / "out")
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    for words in (
        ["validate", result + "/result.json", str(new / "logs/later.parquet")],
        ["preview", urdf, str(new / "logs/later.csv"), "--given", result],
        ["replay", urdf, str(new / "logs/later.csv"), result],
        ["export", result, "--format", "mjcf", "--out", str(new / "robot.xml")],
        ["identify", urdf, str(new / "logs/fit.csv"), "--out", str(new / "again")],
    ):
        assert main(words) == 0, capsys.readouterr().err
    inputs = robotid.load_result(result).content["inputs"]
    assert [entry["path"] for entry in inputs] == [
        str(new / name) for name in ("robot.urdf", "logs/fit.csv", "logs/check.csv")
    ]
    assert "old" in json.loads((new / "out" / "result.json").read_text())["settings"]["urdf"]
    (new / "logs" / "fit.csv").write_text("another log")
    assert main(["preview", urdf, str(new / "logs/later.csv"), "--given", result]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert f"{old / 'logs/fit.csv'}, a fitted log of" in said
