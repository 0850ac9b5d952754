import tomllib
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers.mujoco_plant import assert_recovered, held, multisine, plant, recorded

from robotid.base.findings import Finding
from robotid.data.log import Log
from robotid.diagnosis.catalogue import finding
from robotid.dynamics.simulation.loops import ClosedLoopRobot, cut_windows
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop.from_commands import (
    identify_loops,
    loop_findings,
    with_gravity,
)
from robotid.identification.closed_loop.loop_settings import LogGains, LoopSettings
from robotid.identification.closed_loop.position_errors import run_open_loop
from robotid.identification.closed_loop.stages import fit_loops, stated_loops
from robotid.output.files.entries import build_result
from robotid.robot.drives import Coulomb, Offset, PositionCoulomb, Viscous

NOISE = 1e-3  # [rad]: with less, that MuJoCo's friction is a little soft shows beside the errors
SETTINGS = SimulationSettings(window=1.0, lead=0.3, bodies=0.0, step=2e-3)
COARSE = replace(SETTINGS, step=5e-3)  # more than a row of 250 Hz: the fit halves rows


SLOW = finding("slow_command", "log", "hip", frequency=2.0, longest=0.09)


def stated(robot, **changes):
    return LoopSettings(**({"delays": "group"} | robot.gains | changes))


@pytest.fixture(scope="module")
def leg():
    """A leg of a Go2 in MuJoCo, a log to fit and one kept apart."""
    rng = np.random.default_rng(4)
    robot = plant("leg", rng)
    return robot, *(recorded(robot, rng, duration=d, noise=NOISE)[0] for d in (3.0, 2.2))


@pytest.fixture(scope="module")
def found(leg):
    """What is found with stated gains; the doctor said of the log that it shows no delay."""
    robot, log, kept = leg
    return identify_loops(
        robot.model, [log], [kept], stated(robot), SETTINGS, chooses=False, examined=[SLOW]
    )


@pytest.fixture(scope="module")
def scaleless(leg):
    """What is found without gains, hip and thigh having the same drives."""
    robot, log, kept = leg
    loop = LoopSettings(groups={"upper": list(robot.model.joints[:2])})
    return identify_loops(robot.model, [log], [kept], loop, SETTINGS, chooses=False)


def test_the_drives_of_a_leg_are_recovered_within_their_errors(leg, found):
    estimate = found.fit.estimate
    assert estimate.converged
    assert {name.rpartition(".")[2] for name in estimate.names} == {
        "armature", "viscous", "coulomb", "offset", "delay",
    }  # fmt: skip
    assert_recovered(estimate, leg[0].truth)
    windows = found.fit.simulator.windows
    assert {len(window.log.t) for window in windows} == {len(leg[1].t)}, "kept ones are not fitted"


def test_drives_behind_a_slow_clock_are_recovered_once_it_is_stated(rng):
    """At 100 Hz the hold is worth some 5 ms, which damping has to give else."""
    robot = plant("planar", rng, delay=0.0, coulomb=0.0)
    t = np.arange(800) / 500.0
    q_ref = multisine(t, robot.middle, 0.5 * robot.reach, rng, highest=8.0)
    q = held(robot, q_ref, 500.0, 100.0) + 1e-4 * rng.standard_normal(q_ref.shape)
    log = Log(t, q, 0 * q, robot.model.joints, q_ref=q_ref, has_torque=False)
    worst = {}
    for rate in (100.0, None):
        loop = stated(robot, rate=rate)
        found = identify_loops(robot.model, [log], [], loop, SETTINGS, chooses=False)
        values = dict(zip(found.fit.estimate.names, found.fit.estimate.theta, strict=True))
        off = {
            what: max(abs(values[f"{d.joint}.{what}"] / getattr(d, what) - 1) for d in robot.drives)
            for what in ("armature", "viscous")
        }
        worst[rate] = (max(off.values()), found.fitted[0].rmse.max())
        late = max(value for name, value in values.items() if name.endswith("delay"))
        assert rate is None or late < 2e-4
    assert worst[100.0] == pytest.approx((0.0, 1e-4), abs=0.02), worst
    assert worst[None][0] > 0.2


