"""Vectors of compiled code: each operator beside NumPy, lane by lane."""

import math

import numpy as np

from robotid.dynamics.kernels.lanes import (
    LANES,
    compiled,
    copysign,
    cos_sin,
    is_any,
    read,
    where,
    wide,
    write,
)

x = np.array([1.5, -2.0, 0.0, 3.25, -0.5, 7.0, -4.0, np.nan])
y = np.array([-0.5, 4.0, -2.5, 3.25, 1.0, 2.0, -9.0, 1.0])


@compiled
def arithmetic(a, b, out):
    u, v = read(a, 0), read(b, 0)
    found = (u + v, u - 2.0, 3.0 * u, 1.0 / v, -u, abs(u), math.sqrt(abs(v)), copysign(u, v))
    for k in range(8):
        write(out, k * LANES, found[k])
    w = wide(2.0)
    w += u
    w *= v
    w -= 1.0
    w /= 4.0
    write(out, 8 * LANES, w)


@compiled
def comparisons(a, b, out):
    u, v = read(a, 0), read(b, 0)
    both = (u < v) & (v > 0.0)
    either = (u <= v) | (v >= 4.0)
    masks = (u < v, u <= v, u > v, u >= v, u == v, both, either, ~(u < v))
    for k in range(8):
        write(out, k * LANES, where(masks[k], 1.0, 0.0))
    write(out, 8 * LANES, where(u > v, u, v))
    return is_any(u > 6.9), is_any(u > 7.1)


def test_arithmetic_is_numpys():
    out = np.zeros(9 * LANES)
    arithmetic(x, y, out)
    expected = [x + y, x - 2, 3 * x, 1 / y, -x, abs(x), np.sqrt(abs(y)), np.copysign(x, y)]
    expected.append(((2 + x) * y - 1) / 4)
    np.testing.assert_allclose(out.reshape(9, LANES), expected, rtol=1e-15)


def test_comparisons_are_numpys_and_false_for_nan():
    out = np.zeros(9 * LANES)
    assert comparisons(x, y, out) == (True, False)
    expected = [x < y, x <= y, x > y, x >= y, x == y, (x < y) & (y > 0), (x <= y) | (y >= 4)]
    expected += [~(x < y), np.where(x > y, x, y)]
    np.testing.assert_array_equal(out.reshape(9, LANES), np.array(expected, dtype=float))


@compiled
def turn(angles, out):
    c, s = cos_sin(read(angles, 0))
    write(out, 0, c)
    write(out, LANES, s)


def test_cosine_and_sine_in_all_quarters():
    for angles in (np.linspace(-7.0, 7.0, LANES), 1e3 + np.arange(LANES), np.zeros(LANES)):
        out = np.zeros(2 * LANES)
        turn(angles, out)
        np.testing.assert_allclose(out.reshape(2, -1), [np.cos(angles), np.sin(angles)], atol=3e-13)
