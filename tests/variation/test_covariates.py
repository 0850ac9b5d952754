"""Effects of temperature and time on parameters of runs, against generalised least squares."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ndtr

from robotid.exceptions import DataError
from robotid.variation.covariates import at_temperature, effects_of, model_of, with_effects
from robotid.variation.groups import Covariate, Group, RunsOf
from robotid.variation.mixed_effects import MixedEffects, Runs, Slope
from robotid.variation.restricted_likelihood import evidence
from robotid.variation.variation import between_covariance, effects_by_log, vary

UNIT = np.array([0, 0, 0, 1, 1, 2, 2, 2, 2])


def drawn_runs(rng, *, q=2, unit=UNIT, scale=0.5):
    """Return estimates of q parameters in runs, x and covariances, and the runs."""
    count = len(unit)
    A = rng.normal(size=(count, q, q))
    C = 0.05 * (np.einsum("kij,klj->kil", A, A) + np.eye(q))
    x, H = rng.normal(size=(count, q)), np.linalg.inv(C)
    return x, C, Runs(H, np.einsum("kij,kj->ki", H, x), unit, np.full(q, scale))


def least_squares(x, C, slopes, deviation, unit):
    """Return the generalised least squares estimate of means and slopes, and its covariance."""
    count, q = x.shape
    X = np.zeros((count, q, q + len(slopes)))
    X[:, range(q), range(q)] = 1.0
    for s, slope in enumerate(slopes):
        X[:, slope.parameter, q + s] = slope.covariate
    same = 1.0 * (unit[:, None] == unit) if len(deviation) > 1 else np.zeros((count, count))
    V = np.einsum("kl,ij->kilj", same, np.diag(deviation[-1] ** 2)) if len(deviation) > 1 else 0.0
    V = V + np.einsum("kl,kij->kilj", np.eye(count), C + np.diag(deviation[0] ** 2))
    V, X, y = V.reshape(count * q, -1), X.reshape(count * q, -1), x.ravel()
    P = np.linalg.inv(X.T @ np.linalg.solve(V, X))
    return P @ X.T @ np.linalg.solve(V, y), P


@pytest.mark.parametrize("unit", [np.zeros(9, int), UNIT])
def test_means_and_slopes_are_those_of_generalised_least_squares(unit):
    rng = np.random.default_rng(1)
    x, C, runs = drawn_runs(rng, unit=unit)
    slopes = [Slope(1, rng.normal(size=9) + 3.0, 0.4), Slope(0, rng.normal(size=9), 0.2)]
    model = MixedEffects(runs.with_slopes(slopes))
    levels = 1 + int(unit.max() > 0)
    deviation = np.array([[0.3, 0.7], [0.5, 0.2]])[:levels]
    variance = np.hstack([deviation, np.zeros((levels, 2))])[:, :, None] ** 2
    found = evidence(*model._members, model.runs.scale, variance)
    mean, covariance = found.mean[0], found.covariance[0]
    wanted, P = least_squares(x, C, slopes, deviation, unit)
    assert mean == pytest.approx(wanted, abs=2e-3)  # of a prior of 100 plausible sizes
    assert np.sqrt(np.diag(covariance)) == pytest.approx(np.sqrt(np.diag(P)), rel=2e-3)
    assert (model.deviation[:, 2:] < 1e-4).all()
    # other slopes replace the present ones
    again = model.runs.with_slopes(slopes[:1])
    assert pytest.approx(runs.with_slopes(slopes[:1]).H) == again.H


def test_a_prediction_at_a_covariate_is_that_of_runs_seen_from_it():
    rng = np.random.default_rng(2)
    _, _, runs = drawn_runs(rng)
    slopes = [Slope(1, rng.normal(size=9), 0.4), Slope(1, rng.normal(size=9), 0.2)]
    model = MixedEffects(runs.with_slopes(slopes))
    seen = MixedEffects(model.runs.seen_from([0.8, -1.5]))
    ahead, there = model.predict(at=[0.8, -1.5]), seen.predict()
    here = model.predict()
    assert len(here) == len(there) == 2
    for own, other in zip(ahead, there, strict=True):
        assert own.ends == pytest.approx(other.ends, rel=5e-3)
        assert own.mean == pytest.approx(other.mean, rel=5e-3)
    change = 0.8 * model.slope(0)[0] - 1.5 * model.slope(1)[0]
    assert ahead[1].mean - here[1].mean == pytest.approx(change, rel=0.05)
    assert ahead[0].ends == pytest.approx(here[0].ends, rel=1e-5)  # the prior is that there
    assert np.ptp(ahead[1].ends) > np.ptp(here[1].ends)


def group(x, error, covariates, *, name="elbow", unit=None, scale=0.1):
    """Return estimates (k, q) of the terms of a drive in k runs, each with one standard error."""
    count, size = x.shape
    names = tuple(f"{name}.{term}" for term in ("viscous", "coulomb", "offset")[:size])
    H = np.tile(np.eye(size) / error**2, (count, 1, 1))
    runs = Runs(H, x / error**2, np.zeros(count, int) if unit is None else unit,
                np.full(size, scale))  # fmt: skip
    about = Group("drive", name, names, ("N m",) * size, np.eye(size), (0,))
    return RunsOf(about, np.full(size, 2.0), runs, 1.0, tuple(covariates))


def test_intervals_of_a_slope_cover_it_and_alike_runs_have_no_effect():
    inside = found = false = 0
    for seed in range(80):
        rng = np.random.default_rng([6, seed])
        warm = 25.0 + 8.0 * rng.normal(size=8)
        x = 0.08 * rng.normal(size=(8, 1)) - 0.02 * (warm - 25.0)[:, None]
        known = [Covariate("temperature", "degC", warm)]
        own = group(x + 0.02 * rng.normal(size=(8, 1)), 0.02, known)
        c = warm - warm.mean()
        moved = own.runs.with_slopes([Slope(0, c, 0.1 / c.std())])
        at = np.einsum("kij,j->ki", moved.H, [0.0, -0.02])  # about the true slope
        about = MixedEffects(Runs(moved.H, moved.h - at, moved.unit, moved.scale, moved.slopes))
        size, error, p_value = about.slope(0)
        inside += p_value > 0.05
        assert abs(size) < 6 * error
        if seed < 60:
            found += bool(with_effects([own])[0].runs.slopes)
            mixed = group(rng.permutation(x), 0.02, own.covariates)
            false += bool(with_effects([mixed])[0].runs.slopes)
    assert 0.89 <= inside / 80 <= 0.987  # 95 % and -2.5 to 1.5 standard errors
    assert found >= 40  # of 60; 1.6 standard deviations of the spread per that of the temperature
    assert false <= 3  # of 60; 2 % expected


def two_drives(rng, *, slope=-0.02, count=10):
    """Return two drives, the viscous friction of the second depends on its own temperature."""
    warm, other = 20 + 8 * rng.normal(size=(2, count))
    time = np.linspace(400.0, 430.0, count)
    x = 0.03 * rng.normal(size=(2, count, 2))
    x[1, :, 0] += slope * (warm - warm.mean())
    hours = Covariate("time", "h", time)
    first = group(x[0], 0.01, [Covariate("temperature", "degC", other), hours], name="lift")
    second = group(x[1], 0.01, [Covariate("temperature", "degC", warm), hours])
    return [first, second], warm


@pytest.fixture(scope="module")
def of_two_drives():
    """Two drives in ten runs, the temperatures of the second, and the variation of both."""
    groups, warm = two_drives(np.random.default_rng(3))
    return groups, warm, vary([f"run_{k}" for k in range(10)], groups)


def test_an_effect_is_found_with_its_parameter_and_the_interval_at_a_temperature(of_two_drives):
    _, warm, variation = of_two_drives
    used = [(each.name, own.covariate.name) for each in variation.parameters
            for own in each.effects if own.is_used]  # fmt: skip
    assert used == [("elbow.viscous", "temperature")]
    (viscous,) = [each for each in variation.parameters if each.name == "elbow.viscous"]
    assert [own.covariate.name for own in viscous.effects] == ["temperature", "time"]
    effect, unused = viscous.effects
    assert effect.slope == pytest.approx(-0.02, abs=3 * effect.std_error)
    assert effect.std_error == pytest.approx(0.032 / warm.std() / np.sqrt(10), rel=0.5)
    assert viscous.prediction.spread < 0.06  # 0.16 without the temperature
    assert unused.probability > 0.001
    # the interval moves with the mean and is wider far away
    low, high = effect.interval(warm.max())
    middle = 0.5 * (low + high) - viscous.prediction.mean
    assert middle == pytest.approx(effect.slope * (warm.max() - warm.mean()), rel=0.1)
    assert high - low > np.ptp(viscous.prediction.ends)
    seen = viscous.seen_ends
    assert seen[0] == pytest.approx(low)
    assert seen[1] == pytest.approx(effect.interval(warm.min())[1])
    with pytest.raises(DataError, match=r"temperature is 99 degC, wanted .* half of it beyond"):
        effect.interval(99.0)
    with pytest.raises(DataError, match="the time has no effect on this parameter"):
        unused.interval(410.0)
    # values are those at the mean temperature
    assert np.abs(np.corrcoef(viscous.values, warm)[0, 1]) < 0.3
    # the next log is at any of the temperatures
    plain = variation.to_dict()
    C = between_covariance(plain, ["elbow.coulomb", "elbow.viscous"])
    without = viscous.prediction.spread**2
    assert C[1, 1] - without == pytest.approx(np.var(effect.slope * warm, ddof=1))
    found = plain["parameters"]["elbow.viscous"]
    assert found["effects"]["temperature"]["by_log"] == warm.tolist()
    assert found["seen_interval"] == seen.tolist()
    assert "seen_interval" not in plain["parameters"]["elbow.coulomb"]


def test_the_interval_at_a_covariate_has_the_other_one_at_its_mean():
    rng = np.random.default_rng(8)
    warm, hours = 20.0 + 8.0 * rng.normal(size=12), 5.0 + rng.normal(size=12)
    x = 0.02 * rng.normal(size=(12, 1)) + (0.03 * warm - 0.4 * hours)[:, None]
    both = [Covariate("temperature", "degC", warm), Covariate("time", "h", hours)]
    (own,) = with_effects([group(x - x.mean(), 0.01, both)])
    model = MixedEffects(own.runs)
    effects, (plain,) = effects_of(own, model, 0), model.predict()
    assert [each.is_used for each in effects] == [True, True]
    for each, slope in zip(effects, (0.03, -0.4), strict=True):
        values = each.covariate.values
        middle = each.interval(values.max()).mean() - 2.0 - plain.mean
        assert middle == pytest.approx(slope * (values.max() - values.mean()), abs=0.04)
    moved = effects_by_log([{}, {"effects": {x.covariate.name: x.to_dict() for x in effects}}])
    wanted = sum(x.slope * (x.covariate.values - x.covariate.values.mean()) for x in effects)
    np.testing.assert_allclose(moved, np.column_stack([np.zeros(12), wanted]), atol=1e-12)


def test_predictions_of_a_result_are_moved_to_a_temperature(of_two_drives):
    _, warm, before = of_two_drives
    plain = before.to_dict()
    moved = at_temperature(plain, float(warm.max()))["parameters"]
    (viscous,) = [each for each in before.parameters if each.name == "elbow.viscous"]
    effect, own, old = viscous.effects[0], moved["elbow.viscous"], plain["parameters"]
    assert own["next_interval"] == effect.interval(warm.max()).tolist()
    assert own["seen_interval"] == pytest.approx(own["next_interval"])
    change = effect.slope * (warm.max() - warm.mean())
    assert own["mean"] == pytest.approx(viscous.prediction.mean + change)
    assert own["next_quantiles"][7] == pytest.approx(np.mean(own["next_interval"]), abs=0.01)
    ratio = np.ptp(own["next_interval"]) / np.ptp(viscous.prediction.ends)
    assert np.ptp(own["next_quantiles"]) == pytest.approx(
        ratio * np.ptp(old["elbow.viscous"]["next_quantiles"])
    )
    assert moved["elbow.coulomb"] == old["elbow.coulomb"]
    assert plain == before.to_dict()
    with pytest.raises(DataError, match="temperature is -40 degC, wanted"):
        at_temperature(plain, -40.0)
    for entry in plain["parameters"].values():
        entry["effects"]["temperature"]["is_used"] = False
    with pytest.raises(DataError, match="temperature has no effect on a drive parameter"):
        at_temperature(plain, 20.0)


def test_the_next_log_has_the_known_effects_of_the_temperatures_of_its_drives():
    rng = np.random.default_rng(3)
    warm, x = 20.0 + 8.0 * rng.normal(size=(2, 10)), 0.03 * rng.normal(size=(2, 10, 2))
    slopes, names = (-0.02, 0.03), ("lift.viscous", "elbow.viscous", "elbow.coulomb")
    x[:, :, 0] += np.array(slopes)[:, None] * (warm - warm.mean(axis=1, keepdims=True))
    groups = [group(own, 0.01, [Covariate("temperature", "degC", each)], name=name)
              for own, each, name in zip(x, warm, ("lift", "elbow"), strict=True)]  # fmt: skip
    plain = vary([str(k) for k in range(10)], groups).to_dict()
    effects = [plain["parameters"][name]["effects"]["temperature"] for name in names]
    assert [each["is_used"] for each in effects] == [True, True, False]
    at = {"lift": 31.0, "elbow": 12.0}
    away = np.array([31.0, 12.0]) - [each["mean"] for each in effects[:2]]
    moved = np.append(away * [each["slope"] for each in effects[:2]], 0.0)
    error = np.append(away * [each["std_error"] for each in effects[:2]], 0.0)
    order = [list(plain["parameters"]).index(name) for name in names]
    std = np.array([plain["parameters"][name]["spread"] for name in names])
    spread = np.array(plain["correlation"])[np.ix_(order, order)] * np.outer(std, std)
    wanted = spread + np.outer(moved, moved) + np.diag(error**2)
    assert between_covariance(plain, names, at) == pytest.approx(wanted, rel=1e-9)
    del at["elbow"]  # has any temperature of the logs
    found = between_covariance(plain, names, at)
    assert found[0, 0] == pytest.approx(wanted[0, 0])
    elbow = effects[1]["slope"] ** 2 * np.var(warm[1], ddof=1)
    assert found[1, 1] - spread[1, 1] == pytest.approx(elbow)
    with pytest.raises(DataError, match="temperature is 99 degC, wanted"):
        between_covariance(plain, names, 99.0)


def test_a_cold_log_is_not_unlike_where_the_temperature_explains_it():
    rng = np.random.default_rng(8)
    warm = np.append(20.0 + 3.0 * rng.normal(size=9), -20.0)
    x = 0.02 * rng.normal(size=(10, 2))
    x[:, 0] -= 0.02 * (warm - 20.0)
    names = [str(k) for k in range(10)]
    known = group(x, 0.01, [Covariate("temperature", "degC", warm)])
    assert [each.run for each in vary(names, [group(x, 0.01, [])]).unlike] == [9]
    assert vary(names, [known]).unlike == ()
    x[4, 1] += 0.5  # another parameter of a log in the middle
    (found,) = vary(names, [group(x, 0.01, known.covariates)]).unlike
    assert (found.run, found.name) == (4, "elbow.coulomb")
    # units at their own temperatures
    unit = np.repeat(np.arange(5), 2)
    of_units = group(x, 0.01, known.covariates, unit=unit)
    of_units.runs.h[4:6, 1] += 0.8 / 0.01**2
    (odd,) = vary(names, [of_units]).unlike_units
    assert (odd.run, odd.name) == (2, "elbow.coulomb")


def test_covariates_that_do_not_vary_and_few_runs_have_no_effect():
    rng = np.random.default_rng(9)
    same = group(rng.normal(size=(6, 2)), 0.1, [Covariate("time", "h", np.full(6, 3.0))])
    assert effects_of(same, MixedEffects(same.runs), 0) == ()
    assert with_effects([same])[0].runs.slopes == ()
    few = group(rng.normal(size=(3, 1)), 0.1, [Covariate("time", "h", np.arange(3.0))])
    assert with_effects([few])[0] is few


def test_the_level_of_an_effect_counts_all_tests():
    """A p-value of 0.006 is below 2 % over 1 test, and above it over 1 + 2 * 2 tests."""
    rng = np.random.default_rng(10)
    c = rng.normal(size=8)
    e, own = 0.08 * rng.normal(size=(8, 1)), [Covariate("temperature", "degC", 30.0 + c)]

    def with_slope(size):
        return group(e + size * c[:, None], 0.02, own, name="lift")

    def p_value(size):
        slope = Slope(0, c - c.mean(), 0.1 / c.std())
        return MixedEffects(with_slope(size).runs.with_slopes([slope])).slope(0)[2]

    size = brentq(lambda x: np.log(p_value(x) / 0.006), 0.0, 1.0, xtol=1e-4)
    assert p_value(size) == pytest.approx(0.006, rel=0.02)
    one = with_slope(size)
    both = [*own, Covariate("time", "h", rng.normal(size=8))]
    others = group(0.08 * rng.normal(size=(8, 2)), 0.02, both)
    assert len(with_effects([one])[0].runs.slopes) == 1
    assert len(with_effects([one, others])[0].runs.slopes) == 0


@pytest.mark.parametrize("is_within", [True, False])
def test_a_slope_is_averaged_over_the_spread_at_the_level_of_its_covariate(is_within):
    """Of temperatures that vary within robots the spread between runs; else that between robots."""
    rng = np.random.default_rng(4)
    x, C, runs = drawn_runs(rng, scale=0.2)
    covariate = rng.normal(size=9) if is_within else np.array([-1.0, 0.5, 1.5])[UNIT]
    slopes = [Slope(1, covariate, 0.4)]
    model = MixedEffects(runs.with_slopes(slopes))
    found = []
    for level in (0, 1):
        deviation = model.deviation[:, :2].copy()
        means, errors, density = np.empty(45), np.empty(45), np.empty(45)
        for g, z in enumerate(np.linspace(-6.0, 5.0, 45)):
            deviation[level, 1] = 0.2 * np.exp(z)
            wanted, P = least_squares(x, C, slopes, deviation, UNIT)
            means[g], errors[g] = wanted[2], np.sqrt(P[2, 2])
            variance = np.hstack([deviation, np.zeros((2, 1))])[:, :, None] ** 2
            own = evidence(*model._members, model.runs.scale, variance).log_likelihood[0]
            density[g] = own + z - 2.5 * np.log1p(np.exp(2.0 * z) / 4.0)
        w = np.exp(density - density.max())
        w /= w.sum()
        found.append((w @ means, np.sqrt(w @ errors**2 + w @ (means - w @ means) ** 2)))
    mean, error, _ = model.slope(0)
    own, other = found if is_within else found[::-1]
    assert (mean, error) == pytest.approx(own, rel=2e-3)
    assert error != pytest.approx(other[1], rel=5e-3)


@pytest.mark.parametrize(("q", "unit"), [(1, UNIT), (2, np.zeros(9, int))])
def test_a_small_p_value_is_that_of_all_spreads(q, unit):
    """Those of two levels, or of two terms: on a grid of both, by generalised least squares."""
    rng = np.random.default_rng(17)
    c = rng.normal(size=9)
    x, C, runs = drawn_runs(rng, q=q, unit=unit, scale=0.5)
    x = 0.6 * x + (1.1 if q > 1 else 1.5) * np.outer(c, np.arange(q, 0, -1) == 1)
    runs = replace(runs, h=np.einsum("kij,kj->ki", runs.H, x))
    model = MixedEffects(runs.with_slopes([Slope(q - 1, c, 0.4)]))
    z = np.linspace(-6.0, 5.0, 45)
    both = np.array(np.meshgrid(z, z)).reshape(2, -1)
    shape = (1 + int(unit.max() > 0), q + 1, both.shape[1])
    variance = np.zeros(shape)
    variance[:, :q] = (0.5 * np.exp(both)).reshape(shape[0], q, -1) ** 2
    density = evidence(*model._members, model.runs.scale, variance).log_likelihood
    density += (both - 2.5 * np.log1p(np.exp(2.0 * both) / 4.0)).sum(axis=0)
    w = np.exp(density - density.max())
    w /= w.sum()
    means, errors = np.zeros(w.size), np.ones(w.size)
    for k in np.flatnonzero(w > 1e-7):
        found, P = least_squares(x, C, model.runs.slopes, np.sqrt(variance[:, :q, k]), unit)
        means[k], errors[k] = found[-1], np.sqrt(P[-1, -1])
    w[w <= 1e-7] = 0.0
    p_value = 2.0 * w @ ndtr(-means / errors)
    mean, error, found = model.slope(0)
    assert 1e-4 < p_value < 5e-3
    assert found == pytest.approx(p_value, rel=0.1)
    assert mean == pytest.approx(w @ means, rel=0.01)
    assert error == pytest.approx(np.sqrt(w @ (errors**2 + (means - w @ means) ** 2)), rel=0.02)


def test_runs_and_robots_are_compared_with_others_at_their_own_covariates():
    """Also if they are two, and not the first; a robot's runs differ in temperature."""
    rng = np.random.default_rng(5)
    x, C, _ = drawn_runs(rng)
    C[8] /= 40.0  # so that the mean temperature is not where a robot's mean is known best
    H = np.linalg.inv(C)
    runs = Runs(H, np.einsum("kij,kj->ki", H, x), UNIT, np.full(2, 0.5))
    model = MixedEffects(runs.with_slopes([Slope(1, 20.0 + 5.0 * rng.normal(size=9), 0.1)]))
    covariate = model.runs.slopes[0].covariate
    found = model.against_others(np.array([4, 7]), is_unit=False)
    for k, run in enumerate((4, 7)):
        others = MixedEffects(model.runs.seen_from([covariate[run]]).without(run), model.deviation)
        expected = others.predict(np.diag(C[run]), x[run])
        assert found.values[k] == pytest.approx(x[run], abs=1e-3)
        assert np.diag(found.covariance[k]) == pytest.approx(np.diag(C[run]), rel=1e-3)
        assert found.mean[k] == pytest.approx([each.mean for each in expected], rel=1e-6)
        wanted = [each.probability for each in expected]
        assert found.probability[k] == pytest.approx(wanted, rel=1e-3)
    own, moved = UNIT == 2, model.runs.seen_from([covariate[UNIT == 2].mean()])
    others = MixedEffects(moved.without_unit(2), model.deviation)
    slope = Slope(1, moved.slopes[0].covariate[own], 0.1)
    wanted, P = least_squares(x[own], C[own], [slope], others.deviation[:1, :2], np.zeros(4, int))
    found = model.against_others(np.array([2]), is_unit=True)
    assert found.values[0] == pytest.approx(wanted[:2], rel=5e-3)
    assert np.sqrt(np.diag(found.covariance[0])) == pytest.approx(np.sqrt(np.diag(P))[:2], rel=5e-3)
    assert found.mean[0] == pytest.approx([each.mean for each in others.predict()], rel=1e-6)


