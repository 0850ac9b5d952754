"""Multipliers of limits and distances: cost, slopes and growth."""

import numpy as np
import pytest

from robotid.design.design import SOFT, SPARE, Multipliers


def test_costs_are_those_of_the_augmented_lagrangian_and_slopes_their_derivatives(rng):
    used, aim = rng.normal(size=(6, 5, 2)), np.array([[0.02], [0.1], [0.05]])
    distance = aim + 0.03 * rng.normal(size=(3, 5))
    limits, distances = rng.uniform(0, 2, used.shape), rng.uniform(0, 2, distance.shape)
    own = Multipliers(2.5, limits, distances)
    cases = (
        (own.of_limits(used), used**2 / (1 - SPARE) ** 2 - 1.0, limits),
        (own.of_distances(distance, aim), (aim - distance) / SOFT, distances),
    )
    for (cost, slopes), over, known in cases:
        pushed = np.maximum(known + 2.5 * over, 0.0)
        assert cost == pytest.approx(((pushed**2 - known**2) / 5.0).sum())
        np.testing.assert_allclose(slopes, pushed)
        assert 0 < (pushed == 0.0).sum() < pushed.size
    raised = own.raised(used, distance, aim)
    assert raised.weight == 2.5
    np.testing.assert_allclose(raised.limits, own.of_limits(used)[1])
    np.testing.assert_allclose(raised.distances, own.of_distances(distance, aim)[1])
    assert own.raised(used, None, aim).distances == 0.0
    edge = own.distance_without_cost(aim)
    assert own.of_distances(edge, aim)[1] == pytest.approx(np.zeros((3, 5)), abs=1e-12)
    assert (own.of_distances(edge - 1e-6, aim)[1] > 0).all()
