"""The figures of findings, by an independent computation: evidence and sentences alike."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.synthetic import exact_log, truth

from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.logs import channels, command_channels, hypotheses, loads, mounted
from robotid.diagnosis.logs.channels import check_channels
from robotid.diagnosis.logs.clock import check_clock
from robotid.diagnosis.logs.command_channels import _held, _Loop
from robotid.diagnosis.logs.hypotheses import Explanation, _refined
from robotid.diagnosis.logs.loads import _payload
from robotid.diagnosis.logs.motion_checks import check_excitation
from robotid.diagnosis.logs.torque_channels import _touches, check_torque_channels
from robotid.diagnosis.urdf import mesh_check as geometry
from robotid.diagnosis.urdf import rounding
from robotid.diagnosis.urdf.inertials import impossible_inertial
from robotid.diagnosis.urdf.mesh_check import _copies
from robotid.dynamics.base_parameters import structural_mapping
from robotid.robot.model import RobotModel
from robotid.robot.tree import Inertial

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
    assert found.evidence == {
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
    assert found.evidence == {"rows": rows, "delay": pytest.approx(late)}
    told = f"is constant for {rows} rows: it is updated at {100 / rows:.3g} Hz and logged at 100 Hz"
    assert told in found.message
    assert f"mean delay of {1e3 * late:.2g} ms" in found.message
    assert f"torque_delay = {late:.4f} (--torque-delay {late:.4f})" in found.message
    assert f"a cutoff below {25 / rows:.2g} Hz" in found.message


def test_clocks_that_were_set_are_told_from_gaps():
    set_ = np.where(np.arange(2000) > 500, 7.0, 0.0) + np.where(np.arange(2000) > 900, 3.0, 0.0)
    log = log_of(t=T + set_, q=log_of().q)
    kept = np.delete(np.arange(2000), np.r_[1200:1260, 1700:1740])
    log = replace(log, t=log.t[kept], q=log.q[kept], tau=log.tau[kept])
    found = list(check_clock(log))
    step = one(found, "clock_step")
    assert step.evidence == {"jump": pytest.approx(7.0), "at": pytest.approx(8.0), "steps": 2.0}
    assert "the clock jumps by 7 s at t = 8 s" in step.message
    gap = one(found, "gap")
    assert gap.evidence == {
        "gaps": 2.0, "longest": pytest.approx(0.61), "at": pytest.approx(14.99 + 10.0)
    }  # fmt: skip
    assert "2 gaps, the longest of 0.61 s at t = 24.99 s" in gap.message
    rate = one(found, "rate")
    assert rate.evidence["samples"] == 1900
    assert rate.evidence["rate"] == pytest.approx(100.0)
    assert rate.evidence["duration"] == pytest.approx(19.99 + 10.0)


def test_impossible_inertias_are_told_with_their_moments():
    def found(*inertia, mass=2.0):
        return list(impossible_inertial("arm", Inertial(mass, (0, 0, 0), (0, 0, 0), inertia), True))

    [broken] = found(4.0, 0.0, 0.0, 1.0, 0.0, 2.5)
    assert broken.severity == "error"
    assert broken.evidence == pytest.approx(
        {"smallest": 1.0, "middle": 2.5, "largest": 4.0, "triangle": -0.5}
    )
    assert "the sum of the two smaller ones is 3.5, wanted more than 4" in broken.message
    [negative] = found(1.0, 2.0, 0.0, 1.0, 0.0, 2.5)  # -1, 2.5, 3
    assert "moments of inertia -1, 2.5, 3 kg m^2 are not all positive" in negative.message
    assert "(-1 is not)" in negative.message
    assert negative.evidence["triangle"] == pytest.approx(-1.5)
    [flat] = found(3.0, 0.0, 0.0, 1.0, 0.0, 2.0)
    assert flat.severity == "note"
    assert found(3.0, 0.0, 0.0, 1.5, 0.0, 2.0) == []
    zero, _ = found(4.0, 0.0, 0.0, 1.0, 0.0, 2.5, mass=0.0)
    assert (zero.code, zero.severity) == ("zero_mass", "warning")
    assert found(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, mass=0.0)[1:] == []


@pytest.mark.parametrize(("mass", "severity"), [(2.0, "warning"), (-2.0, "warning"), (0.4, "note")])
def test_a_payload_is_told_with_its_moments(mass, severity):
    pi = np.repeat([5.0, 3.0], 10)
    model = SimpleNamespace(
        standard_parameters=lambda: pi, layout=SimpleNamespace(n_inertial=20, bodies=("up", "low"))
    )
    [found] = _payload(
        SimpleNamespace(model=model), np.array([mass, 0.1, -0.2, 0.3]), 0.05, "run.csv"
    )
    assert found.evidence == {
        "mass": mass, "std_error": 0.05, "mcx": 0.1, "mcy": -0.2, "mcz": 0.3
    }  # fmt: skip
    assert (found.where, found.severity) == ("run.csv: low", severity)
    sign = "more" if mass > 0 else "less"
    assert f"low carries roughly {abs(mass):.2g} kg {sign} than in the URDF, if" in found.message
    assert "+-" not in found.message  # errors of gains and of the other masses are not in it
    assert list(_payload(SimpleNamespace(model=model), np.array([0.14, 0, 0, 0]), 0.05, "x")) == []


def test_copies_differ_by_the_largest_of_all_their_sides():
    inertial = Inertial(2.0, (0.1, 0, 0), (0, 0, 0), (1.0, 0, 0, 1.0, 0, 1.5))
    other = Inertial(2.1, (0.1, 0, 0), (0, 0, 0), (1.0, 0, 0, 1.0, 0, 1.5))
    sides = {"a": (0.2, 0.3, 0.4), "b": (0.3, 0.4, 0.2), "c": (0.2, 0.5, 0.3), "d": (1, 1, 1)}
    points = {name: np.array([[0, 0, 0], own]) for name, own in sides.items()}
    inertials = dict.fromkeys("abc", inertial) | {"d": other}
    model = SimpleNamespace(
        layout=SimpleNamespace(bodies=tuple("abcd")), tree=SimpleNamespace(inertials=inertials)
    )
    [found] = _copies(model, points)
    # of c the longest side is 0.1 m longer, of 0.5 m
    assert found.evidence == {"links": 3.0, "difference": pytest.approx(0.2)}
    assert "the links a, b, c have the same mass" in found.message
    del points["c"]
    assert list(_copies(model, points)) == [], "b has the same sides in another order"


@pytest.mark.parametrize("off", [0.31, -0.27, 0.02])
def test_an_offset_is_refined_to_either_side(monkeypatch, off):
    shifted = SimpleNamespace(
        q=np.array([[0.5, -0.2 + off, 0.7]]), v=0.0, a=0.0, with_motion=lambda motion: motion
    )
    shifted.v, shifted.a = 2.0 * shifted.q, 3.0 * shifted.q
    monkeypatch.setattr(hypotheses, "own_share", lambda motion: np.concatenate(motion).reshape(-1))
    read = hypotheses._offset(shifted, 1, off)
    assert (read.joints, read.values) == ((1,), (off,))
    recorded = [0.5, -0.2 + off, 0.7]
    np.testing.assert_allclose(
        read.share, [0.5, -0.2, 0.7, *(k * x for k in (2.0, 3.0) for x in recorded)]
    )

    def offset(_probe, j, x):
        return Explanation("position_offset", np.array([0.1 + (x - 1.5 - off) ** 2]), (j,), (x,))

    monkeypatch.setattr(hypotheses, "_offset", offset)
    found = _refined(None, offset(None, 2, 1.5))
    assert found.joints == (2,)
    assert found.values[0] == pytest.approx(1.5 + off, abs=0.01)
    assert found.misfit <= offset(None, 2, 1.5).misfit


def test_held_commands_are_told_with_their_period():
    held = np.arange(2000) // 5 * 5
    log = log_of(q_ref=log_of().q[held])
    [found] = _held(log, [_Loop(log, j) for j in range(2)])
    assert found.evidence == {"rows": 5.0, "period": pytest.approx(0.05)}
    assert "of a, b is updated every 5 rows, at 20 Hz on average" in found.message
    assert "is constant for 50 ms" in found.message
    assert "else 25 ms are added to the identified delay of the drive" in found.message


def test_a_lag_is_the_slope_of_the_phase_with_the_error_of_a_weighted_mean():
    rng = np.random.default_rng(3)
    ref = np.convolve(rng.standard_normal(2010), np.ones(11) / 11, "valid")
    q_ref = np.column_stack([ref, ref])
    log = log_of(q=np.roll(q_ref, 7, axis=0), q_ref=q_ref)
    loop = _Loop(log, 0)
    f = np.linspace(0.5, 6.0, 23)
    phase, weight = 0.3 * rng.standard_normal(23), rng.uniform(5.0, 400.0, 23)
    H = np.exp(-2j * np.pi * f * 0.074 + 1j * phase)
    loop.__dict__.update(response=(f, H, weight), bandwidth=5.1)
    lag, error = loop.lag
    used = f < 5.1
    w, y, weight = 2 * np.pi * f[used], (2 * np.pi * f * 0.074 - phase)[used], weight[used]
    slope = np.sum(weight * w * y) / np.sum(weight * w**2)
    assert lag == pytest.approx(slope, rel=1e-9)
    share = weight * w**2 / np.sum(weight * w**2)
    scatter = np.sqrt(np.sum(share * (y / w - slope) ** 2) / (len(w) - 1))
    assert error == pytest.approx(max(scatter, np.sum(weight * w**2) ** -0.5), rel=1e-9)
    assert scatter > np.sum(weight * w**2) ** -0.5, "the scatter counts"


def test_what_a_motion_determines_is_the_same_of_its_halves():
    model = RobotModel.from_urdf(ROOT / "urdf" / "planar_2r.urdf")
    rng = np.random.default_rng(1)
    log = exact_log(model, truth(model), rng, samples=900, rate=100.0, noise=[0.2, 0.05])
    signals = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0)
    motion, mapping = process(log, signals), structural_mapping(model)
    parts = [motion.part(0, 300), motion.part(300, 900)]
    [whole], [cut] = (check_excitation(model, mapping, m, signals, "x") for m in ([motion], parts))
    assert cut.evidence == pytest.approx(whole.evidence, rel=1e-9)
    assert cut.message == whole.message
    assert 0 < whole.evidence["weakest"] < 1


def test_quantised_channels_are_reported_with_each_joint_s_own_steps():
    t, rng = 3.0 + np.arange(2000) / 100, np.random.default_rng(0)
    steps, sizes = (0.5, 0.25, 0.01, 0.005), (4.0, 3.5, 3.0, 2.0)
    tau = np.column_stack(
        [
            np.round(size * np.sin(2 * t + size) / h) * h
            for h, size in zip(steps, sizes, strict=True)
        ]
        + [rng.standard_normal(2000)]
    )
    log = SimpleNamespace(name="run.csv", joints=tuple("abcde"))
    few, many = channels._quantisation(log, "tau", tau, "auto")
    count = [np.ptp(x) / h for x, h in zip(tau.T, steps, strict=False)]
    assert few.evidence == pytest.approx({"steps_a": count[0], "steps_b": count[1]})
    assert many.evidence == pytest.approx({"steps_c": count[2], "steps_d": count[3]})
    assert (few.severity, many.severity) == ("warning", "note")
    assert f"tau of a, b is quantised in steps of 0.5, {count[0]:.0f} steps" in few.message
    assert f"tau of c, d is quantised in steps of 0.01, {count[2]:.0f} steps" in many.message
    (unused,) = channels._quantisation(log, "dq", tau[:, :2], "differentiated")
    assert unused.severity == "note"


def test_steps_say_what_is_to_be_done_about_them():
    t, step = np.arange(2000) / 100, 2 * np.pi / 4096
    log = SimpleNamespace(name="run.csv", joints=("a",))

    def said(kind, size, h, velocity="auto"):
        x = (np.round(size * np.sin(2 * t) / h) * h)[:, None]
        (finding,) = channels._quantisation(log, kind, x, velocity)
        return finding.message.partition("over its range; ")[2]

    encoder = "the step is that of an encoder of 12 bits, not of the digits"
    assert said("q", 0.06, step) == f"{encoder}: record a larger motion, of 100 steps or more"
    assert said("q", 0.6, step) == f"{encoder}, and small in the motion; no action needed"
    assert said("q", 2.0, 0.01) == "log more digits"
    assert "No action needed: velocity = 'auto' differentiates" in said("dq", 1.0, 50 * step)
    assert said("dq", 1.0, 50 * step, "measured").endswith("set velocity = 'differentiated'")


@pytest.mark.parametrize("stated", [0.0, 0.004])
def test_the_error_of_a_delay_is_of_the_joints_that_have_one(monkeypatch, stated):
    lags = np.array([0.011, 0.0, 0.014, 0.0125])
    monkeypatch.setattr(channels, "velocity_lags", lambda log: (0.012, lags))
    (found,) = channels._velocity_delay(log_of(), stated)
    error = 1.48 * 0.001 / np.sqrt(3)
    assert found.evidence == pytest.approx({"delay": 0.012 - stated, "std_error": error})
    reported = f"a delay of {12 - 1e3 * stated:.1f} +- {1e3 * error:.1f} ms"
    assert reported in found.message
    assert found.message.endswith("or set [signals] velocity_delay = 0.0120")


def test_a_torque_is_clipped_at_either_limit_and_held_by_groups():
    t = 3.0 + np.arange(2000) / 100
    q = np.column_stack([np.sin(2 * t), np.cos(t), np.sin(t), np.cos(3 * t)])
    tau = 5.0 * q
    tau[:, 0] = np.clip(tau[:, 0], -4.0, 3.0)
    k = np.arange(2000)
    tau[:, 1], tau[:, 2], tau[:, 3] = tau[k // 4 * 4, 1], tau[k // 7 * 7, 2], tau[k // 4 * 4, 3]
    log = replace(log_of(), joints=tuple("abcd"), q=q, tau=tau)
    found = list(check_torque_channels(log))
    clipped = [f for f in found if f.code == "clipped" and f.where == "run.csv: a"]
    for finding, limit in zip(clipped, (3.0, -4.0), strict=True):
        share = np.mean(tau[:-1, 0] == limit) * 1999 / 2000
        assert finding.evidence == pytest.approx({"limit": limit, "share": share})
        assert f"at its limit {limit:g} in {100 * share:.3g} % of the rows" in finding.message
    repeated = {f.where: f.evidence for f in found if f.code == "repeated_torque"}
    assert repeated == {
        "run.csv: b, d": pytest.approx({"rows": 4.0, "delay": 0.015}),
        "run.csv: c": pytest.approx({"rows": 7.0, "delay": 0.03}),
    }


def test_torques_without_sign_are_those_of_three_joints_that_reach_zero_thrice():
    """Of five joints the last ones are 0 only twice, and never."""
    t = 3.0 + np.arange(2000) / 100  # 20 s
    speeds = 0.75, 0.9, 1.1
    tau = np.column_stack([4.0 * np.abs(np.cos(w * (t - 3.0))) for w in speeds])
    twice = 5.0 * np.abs(np.cos(0.3 * (t - 3.0)))
    q, all_tau = np.cos(np.outer(t, np.arange(1, 6))), np.column_stack([tau, twice, 3.0 + 0 * t])
    log = Log(t, q, all_tau, tuple("abcde"), path="run.csv")
    found = one(check_torque_channels(log), "unsigned_torque")
    assert (found.severity, found.evidence) == ("error", {"joints": 3})
    assert found.message.startswith(
        "run.csv: no torque is ever negative, although the torques of 3 joints reach 0 repeatedly"
    )
    for changed in (all_tau * [1, 1, 1, 1, -1], all_tau[:, [0, 1, 3, 3, 4]]):
        other = replace(log, tau=changed)
        assert "unsigned_torque" not in {f.code for f in check_torque_channels(other)}
    # it is away from 0 above a fifth of its top, at 0 below a twentieth
    for between, low, count in ((0.21, 0.04, 2), (0.19, 0.04, 1), (0.9, 0.06, 0)):
        wave = 5.0 * np.array([1.0, low, between, low, 1.0])
        assert _touches(wave) == count


def test_proportional_commands_are_alike_in_their_changes_too():
    """Of a chain of three the least of the largest correlations; a trend alone is none."""
    t, rng = np.arange(3000) / 100, np.random.default_rng(2)
    base = np.sin(1.3 * t) + 0.3 * np.sin(3.7 * t)
    slow = [0.08 * np.sin(5 * t + k) for k in range(2)]
    commands = [base, base + slow[0], base + slow[0] + 1.2 * slow[1], t + 0.3 * rng.random(3000),
                t + 0.3 * rng.random(3000)]  # fmt: skip
    loops = [
        SimpleNamespace(name=name, command=own, step=0.01)
        for name, own in zip("abcde", commands, strict=True)
    ]
    (found,) = command_channels._alike(log_of(), loops)
    x = np.column_stack(commands[:3])
    same = np.minimum(np.abs(np.corrcoef(x.T)), np.abs(np.corrcoef((x[10:] - x[:-10]).T)))
    assert same[0, 2] < 0.95 < same[1, 2] < same[0, 1]
    assert found.evidence == pytest.approx({"correlation": same[1, 2], "joints": 3.0})
    assert found.where == "run.csv: a, b, c"
    assert f"(correlation {same[1, 2]:.3f} or more)" in found.message


def test_slow_commands_are_reported_with_the_widest_range_and_the_fastest_frequency():
    def loop(name, f, delays, lag=0.3, bandwidth=np.nan):
        return SimpleNamespace(
            name=name, response=(np.array(f), None, None), delays=delays, lag=(lag, 0.0),
            bandwidth=bandwidth,
        )  # fmt: skip

    loops = [
        loop("a", [0.5, 1.5], (0.011, 0.09)), loop("b", [0.5, 2.5], (0.034, 0.121)),
        loop("c", [9.0], (0.0, 0.2), bandwidth=7.0), loop("d", [8.0], (0.01, 0.02)),
    ]  # fmt: skip
    log = SimpleNamespace(name="run.csv", joints=tuple("abcd"))
    (found,) = command_channels._slow(log, loops)
    assert found.where == "run.csv: a, b"
    assert found.evidence == {"frequency": 2.5, "shortest": 0.011, "longest": 0.121}
    assert "follow it up to 2.5 Hz" in found.message
    assert "Any delay up to 121 ms" in found.message


def test_a_saturated_drive_is_reported_with_the_largest_error_of_all_movements():
    """Four movements at 1.25 per second, whose commands jump."""
    dt, q, command = 0.01, [0.0], [0.0]
    rows = 0
    for length in (0.5, 1.0, 0.75, 0.625):
        target = q[-1] + length
        count = round(length / 1.25 / dt)
        rows += count
        q += [q[-1] + 1.25 * dt * (k + 1) for k in range(count)] + [target] * 150
        command += [target] * (count + 150)
    q, command = np.array(q), np.array(command)
    loop = SimpleNamespace(name="a", joint=0, q=q, command=command, step=dt, unit="rad")
    log = SimpleNamespace(name="run.csv", q=np.random.default_rng(0).random((len(q), 1)))
    ((name, found),) = command_channels._saturated(log, [loop])
    assert (name, found.where) == ("a", "run.csv: a")
    assert found.evidence["speed"] == pytest.approx(1.25)
    assert found.evidence["error"] == pytest.approx(1.0, abs=0.03)
    assert found.evidence["share"] == pytest.approx(rows / len(q), rel=0.05)
    assert "in 4 movements" in found.message


def test_rounded_angles_are_reported_by_what_they_change_with_the_largest_error(monkeypatch):
    angles = {
        "a": {"3.1416": np.pi, "1.57": np.pi / 2}, "b": {"0.785": np.pi / 4},
        "c": {"-1.5708": -np.pi / 2},
    }  # fmt: skip
    monkeypatch.setattr(rounding, "_rounded", lambda tree: angles)
    monkeypatch.setattr(rounding, "_effect", lambda model, mapping: (2, "two more"))
    monkeypatch.setattr(rounding, "_carrying", lambda tree: {"a", "c", "other"})
    model = SimpleNamespace(tree=SimpleNamespace(path="x/robot.urdf"))
    felt, other = rounding.rounded_angles(model, None)
    assert (felt.severity, felt.where) == ("warning", "file robot.urdf")
    assert felt.evidence == pytest.approx({"largest_error": np.pi / 2 - 1.57, "felt": 1.0})
    assert felt.message.startswith("the joints a, c have rounded angles in rpy; write ")
    assert (other.severity, other.where) == ("note", "joint b")
    assert other.evidence == pytest.approx({"largest_error": np.pi / 4 - 0.785, "felt": 0.0})


def test_a_body_is_small_beside_the_mass_of_all(monkeypatch):
    """Of 3 x 5 kg and 7.5 g: a fault of the last is a note, of 16 g a warning."""
    for mass, severity in ((0.0075, "note"), (0.016, "warning")):
        pi = np.zeros(40)
        pi[::10] = 5.0, 5.0, 5.0, mass
        for at, inertia in ((4, 0.04), (6, 0.04), (9, 0.04)):
            pi[at::10] = inertia * pi[::10]
        pi[31] = 0.9 * mass  # the centre is outside by 0.4 m
        layout = SimpleNamespace(n_inertial=40, bodies=tuple("abcd"))
        points = dict.fromkeys("abcd", np.array([[-0.5, -0.2, -0.1], [0.5, 0.2, 0.1]]))
        monkeypatch.setattr(geometry, "body_points", lambda *_, with_visual, own=points: own)
        found = list(geometry.audit_bodies(SimpleNamespace(layout=layout), pi, points))
        outside = one(found, "com_outside")
        assert outside.severity == severity
        assert outside.evidence == {"outside": pytest.approx(0.4)}
        assert one(found, "density").evidence == {"density": pytest.approx(mass / 0.08)}


def test_a_spike_is_one_by_the_noise_of_its_own_channel():
    """Both channels rest and jump by 0.4; the noise of the first is larger."""
    values = np.zeros((400, 2))
    values[:, 0], values[:, 1] = np.sin(np.arange(400) / 30), np.cos(np.arange(400) / 30)
    values[[100, 250]] += 4.0
    log = SimpleNamespace(name="run.csv", joints=("a", "b"), t=T[:400])
    (found,) = channels._spikes(log, "tau", values, np.array([0.5, 0.01]))
    assert found.where == "run.csv: tau_b"
    assert found.evidence["rows"] == 2
    assert found.severity == "note"  # four times the amplitude, which a motion may reach
    values[[100, 250]] += 2.0
    (found,) = channels._spikes(log, "tau", values, np.array([0.5, 0.01]))
    assert found.severity == "error"


def test_velocities_of_another_joint_are_reported_with_both_correlations():
    log = log_of()
    alike = np.array([[0.31, 0.93], [0.2, 0.9]])
    [found] = channels._velocity_order(log, alike)
    assert found.where == "run.csv: a"
    assert found.evidence == {"correlation": 0.93, "own_correlation": 0.31}
    assert "dq_b is d(q)/dt of q_a (correlation 0.93; with dq_a 0.31)" in found.message


def test_a_bandwidth_starts_at_the_largest_of_the_slow_responses():
    loop = _Loop(log_of(q_ref=log_of().q), 0)
    f = np.linspace(0.5, 8.0, 16)
    size = np.array(
        [0.6, 0.6, 1.3, 1.3, 1.3, 1.0, 1.0, 1.0, 1.0, 1.0, 0.7, 0.7, 0.7, 0.7, 0.4, 0.4]
    )
    loop.__dict__["response"] = (f, size * np.exp(0.3j * f), np.ones(16))
    # the medians of five are 0.6, 0.6, 1.3, 1.3 ...: 0.92 is the limit
    assert loop.bandwidth == f[10]


@pytest.mark.parametrize(("needed", "named"), [((0, 3), [0, 3]), ((3,), [3]), ((1, 3), [1, 3])])
def test_scales_are_named_of_the_joints_that_need_them(monkeypatch, needed, named):
    scale, other = np.array([0.2, 7.0, 1.1, 30.0]), np.array([0, 1, 3])
    model = SimpleNamespace(fit=lambda scale: (scale, scale, scale))
    found = scale.tolist()

    def fits(_model, scale, _theta):
        return all(scale[j] == found[j] for j in needed)

    monkeypatch.setattr(loads, "_is_this_robot", fits)
    assert loads._needed(model, scale, other).tolist() == named
    every = np.arange(4)
    assert loads._needed(model, scale, every).tolist() == [0, 1, 2, 3]
    assert scale.tolist() == found


@pytest.mark.parametrize(
    ("left", "loaded", "is_named"), [(86.0, 85.5, True), (88.0, 87.0, False), (86.0, 83.0, False)]
)
def test_a_part_is_not_mounted_by_its_gain_over_the_whole(monkeypatch, left, loaded, is_named):
    model = RobotModel.from_urdf(ROOT / "urdf" / "planar_2r.urdf")
    pi = model.standard_parameters()
    size = model.layout.n_inertial
    mass = 0.3 * pi[size - 10]
    misfits = iter([91.0, 95.0, left])
    probe = SimpleNamespace(model=model, of=lambda lighter: lighter)
    parts = [
        (["lid"], np.eye(10)[0] * 0.25 * pi[size - 10]),
        (["hand", "tool"], np.eye(10)[0] * mass),
    ]
    stub = SimpleNamespace(fit=lambda scale: (loaded, None, None))
    monkeypatch.setattr(mounted, "load_model", lambda probe, share: stub)
    monkeypatch.setattr(mounted, "_misfit_without_load", lambda model: next(misfits))
    monkeypatch.setattr(mounted, "_parts", lambda probe: parts)
    found = list(mounted.check_unmounted_parts(probe, np.zeros(2), "run.csv"))
    assert bool(found) == is_named
    if is_named:
        assert found[0].evidence == {
            "mass": pytest.approx(mass),
            "gain": pytest.approx(91.0 - left),
        }
        assert "without hand, tool, with a total mass" in found[0].message
