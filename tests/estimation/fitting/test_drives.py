"""Shapes of a drive's terms: moved together, or one of them altered."""

import numpy as np

from robotid.estimation.fitting.drive_terms import DriveChoice, FoundShape
from robotid.robot.drives import LuGre, Stribeck

SEEN = {"v": (0.0, 2.0), "q": (-0.3, 0.4)}
SIZES = ((0.1,), (0.01, 0.2, 0.5))


def choice():
    names = ("stribeck.speed", "lugre.displacement", "lugre.speed", "lugre.excess")
    flat = [size for own in SIZES for size in own]
    shapes = tuple(FoundShape(n, x, 0.0, "-", False) for n, x in zip(names, flat, strict=True))
    return DriveChoice("a", ("stribeck", "lugre"), (), shapes=shapes, sizes=SIZES, data_range=SEEN)


def terms(speed, *own):
    return Stribeck(data_range=SEEN["v"], speed=speed), LuGre(
        displacement=own[0], speed=own[1], excess=own[2]
    )


def test_one_shape_of_all_is_larger_by_a_share():
    found = choice()
    assert found.altered(0, 0.5) == terms(0.1 * 1.5, 0.01, 0.2, 0.5)
    assert found.altered(1, 0.5) == terms(0.1, 0.01 * 1.5, 0.2, 0.5)
    assert found.altered(2, 0.5) == terms(0.1, 0.01, 0.2 * 1.5, 0.5)
    assert found.altered(3, -0.25) == terms(0.1, 0.01, 0.2, 0.5 * 0.75)
    assert found.sizes == SIZES


def test_shapes_move_by_a_third_at_most_and_within_their_bounds():
    """A displacement is at most 0.015 of the range of positions, 0.7 rad here."""
    root = np.diag([0.5, 0.25, 2.0, 3.0])
    covariance = root @ (np.eye(4) + 0.1) @ root
    found = choice().moved(np.array([0.5, 0.002, -0.15, 0.05]), covariance)
    sizes = [0.1 * 1.33, 0.015 * 0.7, 0.2 / 1.33, 0.55]
    np.testing.assert_allclose([x for own in found.sizes for x in own], sizes, rtol=1e-12)
    assert found.terms == terms(*(x for own in found.sizes for x in own))
    np.testing.assert_allclose([shape.value for shape in found.shapes], sizes, rtol=1e-12)
    errors = np.sqrt(1.1) * np.array([0.5, 0.25, 2.0, 3.0])
    np.testing.assert_allclose([shape.std_error for shape in found.shapes], errors, rtol=1e-12)
    np.testing.assert_array_equal(found.shape_covariance, covariance)
    assert [shape.name for shape in found.shapes] == [shape.name for shape in choice().shapes]