def test_a_command_that_goes_on_between_its_rows_is_early(rng):
    """Of commands held for 2 ms every fifth is logged: 10 ms held would be 4 ms later."""
    robot = plant("planar", rng, delay=0.0)
    log, truth = recorded(robot, rng, duration=2.0, noise=1e-4)
    q, q_ref = log.q[::5], log.q_ref[::5]
    log = Log(log.t[::5], q, 0 * q, robot.model.joints, q_ref=q_ref, has_torque=False)
    loop = stated(robot, delays="one")
    found = identify_loops(robot.model, [log], [], loop, COARSE, chooses=False)
    [early] = [f for f in found.findings if f.code == "no_delay"]
    assert (early.severity, early.where) == ("note", "robot.delay")
    assert early.evidence["delay"] == pytest.approx(-4.25e-3, abs=2e-4), "and half a step"
    values = zip(found.estimate.theta, found.estimate.std_error, strict=True)
    for name, (value, error) in zip(found.estimate.names, values, strict=True):
        assert name == "robot.delay" or abs(value - truth[name]) < 4.0 * error, name


def test_the_drives_of_an_arm_are_recovered_with_steps_that_are_halved():
    """From commands that last as long as the steps to begin with, which are too long by far."""
    rng = np.random.default_rng(1)
    robot = plant("planar", rng)
    usual = {"rate": 250.0, "noise": 3e-4, "step": 1e-4}
    first, second = (recorded(robot, rng, duration=d, **usual)[0] for d in (2.4, 1.6))
    logs, truth = [first, replace(second, t=second.t + 7.0)], robot.truth
    found = identify_loops(robot.model, logs, [], stated(robot), COARSE, chooses=False)
    assert [len(run.q) for run in found.fitted] == [600, 400]
    windows = found.fit.simulator.windows
    assert [sum(w.stop - w.first for w in windows if w.log.t[0] == t) for t in (0, 7)] == [600, 400]
    estimate, fine = found.fit.estimate, found.fit.simulator.fine
    errors = np.array(
        [value - truth[n] for n, value in zip(estimate.names, estimate.theta, strict=True)]
    )
    for name, error in zip(estimate.names, errors, strict=True):
        wide = {"delay": 3e-4, "offset": 0.05}.get(name.rpartition(".")[2], 0.03 * truth[name])
        assert abs(error) < wide, name
    assert np.sqrt(np.mean((errors / estimate.std_error) ** 2)) < 1.7
    assert fine.step == pytest.approx(estimate.details["step"])
    assert round(4e-3 / fine.step) in (8, 16)
    assert estimate.details["halving"] <= 0.2  # of a standard error, that another would move
    again, coarse = (
        run_open_loop(r, found.fit.loops, first) for r in (fine, found.fit.simulator.robot)
    )
    np.testing.assert_allclose(found.fitted[0].rmse, again.rmse, rtol=1e-12)
    assert (found.fitted[0].rmse < coarse.rmse).all(), "errors of the steps of the fit"


def test_it_is_an_identification_as_others_are(found):
    layout, estimate = found.model.layout, found.estimate
    size, count = layout.n_inertial, len(found.base)
    name = f"Identification of {found.model.name}: {count} base parameters"
    assert repr(found) == f"<{name} by simulation, verdict good>"
    assert set(found.sources[:size]) == {"prior"}, "bodies stay: bodies=0"
    content = build_result(found, {"estimator": {"name": "simulation"}})
    entries = {entry["name"]: entry for entry in content["drive_parameters"]}
    share = dict(zip(estimate.names, found.shrunk, strict=True))
    known = zip(estimate.names, estimate.theta, estimate.std_error, estimate.quantile, strict=True)
    for key, value, error, quantile in known:
        own = entries[key]
        assert (own["value"], own["quantile"]) == (value, quantile)
        assert own["std_error"] == pytest.approx(error, rel=1e-6)
        if key in layout.names:
            ends = [value - quantile * error, value + quantile * error]
            assert own["interval_95"] == pytest.approx(ends, rel=1e-6)
            assert own["source"] == ("data" if share[key] < 0.3 else "mixed")
            i = layout.names.index(key)
            ends = content["ranges"]["drives"][key.rpartition(".")[0]][key.rpartition(".")[2]]
            assert ends["high"] == pytest.approx(found.standard_interval[i, 1])
    stated = entries[f"{found.model.joints[0]}.kp"]
    assert (stated["std_error"], stated["source"]) == (None, "stated")
    of_bodies = ~found.mapping.K[:, size:].any(axis=1)
    unfitted = [entry["std_error"] is None for entry in content["base_parameters"]]
    np.testing.assert_array_equal(unfitted, np.isinf(found.base_error))
    np.testing.assert_array_equal(unfitted, of_bodies)
    joint = content["validation"][0]["per_joint"][found.model.joints[1]]
    [run] = found.validation
    assert joint["relative_error_pct"] == pytest.approx(100 * run.rmse[1] / run.spread[1])
    command = run.baselines["command"][1]
    assert joint["command_relative_error_pct"] == pytest.approx(100 * command / run.spread[1])


