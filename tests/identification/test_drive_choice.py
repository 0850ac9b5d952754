"""Friction that the drives of a known robot have is chosen, sized and guarded; no other is."""

import re
from functools import cache, partial

import numpy as np
import pytest
from helpers import driven as helper
from helpers.driven import ELBOW, JOINTS, driven, driven_log
from helpers.stands import recorded, stand

from robotid.base.exceptions import SettingsError
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.residual.term_trials import Trials, take_sample
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.constraint_rows import without_forces
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.fit import solve_recordings
from robotid.estimation.fitting.fitted import friction_curve
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.identification.drive_choice import choose_drives
from robotid.robot.constraints import Contact
from robotid.robot.drive_term import DriveMotion
from robotid.robot.drives import AUTO, FAMILIES, Harmonic, Lag, LoadFriction, Stribeck, Tanh
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

found_in, fitted_in = (partial(f, estimator="wls") for f in (helper.found_in, helper.fitted_in))
SEED, QUANTILE = 3, 1.5  # of the motion: the elbow turns more than half a turn
SURE = 2.6  # standard errors, of a few hundred figures that are looked at
SEEN = {"q": (-1.58, 1.80), "v": (0.03, 1.53)}  # of the elbow in this motion
# Shapes, parameters, and what else the elbow has: sizes of some 2 N m beside 7 N m of torque.
CASES = {
    "load": ((), (0.07,)), "stribeck": ((0.1,), (3.0,)), "tanh": ((0.2,), (4.0,)),
    "presliding": ((0.02,), (4.0,)), "lag": ((), (0.01,)), "harmonics1": ((), (2.0, 1.5)),
    "harmonics2": ((), (0.0, 0.0, 2.0, 1.5)),
    "harmonics4": ((), (0.0, 0.0, 2.0, 1.5, 1.0, -1.0, 0.5, -1.5)),
    "asymmetric": ((), (1.5,)), "power": ((0.35,), (3.0,)), "cubic": ((), (1.0,)),
    "curve": ((), (2.0, 1.5, 1.0, 0.5)), "lugre": ((0.02, 0.15, 0.8), (3.0,)),
    "position": ((), (1.0, 0.7)), "spring": ((), (4.0,)),
    "spring_table": ((), (2.0, 1.0, -1.0, -2.0, 1.0, 2.0, 3.0, 1.0)),
}  # fmt: skip
ALIKE = {"tanh": {"tanh", "stribeck"}, "stribeck": {"tanh", "stribeck"}}


@pytest.fixture(scope="module")
def cases(model):
    """Each family on the elbow: the robot, its parameters and its log, made when asked for."""
    made = {}

    def case(name):
        if name not in made:
            sizes, values = CASES[name]
            terms = FAMILIES[name].make(SEEN, *sizes)
            own = {f"{ELBOW}.{t.name}": x for t, x in zip(terms, values, strict=True)}
            true, pi = driven(model, {ELBOW: terms}, own)
            made[name] = (true, pi, driven_log(true, pi, SEED, reach=QUANTILE))
        return made[name]

    return case


@pytest.fixture(scope="module")
def chosen_in(model, cases):
    """The fit of each case with the friction that it shows."""
    return cache(lambda name: fitted_in(model, [cases(name)[2]], friction=AUTO))


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
def test_a_family_that_is_stated_is_found_within_its_intervals(model, cases, name):
    true, pi, log = cases(name)
    # least squares alone does not tell the parts of a curve from viscous friction
    estimator = helper.FIT if name == "curve" else "wls"
    # errors of shapes widen intervals when all is concluded
    finds = found_in if CASES[name][0] else fitted_in
    found = finds(model, [log], friction={ELBOW: name, "*": "none"}, estimator=estimator)
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
    beside = [x.held_out_error_pct for x in choice.tried if len(x.families) == 2]
    assert max(beside, default=0.0) < 0.7 * plain_error  # with the weights of the family, too
    # noise is 1 % of the torque; shapes of the grid leave more than those of the fit
    assert error == pytest.approx(1.0, abs=0.5)
    assert found.metrics().per_joint[ELBOW].relative_error_pct == pytest.approx(1.0, rel=0.15)


def test_a_shape_between_the_sizes_of_the_grid_needs_no_second_family(model):
    low, high = FAMILIES["stribeck"].shapes[0].within(SEEN)
    speed = low * (high / low) ** (3.5 / 5)  # of 6 sizes
    terms = [Stribeck(speed=speed)]
    true, pi = driven(model, {ELBOW: terms}, {f"{ELBOW}.stribeck": 6.0})
    found = fitted_in(model, [driven_log(true, pi, SEED, reach=QUANTILE)], estimator="wls")
    assert chosen(found) == {ELBOW: ("stribeck",)}


