"""Terms that a drive's model lacks are named on their joint, with their share; others are not."""

import tomllib
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import misfits as helper
from helpers.fitting import fit
from helpers.misfits import EFFECTS
from helpers.paths import ROOT

from robotid.base.findings import Finding
from robotid.cli.doctor import doctor
from robotid.cli.identify import identify
from robotid.cli.job import job_from_settings, read_job
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.explanations import explained
from robotid.diagnosis.residual import misfit
from robotid.diagnosis.residual.misfit import couplings as couplings_of
from robotid.diagnosis.residual.misfit import (
    find_misfits,
    misfit_finding,
    ripples,
    setting_of,
    settled,
)
from robotid.diagnosis.residual.term_trials import RIDGE, Trials, take_sample
from robotid.diagnosis.verdict.verdict import warnings_of
from robotid.estimation.fitting.drive_terms import JointMotion
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.robot.drives import AUTO
from robotid.robot.model import RobotModel

log_with = partial(helper.log_with, rate=50.0)  # [Hz]: the effects are slower than 10 Hz
FIT = EstimatorSettings()  # bounds have no part in what is tested here
WLS = EstimatorSettings("wls")  # nor has the prior, where terms alone are read
PAN, LIFT, ELBOW = "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"


def fitted(model, logs, *, estimator=WLS, **settings):
    """Return the fit, with plain friction, of a log beside one kept apart."""
    return fit(model, logs[:1], validation=logs[1:], estimator=estimator, **settings)


def concluded(model, logs, friction="viscous+coulomb"):
    """Return what is concluded of such logs."""
    return identify(
        model, logs[:1], validation=logs[1:], estimator=FIT, friction=friction, doctor=False
    )


def logs_of(model, seed, effect=None, joint=0, **options):
    return [log_with(model, seed, effect, joint, part=k, **options) for k in (0, 1)]


def identified(model, *what, **options):
    return fitted(model, logs_of(model, *what, **options))


def misfits(found):
    return find_misfits(take_sample(found))


@pytest.fixture(scope="module")
def three(ur5):
    """The first three joints of a UR5."""
    return RobotModel.from_urdf(ur5.tree, joints=ur5.joints[:3])


@pytest.fixture(scope="module")
def clean(three):
    """The robot of seed 1 whose drives have nothing beside their model."""
    return identified(three, 1)


def rmse(found, joint):
    return found.metrics().per_joint[joint].rmse


@pytest.mark.parametrize(
    ("effect", "joint"),
    [("stribeck", 2), ("saturating", 1), ("load", 1), ("periodic", 0), ("harmonic drive", 1),
     ("spring", 2), ("counterbalance", 0), ("windup", 1), ("drift", 2)],
)  # fmt: skip
def test_a_missing_term_is_named_first_on_its_joint_with_its_share(three, clean, effect, joint):
    found = identified(three, 1, effect, joint)
    name = three.joints[joint]
    # what is left without the effect is the noise: the rest is its share
    share = 1.0 - (rmse(clean, name) / rmse(found, name)) ** 2
    first, *others = misfits(found)
    assert (first.joint, first.term.code) == (name, EFFECTS[effect].code)
    assert first.share == pytest.approx(share, abs=0.15)
    assert first.confirmed > 0.4 * share
    assert all(other.joint == name and other.share < 0.1 * first.share for other in others)


def test_a_drift_has_the_trend_of_the_friction_per_minute(three):
    """Coulomb friction falls by 0.3 of the RMS torque in 30 s."""
    found = identified(three, 1, "drift", 2)
    log = log_with(three, 1, None, 2, noise=0.0)
    true = -0.3 * np.sqrt(np.mean(log.tau[:, 2] ** 2)) / 0.5  # [N m/min]
    (first, *_) = misfits(found)
    change, error = first.trend
    assert error < 0.05 * abs(true)
    assert abs(change - true) < 3 * error + 0.05 * abs(true)  # the torque filter
    finding = misfit_finding(first, found, [])
    assert finding.evidence["trend"] == change
    assert finding.evidence["trend_std_error"] == error
    said = f"friction at the RMS speed falls by {-change:.2g} +- {error:.1g} N m per min. It"
    assert said in finding.message
    (other, *_) = misfits(identified(three, 1, "spring", 2))
    assert np.isnan(other.trend).all()
    finding = misfit_finding(other, found, [])
    assert "trend" not in finding.evidence
    assert "per min" not in finding.message


