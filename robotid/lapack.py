"""Rows folded into a triangular factor by LAPACK, in place.

dtpqrt keeps the triangle a triangle: the QR of [R; rows] without touching the zeros of R. It is
called through SciPy's own LAPACK by address, which copies nothing and frees the interpreter's lock;
where that address is not to be had, through SciPy's wrapper.
"""

import ctypes
from collections.abc import Callable
from functools import cache

import numpy as np
import scipy.linalg.cython_lapack
import scipy.linalg.lapack

from robotid._typing import Array

__all__ = ["fold"]

_PANEL = 8  # columns eliminated at a time: measured fastest for 20 to 70 columns


def fold(R: Array, rows: Array) -> None:
    """Replace R by the triangular factor of [R; rows].

    Both arguments are written to: they are work space, and this is the innermost loop.

    Args:
        R: Upper triangular factor, shape (c, c), column-major; overwritten.
        rows: Rows to fold in, shape (m, c), column-major with any distance between columns;
            destroyed.

    References:
        LAPACK Working Note 257; Golub, Van Loan (2013), Matrix Computations, section 6.5.3.
    """
    m, c = rows.shape
    if m == 0:
        return
    panel = min(_PANEL, c)
    call = _dtpqrt()
    if call is None:
        R[:] = scipy.linalg.lapack.dtpqrt(0, panel, R, rows)[0]
        return
    scratch = np.empty(2 * panel * c)
    address = scratch.ctypes.data
    # m, n, l, nb, lda, ldb, ldt, info
    sizes = np.array([m, c, 0, panel, c, max(m, rows.strides[1] // 8), panel, 0], dtype=np.intc)
    at, step = sizes.ctypes.data, sizes.itemsize
    call(
        at, at + step, at + 2 * step, at + 3 * step,
        R.ctypes.data, at + 4 * step, rows.ctypes.data, at + 5 * step,
        address, at + 6 * step, address + 8 * panel * c, at + 7 * step,
    )  # fmt: skip


@cache
def _dtpqrt() -> Callable[..., None] | None:
    """Return LAPACK's dtpqrt, or None where SciPy's LAPACK has other integers than C's int."""
    capsule = scipy.linalg.cython_lapack.__pyx_capi__.get("dtpqrt")
    if capsule is None:
        return None
    name_of, pointer_of = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    name_of.restype, name_of.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer_of.restype, pointer_of.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    signature = name_of(capsule)
    if signature is None or not signature.startswith(b"void (int *, int *, int *, int *,"):
        return None
    prototype = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 12)
    return prototype(pointer_of(capsule, signature))
