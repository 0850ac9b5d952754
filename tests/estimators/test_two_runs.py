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
