"""The mixed-effects model against dense matrices, brute-force integration, and coverage."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.stats

from robotid.estimation.variation.mixed_effects import MixedEffects, Prediction, Runs, _posterior
from robotid.estimation.variation.restricted_likelihood import evidence, integrated

SCALE = np.array([0.2, 0.5])
BETWEEN = np.array([[0.13, 0.4], [0.31, 0.2]])  # runs, units


def drawn(rng, unit, *, mean=(2.0, -1.0), between=BETWEEN, rows=5):
    """Return runs with few rows each: x = mean + u_unit + u_run + e, and the rows A, y."""
    unit, blocks = np.asarray(unit), []
    u_unit = between[1] * rng.normal(size=(unit.max() + 1, 2))
    for k in unit:
        A = rng.normal(size=(rows, 2)) @ np.array([[1.0, 0.7], [0.0, 0.6]])
        x = np.asarray(mean) + u_unit[k] + between[0] * rng.normal(size=2)
        blocks.append((A, A @ x + rng.normal(size=rows)))
    return information(blocks, unit), blocks


def information(blocks, unit):
    H = np.array([A.T @ A for A, _ in blocks])
    h = np.array([A.T @ y for A, y in blocks])
    return Runs(H, h, np.asarray(unit), SCALE)


def dense(blocks, unit, deviation):
    """Return the restricted log likelihood, mean and covariance from the covariance of all rows."""
    A = scipy.linalg.block_diag(*[A for A, _ in blocks])
    X, y = np.concatenate([A for A, _ in blocks]), np.concatenate([y for _, y in blocks])
    same = np.eye(len(unit))
    V = A @ np.kron(same, np.diag(deviation[0] ** 2)) @ A.T + np.eye(len(y))
    if len(deviation) == 2:
        shared = np.equal.outer(unit, unit).astype(float)
        V += A @ np.kron(shared, np.diag(deviation[1] ** 2)) @ A.T
    W = np.linalg.inv(V)
    P = X.T @ W @ X + np.diag((100.0 * SCALE) ** -2.0)
    C = np.linalg.inv(P)
    mean = C @ X.T @ W @ y
    size = np.linalg.slogdet(V)[1] + np.linalg.slogdet(P)[1] + y @ W @ y - y @ W @ X @ mean
    return -0.5 * size, mean, C, (A, X, y, W)


@pytest.mark.parametrize("unit", [(0, 0, 0, 0), (0, 0, 1, 1, 1, 2)])
def test_restricted_likelihood_and_mean_are_those_of_the_covariance_of_all_rows(unit):
    runs, blocks = drawn(np.random.default_rng(1), unit)
    levels, of_unit = (2, runs.unit) if max(unit) else (1, None)
    tried = np.array([[[0.1, 0.2], [0.3, 0.1]], [[0.5, 0.01], [0.02, 0.7]]])[:, :levels]
    H, h = np.moveaxis(runs.H, 0, -1)[:, :, None], runs.h.T[:, None]
    found = evidence(H, h, of_unit, SCALE, np.moveaxis(tried, 0, -1) ** 2)
    wanted = [dense(blocks, np.array(unit), each) for each in tried]
    difference = found.log_likelihood[1] - found.log_likelihood[0]
    assert difference == pytest.approx(wanted[1][0] - wanted[0][0], rel=1e-9)
    for k in range(2):
        assert found.mean[k] == pytest.approx(wanted[k][1], rel=1e-9)
        assert found.covariance[k] == pytest.approx(wanted[k][2], rel=1e-9)


def test_values_in_each_run_are_the_best_linear_unbiased_prediction():
    unit = np.array([0, 0, 1, 1, 1, 2])
    runs, blocks = drawn(np.random.default_rng(2), unit)
    model = MixedEffects(runs)
    deviation = model.deviation
    _, mean, C, (A, X, y, W) = dense(blocks, unit, deviation)
    own = np.kron(np.eye(6), np.diag(deviation[0] ** 2))
    shared = np.kron(np.equal.outer(unit, unit).astype(float), np.diag(deviation[1] ** 2))
    wanted = mean + ((own + shared) @ A.T @ W @ (y - X @ mean)).reshape(6, 2)
    values, errors = model.values
    assert values == pytest.approx(wanted, rel=1e-8)
    G, same = own + shared, np.tile(np.eye(2), (6, 1))
    P = W - W @ X @ C @ X.T @ W
    cross = -same @ C @ X.T @ W @ A @ G
    total = same @ C @ same.T + G - G @ A.T @ P @ A @ G + cross + cross.T
    assert errors.ravel() == pytest.approx(np.sqrt(np.diag(total)), rel=1e-3)


def test_runs_left_over_have_their_units_numbered_anew():
    runs, _ = drawn(np.random.default_rng(8), [0, 1, 1, 2])
    left = runs.without(0)
    assert left.unit.tolist() == [0, 0, 1]
    assert left.H.tolist() == runs.H[1:].tolist()
    assert left.h.tolist() == runs.h[1:].tolist()


def test_most_probable_deviations_maximise_the_density():
    unit = np.array([0, 0, 1, 1, 1, 2])
    runs, blocks = drawn(np.random.default_rng(3), unit)
    best = MixedEffects(runs).deviation

    def density(deviation):
        z = np.log(deviation / SCALE)
        prior = np.log(np.exp(z) * scipy.stats.t(4).pdf(np.exp(z))).sum()
        return dense(blocks, unit, deviation)[0] + prior

    top = density(best)
    inside = np.abs(np.log(best / SCALE)) < 4.9
    assert inside.any()
    for level, p in zip(*np.nonzero(inside), strict=True):
        for factor in (0.9, 1.1):
            tried = best.copy()
            tried[level, p] *= factor
            assert density(tried) < top


def test_prediction_of_one_parameter_is_the_brute_force_integral():
    rng = np.random.default_rng(4)
    x, error = np.array([1.3, 2.1, 1.7, 2.6]), np.array([0.2, 0.5, 0.3, 0.2])
    runs = Runs((error**-2.0)[:, None, None], (x / error**2)[:, None], np.zeros(4, int),
                np.array([0.3]))  # fmt: skip
    (found,) = MixedEffects(runs).predict(np.array([0.04]), np.array([4.5]))
    s = 0.3 * np.exp(rng.uniform(-6, 5, 200_000))  # density of log s is uniform here
    weight = 1 / (error**2 + s[:, None] ** 2)
    total = weight.sum(axis=1)
    mean = weight @ x / total
    log = 0.5 * np.log(weight).sum(axis=1) - 0.5 * np.log(total)
    log -= 0.5 * (weight * (x - mean[:, None]) ** 2).sum(axis=1)
    density = np.exp(log) * s / 0.3 * scipy.stats.t(4).pdf(s / 0.3)
    density /= density.sum()
    draws = rng.choice(len(s), 200_000, p=density)
    new = mean[draws] + np.sqrt(1 / total[draws] + s[draws] ** 2 + 0.04) * rng.normal(size=200_000)
    assert found.mean == pytest.approx(density @ mean, abs=0.01)
    assert found.ends == pytest.approx(np.quantile(new, [0.025, 0.975]), abs=0.04)
    assert found.spread == pytest.approx(np.quantile(s[draws], 0.5), rel=0.05)
    assert found.spread_ends == pytest.approx(np.quantile(s[draws], [0.025, 0.975]), rel=0.1)
    assert found.probability == pytest.approx(2 * np.mean(new > 4.5), rel=0.15)
    error = np.sqrt(density @ (1 / total + mean**2) - (density @ mean) ** 2)
    assert found.std_error == pytest.approx(error, rel=0.02)


def test_the_mean_is_uncertain_by_the_spread_too_if_runs_have_unlike_errors():
    """One accurate run differs from eight inaccurate ones: the mean depends on the spread."""
    x, error = np.append(0.0, 3.0 + 0.1 * np.arange(8)), np.append(0.02, np.full(8, 2.0))
    runs = Runs((error**-2.0)[:, None, None], (x / error**2)[:, None], np.zeros(9, int), np.ones(1))
    (found,) = MixedEffects(runs).predict()
    z = np.linspace(-6.0, 5.0, 20_001)  # log of the spread
    weight = 1 / (error**2 + np.exp(2 * z)[:, None])
    total = weight.sum(axis=1) + 1e-4  # the prior of the mean: 0 with a deviation of 100
    mean = weight @ x / total
    log = 0.5 * np.log(weight).sum(axis=1) - 0.5 * np.log(total)
    log += 0.5 * (total * mean**2 - weight @ x**2) + z + scipy.stats.t(4).logpdf(np.exp(z))
    density = np.exp(log - log.max())
    density /= density.sum()
    average = density @ mean
    within, between = density @ (1 / total), density @ (mean - average) ** 2
    assert between > 0.2 * within
    assert found.mean == pytest.approx(average, rel=0.01)
    assert found.std_error == pytest.approx(np.sqrt(within + between), rel=0.01)


def test_a_run_that_tells_nothing_of_a_parameter_changes_nothing():
    unit = [0, 0, 0, 0]
    runs, _ = drawn(np.random.default_rng(5), unit)
    more = Runs(np.concatenate([runs.H, np.zeros((1, 2, 2))]),
                np.concatenate([runs.h, np.zeros((1, 2))]), np.zeros(5, int), SCALE)  # fmt: skip
    ours, theirs = MixedEffects(runs).predict(), MixedEffects(more).predict()
    assert [x.ends for x in ours] == [pytest.approx(x.ends, rel=1e-4) for x in theirs]
    assert MixedEffects(more.without(4)).predict()[1].mean == pytest.approx(ours[1].mean)


def test_prediction_intervals_of_the_next_robot_and_of_spreads_cover():
    rng, inside, spreads, count = np.random.default_rng(6), 0, 0, 40
    for _ in range(count):
        unit = np.repeat(np.arange(7), 3)
        runs, blocks = drawn(rng, unit, rows=12)
        known = unit < 6
        model = MixedEffects(Runs(runs.H[known], runs.h[known], unit[known], SCALE))
        A, y = blocks[-1]
        x, C = np.linalg.solve(A.T @ A, A.T @ y), np.linalg.inv(A.T @ A)
        for p, found in enumerate(model.predict(np.diag(C))):
            inside += found.ends[0] < x[p] < found.ends[1]
            spreads += found.spread_ends[0] < BETWEEN[1, p] < found.spread_ends[1]
    assert 0.9 <= inside / (2 * count) <= 1.0
    assert 0.9 <= spreads / (2 * count) <= 1.0


def test_prediction_is_shifted_by_a_constant():
    found = Prediction(1.0, 0.5, 0.2, np.array([0.1, 0.4]), np.array([0.0, 2.5]), 0.3)
    moved = found.shifted(10.0)
    assert (moved.mean, moved.std_error, moved.spread, moved.probability) == (11.0, 0.5, 0.2, 0.3)
    assert moved.ends.tolist() == [10.0, 12.5]
    assert moved.spread_ends.tolist() == [0.1, 0.4]


def test_a_unit_is_estimated_from_its_runs_and_predicted_without_their_deviation():
    unit = np.repeat(np.arange(4), 2)
    runs, blocks = drawn(np.random.default_rng(9), unit)
    left = 2
    model = MixedEffects(runs.without_unit(left))
    found = MixedEffects(runs).against_others(np.array([left]), is_unit=True)
    x, C = found.values[0], found.covariance[0]
    own = [block for block, u in zip(blocks, unit, strict=True) if u == left]
    A = scipy.linalg.block_diag(*[A for A, _ in own])
    X, y = np.concatenate([A for A, _ in own]), np.concatenate([y for _, y in own])
    V = A @ np.kron(np.eye(2), np.diag(model.deviation[0] ** 2)) @ A.T + np.eye(len(y))
    P = X.T @ np.linalg.solve(V, X) + np.diag((100.0 * SCALE) ** -2.0)
    assert pytest.approx(np.linalg.inv(P)) == C
    assert x == pytest.approx(np.linalg.solve(P, X.T @ np.linalg.solve(V, y)))
    pairs = zip(model.predict(is_unit=True), model.predict(), model.deviation[0], strict=True)
    for of_unit, of_run, deviation in pairs:
        assert of_unit.mean == of_run.mean
        variance = of_run.mixture[2] ** 2 - of_unit.mixture[2] ** 2
        assert variance == pytest.approx(np.full(len(variance), deviation**2))
    assert runs.of_unit(left).unit.tolist() == [0, 0]
    assert runs.without_unit(left).unit.tolist() == [0, 0, 1, 1, 2, 2]


@pytest.mark.parametrize(
    ("unit", "is_unit"),
    [
        ((0, 0, 0, 0, 0), False),
        ((0, 0, 1, 1, 1, 2, 2), False),
        ((0, 0, 0, 1), False),  # without the last run there is one unit
        ((0, 0, 1, 1, 1, 2, 3), True),
        ((0, 0, 1, 1, 1), True),  # two units: the others are one
    ],
)
def test_each_is_compared_with_the_others_as_if_it_had_never_been(unit, is_unit):
    runs, _ = drawn(np.random.default_rng(11), unit)
    factor = np.array([1.0, 1e3, 1e-2, *np.ones(len(unit) - 3)])  # unlike information
    runs = replace(runs, H=runs.H * factor[:, None, None], h=runs.h * factor[:, None])
    every, count = MixedEffects(runs), 1 + max(unit) if is_unit else len(unit)
    which = np.arange(count)[::-1]
    found = every.against_others(which, is_unit=is_unit)
    for k, left in enumerate(which):
        without = runs.without_unit(left) if is_unit else runs.without(left)
        others = MixedEffects(without, every.deviation)
        x, C = found.values[k], found.covariance[k]
        if is_unit:  # its runs vary as those of the others
            S = np.diag(others.deviation[0] ** 2)
            own = runs.of_unit(left)
            W = np.array([H @ np.linalg.inv(np.eye(2) + S @ H) for H in own.H])
            each = np.array(
                [np.linalg.solve(np.eye(2) + H @ S, h) for H, h in zip(own.H, own.h, strict=True)]
            )
            information, score = W.sum(axis=0), each.sum(axis=0)
        else:
            information, score = runs.H[left], runs.h[left]
        wanted = np.linalg.inv(information + np.diag((100.0 * SCALE) ** -2.0))
        np.testing.assert_allclose(C, wanted, rtol=1e-7)
        np.testing.assert_allclose(x, wanted @ score, rtol=1e-7)
        expected = others.predict(np.diag(C), x, is_unit=is_unit)
        np.testing.assert_allclose(found.mean[k], [e.mean for e in expected], rtol=1e-8)
        wanted = [e.probability for e in expected]
        np.testing.assert_allclose(found.probability[k], wanted, rtol=1e-8)


def test_slopes_of_the_likelihood_are_its_finite_differences():
    unit, rng = np.array([0, 0, 1, 1, 1, 2]), np.random.default_rng(12)
    runs, _ = drawn(rng, unit)
    H, h = np.moveaxis(runs.H, 0, -1)[:, :, None], runs.h.T[:, None]
    variance = np.exp(rng.normal(size=(2, 2, 3)))
    for levels, of_unit in ((1, None), (2, unit)):
        found = evidence(H, h, of_unit, SCALE, variance[:levels])
        for level, p in np.ndindex(levels, 2):
            step = np.zeros((levels, 2, 1))
            step[level, p] = 1e-5
            above, below = (
                evidence(H, h, of_unit, SCALE, variance[:levels] + side).log_likelihood
                for side in (step, -step)
            )
            wanted = (above - below) / 2e-5
            np.testing.assert_allclose(found.slope[level, p], wanted, rtol=1e-5, atol=1e-8)


def test_many_runs_without_scatter_have_the_smallest_spread():
    """The information is far above the spread: the most probable one is at the bound."""
    runs = Runs(np.full((5, 1, 1), 1e12), np.full((5, 1), 2e12), np.zeros(5, int), np.ones(1))
    assert MixedEffects(runs).deviation == pytest.approx(np.exp(-6.0) * np.ones((1, 1)))


def test_the_start_of_the_search_does_not_matter():
    runs, _ = drawn(np.random.default_rng(3), (0, 0, 1, 1, 1, 2))
    best = MixedEffects(runs).deviation
    for first in (best, 3.0 * best, np.full((2, 2), 1e-9)):
        assert MixedEffects(runs, first).deviation == pytest.approx(best, rel=0.02)
    alone = Runs(runs.H, runs.h, np.zeros(6, int), SCALE)
    assert MixedEffects(alone, best).deviation == pytest.approx(
        MixedEffects(alone).deviation, rel=0.02
    )


def test_quantiles_are_those_of_the_mixture():
    weight, mean, std = np.array([0.3, 0.7]), np.array([1.0, 2.0]), np.array([0.5, 3.0])
    found = Prediction(
        1.7, 0.1, 0.2, np.zeros(2), np.zeros(2), mixture=np.array([weight, mean, std])
    )
    values = found.shifted(4.0).quantiles(np.array([-2.0, 0.0, 1.5])) - 4.0
    below = (weight * scipy.stats.norm.cdf((values[:, None] - mean) / std)).sum(axis=1)
    assert below == pytest.approx(scipy.stats.norm.cdf([-2.0, 0.0, 1.5]))


def test_one_more_run_adds_its_expected_likelihood():
    x, error = np.array([1.3, 2.1, 1.7, 2.6, 1.9]), 0.3
    runs = Runs(np.full((5, 1, 1), error**-2.0), (x / error**2)[:, None], np.zeros(5, int),
                np.array([0.3]))  # fmt: skip
    (found,) = MixedEffects(runs).with_one_more()
    s = 0.3 * np.exp(np.linspace(-6, 5, 45))
    v = s**2 + error**2
    log = -0.5 * (4 * np.log(v) + ((x - x.mean()) ** 2).sum() / v)
    log += np.log(s) + np.log(scipy.stats.t(4).pdf(s / 0.3))
    total, at = v * 6 / 5, (found.spread**2 + error**2) * 6 / 5
    log -= 0.5 * (np.log(total) + at / total)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    assert found.after[0] == pytest.approx(np.sqrt(weight @ (v / 6)), rel=0.01)
    std = np.sqrt(v / 6 + s**2)

    def beyond(end):
        return weight @ scipy.stats.norm.sf(end / std)

    end = scipy.optimize.brentq(lambda end: beyond(end) - 0.025, 0.0, 50.0)
    assert found.after[1] == pytest.approx(2 * end, rel=0.01)
    assert found.after[1] < np.ptp(found.ends)


def test_one_more_run_narrows_intervals_as_much_as_expected():
    rng, expected, found = np.random.default_rng(5), [], []
    for _ in range(40):
        x = 0.4 * rng.normal(size=7) + 0.1 * rng.normal(size=7)
        every = Runs(np.full((7, 1, 1), 100.0), 100.0 * x[:, None], np.zeros(7, int),
                     np.array([0.3]))  # fmt: skip
        (before,) = MixedEffects(every.without(6)).with_one_more()
        (after,) = MixedEffects(every).predict()
        expected.append((before.after[0] / before.std_error, before.after[1] / np.ptp(before.ends)))
        found.append((after.std_error / before.std_error, np.ptp(after.ends) / np.ptp(before.ends)))
    assert np.mean(np.log(found), axis=0) == pytest.approx(
        np.mean(np.log(expected), axis=0), abs=0.05
    )


def test_information_far_above_the_spread_is_integrated_without_rounding():
    """(H^-1 + S^2)^-1 of diagonal matrices: 1 / S^2 where H is large, H where it is small."""
    H, S, x = np.array([1e18, 3e12, 1e-3]), np.array([0.1, 0.02, 2.0]), np.array([2.0, -1.0, 5.0])
    W, w, _ = integrated(np.diag(H)[:, :, None, None], (H * x)[:, None, None], S[:, None] ** 2)
    wanted = H / (1.0 + S**2 * H)
    np.testing.assert_allclose(W[:, :, 0, 0], np.diag(wanted), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(w[:, 0, 0], wanted * x, rtol=1e-9)
    U = _posterior(np.diag(H)[None], S)
    np.testing.assert_allclose(np.diag(U[0]), S**2 / (1.0 + S**2 * H), rtol=1e-9)


def mixture(log, mean, variance, between, value):
    """Return weights, mean and its error, ends of 95 %, and the probability below a value."""
    weight = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
    std = np.sqrt(variance + between)
    centre = weight @ mean
    error = np.sqrt(weight @ (variance + (mean - centre) ** 2))

    def below(x):
        return weight @ scipy.stats.norm.cdf((x - mean) / std)

    ends = [
        scipy.optimize.brentq(lambda x, share=share: below(x) - share, -900, 900)
        for share in (0.025, 0.975)
    ]
    return weight, centre, error, ends, below(value)


@pytest.mark.parametrize("unit", [(0, 0, 0, 0, 0), (0, 0, 1, 1, 1, 2, 2)])
def test_predictions_are_those_of_dense_matrices_on_a_grid_of_spreads(unit):
    """All outputs, with and without one more run or unit; other deviations are fixed."""
    unit = np.array(unit)
    runs, blocks = drawn(np.random.default_rng(12), unit)
    model = MixedEffects(runs)
    members = max(len(set(unit.tolist())), 1) if unit.max() else len(unit)
    own, value = np.array([0.04, 0.3]), np.array([2.9, -0.2])
    z, prior = np.linspace(-6.0, 5.0, 45), np.diag((100.0 * SCALE) ** -2.0)
    every = zip(model.predict(own, value), model.with_one_more(), strict=True)
    for p, (found, more) in enumerate(every):
        s = SCALE[p] * np.exp(z)
        tried = np.repeat(model.deviation[None], 45, axis=0)
        tried[:, -1, p] = s
        log, mean, C = zip(*[dense(blocks, unit, x)[:3] for x in tried], strict=True)
        log = np.array(log) + z + np.log(scipy.stats.t(4).pdf(s / SCALE[p]))
        mean, variance = np.array(mean)[:, p], np.array([x[p, p] for x in C])
        between = (tried[:, :, p] ** 2).sum(axis=1)

        weight, centre, error, ends, below = mixture(
            log, mean, variance, between + own[p], value[p]
        )
        assert found.mean == pytest.approx(centre, rel=1e-6)
        assert found.std_error == pytest.approx(error, rel=1e-6)
        assert found.ends == pytest.approx(ends, rel=1e-6)
        assert found.probability == pytest.approx(2.0 * min(below, 1.0 - below), rel=1e-6)
        middle = np.cumsum(weight) - 0.5 * weight
        quantiles = SCALE[p] * np.exp(np.interp([0.025, 0.5, 0.975], middle, z))
        low, high = found.spread_ends
        assert [low, found.spread, high] == pytest.approx(quantiles)
        alone = np.array([np.linalg.inv((np.linalg.inv(x) - prior) / members + prior) for x in C])
        total = alone[:, p, p] + variance
        log = log - 0.5 * (np.log(total) + np.interp(found.spread, s, total) / total)
        more_variance = variance * members / (members + 1)
        _, _, error, ends, _ = mixture(log, mean, more_variance, between, 0.0)
        assert more.after == pytest.approx((error, ends[1] - ends[0]), rel=1e-6)
        moved = found.shifted(3.0)
        assert moved.mixture[1] == pytest.approx(found.mixture[1] + 3.0)
        assert moved.mixture[[0, 2]].tolist() == found.mixture[[0, 2]].tolist()
