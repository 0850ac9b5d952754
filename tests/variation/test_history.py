"""Changes over results in order of time: the test of a step, alarms and their causes."""

import numpy as np
import pytest
import scipy.stats

from robotid.variation.change_causes import _coefficient, cause_of
from robotid.variation.history import changes, steps_of


def test_a_step_without_errors_has_the_probability_of_the_t_test():
    x = np.array([[5.0, 5.3, 4.8, 5.1, 5.9, 6.2]]).T
    steps = steps_of(np.hstack([x, -x]), np.full((6, 2), 1e-4))
    expected = scipy.stats.ttest_ind(x[:4, 0], x[4:, 0])
    np.testing.assert_allclose(steps.probability[:, 3], expected.pvalue, rtol=0.05)
    np.testing.assert_allclose(steps.before[:, 3], [5.05, -5.05], rtol=1e-9)
    np.testing.assert_allclose(steps.change[:, 3], [1.0, -1.0], rtol=1e-9)
    assert (steps.evidence.argmax(axis=1) == 3).all()


def test_a_step_of_alike_results_has_the_error_of_their_noise():
    e = np.array([0.1, 0.2, 0.1, 0.3, 0.1, 0.2])
    x = 2.0 + 1e-4 * np.arange(6)
    steps = steps_of(x[:, None], e[:, None])
    w = e**-2
    noise = np.sqrt(1 / w[:3].sum() + 1 / w[3:].sum())
    assert noise < steps.std_error[0, 2] < 1.5 * noise
    assert steps.probability[0, 2] > 0.9


def test_changes_are_those_that_earlier_results_do_not_predict():
    rng, alarms = np.random.default_rng(0), 0
    for _ in range(20):
        values = np.array([5.0, -0.4, 0.0]) + [0.2, 0.05, 0.01] * rng.normal(size=(8, 3))
        errors = np.tile([0.1, 0.02, 0.01], (8, 1))
        alarms += bool(changes(values, errors))
    assert alarms <= 2
    values[5:, 1] = [-1.5, -1.52, -1.48]
    (found,) = changes(values, errors)[:1]
    assert (found.parameter, found.first) == (1, 5)
    assert found.result in (5, 6, 7)
    assert found.expected.ends[0] < -0.4 < found.expected.ends[1]
    assert changes(values[:3], errors[:3]) == []
    some = changes(values[: found.result + 1], errors[: found.result + 1])
    assert (some[0].result, some[0].probability) == (found.result, found.probability)


@pytest.mark.parametrize(("level", "few", "many"), [(0.02, 0, 5), (0.5, 12, 40)])
def test_histories_without_a_change_have_the_stated_rate_of_alarms(level, few, many):
    rng = np.random.default_rng(4)
    errors, alarms = np.full((9, 2), 0.01), 0
    for _ in range(80):  # expected: 80 times the level, less the share of the results beyond 9
        alarms += bool(changes(rng.normal(size=(9, 2)), errors, false_alarms=level))
    assert few <= alarms <= many


def test_after_an_alarm_the_new_level_is_expected():
    rng = np.random.default_rng(1)
    x = 3.0 + 0.05 * rng.normal(size=(24, 1))
    x[8:16] += 1.0
    found = changes(x, np.full((24, 1), 0.02))
    assert [each.first for each in found] == [8, 16]
    assert [each.start for each in found] == [0, 8]
    assert found[1].expected.ends == pytest.approx([3.85, 4.15], abs=0.12)
    x[8:16] -= 0.82  # found some results after it
    first, *_, last = changes(x, np.full((24, 1), 0.02))
    assert (first.start, first.first) == (0, 8)
    assert first.result > 8
    assert last.start == 8


EXPRESSIONS = {
    "arm.mcx": "arm.mcx + 0.6 tool.m",
    "tool.mcx": "tool.mcx",
    "tool.Izz": "tool.Izz - 1.5e-2 tool.m",
    "one.viscous": "one.viscous", "one.coulomb": "one.coulomb", "one.armature": "one.armature",
    "two.viscous": "two.viscous", "two.coulomb": "two.coulomb", "two.armature": "two.armature",
    "two.offset": "two.offset",
}  # fmt: skip
BEFORE = np.array([3.0, 0.5, 0.2, 4.0, 2.0, 0.3, 1.5, 0.8, 0.1, 0.2])
CHANGES = {
    ("friction", "one"): ([0, 0, 0, 0.8, 0.4, 0, 0, 0, 0, 0], 0.2),
    ("friction", "two"): ([0, -0.05, 0, 0, 0, 0, 0.3, 0.16, 0.02, 0], 0.2),  # body: less
    ("gain", "two"): ([0, -0.05, -0.02, 0, 0, 0, -0.15, -0.08, -0.01, 0], -0.1),
    ("offset", "two"): ([0, 0, 0, 0, 0, 0, 0, 0, 0, 0.5], 0.5),
    ("payload", "tool"): ([0.6 * 0.7, 0.05, -0.015 * 0.7, 0, 0, 0, 0, 0, 0, 0], 0.7),
    ("other", ""): ([0, 0, 0, 0.8, 0, -0.04, 0, 0.4, 0, 0.8], 0.0),
}


