import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from robotid.data.filters import cubic_spline


@pytest.mark.parametrize("rows", [2, 3, 4, 5, 60])
def test_splines_are_those_of_scipy_at_uneven_times_and_beyond_the_ends(rows, rng):
    t = np.cumsum(rng.uniform(0.2, 1.8, rows))
    x = rng.normal(size=(rows, 3))
    at = rng.uniform(t[0] - 0.5, t[-1] + 0.5, size=(4, 25))
    found, wanted = cubic_spline(t, x, at), CubicSpline(t, x, axis=0)(at)
    assert found.shape == (4, 25, 3)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())
    np.testing.assert_allclose(cubic_spline(t, x, t), x, rtol=0, atol=1e-12)  # also at its rows
