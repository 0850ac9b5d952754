import numpy as np
import pytest
from helpers.estimation import NOISE, Case, consistent

from robotid.base.exceptions import DataError
from robotid.dynamics.factors import Factors, triangle_of
from robotid.estimation.estimators import PRX, RLS, WLS, Consistent, Kalman, fold
from robotid.estimation.estimators.estimator import Estimate
from robotid.robot.parameters import ParameterLayout, pseudo_inertia


def test_consistent_fit_is_physical_where_least_squares_is_not(ur5, rng):
    case = Case(ur5, rng, 40 * NOISE, samples=200)
    free = case.mapping.to_standard(WLS().fit(case.problem).theta, ur5.standard_parameters())
    assert np.linalg.eigvalsh(pseudo_inertia(free[:60])).min() < 0
    estimate = consistent(case).fit(case.problem)
    assert np.linalg.eigvalsh(pseudo_inertia(estimate.theta[:60])).min() > 0
    assert (estimate.theta[ur5.layout.is_nonnegative()] >= 0).all()


def test_the_held_share_of_a_body_is_respected(ur5, rng):
    case = Case(ur5, rng, NOISE)
    held = np.zeros(60)
    # the last link is known to carry a 5 kg part, more than it has: the rest must stay possible
    held[50:] = [5.0, 0, 0, 0, 0.05, 0, 0.05, 0, 0, 0.05]
    estimate = consistent(case, held=held).fit(case.problem)
    rest = pseudo_inertia(estimate.theta[:60] - held)
    assert np.linalg.eigvalsh(rest).min() > 0
    assert estimate.theta[50] > 5.0


def test_a_prior_that_is_not_finite_is_refused(ur5, rng):
    case = Case(ur5, rng, NOISE)
    with pytest.raises(DataError, match="prior and held must be finite"):
        consistent(case, held=np.full(60, np.nan))


@pytest.mark.parametrize("kind", ["rls", "kalman"])
def test_the_running_estimate_can_be_made_physical(ur5, rng, kind):
    case = Case(ur5, rng, 40 * NOISE, samples=200)
    prior = case.mapping.to_base(ur5.standard_parameters())
    sigma = 40 * NOISE
    estimator = RLS(sigma) if kind == "rls" else Kalman(sigma, prior, 50 + 0 * prior, gate=None)
    state = fold(estimator, case.problem.samples(), estimator.init(len(prior)))
    running = estimator.estimate(state, case.problem.names)
    free = case.mapping.to_standard(running.theta, ur5.standard_parameters())
    assert np.linalg.eigvalsh(pseudo_inertia(free[:60])).min() < 0
    projected = consistent(case).project(running)
    assert np.linalg.eigvalsh(pseudo_inertia(projected.theta[:60])).min() > 0
    assert "projected onto physically consistent" in projected.message


def test_projection_is_the_consistent_fit_of_the_same_data(ur5, rng):
    case = Case(ur5, rng, 4 * NOISE)
    wls = WLS().fit(case.problem)
    fit = consistent(case).fit(case.problem)
    projected = consistent(case).project(wls)
    distance = np.abs(case.base(projected) - case.base(fit)) / wls.std_error
    assert distance.max() < 1e-3
    nothing = PRX(np.ones(6)).estimate(PRX(np.ones(6)).init(58), case.problem.names)
    with pytest.raises(DataError, match="the estimate has no covariance"):
        consistent(case).project(nothing)


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
    assert found.message.startswith(
        "rls; projected onto physically consistent parameters, interior"
    )
    assert "c" in found.undetermined
