"""Scatter of segments in directions that one segment alone determines, or none."""

import numpy as np

from robotid.dynamics.factors import Factors, triangle_of
from robotid.estimation.estimators.segments import scatter


def test_what_one_segment_alone_determines_has_the_mean_scatter_of_all_others(rng):
    """The third parameter is that of one segment, the fourth has a prior and no rows."""
    count, each, sigma = 14, 30, 0.3
    W = np.zeros((count, each, 4))
    W[..., :2] = rng.standard_normal((count, each, 2))
    W[3] = rng.standard_normal((each, 4)) * [0.0, 0.0, 5.0, 0.0]
    tau = rng.standard_normal((count, each)) * np.linspace(0.2, 0.5, count)[:, None]
    W, tau = W.reshape(-1, 4), tau.reshape(-1)
    bread = np.linalg.inv(W.T @ W / sigma**2 + np.diag([0.0, 0.0, 0.0, 1e4]))
    theta = bread @ W.T @ tau / sigma**2
    segments = [
        Factors((triangle_of(A),), (np.arange(4),), np.array([each]), ("a", "b", "c", "d"))
        for A in np.split(np.column_stack([W, tau]), count)
    ]
    found = scatter(segments, theta, np.array([sigma]), bread)
    squares = 0.0  # of the scores of the first two parameters, which the fourth segment lacks
    for k in set(range(count)) - {3}:
        A = W[k * each : (k + 1) * each, :2] / sigma
        values, V = np.linalg.eigh(np.eye(each) - A @ bread[:2, :2] @ A.T)
        left = tau[k * each : (k + 1) * each] / sigma - A @ theta[:2]
        score = A.T @ (V @ ((V.T @ left) / np.sqrt(values)))
        squares += np.outer(score, score)
    np.testing.assert_allclose(found.meat[:2, :2], squares, rtol=1e-9)
    inflation = np.trace(squares @ bread[:2, :2]) / 2.0  # leverages of parameters sum to 1 each
    np.testing.assert_allclose(found.inflation, inflation, rtol=1e-9)
    C = found.covariance
    np.testing.assert_allclose(C[2, 2], found.inflation * bread[2, 2], rtol=1e-9)
    np.testing.assert_allclose(C[3], 0.0, atol=1e-15)
    freedom = found.freedom()
    assert freedom[2] == 1.0
    assert freedom[3] == np.inf
    assert ((freedom[:2] > 5.0) & (freedom[:2] <= count)).all()
