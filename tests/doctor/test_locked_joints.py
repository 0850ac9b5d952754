"""Positions that a job states of held joints, against what the logs say of them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.commands.identify import run_job
from robotid.commands.job import Job, LogEntry
from robotid.commands.logs import examine
from robotid.identification.settings import EstimatorSettings
from robotid.logs.read import read_log, write_log
from robotid.logs.settings import LogUnits
from robotid.robot.examples import example_urdf

HELD = "wrist_3_joint"


@pytest.fixture
def job(ur5, rng, tmp_path):
    """Hold the last joint, which the log says to be at 0.7 rad; or to move, if not still."""

    def make(stated, *, still=True, **options):
        log = exact_log(ur5, truth(ur5), rng, samples=1000, rate=100.0, noise=0.1)
        if still:
            q, v = log.q.copy(), log.v.copy()
            q[:, -1], v[:, -1] = 0.7, 0.0
            log = replace(log, q=q, v=v, a=None)
        write_log(log, tmp_path / "run.csv")
        return Job(
            example_urdf("ur5_robot.urdf"),
            joints=ur5.joints[:-1],
            locked={} if stated is None else {HELD: stated},
            identification=(LogEntry(tmp_path / "run.csv"),),
            report=False,
            **options,
        )

    return make


def found(job):
    return [f for f in examine(job) if f.code == "locked_position"]


@pytest.mark.parametrize(("stated", "said"), [(0.5, "at 0.5,"), (None, "at 0, unasked,")])
def test_a_joint_that_stands_elsewhere_is_named_with_its_position(job, stated, said):
    (finding,) = found(job(stated))
    assert (finding.severity, finding.where) == ("error", f"run.csv: {HELD}")
    assert said in finding.message
    assert f"state locked = {{ {HELD} = 0.7 }}" in finding.message


def test_a_joint_that_moves_is_named_and_leads_the_verdict(job, tmp_path):
    moving = job(0.0, still=False, estimator=EstimatorSettings("wls"))
    (finding,) = found(moving)
    assert finding.evidence["range"] > 0.1
    assert "identify wrist_3_joint, too" in finding.message
    identification, _ = run_job(moving, tmp_path / "out")
    assert identification.verdict.reasons[0] == finding.message
    assert found(replace(moving, identification=())) == []


def test_a_joint_that_stands_where_it_is_said_to_is_not_named(job):
    assert found(job(0.7)) == []


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_held_joints_are_checked_in_logs_read_in_pieces_too(job, tmp_path, suffix, monkeypatch):
    monkeypatch.setattr("robotid.identification.survey._WINDOW", 300)
    short = job(0.5)
    path = tmp_path / f"run.{suffix}"
    write_log(read_log(tmp_path / "run.csv", (*short.model().joints, HELD)), path)
    short = replace(short, identification=(LogEntry(path),))
    long = replace(short, rows_in_memory=512)
    (one,), (other,) = found(short), found(long)
    assert (other.message, other.evidence["median"]) == (one.message, one.evidence["median"])
    assert any(f.code == "log_note" and "looked at rows 0-300" in f.message for f in examine(long))
    identification, _ = run_job(replace(long, estimator=EstimatorSettings("wls")), tmp_path / "out")
    assert identification.verdict.reasons[0] == one.message
    assert identification.alarms[0] == one.message


def test_degrees_of_the_log_are_degrees_here(job):
    (finding,) = found(job(0.7, units=LogUnits(angle="deg")))
    assert finding.evidence["median"] == pytest.approx(np.deg2rad(0.7))
