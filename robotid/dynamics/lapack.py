"""Rows folded into a triangular factor by LAPACK, in place.

dtpqrt computes the QR of [R; rows] without using the zeros of R. It is called through the address
of SciPy's own LAPACK, which copies nothing and releases the interpreter's lock; if that address is
not available, through SciPy's wrapper.
"""

import ctypes
from collections.abc import Callable
from functools import cache, cached_property

import numpy as np
import scipy.linalg.cython_lapack
import scipy.linalg.lapack

from robotid.base.typing import Array

_PANEL = 8  # columns eliminated at a time: measured fastest for 20 to 70 columns ...
_WIDE, _WIDE_PANEL = 200, 24  # ... and from so many columns on, which exceed a cache


class Triangle:
    """A triangular factor into which rows are folded.

    It is changed in place, unlike other objects of the package: it is the innermost loop.

    Attributes:
        R: Upper triangular factor of all rows so far, shape (c, c), column-major; read only.
    """

    def __init__(self, columns: int) -> None:
        """Initialise for rows of so many columns."""
        self.R = np.zeros((columns, columns), order="F")
        self._is_empty = True
        self._panel = _PANEL if columns < _WIDE else _WIDE_PANEL
        # 8 sizes of C's int: m, n, l, nb, lda, ldb, ldt, info; then T and work
        self._scratch = np.empty(4 + 2 * self._panel * columns)
        self._sizes = self._scratch[:4].view(np.intc)
        self._sizes[[4, 6]] = columns, self._panel

    def fold(self, rows: Array) -> None:
        """Replace R by the triangular factor of [R; rows].

        References:
            LAPACK Working Note 257; Golub, Van Loan (2013), Matrix Computations, section 6.5.3.

        rows (m, c).
        """
        self._fold(rows, 0, 0)

    def fold_triangle(self, other: Array, places: Array) -> None:
        """Replace R by the triangular factor of [R; other], without computing with its zeros.

        other (m, m), places (m,).
        """
        if len(places) == len(self.R):
            if self._is_empty:
                self.R[:], self._is_empty = other, False
            else:
                self._fold(other.copy(order="F"), 0, len(other))
            return
        first = int(places[0])
        rows = np.zeros((len(places), len(self.R) - first), order="F")
        rows[:, places - first] = other
        self._fold(rows, first, len(rows))

    def _fold(self, rows: Array, first: int, triangular: int) -> None:
        """Fold rows from a column on; the last ones of them are upper trapezoidal."""
        if len(rows) == 0:
            return
        self._is_empty = False
        call, width = _dtpqrt(), rows.shape[1]
        panel = min(self._panel, width)
        if call is None:
            corner = self.R[first:, first:]
            corner[:] = scipy.linalg.lapack.dtpqrt(triangular, panel, corner, rows)[0]
            return
        ldb = max(len(rows), rows.strides[1] // rows.itemsize)
        self._sizes[:4] = len(rows), width, triangular, panel
        self._sizes[5] = ldb
        addresses = self._addresses.copy()
        addresses[4] += first * (len(self.R) + 1) * self.R.itemsize
        addresses[6] = rows.ctypes.data
        call(*addresses)

    @cached_property
    def _addresses(self) -> list[int]:
        """Addresses of m, n, l, nb, A, lda, B, ldb, T, ldt, work and info."""
        R, sizes = self.R.ctypes.data, self._scratch.ctypes.data
        T, end = sizes + self._sizes.nbytes, sizes + self._scratch.nbytes
        m, n, pentagon, nb, lda, ldb, ldt, info = range(sizes, T, self._sizes.itemsize)
        return [m, n, pentagon, nb, R, lda, 0, ldb, T, ldt, (T + end) // 2, info]


@cache
def _dtpqrt() -> Callable[..., None] | None:
    """Return LAPACK's dtpqrt, or None if the integers of SciPy's LAPACK are not C's int."""
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
