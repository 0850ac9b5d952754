"""What the rows of a log come down to, whole or joined from its parts."""

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.exceptions import DataError
from robotid.identification.survey import hold_log
from robotid.logs.settings import SignalSettings
from robotid.regressor.base_parameters import structural_mapping
from robotid.regressor.reduction import Reduction, join, join_stretches
from robotid.regressor.torque import build_problem

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0)


def reduction(model, log):
    motion = hold_log(model, log, EXACT).whole.trajectory
    problem = structural_mapping(model).reduce(build_problem(model, motion))
    return Reduction.of(problem, motion), motion


def test_reductions_of_the_parts_join_to_that_of_the_whole(ur5, rng):
    log = exact_log(ur5, truth(ur5), rng)
    whole, motion = reduction(ur5, log)
    middle = float(log.t[len(log.t) // 3])
    parts = [
        reduction(ur5, log.window(None, middle - 1e-6))[0],
        reduction(ur5, log.window(middle))[0],
    ]
    joined = join(parts)
    assert joined.samples == whole.samples == len(log.t)
    np.testing.assert_allclose(joined.squares, whole.squares, rtol=1e-13)
    np.testing.assert_allclose(whole.squares[1], (motion.v**2).sum(axis=0), rtol=1e-13)
    for one, other in zip(joined.factors.R, whole.factors.R, strict=True):
        np.testing.assert_allclose(one.T @ one, other.T @ other, rtol=1e-10, atol=1e-10)


def test_neighbours_are_joined_to_few_stretches(ur5, rng):
    log = exact_log(ur5, truth(ur5), rng)
    edges = np.linspace(0, 12, 11)
    ends = np.nextafter(edges[1:], 0)
    parts = [reduction(ur5, log.window(*x))[0] for x in zip(edges[:-1], ends, strict=True)]
    found = join_stretches(iter(parts), len(parts), 4)
    assert [x.samples for x in found] == [180, 180, 180, 60]
    again = join_stretches(iter(parts), len(parts), 64)
    assert [x.samples for x in again] == [60] * 10
    for x in (found, again):
        np.testing.assert_allclose(join(x).squares, join(parts).squares, rtol=1e-13)


def test_nothing_cannot_be_joined():
    with pytest.raises(DataError, match="no reduction was given; at least one log is needed"):
        join([])


def test_a_reduction_survives_its_arrays_to_the_last_bit(ur5, rng, tmp_path):
    found, _ = reduction(ur5, exact_log(ur5, truth(ur5), rng))
    np.savez(tmp_path / "part.npz", **found.to_arrays())
    with np.load(tmp_path / "part.npz") as arrays:
        again = Reduction.from_arrays(arrays)
    assert again.factors.names == found.factors.names
    assert again.samples == found.samples
    np.testing.assert_array_equal(again.factors.R, found.factors.R)
    np.testing.assert_array_equal(again.factors.rows, found.factors.rows)
    np.testing.assert_array_equal(again.squares, found.squares)
