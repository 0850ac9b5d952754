"""Terms that a drive's model lacks are named on their joint, with their share; others are not."""

import tomllib
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import misfits as helper
from helpers.findings import Figures
from helpers.fitting import fit
from helpers.misfits import EFFECTS
from helpers.paths import ROOT

from robotid.base.findings import Finding
from robotid.cli.identify import run_job
from robotid.cli.job import job_from_settings, read_job
from robotid.cli.logs import survey_logs
from robotid.data.files.read import write_log
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.check_logs import check_logs
from robotid.diagnosis.residual import candidates, misfit
from robotid.diagnosis.residual.candidates import CANDIDATES
from robotid.diagnosis.residual.candidates import couplings as couplings_of
from robotid.diagnosis.residual.misfit import find_misfits
from robotid.diagnosis.residual.misfit_findings import (
    counterbalanced,
    misfit_findings,
    setting_of,
    settled,
    with_entries,
    with_known_springs,
)
from robotid.diagnosis.residual.term_trials import RIDGE, Trials, take_sample
from robotid.diagnosis.verdict.fit_findings import fit_findings
from robotid.diagnosis.verdict.verdict import warnings_of
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.simulation.truth import another_robot
from robotid.estimation.fitting.drive_terms import JointMotion
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.fitting.survey import hold_log
from robotid.identification.pipeline import conclude, identify
from robotid.robot.drives import AUTO, Harmonic, Viscous, drive_line
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


def findings_of(found):
    return misfit_findings(found, found.misfits, found.on_misfit)


@pytest.fixture(scope="module")
def three(ur5):
    """The first three joints of a UR5."""
    return RobotModel.from_urdf(ur5.tree, joints=ur5.joints[:3])


@pytest.fixture(scope="module")
def four(ur5):
    """With the first wrist joint."""
    return RobotModel.from_urdf(ur5.tree, joints=ur5.joints[:4])


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
    (finding, *_) = misfit_findings(found, [first], [])
    assert finding.evidence["trend"] == change
    assert finding.evidence["trend_std_error"] == error
    said = f"friction at the RMS speed falls by {-change:.2g} +- {error:.1g} N m per min. It"
    assert said in finding.message
    (other, *_) = misfits(identified(three, 1, "spring", 2))
    assert np.isnan(other.trend).all()
    (finding, *_) = misfit_findings(found, [other], [])
    assert "trend" not in finding.evidence
    assert "per min" not in finding.message


def test_nothing_is_named_where_nothing_is_missing(clean):
    assert misfits(clean) == ()


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


def test_the_size_of_several_columns_is_their_torque(four):
    """A torque that no base parameter explains is seen as it was added, root mean square."""
    log, clean = (log_with(four, 1, effect, 2, noise=0.0) for effect in ("periodic", None))
    added = np.sqrt(np.mean((log.tau - clean.tau)[:, 2] ** 2))
    (found,) = misfits(identified(four, 1, "periodic", 2))
    # gravity explains a part of a slow harmonic
    assert 0.6 * added < found.size < 1.05 * added
    assert (found.unit, found.std_error < 0.05 * added) == ("N m rms", True)


def test_coulomb_friction_that_was_left_out_is_asked_for(three):
    terms = ("armature", "viscous", "offset")
    model = RobotModel.from_urdf(three.tree, joints=three.joints, terms=terms)
    logs = [log_with(three, 1, part=k) for k in (0, 1)]
    found = findings_of(concluded(model, logs))
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


def test_a_setting_keeps_what_the_drive_has_already(three):
    friction = {ELBOW: "load+harmonics1", "*": "none"}
    found = concluded(three, [log_with(three, 1, "load", 2, duration=12.0)], friction)
    stated = Harmonic(order=9.0)
    own = {**found.model.layout.own, ELBOW: (*found.model.layout.own[ELBOW], stated)}
    found = replace(found, model=found.model.with_terms(own))
    line = with_entries(found, ELBOW, ["harmonics2", "stribeck"])
    assert tomllib.loads(line)[ELBOW] == [
        {"term": "Harmonic", "order": 9.0, "is_sine": False}, "load", "harmonics2", "stribeck",
    ]  # fmt: skip
    assert with_entries(found, LIFT, ["load"]) == f'{LIFT} = ["load"]'


