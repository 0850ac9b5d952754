"""Friction that the drives of a known robot have is chosen, sized and guarded; no other is."""

import pickle
import re
from functools import cache, partial

import numpy as np
import pytest
from helpers import driven as helper
from helpers.driven import (
    ELBOW,
    EXACT,
    JOINTS,
    LIFT,
    WRIST,
    arm,
    driven,
    driven_log,
)

from robotid.base.exceptions import SettingsError
from robotid.cli.job import job_from_settings
from robotid.cli.logs import survey_logs
from robotid.data.files.read import write_log
from robotid.data.signals import process
from robotid.diagnosis.residual.drive_choice import choose_drives
from robotid.diagnosis.verdict.parameter_table import parameter_entries
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.prediction import predict, remember
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.fitted import (
    friction_curve,
)
from robotid.estimation.fitting.recorded import Recordings
from robotid.identification.pipeline import identify, with_drives
from robotid.output.files.urdf import load_identified, write_urdf
from robotid.robot.drive_term import DriveMotion
from robotid.robot.drives import (
    AUTO,
    FAMILIES,
    Harmonic,
    LoadFriction,
    Stribeck,
    Tanh,
    wanted_families,
)

found_in, fitted_in = (partial(f, estimator="wls") for f in (helper.found_in, helper.fitted_in))
SEED, QUANTILE = 3, 1.5  # of the motion: the elbow turns more than half a turn
SURE = 2.6  # standard errors, of a few hundred figures that are looked at
SEEN = {"q": (-1.58, 1.80), "v": (0.03, 1.53)}  # of the elbow in this motion
# Shapes, parameters, and what else the elbow has: sizes of some 2 N m beside 7 N m of torque.
CASES = {
    "load": ((), (0.07,)),
    "stribeck": ((0.1,), (3.0,)),
    "tanh": ((0.2,), (4.0,)),
    "presliding": ((0.02,), (4.0,)),
    "lag": ((), (0.01,)),
    "harmonics1": ((), (2.0, 1.5)),
    "harmonics2": ((), (0.0, 0.0, 2.0, 1.5)),
    "harmonics4": ((), (0.0, 0.0, 2.0, 1.5, 1.0, -1.0, 0.5, -1.5)),
    "asymmetric": ((), (1.5,)),
    "power": ((0.35,), (3.0,)),
    "cubic": ((), (1.0,)),
    "curve": ((), (2.0, 1.5, 1.0, 0.5)),
    "lugre": ((0.02, 0.15, 0.8), (3.0,)),
    "position": ((), (1.0, 0.7)),
    "spring": ((), (4.0,)),
    "spring_table": ((), (2.0, 1.0, -1.0, -2.0, 1.0, 2.0, 3.0, 1.0)),
}
ALIKE = {"tanh": {"tanh", "stribeck"}, "stribeck": {"tanh", "stribeck"}}


@pytest.fixture(scope="module")
def plain():
    return arm()


@pytest.fixture(scope="module")
def cases(plain):
    """Each family on the elbow: the robot, its parameters and its log, made when asked for."""
    made = {}

    def case(name):
        if name not in made:
            sizes, values = CASES[name]
            terms = FAMILIES[name].make(SEEN, *sizes)
            own = {f"{ELBOW}.{t.name}": x for t, x in zip(terms, values, strict=True)}
            true, pi = driven(plain, {ELBOW: terms}, own)
            made[name] = (true, pi, driven_log(true, pi, SEED, reach=QUANTILE))
        return made[name]

    return case


@pytest.fixture(scope="module")
def chosen_in(plain, cases):
    """The fit of each case with the friction that it shows."""
    return cache(lambda name: fitted_in(plain, [cases(name)[2]], friction=AUTO))


def chosen(found):
    return {choice.joint: choice.families for choice in found.drives if choice.families}


def friction(true, pi, v, load):
    """Return the elbow's friction and offset while it moves steadily."""
    still = np.zeros_like(v)
    x = DriveMotion(still, v, still, np.sign(v), load + still, still)
    d = JOINTS.index(ELBOW)
    own = enumerate(true.layout.drive_parameters, start=true.layout.n_inertial)
    return sum(pi[k] * t.column(x) for k, (at, t) in own if at == d and not t.is_inertia)


