"""The weight of the prior chosen from the data: brute force, closed form, what it is good for."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from helpers.estimation import EXACT, NOISE, Case, consistent
from helpers.fitting import fit as fitted
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import DataError
from robotid.dynamics.factors import compress, compress_segments, merge
from robotid.estimation.estimators import Constraints
from robotid.estimation.estimators import consistent_fit as weighting
from robotid.estimation.estimators.consistent_fit import (
    Segments,
    choose_weight,
    contradicted_extents,
    held_out_errors,
    log_evidence,
    plausible_weight,
)
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.robot.bodies import body_boxes


@pytest.fixture
def case(ur5, rng):
    case = Case(ur5, rng, NOISE)
    return consistent(case), case.problem


def cut(problem, count):
    return compress_segments(problem, -(-problem.sources[0].samples // count))


def test_the_evidence_is_the_density_of_the_data(case):
    fit, problem = case
    rows = fit.rows(compress(problem), NOISE)
    C = np.linalg.inv(0.5 * fit.programme.penalty.hessian(fit.programme.penalty.centre))
    D, d = rows[:, :-1] @ fit.K, rows[:, -1]
    stated, expected = [], []
    for weight in (0.01, 1.0, 30.0):
        S = np.eye(len(d)) + D @ C @ D.T / weight
        mean = D @ fit.programme.penalty.centre
        expected.append(scipy.stats.multivariate_normal(mean, S).logpdf(d))
        stated.append(log_evidence(fit, rows)(weight))
    np.testing.assert_allclose(np.diff(stated), np.diff(expected), rtol=1e-6, atol=1e-4)


def test_at_the_plausible_weight_the_prior_is_as_far_as_expected(case):
    fit, problem = case
    rows = fit.rows(compress(problem), NOISE)
    weight, start = plausible_weight(fit, rows, 15.0), 15.0
    pi = fit.programme.minimise(rows, weight).x
    unit = np.diag(fit.prior_std)
    A, H = rows[:, :-1] @ fit.K @ unit, unit @ fit.programme.penalty.hessian(pi) @ unit / 2
    determined = np.trace(np.linalg.solve(A.T @ A + weight * H, A.T @ A))
    assert weight * fit.programme.penalty.value(pi) == pytest.approx(determined, rel=0.03)
    assert start / 10.0**0.5 < weight < 0.8 * start


def test_the_held_out_errors_are_those_of_a_loop_by_hand(case):
    fit, problem = case
    segments = cut(problem, 3)
    total, count = np.zeros(6), 0
    for k in range(3):
        others = [s for i, s in enumerate(segments) if i != k]
        rows = fit.rows(merge(others), NOISE)
        pi = fit.programme.minimise(rows, 2.0).x
        W, tau, _ = (np.concatenate(x) for x in zip(*problem.blocks(), strict=True))
        part = slice(200 * 6 * k, 200 * 6 * (k + 1))
        residual = (tau - W @ (fit.K @ pi))[part].reshape(-1, 6) / NOISE
        total, count = total + (residual**2).sum(axis=0), count + len(residual)
    squares, _ = held_out_errors(fit, replace(Segments.of(fit, segments), sigma=NOISE), 2.0)
    error = np.sqrt(squares.sum(axis=0))
    # it is computed to the solver's tolerance only
    np.testing.assert_allclose(error, np.sqrt(total / count), rtol=2e-4)


def test_the_chosen_weight_is_the_best_of_its_curve_and_is_stated(ur5, rng):
    log = exact_log(ur5, truth(ur5), rng, noise=NOISE)
    for how in ("cv", "evidence"):
        settings = EstimatorSettings(prior_weight=how)
        found = fitted(ur5, [log], signals=EXACT, estimator=settings)
        prior = found.estimate.details["prior"]
        assert prior["chosen_by"] == how
        weights, scores = np.array(prior["curve"]).T
        assert prior["weight"] in weights
        assert prior["weight"] >= weights[np.argmin(scores)]
        assert (np.diff(weights) > 0).all()
        assert len(weights) >= 5
        assert weights.max() == 100.0


CHANCE = np.array([[0.05], [-0.05], [0.02], [-0.05], [0.05], [-0.02]])  # (segments, 1)


def chosen(case, monkeypatch, excess, repeated=0.0):
    """Return the choice where mean squares rise by excess (6, n) per decade away from 1."""
    fit, problem = case

    def errors(fit, segments, w, starts):
        return (1.0 + abs(np.log10(w)) * np.asarray(excess)) / 6.0, []

    monkeypatch.setattr("robotid.estimation.estimators.consistent_fit.held_out_errors", errors)
    return choose_weight(fit, Segments.of(fit, cut(problem, 6)), "cv", repeated)


def of_joint(loss):
    """Return chance at six joints, and a loss of one at the weight of 100, two decades away."""
    excess = np.tile(CHANCE, (1, 6))
    excess[:, 4] += (loss**2 - 1.0) / 2.0
    return excess


@pytest.mark.parametrize(
    ("excess", "weight"),
    [
        # a larger weight costs at most 2 % of the error, and 5 % of that of a joint
        (0.018 + CHANCE, 100.0), (0.03 + CHANCE, 10.0), (0.5 + CHANCE, 1.0),
        (of_joint(1.04), 100.0), (of_joint(1.06), 10.0),
        # one or two bad segments reject it
        (30.0 * np.eye(6)[3][:, None] * np.ones(6), 1.0),
        (30.0 * np.eye(6)[[1, 4]].sum(axis=0)[:, None] * np.ones(6), 1.0),
    ],
)  # fmt: skip
def test_the_largest_weight_is_chosen_that_costs_little_of_the_error(
    case, monkeypatch, excess, weight
):
    choice = chosen(case, monkeypatch, excess)
    assert choice.weight == pytest.approx(weight)
    weights, scores = zip(*choice.curve, strict=True)
    assert weights[int(np.argmin(scores))] == pytest.approx(1.0)
    # the RMS over segments, of each joint
    wanted = np.exp(0.5 * np.log(1.0 + 2.0 * excess.mean(axis=0)).mean())
    assert scores[-1] == pytest.approx(wanted)


def test_a_good_prior_gets_more_weight_than_a_bad_one(case):
    fit, problem = case
    segments = cut(problem, 4)
    true = fit.fit(compress(problem)).theta
    wrong = true + 30.0 * fit.prior_std
    for how in ("cv", "evidence"):
        good, bad = (
            choose_weight(fit, Segments.of(fit, segments), how).weight
            for fit in (replace(fit, prior=true), replace(fit, prior=wrong))
        )
        assert good == 100.0
        assert bad <= 1.0, how


def test_rows_without_constraint_forces_are_one_joint():
    fold = SimpleNamespace(rows=np.array([10, 30]), is_projected=True)
    segments = Segments((fold, fold), np.array([2.0, 4.0]), None, 1.0)
    errors = segments.errors(np.array([[40.0, 160.0], [8.0, 0.0]]))
    np.testing.assert_allclose(errors, [[20.0 / 80], [2.0 / 80]])


def test_one_stretch_is_too_few(case):
    fit, problem = case
    with pytest.raises(DataError, match="needs at least 2 segments, found 1"):
        choose_weight(fit, Segments.of(fit, [compress(problem)]), "cv")


def test_a_larger_weight_may_leave_an_error_that_repeats_in_all_segments():
    best = np.full((6, 1), 1.0)
    worse = best * 1.01**2  # in each segment, without scatter
    assert not weighting._is_accepted(worse, best, 0.0)
    assert not weighting._is_accepted(worse, best, 0.009)
    assert weighting._is_accepted(worse, best, 0.011)
    assert not weighting._is_accepted(best * 1.03**2, best, 0.1)


@pytest.mark.parametrize(("loss", "named"), [(0.4, ()), (0.6, ("wrist_3_link",))])
def test_an_extent_is_contradicted_beyond_the_scatter_of_segments(ur5, monkeypatch, loss, named):
    case = Case(ur5, np.random.default_rng(0), 0.1 * NOISE)
    center = body_boxes(ur5)["wrist_3_link"].mean(axis=0)
    box = 0.1 * (body_boxes(ur5)["wrist_3_link"] - center)
    fit = consistent(case, constraints=Constraints(extent={"wrist_3_link": box}))
    scatter = loss + np.array([-0.5, 0.5, -0.5, 0.5])  # mean 2 standard errors at 0.58

    def errors(one, segments, weight, starts=None):
        return np.ones((4, 1)) + (one is fit) * scatter[:, None], []

    monkeypatch.setattr("robotid.estimation.estimators.consistent_fit.held_out_errors", errors)
    assert contradicted_extents(fit, Segments.of(fit, cut(case.problem, 4))) == named


def test_an_extent_is_contradicted_by_a_body_clearly_outside_its_box(ur5):
    """Of a tenth of the size of the body, and of a generous size; and of noise too large to see."""
    body = "wrist_3_link"
    for noise, size, named in ((0.1, 0.1, (body,)), (0.1, 50.0, ()), (1.0, 0.1, ())):
        case = Case(ur5, np.random.default_rng(0), noise * NOISE)
        box = size * (body_boxes(ur5)[body] - body_boxes(ur5)[body].mean(axis=0))
        fit = consistent(case, constraints=Constraints(extent={body: box}))
        assert contradicted_extents(fit, Segments.of(fit, cut(case.problem, 4))) == named
