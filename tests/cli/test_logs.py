"""The logs of a job: in memory or in pieces, from whom they are told, as their robots hear them."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from robotid.base.exceptions import SettingsError
from robotid.cli.job import Job, LogEntry
from robotid.cli.logs import locked_as_logged, survey_logs, units_of_logs
from robotid.data.signal_settings import Transmission
from robotid.robot.drives import DRIVE_TERMS

HAND = """<robot name="hand"><link name="base"/><link name="a"/><link name="b"/><link name="c"/>
<link name="d"/>
<joint name="ja" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="2" effort="7" velocity="1"/></joint>
<joint name="slide" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="2.5" effort="8" velocity="2"/></joint>
<joint name="jc" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="9" velocity="3"/></joint>
<joint name="jd" type="revolute"><parent link="b"/><child link="d"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="9" velocity="3"/><mimic joint="jc" multiplier="2"/></joint>
</robot>"""


@pytest.fixture
def hand(tmp_path):
    path = tmp_path / "hand.urdf"
    path.write_text(HAND)
    return Job(path, joints=("ja", "slide"))


@dataclass(frozen=True)
class Held:
    """A surveyed log, as far as its locked joints go."""

    locked: dict
    model: object = None


def test_a_joint_is_locked_at_the_median_of_all_logs_if_it_stands_there_in_each(hand):
    model = hand.model()
    first = Held({"jc": np.array([0.3, 0.3001]), "jd": np.array([0.1, 0.1])})
    second = Held({"jc": np.array([0.3004, 0.3002, 0.3001])})
    far = Held({"jd": np.array([0.4, 0.4])})
    job, own, fitted, kept, (note,) = locked_as_logged(hand, model, [first], [second])
    assert job.locked == {"jc": pytest.approx(0.3001), "jd": pytest.approx(0.1)}
    assert own.locked["jc"] == pytest.approx(0.3001)
    assert (note.code, note.severity) == ("locked_as_logged", "note")
    assert "jc = 0.3001, jd = 0.1." in note.message
    assert {log.model for log in (*fitted, *kept)} == {own}
    job, *_ = locked_as_logged(hand, model, [first, far], [second])
    assert job.locked == {"jc": pytest.approx(0.3001)}
    leader = replace(hand, locked={"jc": 0.0})  # the position of jd follows from it
    assert leader.placed(leader.model()) == ("jc", "jd")
    for locked in ({"jc": 0.0, "jd": 0.2}, {"*": 0.1}):
        stated = replace(hand, locked=locked)
        assert locked_as_logged(stated, stated.model(), [first], [second])[-1] == ()


def test_a_motor_that_moves_two_joints_replaces_the_drive_of_the_joint(hand):
    gear = Transmission(("ja", "slide"), ((32.0, 0.0), (45.0, 90.0)), ("m", "n"))
    model = replace(hand, transmissions=(gear,)).model()
    (coupling,) = model.layout.couplings
    assert coupling.replaces
    assert (coupling.name, coupling.ratios) == next(iter(gear.shared.items()))
    assert {joint for joint, _ in coupling.ratios} == {"ja", "slide"}


@pytest.mark.parametrize(("dynamics", "is_whole"), [("full", False), ("static", True)])
def test_logs_of_poses_are_read_whole(arm, arm_logs, dynamics, is_whole):
    entries = (LogEntry(arm_logs / "fit.csv"), LogEntry(arm_logs / "keep.csv"))
    job = Job(Path(arm.tree.path), model_dynamics=dynamics, rows_in_memory=900, terms=DRIVE_TERMS)
    groups = survey_logs(job, job.model(), *((entry,) for entry in entries))  # 800 rows each
    assert [log.is_in_memory for (log,) in groups] == [is_whole] * 2


def test_of_a_log_its_window_is_read(arm, arm_logs):
    job, entry = Job(Path(arm.tree.path)), LogEntry(arm_logs / "fit.csv", 1.0, 5.0)
    t = job.read(entry, arm).t
    assert (t[0], t[-1]) == (1.0, 5.0)
    ((log,),) = survey_logs(job, arm, [entry])
    t = log.whole.trajectory.t
    assert 1.0 <= t[0] < 1.6
    assert 4.4 < t[-1] <= 5.0


@pytest.mark.parametrize("at", [0, 1, 2])
def test_a_log_that_alone_has_no_unit_is_named(at):
    entries = [LogEntry(Path(f"{name}.csv"), unit="left") for name in "abc"]
    assert units_of_logs(entries) == ["left"] * 3
    entries[at] = replace(entries[at], unit="")
    other = "b.csv" if at == 0 else "a.csv"
    wanted = f"^{'abc'[at]}.csv has no unit, but {other} has unit = 'left'; "
    with pytest.raises(SettingsError, match=wanted):
        units_of_logs(entries)