@pytest.mark.parametrize("name", CASES)
def test_a_family_that_is_stated_is_found_within_its_intervals(plain, cases, name):
    true, pi, log = cases(name)
    # least squares alone does not tell the parts of a curve from viscous friction
    estimator = helper.FIT if name == "curve" else "wls"
    # errors of shapes widen intervals when all is concluded
    finds = found_in if CASES[name][0] else fitted_in
    found = finds(plain, [log], friction={ELBOW: name, "*": "none"}, estimator=estimator)
    (choice,) = found.drives
    assert (choice.joint, choice.families) == (ELBOW, (name,))
    for shape, size in zip(choice.shapes, CASES[name][0], strict=True):
        assert abs(shape.value - size) < SURE * shape.std_error, shape
        assert shape.std_error < 0.2 * size
        assert not shape.is_at_bound
    names = list(found.model.layout.names)
    assert names == list(true.layout.names)
    for k, label in enumerate(names):
        if label.startswith(ELBOW):
            miss, std_error = abs(found.standard[k] - pi[k]), found.standard_error[k]
            assert miss < SURE * std_error, (label, found.standard[k], pi[k], std_error)
    v = np.linspace(*SEEN["v"], 12)
    for load in (0.0, 10.0):
        own = friction_curve(found, ELBOW, np.append(-v, v), load=load)
        wanted = friction(true, pi, own.v, load)
        assert (np.abs(own.torque - wanted) < SURE * own.std + 1e-9).all()
        if not name.startswith("harmonics"):  # gravity has a part of these
            assert own.std.max() < 0.5  # [N m], of 7


@pytest.mark.parametrize("name", [name for name in CASES if FAMILIES[name].is_automatic])
def test_the_family_is_chosen_on_its_joint_and_nothing_on_others(chosen_in, name):
    found = chosen_in(name)
    assert set(chosen(found)) == {ELBOW}
    (family,) = chosen(found)[ELBOW]
    assert family in ALIKE.get(name, {name})
    (choice,) = (choice for choice in found.drives if choice.families)
    taken = [x for x in choice.tried if x.is_selected]
    assert [x.families for x in taken] == [(), (family,)]
    assert choice.families == (family,)
    plain_error, error = (x.held_out_error_pct for x in taken)
    assert error < 0.7 * plain_error
    assert taken[1].p_value < 0.015
    # noise is 1 % of the torque; shapes of the grid leave more than those of the fit
    assert error == pytest.approx(1.0, abs=0.5)
    assert found.metrics().per_joint[ELBOW].relative_error_pct == pytest.approx(1.0, rel=0.15)


def test_a_shape_between_the_sizes_of_the_grid_needs_no_second_family(plain):
    low, high = FAMILIES["stribeck"].shapes[0].within(SEEN)
    speed = low * (high / low) ** (3.5 / 5)  # of 6 sizes
    terms = [Stribeck(speed=speed)]
    true, pi = driven(plain, {ELBOW: terms}, {f"{ELBOW}.stribeck": 6.0})
    found = fitted_in(plain, [driven_log(true, pi, SEED, reach=QUANTILE)], estimator="wls")
    assert chosen(found) == {ELBOW: ("stribeck",)}


def test_a_robot_of_viscous_and_coulomb_friction_gets_no_more(plain):
    true, pi = driven(plain, {}, {})
    for seed in range(2):
        found = fitted_in(plain, [driven_log(true, pi, seed, reach=QUANTILE, noise=0.02)])
        assert [c.joint for c in found.drives] == list(JOINTS)
        assert chosen(found) == {}
        assert found.model.layout == plain.layout


@pytest.fixture(scope="module")
def rising(plain):
    """Friction that sets in over most of the speeds: a hook of Stribeck's fits nearly as well."""
    terms = [Tanh(speed=0.6 * SEEN["v"][1])]
    true, pi = driven(plain, {ELBOW: terms}, {f"{ELBOW}.tanh": 14.0})
    return helper.found_in(plain, [driven_log(true, pi, SEED, reach=QUANTILE, noise=0.03)])


