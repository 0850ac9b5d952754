"""Zeros, scales, a clock and joints that are stated wrongly are named with their size."""

import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio as pin
import pytest
from helpers.corruptions import delayed
from helpers.misfits import EFFECTS, log_with
from helpers.paths import ROOT

from robotid.base.findings import Finding
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.residual.discrepancies import alterations, explain_residual, readings
from robotid.diagnosis.residual.misfit import find_misfits, settled
from robotid.diagnosis.residual.term_trials import take_sample
from robotid.diagnosis.verdict.fit_findings import fit_findings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import inverse_dynamics
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.identification.pipeline import with_drives
from robotid.robot.drives import wanted_families
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

sys.path.append(str(ROOT / "benchmarks"))
from verdict_cases import ROBOTS, build, measured, move

SETTINGS = EstimatorSettings(prior_weight=1.0)


def fitted(model, logs, estimator=SETTINGS, families=None):
    """Return the fit of a log, with plain friction or families, beside one kept apart."""
    own, kept = ([hold_log(model, log, SignalSettings())] for log in logs)
    recordings = Recordings(model, structural_mapping(model), own, kept)
    families = families or wanted_families("viscous+coulomb", model.joints)
    return with_drives(recordings, estimator, families)


def found(model, change, robot="ur5_robot.urdf", turn=None, duration=16.0, estimator=None):
    """Return the findings on logs of a robot near its URDF that a change spoilt alike."""
    arm = build(replace(ROBOTS["ur5"], urdf=str(robot), joints=model.joints), (3,), turn=turn)
    logs = []
    for part in (0, 1):
        run = move(arm.model, np.random.default_rng([3, part]), 50.0, duration)
        run = replace(run, tau=arm.rigid(run) + arm.drives(run))
        run = measured(run, "usual", np.random.default_rng([4, part]))
        log = Log(run.t, run.q, run.tau, model.joints, run.v, path=f"run{part}.csv")
        logs.append(change(log))
    fit = fitted(model, logs, estimator or EstimatorSettings("wls"))
    return explain_residual(fit, take_sample(fit))[1]


def times(log, **factors):
    """Return the log with channels multiplied."""
    return replace(log, **{name: factor * getattr(log, name) for name, factor in factors.items()})


def on(model, joint, value, elsewhere):
    return np.where(np.array(model.joints) == joint, value, elsewhere)


def test_nothing_is_said_of_a_robot_that_only_weighs_differently(four):
    assert found(four, lambda log: log) == ()


# of harmonics the slowest, which gravity is most like
@pytest.mark.parametrize("effect", sorted(EFFECTS.keys() - {"ripple", "harmonic drive"}))
def test_nothing_is_said_of_drives_that_do_more_than_their_model(four, effect):
    logs = [log_with(four, 3, effect, part=part, rate=50.0, duration=20.0) for part in (0, 1)]
    found = fitted(four, logs, EstimatorSettings("wls"))
    _, discrepancies = explain_residual(found, take_sample(found))
    assert discrepancies == ()


# sizes are of first order: those of large faults are off by a quarter
@pytest.mark.parametrize(
    ("change", "code", "where", "size", "words"),
    [
        (lambda log, one: replace(log, q=log.q + one("elbow_joint", 0.1, 0.0)),
         "position_offset", "elbow_joint", -0.1, "position offset 0."),
        (lambda log, one: replace(log, q=log.q + one("elbow_joint", 0.02, 0.0) * np.sign(log.v)),
         "lost_motion", "elbow_joint", -0.04, "position differs by 0.04"),
        (lambda log, one: replace(log, q=1.1 * log.q, v=None),
         "angle_scale", "all joints", 1 / 1.1 - 1, "every position fits best with a factor of 0.9"),
        (lambda log, one: replace(log, q=log.q * one("elbow_joint", 1.2, 1.0), v=None),
         "angle_scale", "elbow_joint", 1 / 1.2 - 1, "q_elbow_joint fits best with a factor of 0.8"),
        (lambda log, one: replace(log, tau=log.tau * one("elbow_joint", 1.3, 1.0)),
         "torque_scale", "elbow_joint", 0.3, "about 1."),
        (lambda log, one: replace(times(log, t=1.1), v=None),
         "time_scale", "all joints", 1.1**2 - 1, "time stamps run 1."),
        (lambda log, one: times(log, tau=np.where(np.arange(6) < 3, 1.0, 1.5)),
         "torque_scale", "wrist_1_joint, wrist_2_joint, wrist_3_joint", 0.5, "are about 1."),
    ],
)  # fmt: skip
def test_what_is_stated_wrongly_is_named_with_its_size(ur5, four, change, code, where, size, words):
    model = four if code in ("angle_scale", "time_scale") else ur5  # which fewer joints show
    first = found(model, lambda log: change(log, lambda *args: on(model, *args)))[0]
    assert (first.code, first.where, first.severity) == (code, where, "warning")
    assert first.evidence["size"] == pytest.approx(size, rel=0.25)
    assert words in first.message
    if code == "time_scale":
        faster = np.sqrt(1.0 + first.evidence["size"])  # inertial torques go with its square
        assert f"the time stamps run {faster:.3f} times as fast" in first.message


