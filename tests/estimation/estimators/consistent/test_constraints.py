"""Bounds of bodies: kept by the fit, refused where they contradict each other."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.estimation import NOISE, Case, consistent
from helpers.synthetic import truth

from robotid.base.exceptions import SettingsError
from robotid.dynamics.factors import compress
from robotid.estimation.estimators import Consistent
from robotid.estimation.estimators.consistent.body_constraints import Constraints, slabs
from robotid.estimation.fitting.consistent_estimator import make_constraints
from robotid.estimation.fitting.estimator_settings import ConstraintSettings
from robotid.robot.geometry import body_boxes
from robotid.robot.parameters import ParameterLayout, pseudo_inertia


@pytest.fixture
def case(ur5, rng):
    """The fit of a UR5 whose masses are unlike its URDF's, and the factors of a noisy log."""
    case = Case(ur5, rng, NOISE)
    return consistent(case), compress(case.problem)


def constrained(fit, **bounds):
    return replace(fit, constraints=Constraints(**bounds))


def masses(estimate):
    return estimate.theta[:60:10]


def centre(estimate, body):
    values = estimate.theta[10 * body : 10 * body + 4]
    return values[1:] / values[0]


def test_bounds_of_mass_are_kept_and_reached(case):
    fit, factors = case
    free = masses(fit.fit(factors))
    low, high = 1.2 * free[2], 0.7 * free[3]
    mass = {"forearm_link": (low, np.inf), "wrist_1_link": (0.0, high)}
    estimate = constrained(fit, mass=mass).fit(factors)
    assert masses(estimate)[2] == pytest.approx(low, rel=1e-6)
    assert masses(estimate)[3] == pytest.approx(high, rel=1e-6)
    assert {"mass forearm_link", "mass wrist_1_link"} <= set(estimate.details["active"])
    assert "mass" in estimate.details["constraints"]


def test_a_known_total_mass_is_met_exactly(case):
    fit, factors = case
    total = 1.1 * masses(fit.fit(factors)).sum()
    estimate = constrained(fit, total_mass=(total, total)).fit(factors)
    assert masses(estimate).sum() == pytest.approx(total, rel=1e-12)
    bounded = constrained(fit, total_mass=(total, 2 * total)).fit(factors)
    assert masses(bounded).sum() == pytest.approx(total, rel=1e-6)
    # the known sum leaves it less room: its variance in that direction is 0
    one = np.zeros(len(fit.prior))
    one[:60:10] = 1.0
    assert one @ estimate.covariance @ one == pytest.approx(0.0, abs=1e-12)


def test_pinned_bodies_keep_the_urdf_and_the_rest_is_the_constrained_least_squares(case, ur5):
    fit, factors = case
    estimate = constrained(fit, pinned=("forearm_link", "wrist_1_link")).fit(factors)
    np.testing.assert_allclose(estimate.theta[20:40], fit.prior[20:40], rtol=1e-12, atol=1e-12)
    assert not estimate.std_error[20:40].any()
    # all others are at a minimum, where no inequality binds
    fit = replace(fit, prior=truth(ur5), prior_weight=10.0)
    pinned = constrained(fit, pinned=("forearm_link", "wrist_1_link"))
    estimate = pinned.fit(factors)
    assert estimate.details["active"] == []
    rows = pinned.rows(factors, estimate.sigma)
    D = rows[:, :-1] @ fit.K
    slope = D.T @ (D @ estimate.theta - rows[:, -1])
    slope += 0.5 * fit.prior_weight * fit.programme.penalty.gradient(estimate.theta)
    kept = np.setdiff1d(np.arange(len(fit.prior)), np.arange(20, 40))
    slope *= fit.prior_std
    assert np.abs(slope[kept]).max() < 1e-5 * np.abs(slope).max()


def test_a_centre_of_mass_stays_in_its_box(case):
    fit, factors = case
    free = centre(fit.fit(factors), 2)
    corners = [free - 0.2, free - [0.02, -0.1, -0.1]]  # x at least 2 cm less
    settings = ConstraintSettings(com={"forearm_link": [list(c) for c in corners]})
    estimate = replace(fit, constraints=make_constraints(settings, {})).fit(factors)
    found = centre(estimate, 2)
    assert (corners[0] - 1e-6 <= found).all()
    assert (found <= corners[1] + 1e-6).all()
    assert found[0] == pytest.approx(corners[1][0], abs=1e-6)
    assert "centre_of_mass forearm_link" in estimate.details["active"]


