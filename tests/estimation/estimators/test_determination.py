"""Which directions data determine: closed forms, brute force, and one answer everywhere."""

import numpy as np
import pytest

from robotid.base.exceptions import RankDeficientError
from robotid.estimation.estimators.determination import (
    Combination,
    Determination,
    Group,
    base_spread,
    determine,
)


def test_words_name_the_four_largest_terms_of_a_sum_by_their_shares():
    names, factors = tuple("abcdefg"), (-20.0, 0.5, 1.0, 1.0, 3.14159, -1.0, 7.0)
    shares = (0.3, -0.2, 1.0, 0.9, 0.051, 0.4, 0.05)
    sums = [Combination(names[:k], factors[:k], shares[:k]) for k in range(3, 8)]
    assert list(map(str, sums)) == [
        "c - 20 a + 0.5 b", "c + d - 20 a + 0.5 b", "c + d - 20 a + 0.5 b + ...",
        "c + d - f - 20 a + ...", "c + d - f - 20 a + ...",
    ]  # fmt: skip
    assert str(Combination(names[2:5], factors[2:5], shares[2:5])) == "c + d + 3.14 e"
    # g is too small to be a term, whatever its factor
    assert str(Combination(("c", "g"), (1.0, 7.0), (1.0, 0.05))) == "c"


def grouped(size, count):
    names = tuple(f"p{k}" for k in range(size))
    return Group(names, tuple(Combination(names[k : k + 1], (1.0,), (1.0,)) for k in range(count)))


def test_words_of_groups_say_how_many_sums_are_determined():
    said = [str(grouped(*sizes)) for sizes in ((2, 0), (2, 1), (5, 2), (4, 3), (6, 1), (1, 0))]
    assert said == [
        "p0 and p1 are not identifiable", "p0 and p1 are identifiable only as p0",
        "p0, p1, p2, p3 and p4 are identifiable only as p0 and p1",
        "the 4 parameters p0 ... p3 are identifiable only in 3 sums, as p0",
        "the 6 parameters p0 ... p5 are identifiable only in 1 sum, as p0",
        "p0 is not identifiable",
    ]  # fmt: skip
    a, b = Group(("x",), ()), Group(("y", "z"), ())
    one, two, three, four = (grouped(size, 1) for size in (2, 3, 4, 5))
    names = ("x", "y", "z", "p0", "p1", "p2", "p3", "p4", "alone")

    def known(*groups):
        return Determination(names, np.ones(9), np.ones(9), np.zeros((9, 4)), groups)

    found = known(a, one, two, b, three, four)
    assert found.merged == (one, two, three, four, Group(("x", "y", "z"), ()))
    nothing = "x, y and z are not identifiable"
    assert found.described() == f"{one}; {two}; 2 more groups of this kind; {nothing}"
    assert known(one, two, three).described() == f"{one}; {two}; 1 more group of this kind"
    assert known(two, a).described() == f"{two}; x is not identifiable"
    assert found.rank == 5
    assert found.undetermined == names[:-1]
    assert known().merged == ()
    assert known().described() == ""
    error = RankDeficientError(3, ("x",), 9)
    assert known().refusal(error) is error
    said = found.refusal(error)
    assert (said.rank, said.undetermined) == (5, names[:-1])
    assert f"{one}; {two}; 2 more groups of this kind" in str(said)


@pytest.mark.parametrize(("noise", "is_determined"), [(1.0, True), (2.0, True), (2.2, False)])
def test_a_parameter_is_determined_if_its_spread_shrinks_by_a_tenth(noise, is_determined):
    # 1 / sqrt(1 + 1 / noise^2) = 0.9 at a noise of 2.06 spreads
    known = determine(["a"], np.array([[1.0 / (3.0 * noise)]]), np.array([3.0]))
    assert known.shrinkage[0] == pytest.approx(1 / np.sqrt(1 + noise**-2))
    assert known.rank == int(is_determined)
    assert known.undetermined == (() if is_determined else ("a",))


def test_what_is_pinned_counts_as_known():
    K, spread = np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]), np.array([3.0, 2.0, 1.0])
    np.testing.assert_allclose(base_spread(K, spread), [5.0, 1.0])
    before = base_spread(K, spread, [False, True, True])
    np.testing.assert_allclose(before, [3.0, 0.0])
    known = determine(["a", "b"], np.zeros((2, 2)), before)
    assert known.rank == 1
    assert known.undetermined == ("a",)


@pytest.mark.parametrize("seed", range(5))
def test_named_sums_hold_along_every_direction_the_data_leave_open(seed):
    rng = np.random.default_rng(seed)
    b, rank = 12, 8
    spread = 10.0 ** rng.uniform(-3, 2, b)
    N = rng.standard_normal((b, b - rank)) * (rng.uniform(size=(b, b - rank)) < 0.4)
    A = rng.standard_normal((30, b))
    A = 50 * (A - A @ N @ np.linalg.pinv(N)) / spread
    names = [f"p{i}" for i in range(b)]
    known = determine(names, A, spread)
    assert known.rank == np.linalg.matrix_rank(A)
    named = set()
    for combination in [c for group in known.groups for c in group.combinations]:
        places = [names.index(name) for name in combination.names]
        moved_by = np.array(combination.coefficients) @ (spread[:, None] * N)[places]
        terms = np.abs(combination.coefficients) * spread[places]
        assert np.abs(moved_by).max() < 0.01 * terms.max()
        named |= set(combination.names)
    # the rest holds by itself
    alone = [i for i, name in enumerate(names) if name not in known.undetermined]
    assert np.abs(known.weak[alone]).max(initial=0) < 0.31
    # as many independent sums and single ones as the rank
    sums = sum(len(group.combinations) for group in known.groups)
    assert sums + len(alone) == known.rank
