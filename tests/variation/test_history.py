"""Changes over results in order of time: the test of a step, alarms and their causes."""

import numpy as np
import pytest
import scipy.stats

from robotid.variation.change_causes import cause_of
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
    if cause[0] == "offset":
        assert found.std_error == pytest.approx(0.02)


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