def test_an_effect_is_estimated_beside_plausible_ones_on_the_other_terms():
    """Generalised least squares with a normal prior of slopes: 3 plausible sizes."""
    rng = np.random.default_rng(12)
    x, C, runs = drawn_runs(rng, q=3, unit=np.zeros(9, int))
    c, hours = (rng.permutation(np.arange(-4.0, 5.0)) for _ in range(2))  # means of exactly 0
    about = [Covariate("temperature", "degC", c), Covariate("time", "h", hours)]
    one = group(x, 1.0, about, scale=0.5)
    own = Slope(2, c, 0.5 / np.std(c))
    one = replace(one, runs=runs.with_slopes([own]))
    every = MixedEffects(one.runs)
    assert model_of(one, every, 0) is every
    model = model_of(one, every, 2)
    assert [slope.parameter for slope in model.runs.slopes] == [2, 0, 1]
    variance = np.concatenate([model.deviation[0, :3], np.zeros(3)])[None, :, None] ** 2
    found = evidence(*model._members, model.runs.scale, variance)
    wanted, P = least_squares(x, C, model.runs.slopes, model.deviation[:, :3], np.zeros(9, int))
    prior = np.diag([0.0, 0.0, 0.0, 0.0, *np.full(2, (1.5 / np.std(c)) ** -2.0)])
    C = np.linalg.inv(np.linalg.inv(P) + prior)
    assert found.mean[0] == pytest.approx(C @ np.linalg.solve(P, wanted), rel=5e-3, abs=1e-4)
    errors = np.sqrt(np.diag(C))
    assert np.sqrt(np.diag(found.covariance[0])) == pytest.approx(errors, rel=2e-3)
    # an effect of the other covariate is taken for itself, and one that is taken has no prior
    two = replace(one, runs=runs.with_slopes([own, Slope(0, c, own.scale)]))
    slopes = model_of(two, MixedEffects(two.runs), 2).runs.slopes
    assert [(each.parameter, each.scale) for each in slopes[:2]] == [(2, own.scale), (0, own.scale)]
    assert [(each.parameter, each.scale) for each in slopes[2:]] == [(1, 0.03 * own.scale)]


