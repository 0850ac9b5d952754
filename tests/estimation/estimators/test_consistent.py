"""Constraints of bodies, the entropic penalty and all that a consistent fit states."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from helpers.estimation import NOISE, Case, consistent

from robotid.base.exceptions import DataError, SettingsError
from robotid.dynamics.factors import Factors, compress, triangle_of
from robotid.estimation.estimators import WLS, Consistent
from robotid.estimation.estimators.consistent_fit import Constraints, Subspace, slabs
from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.estimators.interior_point import Entropic
from robotid.estimation.fitting.estimator_settings import ConstraintSettings
from robotid.estimation.fitting.fit import make_constraints
from robotid.robot.parameters import ParameterLayout, inertial_from_pseudo_inertia, pseudo_inertia

LAYOUT = ParameterLayout(bodies=("one", "two"), joints=("a", "b"), terms=("viscous",))


@pytest.fixture
def prior(rng):
    """Two bodies of different size, and two drives."""
    half = rng.standard_normal((2, 4, 6))
    J = half @ half.transpose(0, 2, 1) * np.array([1.0, 0.01])[:, None, None]
    bodies = [inertial_from_pseudo_inertia(J_i) for J_i in J]
    return np.concatenate([*bodies, [0.3, 0.1]])


@pytest.fixture
def std(prior):
    spread = []
    for J in pseudo_inertia(prior[:20]):
        m, r = J[3, 3], np.sqrt(np.trace(J[:3, :3]) / J[3, 3])
        spread += [m, *[m * r] * 3, *[m * r**2] * 6]
    return np.array([*spread, 1.0, 2.0])


def penalty_of(prior, std, held=None):
    return Entropic.of(LAYOUT, prior, std, np.zeros(20) if held is None else held)


def differences(function, pi, steps):
    return np.array(
        [(function(pi + h) - function(pi - h)) / (2 * h.max()) for h in np.diag(steps)]
    ).T


def test_gradient_and_hessian_are_those_of_finite_differences(prior, std):
    penalty, pi = penalty_of(prior, std), 1.0 * prior
    pi[[1, 5, 14, 20]] += 0.05 * std[[1, 5, 14, 20]]
    gradient, hessian = penalty.gradient(pi), penalty.hessian(pi)
    steps, units = 1e-5 * std, np.outer(std, std)
    for exact, function, unit in (
        (gradient, penalty.value, std),
        (hessian, penalty.gradient, units),
    ):
        atol = 1e-6 * np.abs(exact * unit).max()
        numeric = differences(function, pi, steps)
        np.testing.assert_allclose(exact * unit, numeric * unit, atol=atol)
    assert np.linalg.eigvalsh(hessian * units).min() > 0


def test_it_is_the_divergence_of_two_gaussians(prior, std):
    # -log det's Bregman divergence is twice the Kullback-Leibler divergence of N(0, J), N(0, P)
    penalty = penalty_of(prior, std)
    pi = prior.copy()
    pi[:10] *= 1.3
    J, P = pseudo_inertia(pi[:10])[0], pseudo_inertia(prior[:10])[0]
    rng = np.random.default_rng(1)
    x = rng.multivariate_normal(np.zeros(4), J, 200_000)
    gap = scipy.stats.multivariate_normal(cov=J).logpdf(x)
    gap -= scipy.stats.multivariate_normal(cov=P).logpdf(x)
    assert penalty.value(pi) == pytest.approx(4 * gap.mean(), abs=5 * 4 * gap.std() / 447)
    pi[0] = -1.0
    assert penalty.value(pi) == np.inf


def test_a_prior_without_mass_is_widened_to_a_hundredth_of_its_size(prior, std):
    pi = prior.copy()
    pi[:10] = 0.0
    penalty = penalty_of(pi, std)
    assert 0.0 < penalty.centre[0] <= 0.011 * std[0]
    np.testing.assert_allclose(penalty.centre[10:], pi[10:], rtol=1e-13)
    assert np.isfinite(penalty.hessian(penalty.centre)).all()


def test_a_subspace_holds_what_the_equalities_say(rng):
    E = np.array([[1.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    space = Subspace.of(E, np.array([6.0, 2.0, 2.0]))
    for y in rng.standard_normal((5, space.basis.shape[1])):
        np.testing.assert_allclose(E @ (space.origin + space.basis @ y), [6.0, 2.0, 2.0])
    assert space.basis.shape == (4, 2)
    whole = np.hstack([space.basis, space.fixed])
    np.testing.assert_allclose(whole.T @ whole, np.eye(4), atol=1e-14)


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


def test_without_noise_a_redrawn_fit_is_the_fit_at_its_bounds(case, rng):
    fit, factors = case
    fit = constrained(fit, mass={"forearm_link": (1.2 * masses(fit.fit(factors))[2], np.inf)})
    found = fit.fit(factors)
    rows, b = fit.rows(factors, found.sigma), len(fit.K)
    moved, failures = fit.programme.redrawn(rows, 1.0, found.theta, np.zeros((b, b)), 0.0, 3, rng)
    assert found.details["active"] == ["mass forearm_link"]
    assert failures == []
    assert np.abs(moved / fit.prior_std).max() < 1e-6


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
        ({"mass": {"tool": (1.0, 2.0)}}, r"\['tool'\], which are not bodies of the model"),
        ({"mass": {"two": (3.0, 2.0)}}, r"\[3, 2\] kg: the first value is larger"),
        ({"mass": {"two": (-2.0, -1.0)}}, "is bounded by -1 kg, expected a positive"),
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


def test_a_prior_that_is_not_finite_is_refused(ur5, rng):
    case = Case(ur5, rng, NOISE)
    with pytest.raises(DataError, match="prior and held must be finite"):
        consistent(case, held=np.full(60, np.nan))


class Small:
    """Two bodies, 7 base parameters, 60 and 35 rows of two joints with noise of 0.3 and 2."""

    def __init__(self, rng):
        ball = np.array([1.0, 0.1, 0.2, -0.3, 0.4, 0, 0.4, 0, 0, 0.4])
        self.prior = np.concatenate([3 * ball, 5 * ball])
        self.std = np.linspace(0.03, 0.09, 20)
        self.K = rng.standard_normal((7, 20))
        truth = self.K @ (self.prior + 0.3 * self.std * rng.standard_normal(20))
        self.W = [rng.standard_normal((n, 7)) * np.linspace(1, 3, 7) for n in (60, 35)]
        self.tau = [
            W @ truth + x * rng.standard_normal(len(W))
            for W, x in zip(self.W, (0.3, 2.0), strict=True)
        ]
        rows = [np.column_stack(pair) for pair in zip(self.W, self.tau, strict=True)]
        names = tuple("abcdefg")
        triangles = tuple(triangle_of(x) for x in rows)
        self.factors = Factors(triangles, (np.arange(7),) * 2, np.array([60, 35]), names)
        self.fit = Consistent(
            ParameterLayout(("one", "two"), (), ()), self.K, self.prior, self.std,
            prior_weight=2.5, plausible_weight=0.5, independent_share=0.4,
        )  # fmt: skip

    def is_minimum(self, found, A, d):
        """Check slope and covariance of |A K pi - d|^2 plus 2.5 times the penalty."""
        D, penalty = A @ self.K, self.fit.programme.penalty
        data, own = D.T @ (D @ found.theta - d), 1.25 * penalty.gradient(found.theta)
        np.testing.assert_allclose(data, -own, atol=1e-6 * np.abs(own).max())
        H = D.T @ D + 1.25 * penalty.hessian(found.theta)
        np.testing.assert_allclose(found.covariance, np.linalg.inv(H), rtol=1e-7, atol=1e-12)


def test_all_that_a_fit_states_is_of_the_rows_with_the_noise_that_it_leaves(rng):
    case = Small(rng)
    found = case.fit.fit(case.factors)
    pairs = list(zip(case.W, case.tau, found.sigma, strict=True))
    A = np.vstack([np.sqrt(0.4) / x * W for W, _, x in pairs])
    d = np.concatenate([np.sqrt(0.4) / x * tau for _, tau, x in pairs])
    case.is_minimum(found, A, d)
    wls = WLS(case.K @ case.prior, 0.4).fit(case.factors)
    for (W, tau, sigma), level in zip(pairs, wls.sigma, strict=True):
        # of 0.4 independent rows, the parameters use the trace of their leverage
        used = np.trace(W @ wls.covariance @ W.T) / level**2
        left = np.sum((tau - W @ wls.theta) ** 2)
        assert sigma == pytest.approx(np.sqrt(left / (len(W) - used)), rel=1e-3)
    np.testing.assert_allclose(case.fit.noise(case.factors), found.sigma)
    penalty = case.fit.programme.penalty
    before = np.linalg.inv(0.25 * penalty.hessian(case.prior))  # at the plausible weight
    np.testing.assert_allclose(found.prior_std, np.sqrt(np.diag(before)))
    assert (found.rank, found.names) == (7, case.fit.layout.names)
    assert found.condition == pytest.approx(wls.condition, rel=5e-3)
    assert found.undetermined == ()
    assert found.details["prior"] == {"metric": "entropic", "weight": 2.5, "plausible_weight": 0.5}
    assert found.details["active"] == []


def test_a_projection_is_of_the_parameters_with_a_variance_and_the_prior(rng):
    case = Small(rng)
    half = rng.standard_normal((7, 7))
    C, beta = half @ half.T + np.eye(7), case.K @ case.prior + rng.standard_normal(7)
    C[2, 2] = np.inf
    own = np.delete(np.arange(7), 2)
    running = Estimate(beta, C, tuple("abcdefg"), np.ones(2), 6, 9.0, ("c",), True, 41, "rls")
    found = case.fit.project(running)
    root = np.linalg.cholesky(np.linalg.inv(C[np.ix_(own, own)])).T
    A = np.zeros((6, 7))
    A[:, own] = root
    case.is_minimum(found, A, root @ beta[own])
    assert (found.rank, found.condition, found.converged) == (6, 9.0, True)
    assert found.n_iter > 41
    expected = "rls; projected onto physically consistent parameters, interior"
    assert found.message.startswith(expected)
    assert "c" in found.undetermined
    with pytest.raises(DataError, match="the estimate has no covariance"):
        case.fit.project(replace(running, covariance=np.full((7, 7), np.inf)))