@pytest.mark.parametrize(("code", "size"), [("joint_elasticity", 0.05), ("lost_motion", 0.06)])
def test_a_gear_behind_its_encoder_that_yields_or_has_play_is_named(ur5, code, size):
    t, logs = np.arange(0.0, 20.0, 0.005), []
    for part in (0, 1):
        rng = np.random.default_rng(part)
        f, phase = rng.uniform(0.1, 0.6, (5, 1, 6)), rng.uniform(0.0, 7.0, (5, 1, 6))
        q = 0.35 * np.sin(2 * np.pi * f * t[:, None] + phase).sum(axis=0)
        v = np.gradient(q, t, axis=0)
        motion, robot = zip(q, v, np.gradient(v, t, axis=0), strict=True), ur5.pin_model
        load = np.array([pin.rnea(robot, robot.createData(), *x) for x in motion])
        ratio = load / np.sqrt(np.mean(load**2, axis=0))
        yields = ratio if code == "joint_elasticity" else 0.5 * np.tanh(load)
        q += on(ur5, "elbow_joint", size * yields, 0.0)
        tau = load + 0.5 * v + 0.01 * rng.standard_normal(v.shape)
        logs.append(Log(t, q, tau, ur5.joints, path=f"run{part}.csv"))
    fit = fitted(ur5, logs)
    first = explain_residual(fit, take_sample(fit))[1][0]
    assert (first.code, first.where) == (code, "elbow_joint")
    assert abs(first.evidence["size"]) == pytest.approx(size, rel=0.25)


def test_columns_are_derivatives_of_the_torque(ur5):
    logs = [log_with(ur5, 3, part=part, rate=50.0, duration=10.0) for part in (0, 1)]
    fit = fitted(ur5, logs, EstimatorSettings("wls"))
    sample, h, j = take_sample(fit), 1e-5, 2
    pi = np.abs(fit.standard) + 1.0  # large armatures, too
    one = np.eye(6)[j]
    changes = {
        ("angle_scale", ()): lambda m, x: replace(m, q=x * m.q, v=x * m.v, a=x * m.a),
        ("position_offset", (ur5.joints[j],)): lambda m, x: replace(m, q=m.q + (x - 1) * one),
        ("torque_scale", (ur5.joints[j],)): None,
    }
    found = {
        (a.reading.code, a.joints): Z[..., 0]
        for a, Z in alterations(ur5, readings(ur5, pi, sample)).items()
    }
    # gains: of one joint, or of all from one on but the first and the last
    ends = [ur5.joints[first:] for first in (1, 2, 3, 4)]
    scaled = {joints for code, joints in found if code == "torque_scale"}
    assert scaled == {*((joint,) for joint in ur5.joints), *ends}

    def torques(change, x):
        return np.concatenate([inverse_dynamics(ur5, pi, change(m, x)) for m in sample.at])

    for key, change in changes.items():
        if change is None:
            wanted = one * torques(lambda m, x: m, 1.0)
        else:
            wanted = (torques(change, 1 + h) - torques(change, 1 - h)) / (2 * h)
        np.testing.assert_allclose(found[key], wanted, atol=1e-4 * np.abs(wanted).max())


def test_a_large_offset_of_a_zero_has_its_size_and_makes_no_other_finding(four):
    joint, offset = "shoulder_lift_joint", -0.2
    moved = offset * on(four, joint, 1.0, 0.0)
    (finding,) = found(four, lambda log: replace(log, q=log.q + moved))
    assert (finding.code, finding.where) == ("position_offset", joint)
    # to first order it would be far less
    assert finding.evidence["size"] == pytest.approx(-offset, rel=0.06)
    assert 0 < finding.evidence["std_error"] < 0.05 * abs(offset)


def recorded(truth, model, seed, joint, offset, **effect):
    """Return logs with the effect on a joint, whose position is off besides."""
    moved = offset * np.eye(len(model.joints))[joint]
    logs = [log_with(truth, seed, joint=joint, part=part, **effect) for part in (0, 1)]
    return [replace(log, q=log.q + moved) for log in logs]


def both(*args, rate=50.0, **effect):
    """Return the terms found alone, and terms and discrepancies found together, of such logs."""
    fit = fitted(args[1], recorded(*args, rate=rate, **effect))
    sample = take_sample(fit)
    return find_misfits(sample), *explain_residual(fit, sample)


