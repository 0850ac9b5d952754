"""One compiled tree of bodies: motions, inverse dynamics, mass matrix, derivatives, regressor rows.

Spatial vectors are pairs, (linear, angular) and (force, moment), in the frame of a body, in six
adjacent entries of a work space: ``BODY`` entries of the world, then of each body. Its ``FRAME``
entries are its placement in its parent, velocity and acceleration; the world's is minus gravity.

    V_i = X^-1 V + s v_i,    A_i = X^-1 A + s a_i + V_i x s v_i    from those of the parent.

With a displacement d q_i of joint i, a motion m in the frame of its body changes by m x s d q_i.

Common arguments of the kernels:

- work: The work space.
- tree: The bodies and their joints; see ``rows.Tree``.
- own, up: First entries of a body and of its parent.
- joint: Constants of a joint; see ``rows.joint_constants``.
- bodies: Ten inertial parameters of each joint's body, shape (n, 10).
- v, a: First entries of the speeds and accelerations of the joints.

Row j of body i of the regressor is the component of its force along the axis (u, e) of joint j. In
the frame of the body, with its velocity (v, w), its acceleration (a, dw), that of its origin
d = a + w x v minus gravity, B = [dw]x + [w]x [w]x and N I = I dw + w x I w, it is

    s_j . f_i = u . (m d + B mc) + e . (mc x d + N I).

The gradient of rows is computed backwards (reverse mode, by hand): ``pull``s are the adjoints of
motions, spatial forces. See Featherstone (2008), Rigid Body Dynamics Algorithms, 2, 5 and 6.
"""

import numpy as np

from robotid.dynamics.kernels.lanes import (
    LANES,
    add,
    compiled,
    cos_sin,
    cross,
    dot,
    get,
    get3,
    inner,
    lane_of,
    put,
    put3,
    put_lane,
    scale,
    times,
    work_space,
    write,
)

_R, _P, VELOCITY, ACCELERATION, FRAME = 0, 9, 12, 18, 24
_F, _C, _TV, _TA, _TF, BODY = 24, 30, 40, 46, 52, 58  # of derivatives, T: changes


@inner
def get6(work, at):
    """Return a spatial vector."""
    return get3(work, at), get3(work, at + 3)


@inner
def put6(work, at, x):
    """Write a spatial vector."""
    put3(work, at, x[0])
    put3(work, at + 3, x[1])


@inner
def gather(work, at, x):
    """Add to a spatial vector."""
    put6(work, at, joined(get6(work, at), x))


@inner
def joined(x, y):
    """Return x + y."""
    return add(x[0], y[0]), add(x[1], y[1])


@inner
def times6(s, x):
    """Return s x."""
    return scale(s, x[0]), scale(s, x[1])


@inner
def along(x, f):
    """Return the power of a force along a motion."""
    return dot(x[0], f[0]) + dot(x[1], f[1])


@inner
def motion_cross(x, y):
    """Return x x y, the derivative of the motion y fixed in a body with velocity x."""
    return add(cross(x[1], y[0]), cross(x[0], y[1])), cross(x[1], y[1])


@inner
def _force_cross(x, f):
    """Return x x* f, the derivative of the force f fixed in a body with velocity x."""
    return cross(x[1], f[0]), add(cross(x[1], f[1]), cross(x[0], f[0]))


@inner
def axis(joint):
    """Return the motion of a joint at the speed 1, in its body's frame."""
    return (joint[33], joint[34], joint[35]), (joint[36], joint[37], joint[38])


@inner
def placement(work, own):
    """Return the columns of R, and p, of a body in its parent."""
    return (
        get3(work, own + _R), get3(work, own + _R + 3),
        get3(work, own + _R + 6), get3(work, own + _P),
    )  # fmt: skip


@inner
def _into_child(T, x):
    """Return a motion from the parent's frame in the body's frame: X^-1 x."""
    X, Y, Z, p = T
    u, e = add(x[0], cross(x[1], p)), x[1]
    return (dot(X, u), dot(Y, u), dot(Z, u)), (dot(X, e), dot(Y, e), dot(Z, e))


@inner
def turned(T, u):
    """Return R u."""
    X, Y, Z, _ = T
    return add(add(scale(u[0], X), scale(u[1], Y)), scale(u[2], Z))


