import numpy as np
import pinocchio as pin
import pytest

from robotid.viewer.scene import ellipsoids


def test_the_ellipsoid_of_a_solid_ellipsoid_is_itself(rng):
    for _ in range(20):
        a = np.sort(rng.uniform(0.02, 0.5, 3))
        M = pin.SE3.Random()
        body = M.act(pin.Inertia.FromEllipsoid(3.7, *a))
        (found,) = ellipsoids(body.toDynamicParameters())
        assert found.mass == pytest.approx(3.7)
        np.testing.assert_allclose(found.com, M.translation, atol=1e-12)
        np.testing.assert_allclose(found.semi_axes, a, rtol=1e-9)
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)
        # the axes agree but for their signs
        np.testing.assert_allclose(np.abs(found.rotation.T @ M.rotation), np.eye(3), atol=1e-7)


def test_a_rod_has_no_width():
    pi = np.array([2.0, 0, 0, 0, 0, 0, 0.3, 0, 0, 0.3])  # along x
    (found,) = ellipsoids(pi)
    np.testing.assert_allclose(found.semi_axes, [0, 0, np.sqrt(5 * 0.3 / 2)], atol=1e-7)


def test_what_no_solid_can_be_has_no_ellipsoid_and_says_why():
    thin = [1.0, 0, 0, 0, 0.1, 0, 0.1, 0, 0, 0.3]  # one moment exceeds the sum of the others
    pi = np.array([np.zeros(10), [-1.0, *np.ones(9)], thin]).ravel()
    nothing, negative, impossible = ellipsoids(pi)
    assert (nothing.fault, nothing.com) == ("no mass", None)
    assert (negative.fault, negative.com) == ("negative mass", None)
    assert impossible.fault == "no solid has this inertia"
    assert impossible.semi_axes is None
    np.testing.assert_allclose(impossible.com, 0.0)
