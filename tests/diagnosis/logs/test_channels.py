"""Spikes and limits of a channel, told from a joint that rests, a sensor's step, a dead torque."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.corruptions import controlled_log, robot
from helpers.findings import Figures

from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.channels import (
    check_channels,
    check_clock,
    check_limits,
    check_rest,
    check_torque_channels,
)
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint

RATE, N = 500.0, 20000  # [Hz], rows of 40 s


def log_of_two(q=None, tau=None, moving=1.0):
    """Return a log of two joints; the first moves all the time, the second in a share of it."""
    rng = np.random.default_rng(0)
    t = np.arange(N) / RATE
    inside = np.clip((t - 10.0) / max(moving * t[-1], 1e-9), 0.0, 1.0)
    own = np.column_stack([np.sin(2 * t), 0.8 * np.sin(np.pi * inside) ** 2])
    q = own if q is None else np.column_stack([own[:, 0], q])
    loads = np.column_stack([20 * np.cos(2 * t), 5 * np.cos(q[:, 1])])
    loads = loads + 0.05 * rng.standard_normal(loads.shape)
    tau = loads if tau is None else np.column_stack([loads[:, 0], tau])
    return Log(t, q, tau, ("a", "b"), v=np.gradient(q, t, axis=0), path="run.csv")


def found_of(log, *codes, **signals):
    return [f for f in check_channels(log, SignalSettings(**signals)) if f.code in codes]


def spikes(log):
    return {f.where.removeprefix("run.csv: "): f.severity for f in found_of(log, "spikes")}


def flicker(step, count=17):
    """Return a channel at rest that now and then reads one step more."""
    x = np.zeros(N)
    x[np.random.default_rng(1).choice(N, count, replace=False)] = step
    return x


def test_one_step_of_a_sensor_at_rest_is_no_spike():
    assert spikes(log_of_two(q=flicker(1e-4))) == {}
    # a torque of the second joint that is as good as none beside the first one's 20 N m
    assert spikes(log_of_two(tau=flicker(0.05))) == {}


@pytest.mark.parametrize("moving", [0.003, 0.02, 0.3])
def test_a_joint_that_rests_most_of_the_log_has_no_spikes_where_it_moves(moving):
    assert spikes(log_of_two(moving=moving)) == {}


@pytest.mark.parametrize("moving", [0.0, 0.02, 1.0])
def test_rows_that_jump_are_found_whether_the_joint_moves_or_rests(moving):
    log = log_of_two(moving=moving)
    q, tau = log.q.copy(), log.tau.copy()
    q[[3000, 9000], 1] += 50.0
    tau[[500, 6000, 12000], 0] = 5000.0
    assert spikes(replace(log, q=q, tau=tau)) == {"q_b": "error", "tau_a": "error"}


def test_spikes_of_a_velocity_that_is_not_used_are_a_note():
    log = log_of_two()
    v = log.v.copy()
    v[[3000, 9000], 1] += 9.0
    log = replace(log, v=v)
    severities = {"auto": "error", "measured": "error", "differentiated": "note"}
    for velocity, severity in severities.items():
        (found,) = found_of(log, "spikes", velocity=velocity)
        assert (found.where, found.severity) == ("run.csv: dq_b", severity)
    coarse = replace(log, v=np.round(v / 0.1) * 0.1)  # "auto" differentiates the position instead
    assert {f.severity for f in found_of(coarse, "spikes")} == {"note"}


@pytest.mark.parametrize("value", [0.0, -0.0, 3.0])
def test_a_torque_that_never_changes_is_dead_and_not_clipped(value):
    log = log_of_two(tau=np.full(N, value))
    (found,) = check_torque_channels(log)
    assert (found.code, found.where) == ("constant_torque", "run.csv: b")
    assert f"the torque of b is {abs(value):g} in every row" in found.message


@pytest.mark.parametrize("factor", [0.5, 9.5493])
def test_a_velocity_in_another_unit_is_told_with_its_factor(factor):
    log = log_of_two()
    scaled = replace(log, v=log.v * [1.0, factor])
    (found,) = found_of(scaled, "velocity_scale", velocity="auto")
    assert (found.code, found.severity, found.where) == ("velocity_scale", "error", "run.csv: b")
    assert found.evidence["factor"] == pytest.approx(factor, rel=1e-3)
    (unused,) = found_of(scaled, "velocity_scale", velocity="differentiated")
    assert unused.severity == "note"
    assert found_of(log, "velocity_scale", velocity="auto") == []


@pytest.mark.parametrize("factor", [0.5, 0.985, 1.02, 1.5])
def test_a_clock_is_one_finding_with_its_standard_error_and_names_no_velocity(factor):
    log, rng = log_of_two(), np.random.default_rng(0)
    v = log.v + 0.01 * rng.standard_normal(log.v.shape)  # 1 % noise
    clocked = replace(log, t=log.t * factor, v=v)
    (found,) = found_of(clocked, "time_scale", "velocity_scale")
    assert (found.code, found.where, found.severity) == (
        "time_scale", "run.csv", "error" if abs(factor - 1) > 0.1 else "warning"
    )  # fmt: skip
    figures = found.evidence
    assert abs(figures["factor"] - factor) < max(4 * figures["std_error"], 1e-4)
    assert figures["std_error"] < 2e-3
    assert "correct the time stamps" in found.message
    single = found_of(replace(clocked, v=v * [1.0, 2.0]), "time_scale", "velocity_scale")
    wrong = [x for x, own in (("a", factor), ("b", 2 * factor)) if abs(own - 1) > 0.1]
    assert [(f.code, *f.joints) for f in single] == [("velocity_scale", x) for x in wrong]


def test_a_right_clock_and_velocities_that_share_a_unit_are_no_clock():
    log = log_of_two()
    late = np.column_stack([np.interp(log.t - 0.03, log.t, v) for v in log.v.T])
    assert found_of(replace(log, v=late), "time_scale", "velocity_scale") == []
    assert found_of(replace(log, t=1.005 * log.t), "time_scale", "velocity_scale") == []
    (found,) = found_of(replace(log, v=9.5493 * log.v), "time_scale", "velocity_scale")
    assert (found.code, found.joints) == ("velocity_scale", ("a", "b"))  # rpm


def joint(**limits):
    return Joint(**({"name": "a", "type": "revolute", "parent": "", "child": "a"} | limits))


LIFT = joint(type="prismatic", lower=-0.2, upper=0.05, effort=50.0)


@pytest.mark.parametrize(
    ("size", "limits", "units"),
    [
        (1000.0, LIFT, "mm"), (100.0, LIFT, "cm"), (1.0, LIFT, None),
        (5000.0, LIFT, ""),  # no unit
        (180 / np.pi, joint(lower=-0.1, upper=0.1), "degrees"),
        (1.0, joint(lower=-0.04, upper=0.04), None),  # a little beyond
        (180 / np.pi, joint(lower=0.0, upper=0.0), None),  # no range
    ],
)  # fmt: skip
def test_positions_far_beyond_the_limits_are_named_with_their_unit(size, limits, units):
    log = log_of_two().select(["a"])
    q = -0.08 + 0.09 * log.q  # from -0.17 to 0.01
    found = list(check_limits(replace(log, q=size * q), [limits]))
    assert [f.words["units"] for f in found] == [] if units is None else [units]
    for finding in found:
        assert (finding.code, finding.severity) == ("beyond_limits", "error")
        setting = {"mm": "0.1", "cm": "1", "degrees": "1.745"}.get(units)
        assert (f"percent = {{ a = [0, {setting}] }} ({units})" in finding.message) == bool(units)


def test_torques_far_beyond_the_effort_limits_are_one_finding():
    log = log_of_two()  # 20 and 5 N m
    for efforts, names in (((50.0, 28.0), ("a", "b")), ((50.0, 1e6), ("a",)), ((0.0, 28.0), ("b",)),
                           ((1.0, 1.0), ())):  # fmt: skip
        limits = [joint(name=x, effort=e) for x, e in zip("ab", efforts, strict=True)]
        found = list(check_limits(replace(log, tau=log.tau * 1000.0), limits))
        assert [f.joints for f in found] == ([names] if names else [])
        assert list(check_limits(log, limits)) == []
    (found,) = check_limits(replace(log, tau=log.tau * 1000.0), [limits[0], joint(effort=28.0)])
    assert found.evidence["times"] == pytest.approx(5000 / 28, rel=0.02)


def test_torques_that_are_all_0_are_one_error():
    (found,) = check_torque_channels(replace(log_of_two(), tau=np.zeros((N, 2))))
    assert (found.code, found.severity, found.where) == ("constant_torque", "error", "run.csv")
    assert "0 in every row of every joint" in found.message


@pytest.mark.parametrize(("level", "names"), [(1.0, ()), (2.0, ("b",))])
def test_a_torque_is_noisy_from_three_tenths_of_its_standard_deviation_on(level, names):
    rng = np.random.default_rng(2)  # the torque itself has 4.9 N m RMS
    tau = 5 * np.sqrt(2) * np.cos(np.arange(N) / RATE) + level * rng.standard_normal(N)
    noisy = found_of(log_of_two(tau=tau), "noisy_torque")
    assert tuple(joint for finding in noisy for joint in finding.joints) == names
    for finding in noisy:
        assert finding.evidence["share"] == pytest.approx(level / np.hypot(5.0, level), rel=0.05)


def test_the_noise_of_a_channel_is_its_standard_deviation():
    levels = {f.where: f.evidence for f in found_of(log_of_two(), "noise")}
    assert levels["run.csv: tau"] == pytest.approx({"a": 0.05, "b": 0.05}, rel=0.05)
    assert levels["run.csv: q"]["a"] < 1e-6


@pytest.mark.parametrize("stated", [0.0, 0.01, -0.02])
def test_the_delay_of_a_velocity_is_told_beyond_what_is_stated(stated):
    log = log_of_two()
    late = np.column_stack([np.interp(log.t - 0.03, log.t, v) for v in log.v.T])
    (found,) = found_of(replace(log, v=late), "velocity_delay", velocity_delay=stated)
    assert found.evidence["delay"] == pytest.approx(0.03 - stated, abs=1e-3)
    assert "set [signals] velocity_delay = 0.0300" in found.message
    assert found_of(log, "velocity_delay") == []


def test_the_delay_of_a_velocity_is_as_sure_as_joints_agree():
    log = log_of_two()
    late = [np.interp(log.t - x, log.t, v) for x, v in zip((0.03, 0.033), log.v.T, strict=True)]
    log = replace(log, v=np.column_stack(late))
    (found,) = found_of(log, "velocity_delay", velocity_delay=0.0)
    off = np.array([0.03, 0.033]) - found.evidence["delay"]
    expected = 1.48 * np.median(np.abs(off)) / np.sqrt(2)
    assert found.evidence["std_error"] == pytest.approx(expected, rel=0.05)


# --- figures, by an independent computation -------------------------------------------------------
T = 3.0 + np.arange(2000) / 100


def log_of(t=T, tau=None, **changes):
    q = np.column_stack([np.sin(2 * (t - 3.0)), 0.4 * np.cos(3 * (t - 3.0))])
    tau = 5.0 * q if tau is None else tau
    return replace(Log(t, q, tau, ("a", "b"), path="run.csv"), **changes)


def one(findings, code):
    [found] = [f for f in findings if f.code == code]
    return found


def test_spikes_are_counted_by_their_share_of_what_varies():
    rng = np.random.default_rng(0)
    tau = 40.0 + 5.0 * log_of().q + 0.01 * rng.standard_normal((2000, 2))
    tau[[310, 700, 1500], 1] += [120.0, -70.0, 90.0]
    found = one(check_channels(log_of(tau=tau), SignalSettings()), "spikes")
    x = tau[:, 1]
    height = np.array([120.0, -70.0, 90.0])
    share = np.sum(height**2) / np.sum((x - np.median(x)) ** 2)
    assert (found.where, found.severity) == ("run.csv: tau_b", "error")
    assert Figures(found) == {
        "rows": 3.0, "largest": pytest.approx(120.0, abs=0.2), "first": pytest.approx(6.1),
        "energy_share": pytest.approx(share, rel=0.01),
    }  # fmt: skip
    assert "tau of b has spikes of up to 120 in 3 rows, the first at t = 6.1 s" in found.message


@pytest.mark.parametrize("rows", [3, 5, 6])
def test_a_held_torque_is_late_by_half_of_what_it_is_held_less_a_row(rows):
    held = np.arange(2000) // rows * rows
    tau = 5.0 * log_of().q
    tau[:, 1] = tau[held, 1]
    found = one(check_torque_channels(log_of(tau=tau)), "repeated_torque")
    own = (np.arange(2000) - held)[: 2000 // rows * rows]  # rows since each was new
    late = own.mean() * 0.01
    assert found.where == "run.csv: b"
    assert Figures(found) == {"rows": rows, "delay": pytest.approx(late)}
    told = f"is constant for {rows} rows: it is updated at {100 / rows:.3g} Hz and logged at 100 Hz"
    assert told in found.message
    assert f"mean delay of {1e3 * late:.2g} ms" in found.message
    assert f"torque_delay = {late:.4f} (--torque-delay {late:.4f})" in found.message
    assert f"a cutoff below {25 / rows:.2g} Hz" in found.message


def test_a_torque_is_clipped_at_either_limit_and_held_by_groups():
    k = np.arange(2000)
    t = 3.0 + k / 100
    q = np.column_stack([np.sin(2 * t), np.cos(t), np.sin(t), np.cos(3 * t)])
    tau = 5.0 * np.column_stack([np.clip(q[:, 0], -0.8, 0.6), q[:, 1:]])
    tau[:, 1], tau[:, 2], tau[:, 3] = tau[k // 4 * 4, 1], tau[k // 7 * 7, 2], tau[k // 4 * 4, 3]
    log = replace(log_of(), joints=tuple("abcd"), q=q, tau=tau)
    found = list(check_torque_channels(log))
    clipped = [f for f in found if f.code == "clipped" and f.where == "run.csv: a"]
    for finding, limit in zip(clipped, (3.0, -4.0), strict=True):
        share = np.mean(tau[:-1, 0] == limit) * 1999 / 2000
        assert Figures(finding) == pytest.approx({"limit": limit, "share": share})
        assert f"at its limit {limit:g} in {100 * share:.3g} % of the rows" in finding.message
    repeated = {f.where: Figures(f) for f in found if f.code == "repeated_torque"}
    assert repeated == {
        "run.csv: b, d": pytest.approx({"rows": 4.0, "delay": 0.015}),
        "run.csv: c": pytest.approx({"rows": 7.0, "delay": 0.03}),
    }


@pytest.mark.parametrize(("noise", "least"), [(0.005, 9), (0.02, 8)])
def test_a_torque_that_is_clipped_under_noise_is_named_and_no_other(noise, least):
    model, named = robot("panda"), 0
    log, rng = controlled_log("panda", 1), np.random.default_rng(0)
    level = noise * log.tau.std(axis=0)
    for share in (1.0, 0.75, 0.6):
        limit = share * np.abs(log.tau).max(axis=0)
        tau = np.clip(log.tau, -limit, limit) + level * rng.standard_normal(log.tau.shape)
        for finding in check_torque_channels(replace(log, tau=tau)):
            j = model.joints.index(finding.joints[0])
            assert (finding.code, share < 1.0) == ("clipped", True)
            assert abs(finding.evidence["limit"]) == pytest.approx(limit[j], abs=2 * level[j])
            named += 1
        one = np.maximum(log.tau, -0.3 * limit) + level * rng.standard_normal(log.tau.shape)
        assert list(check_torque_channels(replace(log, tau=one))) == []  # no limit is of one side
    assert named >= least


def test_a_torque_that_gravity_loads_in_one_direction_is_clipped_in_most_rows():
    t, rng = np.arange(4000) / 200, np.random.default_rng(0)
    q = 0.6 * np.sin(2 * t) + 0.3 * np.sin(3.3 * t)
    tau = np.maximum(-60.0 * np.cos(q) - 4.0 * np.sign(np.cos(2 * t)), -48.0)
    tau += 0.2 * rng.standard_normal(len(t))
    log = Log(t, q[:, None], tau[:, None], ("lift",), path="run.csv")
    (found,) = check_torque_channels(log)
    assert (found.code, found.evidence["limit"]) == ("clipped", pytest.approx(-48.0, abs=0.1))


# --- clock, rows and rests ------------------------------------------------------------------------
START = 3.0  # [s]: no log starts at 0


def clocked_log(t, path="run.csv"):
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
    found = said(check_clock(clocked_log(t)))
    assert set(found) == {"rate", "jitter"}
    assert Figures(found["rate"]) == {
        "rate": pytest.approx(100.0), "samples": 901, "duration": pytest.approx(9.0)
    }  # fmt: skip
    assert found["rate"].message.startswith("run.csv: the log has 901 rows in 9 s, median rate 100")
    assert Figures(found["jitter"]) == {
        "relative_spread": pytest.approx(np.sqrt(2.0 / 3.0) * 0.2),
        "shortest": pytest.approx(0.008),
        "longest": pytest.approx(0.012),
    }
    assert "from 8 to 12 ms about 10 ms (standard deviation 16 %)" in found["jitter"].message
    even = START + 0.01 * np.arange(901)
    assert set(said(check_clock(clocked_log(even)))) == {"rate"}


def test_gaps_are_counted_and_the_longest_has_its_time():
    found = said(check_clock(clocked_log(stamps((100, 0.04), (300, 0.5), (600, 0.2)))))
    gap = found["gap"]
    assert gap.severity == "warning"
    # before it, 300 steps of which one is a gap of 40 ms in place of 8
    at = START + 300 * 0.01 + 0.032
    assert Figures(gap) == {"gaps": 3, "longest": pytest.approx(0.5), "at": pytest.approx(at)}
    words = "run.csv: the time stamps have gaps (3). The longest, at t = 6.032 s, lasts 0.5 s. "
    assert gap.message.startswith(words)
    # a gap has no part in the jitter
    assert found["jitter"].evidence["longest"] == pytest.approx(0.012)
    short = said(check_clock(clocked_log(stamps((100, 0.04)))))["gap"]
    assert short.severity == "note"
    paused = clocked_log(stamps((300, 3600.0)))
    paused = replace(paused, q=paused.q[np.minimum(np.arange(901), 200)])  # at rest
    assert said(check_clock(paused))["gap"].severity == "note"


def test_a_clock_that_was_set_is_told_from_a_gap_by_the_position():
    t = stamps((300, 0.5), (400, 5.01), (700, 2.01))
    found = said(check_clock(clocked_log(t)))
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
    found = said(check_clock(clocked_log(bunched())))["bunched_stamps"]
    assert found.severity == "warning"
    late = 5 * len(range(1, 150, 4))  # steps of 0.1 ms, in every fourth six
    assert Figures(found) == {
        "rows": late, "share": pytest.approx(late / 899), "longest": pytest.approx(0.0595)
    }  # fmt: skip
    assert "no stamp is farther than a pause from equal steps of 10 ms, so no" in found.message
    assert 'so no rows are missing: set stamp = "even" in [log]' in found.message
    missing = said(check_clock(clocked_log(bunched(lost=90))))["bunched_stamps"]
    assert missing.message.endswith("are wrong; log the time of recording")


def test_rows_that_repeat_the_one_before_are_counted_where_the_robot_moves():
    def stale(count):
        log, rows = clocked_log(START + 0.01 * np.arange(count)), np.arange(count)
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


def test_a_position_that_jumps_or_is_stuck_is_an_error_of_its_joint_or_of_all_if_rows_are_lost():
    t, rng = 0.01 * np.arange(2000), np.random.default_rng(0)
    q = np.sin(np.outer(t, [1.0, 1.7])) + 1e-5 * rng.standard_normal((2000, 2))

    def errors(q):
        log = Log(t[: len(q)], q=q, tau=q, joints=("a", "b"), path="run.csv")
        every = check_channels(log, SignalSettings())
        return [(x.code, x.joints, Figures(x)) for x in every if x.severity == "error"]

    assert errors(q) == []
    late = (t > 8.0)[:, None]
    slip = {"rows": 1, "first": pytest.approx(8.01)}
    assert errors(q + 0.3 * (late & [True, False])) == [("position_jump", ("a",), slip)]
    lost = np.delete(q, np.r_[500:540, 900:930], axis=0)
    assert errors(lost) == [("position_jump", (), {"rows": 2, "first": pytest.approx(5.0)})]
    stuck = {"start": pytest.approx(8.0), "share": pytest.approx(0.6, abs=0.001)}
    assert errors(np.where(late & [False, True], q[800], q)) == [("stuck_position", ("b",), stuck)]


@pytest.fixture(scope="module")
def slider():
    """A prismatic joint and one that turns."""
    joints = ["torso_lift_joint", "arm_1_joint"]
    return RobotModel.from_urdf(example_urdf("tiago.urdf"), joints=joints)


def moved(model, *ways):
    """Return a log of 10 s and its motion: each joint has a speed from one row to another."""
    t = START + np.arange(1001) / 100
    v = np.zeros((1001, 2))
    for j, (first, last, speed) in enumerate(ways):
        v[first : last + 1, j] = speed
    q = np.cumsum(v, axis=0) / 100
    motion = Trajectory(t, q, v, 0 * v, 0 * v, model.joints, 100.0, np.zeros(1001, dtype=int))
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
    assert "(range 0.15 rad, 30 % of the time)" in hardly.message
    # far, but in a twelfth of the time; and not at all
    found = said(check_rest(*moved(slider, (0, -2, 0.0), (400, 479, 1.0)), slider.layout))
    assert Figures(found["hardly_moves"]) == {
        "range": pytest.approx(0.8), "moving_share": pytest.approx(80 / 1001)
    }  # fmt: skip
    still = found["static_joint"]
    assert (still.where, still.severity) == ("run.csv: torso_lift_joint", "warning")
    assert Figures(still) == {"range": 0.0, "moving_share": 0.0}
    assert "torso_lift_joint did not move (range 0 m): this log" in still.message
    assert "arm_1_joint moved little (range 0.8 rad, 8 %" in found["hardly_moves"].message