@pytest.mark.parametrize("memory", [0, 50])
def test_noise_of_any_colour_is_no_term(three, memory):
    assert misfits(identified(three, 5, noise=0.03, memory=memory)) == ()


def test_a_counterbalance_is_named_taken_into_the_model_and_no_error(four):
    """40 N m at the lift: gravity of the URDF's is held by the other joints."""
    model = four
    logs = [log_with(model, 3, "balancing", 1, part=k) for k in (0, 1)]
    guesses = check_logs(model, logs[:1], validation=logs[1:])
    said = [f for f in guesses if f.severity != "note"]
    assert {(f.code, f.severity) for f in said} == {("counterbalance", "warning")}
    assert said[0].where == f"run0.csv: {LIFT}"
    assert f'Add it to the model: {LIFT} = ["harmonics1"] in [drives]' in said[0].message
    own, kept = ([hold_log(model, log, SignalSettings())] for log in logs)
    recordings = Recordings(model, structural_mapping(model), own, kept)
    found = conclude(recordings, FIT, guesses)
    (choice,) = (c for c in found.drives if c.families)
    assert (choice.joint, choice.families) == (LIFT, ("harmonics1",))
    known = [f for f in found.findings if f.code == "counterbalance"]
    assert {f.severity for f in known} == {"note"}
    assert "The model includes it: cos1, sin1 of shoulder_lift_joint" in known[0].message
    assert found.verdict.status == "good"
    for name, size in (("cos1", 40.0 * np.cos(0.1)), ("sin1", -40.0 * np.sin(0.1))):
        k = found.model.layout.names.index(f"{LIFT}.{name}")
        assert abs(found.standard[k] - size) < 2.6 * found.standard_error[k], name
        assert found.standard_error[k] < 8.0
    friction = {LIFT: "load", "*": "none"}
    stated = conclude(recordings, FIT, guesses, friction=friction)
    (warned, _) = [f for f in stated.findings if f.code == "counterbalance"]
    assert warned.severity == "warning"
    assert stated.verdict.joints[LIFT].status == "usable"


def test_a_mass_that_is_too_large_is_named_beside_a_spring(ur5):
    """The URDF's upper arm has 5 times its mass; the log is of about the right one."""
    k, log = 10 * ur5.layout.bodies.index("upper_arm_link"), log_with(ur5, 3)
    pi, truth = ur5.standard_parameters(), another_robot(ur5, np.random.default_rng(3))
    pi[k : k + 10] *= 5.0
    (found,) = [f for f in check_logs(ur5.with_parameters(pi), log) if f.severity != "note"]
    assert (found.code, found.where) == ("link_mass", f"run0.csv: {LIFT}")
    assert found.evidence["mass"] == pytest.approx(pi[k])
    wanted = np.linalg.norm(truth[k + 1 : k + 4]) / np.linalg.norm(pi[k + 1 : k + 4])
    assert found.evidence["factor"] == pytest.approx(wanted, abs=0.06)
    assert f"the URDF's mass of upper_arm_link, {pi[k]:.3g} kg, is too large" in found.message
    assert counterbalanced([found], ["run0.csv"]) == {LIFT: "harmonics1"}
    terms = (Viscous(), Harmonic(order=1.0))
    fit = SimpleNamespace(
        model=SimpleNamespace(layout=SimpleNamespace(own={LIFT: terms})),
        drives=[SimpleNamespace(joint=LIFT, terms=terms)],
    )
    assert with_known_springs([found], fit, {LIFT: None}) == [found]
    (note,) = with_known_springs([found], fit, {LIFT: ("harmonics1",)})
    assert note.severity == "note"
    assert note.message.endswith(f"torques as well. The model includes it: cos1 of {LIFT}")


