"""Rows of the regressor for several samples together, and their gradient, compiled by Numba.

Row j of body i is the component of its force along the axis (u, e) of joint j. In the frame of the
body, with its velocity (v, w), its acceleration (a, dw), that of its origin d = a + w x v minus
gravity, B = [dw]x + [w]x [w]x and N I = I dw + w x I w, it is

    s_j . f_i = u . (m d + B mc) + e . (mc x d + N I).

The gradient is computed backwards (reverse mode, by hand): ``pull``s are the adjoints of motions.
They are spatial forces and are transformed like these.
"""

import numpy as np

from robotid.dynamics.kernels.lanes import (
    LANES,
    add,
    compiled,
    cross,
    dot,
    get,
    get3,
    lane_of,
    put,
    put3,
    put_lane,
    scale,
    times,
    work_space,
    write,
)
from robotid.dynamics.kernels.tree_lanes import (
    ACCELERATION,
    FRAME,
    VELOCITY,
    along,
    axis,
    carry,
    gather,
    get6,
    joined,
    motion_cross,
    move,
    pass_up,
    place,
    placement,
    put6,
    times6,
    turned,
)

# entries of one body: q, v, a of its joint; quantities common to its rows; ten columns. They are
# not Python's int, for which Numba would compile a function once more for each value.
_MOTION, _D, _X, _Y, _Z, _DW, _WW, _COLUMNS, _WORLD = np.array([0, 3, 6, 9, 12, 15, 18, 21, 31])


def work_of(bodies, depth):
    """Return a new work space of rows, and of their gradient."""
    return work_space(int(_WORLD) + (bodies + 1) * (FRAME + 12 * depth + 12))


@compiled
def _load(work, tree, i, motion, first, last):
    """Write q, v, a of a joint from its coordinate; past the end, those of the last sample."""
    q, v, a, _ = motion
    leader, ratio, offset = tree.leaders[i], tree.joints[i, 39], tree.joints[i, 40]
    for lane in range(LANES):
        k = min(first + lane, last)
        put_lane(work, _MOTION, lane, ratio * q[k, leader] + offset)
        put_lane(work, _MOTION + 1, lane, ratio * v[k, leader])
        put_lane(work, _MOTION + 2, lane, ratio * a[k, leader])


@compiled
def _above(tree, i):
    """Return the number of rows that the parent of a body affects."""
    return tree.depths[tree.parents[i]] if tree.parents[i] >= 0 else 0


@compiled
def _follow(work, tree, i, size, motion, first, last):
    """Write placement, velocity, acceleration and axes of a body from those of its parent."""
    own, up = _WORLD + (i + 1) * size, _WORLD + (tree.parents[i] + 1) * size
    if tree.slots[i] < 0:  # the floating base: its state is given, its axes are fixed
        for k in range(12):
            for lane in range(LANES):
                put_lane(work, own + VELOCITY + k, lane, motion[3][k, min(first + lane, last)])
        for k in range(36):
            put(work, own + FRAME + k, 1.0 if k % 7 == 0 else 0.0)
        return
    joint, above = tree.joints[i], _above(tree, i)
    _load(work, tree, i, motion, first, last)
    place(work, own, joint, _MOTION, 0.0)
    move(work, own, up, joint, _MOTION + 1, _MOTION + 2)
    for row in range(above):
        carry(work, own, up + FRAME + 6 * row, own + FRAME + 6 * row)
    s, to = times6(joint[39], axis(joint)), own + FRAME + 6 * tree.slots[i]
    if tree.slots[i] < above:  # a coordinate that also moves the parent
        gather(work, to, s)
    else:
        put6(work, to, s)


@compiled
def _share(work, own):
    """Write d, B by columns, dw and the products of w, common to all rows of a body."""
    v, w = get6(work, own + VELOCITY)
    a, dw = get6(work, own + ACCELERATION)
    xx, yy, zz = w[0] * w[0], w[1] * w[1], w[2] * w[2]
    xy, xz, yz = w[0] * w[1], w[0] * w[2], w[1] * w[2]
    put3(work, _D, add(a, cross(w, v)))
    put3(work, _X, (-(yy + zz), xy + dw[2], xz - dw[1]))
    put3(work, _Y, (xy - dw[2], -(xx + zz), yz + dw[0]))
    put3(work, _Z, (xz + dw[1], yz - dw[0], -(xx + yy)))
    put3(work, _DW, dw)
    put3(work, _WW, (xy, xz, yz))


