import numpy as np
import pytest
from helpers.estimation import NOISE, Case

from robotid.estimators import OLS, RLS, WLS, fold
from robotid.exceptions import DataError, RankDeficientError
from robotid.regressor.problem import Problem, Sample

NAMES = ("a", "b", "c")


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


def random_samples(rng, count, sigma, theta=(1.0, -2.0, 0.5)):
    """Return samples of two rows, a fifth of which are left out, and all of them stacked."""
    Y = rng.standard_normal((count, 2, 3))
    tau = Y @ np.array(theta) + sigma * rng.standard_normal((count, 2))
    weight = np.where(rng.random((count, 2)) < 0.2, 0.0, rng.uniform(0.5, 2.0, (count, 2)))
    weight[:, 0] = np.maximum(weight[:, 0], 0.5)  # no sample is left out altogether
    return [Sample(*x) for x in zip(Y, tau, weight, strict=True)], Y, tau, weight


@pytest.mark.parametrize("forgetting", [0.9, 0.98])
def test_forgetting_weighs_sample_k_of_n_by_its_power(rng, forgetting):
    sigma = np.array([0.5, 0.1])
    samples, Y, tau, weight = random_samples(rng, 60, sigma)
    ours = RLS(sigma, forgetting, np.zeros(3), np.full(3, 1e6))
    state = fold(ours, samples, ours.init(3))
    age = forgetting ** np.arange(59.0, -1, -1)
    w = (age[:, None] * weight / sigma**2).reshape(-1)
    W, d = Y.reshape(-1, 3), tau.reshape(-1)
    H = W.T @ (w[:, None] * W)
    theta = np.linalg.solve(H, W.T @ (w * d))
    estimate = ours.estimate(state, NAMES)
    np.testing.assert_allclose(estimate.theta, theta, rtol=1e-9)
    # the common factor of the noise levels: weighted squares over weighted rows less c
    rows = (age[:, None] * (weight > 0)).sum()
    assert state.rows == pytest.approx(rows, rel=1e-12)
    scale = np.sqrt((w @ (d - W @ theta) ** 2) / (rows - 3))
    np.testing.assert_allclose(estimate.sigma, scale * sigma, rtol=1e-8)
    np.testing.assert_allclose(estimate.covariance, scale**2 * np.linalg.inv(H), rtol=1e-8)


def test_each_step_renews_what_a_round_forgets_of_one_parameters_prior(rng):
    sigma, forgetting, prior = np.ones(2), 0.9, np.array([1.0, 2.0, 3.0])
    std = np.array([0.5, 1.0, 2.0])
    samples, Y, tau, weight = random_samples(rng, 20, sigma)
    ours = RLS(sigma, forgetting, prior, std)
    state = fold(ours, samples, ours.init(3))
    L, eta = np.diag(std**-2.0), prior / std**2
    for k in range(20):
        W = np.sqrt(weight[k])[:, None] * Y[k]
        renewed = np.zeros(3)
        renewed[k % 3] = (1 - forgetting**3) / std[k % 3] ** 2
        L = forgetting * L + W.T @ W + np.diag(renewed)
        eta = forgetting * eta + W.T @ (np.sqrt(weight[k]) * tau[k]) + renewed * prior
    np.testing.assert_allclose(state.R[:3, :3].T @ state.R[:3, :3], L, rtol=1e-12)
    estimate = ours.estimate(state, NAMES)
    np.testing.assert_allclose(estimate.theta, np.linalg.solve(L, eta), rtol=1e-10)


@pytest.mark.parametrize("share", [1.0, 0.2])
def test_without_forgetting_sigma_has_n_minus_c_degrees_of_freedom(rng, share):
    sigma = np.array([0.5, 0.1])
    samples, Y, tau, weight = random_samples(rng, 12, sigma)
    ours = RLS(sigma, independent_share=share)
    estimate = ours.estimate(fold(ours, samples, ours.init(3)), NAMES)
    used = weight.reshape(-1) > 0
    root = (np.sqrt(weight) / sigma).reshape(-1)[used]
    W, d = root[:, None] * Y.reshape(-1, 3)[used], root * tau.reshape(-1)[used]
    theta, squares, *_ = np.linalg.lstsq(W, d, rcond=None)
    variance = squares[0] / (len(d) - 3)
    np.testing.assert_allclose(estimate.theta, theta, rtol=1e-9)
    np.testing.assert_allclose(estimate.sigma, np.sqrt(variance) * sigma, rtol=1e-9)
    expected = variance / share * np.linalg.inv(W.T @ W)
    np.testing.assert_allclose(estimate.covariance, expected, rtol=1e-8)
    np.testing.assert_allclose(estimate.std_error, np.sqrt(np.diag(expected)), rtol=1e-8)


def test_few_samples_are_refused_with_forgetting_too(rng):
    _, Y, tau, weight = random_samples(rng, 1, np.ones(2))
    problem = Problem(
        lambda: iter([(Y[0], tau[0], weight[0])]), NAMES, 2, np.ones((2, 3), dtype=bool)
    )
    with pytest.raises(DataError, match="2 torque rows for 3 parameters"):
        RLS(np.ones(2), 0.9, np.zeros(3), np.ones(3)).fit(problem)
