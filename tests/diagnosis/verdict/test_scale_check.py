from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.crane import CRANE
from helpers.driven import arm
from helpers.fitting import fit, identify
from helpers.synthetic import exact_log, truth

from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.verdict.scale_check import (
    PayloadCheck,
    ScaleCheck,
    StatedMass,
    check_scale,
    common_factor,
    determines_total_mass,
    stated_mass,
)
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import joint_torque_regressor
from robotid.estimation.fitting.estimator_settings import ConstraintSettings, EstimatorSettings
from robotid.estimation.fitting.fit import pinned_joints
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0, velocity="measured")
NOISE = 0.05 * np.array([4, 4, 2, 1, 1, 0.5])


def near_urdf(model, scale=1.0):
    pi, size = model.standard_parameters(), model.layout.n_inertial
    pi[size:] = truth(model)[size:]
    return scale * pi


def found_of(model, pi, **constraints):
    noise, rngs = NOISE[: len(model.joints)], np.random.default_rng(0).spawn(2)
    logs = [exact_log(model, pi, rng, noise=noise) for rng in rngs]
    settings = EstimatorSettings(constraints=constraints)
    return identify(model, logs[:1], validation=logs[1:], signals=EXACT, estimator=settings)


@pytest.fixture(scope="module")
def alike(ur5):
    """A robot whose bodies are those of its URDF."""
    return found_of(ur5, near_urdf(ur5))


