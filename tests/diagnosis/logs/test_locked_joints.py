"""Positions that a job states of held joints, against what the logs say of them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.cli.identify import run_job
from robotid.cli.job import Job, LogEntry
from robotid.cli.logs import examine
from robotid.data.files.read import read_log, write_log
from robotid.data.signal_settings import LogUnits
from robotid.diagnosis.logs.check_logs import check_locked, percent_hint
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.output.report.next_steps import Origin, next_steps
from robotid.robot.drives import DRIVE_TERMS
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

HELD = "wrist_3_joint"


@pytest.fixture
def job(ur5, rng, tmp_path):
    """Hold the last joint, which the log says to be at 0.7 rad; or to move, if not still."""

    def make(stated, *, still=True, samples=600, **options):
        log = exact_log(ur5, truth(ur5), rng, samples=samples, rate=100.0, noise=0.1)
        if still:
            q, v = log.q.copy(), log.v.copy()
            q[:, -1], v[:, -1] = 0.7, 0.0
            log = replace(log, q=q, v=v, a=None)
        write_log(log, tmp_path / "run.csv")
        return Job(
            example_urdf("ur5_robot.urdf"), joints=ur5.joints[:-1], terms=DRIVE_TERMS,
            locked={} if stated is None else {HELD: stated}, report=False,
            identification=(LogEntry(tmp_path / "run.csv"),), **options,
        )  # fmt: skip

    return make


def found(job):
    return [f for f in examine(job) if f.code == "locked_position"]


def test_a_joint_that_nobody_placed_is_locked_where_the_logs_have_it(job, tmp_path):
    unplaced = job(None, estimator=EstimatorSettings("wls"))
    log = read_log(tmp_path / "run.csv", (*unplaced.model().joints, HELD))
    q = log.q.copy()
    q[0, -1] += 0.01  # the first row is no better than others
    write_log(replace(log, q=q, a=None, path=""), tmp_path / "run.csv")
    assert found(unplaced) == []
    identification, result = run_job(unplaced, tmp_path / "out")
    assert dict(identification.model.locked) == {HELD: 0.7}
    assert result["settings"]["locked"] == {HELD: 0.7}
    (note,) = [f for f in identification.findings if f.code == "locked_as_logged"]
    assert note in examine(unplaced)
    assert (note.severity, note.where) == ("note", HELD)
    assert "wrist_3_joint = 0.7" in note.message
    assert "locked_at_zero" not in {f.code for f in identification.findings}


def test_logs_that_disagree_of_a_joint_place_it_nowhere(job, tmp_path):
    one = job(None)
    log = read_log(tmp_path / "run.csv", (*one.model().joints, HELD))
    write_log(replace(log, q=log.q + 0.1 * (np.arange(6) == 5), a=None), tmp_path / "two.csv")
    two = replace(one, validation=(LogEntry(tmp_path / "two.csv"),))
    assert [f.where for f in found(two)] == [f"run.csv: {HELD}", f"two.csv: {HELD}"]
    assert "at 0 rad by default but is" in found(two)[0].message


def test_a_joint_that_moves_is_named_and_leads_the_verdict(job, tmp_path):
    moving = job(0.0, still=False, estimator=EstimatorSettings("wls"))
    (finding,) = found(moving)
    assert finding.evidence["range"] > 0.1
    assert "identify wrist_3_joint, too" in finding.message
    parts = [(LogEntry(tmp_path / "run.csv", *ends),) for ends in ((None, 4.0), (4.0, None))]
    moving = replace(moving, identification=parts[0], validation=parts[1])
    identification, _ = run_job(moving, tmp_path / "out")
    assert ["is locked" in x for x in identification.verdict.reasons].index(False) == 1
    step = next_steps(identification, Origin(("job.toml",)))[0]
    assert ("identify wrist_3_joint, too" in step.words, step.blocks) == (True, ())


def test_positions_and_ranges_have_the_unit_of_their_joint():
    fingers = {"panda_finger_joint1": 0.03, "panda_finger_joint2": 0.03, "panda_joint7": 0.5}
    arm = [f"panda_joint{i}" for i in range(1, 7)]
    panda = RobotModel.from_urdf(example_urdf("panda.urdf"), joints=arm, locked=fingers)
    logged = (np.linspace(0.0, 0.04, 5), np.full(5, 0.005), np.linspace(0.1, 0.9, 5))
    positions = dict(zip(fingers, logged, strict=True))
    asked, units = list(fingers), LogUnits()
    one, two, seven = check_locked(panda, positions, "run.csv", asked, units)
    assert "is locked at 0.03 m but moves over a range of 0.04 m in the log" in one.message
    assert "is locked at 0.03 m but is at 0.005 m in the log" in two.message
    assert "is locked at 0.5 rad but moves over a range of 0.8 rad in the log" in seven.message


def test_a_joint_that_stands_where_it_is_said_to_is_not_named(job):
    assert found(job(0.7)) == []


def hint(position, name="gripper", **units):
    model = RobotModel.from_urdf(example_urdf("so101.urdf"))
    return percent_hint(model, name, position, LogUnits(**units))


def test_a_gripper_that_may_be_logged_in_percent_has_the_setting_and_the_position_named():
    words = hint(np.deg2rad(35.0), angle="deg")
    assert words.startswith(". If 35, the number in the log, is a percentage, as of LeRobot's gri")
    assert "set percent = { gripper = [-0.1745, 1.745] } in [units]" in words
    assert words.endswith(f"it then is at {-0.174533 + 0.35 * (1.74533 + 0.174533):.4g} rad")
    assert hint(35.0).startswith(". If 35, the number in the log"), "in radians it is far"
    for position, others in (
        (0.3, {}), (np.deg2rad(105.0), {"angle": "deg"}), (-np.deg2rad(35.0), {"angle": "deg"}),
        (np.deg2rad(35.0), {"angle": "deg", "percent": {"gripper": [0.0, 1.0]}}),
        (np.deg2rad(35.0), {"angle": "deg", "name": "wrist_roll"}),
    ):  # fmt: skip
        assert hint(position, **others) == ""