def test_an_effect_is_not_biased_by_one_of_a_term_that_is_hardly_distinguishable():
    """Both terms fall by 2 % per degC; the evidence of viscous friction is weak."""
    inside, sizes = 0, []
    A = np.array([[1.0, 0.99], [0.0, 0.14]]) / 0.03  # torques of both correlate by 0.99
    H = np.tile(A.T @ A, (12, 1, 1))
    for seed in range(10):
        rng = np.random.default_rng([13, seed])
        warm = 25.0 + 8.0 * rng.normal(size=12)
        own = Covariate("temperature", "degC", warm)
        noise = 0.05 * rng.normal(size=(12, 2)) + np.linalg.solve(A, rng.normal(size=(2, 12))).T
        for sign in (-1.0, 1.0):
            x = sign * noise - 0.02 * (warm - warm.mean())[:, None]
            one = group(x, 1.0, [own])
            one = replace(one, runs=replace(one.runs, H=H, h=np.einsum("kij,kj->ki", H, x)))
            (effect,) = effects_of(one, MixedEffects(one.runs), 1)
            sizes.append(effect.slope)
            inside += abs(effect.slope + 0.02) < 1.96 * effect.std_error
    assert np.mean(sizes) == pytest.approx(-0.02, abs=0.002)
    assert 17 <= inside <= 20


