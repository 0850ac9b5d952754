import json

import numpy as np
import pytest

from robotid.cli import main
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
    assert content["feasible"]


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
