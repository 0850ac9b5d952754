"""What a user sees on a terminal of 80 columns: progress, wrapped lines, little colour."""

import re

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid._typing import STAGES
from robotid.cli import main
from robotid.commands.console import terminal_progress
from robotid.identification.pipeline import identify
from robotid.logs.read import write_log
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

URDF = str(example_urdf("ur5_robot.urdf"))


@pytest.fixture(scope="module")
def log():
    model, rng = RobotModel.from_urdf(URDF), np.random.default_rng(0)
    return exact_log(model, truth(model), rng, samples=900, rate=100.0, noise=0.1)


def test_python_hears_of_each_stage_of_logs_in_memory(log):
    heard = []
    model = RobotModel.from_urdf(URDF)
    identify(
        model, [log], estimator="wls", friction="viscous", progress=lambda *told: heard.append(told)
    )
    assert heard == [(name, k, 5, "stages") for k, name in enumerate(STAGES) if 0 < k < 4]


def test_verbose_says_the_stages_where_there_is_no_terminal(log, tmp_path, capsys):
    write_log(log, tmp_path / "fit.csv")
    words = ["identify", URDF, str(tmp_path / "fit.csv"), "--estimator", "wls", "--no-report"]
    assert main([*words, "--out", str(tmp_path / "out"), "--json", "--verbose"]) == 0
    assert "1/5" not in capsys.readouterr().err, "beside JSON nothing is said"
    assert main([*words, "--out", str(tmp_path / "out"), "--verbose"]) == 0
    printed = capsys.readouterr()
    said = re.findall(r"^robotid: (\d)/5 (.*)$", printed.err, re.MULTILINE)
    assert said == [(str(k + 1), name) for k, name in enumerate(STAGES)]
    assert "/5 " not in printed.out


def test_a_stage_stays_above_the_work_it_consists_of(capsys):
    with terminal_progress(force=True) as show:
        show("fitting", 2, 5, "stages")
        show("reducing", 50, 100, "samples")
    assert re.search(r"3/5 fitting.*\n.*    reducing.*50 %", capsys.readouterr().err)