def test_a_counterbalance_of_a_validation_log_alone_has_no_part_in_the_model():
    on_joint = [
        Finding("counterbalance", "warning", f"{log}: {joint}", "", {"turned": turned})
        for log, joint, turned in (("a.csv", LIFT, 2.0), ("b.csv", ELBOW, 2.0), ("a.csv", PAN, 0.3))
    ]
    other = Finding("spring", "warning", f"a.csv: {ELBOW}", "", {"turned": 2.0})
    found = counterbalanced([*on_joint, other], ["a.csv"])
    assert found == {LIFT: "harmonics1", PAN: "spring"}


def test_a_coupling_is_named_on_both_joints_with_the_setting_to_copy(three):
    pair = {joint: 1.0 for joint in three.joints[1:]}
    one, other = findings_of(concluded(three, logs_of(three, 4, coupling=tuple(pair.items()))))
    assert [(f.code, f.severity, f.where) for f in (one, other)] == [
        ("coupling", "warning", joint) for joint in pair
    ]
    assert 'Add [[coupling]] to the job: name = "shoulder_lift_joint_elbow_joint"' in one.message
    assert "ratios = { shoulder_lift_joint = 1.0, elbow_joint = 1.0 }" in one.message
    assert one.evidence["share_pct"] > 90


def test_columns_join_the_regressor_and_base_parameters_are_refitted(three):
    sample = take_sample(identified(three, 1, "load", 1, duration=12.0))
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


def test_a_misfit_reaches_the_verdict_unless_the_torque_is_explained_well(three):
    large, small, note = (
        Finding("friction_shape", severity, LIFT, "", {"share_pct": 90, "error_pct": error})
        for severity, error in (("warning", 5.1), ("warning", 4.9), ("note", 20.0))
    )
    (doubt,) = warnings_of([large, small, note], three.joints)
    assert (doubt.code, doubt.joint) == ("friction_shape", LIFT)
    assert doubt.message == (
        "friction of another shape than viscous and Coulomb would explain 90 % of the squared "
        "residual (5.1 % of the torque): the drive model lacks it"
    )


def test_a_hook_of_stribeck_makes_its_joint_usable(ur5, tmp_path):
    paths = [tmp_path / name for name in ("fit.csv", "kept.csv")]
    for k, path in enumerate(paths):
        write_log(log_with(ur5, 1, "stribeck", 2, part=k), path)
    table = {
        "urdf": ur5.tree.path,
        "model": {"friction": "viscous+coulomb"},
        "identification": [{"log": str(paths[0])}],
        "validation": [{"log": str(paths[1])}],
        "output": {"report": False},
    }
    found, result = run_job(job_from_settings(table, "job", tmp_path), tmp_path / "out")
    (named,) = [f for f in result["warnings"] if f["code"] == "friction_shape"]
    assert named["where"] == ELBOW
    assert f"with {ELBOW} = [".lower() in named["message"].lower()
    assert "Add it to the model with" in named["message"]
    assert f"{ELBOW}.coulomb" in named["message"].partition("include this misfit")[0]
    assert set(found.on_misfit) <= {name for name in found.mapping.names if ELBOW in name}
    by_joint = found.verdict.joints
    assert by_joint[ELBOW].status == "usable"
    assert by_joint[ELBOW].reasons[-1].endswith("(friction_shape)")
    assert by_joint[LIFT].status == "good"