def test_a_coupling_of_some_share_needs_that_of_the_other_joint(monkeypatch):
    rows = [("a", "b", 0.3), ("b", "a", 0.3), ("c", "b", 0.59), ("d", "c", 0.61), ("d", "", 0.1)]
    terms = [SimpleNamespace(joint=j, share=x, term=SimpleNamespace(coupled=o)) for j, o, x in rows]
    monkeypatch.setattr(misfit, "_of_joint", lambda sample, j: [terms[j]])
    assert find_misfits(SimpleNamespace(joints=rows)) == tuple(terms[k] for k in (0, 1, 3, 4))


@pytest.mark.parametrize(
    ("effect", "joint", "size", "unit"),
    [("load", 1, 0.1, "N m per N m"), ("spring", 2, None, "N m/rad")],
)
def test_the_size_holds_the_truth(three, effect, joint, size, unit):
    (found,) = misfits(fitted(three, logs_of(three, 2, effect, joint), estimator=FIT))
    if size is None:  # 0.3 of the RMS torque per radian
        t, q, v, load = np.zeros((4, 1))
        log, clean = (log_with(three, 2, e, joint, noise=0.0) for e in (effect, None))
        usual = np.sqrt(np.mean(clean.tau[:, joint] ** 2))
        size = float(EFFECTS[effect].torque(t, q + 1.2, v, load, usual)[0])
        slope = np.polyfit(log.q[:, joint], (log.tau - clean.tau)[:, joint], 1)[0]
        assert slope == pytest.approx(size, rel=1e-3)
    assert found.unit == unit
    # the load is that of an estimate without the term, which is some per cent off
    assert abs(found.size - size) < 3.0 * found.std_error + 0.02 * size
    assert found.std_error < 0.03 * size


def test_coulomb_friction_that_was_left_out_is_asked_for(three):
    terms = ("armature", "viscous", "offset")
    model = RobotModel.from_urdf(three.tree, joints=three.joints, terms=terms)
    logs = [log_with(three, 1, part=k) for k in (0, 1)]
    fit_of = concluded(model, logs)
    found = [misfit_finding(misfit, fit_of, fit_of.on_misfit) for misfit in fit_of.misfits]
    loud = {finding.where for finding in found if finding.severity == "warning"}
    assert loud == set(three.joints)
    for finding in found:
        assert (finding.code, finding.evidence["share_pct"] > 50) == ("friction_shape", True)
        assert "Set friction = 'viscous+coulomb' in [model]" in finding.message


def test_a_ripple_is_named_with_its_periods_a_turn_and_the_terms_that_predict_it(three, tmp_path):
    logs = logs_of(three, 2, "harmonic drive", 1)

    def error(found):
        (metrics,) = found.predictions.values()
        return metrics.per_joint[LIFT].relative_error_pct

    found = concluded(three, logs, AUTO)
    named, *_ = found.misfits
    assert (named.joint, named.term.name) == (LIFT, "ripple 40")
    plain = log_with(three, 2, noise=0.0).tau[:, 1]
    assert named.unit == "N m rms"  # 0.15 of the RMS torque in amplitude
    assert named.size == pytest.approx(0.15 * np.sqrt(np.mean(plain**2) / 2), rel=0.1)
    pasted = setting_of(named, found)
    assert pasted == (
        f'[drives]\n{LIFT} = [{{ term = "Harmonic", order = 40.0, is_sine = false }}, '
        '{ term = "Harmonic", order = 40.0, is_sine = true }]'
    )
    table = {"urdf": three.tree.path, "joints": list(three.joints)}
    table |= {"identification": [{"log": "run.csv"}]} | tomllib.loads(pasted)
    job = job_from_settings(table, "job", tmp_path)
    better = concluded(job.model(), logs, AUTO)
    assert error(found) > 10.0
    assert error(better) < 4.0  # the torque's noise is 2 %
    assert better.misfits == ()


