"""A joint that moves before its logged command, in all of a log or in part of it."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.servos import Servo, chirps, record

from robotid.diagnosis.logs.command_channels import check_commands
from robotid.diagnosis.logs.command_lead import _fit, _smooth, find_lead

RATE = 100.0  # [Hz]
SERVO = Servo(coulomb=2.0, quantum=1.5e-3)  # its lag at low frequency is 80 ms


@pytest.fixture(scope="module")
def log():
    """A joint that follows a multisine beyond its bandwidth."""
    rng = np.random.default_rng(0)
    f, phase = rng.uniform(0.1, 8.0, 25), rng.uniform(0, 6, 25)

    def waves(t):
        return 0.05 * np.sum(np.sin(2 * np.pi * f * t[:, None] + phase), axis=1)

    return record(lambda t: waves(t)[:, None], [SERVO], rate=RATE, duration=24.0)


def errors(log):
    return [f for f in check_commands(log) if f.severity == "error"]


def delayed(log, lead, since=0.0):
    """Return the log with a command that is logged so late that the joint leads [s] from then."""
    rows = round((0.08 + lead) * RATE)
    moved = np.roll(log.q_ref, rows, axis=0)
    return replace(log, q_ref=np.where((log.t >= since)[:, None], moved, log.q_ref))


@pytest.mark.parametrize("lead", [0.03, 0.1])
def test_a_lead_of_the_whole_log_is_found(log, lead):
    (found,) = errors(delayed(log, lead))
    assert found.code == "delayed_command"
    assert -found.evidence["lag"] == pytest.approx(lead, abs=0.02)
    assert found.evidence["std_error"] < 0.01
    assert " from " not in found.message


def test_a_lead_of_a_part_is_found_with_its_time(log):
    (found,) = errors(delayed(log, 0.1, since=12.0))
    assert -found.evidence["lag"] == pytest.approx(0.1, abs=0.02)
    assert "before its command in 12-23.99 s: " in found.message


def test_a_constant_offset_and_a_drift_change_no_lag(log):
    command, q = log.q_ref[:, 0], log.q[:, 0]
    found = _fit(command, q, 1 / RATE)
    assert found[0] == pytest.approx(0.08, abs=0.02)
    other = _fit(command + 30.0 - 0.2 * log.t, q - 50.0 + 0.4 * log.t, 1 / RATE)
    np.testing.assert_allclose(other, found, rtol=1e-6)
    # where the joint follows at once, no lead explains anything
    noise = 1e-4 * np.random.default_rng(0).standard_normal(len(q))
    lag, *_, explained = _fit(command, command + noise, 1 / RATE)
    assert lag == pytest.approx(0.0, abs=1e-4)
    assert 0.0 <= explained < 0.05


def test_signals_are_those_of_the_loop_up_to_its_bandwidth():
    """By the gain of a Butterworth filter of order two, forwards and backwards, at 50 Hz."""
    t = np.arange(1000) / 50
    for f, bandwidth in ((3.0, 5.0), (8.0, 5.0), (15.0, 19.5)):
        x = np.sin(2 * np.pi * f * t + 0.4)
        gain = 1 / (1 + (np.tan(np.pi * f / 50) / np.tan(np.pi * bandwidth / 50)) ** 4)
        found = _smooth(x, 0.02, bandwidth)
        np.testing.assert_allclose(found[100:-100], gain * x[100:-100], atol=1e-6)
    assert all(_smooth(x, 0.02, above) is x for above in (20.5, np.nan))


def test_short_windows_and_smooth_commands_are_no_lead(log):
    chirp = record(chirps([0.3, 0.2], 8.0), [SERVO, SERVO], rate=RATE)
    for start in range(0, 16, 3):  # the phase of a few frequencies is no lag
        assert errors(chirp.window(start, start + 5.0)) == []
    smooth = record(
        lambda t: 0.3 * np.column_stack([np.sin(0.9 * t), np.sin(1.3 * t)]), [SERVO, SERVO],
        couple=lambda t, q: 0.02 * q[:, ::-1], rate=RATE,
    )  # fmt: skip
    assert errors(smooth) == []


def test_a_model_error_of_all_windows_is_no_lead():
    rng = np.random.default_rng(1)
    command = np.cumsum(rng.standard_normal(3000)) / RATE
    q = 0.05 * np.roll(command, -20) + np.cumsum(rng.standard_normal(3000)) / RATE
    lead = find_lead(command, np.roll(command, -20), 1 / RATE, np.nan)
    assert lead.lead == pytest.approx(0.2)
    assert find_lead(command, q, 1 / RATE, np.nan) is None


@pytest.mark.parametrize("sign", [-1.0, 0.0])
def test_a_joint_that_does_not_follow_has_no_lead(log, sign):
    opposed = replace(log, q=sign * log.q_ref)
    assert errors(opposed) == []
    assert errors(opposed.window(0.0, 0.5)) == []
    ramp = np.linspace(0.0, 0.5, len(log.t))[:, None]
    assert errors(replace(log, q_ref=ramp, q=sign * ramp)) == []


def test_a_disturbance_as_slow_as_the_command_is_no_lead():
    def waves(rng):
        t = np.arange(1200) / 50
        f, phase = rng.uniform(0.1, 0.6, 8), rng.uniform(0, 6, 8)
        return np.sum(np.sin(2 * np.pi * f * t[:, None] + phase), axis=1)

    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        command = waves(rng)
        lead = find_lead(command, command + 0.5 * waves(rng), 0.02, np.nan)
        found += [seed] if lead else []
    assert len(found) <= 1  # 4, if the residual were white