def test_a_term_stands_for_what_the_doctor_guessed_of_its_torque(three):
    guesses = [
        Finding("urdf_mismatch", "warning", "run.csv", ""),
        Finding("unexplained_torque", "warning", f"run.csv: {LIFT}", ""),
        Finding("unexplained_torque", "warning", f"run.csv: {PAN}", ""),
        Finding("clipped", "warning", f"run.csv: {LIFT}", ""),
    ]

    def said(code, share):
        term = Finding(code, "note", LIFT, "It is.", {"share_pct": share, "error_pct": 1.0})
        *kept, term = settled(guesses, [term])
        return [guesses.index(f) for f in kept], term

    kept, term = said("spring", 90.0)
    assert kept == [2, 3]
    assert (term.severity, term.evidence["replaces"]) == ("warning", 2.0)
    assert "It explains urdf_mismatch, unexplained_torque and" in term.message
    assert [doubt.joint for doubt in warnings_of([term], three.joints)] == [LIFT]
    assert said("position_offset", 90.0)[0] == [2, 3]
    assert said("load_friction", 90.0)[0] == [0, 2, 3]
    assert said("spring", 40.0) == ([0, 1, 2, 3], Finding(
        "spring", "note", LIFT, "It is.", {"share_pct": 40.0, "error_pct": 1.0}
    ))  # fmt: skip


@pytest.mark.parametrize(
    ("effect", "seed", "size", "guess"),
    [("counterbalance", 5, 3.0, "current_for_torque"), ("periodic", 1, 2.0, "counterbalance")],
)
def test_a_joint_that_follows_its_position_is_no_other_robot(ur5, four, effect, seed, size, guess):
    model = ur5 if guess == "current_for_torque" else four  # guessed of six only
    logs = [log_with(model, seed, effect, 1, part=k, size=size) for k in (0, 1)]
    guesses = check_logs(model, logs[:1], validation=logs[1:])
    assert guess in {finding.code for finding in guesses}
    found = fitted(model, logs, estimator=FIT)
    said = settled(guesses, fit_findings(found, misfits(found)))
    said = {f.code for f in said if f.severity != "note"}
    assert EFFECTS[effect].code in said
    assert not said & {"counterbalance", "urdf_mismatch", "current_for_torque"}
    assert "unexplained_torque" not in said


def test_logs_in_files_are_judged_by_the_stretches_at_hand(three, tmp_path):
    for k, name in enumerate(("fit.csv", "kept.csv")):
        write_log(log_with(three, 1, "load", 1, part=k), tmp_path / name)
    table = {
        "urdf": three.tree.path,
        "joints": list(three.joints),
        "reduction": {"rows_in_memory": 1024},
        "identification": [{"log": "fit.csv"}],
        "validation": [{"log": "kept.csv"}],
    }
    job = job_from_settings(table, "job", tmp_path)
    surveyed = survey_logs(job, three, job.identification, job.validation)
    recordings = Recordings(three, structural_mapping(three), *surveyed)
    assert not recordings.is_in_memory
    (found,) = misfits(conclude(recordings, EstimatorSettings("wls"), friction="none"))
    assert (found.joint, found.term.code) == (LIFT, "load_friction")
    assert found.size == pytest.approx(0.1, abs=0.01)


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


def test_a_misfit_matters_by_its_part_of_the_torque_if_nothing_denies_it():
    (load, tanh) = (c for c in CANDIDATES if c.name in ("load", "tanh"))
    still = np.zeros(3)
    motion = JointMotion(*7 * [still])
    usual = misfit.Misfit(
        LIFT, load, 0.36, 1e-9, 0.2, 0.1, 0.01, "N m per N m", 0.04, still, still, motion
    )
    assert usual.matters  # 2.4 % of the torque
    assert not replace(usual, error=0.03).matters  # 1.8 %
    assert not replace(usual, share=0.24, error=0.9).matters
    assert replace(usual, confirmed=None).matters
    assert not replace(usual, confirmed=0.08).matters  # less than a quarter of the share
    assert not replace(usual, term=tanh).matters


