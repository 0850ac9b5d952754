"""The gradient methods: PRX with the exact step, and the normalised gradient."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.estimation import RandomStates

from robotid.dynamics.factors import Sample
from robotid.estimation.estimators import PRX, NormalisedGradient
from robotid.estimation.estimators.recursive import column_scale
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


def _rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def states():
    return RandomStates(RobotModel.from_urdf(example_urdf("ur10_robot.urdf")), _rng())


@pytest.mark.parametrize("kind", [PRX, NormalisedGradient])
def test_a_step_never_moves_away_from_the_truth(states, kind):
    problem, beta = states.problem, states.beta
    scale = column_scale(problem, np.ones(6))
    assert_monotone(kind(np.ones(6), scale=scale, average=False), problem, scale * beta)


def assert_monotone(estimator, problem, truth):
    state = estimator.init(len(truth))
    distance = [np.linalg.norm(state.x - truth)]
    for sample in problem.samples():
        state = estimator.update(state, sample)
        distance.append(np.linalg.norm(state.x - truth))
    growth = np.diff(distance) / distance[0]
    assert growth.max() < 1e-12  # rounding of 58 products
    return distance


def test_prx_needs_two_passes_from_a_start_far_off(states):
    problem, beta = states.problem, states.beta
    estimator = PRX(np.ones(6), prior=1.3 * beta, average=False, passes=2, rng=_rng())
    assert np.linalg.norm(estimator.fit(problem).theta - beta) < 1e-6 * np.linalg.norm(beta)


def test_a_state_averages_what_rows_of_their_own_weight_leave(rng):
    """Of three samples of three joints; a row of weight 0 changes nothing of its joint."""
    sigma, scale = np.array([0.5, 2.0, 1.5]), np.array([1.0, 4.0])
    prior = np.array([0.3, -0.2])
    estimator = NormalisedGradient(sigma, prior=prior, scale=scale)
    state, x = estimator.init(2), prior * scale
    mean, squares, prx, square = x.copy(), np.zeros(3), np.zeros(2), 0.0
    for k, weight in enumerate(([1.0, 4.0, 0.25], [2.0, 0.0, 1.0], [1.0, 1.0, 9.0]), start=1):
        weight = np.array(weight)
        Y, tau = rng.standard_normal((3, 2)), rng.standard_normal(3)
        state = estimator.update(state, Sample(Y, tau, weight))
        used = np.flatnonzero(weight)
        rows = (np.sqrt(weight) / sigma)[used]
        Psi, u = rows[:, None] * Y[used] / scale, rows * tau[used]
        gradient = (Psi @ mean - u) @ Psi
        left = (Y[used] / scale @ mean - tau[used]) ** 2
        x = x - 1.0 / np.sum(Psi**2) * (Psi @ x - u) @ Psi
        squares[used] += (left - squares[used]) / k
        prx, square = prx + (gradient - prx) / k, square + (gradient @ gradient - square) / k
        mean = mean + 3.0 / (k + 2) * (x - mean)
        np.testing.assert_allclose(state.x, x, rtol=1e-9)
        np.testing.assert_allclose(state.mean, mean, rtol=1e-9)
        np.testing.assert_allclose(state.squares, squares, rtol=1e-9)
        np.testing.assert_allclose(state.prx, prx, rtol=1e-9)
        assert state.prx_square == pytest.approx(square)
    assert (state.steps, state.rows, state.skipped) == (3, 8, 0)
    found = estimator.estimate(state, ("a", "b"))
    np.testing.assert_allclose(found.theta, mean / scale)
    np.testing.assert_allclose(found.sigma, np.sqrt(squares))
    assert np.isinf(found.std_error).all()
    assert "a gradient method has no covariance" in found.message
    silent = estimator.update(state, Sample(np.zeros((3, 2)), np.ones(3), np.ones(3)))
    assert (silent.steps, silent.rows, silent.skipped) == (4, 8, 1)


def test_columns_are_scaled_by_the_rows_of_every_block_with_their_weights(rng):
    sigma = np.array([0.5, 2.0])
    blocks = []
    for n in (3, 5):
        W, weight = rng.standard_normal((2 * n, 3)), rng.uniform(0.5, 2.0, 2 * n)
        weight[1] = 0.0
        W[1] = np.nan  # of a row that is not used
        W[:, 2] = 0.0
        blocks.append((W, rng.standard_normal(2 * n), weight))
    problem = SimpleNamespace(n_joints=2, names=("a", "b", "c"), blocks=lambda: iter(blocks))
    squares = sum(
        np.nansum((weight / np.tile(sigma, len(W) // 2) ** 2)[:, None] * W**2, axis=0)
        for W, _, weight in blocks
    )
    np.testing.assert_allclose(column_scale(problem, sigma), [*np.sqrt(squares[:2] / 8), 1.0])
    # below 1e-6 of the largest, a column has no data
    small = np.array([[2.0, 2.4e-6, 1.6e-6]])
    problem.n_joints, problem.blocks = 1, lambda: iter([(small, np.ones(1), np.ones(1))])
    np.testing.assert_allclose(column_scale(problem, np.ones(1)), [2.0, 2.4e-6, 1.0])


def test_prx_is_zero_within_two_standard_errors_of_its_moving_average():
    """Averaged over 1000 samples, independent ones have the variance of one over 2000."""
    prx, limit = PRX(np.ones(1)), 2.0 * np.sqrt(5.0 / 2000)
    for size, steps, is_zero in (
        (0.99 * limit, 1000, True), (1.01 * limit, 1000, False), (0.99 * limit, 999, False),
    ):  # fmt: skip
        state = replace(prx.init(2), prx=size * np.array([0.6, -0.8]), prx_square=5.0, steps=steps)
        assert prx._is_zero(state) == is_zero
    still = replace(prx.init(2), prx=np.array([0.9e-9, 0.0]), prx_square=0.0, steps=1000)
    assert prx._is_zero(still)
    assert not prx._is_zero(replace(still, prx=np.array([1.1e-9, 0.0])))
    # within its scatter it is settled if a pass lowers the squared residual by less than 1 %
    inside = replace(still, prx=np.array([1e-3, 0.0]), prx_square=1.0)
    for left, settled in ((0.9905, True), (0.9895, False), (1.02, True)):
        before, after = (replace(inside, squares=np.array([x])) for x in (3.0, 3.0 * left))
        assert prx._has_settled(before, after) == settled
