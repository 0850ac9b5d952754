"""Options compete on held-out segments; the simplest of those that explain most is found."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

from robotid.diagnosis.decisions import Round, Rule, p_value, select

RULE = Rule(most=3, share=0.05, p_value=0.01, alike=0.02)


def round_of(rng, fitted=10, **shares):
    """Return a round of 10 segments and 4 of validation, in which options gain these shares."""
    before = rng.uniform(1.0, 2.0, 14)
    left = {
        name: before * (1.0 - share * rng.uniform(0.98, 1.02, 14)) for name, share in shares.items()
    }
    return Round(before, left, fitted, float(before[:fitted].sum()))


def test_chance_is_students(rng):
    before = rng.uniform(1.0, 2.0, 16)
    after = before * rng.uniform(0.6, 1.2, 16)
    gain = (before - after) / np.maximum(before, after)

    def wanted(gain):
        return scipy.stats.ttest_1samp(gain, 0.0, alternative="greater").pvalue

    assert p_value(before, after, 16) == pytest.approx(wanted(gain))
    surer = min(wanted(gain), wanted(gain[:9]))  # of fitted logs, or of all
    assert p_value(before, after, 9) == pytest.approx(surer)
    still = np.append(before, np.zeros(8)), np.append(after, np.zeros(8))
    assert p_value(*still, 24) == pytest.approx(wanted(gain))  # at rest a segment does not count
    assert p_value(before[:2], after[:2], 2) == 1.0


def test_the_simplest_of_those_that_explain_alike_is_found(rng):
    this = round_of(rng, large=0.50, small=0.49, other=0.4, none=0.01)
    cost = {"large": 2, "small": 1, "other": 0, "none": 0}.get
    assert this.best(RULE) == "large"
    assert this.best(RULE, cost) == "small"
    assert this.alike(RULE) == ["large", "small"]
    assert this.best(replace(RULE, alike=0.2), cost) == "other"
    assert this.share("large") == pytest.approx(0.5, abs=0.01)
    assert this.gain("other") == pytest.approx(0.4 * this.whole, rel=0.02)


def test_what_is_too_small_or_by_chance_is_not_found(rng):
    this = round_of(rng, some=0.2)
    assert this.best(RULE) == "some"
    assert this.best(replace(RULE, share=0.25)) is None
    assert replace(this, least=0.3 * this.whole).best(RULE) is None
    p = this.p_value("some")
    assert this.best(replace(RULE, p_value=0.5 * p)) is None
    assert this.best(replace(RULE, p_value=2.0 * p), tried=lambda option: 1) == "some"
    assert this.best(replace(RULE, p_value=2.0 * p), tried=lambda option: 3) is None
    assert this.best(replace(RULE, p_value=None)) == "some"


def test_validation_has_no_part_in_the_share(rng):
    this = round_of(rng, some=0.2)
    left = this.left["some"].copy()
    left[10:] = 0.0
    assert replace(this, left={"some": left}).share("some") == pytest.approx(this.share("some"))


def test_rounds_end_with_the_first_that_finds_nothing_or_the_most(rng):
    shares = {"a": 0.5, "b": 0.3, "c": 0.01}

    def offered():
        return round_of(rng, **shares)

    found = []
    for _, best in select(offered, RULE):
        found.append(best)
        shares.pop(best, None)
    assert found == ["a", "b", None]
    shares = {"a": 0.5}
    assert [best for _, best in select(offered, RULE)] == ["a"] * 3


def test_options_are_alike_within_a_share_of_the_residual_not_of_the_gain():
    before = np.full(10, 2.0)
    left = {name: before * (1.0 - share) for name, share in (("a", 0.3), ("b", 0.281), ("c", 0.27))}
    this = Round(before, left, 10, 20.0)
    assert this.alike(replace(RULE, p_value=None)) == ["a", "b"]
