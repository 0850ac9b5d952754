"""Friction that the drives of a known robot have is chosen, sized and guarded; no other is."""

import pickle
import re
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

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

from robotid.base.exceptions import NotConvergedError, SettingsError
from robotid.cli.job import job_from_settings
from robotid.cli.logs import survey_logs
from robotid.data.files.read import write_log
from robotid.data.signals import process
from robotid.diagnosis.residual import drive_choice
from robotid.diagnosis.residual.drive_choice import choose_drives
from robotid.diagnosis.residual.term_trials import Normal, Sample, Trials, take_sample
from robotid.diagnosis.verdict.parameter_table import parameter_entries
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.prediction import drive_motion_along, predict, remember
from robotid.estimation.fitting.drive_terms import DriveChoice
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.fitted import friction_curve
from robotid.estimation.fitting.recorded import Recordings
from robotid.identification.pipeline import identify, with_drives
from robotid.output.files.urdf import load_identified, write_urdf
from robotid.robot.drives import (
    AUTO,
    FAMILIES,
    DriveMotion,
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


def test_a_standard_error_grows_as_that_of_least_squares_does(plain, cases):
    """Beside the columns of a term, and of its shape's derivative."""
    found = fitted_in(plain, [cases("stribeck")[2]], friction="none")
    sample = take_sample(found, for_drives=True)
    j, speed = sample.joints.index(ELBOW), 0.1
    own = [drive_motion_along(found.model, found.fitted[0].recording.trajectory).of(j)]
    plain_parts = {
        name: sample.U[:, k]
        for k, name in enumerate(found.mapping.base_names)
        if name.startswith(ELBOW)
    }
    drive = drive_choice._Drive(False, True, tuple(own), sample.taken, SEEN, 1.0, plain_parts)
    alone = sample.of_joint(j)
    family = FAMILIES["stribeck"]
    grown = drive_choice._grown(alone, drive, [(family, [speed])])
    Z = [drive.columns([Stribeck(speed=speed * x, data_range=SEEN["v"])]) for x in (1.0, 1.001)]
    theta = 3.0  # about: it scales the derivative's column only
    b = sample.W.shape[-1]
    columns = np.zeros((*sample.r.shape, 2))
    columns[:, j] = sample.weight[:, [j]] * np.hstack([Z[0], theta * (Z[1] - Z[0])])
    W = sample.W.reshape(-1, b)
    X = np.hstack([W, columns.reshape(-1, 2)])
    before = np.linalg.inv(W.T @ W + np.eye(b))
    prior = np.diag(np.append(np.ones(b), np.zeros(2)))
    after = np.linalg.inv(X.T @ X + prior)[:b, :b]
    assert set(grown) == set(plain_parts)
    for name, u in plain_parts.items():
        wanted = np.sqrt((u @ after @ u) / (u @ before @ u))
        assert grown[name] == pytest.approx(wanted, rel=0.02), name
    assert grown[f"{ELBOW}.coulomb"] > 1.5
    # a shape has the error of its derivative's column beside that of the term
    for slides, unit in ((False, "rad/s"), (True, "m/s")):
        sliding = replace(drive, is_prismatic=slides)
        choice = drive_choice._found(alone, sliding, [(family, [speed])], ())
        (shape,) = choice.shapes
        assert (shape.name, shape.unit) == ("stribeck.speed", unit)
    anew = drive_choice._reweighted(alone, drive, [(family, [shape.value])])
    Z = np.hstack(
        [
            drive.columns([Stribeck(speed=shape.value + x, data_range=SEEN["v"])])
            for x in (0.0, 1e-6)
        ]
    )
    Z[:, 1] -= Z[:, 0]
    size = drive_choice.Trials(anew, Z[:, None, :1], 1e-10).whole.parameters([0])[0]
    Z[:, 1] *= size / 1e-6
    C = drive_choice.Trials(anew, Z[:, None], 1e-10).whole.estimate([0, 1], anew.fitted)[1]
    assert shape.std_error == pytest.approx(np.sqrt(C[1, 1]), rel=0.01)
    assert choice.shape_covariance == ((pytest.approx(shape.std_error**2),),)
    # rows that are weighed by what terms leave keep their residual's share of the torque
    anew = drive_choice._reweighted(alone, drive, [(family, [speed])])
    factor = anew.r[:, 0] @ alone.r[:, 0] / np.sum(alone.r[:, 0] ** 2)
    assert factor > 1.5
    np.testing.assert_allclose(anew.weight, factor * alone.weight)
    np.testing.assert_allclose(anew.W, factor * alone.W)
    assert anew.torque == pytest.approx(factor**2 * alone.torque)
    weighed = np.where(np.arange(len(sample.joints)) == j, factor, 1.0)
    W, r = sample.W * weighed[:, None], sample.r * weighed
    wanted = Normal.of(W, r, sample.segments, sample.fitted)
    np.testing.assert_allclose(anew.normal.A, wanted.A, atol=1e-9 * np.abs(wanted.A).max())
    np.testing.assert_allclose(anew.normal.B, wanted.B, atol=1e-9 * np.abs(wanted.B).max())


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


def test_segments_are_alike_within_a_slack_or_their_scatter():
    best, other = np.array([1.0, 2.0, 3.0]), np.array([1.5, 2.0, 2.8])
    more = np.sqrt(3) * np.std(other - best, ddof=1)
    assert more > 0.3  # the sum of the differences
    assert drive_choice._is_alike(best, other, 0.0)
    assert not drive_choice._is_alike(best, best + 0.1, 0.29)
    assert drive_choice._is_alike(best, best + 0.1, 0.31)
    # the scatter of the sum of nine differences is three times that of one
    swing = np.array([1.0, -1.0, 1.0, -1.0, 0.0, 1.0, -1.0, 1.0, -1.0])
    best = np.arange(9.0)
    assert drive_choice._is_alike(best, best + swing + 0.3, 0.0)  # 2.7 of 3
    assert not drive_choice._is_alike(best, best + swing + 0.4, 0.0)


@pytest.mark.parametrize(
    ("faults", "more", "wanted"),
    [
        ([(0, 10.0), (1, 1.0), (0, 1.0)], 0.0, 0),  # the best has no fault
        ([(0, 10.1), (0, 11.0), (0, 1.0)], 0.0, 2),
        ([(0, 10.1), (0, 11.0), (0, 11.0)], 0.0, 0),  # no better, though simpler
        ([(0, 10.1), (1, 1.0), (1, 1.0)], 0.0, 0),
        ([(1, 1.0), (0, 11.0), (1, 11.0)], 0.0, 1),
        ([(0, 10.1), (0, 1.0), (0, 1.0)], 0.0, 1),  # the simplest
        ([(0, 10.1), (0, 11.0), (0, 1.0)], 0.019, 2),
        ([(0, 10.1), (0, 11.0), (0, 1.0)], 0.021, 0),  # of the squared residual
    ],
)
def test_an_equal_family_is_taken_for_its_faults_only(monkeypatch, faults, more, wanted):
    """Candidates 0, 1 and 2 have two, one and one column; another of the best's family is none."""
    families = [FAMILIES[name] for name in ("stribeck", "tanh", "power", "stribeck")]
    faults = [*faults, (0, 1.0)]
    own = [(family, [float(k)]) for k, family in enumerate(families)]
    after = np.full(10, 5.0)
    left = {0: after, 1: after + 10 * more, 2: after + 10 * more, 3: after - 0.01}

    class Options(SimpleNamespace):
        @classmethod
        def of(cls, sample, drive, own):
            return SimpleNamespace(left=lambda which: left[int(own[-1][1][0])])

    every = Options(own=own, place=[[0, 1], [2], [3], [4]])
    this = drive_choice.Round(np.full(10, 10.0), left, 10, 100.0)

    def place(own):
        return int(own[-1][1][0])

    for name, function in {
        "_Options": Options,
        "_refined": lambda sample, drive, own: own,
        "_reweighted": lambda sample, drive, own: sample,
        "_grown": lambda sample, drive, own: {"coulomb": 1.0, "viscous": faults[place(own)][1]},
        "_at_bound": lambda drive, own: np.array([False, faults[place(own)][0]]),
    }.items():
        monkeypatch.setattr(drive_choice, name, function)
    found = drive_choice._conditioned(None, None, every, this, {k: [] for k in range(4)}, 0)
    assert found.number == wanted
    assert found.own == [own[wanted]]


@pytest.mark.parametrize(
    ("share", "p", "torque", "families", "undecided"),
    [
        (0.051, 0.0099, 1e4, ("tanh",), 0),
        (0.049, 0.0099, 1e4, (), 1),
        (0.051, 0.0101, 1e4, (), 1),
        (0.051, 0.249, 1e4, (), 1),
        (0.051, 0.251, 1e4, (), 0),
        (0.1, 0.0099, 0.99 * 1.0 / 0.006**2, ("tanh",), 0),
        (0.1, 0.0099, 1.01 * 1.0 / 0.006**2, (), 1),  # the gain is 1.0
    ],
)
def test_a_family_is_selected_by_share_p_value_and_gain(
    monkeypatch, share, p, torque, families, undecided
):
    one = (FAMILIES["tanh"], [0.2])
    drive = SimpleNamespace(data_range=SEEN)
    sample = SimpleNamespace(torque=np.array([torque]))

    class Options(SimpleNamespace):
        @classmethod
        def of(cls, sample, drive, own):
            before = np.ones(10)
            return cls(
                own=own, place=[[k] for k in range(len(own))], left=lambda chosen: before,
                left_each=lambda retained: {i: before * (1 - share) for i in retained},
            )  # fmt: skip

    given = []

    def found(sample, drive, own, tried):
        given.append((own, tried))
        return DriveChoice("a", tuple(family.name for family, _ in own), ())

    for name, function in {
        "_Options": Options,
        "_candidates": lambda drive, families: [one] if len(families) > 1 else [],
        "_reweighted": lambda sample, drive, own: sample,
        "_conditioned": lambda sample, drive, every, this, retained, best: drive_choice._Refined(
            best, [every.own[best]], sample, (False, False)
        ),
        "_found": found,
    }.items():
        monkeypatch.setattr(drive_choice, name, function)
    monkeypatch.setattr(drive_choice.Round, "p_value", lambda self, option: p)
    choice = drive_choice._auto(sample, drive)
    assert choice.families == families
    assert len(choice.undecided) == undecided
    ((_, tried),) = given
    assert tried[0] == drive_choice.Tried((), 100 * np.sqrt(10 / torque), 1.0, True)
    after = 100 * np.sqrt(10 * (1 - share) / torque)
    assert tried[1] == drive_choice.Tried(("tanh",), pytest.approx(after), p, bool(families))


@pytest.mark.parametrize(
    ("at", "is_near"), [(0.0, True), (0.019, True), (0.021, False), (0.979, False), (0.981, True)]
)
def test_a_shape_is_at_a_bound_within_a_fiftieth_of_its_range(at, is_near):
    drive = SimpleNamespace(data_range=SEEN)
    low, high = FAMILIES["tanh"].shapes[0].within(SEEN)
    middle = float(np.sqrt(low * high))
    own = [(FAMILIES["tanh"], [low * (high / low) ** at]), (FAMILIES["tanh"], [middle])]
    assert drive_choice._at_bound(drive, own).tolist() == [is_near, False]


def test_what_was_seen_is_of_the_rows_that_count_in_all_recordings():
    q = [np.array([9.0, 0.5, -1.5, 7.0]), np.array([0.8, -8.0, 1.25])]
    v = [np.array([5.0, -0.25, 1.0, 0.0]), np.array([-2.0, 9.0, 0.5])]
    motions = [SimpleNamespace(q=own, v=speed) for own, speed in zip(q, v, strict=True)]
    taken = [np.array([1, 2, 3]), np.array([0, 1, 2])]
    used = np.array([True, True, False, True, False, True])
    assert drive_choice._range_of(motions, taken, used) == {"q": (-1.5, 1.25), "v": (0.25, 2.0)}


def test_a_grid_of_a_wide_range_has_its_end_too():
    np.testing.assert_allclose(drive_choice._sizes(0.01, 1.0), np.geomspace(0.01, 1.0, 6))
    wide = drive_choice._sizes(0.01, 2.0)
    np.testing.assert_allclose(wide, [*np.geomspace(0.01, 1.0, 6), 2.0])


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


def test_a_load_that_does_not_settle_is_refused(plain, cases, monkeypatch):
    monkeypatch.setattr("robotid.estimation.fitting.fit._SETTLED", -1.0)
    monkeypatch.setattr("robotid.estimation.fitting.fit._MOST_LOADS", 3)
    with pytest.raises(NotConvergedError, match="joint load torque has not converged after 3 fits"):
        fitted_in(plain, [cases("load")[2]], friction={ELBOW: "load"}, estimator="wls")


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


def test_derivatives_of_terms_by_each_shape_follow_their_columns(rng):
    """Of Stribeck and tanh, whose shapes differ, in a sample of one joint."""
    n = 60
    v, still, weight = 0.8 * rng.standard_normal(n), np.zeros(n), rng.uniform(0.5, 2.0, (n, 1))
    motion = DriveMotion(still, v, still, np.sign(v), still, still)
    ranges = {"v": (0.02, 2.0), "q": (-1.0, 1.0)}
    W = weight[:, :, None] * rng.standard_normal((n, 1, 2))
    families, sizes = [FAMILIES["stribeck"], FAMILIES["tanh"]], np.array([0.1, 0.6])

    def columns(at):
        return np.column_stack(
            [term.column(motion) for family, x in zip(families, at, strict=True)
             for term in family.make(ranges, x)]
        )  # fmt: skip

    Z = columns(sizes)
    r = weight * (Z @ [[3.0], [-2.0]] + 0.1 * rng.standard_normal((n, 1)))
    segments = tuple(slice(k, k + 10) for k in range(0, n, 10))
    sample = Sample(
        joints=("a",), is_prismatic=np.array([False]), motions=(), recordings=(), at=(), taken=(),
        weight=weight, torque=np.ones(1), segments=segments, rows=n, W=W, r=r,
        independent=np.arange(2), U=np.eye(2), normal=Normal.of(W, r, segments, 6),
        standard=np.zeros(0),
    )  # fmt: skip
    drive = drive_choice._Drive(False, True, (motion,), (np.arange(n),), ranges, 9.0, {})
    count, trial = drive_choice._with_slopes(sample, drive, families, sizes)
    assert count == 2
    X = np.concatenate([x for _, x in trial.rows])
    np.testing.assert_allclose(X[:, :2], weight * Z)
    theta = Trials(sample, Z[:, None], 1e-10).whole.parameters([0, 1])
    for k in (0, 1):
        h = 1e-6 * sizes * (np.arange(2) == k)
        slope = (columns(sizes + h) - columns(sizes - h)) @ theta / (2 * h[k])
        np.testing.assert_allclose(X[:, 2 + k], weight[:, 0] * slope, rtol=0.01, atol=5e-3)
    assert (np.abs(X[:, 2:4]).max(axis=0) > 0.5).all()


def test_shapes_are_at_a_bound_at_either_end_of_their_own_range(monkeypatch):
    bounds = np.log([[0.01, 1.0], [0.1, 10.0], [1.0, 2.0], [0.5, 5.0]])
    monkeypatch.setattr(drive_choice, "_log_bounds", lambda drive, families: bounds)
    span = np.log(100.0)
    sizes = [0.01 * np.exp(0.019 * span), 10.0 * np.exp(-0.021 * span)]
    others = [2.0 * np.exp(-0.019 * np.log(2.0)), 5.0 * np.exp(-0.019 * np.log(10.0))]
    found = drive_choice._at_bound(None, [("a", sizes), ("b", others)])
    assert found.tolist() == [True, False, True, True]


def test_a_candidate_counts_if_all_of_its_parameters_are_possible():
    theta = {0: [1.0, 2.0], 1: [-1.0], 2: [3.0, 9.0], 3: [5.0, -4.0], 4: [0.5, 1.0, -8.0]}
    place = [[0, 1], [2], [3, 4], [5, 6], [7]]
    given = {}
    trials = SimpleNamespace(
        whole=SimpleNamespace(
            parameters_each=lambda columns: {i: np.array(theta[i]) for i in columns}
        ),
        held_out=SimpleNamespace(left_each=lambda possible: given.update(possible) or possible),
    )
    positive = np.array([True, True, True, True, True, True, False, False])
    highest = np.array([4.0, 4.0, 4.0, 4.0, 8.0, 6.0, 4.5, 7.0])
    every = drive_choice._Options([], place, positive, highest, trials)
    every.left_each({0: [], 1: [], 2: [], 3: [], 4: [0]})
    # negative friction, beyond the largest torque; an offset may be negative
    assert given == {0: [0, 1], 3: [5, 6]}
    theta[4][2] = -6.9
    given.clear()
    every.left_each({4: [0]})
    assert given == {4: [0, 1, 7]}


@pytest.mark.parametrize("growth", [1.2, 5.0])  # of a standard error with the suspected family
def test_each_joint_is_given_its_own_drive_and_what_is_wanted_of_it(monkeypatch, rng, growth):
    """The second joint has no sample that is used, the fourth is to have nothing."""
    names, n = ("a", "b", "c", "d"), 9
    q, v, tau = rng.standard_normal((3, n, 4)) * [1.0, 50.0, 7.0, 2.0]
    weight = np.ones((n, 4))
    weight[:, 1] = 0.0
    weight[2, 2] = 0.0
    U = rng.standard_normal((3, 3))
    sample = SimpleNamespace(
        joints=names, weight=weight, taken=(np.arange(n),), is_prismatic=np.array([0, 0, 1, 0]),
        recordings=[SimpleNamespace(trajectory=None)], at=[SimpleNamespace(tau=tau)], U=U,
        of_joint=lambda j: ("of", j), basis=None, standard=None,
    )  # fmt: skip
    motion = SimpleNamespace(of=lambda j: SimpleNamespace(q=q[:, j], v=v[:, j]))
    monkeypatch.setattr(drive_choice, "take_sample", lambda fit, **given: sample)
    monkeypatch.setattr(drive_choice, "drive_motion_along", lambda model, trajectory: motion)
    monkeypatch.setattr(drive_choice, "_candidates", lambda drive, families: families)
    monkeypatch.setattr(drive_choice, "_reweighted", lambda own, drive, first: own)
    grown = {"a.offset": growth}
    monkeypatch.setattr(drive_choice, "_grown", lambda own, drive, first: grown)
    monkeypatch.setattr(drive_choice, "_auto", lambda *given: ("auto", *given))
    monkeypatch.setattr(drive_choice, "_fixed", lambda *given: ("fixed", *given))
    model = SimpleNamespace(passive=(), with_reference=lambda pi: None)
    mapping = SimpleNamespace(base_names=("c.viscous", "cc.viscous", "c.offset"))
    fit = SimpleNamespace(model=model, mapping=mapping, standard=None)
    wanted = {"a": None, "b": None, "c": ("load", "tanh"), "d": ()}
    first, second = choose_drives(fit, wanted, {"a": "harmonics1", "c": "spring"})
    suspected = [FAMILIES["harmonics1"]]
    assert first[:2] == ("auto", ("of", 0))
    assert first[3:] == (suspected, suspected if growth < 1.3 else [])
    assert (second[:2], second[3]) == (("fixed", ("of", 2)), ("load", "tanh"))
    for (_, _, drive, *_), j in ((first, 0), (second, 2)):
        used = weight[:, j] > 0
        assert drive.largest == np.abs(tau[:, j]).max()
        assert drive.is_prismatic is (j == 2)
        speed = np.abs(v[used, j])
        assert drive.data_range == {
            "q": (q[used, j].min(), q[used, j].max()), "v": (speed.min(), speed.max()),
        }  # fmt: skip
    assert first[2].plain == {}
    assert list(second[2].plain) == ["c.viscous", "c.offset"]
    np.testing.assert_array_equal(second[2].plain["c.offset"], U[:, 2])


def test_stated_families_are_sized_one_after_the_other_until_they_agree(monkeypatch):
    """Of two families with three sizes each, whose best pair is found in the second pass."""
    own = [(FAMILIES[name], [k]) for name in ("load", "tanh") for k in range(3)]
    cost = np.array([[5.0, 9.0, 9.0], [9.0, 6.0, 4.0], [8.0, 9.0, 3.0]])

    def left(chosen):
        if not chosen:
            return np.array([30.0, 20.0])
        one, two = sorted(chosen)
        return np.array([cost[one, two - 3] - 1.0, 1.0])

    every = SimpleNamespace(own=own, left=left)
    monkeypatch.setattr(drive_choice, "_candidates", lambda *_: own)
    monkeypatch.setattr(drive_choice, "_Options", SimpleNamespace(of=lambda *_: every))
    monkeypatch.setattr(drive_choice, "_found", lambda *given: given[2:])
    sample = SimpleNamespace(torque=np.array([200.0]), joints=("a",))
    chosen, (none, both) = drive_choice._fixed(sample, None, ("load", "tanh"))
    assert [sizes for _, sizes in chosen] == [[2], [2]]
    assert (none.families, none.is_selected, both.is_selected) == ((), False, True)
    assert both.families == ("load", "tanh")
    assert none.held_out_error_pct == pytest.approx(100 * np.sqrt(50.0 / 200.0))
    assert both.held_out_error_pct == pytest.approx(100 * np.sqrt(3.0 / 200.0))
