"""The filters of recorded signals: Butterworth's, run both ways, and local polynomials.

They do what ``sosfiltfilt(butter(...))`` and ``savgol_filter`` of scipy.signal do, to rounding: the
import of that package takes longer than the doctor does.
"""

from math import factorial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg.blas import dtbsv

from robotid._typing import Array

__all__ = ["butterworth_poles", "local_polynomial", "zero_phase"]


def butterworth_poles(order: int, cutoff: float, rate: float) -> Array:
    """Return the poles of a digital low-pass filter of Butterworth, by the bilinear transform.

    Args:
        order: Number of poles.
        cutoff: Frequency of half the power [Hz].
        rate: Rows per second.

    Returns:
        Those on the real axis or above it, shape (ceil(order / 2),), complex.
    """
    angles = np.pi * (2 * np.arange((order + 1) // 2) + order + 1) / (2 * order)
    analog = np.tan(np.pi * cutoff / rate) * np.exp(1j * angles)
    return np.asarray((1 + analog) / (1 - analog))


def zero_phase(x: Array, order: int, cutoff: float, rate: float, pad: int) -> Array:
    """Return signals after Butterworth's filter forwards and backwards, shape (N, ...).

    Each pass starts as if the first value had been there for ever; both ends are continued by the
    signal turned about its end (Gustafsson 1996 compares such starts).

    Args:
        x: Signals over time, shape (N, ...).
        order: Order of the filter.
        cutoff: Frequency of half the power in one pass [Hz].
        rate: Rows per second.
        pad: Rows by which both ends are continued, below N.
    """
    flat = x.reshape(len(x), -1)
    before, after = 2 * flat[0] - flat[pad:0:-1], 2 * flat[-1] - flat[-2 : -pad - 2 : -1]
    y = np.concatenate([before, flat, after])
    sections = [_Section(pole) for pole in butterworth_poles(order, cutoff, rate)]
    for _ in range(2):
        start = y[0]
        y = y - start
        for section in sections:
            y = section.filtered(y)
        y = (y + start)[::-1]
    return np.asarray(y[pad : len(y) - pad].reshape(x.shape))


class _Section:
    """One pole, or a pair of conjugate ones, with zeros at half the rate: y + a y' = g (x + x')."""

    def __init__(self, pole: complex) -> None:
        is_real = abs(pole.imag) < 1e-12 * abs(pole)
        self.a = np.array([1.0, -pole.real] if is_real else [1.0, -2 * pole.real, abs(pole) ** 2])
        self.b = np.array([1.0, 1.0] if is_real else [1.0, 2.0, 1.0])
        self.b *= self.a.sum() / self.b.sum()  # what is constant passes

    def filtered(self, x: Array) -> Array:
        """Return the output of the section that was at rest, shape (N, k)."""
        right = self.b[0] * x
        for k, b in enumerate(self.b[1:], start=1):
            right[k:] += b * x[:-k]
        band = np.tile(self.a, (len(x), 1)).T  # of the triangle whose solution is the recursion
        columns = [dtbsv(len(self.a) - 1, band, column, lower=1, diag=1) for column in right.T]
        return np.reshape(columns, x.shape[::-1]).T


def local_polynomial(
    x: Array, width: int, degree: int, *, derivative: int = 0, step: float = 1.0
) -> Array:
    """Return signals as polynomials through the rows around each have them, shape (N, ...).

    At the ends the polynomial of the first and of the last ``width`` rows counts (Savitzky, Golay
    1964).

    Args:
        x: Signals over time, shape (N, ...).
        width: Rows of each polynomial, odd, at most N.
        degree: Its degree, below ``width``.
        derivative: Which of its derivatives is returned.
        step: Time between rows [s].
    """
    half = width // 2
    offsets = np.arange(-half, half + 1)
    fit = np.linalg.pinv(np.vander(offsets, degree + 1, increasing=True))  # (degree + 1, width)
    scale = factorial(derivative) / step**derivative
    inner = sliding_window_view(x, width, axis=0) @ (scale * fit[derivative])
    powers = np.arange(degree + 1 - derivative)
    slopes = [factorial(k + derivative) / factorial(k) / step**derivative for k in powers]

    def end(rows: Array, at: Array) -> Array:
        """Return the values at some offsets by the polynomial of ``width`` rows."""
        coefficients = np.tensordot(fit[derivative:], rows, axes=1)
        return np.tensordot(at[:, None] ** powers * slopes, coefficients, axes=1)

    return np.concatenate(
        [end(x[:width], offsets[:half]), inner, end(x[-width:], offsets[half + 1 :])]
    )
