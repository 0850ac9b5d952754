"""Figures of a log's clock, of its rows and of its rests, against logs made of them."""

import numpy as np
import pytest
from helpers.findings import Figures

from robotid.data.log import Log, Trajectory
from robotid.diagnosis.logs.channels import check_clock, check_rest
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

START = 3.0  # [s]: no log starts at 0


def log_of(t, path="run.csv"):
    """Return a log of two joints that move on from row to row, whatever the clock says."""
    k = np.arange(len(t))
    q = np.column_stack([np.sin(0.02 * k), 0.5 * np.cos(0.015 * k)])
    return Log(t, q, 10.0 * np.cos(q), ("a", "b"), v=np.gradient(q, axis=0) / 0.01, path=path)


def stamps(*changes, count=901):
    """Return stamps with steps of 8, 10 and 12 ms in turn, but for some: (row, step)."""
    step = np.resize([0.010, 0.008, 0.012], count - 1)
    for row, value in changes:
        step[row] = value
    return START + np.concatenate([[0.0], np.cumsum(step)])


def said(findings):
    return {f.code: f for f in findings}


def test_rate_and_jitter_are_those_of_the_steps():
    t = stamps()
    found = said(check_clock(log_of(t)))
    assert set(found) == {"rate", "jitter"}
    assert Figures(found["rate"]) == {
        "rate": pytest.approx(100.0), "samples": 901, "duration": pytest.approx(9.0)
    }  # fmt: skip
    assert found["rate"].message.startswith("run.csv: 901 rows in 9 s, median rate 100 Hz")
    spread = np.sqrt(2.0 / 3.0) * 0.2
    assert Figures(found["jitter"]) == {
        "relative_spread": pytest.approx(spread),
        "shortest": pytest.approx(0.008),
        "longest": pytest.approx(0.012),
    }
    assert "from 8 to 12 ms about 10 ms (standard deviation 16 %)" in found["jitter"].message
    even = START + 0.01 * np.arange(901)
    assert set(said(check_clock(log_of(even)))) == {"rate"}


def test_gaps_are_counted_and_the_longest_has_its_time():
    found = said(check_clock(log_of(stamps((100, 0.04), (300, 0.5), (600, 0.2)))))
    gap = found["gap"]
    assert gap.severity == "warning"
    # before it, 300 steps of which one is a gap of 40 ms in place of 8
    at = START + 300 * 0.01 + 0.032
    assert Figures(gap) == {"gaps": 3, "longest": pytest.approx(0.5), "at": pytest.approx(at)}
    assert gap.message.startswith("run.csv: 3 gaps, the longest of 0.5 s at t = 6.032 s")
    # a gap has no part in the jitter
    assert found["jitter"].evidence["longest"] == pytest.approx(0.012)
    short = said(check_clock(log_of(stamps((100, 0.04)))))["gap"]
    assert short.severity == "note"


def test_a_clock_that_was_set_is_told_from_a_gap_by_the_position():
    t = stamps((300, 0.5), (400, 5.01), (700, 2.01))
    found = said(check_clock(log_of(t)))
    jump = found["clock_step"].evidence
    assert jump == {"jump": pytest.approx(5.0), "at": pytest.approx(t[400]), "steps": 2.0}
    assert found["gap"].evidence["gaps"] == 1
    assert found["gap"].evidence["longest"] == pytest.approx(0.5)