def named(findings):
    return [(finding.code, finding.where) for finding in findings]


# what explains more
@pytest.mark.parametrize(("offset", "size", "rate"), [(0.1, 1.0, 50.0), (0.03, 3.0, 100.0)])
def test_a_spring_is_named_beside_a_zero_that_is_off(ur5, offset, size, rate):
    how = {"effect": "spring", "size": size, "rate": rate}
    alone, (spring,), others = both(ur5, ur5, 3, 2, offset, **how)
    assert (spring.joint, spring.term.name) == ("elbow_joint", "spring")
    assert spring.size == pytest.approx(alone[0].size, rel=0.01)
    assert named(others) == [("position_offset", "elbow_joint")]
    assert others[0].evidence["size"] == pytest.approx(-offset, rel=0.04)


def test_a_base_that_is_not_level_makes_no_counterbalance(ur5):
    turn = pin.exp3(np.array([np.radians(6), 0.0, 0.0]))
    gravity = turn @ np.array([0.0, 0.0, -9.81])
    truth = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), gravity=gravity)
    alone, misfits, others = both(truth, ur5, 3, 1, 0.1)
    assert [(m.joint, m.term.code) for m in alone] == [("shoulder_pan_joint", "position_periodic")]
    assert misfits == ()
    assert [each.code for each in others] == ["gravity", "position_offset"]
    assert others[0].where == "all joints"
    assert others[1].where in ("shoulder_lift_joint", "wrist_1_joint")  # their axes are parallel
    assert others[0].evidence["size"] == pytest.approx(np.tan(np.radians(6)), rel=0.15)
    assert -0.2 < others[1].evidence["size"] < -0.08  # of the second to first order only


def test_a_joint_that_lies_elsewhere_is_named(ur5, tmp_path):
    longer = rewritten(tmp_path / "longer.urdf", "elbow_joint", "xyz", [0.0, 0.0, 0.05])
    first = found(ur5, lambda log: log, robot=longer)[0]
    assert (first.code, first.where) == ("joint_origin", "elbow_joint")
    assert first.evidence["size"] == pytest.approx(0.05, rel=0.25)


def rewritten(path, joint, key, change, element="origin"):
    """Write a UR5 with another ``xyz`` or ``rpy`` of the origin, or axis, of a joint."""
    tree = ET.parse(example_urdf("ur5_robot.urdf"))
    (place,) = tree.getroot().findall(f"joint[@name='{joint}']/{element}")
    values = np.array([float(x) for x in place.get(key).split()]) + change
    place.set(key, " ".join(str(x) for x in values))
    tree.write(path)
    return path


@pytest.mark.parametrize(
    ("joint", "key", "element", "change"),
    [
        ("wrist_1_joint", "rpy", "origin", [np.radians(8), 0, 0]),
        ("shoulder_lift_joint", "xyz", "axis", [np.sin(0.14), np.cos(0.14) - 1, 0]),
    ],
)
def test_a_joint_axis_of_another_direction_is_named(ur5, tmp_path, joint, key, element, change):
    tilted = rewritten(tmp_path / "tilted.urdf", joint, key, change, element)
    first = found(ur5, lambda log: log, robot=tilted)[0]
    assert (first.code, first.where) == ("axis_direction", joint)
    assert first.evidence["angle"] == pytest.approx(8.0, rel=0.2)
    assert "its axis is tilted by" in first.message


def test_the_delay_of_one_torque_is_named(ur5):
    (first,) = found(ur5, lambda log: delayed(log, 0.02, "elbow"))
    assert (first.code, first.where) == ("joint_delay", "elbow_joint")
    assert first.evidence["size"] == pytest.approx(0.02, rel=0.25)


@pytest.mark.parametrize("delay", [0.0, 0.02])
def test_a_delay_that_was_selected_as_a_drive_term_is_named(four, delay):
    plain = [log_with(four, 3, part=part, rate=50.0, duration=10.0) for part in (0, 1)]
    logs = [delayed(log, delay, "shoulder_pan") for log in plain]
    found = fit_findings(fitted(four, logs, families=dict.fromkeys(four.joints)))
    sizes = [one.evidence["size"] for one in found if one.code == "joint_delay"]
    assert sizes == pytest.approx([delay] * bool(delay), rel=0.25)


def test_a_base_that_is_off_the_level_by_two_degrees_is_named(ur5):
    first = found(ur5, lambda log: log, turn=pin.exp3(np.radians([2.0, 0.0, 0.0])))[0]
    assert (first.code, first.where) == ("gravity", "all joints")
    assert first.evidence["angle"] == pytest.approx(2.0, abs=0.5)