def test_a_robot_of_viscous_and_coulomb_friction_gets_no_more(model):
    true, pi = driven(model, {}, {})
    for seed in range(2):
        found = fitted_in(model, [driven_log(true, pi, seed, reach=QUANTILE, noise=0.02)])
        assert [c.joint for c in found.drives] == list(JOINTS)
        assert chosen(found) == {}
        assert found.model.layout == model.layout


@pytest.fixture(scope="module")
def rising(model):
    """Friction that sets in over most of the speeds: a hook of Stribeck's fits nearly as well."""
    terms = [Tanh(speed=0.6 * SEEN["v"][1])]
    true, pi = driven(model, {ELBOW: terms}, {f"{ELBOW}.tanh": 14.0})
    return helper.found_in(model, [driven_log(true, pi, SEED, reach=QUANTILE, noise=0.03)])


def test_of_families_alike_the_better_conditioned_is_chosen(model, rising):
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
    logs = [evaluation.recording.log for evaluation in rising.fitted]
    stated = helper.found_in(model, logs, friction={ELBOW: "stribeck", "*": "none"})
    (other,) = (c for c in stated.drives if c.families)
    assert other.shapes[0].is_at_bound
    (said,) = [f for f in stated.findings if f.code == "correlated_terms"]
    assert (said.severity, said.where) == ("note", ELBOW)
    assert re.match(
        r"elbow_joint: the errors of coulomb \S+ \+- \S+ and stribeck \S+ \+- \S+ are strongly "
        r"correlated \(r = -0\.9\d+\): .* together are \S+ \+- \S+ N m at \S+ rad/s and ",
        said.message,
    )
    names, C = stated.model.layout.names, stated.standard_covariance
    i, k = (names.index(f"{ELBOW}.{term}") for term in ("coulomb", "stribeck"))
    assert said.evidence["r"] == pytest.approx(C[i, k] / np.sqrt(C[i, i] * C[k, k]))


def test_harmonics_are_for_joints_that_turn_far_enough(model):
    waves = [Harmonic(order=2.0), Harmonic(order=2.0, is_sine=True)]
    true, pi = driven(model, {ELBOW: waves}, {f"{ELBOW}.cos2": 2.0, f"{ELBOW}.sin2": 1.5})
    log = driven_log(true, pi, SEED, reach=1.0)  # 2.4 rad
    found = fitted_in(model, [log])
    names = {family for families in chosen(found).values() for family in families}
    assert not names & {"harmonics2", "harmonics4"}
    assert not any("harmonics" in f for c in found.drives for x in c.tried for f in x.families)
    with pytest.raises(SettingsError, match=r"elbow_joint has harmonics4, .* half a revolution"):
        fitted_in(model, [log], friction={ELBOW: "harmonics4"})


@pytest.mark.parametrize("load", [-0.05, 0.7])
def test_friction_that_would_be_negative_or_hold_any_load_is_none(model, load):
    true, pi = driven(model, {ELBOW: [LoadFriction()]}, {f"{ELBOW}.load": load})
    found = fitted_in(model, [driven_log(true, pi, SEED, reach=QUANTILE)])
    assert "load" not in chosen(found).get(ELBOW, ())
    assert ("load",) not in {x.families for x in found.drives[1].tried}


def test_what_is_nearly_chosen_widens_the_intervals_it_would_move(model):
    """Load friction lost in the noise of one joint: its Coulomb friction takes a part of it."""
    true, pi = driven(model, {ELBOW: [LoadFriction()]}, {f"{ELBOW}.load": 0.03})
    k = list(model.layout.names).index(f"{ELBOW}.coulomb")
    coulomb = pi[list(true.layout.names).index(f"{ELBOW}.coulomb")]
    seen = 0
    for seed in range(3):
        log = driven_log(true, pi, seed, reach=QUANTILE, noise=0.06)
        found = found_in(model, [log], estimator="wls")
        (choice,) = (c for c in found.drives if c.joint == ELBOW)
        assert all(x.p_value < 0.015 for x in choice.tried if x.is_selected and x.families)
        if choice.families or [t.name for t in choice.undecided] != ["load"]:
            continue
        seen += 1
        alone = found_in(model, [log], friction="none", estimator="wls")
        assert found.standard[k] == alone.standard[k]
        assert found.standard_error[k] > alone.standard_error[k]
        assert abs(found.standard[k] - coulomb) < SURE * found.standard_error[k]
    assert seen


