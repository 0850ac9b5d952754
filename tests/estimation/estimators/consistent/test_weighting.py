"""The weight of the prior chosen from the data: brute force, closed form, what it is good for."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from helpers.estimation import EXACT, NOISE, Case, consistent
from helpers.fitting import fit as fitted
from helpers.fitting import identify
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import DataError, NotConvergedError, SettingsError
from robotid.data.signals import process
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import compress, compress_segments, gather, merge
from robotid.dynamics.torque import build_problem
from robotid.estimation.estimators import Consistent
from robotid.estimation.estimators import prior_weight as weighting
from robotid.estimation.estimators.prior_weight import (
    Segments,
    _is_as_good,
    choose_weight,
    contradicted_extents,
    held_out_errors,
    log_evidence,
    plausible_weight,
)
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread


@pytest.fixture
def case(ur5, rng):
    case = Case(ur5, rng, NOISE)
    return consistent(case), case.problem


def cut(problem, count):
    return compress_segments(problem, -(-problem.sources[0].samples // count))


def test_neighbours_are_gathered_in_order(case):
    _, problem = case
    parts = cut(problem, 10)
    folds = gather(parts, 3)
    assert [int(fold.rows[0]) for fold in folds] == [180, 240, 180]
    whole, theta = compress(problem), np.arange(58.0)
    np.testing.assert_allclose(merge(folds).residual_squares(theta), whole.residual_squares(theta))
    assert len(gather(parts, 20)) == 10


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


def test_the_evidence_finds_the_spread_that_parameters_were_drawn_with(case):
    # parameters drawn around the prior with a tenth of its spread: weight 100
    fit, _ = case
    rng = np.random.default_rng(3)
    found = []
    penalty = fit.programme.penalty
    root = penalty.root(penalty.centre)
    for _ in range(8):
        pi = penalty.centre + 0.1 * np.linalg.solve(root, rng.standard_normal(len(root)))
        D = rng.standard_normal((58, 58)) @ fit.K / fit.prior_std.mean()
        rows = np.zeros((58, 59))
        rows[:, :-1] = D @ np.linalg.pinv(fit.K)
        rows[:, -1] = rows[:, :-1] @ (fit.K @ pi) + 1e-3 * rng.standard_normal(58)
        weights = 10.0 ** np.arange(-1.0, 5.0, 0.25)
        values = [log_evidence(fit, 1e3 * rows)(weight) for weight in weights]
        found.append(np.log10(weights[int(np.argmax(values))]))
    assert np.mean(found) == pytest.approx(2.0, abs=0.2)


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


def test_no_smaller_weight_is_plausible_if_the_fit_does_not_converge_there(case, monkeypatch):
    fit, problem = case
    rows, tried = fit.rows(compress(problem), NOISE), []
    minimise = type(fit.programme).minimise

    def fails(self, rows, weight, **options):
        tried.append(weight)
        if len(tried) == 3:
            raise NotConvergedError("stopped", "status")
        return minimise(self, rows, weight, **options)

    monkeypatch.setattr(type(fit.programme), "minimise", fails)
    assert plausible_weight(fit, rows, 40.0) == tried[1] < tried[0] == 40.0


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
    squares, _ = held_out_errors(fit, Segments.of(fit, segments, NOISE), 2.0)
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


@pytest.mark.parametrize("how", ["cv", "evidence"])
def test_a_choice_has_the_plausible_weight_from_that_of_the_largest_evidence(
    case, monkeypatch, how
):
    fit, problem = case
    segments, given = Segments.of(fit, cut(problem, 4)), []
    best = choose_weight(fit, segments, "evidence").weight
    monkeypatch.setattr(
        weighting, "plausible_weight", lambda *own: given.append(own) or 0.3 * own[2]
    )
    assert choose_weight(fit, segments, how).plausible == 0.3 * best
    assert given == [(fit, segments.rows, best)]


CHANCE = np.array([[0.05], [-0.05], [0.02], [-0.05], [0.05], [-0.02]])  # (segments, 1)


def chosen(case, monkeypatch, excess):
    """Return the choice where mean squares rise by excess (6, n) per decade away from 1."""
    fit, problem = case

    def errors(fit, segments, w, starts):
        return (1.0 + abs(np.log10(w)) * np.asarray(excess)) / 6.0, []

    monkeypatch.setattr("robotid.estimation.estimators.prior_weight.held_out_errors", errors)
    return choose_weight(fit, Segments.of(fit, cut(problem, 6)), "cv")


@pytest.mark.parametrize(("gain", "weight"), [(0.018, 100.0), (0.03, 10.0), (0.5, 1.0)])
def test_a_larger_weight_costs_at_most_two_percent_of_the_error(case, monkeypatch, gain, weight):
    choice = chosen(case, monkeypatch, gain + CHANCE)
    assert choice.weight == pytest.approx(weight)
    weights, scores = zip(*choice.curve, strict=True)
    assert weights[int(np.argmin(scores))] == pytest.approx(1.0)
    # the RMS over segments of chance that adds up to 0
    assert scores[-1] == pytest.approx(np.sqrt(1.0 + 2.0 * gain))


def test_a_certain_loss_is_refused_however_small(case, monkeypatch):
    assert chosen(case, monkeypatch, np.full((6, 1), 0.018)).weight == pytest.approx(1.0)


@pytest.mark.parametrize("bad", [[3], [1, 4]])
def test_one_or_two_bad_segments_reject_a_weight(case, monkeypatch, bad):
    excess = np.zeros((6, 6))
    excess[bad] = 30.0
    assert chosen(case, monkeypatch, excess).weight == pytest.approx(1.0)


@pytest.mark.parametrize(("loss", "weight"), [(1.04, 100.0), (1.06, 10.0)])
def test_no_joint_may_lose_more_than_five_percent(case, monkeypatch, loss, weight):
    excess = np.tile(CHANCE, (1, 6))
    excess[:, 4] += (loss**2 - 1.0) / 2.0  # at the weight of 100, two decades from the best
    assert chosen(case, monkeypatch, excess).weight == pytest.approx(weight)


def test_a_joint_at_rest_is_left_out_of_the_choice(case, monkeypatch):
    fit, problem = case

    def errors(fit, segments, w, starts):
        squares = (1.0 + abs(np.log10(w) + 2.0) * (0.009 + CHANCE)) / 6.0
        return np.hstack([squares, np.zeros_like(squares)]), []

    monkeypatch.setattr("robotid.estimation.estimators.prior_weight.held_out_errors", errors)
    choice = choose_weight(fit, Segments.of(fit, cut(problem, 6)), "cv")
    assert choice.weight == pytest.approx(100.0)
    assert choice.curve[-1][1] == pytest.approx(np.sqrt(1.036))


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


def test_the_information_of_all_segments_but_one_counts_the_share_that_is_independent(case):
    fit, problem = case
    fit, segments = replace(fit, independent_share=0.25), cut(problem, 3)
    for k, rows in enumerate(Segments.of(fit, segments, NOISE).others):
        others = fit.rows(merge([s for i, s in enumerate(segments) if i != k]), NOISE)
        np.testing.assert_allclose(rows.T @ rows, others.T @ others, rtol=1e-9, atol=1e-6)


def test_the_noise_level_is_that_of_the_whole_regressor_whatever_the_prior(case):
    fit, problem = case
    fit = replace(fit, prior_weight=100.0, independent_share=0.5)
    W, tau, _ = (np.concatenate(x) for x in zip(*problem.blocks(), strict=True))
    W, tau = W.reshape(-1, 6, W.shape[1]).swapaxes(0, 1), tau.reshape(-1, 6).T
    levels = np.ones(6)
    for _ in range(100):
        rows = (W / levels[:, None, None]).reshape(-1, len(fit.K))
        C = np.linalg.pinv(rows.T @ rows)
        r = tau - W @ (C @ rows.T @ (tau / levels[:, None]).ravel())
        used = np.einsum("jkp,jkp->j", W @ C, W) / levels**2
        levels = np.sqrt((r**2).sum(axis=1) / (tau.shape[1] - used))
        sigma = np.sqrt((r**2).sum(axis=1) / (tau.shape[1] - used / 0.5))
    np.testing.assert_allclose(fit.noise(compress(problem)), sigma, rtol=1e-3)


@pytest.mark.parametrize(("ratio", "weight"), [(1.09, 100.0), (1.11, 10.0)])
def test_no_joint_is_predicted_clearly_worse_than_by_least_squares(
    case, monkeypatch, ratio, weight
):
    """Joint 4 has ``ratio`` times the error of least squares at 100, and its error below."""
    fit, problem = case
    segments = Segments.of(fit, cut(problem, 6))
    least = segments.least_squares_errors

    def errors(fit, segments, w, starts):
        squares = least * (1.0 + abs(np.log10(w) + 2.0) * (1e-4 + 1e-2 * CHANCE))
        squares[:, 4] *= ratio**2 if w > 50.0 else 1.0
        return squares, []

    monkeypatch.setattr(weighting, "held_out_errors", errors)
    monkeypatch.setattr(weighting, "_MOST_JOINT_LOSS", 2.0)
    monkeypatch.setattr(weighting, "_ALIKE", 1e9)
    choice = choose_weight(fit, segments, "cv")
    assert choice.weight == pytest.approx(weight)
    assert choice.loss == pytest.approx(ratio if weight == 100.0 else 1.0, abs=1e-2)


def test_least_squares_predict_each_segment_from_the_others(case):
    fit, problem = case
    folds = cut(problem, 3)
    segments = Segments.of(fit, folds)
    for k, fold in enumerate(folds):
        R = fit.rows(merge([s for i, s in enumerate(folds) if i != k]), segments.sigma)
        theta = np.linalg.pinv(R[:, :-1]) @ R[:, -1]
        wanted = fold.residual_squares(theta) / segments.sigma**2 / sum(s.rows for s in folds)
        np.testing.assert_allclose(segments.least_squares_errors[k], wanted, rtol=1e-6)


def test_one_stretch_is_too_few(case):
    fit, problem = case
    with pytest.raises(DataError, match="needs at least 2 segments, found 1"):
        choose_weight(fit, Segments.of(fit, [compress(problem)]), "cv")


def test_an_unknown_way_is_refused():
    with pytest.raises(
        SettingsError, match="prior_weight is 'best', wanted a positive, finite number or one of"
    ):
        EstimatorSettings(prior_weight="best")


def test_poor_excitation_is_predicted_better_than_by_wls(ur5, rng):
    # 2 s of motion, then a new one
    pi = truth(ur5)
    short = exact_log(ur5, pi, rng, samples=100, noise=NOISE)
    new = exact_log(ur5, pi, rng, noise=NOISE)
    for weight in ("auto", 1.0):
        settings = EstimatorSettings(prior_weight=weight)
        found = fitted(ur5, [short], validation=[new], signals=EXACT, estimator=settings)
        measured = found.validation[0].metrics
        ours, wls = (
            np.array([m.rmse for m in measured[name].per_joint.values()])
            for name in ("estimate", "wls")
        )
        assert (ours < wls).all()
        assert ours.sum() < 0.6 * wls.sum()


def test_rows_that_repeat_each_other_tell_the_noise_no_better(ur5, rng):
    # each row four times over, of which a quarter is independent: the same as once
    log = exact_log(ur5, truth(ur5), rng, samples=40, noise=NOISE)
    trajectory, mapping = process(log, EXACT), structural_mapping(ur5)
    factors = compress(mapping.reduce(build_problem(ur5, trajectory)))
    prior = ur5.standard_parameters()
    fit = Consistent(
        ur5.layout, mapping.K, prior, prior_spread(ur5, trajectory.squares, len(trajectory.t))
    )
    once = fit.noise(factors)
    repeated = replace(fit, independent_share=0.25)
    np.testing.assert_allclose(repeated.noise(merge([factors] * 4)), once, rtol=3e-3)
    # weighted least squares believes in all of them
    assert np.median(fit.noise(merge([factors] * 4)) / once) < 0.95


def test_the_noise_level_of_few_rows_is_right_on_average(ur5, rng):
    found = []
    for _ in range(15):
        log = exact_log(ur5, truth(ur5), rng, samples=40, noise=NOISE)
        trajectory, mapping = process(log, EXACT), structural_mapping(ur5)
        factors = compress(mapping.reduce(build_problem(ur5, trajectory)))
        prior = ur5.standard_parameters()
        fit = Consistent(
            ur5.layout, mapping.K, prior, prior_spread(ur5, trajectory.squares, len(trajectory.t))
        )
        found.append(fit.noise(factors) ** 2)
    ratio = np.sqrt(np.mean(found, axis=0)) / NOISE
    # 15 runs of 30 degrees of freedom know it to 3 %; what the prior misses adds to it
    assert (ratio > 0.85).all()
    assert (ratio < 1.2).all()


def test_a_sum_of_errors_is_as_good_within_two_standard_errors_of_pairs(rng):
    best, p_value = rng.uniform(1.0, 9.0, 16), rng.standard_normal(16)
    p_value *= 0.3 / p_value.std(ddof=1)
    p_value -= p_value.mean()
    for times, is_as_good in ((-5.0, True), (1.95, True), (2.05, False)):
        # a sum of 16 differences scatters by 4 times what each does
        parts = best + p_value + times * 4.0 * 0.3 / 16
        assert _is_as_good(parts, best) is is_as_good
    assert not _is_as_good(best[:0], best[:0])


@dataclass(frozen=True)
class Boxed:
    """A fit of three bodies whose slacks of their boxes, by a fit without them, are given."""

    constraints: str
    slack: np.ndarray
    layout = SimpleNamespace(bodies=("a", "b", "c"))
    prior_std = np.array([2.0, 1.0, 1.0])  # in which the cone has its coefficients

    @property
    def programme(self):
        bounds = SimpleNamespace(
            G=np.diag(self.prior_std), h=np.full(3, 0.5), labels=[f"extent {x}" for x in "abc"]
        )
        x = self.slack - 0.5
        return SimpleNamespace(
            bounds=bounds,
            minimise=lambda rows, weight, is_exact: SimpleNamespace(x=x),
            covariance=lambda weight, rows, x: np.diag([4.0, 4.0, 0.25]),
        )


@pytest.mark.parametrize(
    ("ratio", "p_value", "named"),
    [(1.015, 0.0, ()), (1.025, 0.0, ("a", "c")), (1.025, 0.2, ()), (0.9, 0.0, ())],
)
def test_an_extent_is_contradicted_by_four_errors_two_percent_and_two_errors_of_pairs(
    monkeypatch, ratio, p_value, named
):
    constraints = SimpleNamespace(extent=("a", "b", "c"), without_extent=lambda _: "free")
    fit = Boxed(constraints, np.array([-8.1, -7.9, -2.1]))  # four times 2, 2 and 0.5
    swing = p_value * np.tile([1.0, -1.0], 4)

    def held_out(fit, segments, weight, starts=None):
        left = np.ones((8, 1)) if fit.constraints == "free" else ratio + swing[:, None]
        return left, []

    monkeypatch.setattr("robotid.estimation.estimators.prior_weight.held_out_errors", held_out)
    segments = SimpleNamespace(rows=None, folds=[None] * 8)
    assert contradicted_extents(fit, segments) == named


def test_extents_that_the_data_contradict_are_named_and_no_others(rng):
    z1 = RobotModel.from_urdf(example_urdf("z1.urdf"))
    link, last = z1.layout.bodies[-1], slice(z1.layout.n_inertial - 10, z1.layout.n_inertial)
    found = {}
    for mass in (0.0, 2.0):  # [kg], a tool 0.5 m in front of the last link
        pi = z1.standard_parameters()
        own = mass * 0.5**2
        pi[last] += [mass, 0.5 * mass, 0.0, 0.0, 0.0, 0.0, own, 0.0, 0.0, own]
        log = exact_log(z1, pi, rng, samples=500, noise=0.05)
        found[mass] = identify(z1, [log], signals=EXACT, estimator=EstimatorSettings())
    assert found[0.0].estimate.details["relaxed"] == []
    relaxed = found[2.0].estimate.details["relaxed"]
    assert link in relaxed
    assert set(relaxed) <= {"link06", link}  # its neighbour may carry the tool, too
    where = [f.where for f in found[2.0].findings if f.code == "extent_contradicted"]
    assert where == [f"link {body}" for body in relaxed]
    # and the tool is found where it is
    m, mx = found[2.0].standard[: z1.layout.n_inertial].reshape(-1, 10)[-2:, :2].sum(axis=0)
    true_m, true_mx = pi[: z1.layout.n_inertial].reshape(-1, 10)[-2:, :2].sum(axis=0)
    assert mx / m == pytest.approx(true_mx / true_m, rel=0.3)


@pytest.mark.parametrize(("loss", "accepted"), [(0.055, False), (0.045, True)])
def test_the_loss_of_a_segment_is_the_mean_of_the_joints_that_have_rows_in_it(loss, accepted):
    """Six segments in which one of three joints moves a little, six in which all move."""
    best, parts = np.zeros((2, 12, 3))
    best[:6, 0], best[6:] = 1e-3, 1.0
    parts[:6, 0], parts[6:] = 1e-3 * np.exp(2 * loss), np.exp(-2 * 0.012)
    excess = np.repeat([loss, -0.012], 6)
    assert (excess.mean() <= 2 * excess.std(ddof=1) / np.sqrt(12)) is np.bool_(accepted)
    assert weighting._is_accepted(parts, best, 0.0) is accepted


def test_a_larger_weight_may_leave_an_error_that_repeats_in_all_segments():
    best = np.full((6, 1), 1.0)
    worse = best * 1.01**2  # in each segment, without scatter
    assert not weighting._is_accepted(worse, best, 0.0)
    assert not weighting._is_accepted(worse, best, 0.009)
    assert weighting._is_accepted(worse, best, 0.011)
    assert not weighting._is_accepted(best * 1.03**2, best, 0.1)


@pytest.mark.parametrize(("repeated", "share"), [(0.0, 0.0), (0.36, 0.36), (0.75, 0.5)])
def test_an_error_that_repeats_makes_a_residual_larger_by_its_share(
    case, monkeypatch, repeated, share
):
    """Of a squared residual it is at most one half."""
    fit, problem = case
    segments, given = Segments.of(fit, cut(problem, 4)), []
    found = SimpleNamespace(plausible=None, curve=[(1.0, 0.0)], weight=1.0)

    def search(score, how, excess, *_):
        given.append((how, excess))
        return found

    monkeypatch.setattr(weighting, "_search", search)
    monkeypatch.setattr(weighting, "plausible_weight", lambda *_: 0.1)
    monkeypatch.setattr(weighting, "replace", lambda choice, **_: choice)
    choose_weight(fit, segments, "cv", repeated)
    assert given == [("evidence", 0.0), ("cv", pytest.approx(np.log(1 / np.sqrt(1 - share))))]


def test_the_best_weight_is_one_at_which_the_held_out_fits_converge(case, monkeypatch):
    """Errors fall with the weight, but fits below a weight of 5 do not converge."""
    fit, problem = case
    tried = []

    def errors(fit, segments, w, starts):
        tried.append(w)
        if w < 5.0:
            raise NotConvergedError("stopped", "status")
        return np.full((6, 6), w) * [1.0, 4.0, 1.0, 4.0, 1.0, 4.0], []

    monkeypatch.setattr(weighting, "held_out_errors", errors)
    choice = choose_weight(fit, Segments.of(fit, cut(problem, 6)), "cv")
    assert min(tried) < 5.0
    best = min(w for w in tried if w > 5.0)
    assert choice.weight == pytest.approx(best)
    # the geometric mean over joints of the root mean squares over six segments
    wanted = [(w, np.sqrt(6.0 * w) * 2.0**0.5) for w in sorted(tried) if w > 5.0]
    np.testing.assert_allclose(choice.curve, wanted, rtol=1e-9)