def test_without_gains_the_scale_is_said_to_rest_on_the_urdf(scaleless):
    assert not scaleless.has_stated_gains
    [scale] = [f for f in scaleless.findings if f.code == "scale"]
    assert scale.severity == "warning"
    assert "set kp in [controller]" in scale.message
    assert scaleless.validation[0].baselines["urdf"] is None, "no open loop without gains"


def test_joints_of_a_group_share_their_drive(leg, scaleless):
    hip, thigh, calf = leg[0].model.joints
    names, loops = scaleless.fit.estimate.names, scaleless.fit.loops
    for shared in ("kp", "armature", "viscous"):
        assert f"upper.{shared}" in names
        assert f"{calf}.{shared}" in names
    assert f"{hip}.coulomb" in names, "what wears is each drive's own"
    assert f"{thigh}.coulomb" in names
    for own in (loops.armature, loops.kp):
        assert own[0] == own[1] != own[2]


def test_of_many_scales_that_suit_the_positions_the_urdfs_is_taken():
    rng = np.random.default_rng(5)
    robot = plant("planar", rng)
    log, truth = recorded(robot, rng, duration=2.0, rate=250.0, step=2e-4)
    settings, loop = replace(COARSE, bodies=0.1), LoopSettings(delays="group")
    fitted = fit_loops(robot.model, [log], loop, settings, chooses=False)
    gains = [unknown.what == "kp" for unknown in fitted.simulator.free_parameters]
    exact = np.array([truth[name] for name in np.array(fitted.estimate.names)[gains]])
    np.testing.assert_allclose(fitted.estimate.theta[gains], exact, rtol=0.02)
    assert (fitted.estimate.std_error[gains] > 0.1 * exact).all(), "others would do, too"


def test_a_stated_delay_that_is_wrong_is_no_good_result(leg):
    robot, log, kept = leg
    wrong = stated(robot, delay=0.03)
    found = identify_loops(robot.model, [log], [kept], wrong, SETTINGS, chooses=False)
    [bound] = [f for f in found.findings if f.code == "at_bound"]
    assert bound.severity == "warning"
    assert "armature" in bound.message
    assert "leave the delay out of [controller]" in bound.message.lower()
    assert found.verdict.status != "good"
    assert bound.message in found.verdict.reasons


def test_stated_gains_that_the_bodies_contradict_are_named(leg, found):
    robot, log, kept = leg
    assert not [f for f in found.findings if f.code == "gains_contradicted"]
    scale = found.fit.scale
    assert (np.abs(scale.change) < 4.0 * scale.error).all()
    assert abs(scale.common) < 4.0 * scale.common_error < 0.05
    gains = {k: {d.joint: 1.25 * getattr(d, k) for d in robot.drives} for k in ("kp", "kd")}
    wrong = stated(robot, **gains)
    other = identify_loops(robot.model, [log], [kept], wrong, SETTINGS, chooses=False)
    [named] = [f for f in other.findings if f.code == "gains_contradicted"]
    assert named.severity == "warning"
    assert named.where == "controller"
    assert named.evidence["scale"] == pytest.approx(0.8, abs=0.08)
    each = other.fit.scale
    assert (np.abs(each.change + 0.2) < 4.0 * each.error).all()
    assert (each.error > each.common_error).all(), "together they show it better"
    kp = 1.25 * robot.drives[0].kp * named.evidence["scale"]
    assert f"{robot.drives[0].joint} = {kp:.3g}" in named.message
    assert other.verdict.status != "good"
    assert named.message in other.verdict.reasons