@inner
def _into_parent(T, f):
    """Return a force from the body's frame in its parent's frame: X^-T f."""
    force = turned(T, f[0])
    return force, add(turned(T, f[1]), cross(T[3], force))


@compiled
def place(work, own, joint, q, zero):
    """Write R = A + B cos q + C sin q and p = p0 + d q of a body; q is the entry of coordinates."""
    angle = get(work, q) + zero
    c, s = cos_sin(angle)
    for k in range(9):
        put(work, own + _R + k, joint[k] + joint[9 + k] * c + joint[18 + k] * s)
    for k in range(3):
        put(work, own + _P + k, joint[27 + k] + joint[30 + k] * angle)


@inner
def move(work, own, up, joint, v, a):
    """Write velocity and acceleration of a body."""
    s = axis(joint)
    T = placement(work, own)
    moved = times6(get(work, v), s)
    V = joined(_into_child(T, get6(work, up + VELOCITY)), moved)
    changed = joined(times6(get(work, a), s), motion_cross(V, moved))
    put6(work, own + VELOCITY, V)
    A = joined(_into_child(T, get6(work, up + ACCELERATION)), changed)
    put6(work, own + ACCELERATION, A)


@inner
def carry(work, own, seen, to):
    """Write a motion from the parent's frame in the body's frame."""
    T = placement(work, own)
    put6(work, to, _into_child(T, get6(work, seen)))


@inner
def pass_up(work, own, force, to):
    """Add a force on the body to one in its parent's frame."""
    T = placement(work, own)
    gather(work, to, _into_parent(T, get6(work, force)))


@inner
def _momentum(body, x):
    """Return J x from ten inertial parameters: momentum of a velocity, force of an acceleration."""
    m, c = body[0], (body[1], body[2], body[3])
    J = body[4], body[5], body[6], body[7], body[8], body[9]
    return add(scale(m, x[0]), cross(x[1], c)), add(cross(c, x[0]), times(J, x[1]))


@inner
def _force(work, own, body, to):
    """Write the force J A + V x* J V on a body."""
    V, A = get6(work, own + VELOCITY), get6(work, own + ACCELERATION)
    f = joined(_momentum(body, A), _force_cross(V, _momentum(body, V)))
    put6(work, to, f)


@inner
def _give(work, force, joint, to):
    """Write the component of a body's force along its joint."""
    s = axis(joint)
    put(work, to, along(s, get6(work, force)))


@compiled
def inverse_dynamics(work, tree, bodies, v, a, tau):
    """Write the torques of the bodies from placements, speeds and accelerations."""
    n = len(tree.parents)
    for i in range(n):
        own, up = (i + 1) * BODY, (tree.parents[i] + 1) * BODY
        move(work, own, up, tree.joints[i], v + i, a + i)
        _force(work, own, bodies[i], own + _F)
    for i in range(n - 1, -1, -1):
        own, up = (i + 1) * BODY, (tree.parents[i] + 1) * BODY
        _give(work, own + _F, tree.joints[i], tau + i)
        pass_up(work, own, own + _F, up + _F)


@compiled
def mass_matrix(work, tree, bodies, M):
    """Write the mass matrix by composite bodies (Featherstone 2008, table 6.2)."""
    n, parents, joints = len(tree.parents), tree.parents, tree.joints
    for i in range(n):
        for k in range(10):
            put(work, (i + 1) * BODY + _C + k, bodies[i, k])
    for i in range(n - 1, -1, -1):
        own, s = (i + 1) * BODY, axis(joints[i])
        put6(work, own + _TF, _momentum(_composite(work, own), s))
        _give(work, own + _TF, joints[i], M + i * n + i)
        j = i
        while parents[j] >= 0:
            below, j = (j + 1) * BODY, parents[j]
            at = (j + 1) * BODY
            T = placement(work, below)
            put6(work, at + _TF, _into_parent(T, get6(work, below + _TF)))
            _give(work, at + _TF, joints[j], M + i * n + j)
            put(work, M + j * n + i, get(work, M + i * n + j))
        if parents[i] >= 0:
            _join_bodies(work, own, (parents[i] + 1) * BODY)


