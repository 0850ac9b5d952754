"""The laws that terms of a drive's torque are made of, each beside its derivative.

A memoryless term multiplies its parameter by a(v) b(q), a law of the speed times a law of the
position, within the ranges seen; times the direction of friction or not; times the load of the
gear or not. A law is a code and up to four numbers that shape it. Friction that a drive takes up
over a way has a state and a law of its own, ``bristles``.

The functions work on NumPy's arrays and, compiled, on single numbers: they take no other forms of
Python than both know, and call none of each other.
"""

from collections.abc import Sequence

import numpy as np

from robotid._typing import Array

__all__ = [
    "BRISTLES",
    "CONSTANT",
    "COSINE",
    "CUBIC",
    "DIRECTED",
    "FADING",
    "HAT",
    "LEVER",
    "LINEAR",
    "LOADED",
    "PLAIN",
    "POLYNOMIAL",
    "POWER",
    "RISE",
    "SINE",
    "SIZE",
    "TANH",
    "bristles",
    "law",
]

#: The laws.
CONSTANT, LINEAR, SIZE, CUBIC, TANH, FADING, POWER, RISE = range(8)
POLYNOMIAL, COSINE, SINE, HAT, LEVER = range(8, 13)
#: What a term is beside a(v) b(q): nothing more; times the direction of friction; times that and
#: the size of the gear's load; or a deflection that bristles take up over a way instead.
PLAIN, DIRECTED, LOADED, BRISTLES = range(4)

_LEAST = 1e-12  # [rad/s or m/s]: below it the slope of a power is that at it


def law(
    code: int, x0: float, x1: float, x2: float, x3: float, z: Array
) -> tuple[Array | float, Array | float]:
    """Return a law y(z) and its derivative.

    Args:
        code: Which law.
        x0: What shapes it; 0 of a law that has no such number.
        x1: Likewise.
        x2: Likewise.
        x3: Likewise.
        z: Speeds or positions [rad/s or m/s; rad or m].
    """
    if code == LINEAR:
        return z, 1.0
    if code == SIZE:
        return np.abs(z), np.sign(z)
    if code == CUBIC:
        return z * z * z, 3.0 * z * z
    if code == TANH:
        y = np.tanh(z / x0)
        return y, (1.0 - y * y) / x0
    if code == FADING:  # from |z| = x1 on
        size = np.maximum(np.abs(z), x1)
        y = np.exp(-size / x0)
        return y, -np.sign(z) * (size > x1) * y / x0
    if code == POWER:
        y = np.abs(z) ** x0
        return y, np.sign(z) * x0 * y / np.maximum(np.abs(z), _LEAST)
    if code == RISE:  # from 0 at |z| = x0 to 1 at x1
        y = np.minimum(np.maximum((np.abs(z) - x0) / (x1 - x0), 0.0), 1.0)
        return y, np.sign(z) * (y > 0.0) * (y < 1.0) / (x1 - x0)
    if code == POLYNOMIAL:  # of order x0 about x1
        lower = (z - x1) ** max(x0 - 1.0, 0.0)
        return lower * (z - x1) if x0 > 0.0 else lower, x0 * lower
    if code == COSINE:
        return np.cos(x0 * z), -x0 * np.sin(x0 * z)
    if code == SINE:
        return np.sin(x0 * z), x0 * np.cos(x0 * z)
    if code == HAT:  # 1 at x1, 0 from x0 down and from x2 up
        y = np.maximum(np.minimum((z - x0) / (x1 - x0), (x2 - z) / (x2 - x1)), 0.0)
        rises, falls = (z > x0) & (z <= x1), (z > x1) & (z < x2)
        return y, rises / (x1 - x0) - falls / (x2 - x1)
    if code == LEVER:  # (L - x3) dL/dz, L^2 = x0^2 + x1^2 - 2 x0 x1 cos(z - x2)
        c, s = x0 * x1 * np.cos(z - x2), x0 * x1 * np.sin(z - x2)
        length = np.sqrt(x0 * x0 + x1 * x1 - 2.0 * c)
        slope = s / length
        return (length - x3) * slope, slope * slope + (length - x3) * (c - slope * slope) / length
    return 1.0, 0.0


def bristles(x: Sequence[float], way: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return what a way leaves of the deflection z of bristles.

    dz/ds = sign(v) - z / g along s = |q| / s_0, where g(v) = 1 + c exp(-(v / w)^2) is that of long
    sliding: over a way in one direction, at one speed, z becomes sign(v) g + (z - sign(v) g) kept.

    Args:
        x: s_0, w and c [rad or m; rad/s or m/s; -].
        way: How far the drive goes [rad or m].
        v: Its speed meanwhile [rad/s or m/s].

    Returns:
        g, dg/dv, kept = exp(-|way| / (s_0 g)).
    """
    extra = x[2] * np.exp(-((v / x[1]) ** 2))
    g = 1.0 + extra
    return g, -2.0 * v / (x[1] * x[1]) * extra, np.exp(-np.abs(way) / (x[0] * g))