@pytest.mark.parametrize("cause", CHANGES)
def test_the_cause_of_a_change_is_named_with_its_size(cause):
    change, size = CHANGES[cause]
    errors = np.array([0.02, 0.01, 0.01, 0.02, 0.02, 0.001, 0.01, 0.01, 0.001, 0.02])
    found = cause_of(EXPRESSIONS, ["one", "two"], "tool", BEFORE, np.array(change), errors)
    assert (found.kind, found.where) == cause
    assert found.size == pytest.approx(size, abs=0.02)
    if cause[0] == "other":
        return
    names = list(EXPRESSIONS)
    own = {
        "friction": [f"{cause[1]}.viscous", f"{cause[1]}.coulomb"], "offset": ["two.offset"],
        "gain": ["tool.mcx", "tool.Izz", "two.viscous", "two.coulomb", "two.armature"],
    }  # fmt: skip
    if cause[0] == "payload":  # mass and first moment
        A = np.zeros((10, 2))
        A[[0, 2], 0], A[1, 1] = [0.6, -0.015], 1.0
    else:
        A = np.where(np.isin(names, own[cause[0]]), BEFORE, 0.0)[:, None]
        A = A / 0.2 if cause[0] == "offset" else A
    C = np.linalg.inv(A.T @ np.diag(errors**-2.0) @ A)
    assert found.std_error == pytest.approx(np.sqrt(C[0, 0]))
    assert found.size == pytest.approx((C @ A.T @ (change / errors**2))[0])


def test_results_that_determine_nothing_have_no_weight():
    rng = np.random.default_rng(6)
    x, errors = 2.0 + 0.05 * rng.normal(size=(12, 1)), np.full((12, 1), 1e-3)
    x[8:] += 1.0
    alike = changes(x, errors)
    assert [each.first for each in alike] == [8]
    order = [0, 1, 2, 3, 12, 13, 4, 5, 6, 7, 14, 8, 9, 10, 11]
    more = np.vstack([x, [[40.0], [-30.0], [0.0]]])[order]
    wide = np.vstack([errors, np.full((3, 1), 1e5)])[order]
    (found,) = changes(more, wide)
    assert found.first in (10, 11)  # the result in between is on either side
    steps, own = steps_of(more, wide), steps_of(x, errors)
    assert steps.change[0, 9] == pytest.approx(own.change[0, 7], rel=1e-3)
    assert steps.std_error[0, 9] == pytest.approx(own.std_error[0, 7], rel=0.2)


def cause(change, errors):
    return cause_of(EXPRESSIONS, ["one", "two"], "tool", BEFORE, np.array(change), np.array(errors))


def test_a_body_whose_change_is_uncertain_may_change_like_the_drive():
    """-10 +- 0.4 % of the drive, -4 +- 2.8 % of the body: 6 % are 2.1 standard errors."""
    change = [0, -0.02, -0.008, 0, 0, 0, -0.15, -0.08, -0.01, 0]
    errors = [0.02, 0.02, 0.008, 0.02, 0.02, 0.001, 0.01, 0.004, 0.001, 0.02]
    assert cause(change, errors).kind == "friction"  # of the body, only 1.4 standard errors
    change[1], change[2] = -0.07, -0.025  # -13 %: more than 3 of its own, 1.2 of the difference
    assert (cause(change, errors).kind, cause(change, errors).where) == ("gain", "two")


def test_a_cause_of_more_parameters_explains_more_by_chance():
    """chi^2: gain 100 + 1 of 1 parameter, payload 100 + 2.5 of 2."""
    change = [-0.3, 0.5 * np.sqrt(2.5), 0, -0.4, 0, 0, 0, 0, 0, 0]
    errors = [0.03, 0.5, 100.0, 0.4, 100.0, 100.0, 0.02, 0.02, 0.02, 0.02]
    found = cause(change, errors)
    assert (found.kind, found.where) == ("gain", "one")
    assert found.size == pytest.approx(-0.1, abs=1e-3)
    change[1] = 0.5 * np.sqrt(3.5)
    assert cause(change, errors).kind == "payload"


