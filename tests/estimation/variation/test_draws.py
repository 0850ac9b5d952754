"""Draws against rejection sampling, closed forms and truncated normal distributions."""

import numpy as np
import pytest
import scipy.stats

from robotid.estimation.variation.spread import (
    correlated_scores,
    possible_draws,
    root_of,
    scores_to_values,
)
from robotid.estimation.variation.variation import shrunk_correlation


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
    again = possible_draws(L, is_possible, 50, np.random.default_rng(1))
    assert again.tolist() == possible_draws(L, is_possible, 50, np.random.default_rng(1)).tolist()


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
    assert shrunk_correlation(x) - np.eye(3) == pytest.approx(
        wanted - np.diag(np.diag(wanted)), abs=2e-3
    )
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
