import numpy as np
import pytest
import scipy.linalg

from robotid.base.exceptions import DataError
from robotid.data.log import Trajectory
from robotid.dynamics import factors
from robotid.dynamics.factors import (
    Problem,
    Reduction,
    compress,
    compress_segments,
    concatenate,
    gather,
    join_segments,
    merge,
)
from robotid.dynamics.torque import build_problem


def make(rng, samples=300, n=3, c=5, block=64, weight=None, support=None):
    W = rng.standard_normal((samples * n, c))
    support = np.ones((n, c), dtype=bool) if support is None else support
    W *= np.tile(support, (samples, 1))
    tau = rng.standard_normal(samples * n)
    weight = np.ones(samples * n) if weight is None else weight

    def stream():
        for k in range(0, samples * n, block * n):
            part = slice(k, k + block * n)
            yield W[part], tau[part], weight[part]

    return Problem(stream, tuple("abcde"[:c]), n, support), W, tau


def gram(R):
    return R.T @ R


def test_many_blocks_keep_the_digits_of_one_full_qr_on_poor_excitation(rng):
    # singular values from 1 to 1e-5, over 100 blocks
    samples, c = 6400, 12
    Q = np.linalg.qr(rng.standard_normal((samples, c)))[0]
    A = Q * np.logspace(0, -5, c) @ np.linalg.qr(rng.standard_normal((c, c)))[0]
    theta = rng.standard_normal(c)
    tau = A @ theta
    blocks = [(A[k : k + 64], tau[k : k + 64], np.ones(64)) for k in range(0, samples, 64)]
    problem = Problem(lambda: iter(blocks), tuple("abcdefghijkl"), 1, np.ones((1, c), dtype=bool))
    R = compress(problem).R[0]
    size = np.linalg.norm(theta)
    by_qr = scipy.linalg.solve_triangular(R[:c, :c], R[:c, c])
    by_gram = np.linalg.solve(A.T @ A, A.T @ tau)
    assert np.linalg.norm(by_qr - theta) < 5e-12 * size
    assert np.linalg.norm(by_gram - theta) > 1e-8 * size  # why there are no Gram matrices


def test_scipys_wrapper_gives_the_same_factors(rng, monkeypatch):
    problem = make(rng, weight=rng.choice([0.0, 1.0], 900))[0]
    R = compress(problem).R
    monkeypatch.setattr(factors, "_dtpqrt", lambda: None)
    np.testing.assert_allclose(compress(problem).R, R, atol=1e-13)


def test_a_row_that_is_not_finite_is_refused(rng):
    problem, W, _ = make(rng)
    W[17, 2] = np.nan
    with pytest.raises(DataError, match="a row that is not finite"):
        compress(problem)


def test_problems_with_other_columns_do_not_mix(rng):
    one, other = make(rng)[0], make(rng, c=4)[0]
    with pytest.raises(DataError, match="problems differ in their columns"):
        concatenate([one, other])
    with pytest.raises(DataError, match="factors differ"):
        merge([compress(one), compress(other)])
    with pytest.raises(DataError, match="there are no factors, expected"):
        merge([])
    with pytest.raises(DataError, match="there is no problem, expected"):
        concatenate([])


def test_stretches_merge_into_the_factors_of_the_whole(ur5, rng):
    t = np.arange(250) / 100.0
    q, v, a, tau = rng.uniform(-1, 1, (4, 250, 6))
    motion = Trajectory(t, q, v, a, tau, ur5.joints, 100.0, np.zeros(250, dtype=int))
    weight = rng.integers(0, 2, (250, 6)).astype(float)
    problem = build_problem(ur5, motion, weight).select(np.arange(3, 40))
    segments = compress_segments(concatenate([problem, problem]), 100)
    assert len(segments) == 6
    np.testing.assert_array_equal(segments[1].rows, (weight[100:200] > 0).sum(axis=0))
    whole, merged = compress(problem), merge(segments[3:])
    np.testing.assert_array_equal(merged.rows, whole.rows)
    for a, b in zip(merged.R, whole.R, strict=True):
        np.testing.assert_allclose(gram(a), gram(b), rtol=1e-11, atol=1e-9)


def test_stretches_need_rows_that_can_be_cut(rng):
    with pytest.raises(DataError, match="has blocks only"):
        compress_segments(make(rng)[0], 10)


#: Supports of trees: each joint has the columns of all that it carries.
TREES = {
    "chain": [[1, 1, 1, 1, 1], [0, 1, 1, 1, 1], [0, 0, 0, 1, 1]],
    "two fingers on a palm": [[1, 1, 1, 1, 1], [0, 1, 1, 0, 0], [0, 0, 0, 1, 1]],
    "apart": [[1, 1, 0, 0, 0], [0, 0, 1, 0, 1], [0, 0, 0, 1, 0]],
    "overlapping": [[1, 1, 1, 0, 0], [0, 0, 1, 1, 1], [0, 0, 0, 0, 0]],
    "alike": [[1, 0, 1, 1, 1]] * 3,
}


def tree_support(kind):
    return np.array(TREES[kind], dtype=bool)


@pytest.mark.parametrize("kind", TREES)
def test_compact_factors_are_those_of_the_dense_rows(rng, kind):
    problem, W, tau = make(rng, support=tree_support(kind))
    factors, A = compress(problem), np.column_stack([W, tau])
    assert [len(own) for own in factors.columns] == problem.support.sum(axis=1).tolist()
    sigma = np.array([0.5, 2.0, 3.0])
    R = factors.weighted(sigma)
    np.testing.assert_array_equal(R, np.triu(R))
    np.testing.assert_allclose(gram(R), gram(A / np.tile(sigma, 300)[:, None]), atol=1e-10)

    columns = np.array([4, 0, 2])  # not in order
    selected, kept = factors.select(columns), A[:, [4, 0, 2, 5]]
    for j in range(3):
        np.testing.assert_allclose(gram(selected.R[j]), gram(kept[j::3]), atol=1e-10)