@pytest.mark.parametrize("memory", [0, 50])
def test_noise_of_any_colour_is_no_term(three, memory):
    assert misfits(identified(three, 5, noise=0.03, memory=memory)) == ()


def test_a_counterbalance_that_masses_can_imitate_is_never_good(four):
    """40 N m at the lift: gravity of the URDF's is held by the other joints."""
    logs = [log_with(four, 3, "balancing", 1, part=k) for k in (0, 1)]
    guesses = doctor(four, logs[:1], validation=logs[1:])
    assert {f.code for f in guesses if f.severity != "note"} == {"urdf_mismatch"}
    found = concluded(four, logs, AUTO)
    assert found.scale_check.gravity[LIFT] < 0.3
    assert found.scale_check.contradicts
    assert found.verdict.status == "usable"


def test_columns_join_the_regressor_and_base_parameters_are_refitted(three):
    sample = take_sample(identified(three, 1, "load", 1, duration=12.0))
    np.testing.assert_array_equal(np.diff(sample.taken[0]), 1)  # 10 Hz passes of 25: two per sample
    j, b = 2, sample.W.shape[-1]
    Z = np.column_stack([sample.motions[j].q, sample.motions[j].v ** 3])
    trials = Trials(sample.of_joint(j), Z[:, None])
    for trial, left_out in ((trials.whole, None), (trials.held_out, 3)):
        rows = np.arange(len(sample.r)) < sample.rows
        if left_out is not None:
            rows[sample.segments[left_out]] = False
        columns = np.zeros((*sample.r.shape, 2))
        columns[:, j] = sample.weight[:, [j]] * Z
        X = np.concatenate([sample.W, columns], axis=2)
        # the prior of base parameters, and the ridge of the columns
        size = np.sqrt(RIDGE * np.sum(columns[rows] ** 2, axis=(0, 1)))
        prior = np.diag(np.concatenate([np.ones(b), size]))
        stacked = np.vstack([X[rows].reshape(-1, b + 2), prior])
        r = np.append(sample.r[rows].ravel(), np.zeros(b + 2))
        theta = np.linalg.lstsq(stacked, r, rcond=None)[0]
        found = trial.parameters([0, 1])
        found = found if left_out is None else found[left_out]
        np.testing.assert_allclose(found, theta[b:], rtol=1e-6)
        k = sample.segments[left_out or 0]
        squares = np.sum((sample.r[k, j] - X[k, j] @ theta) ** 2)
        assert trial.left([0, 1])[left_out or 0] == pytest.approx(squares, rel=1e-6)


@pytest.mark.parametrize("limit", [0.6, 1.1])
def test_a_torque_that_stays_where_the_model_predicts_more_is_clipped(three, limit):
    one, kept = logs_of(three, 1, duration=16.0)
    tau, top = one.tau.copy(), limit * np.abs(one.tau[:, 1]).max()
    noise = 0.02 * top * np.random.default_rng(0).standard_normal(len(tau))
    tau[:, 1] = np.clip(tau[:, 1], -top, top) + noise
    found = concluded(three, [replace(one, tau=tau), kept]).findings
    limits = [(f.joints, f.evidence["limit"] / top) for f in found if f.code == "clipped"]
    seen = {(joints, round(abs(x), 1)) for joints, x in limits}
    assert seen == ({((LIFT,), 1.0)} if limit < 1 else set())


