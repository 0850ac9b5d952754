"""Spreads on a grid against dense matrices and coverage; draws against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from robotid.estimation.variation.spread import (
    Mixture,
    Runs,
    SpreadModel,
    _alone,
    correlated_scores,
    possible_draws,
    root_of,
    scores_to_values,
)
from robotid.estimation.variation.variation import shrunk_correlation

Z = np.linspace(-6.0, 5.0, 45)


def alone(x, error, unit=None, scale=0.3):
    """Return runs of one parameter with estimates x and their standard errors."""
    H = np.broadcast_to(np.asarray(error, float) ** -2.0, np.shape(x))
    unit = np.zeros(len(x), int) if unit is None else np.asarray(unit)
    return Runs(H[:, None, None], (H * x)[:, None], unit, np.array([scale]))


def drawn(rng, unit, between, *, rows=12):
    """Return runs of two correlated parameters, which vary by run and unit as ``between``."""
    of_unit, H, h = between[1] * rng.normal(size=(max(unit) + 1, 2)), [], []
    for u in unit:
        A = rng.normal(size=(rows, 2)) @ np.array([[1.0, 0.7], [0.0, 0.6]])
        x = np.array([2.0, -1.0]) + of_unit[u] + between[0] * rng.normal(size=2)
        H.append(A.T @ A)
        h.append(A.T @ (A @ x + rng.normal(size=rows)))
    return Runs(np.array(H), np.array(h), np.asarray(unit), np.array([0.2, 0.5]))


def dense(x, error, unit):
    """Return the posterior by covariance matrices of all runs, at each spread of runs and units."""
    # Weight, mean of mu, its variance, expected x and their variances (k,), variances of the
    # spread.
    several = max(unit) > 0
    within = (0.3 * np.exp(Z[::2])) ** 2 if several else np.zeros(1)
    grid = np.meshgrid(within, (0.3 * np.exp(Z)) ** 2, indexing="ij")
    d_run, d_unit = (variance.ravel() for variance in grid)
    eye = np.eye(len(x))
    shared = np.equal.outer(unit, unit) if several else eye
    G = d_run[:, None, None] * eye + d_unit[:, None, None] * shared
    W = np.linalg.inv(G + np.diag(error**2))
    P = W.sum(axis=(1, 2)) + (100 * 0.3) ** -2.0
    mean = W.sum(axis=1) @ x / P
    size = np.linalg.slogdet(W)[1] - np.log(P) - W @ x @ x + P * mean**2
    s = np.sqrt([d_unit, *([d_run] if several else [])]) / 0.3
    log = 0.5 * size + np.log(s * scipy.stats.t(4).pdf(s)).sum(axis=0)
    left = 1 - (G @ W).sum(axis=2)
    values = mean[:, None] + np.einsum("gij,gj->gi", G @ W, x - mean[:, None])
    errors = np.diagonal(G - G @ W @ G, axis1=1, axis2=2) + left**2 / P[:, None]
    weight = np.exp(log - max(log))
    return weight / weight.sum(), mean, 1 / P, values, errors, d_run, d_unit


@pytest.mark.parametrize("unit", [(0, 0, 0, 0, 0), (0, 0, 1, 1, 1, 2, 2, 3)])
def test_one_parameter_is_integrated_as_by_dense_matrices(unit):
    rng, unit = np.random.default_rng(4), np.array(unit)
    x = 2.0 + 0.3 * rng.normal(size=len(unit)) + 0.5 * unit
    error = np.array([0.2, 0.5, 0.3, 0.2, 0.4, 0.1, 0.3, 0.6])[: len(unit)]
    model = SpreadModel(alone(x, error, unit))
    (found,) = model.predict()
    weight, mean, variance, values, errors, d_run, d_unit = dense(x, error, unit)
    centre = weight @ mean
    near = {"rel": 1e-3}  # the prior of the mean is about the centre of the runs, here about 0
    assert found.mean == pytest.approx(centre, **near)
    square = weight @ (variance + (mean - centre) ** 2)
    assert found.std_error == pytest.approx(np.sqrt(square), **near)
    std = np.sqrt(variance + d_run + d_unit)
    for end, share in zip(found.ends, (0.025, 0.975), strict=True):
        assert weight @ scipy.stats.norm.cdf((end - mean) / std) == pytest.approx(share, abs=1e-4)
    expected = weight @ values
    np.testing.assert_allclose(model.values[0][:, 0], expected, rtol=1e-3)
    spread_of = np.sqrt(weight @ (errors + (values - expected) ** 2))
    np.testing.assert_allclose(model.values[1][:, 0], spread_of, rtol=1e-3)
    below = [weight[d_unit < s**2 * 1.0001].sum() for s in (*found.spread_ends, found.spread)]
    np.testing.assert_allclose(below, [0.025, 0.975, 0.5], atol=0.1)  # a step of the grid
    if max(unit):
        assert weight[d_run < found.within**2 * 1.0001].sum() == pytest.approx(0.5, abs=0.12)


@pytest.mark.parametrize("unit", [(0,) * 7, (0, 0, 0, 1), (0, 0, 1, 1, 1, 2, 3)])
@pytest.mark.parametrize("is_unit", [False, True])
def test_each_is_compared_with_the_others_as_if_it_had_never_been(unit, is_unit):
    if is_unit and len(set(unit)) < 3:
        return
    rng, unit = np.random.default_rng(11), np.array(unit)
    x, error = rng.normal(size=len(unit)), 0.2 + rng.random(len(unit))
    count = max(unit) + 1 if is_unit else len(unit)
    model = SpreadModel(alone(x, error, unit))
    compared = model.against_others(np.arange(count)[::-1], is_unit=is_unit)
    for k in range(count):
        is_out = unit == k if is_unit else np.arange(len(unit)) == k
        row = count - 1 - k
        variance = 1 / (error[is_out] ** 2 + (model.deviation[0] ** 2 if is_unit else 0.0))
        wanted = 1 / (variance.sum() + (100 * 0.3) ** -2.0)
        assert compared.covariance[row] == pytest.approx(wanted)
        assert compared.values[row] == pytest.approx(wanted * (variance @ x[is_out]))
        left = np.unique(unit[~is_out], return_inverse=True)[1]
        if max(unit) and not max(left):
            continue  # one unit is left: the grid still has both levels
        weight, mean, variance, *_, d_run, d_unit = dense(x[~is_out], error[~is_out], left)
        spread = d_unit + (0.0 if is_unit else d_run)
        expected = Mixture(weight, mean, np.sqrt(variance + spread + wanted))
        for value in (-1.0, 0.4):
            below = compared.mixture.at((row, 0)).below(np.array(value))
            assert below == pytest.approx(expected.below(np.array(value)), abs=1e-4)


def test_a_run_that_tells_nothing_of_a_parameter_changes_nothing():
    runs = drawn(np.random.default_rng(5), [0] * 4, np.full((2, 2), 0.2))
    H, h = np.append(runs.H, np.zeros((1, 2, 2)), axis=0), np.append(runs.h, [[0.0, 0.0]], axis=0)
    more = Runs(H, h, np.zeros(5, int), runs.scale)
    for one, two in zip(SpreadModel(runs).predict(), SpreadModel(more).predict(), strict=True):
        assert one.ends == pytest.approx(two.ends)
        assert (one.mean, one.spread) == pytest.approx((two.mean, two.spread))
    assert SpreadModel(more.without(4)).runs.h.tolist() == runs.h.tolist()


def test_one_parameter_alone_has_the_others_integrated_out_of_each_run():
    runs, spread = drawn(np.random.default_rng(8), [0] * 3, np.ones((2, 2))), np.array([0.3, 0.8])
    for p in (0, 1):
        W, w = _alone(runs.H, runs.h, spread, p)
        prior = np.diag(np.where(np.arange(2) == p, 0.0, spread**-2.0))
        C = np.linalg.inv(runs.H + prior)
        np.testing.assert_allclose(W, 1.0 / C[:, p, p])
        np.testing.assert_allclose(w / W, np.einsum("ki,ki->k", C[:, p], runs.h))


def test_the_mean_of_alike_runs_has_the_error_of_their_joint_fit():
    """Correlated parameters with a small spread: the means of the others count."""
    runs = drawn(np.random.default_rng(3), [0] * 8, np.zeros((2, 2)))
    runs = replace(runs, scale=np.full(2, 0.05))
    C = np.linalg.inv(runs.H.sum(axis=0))
    mean = C @ runs.h.sum(axis=0)
    for p, found in enumerate(SpreadModel(runs).predict()):
        assert found.std_error == pytest.approx(np.sqrt(C[p, p]), rel=0.1)
        assert found.mean == pytest.approx(mean[p], abs=0.2 * np.sqrt(C[p, p]))


def test_one_more_run_narrows_intervals_as_much_as_expected():
    rng, expected, found = np.random.default_rng(5), [], []
    for _ in range(40):
        x = 0.4 * rng.normal(size=7) + 0.1 * rng.normal(size=7)
        (before,) = SpreadModel(alone(x[:6], 0.1)).predict()
        (after,) = SpreadModel(alone(x, 0.1)).predict()
        expected.append((before.after[0] / before.std_error, before.after[1] / np.ptp(before.ends)))
        found.append((after.std_error / before.std_error, np.ptp(after.ends) / np.ptp(before.ends)))
    wanted = np.mean(np.log(expected), axis=0)
    assert np.mean(np.log(found), axis=0) == pytest.approx(wanted, abs=0.05)


def test_quantiles_and_probabilities_are_those_of_the_mixture():
    weight, mean, std = np.array([0.3, 0.7]), np.array([1.0, 2.0]), np.array([0.5, 3.0])
    mixture = Mixture(weight, mean, std)
    below = scipy.stats.norm.cdf([-2.0, 0.0, 1.5])
    values = mixture.quantiles(below)
    cdf = (weight * scipy.stats.norm.cdf((values[:, None] - mean) / std)).sum(axis=1)
    assert cdf == pytest.approx(below)
    share = weight @ scipy.stats.norm.sf((9.0 - mean) / std)
    assert mixture.beyond(np.array(9.0)) == pytest.approx(2 * share)
    assert mixture.beyond(mixture.quantiles(np.array([0.5]))) == pytest.approx(1.0)


def test_the_root_keeps_well_determined_sums_of_badly_scaled_parameters():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(5, 3)) * np.array([[1e3], [1.0], [1e-4], [2.0], [0.0]])
    C = A @ A.T
    L = root_of(C)
    assert np.triu(L, 1).tolist() == np.zeros((5, 5)).tolist()
    scale = np.sqrt(np.outer(np.diag(C), np.diag(C)))
    assert np.abs(L @ L.T - C).max(initial=0, where=scale > 0) <= 1e-9 * scale.max()
    assert (L @ L.T)[1:4, 1:4] == pytest.approx(C[1:4, 1:4], rel=1e-9)
    assert L[4].tolist() == [0.0] * 5
    # a sum that is known a thousand times better than its parts
    D = np.array([[1.0, -1.0 + 5e-7], [-1.0 + 5e-7, 1.0]])
    L = root_of(D)
    assert np.array([1.0, 1.0]) @ L @ L.T @ np.array([1.0, 1.0]) == pytest.approx(1e-6, rel=1e-4)


def test_draws_are_those_of_a_normal_distribution_given_that_they_are_possible():
    L = np.array([[1.0, 0.0], [0.8, 0.5]])

    def is_possible(x):
        return (x[:, 0] > -0.3) & (x[:, 0] + 2.0 * x[:, 1] < 1.5)

    drawn = possible_draws(L, is_possible, 4000, np.random.default_rng(1))
    every = np.random.default_rng(2).standard_normal((200_000, 2)) @ L.T
    wanted = every[is_possible(every)]
    assert is_possible(drawn).all()
    assert drawn.mean(axis=0) == pytest.approx(wanted.mean(axis=0), abs=0.03)
    assert np.cov(drawn.T) == pytest.approx(np.cov(wanted.T), abs=0.03)
    for p in range(2):
        assert scipy.stats.ks_2samp(drawn[:, p], wanted[:, p]).pvalue > 1e-3


def test_values_at_scores_are_quantiles_given_the_smallest_value():
    scores = np.linspace(-3.5, 3.5, 15)
    quantiles = 2.0 + 1.5 * scores
    z = np.array([-4.0, -1.0, 0.3, 5.0])
    assert scores_to_values(z, scores, quantiles, -np.inf) == pytest.approx(2.0 + 1.5 * z)
    wanted = scipy.stats.truncnorm(-2.0 / 1.5, np.inf, 2.0, 1.5).ppf(scipy.stats.norm.cdf(z[1:]))
    assert scores_to_values(z[1:], scores, quantiles, 0.0) == pytest.approx(wanted, rel=1e-6)
    bent = np.where(scores > 0, 3.0, 1.0) * scores
    assert scores_to_values(np.array([-0.25, 0.25, 4.5]), scores, bent, -np.inf) == pytest.approx(
        [-0.25, 0.75, 13.5]
    )


def test_scores_of_a_run_share_the_error_of_the_mean():
    rng = np.random.default_rng(3)
    R = np.array([[1.0, 0.6], [0.6, 1.0]])
    first = rng.standard_normal((40_000, 2)) @ np.linalg.cholesky([[1, -0.9], [-0.9, 1]]).T
    share = np.array([0.25, 0.64])
    z = correlated_scores(first, share, R, rng.standard_normal((40_000, 2)))
    wanted = 0.5 * 0.8 * -0.9 + np.sqrt(0.75 * 0.36) * 0.6
    assert np.cov(z.T) == pytest.approx(np.array([[1.0, wanted], [wanted, 1.0]]), abs=0.03)
    assert np.mean(z[:, 0] * first[:, 0]) == pytest.approx(0.5, abs=0.03)


def test_correlation_is_shrunk_by_its_uncertainty():
    rng = np.random.default_rng(4)
    x = rng.normal(size=(6, 3)) @ np.array([[1.0, 0.5, 0.0], [0.0, 2.0, 0.1], [0.0, 0.0, 3.0]])
    z = (x - x.mean(axis=0)) / x.std(axis=0, ddof=1)
    left = []
    for i in range(3):
        above = below = 0.0
        for j in range(3):
            if i != j:
                r = z[:, i] @ z[:, j] / 5
                above += (1 - r**2) ** 2 / 5 * 35 / 24  # 35 / 24: k = 6
                below += r**2
        left.append(np.sqrt(1 - min(above / below, 1.0)))
    assert len({round(a, 3) for a in left}) == 3  # a factor for each parameter
    wanted = np.outer(left, left) * np.corrcoef(x.T)
    expected = wanted - np.diag(np.diag(wanted))
    assert shrunk_correlation(x) - np.eye(3) == pytest.approx(expected, abs=2e-3)
    true = np.array([[1.0, 0.7], [0.7, 1.0]])
    many = rng.multivariate_normal([5.0, -2.0], true, 5000) * np.array([1e-3, 40.0])
    assert shrunk_correlation(many) == pytest.approx(true, abs=0.03)
    few = [shrunk_correlation(rng.normal(size=(4, 8))) for _ in range(40)]
    off = [np.abs(R[~np.eye(8, dtype=bool)]).mean() for R in few]
    assert np.mean(off) < 0.2  # 0.45 without shrinkage
    assert min(np.linalg.eigvalsh(R).min() for R in few) > 0
    # a constant parameter has no correlation, and leaves those of the others
    x[:, 1] = 2.0
    wanted = np.insert(np.insert(shrunk_correlation(x[:, [0, 2]]), 1, 0.0, 0), 1, 0.0, 1)
    wanted[1, 1] = 1.0
    assert shrunk_correlation(x) == pytest.approx(wanted)
    assert shrunk_correlation(x[:2]) == pytest.approx(np.eye(3))  # r is 1 or -1 for any two runs
