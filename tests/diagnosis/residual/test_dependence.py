"""How a residual follows a quantity, against sums over rows, bins and segments one by one."""

from dataclasses import replace

import numpy as np
import pytest

from robotid.diagnosis.decisions import FEWEST, p_value
from robotid.diagnosis.residual.torque_split import even_bins, follow

B, K, SIZE = 4, 7, 33  # bins, segments, rows of each


@pytest.fixture
def rows(rng):
    """Values, residuals, bins and segments; two segments have a bin of their own alone."""
    x = rng.uniform(-1.0, 1.0, K * SIZE)
    bins = np.minimum(((x + 1.0) / 0.6).astype(int), B - 1)
    segments = 3 * np.repeat(np.arange(K), SIZE)  # numbers with gaps
    first = segments < 6
    bins[(bins == B - 1) & ~first] = B - 2
    r = 0.7 * x + 0.4 + rng.standard_normal(K)[segments // 3] + 0.1 * rng.standard_normal(len(x))
    return x, r, bins, segments


def test_means_and_errors_are_those_of_bins_of_clusters(rows):
    x, r, bins, segments = rows
    found = follow("speed", "rad/s", x, r, bins, segments)
    assert (found.name, found.unit) == ("speed", "rad/s")
    for b in range(B):
        own = bins == b
        assert found.centres[b] == pytest.approx(x[own].mean())
        assert found.means[b] == pytest.approx(r[own].mean())
        sums = [np.sum((r - r[own].mean())[own & (segments == k)]) for k in np.unique(segments)]
        there = sum((own & (segments == k)).any() for k in np.unique(segments))
        if there < 3:
            assert np.isnan(found.errors[b])
        else:
            wanted = np.sqrt(np.sum(np.square(sums)) * there / (there - 1)) / own.sum()
            assert found.errors[b] == pytest.approx(wanted)
    assert np.isnan(found.errors).tolist() == [False, False, False, True]


def test_the_share_is_of_stretches_that_the_means_do_not_know(rows):
    x, r, bins, segments = rows
    before, after = [], []
    for k in np.unique(segments):
        out, rest = segments == k, segments != k
        plain = r[rest].mean()
        means = [
            r[rest & (bins == b)].mean() if (rest & (bins == b)).any() else plain for b in range(B)
        ]
        before.append(np.sum((r[out] - plain) ** 2))
        after.append(np.sum((r[out] - np.array(means)[bins[out]]) ** 2))
    found = follow("speed", "rad/s", x, r, bins, segments)
    assert found.share == pytest.approx(1.0 - sum(after) / sum(before))
    assert found.p_value == pytest.approx(p_value(np.array(before), np.array(after), K))
    # a constant is compared with none
    constant = follow("constant", "", x, r, np.zeros(len(r), dtype=int), segments)
    left = sum(np.sum((r[segments == k] - r[segments != k].mean()) ** 2) for k in segments[::33])
    assert constant.share == pytest.approx(1.0 - left / np.sum(r**2))


def test_few_stretches_show_means_but_no_share(rows):
    x, r, bins, segments = rows
    few = segments < 3 * (FEWEST - 1)
    found = follow("speed", "rad/s", x[few], r[few], bins[few], segments[few])
    assert (found.share, found.p_value, found.is_significant) == (None, 1.0, False)
    assert np.isfinite(found.errors[:3]).all()
    none = follow("speed", "rad/s", x, r, bins, None)
    np.testing.assert_allclose(none.means, follow("speed", "", x, r, bins, segments).means)
    assert np.isnan(none.errors).all()
    assert (none.share, none.p_value) == (None, 1.0)


def test_a_dependence_is_significant_by_its_share_and_its_p_value(rows):
    found = follow("speed", "rad/s", *rows)
    for share, p, wanted in (
        (0.1, 2.9e-4, True), (0.099, 2.9e-4, False), (0.1, 3.1e-4, False), (None, 1e-4, False),
    ):  # fmt: skip
        assert replace(found, share=share, p_value=p).is_significant == wanted


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_it_is_off_most_where_the_mean_is_most_errors_from_zero(rows, sign):
    """The largest means are of either sign; the last bin has no error."""
    x, r, bins, segments = rows
    found = follow("speed", "rad/s", x, sign * r, bins, segments)
    ratio = np.where(np.isnan(found.errors), 0.0, np.abs(found.means) / found.errors)
    assert sorted(ratio)[-1] > 1.2 * sorted(ratio)[-2]
    assert found.where == found.centres[np.argmax(ratio)]
    mean, error = found.at(np.array([found.centres[0], 0.5 * sum(found.centres[:2]), -9.0, 9.0]))
    np.testing.assert_allclose(mean[:2], [found.means[0], 0.5 * sum(found.means[:2])])
    np.testing.assert_allclose(error[:2], [found.errors[0], 0.5 * sum(found.errors[:2])])
    assert np.isnan(mean[2:]).all()


def test_even_bins_have_as_many_rows_and_are_cut_at_zero(rng):
    x = rng.permutation(np.arange(100.0) - 34.5)
    bins = even_bins(x)
    assert np.bincount(bins).tolist() == [10, 10, 10, 5, 5, *[10] * 6]
    assert (np.diff(bins[np.argsort(x)]) >= 0).all()
    assert (x[bins <= 3] < 0).all()
    assert (x[bins > 3] > 0).all()
    assert np.unique(even_bins(np.ones(5))).tolist() == [0]