def test_a_slow_command_does_not_contradict_the_delay_that_was_found(found):
    [settled] = [f for f in found.findings if f.code == "slow_command"]
    assert settled.severity == "note"
    assert "Any delay" not in settled.message
    names, errors = found.fit.estimate.names, found.fit.estimate.std_error
    worst = max(e for n, e in zip(names, errors, strict=True) if n.endswith("delay"))
    assert settled.evidence["std_error"] == pytest.approx(worst)
    assert f"{1e3 * worst:.2g} ms" in settled.message


def test_a_delay_at_its_bound_leaves_the_warning_of_a_slow_command(found):
    delay = next(name for name in found.fit.estimate.names if name.endswith("delay"))
    other = next(name for name in found.fit.estimate.names if name.endswith("coulomb"))
    details = {**found.estimate.details, "at_bound": (other, delay)}
    fitted = replace(found.fit, estimate=replace(found.estimate, details=details))
    bound = replace(found, fit=fitted)
    named = {one.code: one for one in loop_findings(bound, [SLOW])}
    assert named["slow_command"].severity == named["no_delay"].severity == "warning"
    assert "in [controller] is wrong" in named["at_bound"].message, "which no cause explains"
    assert "its lower bound, one row" in named["no_delay"].message
    entries = build_result(bound, {"estimator": {"name": "simulation"}})["drive_parameters"]
    sources = {e["source"] for e in entries if e["name"].endswith(".delay")}
    assert "bound" in sources


def test_a_zero_that_position_and_command_do_not_share_is_named(leg, found):
    """A constant torque of a drive above all its other torques is kp times the difference."""
    drive, names = leg[0].drives[2], found.estimate.names
    for offset, wanted in ((0.2, {drive.joint: 0.2}), (-0.2, {drive.joint: -0.2}), (0.01, {})):
        theta, away = found.estimate.theta.copy(), offset * np.eye(3)[2]
        theta[[name.endswith("delay") for name in names]] = 0.0
        theta[names.index(f"{drive.joint}.offset")] += drive.kp * offset
        runs = [replace(x, log=replace(x.log, q_ref=x.log.q_ref + away)) for x in found.fitted]
        fit = replace(found.fit, estimate=replace(found.estimate, theta=theta))
        other = replace(found, fit=fit, fitted=tuple(runs))
        other = replace(other, findings=loop_findings(other, ()))
        named = [f for f in other.findings if f.code == "position_offset"]
        assert {f.where: f.evidence["offset"] for f in named} == pytest.approx(wanted, abs=0.01)
        assert (other.verdict.status == "good") == (not named)
        explained = {f.code for f in loop_findings(other, [replace(SLOW, code="command_sign")])}
        assert not explained & {"position_offset", "no_delay"}


RATIOS = np.array([[1.0, 3.0, 1 / 3], [1.0, 2.0, 1 / 3]])  # of kp and kd


@pytest.fixture(scope="module")
def other_log(leg):
    """A log in which the drives but that of the hip have other gains."""
    both = zip(leg[0].drives, RATIOS.T, strict=True)
    drives = tuple(replace(d, kp=x * d.kp, kd=y * d.kd) for d, (x, y) in both)
    changed = replace(leg[0], drives=drives)
    return recorded(changed, np.random.default_rng(5), duration=1.0, noise=NOISE)[0]


def test_free_gains_are_recovered_from_logs_with_stated_ratios(leg, other_log):
    logs, truth = [leg[1], replace(other_log, gain_factors=RATIOS)], dict(leg[0].truth)
    loop = stated(leg[0], kp=None, kd=None)
    estimate = fit_loops(leg[0].model, logs, loop, SETTINGS, chooses=False).estimate
    hip, *others = leg[0].model.joints  # a kd that is the same in both logs is viscous friction
    truth[f"{hip}.viscous"] += truth.pop(f"{hip}.kd")
    assert {x for x in estimate.names if x.endswith("kd")} == {f"{x}.kd" for x in others}
    assert_recovered(estimate, truth)