def bunched(count=900, lost=0):
    """Return stamps of rows of 10 ms that arrive late: of six in turn, five wait for the last."""
    k = np.arange(count)
    t = START + 0.01 * k
    late = (k // 6 % 4 == 1) & (k % 6 < 5)
    t[late] = t[k[late] // 6 * 6 + 5] - 1e-4 * (5 - k[late] % 6)
    t[count // 2 :] += 0.01 * lost
    return t


def test_rows_that_are_stamped_on_arrival_are_named_with_their_remedy():
    found = said(check_clock(log_of(bunched())))["bunched_stamps"]
    assert found.severity == "warning"
    late = 5 * len(range(1, 150, 4))  # steps of 0.1 ms, in every fourth six
    assert Figures(found) == {
        "rows": late, "share": pytest.approx(late / 899), "longest": pytest.approx(0.0595)
    }  # fmt: skip
    assert "the mean step is 10 ms, the typical one 10 ms, so no rows" in found.message
    assert 'so no rows are missing: state stamp = "even" in [log]' in found.message
    missing = said(check_clock(log_of(bunched(lost=90))))["bunched_stamps"]
    assert missing.message.endswith("are wrong; log the time of recording")


def test_rows_that_repeat_the_one_before_are_counted_where_the_robot_moves():
    def stale(count):
        log, rows = log_of(START + 0.01 * np.arange(count)), np.arange(count)
        rows[50], rows[61:64] = 49, 60
        held = {name: getattr(log, name)[rows] for name in ("q", "v", "tau")}
        return said(check_clock(Log(log.t, joints=log.joints, **held)))["stale_rows"]

    found = stale(79)
    assert found.severity == "warning"
    assert Figures(found) == {"rows": 4, "share": pytest.approx(4 / 79), "longest_run": 3}
    assert ": 4 rows (5.1 %) repeat" in found.message
    assert stale(80).severity == "note"  # a twentieth is not more than a twentieth


def test_a_position_that_is_held_between_steps_is_not_stale():
    t = 0.005 * np.arange(1200)
    step = np.concatenate([0.6 * (1 - np.exp(-t[:400] / 0.05)) + 0.6 * k for k in range(3)])
    q = np.round(step / 0.0015) * 0.0015  # of an encoder
    motion = {"joints": ("a",), "tau": 0 * q[:, None], "has_torque": False}
    assert "stale_rows" not in said(check_clock(Log(t, q=q[:, None], **motion)))
    slow = np.round(0.1 * t / 0.0015) * 0.0015  # an encoder step in three rows
    assert "stale_rows" not in said(check_clock(Log(t, q=slow[:, None], **motion)))
    stale = q[np.arange(1200) // 4 * 4]  # the robot updates its state every 4 rows
    found = said(check_clock(Log(t, q=stale[:, None], **motion)))["stale_rows"]
    assert 90 < found.evidence["rows"] < 300
    assert found.evidence["longest_run"] == 3


@pytest.fixture(scope="module")
def slider():
    """A prismatic joint and one that turns."""
    return RobotModel.from_urdf(
        example_urdf("tiago.urdf"), joints=["torso_lift_joint", "arm_1_joint"]
    )


def moved(model, *ways):
    """Return a log of 10 s and its motion: each joint has a speed from one row to another."""
    t = START + np.arange(1001) / 100
    v = np.zeros((1001, 2))
    for j, (first, last, speed) in enumerate(ways):
        v[first : last + 1, j] = speed
    q = np.cumsum(v, axis=0) / 100
    segment = np.zeros(1001, dtype=int)
    motion = Trajectory(t, q, v, 0 * v, 0 * v, model.joints, 100.0, segment)
    return Log(t, q, 0 * q, model.joints, path="run.csv"), motion


def test_rests_at_the_ends_are_those_of_all_joints(slider):
    log, motion = moved(slider, (300, 400, 0.3), (200, 650, -0.5))
    (rest,) = check_rest(log, motion, slider.layout)
    assert rest.code == "standstill"
    assert Figures(rest) == {"before": pytest.approx(2.0), "after": pytest.approx(3.5)}
    assert "the first 2 s and the last 3.5 s" in rest.message
    assert "start = 5 and end = 9.5" in rest.message
    assert list(check_rest(*moved(slider, (50, 950, 0.1), (80, 920, 0.5)), slider.layout)) == []
    for first, last, ends in ((150, 980, (1.5, 0.2)), (30, 870, (0.3, 1.3))):  # of one end alone
        log, motion = moved(slider, (first, last, 0.1), (first, last, 0.5))
        (rest,) = check_rest(log, motion, slider.layout)
        assert list(rest.evidence.values()) == pytest.approx(ends)


def test_joints_that_hardly_move_are_named_with_their_range_and_share(slider):
    # 0.06 m are enough of a slider, 0.15 rad too little of a hinge
    found = check_rest(*moved(slider, (0, 600, 0.01), (0, 299, 0.05)), slider.layout)
    (hardly,) = (f for f in found if f.code != "standstill")
    assert hardly.code == "hardly_moves"
    assert (hardly.where, hardly.severity) == ("run.csv: arm_1_joint", "note")
    assert hardly.evidence["range"] == pytest.approx(0.15, abs=6e-4)
    assert hardly.evidence["moving_share"] == pytest.approx(300 / 1001)
    assert "moving 30 % of the time" in hardly.message
    # far, but in a twelfth of the time; and not at all
    found = said(check_rest(*moved(slider, (0, -2, 0.0), (400, 479, 1.0)), slider.layout))
    assert Figures(found["hardly_moves"]) == {
        "range": pytest.approx(0.8), "moving_share": pytest.approx(80 / 1001)
    }  # fmt: skip
    still = found["static_joint"]
    assert (still.where, still.severity) == ("run.csv: torso_lift_joint", "warning")
    assert Figures(still) == {"range": 0.0, "moving_share": 0.0}
    assert "torso_lift_joint at rest (range 0 m): this log" in still.message
    assert "arm_1_joint (range 0.8 rad, moving 8 % of" in found["hardly_moves"].message