def test_a_robot_like_its_urdf_is_good_and_its_urdf_bears_witness(alike):
    found = alike
    assert found.scale_check.factor == pytest.approx(1.0, abs=0.01)
    for joint, ratio in found.scale_check.gravity.items():
        assert ratio == pytest.approx(1.0, abs=5 * found.scale_check.gravity_error[joint] + 1e-3)
    model, (e,), size = found.model, found.fitted, found.model.layout.n_inertial
    q = e.recording.trajectory.q
    q = q[:: -(-len(q) // 300)]
    Y = joint_torque_regressor(model, q, 0 * q, 0 * q).reshape(len(q), 6, -1)[:, 1, :size]
    u = Y @ found.prior[:size]
    slope = u @ Y / (u @ u)  # of the ratio of the second joint
    variance = slope @ found.standard_covariance[:size, :size] @ slope
    error = found.scale_check.gravity_error[model.joints[1]]
    assert error == pytest.approx(np.sqrt(variance), rel=1e-6)
    assert found.scale_check.agrees
    assert found.verdict.status == "good"
    assert "within 5 %" in found.verdict.reasons[-1]


def test_torques_of_another_gain_are_told_from_other_masses_and_never_good(four):
    found = found_of(four, near_urdf(four, 0.8))
    assert found.scale_check.factor == pytest.approx(0.8, abs=0.01)
    assert found.scale_check.has_one_factor
    assert found.verdict.status == "usable"
    (reason,) = [r for r in found.verdict.reasons if "absolute scale contradicts the URDF" in r]
    assert "The same factor 0.80 fits all joints: check the gains" in reason


def test_a_load_in_the_hand_is_no_other_scale(four):
    found = found_of(four, truth(four))  # links 10 to 30 % off, and 1.2 kg in the hand
    assert found.scale_check.factor > 1.2
    assert found.scale_check.masses[2] == pytest.approx(1.2, abs=0.4)
    assert not found.scale_check.has_one_factor
    assert found.verdict.status == "good", found.verdict.reasons
    assert "absolute scale not verified" in found.verdict.reasons[-1]


@pytest.mark.parametrize(
    ("factor", "mass", "contradicts"), [(1.37, 20.4, True), (1.2, 20.4, False), (1.01, 27.3, True)]
)
def test_a_load_without_mass_confirms_no_scale(factor, mass, contradicts):
    """Only a load with a mass of its own may be left out of gravity and total mass."""
    check = ScaleCheck(scale=1.01, factor=factor, masses=(20.0, mass, 0.0), unexplained=(0.2, 0.01))
    assert not check.agrees
    assert check.contradicts is contradicts
    said, state = check.message, "contradicts the URDF" if contradicts else "not verified"
    assert said.startswith(f"absolute scale {state}: ")
    assert f"gravity torque {factor:.2f} x the URDF's, total mass {mass:.4g} kg" in said
    assert replace(check, factor=1.05 - 1e-9, masses=(20.0, 20.8, 0.0)).agrees
    assert replace(check, factor=1.05 + 1e-9, masses=(20.0, 20.8, 0.7)).agrees


def test_without_gravity_nothing_bears_witness(four):
    model = four.from_urdf(four.tree, joints=four.joints, gravity=(0.0, 0.0, 0.0))
    found = found_of(model, near_urdf(model))
    assert found.scale_check.scale is None
    assert not found.scale_check.agrees
    assert "gravity loads no driven joint" in found.verdict.reasons[-1]


def test_a_result_that_its_prior_holds_back_bears_no_witness(four, rng):
    pi = truth(four)
    size = four.layout.n_inertial
    pi[:size] = 3.0 * four.standard_parameters()[:size]  # the sensors say three times the URDF
    log = exact_log(four, pi, rng, samples=1000, noise=0.5)
    held = identify(four, [log], estimator=EstimatorSettings(prior_weight=1e9))
    assert held.scale_check.factor == pytest.approx(1.0, abs=0.05)  # it stays at the URDF
    assert not held.scale_check.follows
    assert not held.scale_check.agrees
    assert identify(four, [log], estimator=EstimatorSettings()).scale_check.follows


def bodies_of(rng, count):
    """Return the parameters of random bodies, (count, 10), and their radii of gyration [m]."""
    mass = rng.uniform(1.0, 4.0, count)
    c, axes = rng.normal(0.0, 0.1, (count, 3)), rng.uniform(0.02, 0.1, (count, 3))
    second = [m * (np.diag(a**2) + np.outer(x, x)) for m, a, x in zip(mass, axes, c, strict=True)]
    J = np.zeros((count, 4, 4))
    J[:, :3, :3], J[:, 3, 3] = second, mass
    J[:, :3, 3] = J[:, 3, :3] = mass[:, None] * c
    return inertial_from_pseudo_inertia(J), np.linalg.norm(axes, axis=1)


def test_a_common_factor_is_that_of_generalised_least_squares():
    rng = np.random.default_rng(5)
    pi, radius = bodies_of(rng, 3)
    A, ratios = rng.standard_normal((4, 30)), np.array([1.4, 1.1, 1.7, 1.3])
    columns = [A[:, 10 * b : 10 * b + 10] @ pi[b] for b in range(3)]
    columns += [A[:, 10 * b + i] * pi[b, 0] * radius[b] for b in range(3) for i in (1, 2, 3)]
    V = np.column_stack(columns) @ np.column_stack(columns).T
    W = np.linalg.inv(V)
    factor = W.sum(axis=0) @ ratios / W.sum()
    variance = (ratios - factor) @ W @ (ratios - factor) / 3
    half = 3.182446 * np.sqrt(variance / W.sum())  # Student's t of 3 degrees of freedom
    assert common_factor(ratios, A, pi.ravel()) == pytest.approx((factor, half), rel=1e-4)


@pytest.mark.parametrize(("common", "is_wrong"), [((1.4, 0.5), False), ((1.4, 0.3), True)])
def test_a_factor_that_errors_of_the_urdf_explain_contradicts_nothing(common, is_wrong):
    far = ScaleCheck(scale=1.5, factor=1.5, masses=(20.0, 24.0, 0.0), unexplained=(0.01, 0.5))
    assert far.contradicts
    assert far.has_one_factor
    found = replace(far, common=common)
    assert (found.contradicts, found.has_one_factor) == (is_wrong, is_wrong)
    assert not found.agrees
    said = "The joints' common factor is 1.40 +- 0.5 (95 %): the URDF's errors may explain it"
    assert (said in found.message) is not is_wrong
    assert ("The same factor 1.50 fits all joints" in found.message) is is_wrong
    assert found.to_dict()["common"] == list(common)
    assert "common" not in far.to_dict()
    heavy = replace(found, masses=(20.0, 30.0, 1.0), mass_error=4.0)
    assert heavy.contradicts  # the total mass is determined
    assert replace(heavy, mass_error=6.0).contradicts is is_wrong


@pytest.mark.parametrize(
    ("left", "limit"), [((0.05, 0.2), 0.15), ((0.01, 0.2), 0.1), ((0.05, 0.11), 0.15)]
)
def test_a_factor_is_one_far_from_1_by_what_it_leaves_and_better_than_a_payload(left, limit):
    """By a tenth and three times the share that it leaves, which is less than half of the other."""
    for off in (limit - 0.01, limit + 0.01):
        for factor in (1.0 + off, 1.0 - off):
            found = ScaleCheck(scale=factor, factor=factor, unexplained=left)
            assert found.has_one_factor is (off > limit)
            assert not replace(found, unexplained=(left[0], 1.9 * left[0])).has_one_factor


@pytest.mark.parametrize(("error", "is_wrong"), [(6.0, False), (4.0, True)])
def test_a_total_mass_that_torque_does_not_determine_contradicts_nothing(error, is_wrong):
    found = ScaleCheck(scale=1.04, factor=1.04, masses=(20.0, 30.0, 0.0), unexplained=(0.2, 0.2))
    assert replace(found, mass_error=error).contradicts is is_wrong
    loaded = replace(found, mass_error=error, masses=(20.0, 30.0, 1.0))  # with a small payload
    assert loaded.contradicts is is_wrong
    gravity = replace(found, mass_error=error, factor=1.5, scale=1.5)
    assert gravity.contradicts  # gravity is determined
    assert replace(gravity, scale=None).contradicts is is_wrong


# --- payloads of known mass -----------------------------------------------------------------------
SHARP = PayloadCheck("tool0", 2.0, 2.02, 0.01, (2.0, 2.04), "loaded.csv", "ab")


@pytest.mark.parametrize(
    ("identified", "half", "verifies", "contradicts"),
    [
        (2.09, 0.099, True, False),
        (2.09, 0.101, False, False),  # the interval is too wide
        (2.09, 0.08, True, False),  # the known mass is outside, but the masses are alike
        (1.91, 0.02, True, False),
        (2.11, 0.10, False, True),
        (2.11, 0.12, False, False),  # the known mass is in the interval
        (1.89, 0.10, False, True),
    ],
)
def test_five_percent_and_the_interval_decide(identified, half, verifies, contradicts):
    check = replace(SHARP, identified=identified, interval=(identified - half, identified + half))
    assert (check.verifies, check.contradicts) == (verifies, contradicts)
    assert check.ratio == pytest.approx(identified / 2.0)


def test_it_decides_before_the_urdf_and_a_contradiction_before_all():
    urdf = ScaleCheck(scale=1.2, factor=1.2, masses=(20.0, 24.0, 0.0))
    assert not urdf.agrees
    verified = replace(urdf, payloads=(SHARP,))
    assert verified.agrees
    expected = f"absolute scale verified by a payload of known mass: {SHARP.message}"
    assert verified.message == expected
    wrong = replace(SHARP, identified=2.4, interval=(2.3, 2.5))
    like = ScaleCheck(scale=1.0, factor=1.0, masses=(20.0, 20.0, 0.0), payloads=(wrong,))
    assert like.contradicts
    assert like.message.startswith("absolute scale contradicted by a payload of known mass: pay")
    open_ = replace(urdf, payloads=(replace(SHARP, interval=(1.8, 2.24)),))
    assert not open_.agrees
    assert not open_.contradicts
    assert open_.message.endswith("Use a larger payload, or a longer motion")
    stated = StatedMass(("total_mass",), ratio=1.2, half_width=0.01)
    both = replace(verified, stated=stated)
    assert both.contradicts
    assert not both.agrees
    first, second = both.message.split(". Absolute scale ")
    assert first.startswith("absolute scale contradicted by a given mass")
    assert second.startswith("verified by a payload of known mass")
    assert PayloadCheck.from_dict(both.to_dict()["payloads"][0]) == SHARP


# --- stated masses --------------------------------------------------------------------------------
def checked(model, log, **constraints):
    settings = EstimatorSettings(constraints=constraints)
    return check_scale(fit(model, [log], signals=EXACT, estimator=settings))


@pytest.fixture(scope="module")
def lifted():
    """A fixed arm of revolute joints, whose first link can have any mass: model, truth, log."""
    model = arm()
    pi = truth(model)
    pi[: model.layout.n_inertial] *= 0.75
    return model, pi, exact_log(model, pi, np.random.default_rng(0), samples=300, noise=0.3)


@pytest.fixture(scope="module")
def crane(tmp_path_factory):
    """A cart on a rail without motor inertia, so that the rail's force determines all mass."""
    path = tmp_path_factory.mktemp("crane") / "crane.urdf"
    path.write_text(CRANE)
    model = RobotModel.from_urdf(path, terms=("viscous",))
    pi = truth(model)
    return model, pi, exact_log(model, pi, np.random.default_rng(0), samples=300, noise=0.05)


@pytest.mark.parametrize("times", [1.0, 2.0])
def test_any_total_mass_of_a_fixed_arm_fits_and_none_verifies(lifted, times):
    model, pi, log = lifted
    total = float(pi[: model.layout.n_inertial : 10].sum())
    free, found = checked(model, log), checked(model, log, total_mass=times * total)
    assert not free.is_total_determined
    assert found.stated.ratio is None
    assert found.masses[1] == pytest.approx(times * total)  # it was taken, but no torque changed
    assert found.factor == pytest.approx(free.factor, rel=0.05)
    assert (found.stated.verifies, found.stated.contradicts) == (False, False)
    assert found.contradicts is found.has_one_factor
    assert model.layout.bodies[0] in found.stated.absorbed_by
    assert [x.to_dict()["is_stated"] for x in (free, found)] == [False, True]
    assert "The given total_mass does not verify the scale: torque does not" in found.message
    assert "Verify it with a payload of known mass (robotid payload)" in found.message


def test_the_named_links_take_up_most_of_the_likeliest_change_that_no_torque_shows(model):
    layout, K = model.layout, structural_mapping(model).K
    spread = np.full(len(layout.names), 0.2)
    spread[: layout.n_inertial : 10] = 0.9, 0.35, 1.5  # [kg]
    known = SimpleNamespace(theta=np.zeros(len(K)), covariance=np.eye(len(K)))
    bounds = SimpleNamespace(masses={}, total=(5.0, 5.0), pinned=())
    found = SimpleNamespace(
        model=model, wls=known, prior_std=spread, prior=np.zeros(len(spread)),
        mapping=SimpleNamespace(K=K), estimator=SimpleNamespace(bounds=bounds),
    )  # fmt: skip
    # the change x of least |x / spread| with K x = 0 that adds 1 kg to the total mass
    own = np.array([name.endswith(".m") for name in layout.names], dtype=float)
    rows = np.vstack([K, own]) * spread
    x = spread * (np.linalg.pinv(rows) @ np.append(np.zeros(len(K)), 1.0))
    masses = np.abs(x[: layout.n_inertial : 10])
    wanted = tuple(np.array(layout.bodies)[masses > 0.1 * masses.sum()].tolist())
    assert np.linalg.norm(K @ x) < 1e-9
    assert stated_mass(found) == StatedMass(("total_mass",), absorbed_by=wanted)


def test_the_force_of_a_rail_verifies_a_total_mass_and_contradicts_a_wrong_one(crane):
    model, pi, log = crane
    total = float(pi[0] + pi[10])
    assert checked(model, log).is_total_determined
    right, wrong = (checked(model, log, total_mass=x * total) for x in (1.0, 2.0))
    assert right.stated.ratio == pytest.approx(1.0, abs=right.stated.half_width)
    assert 0.001 < right.stated.half_width < 0.03
    assert wrong.stated.ratio == pytest.approx(right.stated.ratio / 2)
    assert wrong.stated.half_width == pytest.approx(right.stated.half_width / 2)
    assert (right.agrees, right.contradicts) == (True, False)
    assert (wrong.agrees, wrong.contradicts) == (False, True)
    assert right.message.startswith("absolute scale verified by a given mass")
    assert "torque alone determines 0.499 +- 0.0022 x the given total_mass" in wrong.message
    assert "check the gains of the torques, and the given mass" in wrong.message


def test_stated_masses_of_all_links_add_up_to_one_that_torque_determines(crane):
    model, pi, log = crane
    alone = checked(model, log, mass={"boom": float(pi[10])}).stated
    both = checked(model, log, mass={"boom": float(pi[10]), "cart": float(pi[0])}).stated
    total = checked(model, log, total_mass=float(pi[0] + pi[10])).stated
    assert alone.ratio is None
    assert (both.ratio, both.half_width) == pytest.approx((total.ratio, total.half_width), rel=0.1)


def test_the_mass_that_remains_beside_a_pinned_link_is_determined(crane):
    model, pi, log = crane
    boom = float(pi[0] + pi[10] - model.standard_parameters()[0])  # beside the URDF's cart
    stated = checked(model, log, mass={"boom": boom}, pinned=["cart"]).stated
    assert stated.ratio == pytest.approx(1.0, abs=0.03)
    assert pinned_joints(ConstraintSettings(pinned=("cart",)), model) == model.joints[:1]


def test_a_wide_range_is_a_bound_and_a_narrow_one_widens_the_interval(crane):
    model, pi, log = crane
    total = float(pi[0] + pi[10])
    assert checked(model, log, total_mass=[0.9 * total, 1.1 * total]).stated is None
    narrow = checked(model, log, total_mass=[0.98 * total, 1.02 * total]).stated
    exact = checked(model, log, total_mass=total).stated
    assert narrow.half_width == pytest.approx(exact.half_width + 0.02)
    cart, boom = float(pi[0]), float(pi[10])  # ranges of several masses count by their shares
    ranged, both = (
        checked(model, log, mass={"boom": [(1 - x) * boom, (1 + x) * boom],
                                  "cart": [(1 - y) * cart, (1 + y) * cart]}).stated
        for x, y in ((0.02, 0.04), (0.0, 0.0))
    )  # fmt: skip
    wider = (0.02 * boom + 0.04 * cart) / total
    assert ranged.half_width - both.half_width == pytest.approx(wider, rel=1e-6)


@pytest.mark.parametrize(
    ("ratio", "half_width", "verifies", "contradicts"),
    [
        (1.049, 0.049, True, False), (1.049, 0.051, False, False), (1.051, 0.049, False, False),
        (0.9, 0.049, False, True), (0.9, 0.051, False, False), (None, 0.0, False, False),
    ],
)  # fmt: skip
def test_each_limit_of_a_stated_mass(ratio, half_width, verifies, contradicts):
    stated = StatedMass(("total_mass",), ratio, half_width)
    assert (stated.verifies, stated.contradicts) == (verifies, contradicts)
    assert ("does not verify" in stated.message) is not (verifies or contradicts)


@pytest.mark.parametrize("mass", [0.0, -0.1])
def test_a_fit_without_a_total_mass_does_not_determine_it(model, mass):
    standard = np.ones(len(model.layout.names))  # of other parameters than masses
    standard[: model.layout.n_inertial : 10] = mass
    assert not determines_total_mass(SimpleNamespace(model=model, standard=standard))