@pytest.mark.parametrize(
    ("bounds", "text"),
    [
        ({"mass": {"tool0": (1.0, 2.0)}}, r"\['tool0'\], which are not bodies of the model"),
        ({"mass": {"forearm_link": (3.0, 2.0)}}, r"\[3, 2\] kg: the first value is larger"),
        ({"mass": {"forearm_link": (-2.0, -1.0)}}, "is bounded by -1 kg, wanted a positive"),
        ({"total_mass": (0.0, 2.0), "mass": {"forearm_link": (3.0, 9.0)}}, "allow .3, inf. kg"),
        (
            {"mass": {"forearm_link": (0.1, 0.2)}, "pinned": ("forearm_link",)},
            "forearm_link is pinned at the URDF's 2.275 kg, outside its bounds",
        ),
        (
            {
                "com": {"forearm_link": (np.eye(3)[:1], np.array([-1.0]))},
                "pinned": ("forearm_link",),
            },
            "forearm_link is pinned, but the URDF's centre of mass .* mm outside its bounds",
        ),
    ],
)
def test_bounds_that_contradict_each_other_are_refused_before_the_solver_runs(case, bounds, text):
    with pytest.raises(SettingsError, match=text):
        constrained(case[0], **bounds)


def test_links_on_locked_joints_count_in_the_bounds(case):
    held = np.zeros(60)
    held[20:30] = [2.0, 0, 0, 0, 0.01, 0, 0.01, 0, 0, 0.01]
    with pytest.raises(SettingsError, match="its links on locked joints alone have 2 kg"):
        constrained(replace(case[0], held=held), mass={"forearm_link": (0.5, 1.0)})


def test_the_slabs_of_a_box_hold_for_grains_inside_and_fail_for_one_outside(rng):
    box = np.array([[-0.1, -0.2, 0.0], [0.3, 0.2, 0.5]])
    grains = rng.uniform(*box, size=(50, 3))
    homogeneous = np.column_stack([grains, np.ones(50)])
    masses = rng.uniform(0.1, 1.0, 50)
    J = (homogeneous * masses[:, None]).T @ homogeneous
    value = np.einsum("kij,ij->k", slabs(box), J)
    # the integral of (x - l) (u - x), grain by grain
    np.testing.assert_allclose(value, masses @ ((grains - box[0]) * (box[1] - grains)), rtol=1e-12)
    assert (value > 0).all()
    x = np.array([0.31, 0.0, 0.1, 1.0])
    np.testing.assert_array_equal(np.sign(np.einsum("kij,i,j->k", slabs(box), x, x)), [-1, 1, 1])


def test_extents_keep_the_mass_of_each_body_in_its_box(case, ur5):
    boxes = {b: 0.2 * box + 0.8 * box.mean(axis=0) for b, box in body_boxes(ur5).items()}
    loose, factors = case
    tight = replace(loose, constraints=Constraints(extent=boxes))
    free, kept = (one.fit(factors) for one in (loose, tight))

    def slack(estimate):
        J = pseudo_inertia(estimate.theta[:60])
        return np.array(
            [np.einsum("kij,ij->k", slabs(boxes[b]), J_i) for b, J_i in zip(boxes, J, strict=True)]
        )

    assert slack(free).min() < -1e-3
    assert slack(kept).min() > -1e-7
    bound = [b for b, values in zip(boxes, slack(kept), strict=True) if values.min() < 1e-7]
    assert [f"extent {body}" for body in sorted(bound)] == [
        label for label in kept.details["active"] if label.startswith("extent")
    ]


@pytest.fixture(scope="module")
def two_bodies():
    """Two bodies of 3 and 5 kg; the first has 1 kg on locked joints."""
    layout = ParameterLayout(("one", "two"), (), ())
    ball = np.array([1.0, 0.1, 0.2, -0.3, 0.4, 0, 0.4, 0, 0, 0.4])
    return layout, np.concatenate([3 * ball, 5 * ball]), np.concatenate([ball, 0 * ball])