@inner
def _composite(work, own):
    """Return the ten parameters of the composite of a body and its descendants."""
    at = own + _C
    return (
        get(work, at), get(work, at + 1), get(work, at + 2),
        get(work, at + 3), get(work, at + 4), get(work, at + 5),
        get(work, at + 6), get(work, at + 7), get(work, at + 8),
        get(work, at + 9),
    )  # fmt: skip


@inner
def _join_bodies(work, own, up):
    """Add a composite body, in its parent's frame, to the parent's."""
    T = placement(work, own)
    p = T[3]
    m, c0, c1, c2, xx, xy, yy, xz, yz, zz = _composite(work, own)
    c = turned(T, (c0, c1, c2))
    # R J R^T: R times the columns of J, then R times the rows of the product
    U, V, W = turned(T, (xx, xy, xz)), turned(T, (xy, yy, yz)), turned(T, (xz, yz, zz))
    u = turned(T, (U[0], V[0], W[0]))
    v = turned(T, (U[1], V[1], W[1]))
    w = turned(T, (U[2], V[2], W[2]))
    s = 2.0 * dot(p, c) + m * dot(p, p)
    put(work, up + _C, get(work, up + _C) + m)
    moment = add(get3(work, up + _C + 1), add(c, scale(m, p)))
    put3(work, up + _C + 1, moment)
    xx = u[0] + s - 2.0 * p[0] * c[0] - m * p[0] * p[0]
    xy = u[1] - p[0] * c[1] - p[1] * c[0] - m * p[0] * p[1]
    yy = v[1] + s - 2.0 * p[1] * c[1] - m * p[1] * p[1]
    xz = u[2] - p[0] * c[2] - p[2] * c[0] - m * p[0] * p[2]
    yz = v[2] - p[1] * c[2] - p[2] * c[1] - m * p[1] * p[2]
    zz = w[2] + s - 2.0 * p[2] * c[2] - m * p[2] * p[2]
    put3(work, up + _C + 4, add(get3(work, up + _C + 4), (xx, xy, yy)))
    put3(work, up + _C + 7, add(get3(work, up + _C + 7), (xz, yz, zz)))


@inner
def _change_motion(work, own, up, joint, v, is_first, is_speed):
    """Write the derivatives of a body's motion by a position or speed, its own joint's if first."""
    s = axis(joint)
    V, A = get6(work, own + VELOCITY), get6(work, own + ACCELERATION)
    if is_first and is_speed:
        put6(work, own + _TV, s)
        put6(work, own + _TA, motion_cross(V, s))
    elif is_first:
        put6(work, own + _TV, motion_cross(V, s))
        put6(work, own + _TA, motion_cross(A, s))
    else:
        T = placement(work, own)
        TV = _into_child(T, get6(work, up + _TV))
        bent = motion_cross(TV, times6(get(work, v), s))
        put6(work, own + _TV, TV)
        put6(work, own + _TA, joined(_into_child(T, get6(work, up + _TA)), bent))


@inner
def _change_force(work, own, body):
    """Write the derivative of a body's force from those of its velocity and acceleration."""
    V, TV = get6(work, own + VELOCITY), get6(work, own + _TV)
    f = _momentum(body, get6(work, own + _TA))
    f = joined(f, _force_cross(TV, _momentum(body, V)))
    f = joined(f, _force_cross(V, _momentum(body, TV)))
    put6(work, own + _TF, f)


@inner
def _clear(work, at):
    """Write a spatial vector of 0."""
    for k in range(6):
        put(work, at + k, 0.0)


@compiled
def derivatives(work, tree, bodies, v, T):
    """Write T[i, k] = d tau_i / d q_k, then d tau_i / d v_k, after inverse dynamics."""
    n = len(tree.parents)
    for kind in range(2):
        for k in range(n):
            _change_bodies(work, tree, bodies, v, k, kind == 1)
            for i in range(n):
                if not (tree.is_below[i, k] or tree.is_below[k, i]):
                    put(work, T + (kind * n + i) * n + k, 0.0)
            for i in range(n - 1, -1, -1):
                if not (tree.is_below[i, k] or tree.is_below[k, i]):
                    continue
                own, up = (i + 1) * BODY, (tree.parents[i] + 1) * BODY
                _give(work, own + _TF, tree.joints[i], T + (kind * n + i) * n + k)
                if i == k and kind == 0:  # the force rotates with its frame
                    s = axis(tree.joints[k])
                    bent = _force_cross(s, get6(work, own + _F))
                    gather(work, own + _TF, bent)
                if tree.parents[i] >= 0:
                    pass_up(work, own, own + _TF, up + _TF)