@compiled
def _row(work, at):
    """Write the ten columns of one body in one row: m, mc, and I as xx xy yy xz yz zz."""
    u, e = get6(work, at)
    d, dw = get3(work, _D), get3(work, _DW)
    X, Y, Z = get3(work, _X), get3(work, _Y), get3(work, _Z)
    xy, xz, yz = get3(work, _WW)
    put(work, _COLUMNS, dot(u, d))
    put3(work, _COLUMNS + 1, add((dot(X, u), dot(Y, u), dot(Z, u)), cross(d, e)))
    put(work, _COLUMNS + 4, e[0] * dw[0] + e[1] * xz - e[2] * xy)
    put(work, _COLUMNS + 5, -e[0] * X[2] + e[1] * Y[2] + e[2] * (X[0] - Y[1]))
    put(work, _COLUMNS + 6, -e[0] * yz + e[1] * dw[1] + e[2] * xy)
    put(work, _COLUMNS + 7, e[0] * X[1] + e[1] * (Z[2] - X[0]) - e[2] * Z[1])
    put(work, _COLUMNS + 8, e[0] * (Y[1] - Z[2]) - e[1] * Y[0] + e[2] * Z[0])
    put(work, _COLUMNS + 9, e[0] * yz - e[1] * xz + e[2] * dw[2])


@compiled
def _write(work, out, places, start, stride):
    """Copy the wanted ones of the ten columns to their places in the block."""
    for k in range(10):
        if places[k] >= 0:
            write(out, places[k] * stride + start, get(work, _COLUMNS + k))


@compiled
def _begin(work, tree):
    """Write the acceleration of the world: the negative of gravity."""
    for k in range(3):
        put(work, _WORLD + ACCELERATION + k, -tree.gravity[k])


@compiled
def inertial_rows(tree, places, motion, work, out, span):
    """Write the inertial columns of a block of samples, row by row.

    places (B, D, 10), motion (N, n_rows), out (columns, k).
    """
    size, stride = FRAME + 6 * places.shape[1], out.shape[1]
    columns = out.reshape(out.size)
    _begin(work, tree)
    for start in range(span[0], span[1], LANES):
        for i in range(len(tree.parents)):
            own = _WORLD + (i + 1) * size
            _follow(work, tree, i, size, motion, start, span[1] - 1)
            _share(work, own)
            for row in range(tree.depths[i]):
                _row(work, own + FRAME + 6 * row)
                _write(work, columns, places[i, row], start - span[0], stride)


@compiled
def finish_rows(values, places, widths, weights, root, out, span):
    """Write drive columns and torques of a block, and scale its rows by their weights.

    values (E, N), places (E,), widths (n_rows,), weights (N, n_rows), root (k,), out (columns,
    k).
    """
    first, count = span[0], span[1] - span[0]
    for e in range(len(places)):
        for k in range(count):
            out[places[e], k] = values[e, first + k]
    end = 0
    for j in range(len(widths) if len(weights) else 0):
        head, end = end, end + widths[j]
        for k in range(count):
            root[k] = np.sqrt(weights[first + k, j])
        for column in range(head, end):
            for k in range(count):
                out[column, k] *= root[k]


@compiled
def _weigh(work, weights, places, first, last):
    """Write the weights of the ten columns of one body in one row."""
    for k in range(10):
        for lane in range(LANES):
            weight = weights[places[k], min(first + lane, last)] if places[k] >= 0 else 0.0
            put_lane(work, _COLUMNS + k, lane, weight)


@compiled
def _pull_row(work, own, at, pull, pulls):
    """Add the adjoints by the ten columns: of an axis, and of the body's motion."""
    u, e = get6(work, at)
    v, w = get6(work, own + VELOCITY)
    a, dw = get6(work, own + ACCELERATION)
    m, h = get(work, _COLUMNS), get3(work, _COLUMNS + 1)
    one, other = get3(work, _COLUMNS + 4), get3(work, _COLUMNS + 7)
    M = one[0], one[1], one[2], other[0], other[1], other[2]
    d, wh, Mw = add(a, cross(w, v)), dot(w, h), times(M, w)
    by_u = add(add(scale(m, d), cross(dw, h)), add(scale(wh, w), scale(-dot(w, w), h)))
    by_e = add(add(cross(h, d), times(M, dw)), cross(w, Mw))
    by_d, by_dw = add(scale(m, u), cross(e, h)), add(cross(h, u), times(M, e))
    by_w = add(add(scale(dot(w, u), h), scale(wh, u)), scale(-2.0 * dot(h, u), w))
    by_w = add(add(by_w, cross(v, by_d)), add(cross(Mw, e), times(M, cross(e, w))))
    put6(work, pull, joined(get6(work, pull), (by_u, by_e)))
    gather(work, pulls, (cross(by_d, w), by_w))
    gather(work, pulls + 6, (by_d, by_dw))