@pytest.mark.parametrize(
    ("bounds", "text"),
    [
        ({"mass": {"two": (2.0, 4.0)}, "total_mass": (9.0, 12.0), "pinned": ("one",)},
         r"allow \[5, 7\] kg"),
        ({"mass": {"one": (2.0, 4.0), "two": (1.5, 2.5)}, "total_mass": (1.0, 3.4)},
         r"allow \[3.5, 6.5\] kg"),
        ({"mass": {"one": (0.1, 0.9)}}, "joints alone have 1 kg"),
        ({"mass": {"two": (0.1, 4.0)}, "pinned": ("two",)}, r"the URDF's 5 kg, outside its bounds"),
        ({"pinned": ("two",),
          "com": {"two": (np.vstack([np.eye(3), -np.eye(3)]), np.array([9, 0.15, 9, 9, 9, 9.0]))}},
         r"\[0.1, 0.2, -0.3\] m is 50.0 mm outside"),
    ],
)  # fmt: skip
def test_bounds_are_checked_with_the_figures_of_each_body(two_bodies, bounds, text):
    layout, prior, held = two_bodies
    with pytest.raises(SettingsError, match=text):
        Constraints(**bounds).check(layout, prior, held)


def test_rows_of_bounds_are_those_of_their_body_and_sign(two_bodies):
    layout, prior, _ = two_bodies
    normal = np.array([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0]])
    bounds = Constraints(
        mass={"two": (2.0, 9.0), "one": (-np.inf, 7.0)}, total_mass=(4.0, 8.5),
        com={"two": (normal, np.array([0.3, 0.7]))},
        extent={"one": np.array([[-0.5, -0.4, -0.9], [0.6, 0.7, 0.2]])},
    )  # fmt: skip
    rows = bounds.bounds(layout, np.linspace(0.5, 2.4, 20))
    mx = prior[11:14]
    J = pseudo_inertia(prior[:10])[0]
    wanted = [5 - 2.0, 9.0 - 5, 7.0 - 3, 8 - 4.0, 8.5 - 8]
    wanted += [5 * b - n @ mx for n, b in zip(normal, (0.3, 0.7), strict=True)]
    for k, (low, high) in enumerate(((-0.5, 0.6), (-0.4, 0.7), (-0.9, 0.2))):
        wanted.append(-J[k, k] + (low + high) * J[k, 3] - low * high * J[3, 3])
    size = np.linalg.norm(rows.G, axis=1)
    np.testing.assert_allclose(size, 1.0)
    slack = rows.G @ (prior / np.linspace(0.5, 2.4, 20)) + rows.h
    np.testing.assert_allclose(np.sign(slack), np.sign(wanted))
    mass = np.array([0, 1, 2])  # of 0.5 and 1.5 per unit of the rows
    np.testing.assert_allclose(slack[mass], np.array(wanted)[mass] / [1.5, 1.5, 0.5])
    assert list(rows.labels) == [
        "mass two", "mass two", "mass one", "total_mass all", "total_mass all",
        "centre_of_mass two", "centre_of_mass two", *["extent one"] * 3,
    ]  # fmt: skip
    fixed = Constraints(mass={"one": (2.5, 2.5)}, total_mass=(7.5, 7.5), pinned=("two",))
    E, e = fixed.equalities(layout, prior)
    np.testing.assert_array_equal(E @ prior, [*prior[10:], 3.0, 8.0])
    np.testing.assert_array_equal(e, [*prior[10:], 2.5, 7.5])
    assert fixed.bounds(layout, np.ones(20)).labels == ()


def test_the_spread_before_the_data_is_that_of_the_plausible_weight(two_bodies):
    layout, prior, held = two_bodies
    std = np.linspace(0.5, 2.4, 20)
    for weight, plausible, factor in ((6.0, 1.5, 1.5), (1.0, 1.5, 1.0), (0.25, 0.5, 0.25)):
        fit = Consistent(
            layout, np.eye(20), prior, std, held, prior_weight=weight, plausible_weight=plausible
        )
        spread = np.sqrt(
            np.diag(np.linalg.inv(0.5 * factor * fit.programme.penalty.hessian(prior)))
        )
        np.testing.assert_allclose(fit.spread_before, spread, rtol=1e-9)
        assert fit.weight_ratio == max(weight / plausible, 1.0)
