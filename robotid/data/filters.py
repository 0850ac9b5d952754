"""Filters of signals: Butterworth, local polynomials.

They equal ``sosfiltfilt(butter(...))`` and ``savgol_filter`` of scipy.signal to rounding; importing
that package takes longer than the doctor.
"""

from functools import cache
from math import factorial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg.lapack import dtbtrs

from robotid.base.typing import Array


@cache  # a log has few filters, each for many channels
def butterworth_poles(order: int, cutoff: float, rate: float) -> Array:
    """Return the poles of a digital Butterworth low-pass filter, by the bilinear transform.

    -> (ceil(order / 2),).
    """
    angles = np.pi * (2 * np.arange((order + 1) // 2) + order + 1) / (2 * order)
    analog = np.tan(np.pi * cutoff / rate) * np.exp(1j * angles)
    poles = np.asarray((1 + analog) / (1 - analog))
    poles.flags.writeable = False
    return poles


def zero_phase(x: Array, order: int, cutoff: float, rate: float, pad: int) -> Array:
    """Return signals after a Butterworth filter forwards and backwards, shape (N, ...).

    The initial state of each pass is the steady state for the first value; both ends are extended
    by point reflection of the signal (Gustafsson 1996 compares such initial states).

    x (N, ...).
    """
    if not x.size:
        return x  # LAPACK would write beyond an empty array
    # (k, N): each signal in one piece of memory
    rows = np.ascontiguousarray(x.reshape(len(x), -1).T)
    first, last = rows[:, :1], rows[:, -1:]
    before, after = 2 * first - rows[:, pad:0:-1], 2 * last - rows[:, -2 : -pad - 2 : -1]
    y = np.concatenate([before, rows, after], axis=1)
    poles = butterworth_poles(order, cutoff, rate)
    work = np.empty_like(y)
    for _ in range(2):
        start = y[:, :1].copy()
        y -= start
        for pole in poles:
            y, work = _filter(y, pole, work)
        y += start
        y = np.ascontiguousarray(y[:, ::-1])
    return np.asarray(y[:, pad : y.shape[1] - pad].T.reshape(x.shape))


def _filter(x: Array, pole: complex, work: Array) -> tuple[Array, Array]:
    """Return filtered signals, shape (k, N), by one pole or a conjugate pair, from state 0.

    With zeros at half the rate: y + a y' = g (x + x'), or y + a y' + b y'' = g (x + 2 x' + x'').
    The signals and another array of their shape are overwritten; the second one returned is free.
    """
    is_real = abs(pole.imag) < 1e-12 * abs(pole)
    a = np.array([1.0, -pole.real] if is_real else [1.0, -2 * pole.real, abs(pole) ** 2])
    for _ in a[1:]:
        work[:, 0] = x[:, 0]
        np.add(x[:, 1:], x[:, :-1], out=work[:, 1:])  # in place it would copy the signals first
        x, work = work, x
    x *= a.sum() / 2.0 ** (len(a) - 1)  # gain 1 for constant signals
    band = np.tile(a, (x.shape[1], 1)).T  # of the triangle whose solution is the recursion
    return dtbtrs(band, x.T, uplo="L", diag="U", overwrite_b=1)[0].T, work


def local_polynomial(
    x: Array, width: int, degree: int, *, derivative: int = 0, step: float = 1.0
) -> Array:
    """Return signals smoothed by polynomials through the rows around each row, shape (N, ...).

    At the ends the polynomial of the first and of the last ``width`` rows is used (Savitzky, Golay
    1964).

    x (N, ...).
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