@compiled
def _pull_joint(work, own, joint, axes, pull, pulls, above):
    """Write the derivatives by q, v and a of a joint in their places, and update the adjoints.

    The updated adjoints are those of the parent's velocity and acceleration in the body's frame.
    """
    s = axis(joint)
    V, A = get6(work, own + VELOCITY), get6(work, own + ACCELERATION)
    by_V, by_A = get6(work, pulls), get6(work, pulls + 6)
    bent, rate = motion_cross(V, s), get(work, _MOTION + 1)
    by_q = along(bent, by_V) + along(motion_cross(A, s), by_A)
    put(work, _MOTION, by_q)
    put(work, _MOTION + 1, along(s, by_V) + along(bent, by_A))
    put(work, _MOTION + 2, along(s, by_A))
    back = cross(by_A[0], s[1]), add(cross(by_A[0], s[0]), cross(by_A[1], s[1]))
    put6(work, pulls, joined(by_V, times6(-rate, back)))
    for row in range(above):
        seen = motion_cross(get6(work, axes + 6 * row), s)
        by_q = along(seen, get6(work, pull + 6 * row))
        put(work, _MOTION, get(work, _MOTION) + by_q)


@compiled
def pull_rows(tree, places, motion, weights, work, out):
    """Write the gradient of sum(weights * rows) by q, v and a of a robot with a fixed base.

    places (B, D, 10), weights (columns, N), out (3, N, n_rows).
    """
    bodies, depth, N = len(tree.parents), places.shape[1], weights.shape[1]
    axes, pulls = FRAME + 6 * depth, FRAME + 12 * depth
    size = pulls + 12
    _begin(work, tree)
    for start in range(0, N, LANES):
        for i in range(bodies):
            own = _WORLD + (i + 1) * size
            _follow(work, tree, i, size, motion, start, N - 1)
            for k in range(axes, size):
                put(work, own + k, 0.0)
        for i in range(bodies - 1, -1, -1):
            own, up = _WORLD + (i + 1) * size, _WORLD + (tree.parents[i] + 1) * size
            above, ratio = _above(tree, i), tree.joints[i, 39]
            for row in range(tree.depths[i]):
                _weigh(work, weights, places[i, row], start, N - 1)
                _pull_row(work, own, own + FRAME + 6 * row, own + axes + 6 * row, own + pulls)
            _load(work, tree, i, motion, start, N - 1)
            _pull_joint(work, own, tree.joints[i], own + FRAME, own + axes, own + pulls, above)
            for k in range(3):
                change = ratio * get(work, _MOTION + k)
                for lane in range(min(LANES, N - start)):
                    out[k, start + lane, tree.leaders[i]] += lane_of(change, lane)
            for row in range(above):
                pass_up(work, own, own + axes + 6 * row, up + axes + 6 * row)
            pass_up(work, own, own + pulls, up + pulls)
            pass_up(work, own, own + pulls + 6, up + pulls + 6)


@compiled
def placements(tree, q, work, R, p):
    """Write the poses of bodies in the frame of the root link: R (3, 3, B, N), p (3, B, N)."""
    N, size = len(q), FRAME
    for start in range(0, N, LANES):
        for i in range(len(tree.parents)):
            own, up = _WORLD + (i + 1) * size, _WORLD + (tree.parents[i] + 1) * size
            _load(work, tree, i, (q, q, q, q), start, N - 1)
            place(work, own, tree.joints[i], _MOTION, 0.0)
            X, Y, Z, at = placement(work, own)
            if tree.parents[i] >= 0:
                T = placement(work, up + VELOCITY)
                X, Y, Z = turned(T, X), turned(T, Y), turned(T, Z)
                at = add(turned(T, at), T[3])
            put6(work, own + VELOCITY, (X, Y))  # the pose in the root link instead of the motion
            put6(work, own + ACCELERATION, (Z, at))
            for k in range(12):
                own_k = get(work, own + VELOCITY + k)
                for lane in range(min(LANES, N - start)):
                    if k < 9:
                        R[k % 3, k // 3, i, start + lane] = lane_of(own_k, lane)
                    else:
                        p[k - 9, i, start + lane] = lane_of(own_k, lane)