def test_a_cause_explains_half_of_what_noise_does_not():
    """chi^2 of 10 parameters: 40 of the offset, 60 of others; 40 is half of 100 less 10 or 20."""
    errors = np.full(10, 0.1)
    change = np.zeros(10)
    change[9] = 0.1 * np.sqrt(40.0)
    change[[0, 3, 6]] = 0.1 * np.sqrt([17.0, 16.0, 16.0])  # 89
    assert cause(change, errors).kind == "offset"
    change[[0, 3, 6]] = 0.1 * np.sqrt([19.0, 17.0, 17.0])  # 93
    assert cause(change, errors).kind == "other"


def test_coefficients_of_an_expression_have_sign_and_size():
    text = "- a.mcx + 2.5 b.m - 1.5e-2 c.m - d.mcz + e.m"
    names = ["a.mcx", "b.m", "c.m", "d.mcz", "e.m", "m", "a.m"]
    assert [_coefficient(text, x) for x in names] == [-1.0, 2.5, -0.015, -1.0, 1.0, 0.0, 0.0]


def test_steps_are_those_of_weighted_least_squares_over_all_spreads():
    """Dense: at each s, x = mu + delta with covariance s^2 + e^2; restricted likelihoods."""
    rng = np.random.default_rng(3)
    e = 0.1 * np.exp(rng.normal(size=(7, 2))) * [1.0, 30.0]
    x = [5.0, -300.0] + 1.5 * e * rng.normal(size=(7, 2))
    steps = steps_of(x, e)
    for p in range(2):
        low = 0.05 * e[:, p].min()
        high = 30.0 * max(np.std(x[:, p]), e[:, p].min())
        for c in range(6):
            X = np.column_stack([np.ones(7), np.arange(7) > c])
            found = []
            for s in np.exp(np.linspace(np.log(low), np.log(high), 32)):
                W = np.diag(1.0 / (s**2 + e[:, p] ** 2))
                C = np.linalg.inv(X.T @ W @ X)
                b = C @ X.T @ W @ x[:, p]
                r = x[:, p] - X @ b
                log = 0.5 * (np.log(np.diag(W)).sum() + np.linalg.slogdet(C)[1] - r @ W @ r)
                found.append([log, *b, C[1, 1]])
            log, mu, delta, variance = np.array(found).T
            weight = np.exp(log - log.max())
            evidence = log.max() + np.log(weight.sum())
            weight /= weight.sum()
            change = weight @ delta
            z = np.abs(delta) / np.sqrt(variance)
            assert steps.before[p, c] == pytest.approx(weight @ mu)
            assert steps.change[p, c] == pytest.approx(change)
            total = weight @ (variance + (delta - change) ** 2)
            assert steps.std_error[p, c] == pytest.approx(np.sqrt(total))
            assert steps.probability[p, c] == pytest.approx(weight @ (2 * scipy.stats.norm.sf(z)))
            if c == 0:
                first = evidence
            assert steps.evidence[p, c] - steps.evidence[p, 0] == pytest.approx(evidence - first)


def test_the_level_of_an_alarm_counts_results_parameters_and_places():
    """Result 9, the 6th tested; 2 parameters; steps before the last 1, 2 or 4 results."""
    rng = np.random.default_rng(8)
    x, errors = rng.normal(size=(9, 2)), np.full((9, 2), 0.01)
    level = 0.02 / (6 * 7 * 2 * 3)
    for share, is_found in ((1.1, False), (0.9, True)):
        low, high = 0.0, 400.0
        for _ in range(40):  # the last value with this p-value
            x[8, 1] = 0.5 * (low + high)
            p = steps_of(x, errors).probability[1, [7, 6, 4]].min()
            low, high = (low, x[8, 1]) if p < share * level else (x[8, 1], high)
        assert [(y.result, y.parameter) for y in changes(x, errors)] == [(8, 1)] * is_found


def test_the_expected_result_has_its_own_error():
    """40 results of spread 0.02, then one of error 0.3: 1.96 hypot(0.3, 0.02) either side."""
    rng = np.random.default_rng(2)
    x = 4.0 + 0.02 * rng.normal(size=(41, 1))
    errors = np.full((41, 1), 1e-3)
    x[40], errors[40] = 12.0, 0.3
    (found,) = changes(x, errors)
    half = scipy.stats.norm.ppf(0.975) * np.hypot(0.3, np.std(x[:40], ddof=1))
    assert (found.result, found.first) == (40, 40)
    assert found.expected.ends == pytest.approx(
        [x[:40].mean() - half, x[:40].mean() + half], abs=0.01
    )
    assert found.expected.probability < 1e-9