# --- constraint forces that are eliminated --------------------------------------------------------
FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
PLANTED = {"FL_HFE": 0.1, "HR_KFE": 0.1}  # excess of Stribeck friction [N m]


def quadruped(**options):
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=("viscous", "coulomb"),
        constraints=[Contact(foot) for foot in FEET], **options,
    )  # fmt: skip


def solved(planted):
    """Return the fit, with viscous and Coulomb friction, of a robot with Stribeck friction."""
    rng, model = np.random.default_rng(2), quadruped()
    own = {joint: [Stribeck(speed=0.1)] for joint in planted}
    plant = quadruped(own_terms=own)
    pi = plant.standard_parameters()
    size = {"viscous": 0.02, "coulomb": 0.05}
    for i, name in enumerate(plant.layout.names):
        joint, _, term = name.partition(".")
        pi[i] += size.get(term, planted.get(joint, 0.0) if term == "stribeck" else 0.0)
    motion = stand(model, np.tile([0.0, 0.8, -1.6], 4), 0.25, rng, parts=6, length=2.0)
    log = recorded(plant, pi, motion, rng, rate=100.0, duration=12.0)
    signals = SignalSettings(cutoff=None, velocity="measured", acceleration="measured")
    recordings = Recordings(model, structural_mapping(model), [hold_log(model, log, signals)])
    return solve_recordings(recordings, EstimatorSettings("wls"), is_last=False).solution


@pytest.fixture(scope="module")
def fit():
    return solved(PLANTED)


def wanted(fit, *joints, families=None):
    return {joint: families if joint in joints else () for joint in fit.model.joints}


def test_planted_terms_are_selected_and_no_others(fit):
    neighbours = ("FL_KFE", "HR_HFE")
    choices = choose_drives(fit, wanted(fit, *PLANTED, *neighbours))
    assert {x.joint: x.families for x in choices} == {
        **{joint: ("stribeck",) for joint in PLANTED}, **{joint: () for joint in neighbours}
    }  # fmt: skip
    for choice in choices:
        for shape in choice.shapes:
            assert shape.value == pytest.approx(0.1, abs=3 * shape.std_error)
            assert shape.std_error < 0.02


def test_errors_of_shapes_do_not_depend_on_the_order_of_the_families(fit):
    errors = []
    for families in (("stribeck", "power"), ("power", "stribeck")):
        choices = choose_drives(fit, wanted(fit, "FL_HFE", families=families))
        errors += [{x.name: x.std_error for x in c.shapes} for c in choices if c.families]
    assert errors[0] == pytest.approx(errors[1], rel=0.02)


def test_the_row_of_a_joint_alone_has_all_of_its_projected_torque(fit, rng):
    """Row j over sqrt(P_jj) has the same products with the regressor as all rows together."""
    sample = take_sample(fit, for_drives=True)
    z, j = rng.standard_normal((len(sample.r), 2)), 4
    Z = np.zeros((*sample.r.shape, 2))
    Z[:, 6 + j] = z
    used = sample.weight > 0
    is_whole = used.all(axis=1)
    Z *= is_whole[:, None, None]
    z *= is_whole[:, None]
    every = Trials(sample, without_forces(sample.basis, Z), 0.0).whole
    alone = Trials(sample.of_joint(j), z[:, None], 0.0).whole
    np.testing.assert_allclose(alone.T[:, :2], every.T[:, :2], atol=1e-9 * np.abs(every.T).max())
    np.testing.assert_allclose(alone.S[:2], every.S[:2], rtol=1e-6, atol=1e-9 * every.S.max())
    assert is_whole.mean() > 0.3


def test_columns_of_other_joints_are_refitted_with_the_projected_rows(fit, rng):
    sample = take_sample(fit, for_drives=True)
    Z = rng.standard_normal((*sample.r.shape, 2))
    together = sample.with_columns(Z)
    size = sample.W.shape[2]
    added, left = together.W[..., size:], sample.weight[..., None] * without_forces(sample.basis, Z)
    ratio = added[sample.weight > 0] / left[sample.weight > 0]
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[0], ratio.shape))


def test_families_that_need_the_load_are_refused(fit):
    with pytest.raises(SettingsError, match="FL_HFE has load, which needs the joint load torque"):
        choose_drives(fit, wanted(fit, "FL_HFE", families=("load",)))
    for term in (LoadFriction(), Lag()):
        with pytest.raises(SettingsError, match=f"FL_HFE has the drive term '{term.name}', which"):
            quadruped(own_terms={"FL_HFE": [term]})
