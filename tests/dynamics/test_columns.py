"""What drive parameters multiply, of drives that turn with several joints and of sliders."""

import numpy as np
import pytest

from robotid.dynamics.rows import drive_motion, friction_speeds, sure_rows
from robotid.robot.parameters import Coupling, ParameterLayout

RATIOS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [2.0, 0, -0.5]])  # drives over joints


def layout(terms=("viscous", "coulomb"), **options):
    return ParameterLayout(
        joints=("a", "b", "c"),
        bodies=("one", "two", "three"),
        terms=terms,
        couplings=(Coupling("motor", (("a", 2.0), ("c", -0.5))),),
        **options,
    )


@pytest.mark.parametrize("first", [0, 6])  # rows of a floating base
def test_drives_move_with_their_joints_and_bear_their_part_of_the_load(rng, first):
    v, a = rng.standard_normal((2, 8, first + 3))
    q = rng.standard_normal((8, first + 3 + (first > 0)))
    load, rate = rng.standard_normal((2, 8, 3))
    direction, begins = rng.uniform(-1, 1, (8, 4)), np.arange(8) == 0
    found = drive_motion(layout(), q, v, a, direction, load, rate, begins)
    for own, x in ((found.q, q), (found.v, v), (found.a, a)):
        np.testing.assert_allclose(own, RATIOS @ x[:, -3:].T, atol=1e-14)
    # the torque of a drive that alone bears a load nearest to this one: R^T x = load
    for d, row in enumerate(RATIOS):
        for own, x in ((found.load, load), (found.rate, rate)):
            nearest = np.linalg.lstsq(row[:, None], x.T, rcond=None)[0][0]
            np.testing.assert_allclose(own[d], nearest, atol=1e-14)
    np.testing.assert_array_equal(found.direction, direction.T)
    np.testing.assert_array_equal(found.begins, begins)
    bare = drive_motion(layout(), q, v, a, np.empty((8, 0)))
    np.testing.assert_array_equal(bare.direction, bare.v)
    assert not bare.load.any()
    assert not bare.rate.any()
    assert bare.begins is None


def test_a_row_is_sure_where_every_drive_that_loads_it_is_fast():
    v = np.array([
        [1.0, 1.0, 1.0], [0.04, 1.0, 1.0], [1.0, -0.04, 1.0], [0.11, 0.2, 0.4], [-0.2, 0.06, -0.72],
    ])  # fmt: skip  # of the last two, 2 a - c / 2 is 0.02 and -0.04
    wanted = [
        [True] * 3, [False, True, True], [True, False, True], [False, True, False],
        [False, True, False],
    ]  # fmt: skip
    np.testing.assert_array_equal(sure_rows(layout(), v, 0.05), wanted)
    floating = np.hstack([np.zeros((5, 6)), v])
    found = sure_rows(layout(), floating, 0.05)
    assert found[:, :6].all(), "no drive loads the base"
    np.testing.assert_array_equal(found[:, 6:], wanted)
    assert sure_rows(layout(terms=("viscous",)), v, 0.05).all()


def test_speeds_of_sliders_count_by_their_stroke():
    sliding = layout(prismatic=frozenset({"c"}), strokes={"c": 0.8})
    c = 0.8 / (2 * np.pi)  # [m/s] that counts as 1 rad/s
    motor = (2.0 + 0.5 * c) / 2.5
    np.testing.assert_allclose(sliding.drive_speeds, [1.0, 1.0, c, motor])
    wanted = RATIOS / np.array([[1.0], [1.0], [c], [motor]])
    np.testing.assert_allclose(friction_speeds(sliding), wanted)
    unknown = layout(prismatic=frozenset({"c"}))
    np.testing.assert_allclose(unknown.drive_speeds[2], 1.0 / (2 * np.pi))
