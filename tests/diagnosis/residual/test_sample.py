"""Rows that terms are tried on, and what columns beside the base parameters leave of them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from robotid.data.log import Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.residual.term_trials import (
    Normal,
    Sample,
    Trials,
    _is_steady,
    _noise_level,
    _segments,
    _spread_rows,
    _typical_size,
    take_sample,
)
from robotid.dynamics.torque import joint_torque_regressor

N, JOINTS, BASE, FITTED, STRETCHES = 90, 2, 3, 7, 9


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


def test_columns_beside_are_as_free_as_what_is_left(sample, rng):
    Z = rng.standard_normal((N, JOINTS, 1))
    beside = sample.with_columns(Z)
    columns = sample.weight[:, :, None] * Z
    spread = 1e3 * np.linalg.norm(sample.r) / np.linalg.norm(columns)
    np.testing.assert_allclose(beside.W, np.concatenate([sample.W, spread * columns], axis=2))
    for k, rows in enumerate(sample.segments):
        W = beside.W[rows].reshape(-1, BASE + 1)
        np.testing.assert_allclose(beside.normal.A[k], W.T @ W)
        np.testing.assert_allclose(beside.normal.B[k], W.T @ sample.r[rows].ravel())


@pytest.mark.parametrize(
    ("fitted", "kept", "independent", "counts"),
    [(3000, 0, 0.5, (16, 0)), (100, 90, 0.7, (7, 6)), (100, 9, 1.0, (10, 1))],
)
def test_stretches_have_ten_independent_rows_and_are_sixteen_of_each_kind_at_most(
    fitted, kept, independent, counts
):
    found = _segments(fitted, kept, independent)
    assert len(found) == sum(counts)
    assert [part.start for part in found[1:]] == [part.stop for part in found[:-1]]
    assert (found[0].start, found[-1].stop) == (0, fitted + kept)
    assert found[counts[0] - 1].stop == fitted
    for kind in (found[: counts[0]], found[counts[0] :]):
        sizes = [part.stop - part.start for part in kind]
        assert not sizes or max(sizes) - min(sizes) <= 1


def recording(count, cutoff):
    q = np.zeros((count, 1))
    motion = Trajectory(
        np.arange(count) / 100.0, q, q, q, q, ("a",), 100.0, np.zeros(count, dtype=int)
    )
    signals = SignalSettings(cutoff=cutoff, rate=100.0)
    return SimpleNamespace(recording=SimpleNamespace(trajectory=motion, signals=signals))


def test_rows_are_two_for_each_that_is_independent_and_three_thousand_at_most():
    model = SimpleNamespace(n_rows=1, layout=SimpleNamespace(names=("x",) * 10))
    fitted, kept = [recording(400, 5.0), recording(7000, 20.0)], [recording(500, 10.0)]
    rows, independent = _spread_rows(model, fitted, kept)
    # 10, 40 and 20 of 100 rows are independent; of 7400 rows every third is read
    for own, step, count in zip(rows, (5, 3, 2), (400, 7000, 500), strict=True):
        np.testing.assert_array_equal(own, np.arange(0, count, step))
    assert independent == pytest.approx(0.4)  # of each row that is read, in the kept one
    _, alone = _spread_rows(model, fitted[1:], [])
    assert alone == 1.0


def test_rows_near_a_reversal_or_a_stop_are_not_steady():
    t = np.arange(200) / 100.0
    v = np.column_stack([np.where(t < 0.995, 1.0, -1.0), np.where(t < 0.5, 0.01, 1.0)])
    q = np.cumsum(v, axis=0) / 100.0
    segment = np.zeros(200, dtype=int)
    motion = Trajectory(t, q, v, v, v, ("a", "b"), 100.0, segment)
    signals = SignalSettings(cutoff=4.9, min_velocity=0.05)
    steady = _is_steady(SimpleNamespace(trajectory=motion, signals=signals))
    near = 0.5 / 4.9  # half a period of the cut-off
    start = np.abs(t) <= near  # a segment begins
    np.testing.assert_array_equal(steady[:, 0], ~(start | (np.abs(t - 1.0) <= near)))
    np.testing.assert_array_equal(steady[:, 1], ~(start | (t <= 0.49 + near)))
    unfiltered = SignalSettings(cutoff=None)
    assert _is_steady(SimpleNamespace(trajectory=motion, signals=unfiltered)).all()


def test_the_typical_size_is_the_median_of_the_rows_used():
    r = np.array([[1.0, -5.0], [-2.0, 1.0], [9.0, 1.0], [4.0, 2.0]])
    used = np.array([[True, False], [True, False], [False, False], [True, False]])
    assert _typical_size(r, used).tolist() == [2.0, np.inf]


def test_projected_rows_have_one_noise_level_and_as_much_freedom_as_is_left(rng):
    b = rng.standard_normal((N, 3)) * [1.0, 2.0, 0.1]
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    e = rng.standard_normal((N, 3))
    r = e - b * np.sum(b * e, axis=1, keepdims=True)
    r[[4, 80]] *= 100.0  # outliers, of a fitted and of a validation log
    used = rng.random((N, 3)) < 0.9
    found, level = _noise_level(r, used, 70, b[:, :, None])
    usual = np.arange(N)[:, None] % 76 != 4
    np.testing.assert_array_equal(found, used & usual)
    own = (used & usual)[:70]
    squares, freedom = np.sum(r[:70][own] ** 2), np.sum(1.0 - b[:70][own] ** 2)
    np.testing.assert_allclose(level, np.full(3, np.sqrt(squares / freedom)))


def test_samples_are_weighted_by_the_residual_of_fitted_rows_joint_by_joint(identified):
    """Against the dense regressor of all recordings."""
    found = take_sample(identified)
    model, mapping = identified.model, identified.mapping
    every = [*identified.fitted, *[e for e in identified.validation if not e.is_refitted]]
    Y, tau, used = [], [], []
    for e, k in zip(every, found.taken, strict=True):
        m = e.recording.trajectory.at(k)
        Y.append(joint_torque_regressor(model, m.q, m.v, m.a, m.direction).reshape(len(k), 6, -1))
        tau.append(m.tau)
        used.append(e.recording.mask[k] & _is_steady(e.recording)[k])
    fitted = sum(len(k) for k in found.taken[: len(identified.fitted)])
    Y, tau, used = np.concatenate(Y), np.concatenate(tau), np.concatenate(used)
    assert (found.rows, found.fitted) == (fitted, sum(s.stop <= fitted for s in found.segments))
    r = tau - Y @ identified.standard
    for j in range(6):
        own = np.abs(r[:fitted, j])[used[:fitted, j]]
        used[:, j] &= np.abs(r[:, j]) <= 12 * np.median(own)
    independent = found.weight.max(axis=0)
    size = np.sqrt([np.mean(r[:fitted, j][used[:fitted, j]] ** 2) for j in range(6)])
    share = (independent * size)[0]
    np.testing.assert_allclose(found.weight, used * share / size, rtol=1e-6)
    shares = [
        min(1.0, min(1.0, 2 * e.recording.signals.cutoff / e.recording.trajectory.rate)
            * (k[1] - k[0]))
        for e, k in zip(every, found.taken, strict=True)
    ]  # fmt: skip
    assert share**2 == pytest.approx(min(shares), rel=1e-6)
    np.testing.assert_allclose(found.r, found.weight * r, atol=1e-9)
    squares = np.sum((found.weight * tau)[:fitted] ** 2, axis=0)
    np.testing.assert_allclose(found.torque, squares)
    C = mapping.K @ np.diag(identified.prior_std**2) @ mapping.K.T
    np.testing.assert_allclose(found.U.T @ found.U, C, atol=1e-9 * C.max())
    W = found.weight[:, :, None] * (Y[:, :, mapping.independent] @ found.U.T)
    np.testing.assert_allclose(found.W, W, atol=1e-8 * np.abs(W).max())
    n = model.layout.n_inertial
    load = Y[:, :, :n] @ identified.standard[:n]
    np.testing.assert_allclose([m.load for m in found.motions], load.T, atol=1e-8)
    alone = take_sample(identified, for_drives=True)
    assert alone.rows == len(alone.r) == fitted


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