def test_a_log_with_other_gains_is_named_with_their_ratio(found, other_log):
    named = []
    for known in (np.ones((2, 3)), RATIOS**0.2):  # of the ratios, by the job
        log = replace(other_log, gain_factors=known)
        run = run_open_loop(found.fit.simulator.robot, found.fit.loops, log)
        findings = loop_findings(replace(found, validation=(run,)), ())
        named += [one for one in findings if one.code == "other_gains"]
    assert [one.joints for one in named] == [(joint,) for joint in other_log.joints[1:]] * 2
    for one in named:
        entry = tomllib.loads(one.message.partition("in the job file: ")[2])["controller"]
        gains = LogGains.from_dict(entry).factors(found.loop, other_log.joints)
        np.testing.assert_allclose(gains, RATIOS, rtol=0.15)
        assert one.evidence["after"] < 0.3 * one.evidence["before"]
        assert "times its value in the fit: with other gains its position error" in one.message
    other = replace(found, validation=(run,))
    stop = Finding("end_stop", "warning", "", "", joints=other_log.joints[:1])  # another cause
    assert not [one for one in loop_findings(other, [stop]) if one.code == "other_gains"]
    assert not [one for one in loop_findings(found, ()) if one.code == "other_gains"]


def test_friction_by_position_is_found_where_it_is_and_nowhere_else(leg):
    robot, rng = leg[0], np.random.default_rng(3)
    model, n = robot.model, 3
    t = np.arange(750) / 250.0
    q_ref = multisine(t, robot.middle, robot.reach, rng)
    centre = float(robot.middle[2])
    plain = (Viscous(), Coulomb(), Offset())
    bent = (
        *plain,
        PositionCoulomb(order=1, centre=centre),
        PositionCoulomb(order=2, centre=centre),
    )
    loops = replace(
        stated_loops(model, stated(robot)), armature=np.full(n, 0.02), delay=np.full(n, 0.006),
        terms=(plain, plain, bent),
        values=np.array([0.1, 0.2, 0.0, 0.1, 0.2, 0.0, 0.1, 0.25, 0.0, 0.5, 1.0]),
    )  # fmt: skip
    told = Log(t, q_ref, np.zeros_like(q_ref), model.joints, q_ref=q_ref, has_torque=False)
    [out] = ClosedLoopRobot(model, step=5e-4).roll_out(loops, cut_windows(told, np.inf, 0.0))
    log = replace(told, q=out.q + 3e-4 * rng.standard_normal(out.q.shape))
    found = identify_loops(model, [log], [], stated(robot), COARSE)
    chosen = {(t.joint, t.terms) for t in found.fit.tried if t.is_chosen}
    assert {joint for joint, _ in chosen} == {model.joints[2]}
    values = dict(zip(found.fit.estimate.names, found.fit.estimate.theta, strict=True))
    [name] = [f.where for f in found.findings if f.code == "friction_found"]
    assert name == model.joints[2]
    terms = [t for t in found.fit.loops.terms[2] if isinstance(t, PositionCoulomb)]
    parts = zip((1, 2), terms, strict=True)
    q = np.linspace(centre - 0.2, centre + 0.2, 9)
    size = values[f"{name}.coulomb"] + sum(
        values[f"{name}.{term.name}"] * (q - term.centre) ** k for k, term in parts
    )
    exact = 0.25 + 0.5 * (q - centre) + (q - centre) ** 2
    np.testing.assert_allclose(size, exact, rtol=0.05)
    assert f"{name}.{terms[0].name}" in found.model.layout.names
    moments, v = found.moments[name], np.gradient(log.q[:, 2], log.t)
    moving = v[np.abs(v) > 0.05 * np.abs(v).max()]  # of its own speed
    k = moments.terms.index("viscous")
    assert moments.products[k, k] == pytest.approx(np.mean(moving**2), rel=1e-9)


def test_gravity_that_a_controller_compensates_is_fed_forward(leg):
    robot, log, _ = leg
    pin_model, data = robot.model.pin_model, robot.model.pin_model.createData()
    few = replace(log, **{key: getattr(log, key)[:5] for key in ("t", "q", "tau", "q_ref")})
    weight = [pin.computeGeneralizedGravity(pin_model, data, q).copy() for q in few.q]
    np.testing.assert_allclose(with_gravity(robot.model, few).tau_ref, weight, atol=1e-10)
    more = replace(few, tau_ref=np.arange(15.0).reshape(5, 3))
    np.testing.assert_allclose(
        with_gravity(robot.model, more).tau_ref - more.tau_ref, weight, atol=1e-10
    )