def test_factors_with_other_columns_per_joint_merge(rng):
    one, W, tau = make(rng, support=tree_support("chain"))
    other, V, force = make(rng, support=tree_support("apart"))
    merged = merge([compress(one), compress(other)])
    for j in range(3):
        A = np.vstack([np.column_stack([W, tau])[j::3], np.column_stack([V, force])[j::3]])
        np.testing.assert_allclose(gram(merged.R[j]), gram(A), atol=1e-10)


def unlike(rng):
    """Two logs of three joints with columns of their own and rows left out, and their rows."""
    support = np.array([[1, 1, 1, 0, 1], [0, 1, 0, 1, 1], [0, 0, 0, 1, 1]], dtype=bool)
    parts = []
    for samples, own in ((40, support), (23, support & ~np.eye(3, 5, dtype=bool))):
        weight = rng.choice([0.0, 0.5, 4.0], samples * 3)
        parts.append((*make(rng, samples=samples, weight=weight, support=own, block=16), weight))
    return parts


def test_what_is_asked_of_factors_is_what_their_dense_rows_say(rng):
    parts = unlike(rng)
    factors = compress(concatenate([problem for problem, *_ in parts]))
    rows = []
    for j in range(3):
        W, tau, weight = (np.concatenate([part[k][j::3] for part in parts]) for k in (1, 2, 3))
        rows.append((W * np.sqrt(weight)[:, None], tau * np.sqrt(weight), weight))
    theta, each = rng.standard_normal(5), np.array([0.7, 3.0, 0.2])
    A = rng.standard_normal((5, 5))
    covariance = A @ A.T
    np.testing.assert_array_equal(factors.rows, [np.sum(w > 0) for *_, w in rows])
    left = [np.sum((tau - W @ theta) ** 2) for W, tau, _ in rows]
    np.testing.assert_allclose(factors.residual_squares(theta), left)
    np.testing.assert_allclose(factors.torque_squares(), [np.sum(tau**2) for _, tau, _ in rows])
    spread = [np.trace(W @ covariance @ W.T) for W, *_ in rows]
    np.testing.assert_allclose(factors.leverages(covariance), spread)
    known = sum(x * W.T @ W for x, (W, *_) in zip(each, rows, strict=True))
    np.testing.assert_allclose(factors.information(each), known, atol=1e-12)
    score = sum(x * W.T @ (tau - W @ theta) for x, (W, tau, _) in zip(each, rows, strict=True))
    np.testing.assert_allclose(factors.score(theta, each), score, atol=1e-12)
    np.testing.assert_allclose(factors.without(theta).torque_squares(), left)
    sigma = np.array([0.5, 2.0, 0.1])
    whole = sum(
        gram(np.column_stack([W, tau]) / level)
        for level, (W, tau, _) in zip(sigma, rows, strict=True)
    )
    np.testing.assert_allclose(gram(factors.weighted(sigma)), whole, atol=1e-9)
    R, residual = factors.weighted_rows(theta, sigma)
    rows = np.column_stack([R, residual + R @ theta])
    np.testing.assert_allclose(gram(rows), whole, atol=1e-9)


def test_a_problem_of_two_logs_has_the_columns_of_both(rng):
    parts = unlike(rng)
    problems = [problem for problem, *_ in parts]
    for order in (problems, problems[::-1]):
        both = concatenate(order)
        np.testing.assert_array_equal(both.support, problems[0].support)
        assert both.names == problems[0].names
    W, tau, weight = (np.concatenate(x) for x in zip(*concatenate(problems).blocks(), strict=True))
    for k, found in enumerate((W, tau, weight), start=1):
        np.testing.assert_array_equal(found, np.concatenate([part[k] for part in parts]))


@pytest.mark.parametrize(
    ("count", "most", "lengths"),
    [(7, 3, [3, 3, 1]), (6, 3, [2, 2, 2]), (5, 4, [2, 2, 1]), (3, 8, [1, 1, 1]), (4, 1, [4])],
)
def test_pieces_are_joined_to_stretches_of_one_length(rng, count, most, lengths):
    pieces = []
    for k in range(count):
        problem, *_ = make(rng, samples=10 + k)
        pieces.append(Reduction(compress(problem), np.full((3, 3), 10.0**k), 10 + k))
    found = join_segments(iter(pieces), count, most)
    edges = np.cumsum([0, *lengths])
    for own, i, j in zip(found, edges[:-1], edges[1:], strict=True):
        assert own.samples == sum(10 + k for k in range(i, j))
        np.testing.assert_array_equal(own.squares, sum(10.0**k for k in range(i, j)))
        total = sum(gram(piece.factors.R[1]) for piece in pieces[i:j])
        np.testing.assert_allclose(gram(own.factors.R[1]), total, atol=1e-10)


def test_stretches_are_gathered_to_as_many_as_wanted_or_as_there_are(rng):
    pieces = [compress(make(rng, samples=10 + k)[0]) for k in range(5)]
    every = range(6)
    for count, edges in ((2, [0, 2, 5]), (3, [0, 2, 3, 5]), (5, every), (9, every), (1, [0, 5])):
        found = gather(pieces, count)
        assert len(found) == len(edges) - 1
        for own, i, j in zip(found, edges[:-1], edges[1:], strict=True):
            np.testing.assert_array_equal(own.rows, sum(piece.rows for piece in pieces[i:j]))
            total = sum(gram(piece.R[0]) for piece in pieces[i:j])
            np.testing.assert_allclose(gram(own.R[0]), total, atol=1e-10)
