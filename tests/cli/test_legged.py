"""Commands on a robot on its feet: a job file, a motion, a log, and what it would determine."""

import json

import numpy as np
import pytest
from helpers.stands import stand

from robotid.cli import main
from robotid.data.base_motion import BaseColumns
from robotid.data.files.formats import open_table, write_columns
from robotid.data.files.read import read_log
from robotid.data.signal_settings import LogSource
from robotid.robot.constraints import Contact
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
JOB = """
urdf = "{urdf}"
free_flyer = true
[model]
armature = false
friction = "viscous"
[[identification]]
log = "{folder}/motion.parquet"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a job file and the motion that it names."""
    folder, urdf = tmp_path_factory.mktemp("legged"), example_urdf("solo12.urdf")
    contacts = "".join(f'[[contact]]\nframe = "{foot}"\n' for foot in FEET)
    (folder / "job.toml").write_text(JOB.format(urdf=urdf, folder=folder) + contacts)
    model = RobotModel.from_urdf(urdf, free_flyer=True, constraints=[Contact(x) for x in FEET])
    rng = np.random.default_rng(0)
    motion = stand(model, np.tile([0.0, 0.8, -1.6], 4), 0.25, rng, parts=2, length=1.0)
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    table = {"time": motion.t} | {f"base_{x}": motion.pose[:, k] for k, x in enumerate(names)}
    table |= {f"q_{joint}": motion.q[:, j] for j, joint in enumerate(model.joints)}
    table |= {f"contact_{x}": motion.contacts[:, k] * 1.0 for k, x in enumerate(FEET)}
    write_columns(table, folder / "motion.parquet")
    return folder


def test_a_motion_becomes_a_log_with_base_and_contacts(folder, capsys):
    job, motion, log = (str(folder / x) for x in ("job.toml", "motion.parquet", "log.parquet"))
    flags = ["--controller", "perfect", "--rate", "50", "--perturb", "0.05", "--json"]
    assert main(["simulate", job, motion, "--out", log, *flags]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["samples"] == 101
    mass = sum(x["value"] for x in content["standard_parameters"] if x["name"].endswith(".m"))
    read = read_log(log, content["joints"], base=BaseColumns(True, FEET))
    weight = np.abs(read.tau).sum(axis=1)
    assert weight.min() > 0.1 * mass
    assert not read.contacts["FL_FOOT"].all()
    assert read.base.twist is not None


def test_a_filtered_motion_keeps_its_contacts_where_stamps_are_missing(folder, capsys):
    """Every fifth row is missing: the filter's rows are even, contacts come from the last row."""
    table = open_table(folder / "motion.parquet", LogSource())
    columns = table.read(table.names)
    kept = np.arange(len(columns["time"])) % 5 != 2
    write_columns({name: column[kept] for name, column in columns.items()}, folder / "few.csv")
    job, motion, out = (str(folder / x) for x in ("job.toml", "few.csv", "few_log.csv"))
    words = ["--controller", "perfect", "--rate", "50", "--cutoff", "10", "--json"]
    assert main(["simulate", job, motion, "--out", out, *words]) == 0
    joints = json.loads(capsys.readouterr().out)["joints"]
    log = read_log(out, joints, base=BaseColumns(True, FEET))
    t, foot = columns["time"], columns["contact_FL_FOOT"] > 0.5
    wanted = foot[np.searchsorted(t, log.t + t[0] - log.t[0])]
    assert not foot.all()
    assert np.mean(log.contacts["FL_FOOT"] == wanted) > 0.97


def test_the_same_motion_with_the_usual_controller_is_refused(folder, capsys):
    job, motion = (str(folder / x) for x in ("job.toml", "motion.parquet"))
    assert main(["simulate", job, motion, "--out", str(folder / "other.csv")]) == 2
    assert "State --controller perfect" in capsys.readouterr().err
