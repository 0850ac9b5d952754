"""Rows that terms are tried on, and what columns beside the base parameters leave of them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats

from robotid.diagnosis.decisions import Round, Rule, p_value, select
from robotid.diagnosis.residual.term_trials import Normal, Sample, Trials

N, JOINTS, BASE, FITTED = 90, 2, 3, 7


@pytest.fixture
def sample(rng):
    """Seven segments of fitted logs and two of validation, each of ten samples."""
    weight = rng.uniform(0.5, 2.0, (N, JOINTS))
    weight[3] = 0.0  # a row that is left out
    W = weight[:, :, None] * rng.standard_normal((N, JOINTS, BASE))
    r = weight * rng.standard_normal((N, JOINTS))
    segments = tuple(slice(k, k + 10) for k in range(0, N, 10))
    normal = Normal.of(W, r, segments, FITTED)
    return Sample(
        joints=("a", "b"), is_prismatic=np.zeros(2, dtype=bool), motions=(), recordings=(), at=(),
        taken=(), weight=weight, torque=np.ones(2), segments=segments, rows=10 * FITTED,
        W=W, r=r, independent=np.arange(BASE), U=np.eye(BASE), normal=normal, standard=np.zeros(0),
    )  # fmt: skip


def solved(X, r, prior):
    """Return the least squares of rows with a prior of so many about 0."""
    return np.linalg.solve(X.T @ X + np.diag(prior), X.T @ r)


@pytest.mark.parametrize("which", [[0], [1], [0, 1]])
def test_columns_on_all_joints_have_the_scatter_of_the_scores_of_stretches(sample, rng, which):
    Z = rng.standard_normal((N, JOINTS, 2)) + 0.4 * sample.r[:, :, None]
    tried = Trials(sample, Z)
    apart, whole = tried.held_out, tried.whole
    columns = (sample.weight[:, :, None] * Z)[..., which]
    k, own = len(which), slice(0, 10 * FITTED)
    C, R = columns[own].reshape(-1, k), sample.r[own].ravel()
    X = np.hstack([sample.W[own].reshape(-1, BASE), C])
    ridge = 1e-4 * np.sum(C**2, axis=0)
    prior = np.append(np.ones(BASE), ridge)
    theta = solved(X, R, prior)
    found, covariance = whole.estimate(which, FITTED)
    np.testing.assert_allclose(found, theta[BASE:], rtol=1e-9)
    np.testing.assert_allclose(whole.parameters(which), theta[BASE:], rtol=1e-9)
    # of columns beside the base parameters: what these leave of them
    H = X.T @ X + np.diag(prior)
    inverse = np.linalg.inv(H)[BASE:, BASE:]
    T = np.linalg.solve(X[:, :BASE].T @ X[:, :BASE] + np.eye(BASE), X[:, :BASE].T @ C)
    E, e = C - X[:, :BASE] @ T, R - X @ theta
    scores = np.array([E[20 * s : 20 * s + 20].T @ e[20 * s : 20 * s + 20] for s in range(FITTED)])
    wanted = FITTED / (FITTED - 1) * inverse @ scores.T @ scores @ inverse
    np.testing.assert_allclose(covariance, wanted, rtol=1e-7)
    # each segment of fitted logs is left out in turn, those of validation always
    left, none = apart.left(which), apart.left([])
    for s, rows in enumerate(sample.segments):
        used = np.ones(N, dtype=bool)
        used[10 * FITTED :] = False
        used[rows] = False
        C_s, W_s = columns[used].reshape(-1, k), sample.W[used].reshape(-1, BASE)
        prior = np.append(np.ones(BASE), 1e-4 * np.sum(C_s**2, axis=0))
        theta = solved(np.hstack([W_s, C_s]), sample.r[used].ravel(), prior)
        plain = solved(W_s, sample.r[used].ravel(), np.ones(BASE))
        X_s = np.concatenate([sample.W[rows], columns[rows]], axis=2)
        assert left[s] == pytest.approx(np.sum((sample.r[rows] - X_s @ theta) ** 2), rel=1e-9)
        alone = np.sum((sample.r[rows] - sample.W[rows] @ plain) ** 2)
        assert none[s] == pytest.approx(alone, rel=1e-9)


def test_a_column_of_a_joint_at_rest_takes_nothing(sample, rng):
    Z = rng.standard_normal((N, 1, 2))
    Z[:, 0, 1] = 0.0
    tried = Trials(sample.of_joint(1), Z)
    assert tried.whole.parameters([0, 1])[1] == 0.0
    apart = tried.held_out
    np.testing.assert_allclose(apart.left([0, 1]), apart.left([0]))


def test_the_torque_of_a_joint_alone_is_along_its_projected_axis(sample, rng):
    b = rng.standard_normal((N, JOINTS))
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    P = np.eye(JOINTS) - b[:, :, None] * b[:, None, :]
    parts = [np.einsum("kij,kj->ki", P[k], rng.standard_normal((len(P[k]), JOINTS)))
             for k in (slice(40), slice(40, None))]  # fmt: skip
    weight = np.tile(sample.weight[:, :1], (1, JOINTS))
    at = tuple(SimpleNamespace(tau=part) for part in parts)
    alone = replace(sample, basis=b[:, :, None], at=at, weight=weight).of_joint(1)
    axis = P[:, :, 1] / np.linalg.norm(P[:, :, 1], axis=1, keepdims=True)
    along = np.sum(axis * np.concatenate(parts), axis=1)[: 10 * FITTED]
    np.testing.assert_allclose(alone.torque, [np.sum((weight[: 10 * FITTED, 0] * along) ** 2)])
    np.testing.assert_allclose(alone.weight[:, 0], weight[:, 0] * np.sqrt(P[:, 1, 1]))
    np.testing.assert_allclose(alone.r[:, 0], sample.r[:, 1] / np.sqrt(P[:, 1, 1]))


def test_columns_beside_are_each_as_free_as_what_is_left(sample, rng):
    Z = rng.standard_normal((N, JOINTS, 3)) * [1.0, 30.0, 0.0]
    found = sample.with_columns(Z)
    columns = sample.weight[:, :, None] * Z
    for c in (0, 1):
        free = 1e3 * np.sqrt(np.sum(sample.r**2) / np.sum(columns[:, :, c] ** 2))
        np.testing.assert_allclose(found.W[:, :, BASE + c], free * columns[:, :, c])
    assert not found.W[:, :, BASE + 2].any()
    np.testing.assert_array_equal(found.W[:, :, :BASE], sample.W)
    own, joined = found.of_joint(1), found.joined()
    np.testing.assert_array_equal(own.W[:, 0], found.W[:, 1])
    assert (own.joints, own.torque.tolist()) == (("b",), [1.0])
    np.testing.assert_array_equal(own.normal.A, found.normal.A)
    np.testing.assert_allclose(joined.normal.A, [found.normal.A[:FITTED].sum(axis=0)])
    np.testing.assert_allclose(joined.normal.B, [found.normal.B[:FITTED].sum(axis=0)])
    assert (joined.fitted, joined.segments) == (1, (slice(10 * FITTED),))
    np.testing.assert_array_equal(joined.r, found.r[: 10 * FITTED])
    twice = own.reweighted(3.0)
    np.testing.assert_allclose(twice.torque, 9 * own.torque)
    np.testing.assert_allclose(twice.normal.A, own.normal.A + 8 * own.own.A)
    np.testing.assert_allclose(twice.normal.B, own.normal.B + 8 * own.own.B)


# --- selection ------------------------------------------------------------------------------------
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
