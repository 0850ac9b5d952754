"""Filters against those of scipy."""

import numpy as np
import pytest
from scipy.signal import butter, savgol_filter, sosfiltfilt

from robotid.data.signals import butterworth_poles, local_polynomial, zero_phase


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5, 8])
@pytest.mark.parametrize(("rows", "pad"), [(400, 60), (40, 39), (12, 0)])
def test_a_low_pass_filter_run_both_ways_is_that_of_scipy(order, rows, pad, rng):
    x = rng.standard_normal((rows, 3)).cumsum(axis=0) + 5.0
    sos = butter(order, 7.0, fs=100.0, output="sos")
    wanted = sosfiltfilt(sos, x, axis=0, padlen=pad)
    np.testing.assert_allclose(zero_phase(x, order, 7.0, 100.0, pad), wanted, rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        zero_phase(x[:, 1], order, 7.0, 100.0, pad), wanted[:, 1], rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("order", [1, 4, 5])
def test_poles_are_those_of_scipy(order):
    poles = butter(order, 3.0, fs=50.0, output="zpk")[1]
    upper = poles[poles.imag > -1e-12]
    found = butterworth_poles(order, 3.0, 50.0)
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(upper), atol=1e-12)


@pytest.mark.parametrize(
    ("width", "degree", "derivative"),
    [(11, 3, 0), (11, 3, 1), (5, 2, 1), (5, 2, 2), (1, 0, 0), (25, 4, 2)],
)
def test_local_polynomials_are_those_of_scipy(width, degree, derivative, rng):
    x = rng.standard_normal((40, 2)).cumsum(axis=0)
    wanted = savgol_filter(x, width, degree, deriv=derivative, delta=0.02, axis=0)
    found = local_polynomial(x, width, degree, derivative=derivative, step=0.02)
    np.testing.assert_allclose(found, wanted, atol=1e-9 * np.abs(wanted).max())


def test_a_cubic_keeps_its_shape_and_slope_to_its_ends():
    t = 0.1 * np.arange(30)
    x = 1.0 - 2.0 * t + 0.5 * t**3
    np.testing.assert_allclose(local_polynomial(x, 7, 3), x, atol=1e-10)
    slope = local_polynomial(x, 7, 3, derivative=1, step=0.1)
    np.testing.assert_allclose(slope, -2.0 + 1.5 * t**2, atol=1e-9)
