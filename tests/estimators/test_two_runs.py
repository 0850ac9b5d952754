"""Two runs that differ by what loads only one of them."""

import numpy as np
import pytest

from robotid.estimators.two_runs import TwoRuns
from robotid.regressor.factors import Factors, triangle_of

BETA, CHANGE = np.array([2.0, -1.0, 0.5]), 0.3  # of the third parameter, in the loaded run
NOISE = np.array([0.2, 0.05])
NAMES = ("a", "b", "c")


def stretches(rng, beta, hold):
    """Return the factors of 12 stretches of 60 rows of two joints, noise of so many rows alike."""
    found = []
    for _ in range(12):
        triangles = []
        for sigma in NOISE:
            W = rng.standard_normal((60, 3))
            noise = sigma * np.repeat(rng.standard_normal(60 // hold), hold)
            triangles.append(triangle_of(np.column_stack([W, W @ beta + noise])))
        found.append(Factors(tuple(triangles), (np.arange(3),) * 2, np.array([60, 60]), NAMES))
    return tuple(found)


@pytest.mark.parametrize("hold", [1, 6])
def test_errors_that_count_what_changes_with_time_are_no_smaller_than_those_of_alike_rows(
    rng, hold
):
    loaded = stretches(rng, np.add(BETA, [0.0, 0.0, CHANGE]), hold)
    runs = TwoRuns(
        stretches(rng, BETA, hold), loaded, np.eye(3)[:, 2:], np.zeros(3), np.zeros(4),
        1e-6 * np.eye(4), 1.0, np.empty(0, dtype=int),
    )  # fmt: skip
    theta, covariance = runs.alike()
    found = runs.compare()
    np.testing.assert_allclose(found.theta, theta, atol=1e-12)
    assert (np.diag(found.covariance) >= np.diag(covariance) * (1 - 1e-12)).all()
    # rows with weights 1 / noise^2: 12 x 60 of each joint with, and without the change
    information = (720 * NOISE**-2.0).sum()
    expected = np.sqrt(np.array([0.5, 2.0]) / information)  # of what both have, of the change
    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[[0, 3]], expected, rtol=0.1)
    assert np.abs(theta - [*BETA, CHANGE]).max() < 5 * np.sqrt(hold) * expected[1]


def of_rows(W, tau, count):
    """Return the factors of so many stretches of rows W (n, N, c) and torques (n, N)."""
    columns, rows = (np.arange(W.shape[2]),) * len(W), np.full(len(W), W.shape[1] // count)
    whole = np.concatenate([W, tau[:, :, None]], axis=2)
    return tuple(
        Factors(tuple(triangle_of(A) for A in part), columns, rows, NAMES)
        for part in np.split(whole, count, axis=1)
    )


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_both_runs_are_one_fit_with_the_prior_by_the_noise_of_each_joint(rng, share):
    n, N = 2, 48
    D, known = np.array([[0.0], [0.4], [1.0]]), np.array([0.2, 0.0, -0.3])
    mean, precision = np.array([1.0, 0.0, 0.0, 0.1]), np.diag([3.0, 0.5, 1.0, 20.0])
    W = rng.standard_normal((2, n, N, 3))
    noise = NOISE[:, None] * rng.standard_normal((2, n, N))
    tau = np.stack([W[0] @ BETA, W[1] @ (BETA + known + 0.3 * D[:, 0])]) + noise
    runs = TwoRuns(
        of_rows(W[0], tau[0], 4), of_rows(W[1], tau[1], 4), D, known, mean, precision, share,
        np.empty(0, dtype=int),
    )  # fmt: skip
    found = runs.compare()
    alone = [
        np.linalg.lstsq(W[k, j], tau[k, j], rcond=None)[1][0] for k in (0, 1) for j in range(n)
    ]
    own = np.array(alone).reshape(2, n).sum(axis=0)  # of each joint and run by itself
    level = np.sqrt(own / (2 * N - 6 / share)) / np.sqrt(share)
    A = [
        np.concatenate([W[0], np.zeros((n, N, 1))], axis=2),
        np.concatenate([W[1], W[1] @ D], axis=2),
    ]
    b = [tau[0], tau[1] - W[1] @ known]
    H, pull = precision.copy(), precision @ mean
    for X, y in zip(A, b, strict=True):
        for j in range(n):
            H += X[j].T @ X[j] / level[j] ** 2
            pull += X[j].T @ y[j] / level[j] ** 2
    theta = np.linalg.solve(H, pull)
    np.testing.assert_allclose(found.theta, theta, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(H), rtol=1e-8, atol=1e-12)
    assert np.isinf(found.freedom).all()  # eight stretches show no scatter
    left = sum(np.sum((y - X @ theta) ** 2, axis=1) for X, y in zip(A, b, strict=True))
    torque = np.sum(tau**2, axis=(0, 2))
    np.testing.assert_allclose(found.unexplained, np.sqrt(left / torque), rtol=1e-9)
    # one set of both runs' own parameters leaves more than each by itself
    np.testing.assert_allclose(runs.held_together(theta), left / own, rtol=1e-9)


@pytest.mark.parametrize("hold", [1, 20])
def test_errors_are_those_of_rows_that_last_as_long_as_their_noise(rng, hold):
    """Of one joint, whose rows come in runs of so many alike: they count once."""
    W = np.repeat(rng.standard_normal((2, 1, 600 // hold, 3)), hold, axis=2)
    noise = np.repeat(rng.standard_normal((2, 1, 600 // hold)), hold, axis=2)
    tau = W @ BETA + noise
    runs = TwoRuns(
        of_rows(W[0], tau[0], 10), of_rows(W[1], tau[1], 10), np.eye(3)[:, 2:], np.zeros(3),
        np.zeros(4), 1e-6 * np.eye(4), 1.0, np.empty(0, dtype=int),
    )  # fmt: skip
    found, alike = runs.compare(), runs.alike()[1]
    ratio = np.diag(found.covariance) / np.diag(alike)
    assert (ratio >= 1.0 - 1e-12).all()
    assert np.median(ratio) == pytest.approx(hold, rel=0.6)
    assert ((found.freedom > 2.0) & (found.freedom < 20.0)).all()  # of 20 stretches


def test_freedom_is_that_of_the_scatter_whose_error_is_larger(rng):
    """The first parameter differs from joint to joint, the third from stretch to stretch."""
    n, N, count = 6, 240, 12
    W = rng.standard_normal((2, n, N, 3))
    beta = np.tile(BETA, (2, n, N, 1))
    beta[..., 0] += 0.3 * (-1.0) ** np.arange(n)[:, None]
    beta[..., 2] += 0.5 * np.repeat((-1.0) ** (np.arange(count) // 2), N // count)
    tau = np.einsum("rjkc,rjkc->rjk", W, beta) + 0.02 * rng.standard_normal((2, n, N))
    runs = TwoRuns(
        of_rows(W[0], tau[0], count), of_rows(W[1], tau[1], count), np.eye(3)[:, 1:2], np.zeros(3),
        np.zeros(4), 1e-6 * np.eye(4), 1.0, np.empty(0, dtype=int),
    )  # fmt: skip
    found, stretches = runs.compare(), runs.compare(by_joint=False)
    grown = np.diag(found.covariance) > 1.01 * np.diag(stretches.covariance)
    assert grown[[0, 2]].tolist() == [True, False]
    assert (found.freedom[grown] != stretches.freedom[grown]).all()
    assert (found.freedom[grown] < 12.0).all()  # of 12 parts, not of 24
    np.testing.assert_array_equal(found.freedom[~grown], stretches.freedom[~grown])
    assert stretches.freedom[0] > 12.0
