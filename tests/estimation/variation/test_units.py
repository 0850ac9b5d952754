"""Variation of a parameter between many units, and units that differ."""

import numpy as np
import pytest
import scipy.stats

from robotid.estimation.variation.variation import between_units


def test_mean_spread_and_next_interval_of_precise_values_are_those_of_the_sample():
    rng = np.random.default_rng(2)
    x = 4.0 + 0.6 * rng.normal(size=60)
    prediction, unlike = between_units(x, np.full(60, 1e-4), 1e-6)
    assert unlike == ()
    assert prediction.mean == pytest.approx(x.mean(), rel=1e-4)
    assert prediction.spread == pytest.approx(np.std(x, ddof=1), rel=0.05)
    half = scipy.stats.t.ppf(0.975, 59) * np.std(x, ddof=1) * np.sqrt(1 + 1 / 60)
    expected = [x.mean() - half, x.mean() + half]
    np.testing.assert_allclose(prediction.ends, expected, atol=0.06)


def test_units_that_differ_are_named_and_left_out_of_the_prediction():
    rng = np.random.default_rng(5)
    x = -2.0 + 0.1 * rng.normal(size=30)
    alike, _ = between_units(x, np.full(30, 0.02), 1e-4)
    x[[7, 20]] += [-3.0, 1.5]
    prediction, unlike = between_units(x, np.full(30, 0.02), 1e-4)
    assert [k for k, _ in unlike] == [20, 7]  # the most unlikely first, found last
    assert unlike[0][1] < 1e-3 * unlike[1][1]
    assert all(p < 1e-4 for _, p in unlike)
    assert prediction.mean == pytest.approx(alike.mean, abs=0.03)
    np.testing.assert_allclose(prediction.ends, alike.ends, atol=0.06)


def test_a_precise_value_within_the_spread_does_not_hide_one_that_differs():
    x = -2.0 + 0.1 * np.random.default_rng(8).normal(size=12)
    x[[2, 9]] = -1.9, -1.0
    errors = np.full(12, 0.02)
    errors[2] = 1e-3  # 100 standard errors from the median, and one spread
    assert [k for k, _ in between_units(x, errors, 1e-3)[1]] == [9]


def test_a_value_with_a_large_error_is_not_unlike():
    x, errors = np.array([1.0, 1.02, 0.97, 1.01, 3.0]), np.array([0.01, 0.01, 0.01, 0.01, 1.0])
    assert between_units(x, errors, 1e-3)[1] == ()
    assert between_units(x[:2], errors[:2], 1e-3) is None
    x, errors = np.append(x, 1.4), np.append(errors, 0.01)
    assert [k for k, _ in between_units(x, errors, 1e-3)[1]] == [5]


def test_the_probability_is_that_of_weighted_least_squares_over_all_spreads():
    """Dense: at each s, x = mu + delta [last] with covariance s^2 + e^2; restricted likelihoods."""
    rng = np.random.default_rng(3)
    e = 0.1 * np.exp(rng.normal(size=7))
    x = 5.0 + 0.2 * rng.normal(size=7)
    x[6], X = 9.0, np.column_stack([np.ones(7), np.arange(7) == 6])
    unlike = dict(between_units(x, e, 0.05)[1])
    found = []
    for s in np.geomspace(0.05 * e.min(), 30.0 * np.std(x), 32):
        W = np.diag(1.0 / (s**2 + e**2))
        C = np.linalg.inv(X.T @ W @ X)
        b = C @ X.T @ W @ x
        r = x - X @ b
        log = 0.5 * (np.log(np.diag(W)).sum() + np.linalg.slogdet(C)[1] - r @ W @ r)
        found.append([log, 2.0 * scipy.stats.norm.sf(abs(b[1]) / np.sqrt(C[1, 1]))])
    log, p = np.array(found).T
    weight = np.exp(log - log.max())
    assert unlike[6] == pytest.approx(weight @ p / weight.sum())
