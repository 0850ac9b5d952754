"""Two runs that differ by what loads only one of them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from robotid.dynamics.factors import Factors, triangle_of
from robotid.estimation.estimators.two_runs import TwoRuns, payload_runs

BETA = np.array([2.0, -1.0, 0.5])
NOISE = np.array([0.2, 0.05])
NAMES = ("a", "b", "c")


def of_rows(W, tau, count):
    """Return the factors of so many segments of rows W (n, N, c) and torques (n, N)."""
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
    assert np.isinf(found.freedom).all()  # eight segments show no scatter
    left = sum(np.sum((y - X @ theta) ** 2, axis=1) for X, y in zip(A, b, strict=True))
    torque = np.sum(tau**2, axis=(0, 2))
    np.testing.assert_allclose(found.unexplained, np.sqrt(left / torque), rtol=1e-9)


def scattered(parts, theta, bread):
    """Return sum and degrees of freedom of scores of parts (A, b), by matrices of all rows."""
    # Bell and McCaffrey (2002): residuals over (I - leverage)^(1/2), as if rows were independent.
    A = np.concatenate([X for X, _ in parts])
    residual_maker = np.eye(len(A)) - A @ bread @ A.T
    edges = np.cumsum([0, *(len(X) for X, _ in parts)])
    pull, meat = np.zeros((len(parts), len(theta), len(A))), np.zeros((len(theta),) * 2)
    for k, (X, y) in enumerate(parts):
        values, V = np.linalg.eigh(np.eye(len(X)) - X @ bread @ X.T)
        assert values.min() > 0.05
        pull[k, :, edges[k] : edges[k + 1]] = X.T @ (V / np.sqrt(values)) @ V.T
        meat += np.outer(*2 * [pull[k][:, edges[k] : edges[k + 1]] @ (y - X @ theta)])
    freedom = []
    for loads in (bread @ pull).swapaxes(0, 1):  # what each part adds to one parameter
        G = loads @ residual_maker @ loads.T
        freedom.append(np.trace(G) ** 2 / np.sum(G**2))
    return meat, np.array(freedom)


def test_errors_are_the_larger_of_what_stretches_and_what_joints_scatter(rng):
    n, N, count, share = 6, 56, 7, 0.5
    D, known = np.array([[0.0], [0.4], [1.0]]), np.array([0.2, 0.0, -0.3])
    mean, precision = np.array([1.0, 0.0, 0.0, 0.1]), np.diag([3.0, 0.5, 1.0, 20.0])
    W = rng.standard_normal((2, n, N, 3))
    tau = np.stack([W[0] @ BETA, W[1] @ (BETA + known + 0.3 * D[:, 0])])
    tau += np.linspace(0.2, 0.4, n)[:, None] * rng.standard_normal((2, n, N))
    tau += 0.2 * W[..., 0] * np.array([1, -1, 1, -1, 1, -1])[:, None]  # joints disagree
    tau += 0.4 * W[..., 1] * np.repeat(rng.standard_normal((2, 1, count)), N // count, axis=2)
    runs = TwoRuns(
        of_rows(W[0], tau[0], count), of_rows(W[1], tau[1], count), D, known, mean, precision,
        share, np.empty(0, dtype=int),
    )  # fmt: skip
    found = runs.compare()
    own = np.array([
        np.linalg.lstsq(W[k, j], tau[k, j], rcond=None)[1][0] for k in (0, 1) for j in range(n)
    ]).reshape(2, n).sum(axis=0)  # fmt: skip
    noise = np.sqrt(own / (2 * N - 6 / share))[:, None]
    A = np.stack([np.concatenate([W[0], np.zeros((n, N, 1))], axis=2),
                  np.concatenate([W[1], W[1] @ D], axis=2)]) / noise[..., None]  # fmt: skip
    b = np.stack([tau[0], tau[1] - W[1] @ known]) / noise
    bread = np.linalg.inv(share * np.einsum("rjki,rjkl->il", A, A) + precision)
    times = [
        (X.reshape(-1, 4), y.ravel())
        for run in zip(A, b, strict=True)
        for X, y in zip(*(np.split(x, count, axis=1) for x in run), strict=True)
    ]
    joints = [pair for run in zip(A, b, strict=True) for pair in zip(*run, strict=True)]
    (covariance, freedom), (other, few) = (
        (bread @ (share**2 * meat + precision) @ bread, freedom)
        for meat, freedom in (scattered(x, found.theta, share * bread) for x in (times, joints))
    )
    is_wider = np.diag(other) > np.diag(covariance)
    assert 0 < is_wider.sum() < 4
    least = np.diag(bread)
    freedom = np.where(is_wider, few, freedom)
    least = np.maximum(least, np.diag(other))
    own = np.sqrt(np.diag(covariance))
    wider = np.maximum(own, np.sqrt(least)) / own
    np.testing.assert_allclose(found.freedom, np.maximum(freedom, 1.0), rtol=1e-6)
    np.testing.assert_allclose(found.covariance, covariance * np.outer(wider, wider), rtol=1e-6)


def test_runs_of_payloads_have_the_prior_of_the_urdf_and_the_known_part(rng):
    """Two bodies, drives of two terms that change and one that does not, a known parameter."""
    terms = [SimpleNamespace(is_inertia=x) for x in (True, False, False)]
    layout = SimpleNamespace(n_inertial=4, drive_parameters=[(0, term) for term in terms])
    K, spread, urdf = rng.standard_normal((3, 7)), rng.uniform(0.5, 3.0, 7), rng.random(7)
    columns, size = rng.standard_normal((3, 4)), np.array([1.0, 20.0, 0.3, 7.0])
    known = np.array([np.nan, 2.5, np.nan, np.nan])
    parts = [[SimpleNamespace(factors=f"{run}{k}") for k in range(2)] for run in ("one", "two")]
    runs = payload_runs(
        *parts, layout, K, urdf, spread, (columns, known, size), share=0.3, unknown=(1, 0)
    )
    assert (runs.reference, runs.loaded) == (("one0", "one1"), ("two0", "two1"))
    np.testing.assert_array_equal(runs.D, np.column_stack([K[:, 5:], columns[:, [0, 2, 3]]]))
    np.testing.assert_allclose(runs.known, 2.5 * columns[:, 1])
    np.testing.assert_allclose(runs.mean, [*(K @ urdf), 0, 0, 0, 0, 0])
    C = 100.0 * K @ np.diag(spread**2) @ K.T
    np.testing.assert_allclose(runs.precision[:3, :3], np.linalg.inv(C), rtol=1e-9)
    change = 10.0 * np.array([spread[5], spread[6], 1.0, 0.3, 7.0])
    np.testing.assert_allclose(np.diag(runs.precision)[3:], change**-2.0)
    assert not runs.precision[:3, 3:].any()
    assert (runs.share, runs.unknown.tolist()) == (0.3, [1, 0])


def test_rows_without_constraint_forces_have_one_noise_level_in_both_runs(rng):
    W, tau = rng.standard_normal((2, 40, 3)), rng.standard_normal((2, 40))
    for is_projected in (True, False):
        parts = tuple(replace(x, is_projected=is_projected) for x in of_rows(W, tau, 2))
        runs = TwoRuns(
            parts, parts, np.zeros((3, 0)), np.zeros(3), np.zeros(3), np.eye(3), 1.0,
            np.empty(0, dtype=int),
        )  # fmt: skip
        levels = runs._both(np.ones(2)).noise_levels(np.zeros(3), np.array([80.0, 80.0]))
        own = np.sqrt(np.mean(tau**2, axis=1))
        wanted = np.full(2, np.sqrt(np.mean(own**2))) if is_projected else own
        np.testing.assert_allclose(levels, wanted, rtol=1e-12)
