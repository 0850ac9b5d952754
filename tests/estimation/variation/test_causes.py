"""The cause of a difference, against generalised least squares of all runs and groups together."""

import numpy as np
import pytest

from robotid.estimation.variation.causes import evidence_by_group
from robotid.estimation.variation.groups import Group, RunsOf
from robotid.estimation.variation.mixed_effects import Runs

UNIT = np.array([0, 0, 1, 1, 1, 2, 2])
SIZES = {"drive": 2, "gain": 1, "payload": 2}
INFLATION = 1.3


def together(rng, unit, shift=None, is_own=None):
    """Return groups with common information, the estimates of all five parameters, and theirs."""
    count, total = len(unit), 5
    A = rng.normal(size=(count, 8, total))
    H = np.einsum("kri,krj->kij", A, A)
    x = rng.normal(size=(count, total))
    if shift is not None:
        x[is_own] += shift
    groups, end = [], 0
    for kind, size in SIZES.items():
        start, end = end, end + size
        own = slice(start, end)
        h = np.einsum("kij,kj->ki", H[:, own], x)
        runs = Runs(H[:, own, own] / INFLATION, h / INFLATION, unit, np.full(size, 0.7))
        about = Group(kind, kind, tuple(f"{kind}.{k}" for k in range(size)), ("-",) * size,
                      np.eye(size), (0,))  # fmt: skip
        groups.append(RunsOf(about, np.zeros(size), runs, INFLATION, across=H[:, own]))
    return groups, x, np.linalg.inv(H) * INFLATION


@pytest.mark.parametrize(("unit", "own", "is_unit"), [
    (np.zeros(7, int), 4, False),
    (UNIT, 1, True),
    (UNIT, 3, False),
])  # fmt: skip
def test_evidence_is_the_decrease_of_the_squared_residual_less_two_by_parameter(unit, own, is_unit):
    rng = np.random.default_rng(4)
    is_own = unit == own if is_unit else np.arange(7) == own
    groups, x, C = together(rng, unit)
    levels = 1 + int(unit.max() > 0)
    deviations = [np.abs(rng.normal(size=(levels, size))) + 0.2 for size in SIZES.values()]
    D = np.zeros((levels, 5))
    D[:, :2] = deviations[0]  # only drives vary
    of_unit = unit.copy()
    if not is_unit:
        of_unit[is_own] = unit.max() + 1  # compared as a run of another unit
    same = 1.0 * (of_unit[:, None] == of_unit)
    V = np.einsum("kl,kij->kilj", np.eye(7), C + np.diag(D[0] ** 2))
    if levels == 2:
        V = V + np.einsum("kl,ij->kilj", same, np.diag(D[1] ** 2))
    V = V.reshape(35, 35)

    def squares(columns):
        """Return the squared residual with a difference of some parameters of the own runs."""
        X = np.zeros((7, 5, 5 + len(columns)))
        X[:, range(5), range(5)] = 1.0
        for s, p in enumerate(columns, start=5):
            X[is_own, p, s] = 1.0
        X, y = X.reshape(35, -1), x.ravel()
        W = np.linalg.inv(V)
        r = y - X @ np.linalg.solve(X.T @ W @ X, X.T @ W @ y)
        return r @ W @ r

    found = evidence_by_group(groups, deviations, is_own, is_unit=is_unit)
    wanted = [
        squares([]) - squares(columns) - 2 * len(columns) for columns in ([0, 1], [2], [3, 4])
    ]
    assert found == pytest.approx(wanted, abs=2e-2)  # of a prior of 100 plausible sizes


def test_a_changed_gain_of_a_unit_is_the_cause_where_friction_varies():
    """The estimate of a gain and that of the drives share most of their information."""
    rng, unit, is_own = np.random.default_rng(5), np.repeat(np.arange(5), 2), np.arange(10) < 2
    shift = np.array([0.0, 0.0, 3.0, 0.0, 0.0])
    named = []
    for _ in range(20):
        groups, *_ = together(rng, unit, shift, is_own)
        wide = [np.full((2, size), 1.0) for size in SIZES.values()]
        evidence = evidence_by_group(groups, wide, is_own, is_unit=True)
        named.append(list(SIZES)[int(np.argmax(evidence))])
    assert named.count("gain") >= 17


def test_groups_without_common_information_are_independent():
    rng = np.random.default_rng(6)
    groups, *_ = together(rng, UNIT)
    alone = [RunsOf(g.group, g.centre, g.runs, g.inflation) for g in groups]
    blocks = []
    for g, size, start in zip(groups, SIZES.values(), (0, 2, 3), strict=True):
        across = np.zeros((7, size, 5))
        across[:, :, start : start + size] = g.across[:, :, start : start + size]
        blocks.append(RunsOf(g.group, g.centre, g.runs, g.inflation, across=across))
    deviations = [np.full((2, size), 0.4) for size in SIZES.values()]
    found = [evidence_by_group(x, deviations, UNIT == 2, is_unit=True) for x in (alone, blocks)]
    assert found[0] == pytest.approx(found[1])
