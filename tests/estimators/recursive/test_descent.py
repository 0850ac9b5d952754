"""The gradient methods: PRX as the paper has it, and the normalised gradient."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.estimation import RandomStates

from robotid.estimators import PRX, NormalisedGradient
from robotid.estimators.recursive.descent import column_scale
from robotid.exceptions import DataError
from robotid.regressor.problem import Sample
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


def _rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def states():
    return RandomStates(RobotModel.from_urdf(example_urdf("ur10_robot.urdf")), _rng())


@pytest.mark.parametrize("options", [{}, {"metric": "rows"}, {"metric": "mass"}])
def test_prx_never_moves_away_from_the_truth(states, options):
    problem, beta = states.problem, states.beta
    scale = column_scale(problem, np.ones(6))
    estimator = PRX(np.ones(6), scale=scale, average=False, **options)
    assert_monotone(estimator, problem, scale * beta)


def test_printed_prx_never_moves_away_from_the_truth(states):
    problem, beta = states.problem, states.beta
    # half the truth, as in the paper: D(q, P^) starts positive definite
    estimator = PRX(np.ones(6), prior=beta / 2, step="printed", average=False)
    distance = assert_monotone(estimator, problem, beta)
    assert distance[-1] < distance[0]
    assert distance[-1] > 0.3 * distance[0]  # on six joints it hardly moves


def assert_monotone(estimator, problem, truth):
    state = estimator.init(len(truth))
    distance = [np.linalg.norm(state.x - truth)]
    for sample in problem.samples():
        state = estimator.update(state, sample)
        distance.append(np.linalg.norm(state.x - truth))
    growth = np.diff(distance) / distance[0]
    assert growth.max() < 1e-12  # rounding of 58 products
    return distance


def test_exact_prx_needs_two_passes_where_the_printed_step_stands_still(states):
    problem, beta = states.problem, states.beta
    start = 1.3 * beta

    def miss(**options):
        estimator = PRX(np.ones(6), prior=start, average=False, passes=2, rng=_rng(), **options)
        return np.linalg.norm(estimator.fit(problem).theta - beta) / np.linalg.norm(beta)

    assert miss() < 1e-6
    assert miss(metric="rows") < 1e-8
    assert miss(step="printed") > 0.1


def test_prx_says_what_it_lacks_and_refuses_settings(states):
    problem = states.problem
    sample = replace(next(problem.samples()), mass_regressor=None)
    for options in ({"step": "printed"}, {"metric": "mass"}):
        estimator = PRX(np.ones(6), **options)
        with pytest.raises(
            DataError, match=r"PRX needs the mass regressor of each sample, found none"
        ):
            estimator.update(estimator.init(58), sample)
    with pytest.raises(DataError, match="step is 'wrong', wanted 'exact' or 'printed'"):
        PRX(np.ones(6), step="wrong")
    with pytest.raises(DataError, match="passes is 0"):
        PRX(np.ones(6), passes=0)
    with pytest.raises(DataError, match="step_size is 2"):
        NormalisedGradient(np.ones(6), step_size=2.0)


@pytest.mark.parametrize("average", [False, True])
def test_prx_stays_within_omega(states, average):
    problem, beta = states.problem, states.beta
    estimator = PRX(np.ones(6), prior=0 * beta, bounds=1.0, average=average)
    state = estimator.init(58)
    for sample in problem.samples():
        state = estimator.update(state, sample)
        assert max(np.linalg.norm(state.x), np.linalg.norm(state.mean)) < 1.0 + 1e-12
    assert np.linalg.norm(state.x) == pytest.approx(1.0)


def test_only_steps_that_use_the_mass_matrix_ask_for_its_regressor():
    asks = {
        (step, metric): PRX(np.ones(2), step=step, metric=metric).needs_mass
        for step in ("exact", "printed")
        for metric in ("noise", "rows", "mass")
    }
    assert {key for key, needs in asks.items() if not needs} == {
        ("exact", "noise"),
        ("exact", "rows"),
    }
    assert not NormalisedGradient(np.ones(2)).needs_mass


def test_the_gradient_step_is_its_formula(rng):
    sigma, scale, theta = (
        np.array([0.5, 2.0]),
        np.array([1.0, 3.0, 0.2]),
        np.array([1.0, -1.0, 2.0]),
    )
    ours = NormalisedGradient(sigma, theta, scale, step_size=0.7, regularisation=0.3, average=False)
    Y, tau, weight = rng.standard_normal((2, 3)), rng.standard_normal(2), np.array([4.0, 1.0])
    state = ours.update(ours.init(3), Sample(Y, tau, weight))
    root = np.sqrt(weight) / sigma
    Psi = root[:, None] * Y / scale
    e = root * (Y @ theta - tau)
    x = scale * theta - 0.7 / (0.3 + (Psi**2).sum()) * Psi.T @ e
    np.testing.assert_allclose(state.x, x, rtol=1e-12)
    np.testing.assert_allclose(ours.estimate(state, ("a", "b", "c")).theta, x / scale, rtol=1e-12)


def test_averaging_takes_the_noise_out_of_prx(states, rng):
    problem, beta = states.problem, states.beta
    ((W, tau, weight),) = problem.blocks()
    noisy = tau + rng.standard_normal(len(tau))
    data = replace(problem, stream=lambda: iter([(W, noisy, weight)]))
    best = np.linalg.lstsq(W, noisy, rcond=None)[0]

    def residual(average):
        fit = PRX(np.ones(6), average=average, passes=6, rng=_rng()).fit(data)
        return np.linalg.norm(W @ (fit.theta - best)) / np.linalg.norm(W @ (beta - best)), fit

    last, _ = residual(False)
    mean, fit = residual(True)
    assert last > 2.0  # each iterate fits its own sample
    assert mean < 1.0  # nearer to least squares than that is to the truth
    assert np.isinf(fit.std_error).all()
    assert "a gradient method has no covariance" in fit.message


def test_prx_stops_when_the_gradient_is_zero(states):
    problem = states.problem
    fit = PRX(np.ones(6), average=False, passes=30, rng=_rng(), eps1=1e-7).fit(problem)
    assert fit.converged
    assert fit.n_iter < 30_000
    short = PRX(np.ones(6), average=False, passes=1, rng=_rng()).fit(problem)
    assert not short.converged
