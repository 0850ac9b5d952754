import json
import re
from dataclasses import replace

import numpy as np
import pytest

from robotid.cli import main
from robotid.excitation.design import Designer
from robotid.logs.formats import open_table
from robotid.logs.settings import LogSource
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

WRIST = ["wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
WORDS = [
    "excite", str(example_urdf("ur10_robot.urdf")), "--joints", ",".join(WRIST),
    "--duration", "4", "--harmonics", "2", "--starts", "1", "--seconds", "0.01",
]  # fmt: skip


def test_a_motion_is_designed_written_and_told(tmp_path, capsys):
    target = tmp_path / "motion.parquet"
    stated = ["--share", "0.5", "--max-acceleration", "wrist_2_joint=3", "--floor", "-2"]
    assert main([*WORDS, "--out", str(target), "--json", *stated, "--points", "50"]) == 0
    content = json.loads(capsys.readouterr().out)
    table = open_table(target, LogSource())
    assert table.names[:2] == ["time", "q_wrist_1_joint"]
    columns = table.read(table.names)
    np.testing.assert_allclose(columns["time"], np.arange(201) / 50)
    model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"), joints=WRIST)
    speed = [np.abs(columns[f"dq_{j.name}"]).max() / (0.5 * j.velocity) for j in model.limits]
    assert max(speed) <= 1.0
    assert 1.0 - content["limits"]["velocity"]["margin"] == pytest.approx(max(speed), abs=0.01)
    assert content["limits"]["velocity"]["where"] == WRIST[int(np.argmax(speed))]
    assert np.abs(columns["ddq_wrist_2_joint"]).max() <= 3.0
    assert set(content["limits"]) == {
        "position", "velocity", "acceleration", "torque", "collision"
    }  # fmt: skip
    assert content["criterion"] == "D"
    assert content["feasible"] is True


def test_a_motion_beyond_a_limit_is_not_called_feasible(tmp_path, capsys, monkeypatch):
    design = Designer.design

    def beyond(*given, **stated):
        found = design(*given, **stated)
        return replace(found, used=1.2 * found.used)

    monkeypatch.setattr(Designer, "design", beyond)
    words = [*WORDS, "--out", str(tmp_path / "motion.csv"), "--json", "--clearance", "none"]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["feasible"] is False


def test_the_terminal_says_what_is_left_of_each_limit(tmp_path, capsys):
    assert main([*WORDS, "--out", str(tmp_path / "motion.yaml"), "--clearance", "none"]) == 0
    said = capsys.readouterr().out
    assert "a motion of 4 s for 3 joints, condition number" in said
    assert "collision" not in said
    assert "not settled" in said
    assert (tmp_path / "motion.yaml").read_text().startswith("joint_names: [wrist_1_joint, ")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--clearance", "near"], "--clearance 'near': wanted metres, or none"),
        (["--box", "post=1,2,3"], "--box 'post=1,2,3': wanted NAME=x0,y0,z0,x1,y1,z1"),
        (["--duration", "-1"], "duration is -1, wanted more than 0"),
        (["--max-jerk", "elbow=3"], "jerk is stated of 'elbow', which is no joint that moves"),
        (["--noise", "wrist_1_joint=-1"], "noise of 'wrist_1_joint' is -1"),
        (["--harmonics", "1"], "harmonics is 1, wanted 2 or more"),
    ],
)
def test_bad_flags_are_refused_before_anything_is_written(tmp_path, capsys, words, message):
    assert main([*WORDS, "--out", str(tmp_path / "m.csv"), *words]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_page_says_what_is_used_of_each_limit_and_draws_it(tmp_path, capsys):
    target, page = tmp_path / "motion.csv", tmp_path / "motion.html"
    stated = ["--max-acceleration", "wrist_2_joint=3", "--floor", "-2", "--report", str(page)]
    assert main([*WORDS, "--out", str(target), "--json", *stated]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["report"] == str(page)
    html = page.read_text()
    shown = {
        cells[0]: cells[1:]
        for row in re.findall(r"<tr>(.*?)</tr>", html)
        if (cells := re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row))
    }
    table = open_table(target, LogSource())
    columns = table.read(table.names)
    for name, unit in (("velocity", "rad/s"), ("acceleration", "rad/s²")):
        entry, cells = content["limits"][name], shown[name]
        assert float(cells[0]) == pytest.approx(100 * (1 - entry["margin"]), abs=0.06)
        assert cells[2].replace("<wbr>", "") == entry["where"]
        assert cells[5] == unit
        values = columns[{"velocity": "dq_", "acceleration": "ddq_"}[name] + entry["where"]]
        at = columns["time"][int(np.argmax(np.abs(values)))]
        assert float(cells[3]) == pytest.approx(at, abs=0.02)
    charts = [
        json.loads(text)
        for text in re.findall(r'<script type="application/json">(.*?)</script>', html)
    ]
    drawn = {chart["title"]: [s["label"] for s in chart["series"]] for chart in charts}
    assert drawn["acceleration of each joint as a share of its limit"][2:] == ["wrist_2_joint"]
    assert drawn["acceleration of each joint"] == ["wrist_1_joint", "wrist_3_joint"]
    assert "floor and boxes" in drawn["distance of the two hulls that are nearest"]
    velocity = next(c for c in charts if c["title"].startswith("velocity"))
    assert velocity["link"] == "time"
    assert [velocity["series"][k]["y"]["low"] for k in (0, 1)] == [100.0, -100.0]
    assert "motion.csv: the motion determines" in html
    assert sorted(path.name for path in tmp_path.iterdir()) == ["motion.csv", "motion.html"]


def test_a_page_that_cannot_be_written_is_refused_before_the_design(tmp_path, capsys):
    words = ["--out", str(tmp_path / "m.csv"), "--report", str(tmp_path / "none" / "m.html")]
    assert main([*WORDS, *words]) == 1
    assert f"{tmp_path / 'none'}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_sweeps_say_what_they_use_of_jerk_and_refuse_what_is_too_little(tmp_path, capsys):
    words = [*WORDS, "--kind", "sweeps", "--clearance", "none", "--json"]
    words += ["--out", str(tmp_path / "m.csv"), "--points", "100", "--max-jerk"]
    assert main([*words, "wrist_2_joint=1000"]) == 0
    content = json.loads(capsys.readouterr().out)
    columns = open_table(tmp_path / "m.csv", LogSource()).read(["time", "ddq_wrist_2_joint"])
    jerk = np.gradient(columns["ddq_wrist_2_joint"], columns["time"])
    used = 1.0 - content["limits"]["jerk"]["margin"]
    assert used == pytest.approx(np.abs(jerk).max() / 1000, rel=0.05)
    assert content["seconds"] > 0.0
    (tmp_path / "m.csv").unlink()
    assert main([*words, "wrist_2_joint=20"]) == 2
    assert "wrist_2_joint needs " in (said := capsys.readouterr().err)
    assert f"{100 * used * 50:.0f} % of its jerk limit at " in said
    assert not list(tmp_path.iterdir())