def test_of_families_alike_the_better_conditioned_is_chosen(plain, rising):
    assert chosen(rising) == {ELBOW: ("tanh",)}
    (choice,) = (c for c in rising.drives if c.families)
    last = {x.families[-1]: x for x in choice.tried if len(x.families) == 1}
    assert last["tanh"].is_selected
    assert not last["stribeck"].is_selected
    # within 2 % of the squared residual
    first = choice.tried[0].held_out_error_pct
    shares = [(last[name].held_out_error_pct / first) ** 2 for name in ("tanh", "stribeck")]
    assert abs(shares[0] - shares[1]) < 0.02
    assert last["stribeck"].p_value < 0.015
    assert not any(shape.is_at_bound for shape in choice.shapes)
    stated = helper.found_in(plain, rising_logs(rising), friction={ELBOW: "stribeck", "*": "none"})
    (other,) = (c for c in stated.drives if c.families)
    assert other.shapes[0].is_at_bound
    assert other.grown[f"{ELBOW}.coulomb"] > 10.0 > choice.grown[f"{ELBOW}.coulomb"]
    (said,) = [f for f in stated.findings if f.code == "correlated_terms"]
    assert (said.severity, said.where) == ("note", ELBOW)
    assert re.match(
        r"elbow_joint: coulomb \S+ \+- \S+, stribeck \S+ \+- \S+ are strongly correlated "
        r"\(r = -0\.9\d+\): use their sum; friction and offset are \S+ \+- \S+ at \S+ and ",
        said.message,
    )
    names, C = stated.model.layout.names, stated.standard_covariance
    i, k = (names.index(f"{ELBOW}.{term}") for term in ("coulomb", "stribeck"))
    assert said.evidence["r"] == pytest.approx(C[i, k] / np.sqrt(C[i, i] * C[k, k]))
    _, drives = parameter_entries(stated)
    partner = {entry["name"]: entry.get("correlated_with") for entry in drives}
    assert partner[f"{ELBOW}.coulomb"] == f"{ELBOW}.stribeck"
    assert partner[f"{ELBOW}.stribeck"] == f"{ELBOW}.coulomb"
    assert partner[f"{LIFT}.coulomb"] is None


def rising_logs(found):
    return [evaluation.recording.log for evaluation in found.fitted]


def test_a_counterbalance_that_is_known_is_in_the_model_before_others_are_tried(plain, cases):
    log = cases("load")[2]
    fit = fitted_in(plain, [log], friction="none")
    first = {ELBOW: "harmonics1"}
    wanted = dict.fromkeys(JOINTS)
    choices = {c.joint: c for c in choose_drives(fit, wanted, first)}
    assert choices[ELBOW].families == ("harmonics1", "load")
    assert choices[ELBOW].tried[0].families == ("harmonics1",)
    assert choices[ELBOW].tried[0].is_selected
    assert choices[LIFT].families == ()
    # what explains far more of the same kind replaces it
    fit = fitted_in(plain, [cases("harmonics4")[2]], friction="none")
    choices = {c.joint: c for c in choose_drives(fit, wanted, first)}
    assert choices[ELBOW].families == ("harmonics4",)
    assert [x.families for x in choices[ELBOW].tried if x.is_selected] == [
        ("harmonics1",), ("harmonics4",)
    ]  # fmt: skip
    fixed = choose_drives(fit, {**wanted, ELBOW: ("load",)}, first)
    assert {c.joint: c.families for c in fixed}[ELBOW] == ("load",)


def test_harmonics_are_for_joints_that_turn_far_enough(plain):
    waves = [Harmonic(order=2.0), Harmonic(order=2.0, is_sine=True)]
    true, pi = driven(plain, {ELBOW: waves}, {f"{ELBOW}.cos2": 2.0, f"{ELBOW}.sin2": 1.5})
    log = driven_log(true, pi, SEED, reach=1.0)  # 2.4 rad
    found = fitted_in(plain, [log])
    names = {family for families in chosen(found).values() for family in families}
    assert not names & {"harmonics2", "harmonics4"}
    assert not any("harmonics" in f for c in found.drives for x in c.tried for f in x.families)
    with pytest.raises(SettingsError, match=r"elbow_joint has harmonics4, .* half a revolution"):
        fitted_in(plain, [log], friction={ELBOW: "harmonics4"})


def test_a_shape_beyond_its_bounds_is_named(plain):
    sizes = FAMILIES["tanh"].shapes[0].within(SEEN)
    (term,) = FAMILIES["tanh"].make(SEEN, 1.8 * sizes[1])
    true, pi = driven(plain, {ELBOW: [term]}, {f"{ELBOW}.tanh": 12.0})
    log = driven_log(true, pi, SEED, reach=QUANTILE)
    found = found_in(plain, [log], friction={ELBOW: "tanh", "*": "none"})
    ((shape,),) = (choice.shapes for choice in found.drives)
    assert shape.is_at_bound
    assert shape.value == pytest.approx(sizes[1], rel=0.02)
    (said,) = [f for f in found.findings if f.code == "shape_at_bound"]
    assert said.where == ELBOW
    assert f"elbow_joint: tanh.speed is {shape.value:.3g} rad/s, the bound" in said.message