def disturbed(model, log, force, gravity=lambda t: 0.0 * t, at="ee_link"):
    """Return a log with a force (3,) on a frame, and with gravity turned about the x axis."""
    engine, tau = model.pin_model.copy(), log.tau.copy()
    data, tip = engine.createData(), engine.getFrameId(at)
    down = np.array(engine.gravity.linear)
    for k, (t, q) in enumerate(zip(log.t, log.q, strict=True)):
        J = pin.computeFrameJacobian(engine, data, q, tip, pin.LOCAL_WORLD_ALIGNED)
        engine.gravity.linear = down
        tau[k] -= J[:3].T @ force(t) + pin.computeGeneralizedGravity(engine, data, q)
        engine.gravity.linear = pin.exp3(np.array([gravity(t), 0.0, 0.0])) @ down
        tau[k] += pin.computeGeneralizedGravity(engine, data, q)
    return replace(log, tau=tau)


@pytest.mark.parametrize("at", ["ee_link", "wrist_3_joint"])
def test_a_constant_force_on_the_last_link_is_named_with_its_size(ur5, at):
    force = np.array([2.4, -1.8, 0.0])  # 2 % of the weight are 3.6 N
    (first,) = found(ur5, lambda log: disturbed(ur5, log, lambda t: force, at=at))
    assert (first.code, first.where, first.severity) == ("external_force", "all joints", "warning")
    assert first.evidence["size"] == pytest.approx(3.0, rel=0.15)
    assert "changes in time" not in first.message


@pytest.mark.parametrize(
    ("code", "force", "gravity"),
    [
        ("external_force", lambda t: 25 * np.sin(np.r_[2, 1.7, 1.3] * t + range(3)), np.zeros_like),
        ("moving_gravity", lambda t: np.zeros(3), lambda t: 0.4 * np.sin(0.3 * t)),
    ],
)
def test_a_force_or_gravity_that_changes_in_time_is_the_only_finding(ur5, force, gravity, code):
    (first,) = found(
        ur5, lambda log: disturbed(ur5, log, force, gravity), estimator=SETTINGS
    )  # unlike least squares with masses that act as gravity is tilted only
    assert (first.code, first.where, first.severity) == (code, "all joints", "error")
    assert first.evidence["share_pct"] > 50
    if code == "moving_gravity":
        assert first.evidence["angle"] == pytest.approx(np.degrees(0.4 / np.sqrt(2)), rel=0.3)
    else:
        assert first.evidence["size"] == pytest.approx(25.0 * np.sqrt(1.5), rel=0.3)
    codes = "gravity", "unexplained_torque", "torque_delay"
    (merged,) = settled([Finding(x, "warning", "a.csv", "") for x in codes], [first])
    assert (merged.severity, merged.evidence["replaces"]) == ("error", 3.0)


def grasped(log, model):
    """Return a log of which the last link carries 0.1 kg, 0.1 m along its axis, from 9.5 s on."""
    robot, a = model.pin_model.copy(), np.gradient(log.v, log.t, axis=0)
    for k in range(1, 7):
        robot.inertias[k] = pin.Inertia.Zero()
    robot.inertias[6] = pin.Inertia(0.1, np.array([0.0, 0.1, 0.0]), 1e-5 * np.eye(3))
    at = zip(log.q, log.v, a, strict=True)
    load = np.array([pin.rnea(robot, robot.createData(), *x) for x in at])
    return replace(log, tau=log.tau + load * (log.t > 9.5)[:, None])


def test_a_load_that_is_grasped_during_the_recording_is_named_with_mass_and_time(ur5):
    (first,) = found(ur5, partial(grasped, model=ur5), estimator=SETTINGS)
    assert (first.code, first.severity) == ("payload_step", "warning")
    assert first.evidence["mass"] == pytest.approx(0.1, rel=0.1)
    assert first.evidence["start"] == pytest.approx(9.5, abs=0.6)
    assert "more from t = 9" in first.message


@pytest.mark.parametrize(("faster", "noise"), [(1.1, 0.1), (1.03, 0.03)])
def test_a_small_share_of_the_residual_is_named_if_recordings_kept_apart_show_it(
    ur5, faster, noise
):
    """If its size is twice the one that changes a result, 0.04."""

    def change(log):
        rng = np.random.default_rng(int(log.name[3]))
        more = noise * log.tau.std(axis=0) * rng.standard_normal(log.tau.shape)
        return replace(log, tau=log.tau + more, t=faster * log.t, v=None)

    findings = found(ur5, change, duration=25.0)
    assert [(x.code, x.where) for x in findings[:1]] == [("time_scale", "all joints")] * (
        faster > 1.05
    )
    for first in findings[:1]:
        assert 3 < first.evidence["share_pct"] < 10
        assert first.evidence["size"] == pytest.approx(0.21, rel=0.25)