def test_units_are_compared_whose_mean_covariate_rounds():
    """The mean of c - mean(c) is 1e-16, not 0, for one of these robots."""
    rng = np.random.default_rng(14)
    unit, c = np.repeat(np.arange(5), 3), np.round(8.0 * rng.normal(size=15), 1)
    x, C, runs = drawn_runs(rng, unit=unit)
    own = c[3:6] - c[3:6].mean()
    assert own.mean() != 0.0
    model = MixedEffects(runs.with_slopes([Slope(1, c, 0.1)]))
    found = model.against_others(np.arange(5), is_unit=True)
    moved = model.runs.seen_from([c[3:6].mean()])
    others = MixedEffects(moved.without_unit(1), model.deviation)
    slopes, first = [Slope(1, own, 0.1)], others.deviation[:1, :2]
    wanted, P = least_squares(x[3:6], C[3:6], slopes, first, np.zeros(3, int))
    assert found.values[1] == pytest.approx(wanted[:2], rel=1e-2)
    assert np.sqrt(np.diag(found.covariance[1])) == pytest.approx(np.sqrt(np.diag(P))[:2], rel=1e-2)
    assert found.mean[1] == pytest.approx([each.mean for each in others.predict()], rel=1e-6)


@pytest.mark.parametrize("unit", [1e-4, 1e3])
def test_an_effect_does_not_depend_on_the_unit_and_the_zero_of_its_covariate(of_two_drives, unit):
    groups, _, variation = of_two_drives
    moved = [
        replace(each, covariates=tuple(
            replace(own, values=unit * (own.values + 273.15)) for own in each.covariates
        )) for each in groups
    ]  # fmt: skip
    one, other = (
        [own for each in found.parameters for own in each.effects]
        for found in (variation, vary(variation.runs, moved))
    )
    assert [own.is_used for own in one] == [own.is_used for own in other]
    assert sum(own.is_used for own in one) == 1
    for own, same in zip(one, other, strict=True):
        assert unit * same.slope == pytest.approx(own.slope, rel=1e-5, abs=1e-7)
        assert unit * same.std_error == pytest.approx(own.std_error, rel=1e-5)
        assert same.probability == pytest.approx(own.probability, rel=1e-4)
        at, *ends = own.intervals
        assert same.intervals[0] == pytest.approx(unit * (at + 273.15), rel=1e-9)
        assert same.intervals[1:] == pytest.approx(np.array(ends), rel=1e-5)
