from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from helpers.estimation import NOISE, Case

from robotid.base.exceptions import DataError, RankDeficientError
from robotid.dynamics.factors import Problem, Sample
from robotid.estimation.estimators import RLS, WLS, Kalman, fold

NAMES = ("a", "b", "c")


def test_rls_with_the_noise_levels_of_wls_is_wls(ur5, rng):
    case = Case(ur5, rng, NOISE)
    wls = WLS().fit(case.problem)
    ours = RLS(wls.sigma).fit(case.problem)
    np.testing.assert_allclose(ours.theta, wls.theta, rtol=1e-7, atol=1e-9)  # WLS iterates to 1e-8
    np.testing.assert_allclose(ours.std_error, wls.std_error, rtol=0.01)
    np.testing.assert_allclose(ours.sigma, wls.sigma, rtol=0.01)


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
    with pytest.raises(DataError, match="which needs prior and prior_std"):
        RLS(np.ones(2), 0.99)
    with pytest.raises(DataError, match="forgetting is 0"):
        RLS(np.ones(2), 0.0)


def samples_of_known(rng, count, sigma, theta=(1.0, -2.0, 0.5)):
    """Return samples of two rows, a fifth of which are left out, and all of them stacked."""
    Y = rng.standard_normal((count, 2, 3))
    tau = Y @ np.array(theta) + sigma * rng.standard_normal((count, 2))
    weight = np.where(rng.random((count, 2)) < 0.2, 0.0, rng.uniform(0.5, 2.0, (count, 2)))
    weight[:, 0] = np.maximum(weight[:, 0], 0.5)  # no sample is left out altogether
    return [Sample(*x) for x in zip(Y, tau, weight, strict=True)], Y, tau, weight


@pytest.mark.parametrize("forgetting", [0.9, 0.98])
def test_forgetting_weighs_sample_k_of_n_by_its_power(rng, forgetting):
    sigma = np.array([0.5, 0.1])
    samples, Y, tau, weight = samples_of_known(rng, 60, sigma)
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
    samples, Y, tau, weight = samples_of_known(rng, 20, sigma)
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


def test_few_samples_are_refused_with_forgetting_too(rng):
    _, Y, tau, weight = samples_of_known(rng, 1, np.ones(2))
    problem = Problem(
        lambda: iter([(Y[0], tau[0], weight[0])]), NAMES, 2, np.ones((2, 3), dtype=bool)
    )
    with pytest.raises(DataError, match="2 torque rows for 3 parameters"):
        RLS(np.ones(2), 0.9, np.zeros(3), np.ones(3)).fit(problem)
    one = np.array([1.0, 0.0])  # only the first joint moves, in each of two samples
    problem = replace(problem, stream=lambda: iter([(Y[0], tau[0], one)] * 2))
    with pytest.raises(DataError, match="2 torque rows for 3 parameters"):
        RLS(np.ones(2), 1.0, np.zeros(3), np.ones(3)).fit(problem)


@pytest.mark.parametrize("share", [1.0, 0.25])
def test_the_gate_is_chi_squares_bound_on_the_innovation(share):
    sigma, std, gate = np.array([0.5, 0.2]), np.array([0.3, 1.0]), 0.95
    ours = Kalman(sigma, np.zeros(2), std, gate=gate, independent_share=share)
    Y, weight = np.array([[1.0, 2.0], [-1.0, 0.5]]), np.array([1.0, 4.0])
    variance = ((Y * std) ** 2).sum(axis=1) + sigma**2 / share / weight
    edge = np.sqrt(scipy.stats.chi2.ppf(gate, 1) * variance)
    for factor, turned_away in ((0.999, [0, 0]), (1.001, [1, 1])):
        state = ours.update(ours.init(2), Sample(Y, factor * edge, weight))
        np.testing.assert_array_equal(state.gated, turned_away)
    # one joint alone, of either sign
    state = ours.update(ours.init(2), Sample(Y, edge * [-1.001, -0.999], weight))
    np.testing.assert_array_equal(state.gated, [1, 0])
    np.testing.assert_array_equal(state.rows, [0, 1])


def test_after_fifty_rows_turned_away_the_next_is_believed():
    sure = Kalman(np.ones(1), np.zeros(1), np.full(1, 1e-3))
    far = Sample(np.ones((1, 1)), np.full(1, 100.0), np.ones(1))
    state = fold(sure, [far] * 50, sure.init(1))
    assert (state.gated[0], state.rows[0], state.theta[0]) == (50, 0, 0.0)
    state = sure.update(state, far)
    assert (state.gated[0], state.rows[0], state.in_a_row[0]) == (50, 1, 0)
    assert state.theta[0] == pytest.approx(100.0 * 1e-6 / (1 + 1e-6))


def test_two_steps_of_weighted_rows_are_bayes_rule_with_the_noise_of_each_joint(rng):
    """All that a state and its estimate state, against the update in information form."""
    sigma, share, std = np.array([0.5, 3.0]), 0.4, np.array([2.0, 0.3, 7.0])
    kalman = Kalman(sigma, np.array([1.0, -2.0, 0.5]), std, 0.1, None, share)
    state, theta, P = kalman.init(3), kalman.prior, np.diag(std**2)
    products, rows = np.zeros(2), np.zeros(2, dtype=int)
    for weight in np.array([[0.25, 1.7], [3.0, 0.0]]):
        Y, tau = rng.standard_normal((2, 3)), 5.0 * rng.standard_normal(2)
        state = kalman.update(state, Sample(Y, tau, weight))
        used = weight > 0
        precision = (weight * share / sigma**2)[used]
        P = P + np.diag((0.1 * std) ** 2)
        e, A = tau[used] - Y[used] @ theta, Y[used]
        P = np.linalg.inv(np.linalg.inv(P) + A.T @ (precision[:, None] * A))
        theta = theta + P @ A.T @ (precision * e)
        products[used] += e * (tau[used] - A @ theta)
        rows += used
    np.testing.assert_allclose(state.theta, theta, rtol=1e-9)
    np.testing.assert_allclose(state.P, P, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(state.products, products, rtol=1e-9)
    np.testing.assert_array_equal([state.rows, state.gated], [rows, [0, 0]])
    found = kalman.estimate(state, NAMES)
    np.testing.assert_allclose(found.sigma, np.sqrt(np.maximum(products, 0.0) / rows))
    ratio = np.linalg.svd(np.linalg.cholesky(P / np.outer(std, std)), compute_uv=False)
    assert found.condition == pytest.approx(ratio[0] / ratio[-1])
    assert found.rank == np.sum(ratio < 0.9)
    after = np.sqrt(np.diag(P)) / std
    assert found.undetermined == tuple(np.array(NAMES)[after > 0.9].tolist())
    assert found.n_iter == 2
    assert found.message == f"2 samples, 0 rows rejected by the gate, {rows.sum()} used"
