"""Inertial rows of the regressor for many samples at once, compiled by Numba.

Imported only where the extra ``fast`` is installed and a log is long enough. Numba keeps the
compiled code in the folder ``__pycache__`` beside this file or, where that is not writable, in its
own folder below the user's cache; the environment variable ``NUMBA_CACHE_DIR`` names another one.

All numbers of one quantity stand in ``LANES`` neighbouring places, one sample each, so that the
processor works on several samples at once. Row j of body i is

    s_j . f_i = v_j . (m d + B mc) + w_j . (mc x d + N I),

with the axis s_j = (v_j, w_j) of joint j seen from the frame of body i, d its linear acceleration
minus gravity, B = [dw]x + [w]x [w]x and N I = I dw + w x I w.
"""

from typing import Any

import numpy as np
from numba import njit

__all__ = [
    "LANES",
    "add",
    "compiled",
    "cos_sin",
    "cross",
    "dot",
    "finish_rows",
    "inertial_rows",
    "into_child",
    "scale",
    "state_size",
]

LANES = 64
_STATE = 12  # w, v, dw, a of a body
_SHARED = 9 + 3 + 18 + 10 + 5  # placement, what rows of a body share, ten columns, joint's motion
_MOTION = 40  # cos q, sin q, q, v, a of the joint
_HALF_PI = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_ROUND = 6755399441055744.0  # 1.5 2^52: adding and subtracting it rounds to the nearest integer


def state_size(bodies: int, depth: int) -> int:
    """Return the number of entries of the work space.

    Args:
        bodies: Number of bodies, the world included.
        depth: Largest number of rows that one body loads.
    """
    return LANES * (_SHARED + bodies * (_STATE + 6 * depth))


def compiled(function: Any) -> Any:
    """Compile without the interpreter's lock; contract: a b + c may be rounded once.

    Args:
        function: The function.
    """
    return njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")(function)


@compiled
def _get(x, at, k, lane):
    # an unsigned index spares Numba's look for negative ones, which would keep lanes apart
    return x[np.uintp(at + k * LANES + lane)]


@compiled
def _get3(x, at, k, lane):
    return _get(x, at, k, lane), _get(x, at, k + 1, lane), _get(x, at, k + 2, lane)


@compiled
def _put(x, at, k, lane, value):
    x[np.uintp(at + k * LANES + lane)] = value


@compiled
def _put3(x, at, k, lane, u):
    _put(x, at, k, lane, u[0])
    _put(x, at, k + 1, lane, u[1])
    _put(x, at, k + 2, lane, u[2])


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
def into_child(X, Y, Z, u):
    """Return R^T u; X, Y, Z are the columns of R."""
    return dot(X, u), dot(Y, u), dot(Z, u)


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
def _load(work, joint, q, v, a, leader, first, last):
    """Write cos q, sin q, q, v, a of a joint that follows a coordinate; past the end, the last."""
    ratio, offset = joint[39], joint[40]
    for lane in range(LANES):
        k = min(first + lane, last)
        _put(work, 0, _MOTION + 2, lane, ratio * q[k, leader] + offset)
        _put(work, 0, _MOTION + 3, lane, ratio * v[k, leader])
        _put(work, 0, _MOTION + 4, lane, ratio * a[k, leader])
    for lane in range(LANES):
        cosine, sine = cos_sin(_get(work, 0, _MOTION + 2, lane))
        _put(work, 0, _MOTION, lane, cosine)
        _put(work, 0, _MOTION + 1, lane, sine)


@compiled
def _place(work, joint):
    """Write R = A + B cos q + C sin q by columns and p = p0 + d q, the child in its parent."""
    A, B, C = joint[0:9], joint[9:18], joint[18:27]
    for k in range(9):
        a, b, c = A[k], B[k], C[k]
        for lane in range(LANES):
            cosine, sine = _get(work, 0, _MOTION, lane), _get(work, 0, _MOTION + 1, lane)
            _put(work, 0, k, lane, a + b * cosine + c * sine)
    for k in range(3):
        p, d = joint[27 + k], joint[30 + k]
        for lane in range(LANES):
            _put(work, 0, 9 + k, lane, p + d * _get(work, 0, _MOTION + 2, lane))