def test_validation_beyond_what_was_seen_is_named_and_has_no_say(plain, cases, chosen_in):
    true, pi, log = cases("stribeck")
    alone = chosen_in("stribeck")
    fast = driven_log(true, pi, 8, reach=QUANTILE, speed=1.8)
    found = found_in(plain, [log], validation=[fast])
    assert chosen(found) == chosen(alone) == {ELBOW: ("stribeck",)}
    assert [c.tried for c in found.drives] == [c.tried for c in alone.drives]
    np.testing.assert_array_equal(found.standard, alone.standard)
    assert [c.shapes for c in found.drives] == [c.shapes for c in alone.drives]
    (said,) = [f for f in found.findings if f.code == "beyond_range"]
    top = max(abs(log.v[:, 1]))
    share = 100 * np.mean(np.abs(fast.v[:, 1])[np.abs(fast.v[:, 1]) > 0.02] > top)
    assert said.where == ELBOW
    assert said.evidence["share_pct"] == pytest.approx(share, abs=1.0)
    assert f"have speeds outside the fitted range of 0 to {top:.3g}" in said.message
    slow = driven_log(true, pi, SEED, reach=QUANTILE, speed=0.7)
    again = found_in(plain, [log], validation=[slow])
    assert not any(f.code == "beyond_range" for f in again.findings)


def test_a_joint_that_moves_in_one_of_several_logs_is_judged_by_that(plain, cases):
    true, pi, _ = cases("stribeck")
    logs = [driven_log(true, pi, seed, reach=QUANTILE, still=still)
            for seed, still in ((4, (1,)), (SEED, (0,)), (5, (1,)))]  # fmt: skip
    found = helper.found_in(plain, logs)
    assert chosen(found) == {ELBOW: ("stribeck",)}
    k = list(found.model.layout.names).index(f"{ELBOW}.stribeck")
    assert abs(found.standard[k] - 3.0) < 3.0 * found.standard_error[k]
    assert found.standard_error[k] < 0.3
    still = [driven_log(true, pi, seed, reach=QUANTILE, still=(1,)) for seed in (4, 5)]
    found = helper.fitted_in(plain, still)
    assert ELBOW not in {choice.joint for choice in found.drives}
    assert chosen(found) == {}


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ("viscous+stribek", "friction of shoulder_lift_joint has stribek, wanted auto, or some of"),
        ({ELBOW: "load+x"}, "friction of elbow_joint has x, wanted auto, or some of load, "),
        ({"elbow": "load"}, "friction is stated for elbow, wanted joints that are identified: "),
    ],
)
def test_names_that_are_none_are_refused(stated, message):
    with pytest.raises(SettingsError, match=message):
        wanted_families(stated, JOINTS)


def test_friction_is_stated_for_all_joints_or_for_some():
    assert wanted_families(AUTO, JOINTS) == dict.fromkeys(JOINTS)
    assert wanted_families("viscous+coulomb", JOINTS) == dict.fromkeys(JOINTS, ())
    assert wanted_families("coulomb+load+lag", JOINTS)[LIFT] == ("load", "lag")
    stated = wanted_families({ELBOW: "none", "*": "cubic", WRIST: AUTO}, JOINTS)
    assert stated == {LIFT: ("cubic",), ELBOW: (), WRIST: None}
    assert wanted_families({ELBOW: "load"}, JOINTS) == {LIFT: None, ELBOW: ("load",), WRIST: None}


@pytest.mark.parametrize("estimator", ["wls", "consistent"])
def test_the_load_of_the_gears_is_that_of_the_bodies_found(plain, estimator, tmp_path):
    true, pi = driven(plain, {ELBOW: [LoadFriction()]}, {f"{ELBOW}.load": 0.35})
    log = driven_log(true, pi, SEED, reach=QUANTILE)
    found = fitted_in(plain, [log], friction={"*": "load"}, estimator=estimator)
    np.testing.assert_array_equal(found.model.reference, found.standard)
    motion = process(log, EXACT)
    wanted = predict(found.model, [found.standard], remember(found.model, motion))[0]
    np.testing.assert_allclose(found.fitted[0].torques["estimate"], wanted, atol=1e-9)
    if estimator == "consistent":
        sidecar = write_urdf(found.model, found.standard, tmp_path / "arm.urdf")
        model, pi = load_identified(tmp_path / "arm.urdf", sidecar)
        again = predict(model, [pi], remember(model, motion))[0]
        np.testing.assert_allclose(again, wanted, atol=1e-8)
    # one more fit under that load leaves it as it is
    start = found.model.with_reference(found.standard)
    again = fitted_in(start, [log], friction="none", estimator=estimator)
    moved = predict(again.model, [again.standard], remember(again.model, motion))[0] - wanted
    assert np.abs(moved).max() < 0.003 * np.abs(wanted).max()


