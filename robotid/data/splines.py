"""Cubic splines through signals over time.

They equal CubicSpline of scipy.interpolate to rounding; the import of that package takes longer
than all splines of a job.
"""

import numpy as np
from scipy.linalg.lapack import dgtsv

from robotid.base.typing import Array


def cubic_spline(t: Array, x: Array, at: Array) -> Array:
    """Return signals at other times, by the cubic spline through all of their rows.

    The third derivative is continuous at the second and the last but one row ("not a knot"): two
    rows give a straight line, three a parabola. The outer polynomials extrapolate.

    References:
        de Boor (1978), A Practical Guide to Splines, chapter IV.

    t (N,) [s], x (N, k) -> (..., k).
    """
    h = np.diff(t)[:, None]  # (N - 1, 1)
    chord = np.diff(x, axis=0) / h
    slope = _slopes(h, chord)  # of the spline at its rows, (N, k)
    bend = (slope[:-1] + slope[1:] - 2 * chord) / h
    cubic, square = bend / h, (chord - slope[:-1]) / h - bend
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    u = at - t[k]
    found = cubic.T.take(k, axis=1)  # (k, ...): long loops over times
    for own in (square, slope, x):
        found *= u
        found += own.T.take(k, axis=1)
    return np.moveaxis(found, 0, -1)


def _slopes(h: Array, chord: Array) -> Array:
    """Return the derivatives of the spline at its N rows, shape (N, k), from steps and chords."""
    if len(h) == 1:
        return np.repeat(chord, 2, axis=0)
    if len(h) == 2:  # of a parabola
        bend = (chord[1] - chord[0]) / (h[0] + h[1])
        return np.stack([chord[0] - bend * h[0], chord[0] + bend * h[0], chord[1] + bend * h[1]])
    first, last = h[0] + h[1], h[-2] + h[-1]
    below = np.concatenate([h[1:], [last]])[:, 0]
    middle = np.concatenate([h[1:2], 2 * (h[:-1] + h[1:]), h[-2:-1]])[:, 0]
    above = np.concatenate([[first], h[:-1]])[:, 0]
    b = np.empty((len(h) + 1, chord.shape[1]), order="F")
    b[1:-1] = 3 * (h[1:] * chord[:-1] + h[:-1] * chord[1:])
    b[0] = ((h[0] + 2 * first) * h[1] * chord[0] + h[0] ** 2 * chord[1]) / first
    b[-1] = (h[-1] ** 2 * chord[-2] + (2 * last + h[-1]) * h[-2] * chord[-1]) / last
    return np.asarray(dgtsv(below, middle, above, b, overwrite_b=1)[3])
