import numpy as np
import pytest
from helpers.estimation import NOISE, Case, consistent, still_wrist

from robotid.estimators import PRX, RLS, WLS, Kalman, fold
from robotid.exceptions import DataError, NotConvergedError
from robotid.robot.parameters import pseudo_inertia


def test_consistent_fit_names_what_it_took_from_the_prior(ur5, rng):
    case = still_wrist(ur5, rng)
    assert "wrist_3_joint.viscous" in consistent(case).fit(case.problem).undetermined


def test_consistent_fit_is_physical_where_least_squares_is_not(ur5, rng):
    case = Case(ur5, rng, 40 * NOISE, samples=200)
    free = case.mapping.to_standard(WLS().fit(case.problem).theta, ur5.standard_parameters())
    assert np.linalg.eigvalsh(pseudo_inertia(free[:60])).min() < 0
    estimate = consistent(case).fit(case.problem)
    assert np.linalg.eigvalsh(pseudo_inertia(estimate.theta[:60])).min() > 0
    assert (estimate.theta[ur5.layout.is_nonnegative()] >= 0).all()


def test_consistent_fit_agrees_with_wls_where_physics_does_not_bind(ur5, rng):
    case = Case(ur5, rng, 0.01 * NOISE, samples=2000)
    wls, ours = WLS().fit(case.problem), consistent(case).fit(case.problem)
    difference = np.abs(case.base(ours) - wls.theta) / wls.std_error
    assert difference.max() < 1.0


def test_the_held_share_of_a_body_is_respected(ur5, rng):
    case = Case(ur5, rng, NOISE)
    held = np.zeros(60)
    # the last link is known to carry a 5 kg part, more than it has: the rest must stay possible
    held[50:] = [5.0, 0, 0, 0, 0.05, 0, 0.05, 0, 0, 0.05]
    estimate = consistent(case, held=held).fit(case.problem)
    rest = pseudo_inertia(estimate.theta[:60] - held)
    assert np.linalg.eigvalsh(rest).min() > 0
    assert estimate.theta[50] > 5.0


def test_a_solver_that_fails_says_so(ur5, rng):
    case = Case(ur5, rng, 40 * NOISE, samples=200)
    with pytest.raises(NotConvergedError, match="Clarabel failed to solve") as caught:
        consistent(case, max_iterations=1).fit(case.problem)
    assert caught.value.status == "MaxIterations"


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