def test_a_clipped_torque_that_the_doctor_names_is_not_named_again(three):
    one, kept = logs_of(three, 1, duration=16.0)
    top = 0.6 * np.abs(one.tau[:, 1]).max() * np.array([np.inf, 1.0, np.inf])
    one = replace(one, tau=np.clip(one.tau, -top, top))
    found = identify(three, [one], validation=[kept], friction="viscous+coulomb").findings
    signs = [np.sign(f.evidence["limit"]) for f in found if f.code == "clipped"]
    assert len({*signs}) == len(signs) > 0


def test_a_term_stands_for_what_the_doctor_guessed_of_its_torque(three):
    guesses = [
        Finding("urdf_mismatch", "warning", "run.csv", ""),
        Finding("unexplained_torque", "warning", f"run.csv: {LIFT}", "", joints=(LIFT,)),
        Finding("unexplained_torque", "warning", f"run.csv: {PAN}", "", joints=(PAN,)),
        Finding("clipped", "warning", f"run.csv: {LIFT}", ""),
    ]

    def said(code, share, **others):
        figures = {"share_pct": share, "error_pct": 1.0, **others}
        term = Finding(code, "note", LIFT, "It is.", figures, joints=(LIFT,))
        *kept, term = settled(guesses, [term])
        return [guesses.index(f) for f in kept], term

    kept, term = said("spring", 90.0)
    assert kept == [2, 3]
    assert (term.severity, term.evidence["replaces"]) == ("warning", 2.0)
    assert "It explains urdf_mismatch, unexplained_torque and" in term.message
    assert [doubt.joint for doubt in warnings_of([term], three.joints)] == [LIFT]
    certain = Finding("current_for_torque", "warning", "run.csv", "", {"gain": 3.0})
    assert settled([certain], [term])[0] == certain
    assert said("position_offset", 90.0)[0] == [2, 3]
    assert said("load_friction", 90.0)[0] == [0, 2, 3]
    assert said("spring", 90.0, validation_share_pct=8.0)[0] == [0, 1, 2, 3]
    assert said("spring", 40.0) == ([0, 1, 2, 3], Finding(
        "spring", "note", LIFT, "It is.", {"share_pct": 40.0, "error_pct": 1.0}, joints=(LIFT,)
    ))  # fmt: skip


def test_a_finding_of_the_fit_is_a_note_while_a_reading_of_its_joints_stands():
    # the first two joints carry a common body, the last one is of another arm
    support = np.repeat([[True, True, False], [False, True, False], [False, False, True]], 10, 1)
    joints, layout = (PAN, LIFT, "other"), SimpleNamespace(n_inertial=30)
    robot = SimpleNamespace(joints=joints, support=support, layout=layout)

    def doctor_finding(code, joint="", severity="error", log="a.csv"):
        return Finding(code, severity, "", "It is.", log=log, joints=(joint,) if joint else ())

    terms = [doctor_finding("coupling", joint, "warning", "") for joint in joints]

    def said(*findings, ignore=()):
        return "".join(one.severity[0] for one in explained(findings, robot, ignore))

    assert said(*terms) == "www"
    for code in ("current_for_torque", "torque_sign", "drive_off", "position_sign"):
        assert said(doctor_finding(code, PAN), *terms) == "ennw"
    assert said(doctor_finding("torque_sign", PAN), *terms, ignore=("torque_sign",)) == "ewww"
    assert said(doctor_finding("torque_delay", "", "warning"), *terms) == "wnnn"
    # what names no cause explains nothing, and a finding of a validation log rests on the fit
    gain = doctor_finding("log_differs", LIFT, "warning", "b.csv")
    assert said(doctor_finding("unexplained_torque", PAN, "warning"), terms[0], gain) == "wwn"
    assert said(doctor_finding("urdf_mismatch"), doctor_finding("joint_axis", PAN)) == "e"
    # of one channel: the columns are exchanged, or it has another unit and its sign is no evidence
    codes = ("torque_order", "beyond_effort", "torque_sign")
    order, far, sign = (doctor_finding(code, PAN) for code in codes)
    kept = [explained([far, other], robot) for other in (order, sign)]
    assert (kept, said(order, sign)) == ([[order], [far]], "ee")
    for other in (replace(sign, joints=(LIFT,)), replace(sign, log="b.csv")):
        assert said(far, other) == "ee"


