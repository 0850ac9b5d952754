"""Spikes and limits of a channel, told from a joint that rests, a sensor's step, a dead torque."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robotid.cli.job import LogEntry, read_job
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.channels import check_channels, check_torque_channels

RATE, N = 500.0, 20000  # [Hz], rows of 40 s
JOB = Path(__file__).parents[2] / "jobs" / "ur10e.toml"


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
    for velocity, severity in (
        ("auto", "error"),
        ("measured", "error"),
        ("differentiated", "note"),
    ):
        (found,) = found_of(log, "spikes", velocity=velocity)
        assert (found.where, found.severity) == ("run.csv: dq_b", severity)
    coarse = replace(log, v=np.round(v / 0.1) * 0.1)  # "auto" differentiates the position instead
    assert {f.severity for f in found_of(coarse, "spikes")} == {"note"}


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5, 6])
def test_joints_at_rest_in_a_real_recording_raise_no_alarm(recordings, monkeypatch, number):
    monkeypatch.setenv("ROBOTID_DATA", str(recordings))
    job = read_job(JOB)
    path = recordings / "ur10e" / f"jointwise_{number}.parquet"
    log = job.read(LogEntry(path), job.model())
    assert "error" not in {f.severity for f in found_of(log, "spikes")}


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
    assert levels["run.csv: tau"]["a"] == pytest.approx(0.05, rel=0.05)
    assert levels["run.csv: tau"]["b"] == pytest.approx(0.05, rel=0.05)
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
