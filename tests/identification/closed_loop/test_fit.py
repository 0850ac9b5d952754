"""Alternation of initial states and parameters at the end of a fit."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from robotid.estimation.estimators.estimator import Estimate
from robotid.identification.closed_loop.stages import _settled

COVARIANCE = np.array([[0.04, 0.01], [0.01, 0.09]])


class Windows:
    """Windows whose initial states are fitted; it is known how often, and for which parameters."""

    exact = None

    def __init__(self, fitted=()):
        self.fitted = fitted

    def with_better_start(self, theta):
        return Windows((*self.fitted, theta))


@dataclass
class Steps:
    """An estimator with given steps of parameters and initial states together [-]."""

    steps: list
    taken: int = 0

    def settle(self, simulator, estimate):
        step, self.taken = np.array(self.steps[self.taken]), self.taken + 1
        return replace(estimate, theta=estimate.theta + step)


def at(theta):
    return Estimate(np.array(theta), COVARIANCE, ("a", "b"), np.ones(2), 2, 1.0, (), True, 1, "")


@pytest.mark.parametrize(
    ("steps", "taken", "moved"),
    [
        # 0.2 standard errors are 0.04 and 0.06
        ([[0.039, -0.059]], 1, [0.0, 0.0]),
        ([[0.3, 0.5], [-0.041, 0.0], [0.02, -0.05]], 3, [0.0, 0.0]),
        ([[0.3, -0.2], [-0.12, 0.3], [0.1, -0.3], [-0.13, 0.061]], 4, [-0.13, 0.061]),
        ([[0.3, -0.2], [-0.12, 0.3], [0.1, -0.3], [0.01, 0.061]], 4, [0.01, 0.061]),
    ],
    ids=["at once", "after three", "never", "never, by one parameter"],
)
def test_steps_that_do_not_settle_are_in_the_covariance(steps, taken, moved):
    estimator = Steps(steps)
    simulator, found = _settled(Windows(), estimator, at([1.0, -2.0]))
    assert estimator.taken == taken
    before = np.cumsum([[1.0, -2.0], *steps[:-1]], axis=0)  # each step
    np.testing.assert_allclose(simulator.fitted, before, rtol=1e-14)
    np.testing.assert_allclose(found.theta, np.add([1.0, -2.0], np.sum(steps, axis=0)), rtol=1e-14)
    np.testing.assert_allclose(found.covariance, COVARIANCE + np.outer(moved, moved), rtol=1e-14)