@compiled
def _move(work, joint, parent, own):
    """Write velocity and acceleration of a body from those of its parent."""
    axis_v, axis_w = (joint[33], joint[34], joint[35]), (joint[36], joint[37], joint[38])
    for lane in range(LANES):
        X, Y, Z = _get3(work, 0, 0, lane), _get3(work, 0, 3, lane), _get3(work, 0, 6, lane)
        p = _get3(work, 0, 9, lane)
        w0, v0 = _get3(work, parent, 0, lane), _get3(work, parent, 3, lane)
        dw0, a0 = _get3(work, parent, 6, lane), _get3(work, parent, 9, lane)
        rate, change = _get(work, 0, _MOTION + 3, lane), _get(work, 0, _MOTION + 4, lane)
        turn, slide = scale(rate, axis_w), scale(rate, axis_v)
        w = add(into_child(X, Y, Z, w0), turn)
        v = add(into_child(X, Y, Z, add(v0, cross(w0, p))), slide)
        dw = add(into_child(X, Y, Z, dw0), add(scale(change, axis_w), cross(w, turn)))
        a = add(into_child(X, Y, Z, add(a0, cross(dw0, p))), scale(change, axis_v))
        _put3(work, own, 0, lane, w)
        _put3(work, own, 3, lane, v)
        _put3(work, own, 6, lane, dw)
        _put3(work, own, 9, lane, add(a, add(cross(v, turn), cross(w, slide))))


@compiled
def _share(work, own):
    """Write d, B by columns, dw and the products of w, which all rows of a body share."""
    for lane in range(LANES):
        w, v = _get3(work, own, 0, lane), _get3(work, own, 3, lane)
        dw, a = _get3(work, own, 6, lane), _get3(work, own, 9, lane)
        xx, yy, zz = w[0] * w[0], w[1] * w[1], w[2] * w[2]
        xy, xz, yz = w[0] * w[1], w[0] * w[2], w[1] * w[2]
        _put3(work, 0, 12, lane, add(a, cross(w, v)))
        _put3(work, 0, 15, lane, (-(yy + zz), xy + dw[2], xz - dw[1]))
        _put3(work, 0, 18, lane, (xy - dw[2], -(xx + zz), yz + dw[0]))
        _put3(work, 0, 21, lane, (xz + dw[1], yz - dw[0], -(xx + yy)))
        _put3(work, 0, 24, lane, dw)
        _put3(work, 0, 27, lane, (xy, xz, yz))


@compiled
def _carry(work, parent, own):
    """Write an axis seen from the parent as seen from the child: v first, then w."""
    for lane in range(LANES):
        X, Y, Z = _get3(work, 0, 0, lane), _get3(work, 0, 3, lane), _get3(work, 0, 6, lane)
        p = _get3(work, 0, 9, lane)
        v, w = _get3(work, parent, 0, lane), _get3(work, parent, 3, lane)
        _put3(work, own, 0, lane, into_child(X, Y, Z, add(v, cross(w, p))))
        _put3(work, own, 3, lane, into_child(X, Y, Z, w))


@compiled
def _row(work, axis):
    """Write the ten columns of one body in one row: m, mc, and I as xx xy yy xz yz zz."""
    for lane in range(LANES):
        v, w = _get3(work, axis, 0, lane), _get3(work, axis, 3, lane)
        d = _get3(work, 0, 12, lane)
        X, Y, Z = _get3(work, 0, 15, lane), _get3(work, 0, 18, lane), _get3(work, 0, 21, lane)
        dw = _get3(work, 0, 24, lane)
        xy, xz, yz = _get3(work, 0, 27, lane)
        _put(work, 0, 30, lane, dot(v, d))
        _put3(work, 0, 31, lane, add(into_child(X, Y, Z, v), cross(d, w)))
        _put(work, 0, 34, lane, w[0] * dw[0] + w[1] * xz - w[2] * xy)
        _put(work, 0, 35, lane, -w[0] * X[2] + w[1] * Y[2] + w[2] * (X[0] - Y[1]))
        _put(work, 0, 36, lane, -w[0] * yz + w[1] * dw[1] + w[2] * xy)
        _put(work, 0, 37, lane, w[0] * X[1] + w[1] * (Z[2] - X[0]) - w[2] * Z[1])
        _put(work, 0, 38, lane, w[0] * (Y[1] - Z[2]) - w[1] * Y[0] + w[2] * Z[0])
        _put(work, 0, 39, lane, w[0] * yz - w[1] * xz + w[2] * dw[2])