def test_a_log_too_short_to_judge_by_is_not_judged(three):
    log = log_with(three, 1, "spring", 2, duration=8.0)
    signals = SignalSettings(cutoff=2.0)
    assert misfits(fitted(three, [log], signals=signals)) == ()
    assert len(misfits(fitted(three, [log]))) == 1


def test_real_drives_have_the_terms_that_others_measured_on_them(recordings, monkeypatch):
    monkeypatch.setenv("ROBOTID_DATA", str(recordings))
    said = {}
    for name in ("ur10e", "tx40", "panda_inria"):
        job = read_job(ROOT / "tests" / "jobs" / f"{name}.toml")
        for couplings in (job.couplings, ())[: 2 if name == "tx40" else 1]:
            model = replace(job, couplings=couplings).model()
            logs, kept = (
                [job.read(entry, model) for entry in some]
                for some in (job.identification, job.validation)
            )
            found = fit(model, logs, validation=kept, signals=job.signals, estimator=WLS)
            key = name if couplings == job.couplings else f"{name} uncoupled"
            said[key] = {(m.joint, m.term.code): m for m in misfits(found) if m.matters}
    load = {joint: said["ur10e"][joint, "load_friction"] for joint in (LIFT, ELBOW)}
    for term in load.values():  # mu of six fits of two robots: 0.064 to 0.081
        assert 0.06 < term.size < 0.085
        assert min(term.share, term.confirmed) > 0.6
    assert set(said["tx40"]) == {("joint_2", "friction_shape"), ("joint_3", "load_friction")}
    assert {("joint_5", "coupling"), ("joint_6", "coupling")} < set(said["tx40 uncoupled"])
    assert said["panda_inria"] == {}


def test_a_coupled_drive_turns_by_the_ratio_of_the_other_joint(rng):
    v, turned, a, still = rng.uniform(-1, 1, (4, 50))
    other = JointMotion(still, turned, a, still, still, still, still)
    motion = JointMotion(still, v, still, still, still, still, still, others={"b": other})
    for candidate in couplings_of(motion):
        w = v + candidate.ratio * turned
        usual = np.sqrt(np.mean(w**2))
        expected = np.column_stack([a, turned, np.tanh(w / (0.05 * usual))])
        np.testing.assert_allclose(candidate.columns(motion), expected)
    assert [(c.coupled, c.ratio) for c in couplings_of(motion)] == [("b", 1.0), ("b", -1.0)]


def test_ripples_that_are_tried_explain_most_over_what_the_filter_lets_through(rng):
    n = 2000
    q, v = np.cumsum(rng.standard_normal(n)) * 0.05, rng.standard_normal(n) * 3.0
    still = np.zeros(n)
    motion = JointMotion(q, v, still, still, still, still, still, passes=20.0)
    weight, r = rng.uniform(0.5, 2.0, n) * (rng.random(n) < 0.8), rng.standard_normal(n)
    r += sum(a * np.cos(k * q + k) for a, k in ((0.4, 9), (0.4, 41), (2.0, 230)))
    found = [int(c.name.split()[1]) for c in ripples(motion, weight, weight * r)]
    explained = {}
    for k in range(5, 241):
        size = weight / (1 + (k * np.abs(v) / (2 * np.pi * 20.0)) ** 8)
        explained[k] = np.abs(np.sum(weight * r * size * np.exp(1j * k * q))) ** 2 / (size @ size)
    assert found == sorted(sorted(explained, key=explained.get)[-6:])
    assert {9, 41, 230} < set(found)