@inner
def _change_bodies(work, tree, bodies, v, k, is_speed):
    """Write the derivatives of the bodies' forces by the position or speed of joint k."""
    for i in range(len(tree.parents)):
        own, up = (i + 1) * BODY, (tree.parents[i] + 1) * BODY
        if tree.is_below[i, k]:
            _change_motion(work, own, up, tree.joints[i], v + i, i == k, is_speed)
            _change_force(work, own, bodies[i])
        elif tree.is_below[k, i]:
            _clear(work, own + _TF)


@compiled
def inertial_column(work, tree, change, body, own):
    """Write the torques of a change of a body's ten parameters."""
    i = body
    _force(work, (i + 1) * BODY, change, (i + 1) * BODY + _TF)
    while i >= 0:
        at, up = (i + 1) * BODY, (tree.parents[i] + 1) * BODY
        _give(work, at + _TF, tree.joints[i], own + i)
        if tree.parents[i] >= 0:
            _clear(work, up + _TF)
            pass_up(work, at, at + _TF, up + _TF)
        i = tree.parents[i]


# --- rows of the regressor and their gradient -----------------------------------------------------

# entries of one body: q, v, a of its joint; quantities common to its rows; ten columns. They are
# not Python's int, for which Numba would compile a function once more for each value.
_MOTION, _D, _X, _Y, _Z, _DW, _WW, _COLUMNS, _WORLD = np.array([0, 3, 6, 9, 12, 15, 18, 21, 31])


def work_of(bodies, depth):
    """Return a new work space of rows, and of their gradient."""
    return work_space(int(_WORLD) + (bodies + 1) * (FRAME + 12 * depth + 12))


@inner
def _load(work, tree, i, motion, first, last):
    """Write q, v, a of a joint from its coordinate; past the end, those of the last sample."""
    q, v, a, _ = motion
    leader, ratio, offset = tree.leaders[i], tree.joints[i, 39], tree.joints[i, 40]
    for lane in range(LANES):
        k = min(first + lane, last)
        put_lane(work, _MOTION, lane, ratio * q[k, leader] + offset)
        put_lane(work, _MOTION + 1, lane, ratio * v[k, leader])
        put_lane(work, _MOTION + 2, lane, ratio * a[k, leader])


@inner
def _above(tree, i):
    """Return the number of rows that the parent of a body affects."""
    return tree.depths[tree.parents[i]] if tree.parents[i] >= 0 else 0


@inner
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


@inner
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


@inner
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


@inner
def _write(work, out, places, start, stride):
    """Copy the wanted ones of the ten columns to their places in the block."""
    for k in range(10):
        if places[k] >= 0:
            write(out, places[k] * stride + start, get(work, _COLUMNS + k))


@inner
def _begin(work, tree):
    """Write the acceleration of the world: the negative of gravity."""
    for k in range(3):
        put(work, _WORLD + ACCELERATION + k, -tree.gravity[k])


@compiled
def inertial_rows(tree, places, motion, work, out, span):
    """Write inertial columns row by row: places (B, D, 10), out (columns, k)."""
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
    """Write drive columns and torques of a block, and scale its rows by their weights."""
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


@inner
def _weigh(work, weights, places, first, last):
    """Write the weights of the ten columns of one body in one row."""
    for k in range(10):
        for lane in range(LANES):
            weight = weights[places[k], min(first + lane, last)] if places[k] >= 0 else 0.0
            put_lane(work, _COLUMNS + k, lane, weight)


@inner
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


@inner
def _pull_joint(work, own, joint, axes, pull, pulls, above):
    """Write the derivatives by q, v, a of a joint; the adjoints become those of its parent here."""
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
    """Write the gradient (3, N, n_rows) of sum(weights * rows) by q, v and a: a fixed base."""
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