@compiled
def _write(work, out, places, start, stride):
    """Copy those of the ten columns that are wanted to their places in the block."""
    for k in range(10):
        if places[k] >= 0:
            to = places[k] * stride + start
            for lane in range(LANES):
                out[np.uintp(to + lane)] = _get(work, 0, 30 + k, lane)


@compiled
def _join(work, at, joint):
    """Add the joint's own axis, times its ratio, to a row's axis."""
    for k in range(6):
        value = joint[39] * joint[33 + k]
        for lane in range(LANES):
            _put(work, at, k, lane, _get(work, at, k, lane) + value)


@compiled
def inertial_rows(parents, depths, slots, leaders, joints, places, q, v, a, base, work, out, span):
    """Write the inertial columns of a block of samples, row by row.

    Args:
        parents: Parent of each body, shape (B,), int; body 0 is the world.
        depths: Number of rows that each body loads, shape (B,), int.
        slots: Which of a body's rows its own joint belongs to, shape (B,), int; -1: floating base.
        leaders: Coordinate that moves each joint, shape (B,), int.
        joints: Constants of each joint, shape (B, 41).
        places: Column of ``out`` for each body, row and parameter, shape (B, D, 10), int; -1: none.
        q: Coordinates, shape (N, n_rows) [rad, m].
        v: Velocities, shape (N, n_rows) [rad/s, m/s].
        a: Accelerations, shape (N, n_rows) [rad/s^2, m/s^2].
        base: w, v, dw, a of the floating base, gravity taken off, shape (12, N).
        work: Work space, prepared with the world's acceleration and the joints' axes.
        out: The columns, shape (columns, k); k a multiple of ``LANES``; written.
        span: First sample, and the one after the last.
    """
    shared, depth = _SHARED * LANES, places.shape[1]
    size, stride = (_STATE + 6 * depth) * LANES, out.shape[1]
    columns = out.reshape(out.size)
    for start in range(span[0], span[1], LANES):
        for i in range(1, len(parents)):
            own, up = shared + i * size, shared + parents[i] * size
            axes, above = own + _STATE * LANES, up + _STATE * LANES
            if slots[i] < 0:  # the floating base: its state is given, its axes stand
                for k in range(_STATE):
                    for lane in range(LANES):
                        _put(work, own, k, lane, base[k, min(start + lane, span[1] - 1)])
            else:
                _load(work, joints[i], q, v, a, leaders[i], start, span[1] - 1)
                _place(work, joints[i])
                _move(work, joints[i], up, own)
                for row in range(depths[parents[i]]):
                    _carry(work, above + 6 * row * LANES, axes + 6 * row * LANES)
                if slots[i] < depths[parents[i]]:
                    _join(work, axes + 6 * slots[i] * LANES, joints[i])
            _share(work, own)
            for row in range(depths[i]):
                _row(work, axes + 6 * row * LANES)
                _write(work, columns, places[i, row], start - span[0], stride)


@compiled
def finish_rows(values, places, widths, weights, root, out, span):
    """Write drive columns and torques of a block, and weigh its rows.

    Args:
        values: Drive columns and torques, shape (E, N).
        places: Place of each, shape (E,), int.
        widths: Number of columns that each row has in ``out``, shape (n_rows,), int.
        weights: Weights, shape (N, n_rows), or (0, 0) if all are 1.
        root: Work space, shape (k,).
        out: The columns, shape (columns, k); written.
        span: First sample, and the one after the last.
    """
    first, count = span[0], span[1] - span[0]
    for e in range(len(places)):
        for k in range(count):
            out[places[e], k] = values[e, first + k]
    end = 0
    for j in range(len(widths) if len(weights) else 0):
        begin, end = end, end + widths[j]
        for k in range(count):
            root[k] = np.sqrt(weights[first + k, j])
        for column in range(begin, end):
            for k in range(count):
                out[column, k] *= root[k]
