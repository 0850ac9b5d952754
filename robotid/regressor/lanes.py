"""Work spaces of lanes, and vector algebra in three dimensions, compiled by Numba.

Imported only where compiled code is used, since importing Numba takes time. Numba stores the
compiled code in the folder ``__pycache__`` beside this file or, if that is not writable, in its own
folder in the user's cache; the environment variable ``NUMBA_CACHE_DIR`` sets another one.

The values of one quantity are adjacent in memory, one lane each, so that the processor computes
several states together. Entry ``at`` of a work space is one such quantity.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from llvmlite.ir import FunctionType
from numba import cfunc, njit, types
from numba.core.cgutils import unpack_tuple
from numba.extending import intrinsic

from robotid._typing import Array

__all__ = [
    "Work",
    "add",
    "applied",
    "compiled",
    "cos_sin",
    "cross",
    "dot",
    "factor",
    "get",
    "get3",
    "pointed",
    "put",
    "put3",
    "scale",
    "solve",
    "times",
    "width",
    "work_space",
]

_PAIR = types.UniTuple(types.float64, 2)
_HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_ROUND = 6755399441055744.0  # 1.5 2^52: adding and subtracting it rounds to the nearest integer


class Work(NamedTuple):
    """A work space: its entries, one after the other, and the number of lanes of each.

    The number of lanes is 2 to the length of ``doublings``: Numba knows the length of a tuple at
    compile time, so that loops over lanes are vectorised.
    """

    numbers: Array
    doublings: tuple[int, ...]


def work_space(entries: int, doublings: int) -> Work:
    """Return a work space of zeros.

    Args:
        entries: Number of entries.
        doublings: Binary logarithm of the number of lanes.
    """
    return Work(np.zeros(entries << doublings), (0,) * doublings)


def compiled(function: Any) -> Any:
    """Compile without the interpreter's lock; contract: a b + c may be rounded once.

    Args:
        function: The function.
    """
    return _cached(njit, function, nogil=True)


def pointed(function: Callable[..., Any], arguments: int) -> Any:
    """Compile a function of numbers that returns two, for ``applied``, which uses its address.

    Args:
        function: The function.
        arguments: Number of its arguments.
    """
    return _cached(partial(cfunc, _PAIR(*[types.float64] * arguments)), function)


def _cached(compile: Any, function: Any, **options: Any) -> Any:
    options |= {"fastmath": {"contract"}, "error_model": "numpy"}
    try:
        return compile(cache=True, **options)(function)
    except RuntimeError:  # no cache folder: the code exists only in this process
        return compile(**options)(function)


def _applied(typing, address, x):
    """Return the result of the function at an address of ``pointed`` for a tuple of numbers."""

    def code(context, builder, signature, given):
        numbers = unpack_tuple(builder, given[1])
        kind = FunctionType(context.get_value_type(_PAIR), [number.type for number in numbers])
        return builder.call(builder.inttoptr(given[0], kind.as_pointer()), numbers)

    return _PAIR(address, x), code


applied: Any = intrinsic(_applied)


@compiled
def width(work):
    """Return the number of lanes."""
    return 1 << len(work.doublings)


@compiled
def get(work, at, lane):
    """Return a quantity of one lane."""
    # an unsigned index avoids Numba's check of negative ones, which prevents vectorisation
    return work.numbers[np.uintp(at * (1 << len(work.doublings)) + lane)]


@compiled
def get3(work, at, lane):
    """Return three neighbouring quantities of one lane."""
    return get(work, at, lane), get(work, at + 1, lane), get(work, at + 2, lane)


@compiled
def put(work, at, lane, value):
    """Write a quantity of one lane."""
    work.numbers[np.uintp(at * (1 << len(work.doublings)) + lane)] = value


@compiled
def put3(work, at, lane, u):
    """Write three neighbouring quantities of one lane."""
    put(work, at, lane, u[0])
    put(work, at + 1, lane, u[1])
    put(work, at + 2, lane, u[2])


@compiled
def cross(u, v):
    """Return u x v."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@compiled
def add(u, v):
    """Return u + v."""
    return u[0] + v[0], u[1] + v[1], u[2] + v[2]


@compiled
def scale(s, u):
    """Return s u."""
    return s * u[0], s * u[1], s * u[2]


@compiled
def dot(u, v):
    """Return u . v."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@compiled
def times(J, u):
    """Return J u of a symmetric matrix xx xy yy xz yz zz."""
    return (
        J[0] * u[0] + J[1] * u[1] + J[3] * u[2],
        J[1] * u[0] + J[2] * u[1] + J[4] * u[2],
        J[3] * u[0] + J[4] * u[1] + J[5] * u[2],
    )


@compiled
def cos_sin(angle):
    """Return cosine and sine: Cody and Waite's reduction, fdlibm's polynomials, no branch."""
    n = (angle * 0.6366197723675814 + _ROUND) - _ROUND  # quarter turns
    r = ((angle - n * _HALF_PI[0]) - n * _HALF_PI[1]) - n * _HALF_PI[2]
    z = r * r
    sine = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
    sine = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * sine)
    sine = -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * sine)
    sine = r + r * z * sine
    cosine = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11
    cosine = 2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * cosine)
    cosine = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * cosine)
    cosine = (1.0 - 0.5 * z) + z * z * cosine
    quarter = n - 4.0 * ((n * 0.25 - 0.375 + _ROUND) - _ROUND)  # 0, 1, 2 or 3
    is_odd = (quarter == 1.0) | (quarter == 3.0)
    x, y = (sine, cosine) if is_odd else (cosine, sine)
    return (-x if (quarter == 1.0) | (quarter == 2.0) else x), (-y if quarter > 1.5 else y)


@compiled
def factor(work, n, H):
    """Write the lower Cholesky factor of the symmetric positive definite H, in place."""
    for j in range(n):
        for k in range(j):
            for i in range(j, n):
                for lane in range(width(work)):
                    x = get(work, H + j * n + k, lane) * get(work, H + i * n + k, lane)
                    put(work, H + i * n + j, lane, get(work, H + i * n + j, lane) - x)
        for lane in range(width(work)):
            put(work, H + j * n + j, lane, math.sqrt(get(work, H + j * n + j, lane)))
        for i in range(j + 1, n):
            for lane in range(width(work)):
                x = get(work, H + i * n + j, lane) / get(work, H + j * n + j, lane)
                put(work, H + i * n + j, lane, x)


@compiled
def solve(work, n, H, x):
    """Solve H y = x with the factor of H, in place."""
    for i in range(n):
        for k in range(i):
            for lane in range(width(work)):
                y = get(work, H + i * n + k, lane) * get(work, x + k, lane)
                put(work, x + i, lane, get(work, x + i, lane) - y)
        for lane in range(width(work)):
            y = get(work, x + i, lane) / get(work, H + i * n + i, lane)
            put(work, x + i, lane, y)
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for lane in range(width(work)):
                y = get(work, H + k * n + i, lane) * get(work, x + k, lane)
                put(work, x + i, lane, get(work, x + i, lane) - y)
        for lane in range(width(work)):
            y = get(work, x + i, lane) / get(work, H + i * n + i, lane)
            put(work, x + i, lane, y)