@pytest.mark.parametrize("workers", [1, 2])
def test_logs_in_files_choose_as_in_memory(plain, cases, chosen_in, tmp_path, workers):
    """Two workers are sent the robot with its own terms."""
    held = chosen_in("presliding")
    write_log(cases("presliding")[2], tmp_path / "fit.parquet")
    table = {
        "urdf": plain.tree.path,
        "joints": list(JOINTS),
        "signals": {"cutoff": False, "trim": 0.0},
        "reduction": {"rows_in_memory": 1024, "workers": workers},
        "identification": [{"log": "fit.parquet"}],
    }
    job = job_from_settings(table, "job", tmp_path)
    fitted, kept = survey_logs(job, plain, job.identification, job.validation)
    recordings = Recordings(plain, structural_mapping(plain), fitted, kept)
    assert not recordings.is_in_memory
    found = with_drives(recordings, EstimatorSettings("wls"), wanted_families(AUTO, JOINTS))
    assert chosen(found) == chosen(held) == {ELBOW: ("presliding",)}
    ((shape,), (alike,)) = ([s for c in x.drives for s in c.shapes] for x in (found, held))
    # other rows of the log are looked at
    assert abs(shape.value - alike.value) < 3.0 * np.hypot(alike.std_error, shape.std_error)


def test_a_robot_with_terms_of_its_own_can_be_sent_to_workers():
    own = {ELBOW: [LoadFriction(), Stribeck(speed=0.2, data_range=(0.1, 1.0))]}
    true, pi = driven(arm(), own, {})
    log = driven_log(true, pi, 1, duration=3.0)
    sent = pickle.loads(pickle.dumps(true))
    assert sent.layout == true.layout
    motion = process(log, EXACT)
    wanted, again = (predict(m, [pi], remember(m, motion))[0] for m in (true, sent))
    np.testing.assert_array_equal(again, wanted)


@pytest.mark.parametrize("load", [-0.05, 0.7])
def test_friction_that_would_be_negative_or_hold_any_load_is_none(plain, load):
    true, pi = driven(plain, {ELBOW: [LoadFriction()]}, {f"{ELBOW}.load": load})
    found = fitted_in(plain, [driven_log(true, pi, SEED, reach=QUANTILE)])
    assert "load" not in chosen(found).get(ELBOW, ())
    assert ("load",) not in {x.families for x in found.drives[1].tried}


def test_what_is_nearly_chosen_widens_the_intervals_it_would_move(plain):
    """Load friction lost in the noise of one joint: its Coulomb friction takes a part of it."""
    true, pi = driven(plain, {ELBOW: [LoadFriction()]}, {f"{ELBOW}.load": 0.03})
    k = list(plain.layout.names).index(f"{ELBOW}.coulomb")
    coulomb = pi[list(true.layout.names).index(f"{ELBOW}.coulomb")]
    seen = 0
    for seed in range(3):
        log = driven_log(true, pi, seed, reach=QUANTILE, noise=0.06)
        found = found_in(plain, [log], estimator="wls")
        (choice,) = (c for c in found.drives if c.joint == ELBOW)
        assert all(x.p_value < 0.015 for x in choice.tried if x.is_selected and x.families)
        if choice.families or [t.name for t in choice.undecided] != ["load"]:
            continue
        seen += 1
        alone = found_in(plain, [log], friction="none", estimator="wls")
        assert found.standard[k] == alone.standard[k]
        assert found.standard_error[k] > alone.standard_error[k]
        assert abs(found.standard[k] - coulomb) < SURE * found.standard_error[k]
    assert seen


def test_identify_chooses_unless_told_otherwise(plain, cases):
    log = cases("load")[2]
    assert chosen(identify(plain, [log], signals=EXACT, doctor=False)) == {ELBOW: ("load",)}
    assert fitted_in(plain, [log], friction="viscous+coulomb").drives == ()