def test_ripples_that_are_tried_explain_most_over_what_the_filter_lets_through(rng):
    n = 2000
    q, v = np.cumsum(rng.standard_normal(n)) * 0.05, rng.standard_normal(n) * 3.0
    still = np.zeros(n)
    motion = JointMotion(q, v, still, still, still, still, still, passes=20.0)
    weight, r = rng.uniform(0.5, 2.0, n) * (rng.random(n) < 0.8), rng.standard_normal(n)
    r += sum(0.4 * np.cos(k * q + k) for k in (9, 41, 230))
    found = [int(c.name.split()[1]) for c in candidates.ripples(motion, weight, weight * r)]
    explained = {}
    for k in range(5, 241):
        size = weight / (1 + (k * np.abs(v) / (2 * np.pi * 20.0)) ** 8)
        explained[k] = np.abs(np.sum(weight * r * size * np.exp(1j * k * q))) ** 2 / (size @ size)
    assert found == sorted(sorted(explained, key=explained.get)[-6:])
    assert {9, 41} < set(found)


def test_entries_keep_other_families_and_a_term_replaces_all_that_it_explains():
    own = (Harmonic(order=3.0), Harmonic(order=8.0))
    drives = [
        SimpleNamespace(joint="a", families=("load",), terms=()),
        SimpleNamespace(joint="b", families=("harmonics1", "load"), terms=own[:1]),
    ]
    layout = SimpleNamespace(own={"b": own})
    fit = SimpleNamespace(drives=drives, model=SimpleNamespace(layout=layout))
    assert with_entries(fit, "b", ["harmonics4"]) == drive_line("b", own[1], "load", "harmonics4")
    assert with_entries(fit, "b", ["spring"]) == (
        drive_line("b", own[1], "harmonics1", "load", "spring")
    )
    assert with_entries(fit, "c", ["spring"]) == drive_line("c", "spring")
    before = [
        Finding("counterbalance", "warning", "run: b", "x", {}),
        Finding("urdf_mismatch", "warning", "run", "x", {}),
        Finding("unexplained_torque", "warning", "run: c", "x", {}),
    ]
    spring = Finding("spring", "note", "b", "a spring", {"share_pct": 51.0})
    small = replace(spring, evidence={"share_pct": 49.0})
    other, (_, found) = settled(before, [small, spring])[:1], settled(before, [small, spring])[1:]
    assert other == before[2:]
    assert (found.severity, found.evidence) == ("warning", {"share_pct": 51.0, "replaces": 2.0})
    assert found.message.endswith(
        "It explains counterbalance, urdf_mismatch and may bias the masses"
    )
    load = Finding("load_friction", "note", "c", "load", {"share_pct": 60.0})
    *rest, last = settled(before, [load])
    assert rest == before[:2]
    assert last.evidence["replaces"] == 1.0


def test_a_misfit_is_reported_with_the_intervals_of_its_own_joint():
    still = np.zeros(3)
    (load,) = (c for c in CANDIDATES if c.name == "load")
    found = misfit.Misfit(
        "b", load, 0.36, 1e-9, -0.2, 0.125, 0.01, "N m per N m", 0.04, still, still,
        JointMotion(*7 * [still]),
    )  # fmt: skip
    fit = SimpleNamespace()
    names = ["a.viscous", "b.coulomb", "bb.offset", "b.viscous"]
    (reported,) = misfit_findings(fit, [found], names)
    assert "; the intervals of b.coulomb, b.viscous include this misfit" in reported.message
    assert (
        "b: " + load.meaning + ": 0.125 +- 0.01 N m per N m. It would explain 36 % of"
        in reported.message
    )
    assert "(0 % on the validation logs); the residual is 4.0 % of the torque" in reported.message
    assert Figures(reported) == pytest.approx({
        "share_pct": 36, "error_pct": 4, "size": 0.125, "std_error": 0.01, "p_value": 1e-9,
        "validation_share_pct": -20,
    })  # fmt: skip
