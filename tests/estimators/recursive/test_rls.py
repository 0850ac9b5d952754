import numpy as np
import pytest
from helpers.estimation import NOISE, Case

from robotid.estimators import OLS, RLS, WLS
from robotid.exceptions import DataError, RankDeficientError
from robotid.regressor.problem import Problem, Sample


def test_rls_without_forgetting_is_ols_after_the_last_sample(ur5, rng):
    case = Case(ur5, rng, NOISE)
    ours, ols = RLS(np.ones(6)).fit(case.problem), OLS().fit(case.problem)
    np.testing.assert_allclose(ours.theta, ols.theta, rtol=1e-9, atol=1e-11)


def test_rls_with_the_noise_levels_of_wls_is_wls(ur5, rng):
    case = Case(ur5, rng, NOISE)
    wls = WLS().fit(case.problem)
    ours = RLS(wls.sigma).fit(case.problem)
    np.testing.assert_allclose(ours.theta, wls.theta, rtol=1e-7, atol=1e-9)  # WLS iterates to 1e-8
    np.testing.assert_allclose(ours.std_error, wls.std_error, rtol=0.01)
    np.testing.assert_allclose(ours.sigma, wls.sigma, rtol=0.01)


def test_forgetting_does_not_wind_up_where_nothing_moves():
    # one sample over and over: with forgetting 0.95 the rest would be forgotten after a second
    rng, c = np.random.default_rng(0), 12
    prior, std = np.arange(1.0, c + 1), np.full(c, 2.0)
    estimator = RLS(np.ones(2), 0.95, prior, std)
    state = estimator.init(c)
    Y = np.zeros((2, c))
    Y[:, :2] = [[1.0, 0.5], [0.0, 1.0]]
    truth = np.array([3.0, -1.0])
    for _ in range(100_000):
        tau = Y[:, :2] @ truth + 1e-3 * rng.standard_normal(2)
        state = estimator.update(state, Sample(Y, tau, np.ones(2)))
    assert np.isfinite(state.R).all()
    smallest = np.linalg.svd(state.R[:c, :c], compute_uv=False)[-1]
    assert smallest > 0.5 * 0.95 ** (c / 2) / 2.0  # the floor, forgetting^(c/2) / prior_std
    estimate = estimator.estimate(state, tuple("abcdefghijkl"))
    np.testing.assert_allclose(estimate.theta[:2], truth, atol=0.05)
    np.testing.assert_allclose(estimate.theta[2:], prior[2:], atol=1e-9)
    # and the first jump that comes is taken calmly
    jump = estimator.update(state, Sample(np.ones((2, c)), np.full(2, prior.sum()), np.ones(2)))
    assert np.abs(estimator.estimate(jump, tuple("abcdefghijkl")).theta).max() < 50


def test_what_rls_was_not_shown_is_refused_by_name_or_keeps_its_prior():
    rng, names = np.random.default_rng(0), ("a", "b", "c")
    W = rng.standard_normal((40, 3))
    W[:, 2] = 0.0
    block = (W, W @ [1.0, 2.0, 3.0], np.ones(40))
    problem = Problem(lambda: iter([block]), names, 2, np.ones((2, 3), dtype=bool))
    with pytest.raises(RankDeficientError, match="undetermined"):
        RLS(np.ones(2)).fit(problem)
    kept = RLS(np.ones(2), prior=np.full(3, 7.0)).fit(problem)
    np.testing.assert_allclose(kept.theta, [1.0, 2.0, 7.0])
    assert kept.undetermined == ("c",)
    assert np.isinf(kept.std_error[2])
    with pytest.raises(DataError, match="give prior and prior_std"):
        RLS(np.ones(2), 0.99)
    with pytest.raises(DataError, match="forgetting is 0"):
        RLS(np.ones(2), 0.0)
