"""One compiled tree of bodies: placements, inverse dynamics, mass matrix and their derivatives.

Imported only where the extra ``fast`` is installed. A work space holds ``LANES`` states of one
tree: all numbers of one quantity stand in neighbouring places, so that the processor works on
several states at a time. Entry ``at`` of a work space is one such quantity. The first ``BODY``
entries are the world's, those of body i begin at ``(i + 1) * BODY``.

Arguments that the kernels share:

- work: The work space, shape (entries * LANES,).
- parents: Parent of each joint, shape (n,), int; -1: the world.
- joints: Constants of each joint, as of ``compiled``, shape (n, 41).
- bodies: Ten inertial parameters of each joint's body, shape (n, 10).
- is_below: Whether joint k carries body i, itself included, shape (n, n), bool, [i, k].
"""

import math

import numpy as np

from robotid.regressor.lanes import add, compiled, cos_sin, cross, dot, into_child, scale

__all__ = [
    "BODY",
    "GRAVITY",
    "LANES",
    "derivatives",
    "factor",
    "get",
    "inertial_column",
    "inverse_dynamics",
    "mass_matrix",
    "place",
    "put",
    "put3",
    "solve",
]

LANES = 8
_R, _P, _W, _V, _DW, _A, _XV, _XA, _F, _C, _TV, _TA, _TF = (
    0, 9, 12, 15, 18, 21, 24, 30, 36, 42, 52, 58, 64,
)  # fmt: skip
BODY = 70
GRAVITY = _A  # where the negative of gravity stands, the acceleration of the world


@compiled
def get(x, at, lane):
    """Return a quantity of one lane."""
    return x[np.uintp(at * LANES + lane)]


@compiled
def put(x, at, lane, value):
    """Write a quantity of one lane."""
    x[np.uintp(at * LANES + lane)] = value


@compiled
def _get3(x, at, lane):
    return get(x, at, lane), get(x, at + 1, lane), get(x, at + 2, lane)


@compiled
def put3(x, at, lane, u):
    """Write three neighbouring quantities of one lane."""
    put(x, at, lane, u[0])
    put(x, at + 1, lane, u[1])
    put(x, at + 2, lane, u[2])


@compiled
def _into_parent(X, Y, Z, u):
    """Return R u; X, Y, Z are the columns of R."""
    return add(add(scale(u[0], X), scale(u[1], Y)), scale(u[2], Z))


@compiled
def _turn(J, u):
    """Return J u of a symmetric matrix xx xy yy xz yz zz."""
    return (
        J[0] * u[0] + J[1] * u[1] + J[3] * u[2],
        J[1] * u[0] + J[2] * u[1] + J[4] * u[2],
        J[3] * u[0] + J[4] * u[1] + J[5] * u[2],
    )


@compiled
def _momentum(m, c, J, w, v):
    """Return m v + w x mc and mc x v + J w: a body's momentum, or its force of an acceleration."""
    return add(scale(m, v), cross(w, c)), add(cross(c, v), _turn(J, w))


@compiled
def place(work, own, joint, q, zero):
    """Write placement of a joint's body in its parent; q is where its coordinates stand."""
    A, B, C = joint[0:9], joint[9:18], joint[18:27]
    for lane in range(LANES):
        angle = get(work, q, lane) + zero
        cosine, sine = cos_sin(angle)
        for k in range(9):
            put(work, own + _R + k, lane, A[k] + B[k] * cosine + C[k] * sine)
        for k in range(3):
            put(work, own + _P + k, lane, joint[27 + k] + joint[30 + k] * angle)


@compiled
def _move(work, own, up, joint, v, a):
    """Write velocity and acceleration of a body; v and a are where the joints' rates stand."""
    slide, turn = (joint[33], joint[34], joint[35]), (joint[36], joint[37], joint[38])
    for lane in range(LANES):
        X, Y = _get3(work, own + _R, lane), _get3(work, own + _R + 3, lane)
        Z, p = _get3(work, own + _R + 6, lane), _get3(work, own + _P, lane)
        w0, v0 = _get3(work, up + _W, lane), _get3(work, up + _V, lane)
        dw0, a0 = _get3(work, up + _DW, lane), _get3(work, up + _A, lane)
        rate, change = get(work, v, lane), get(work, a, lane)
        w1, v1 = into_child(X, Y, Z, w0), into_child(X, Y, Z, add(v0, cross(w0, p)))
        dw1, a1 = into_child(X, Y, Z, dw0), into_child(X, Y, Z, add(a0, cross(dw0, p)))
        sw, sv = scale(rate, turn), scale(rate, slide)
        w, v_ = add(w1, sw), add(v1, sv)
        put3(work, own + _XV, lane, w1)
        put3(work, own + _XV + 3, lane, v1)
        put3(work, own + _XA, lane, dw1)
        put3(work, own + _XA + 3, lane, a1)
        put3(work, own + _W, lane, w)
        put3(work, own + _V, lane, v_)
        put3(work, own + _DW, lane, add(dw1, add(scale(change, turn), cross(w, sw))))
        bent = add(cross(w, sv), cross(v_, sw))
        put3(work, own + _A, lane, add(a1, add(scale(change, slide), bent)))


@compiled
def _force(work, own, body, at):
    """Write the force J A + V x* J V on a body; body has its ten parameters."""
    m, c, J = body[0], (body[1], body[2], body[3]), body[4:10]
    for lane in range(LANES):
        w, v = _get3(work, own + _W, lane), _get3(work, own + _V, lane)
        dw, a = _get3(work, own + _DW, lane), _get3(work, own + _A, lane)
        f, n = _momentum(m, c, J, dw, a)
        lin, ang = _momentum(m, c, J, w, v)
        put3(work, own + at, lane, add(f, cross(w, lin)))
        put3(work, own + at + 3, lane, add(n, add(cross(w, ang), cross(v, lin))))


@compiled
def _pass_up(work, own, up, at):
    """Add a force of a body, seen from its parent, to the parent's."""
    for lane in range(LANES):
        X, Y = _get3(work, own + _R, lane), _get3(work, own + _R + 3, lane)
        Z, p = _get3(work, own + _R + 6, lane), _get3(work, own + _P, lane)
        f = _into_parent(X, Y, Z, _get3(work, own + at, lane))
        n = add(_into_parent(X, Y, Z, _get3(work, own + at + 3, lane)), cross(p, f))
        put3(work, up + at, lane, add(_get3(work, up + at, lane), f))
        put3(work, up + at + 3, lane, add(_get3(work, up + at + 3, lane), n))


@compiled
def _along(work, own, at, joint, lane):
    """Return the part of a body's force that its joint has to give."""
    slide, turn = (joint[33], joint[34], joint[35]), (joint[36], joint[37], joint[38])
    return dot(slide, _get3(work, own + at, lane)) + dot(turn, _get3(work, own + at + 3, lane))


@compiled
def inverse_dynamics(work, parents, joints, bodies, v, a, tau):
    """Write the torques of the bodies for the placements, rates v and their changes a."""
    n = len(parents)
    for i in range(n):
        _move(work, (i + 1) * BODY, (parents[i] + 1) * BODY, joints[i], v + i, a + i)
        _force(work, (i + 1) * BODY, bodies[i], _F)
    for i in range(n - 1, -1, -1):
        own = (i + 1) * BODY
        for lane in range(LANES):
            put(work, tau + i, lane, _along(work, own, _F, joints[i], lane))
        _pass_up(work, own, (parents[i] + 1) * BODY, _F)


@compiled
def mass_matrix(work, parents, joints, bodies, M):
    """Write the mass matrix by composite bodies (Featherstone 2008, table 6.2)."""
    n = len(parents)
    for i in range(n):
        for k in range(10):
            for lane in range(LANES):
                put(work, (i + 1) * BODY + _C + k, lane, bodies[i, k])
    for i in range(n - 1, -1, -1):
        own, up = (i + 1) * BODY, (parents[i] + 1) * BODY
        slide = (joints[i, 33], joints[i, 34], joints[i, 35])
        turn = (joints[i, 36], joints[i, 37], joints[i, 38])
        for lane in range(LANES):
            m, c = get(work, own + _C, lane), _get3(work, own + _C + 1, lane)
            J = (
                get(work, own + _C + 4, lane), get(work, own + _C + 5, lane),
                get(work, own + _C + 6, lane), get(work, own + _C + 7, lane),
                get(work, own + _C + 8, lane), get(work, own + _C + 9, lane),
            )  # fmt: skip
            f, t = _momentum(m, c, J, turn, slide)
            put3(work, own + _TF, lane, f)
            put3(work, own + _TF + 3, lane, t)
            put(work, M + i * n + i, lane, dot(slide, f) + dot(turn, t))
        j = i
        while parents[j] >= 0:
            below, at = (j + 1) * BODY, (parents[j] + 1) * BODY
            for lane in range(LANES):
                X, Y = _get3(work, below + _R, lane), _get3(work, below + _R + 3, lane)
                Z, p = _get3(work, below + _R + 6, lane), _get3(work, below + _P, lane)
                f = _into_parent(X, Y, Z, _get3(work, below + _TF, lane))
                t = _into_parent(X, Y, Z, _get3(work, below + _TF + 3, lane))
                put3(work, at + _TF, lane, f)
                put3(work, at + _TF + 3, lane, add(t, cross(p, f)))
            j = parents[j]
            for lane in range(LANES):
                value = _along(work, at, _TF, joints[j], lane)
                put(work, M + i * n + j, lane, value)
                put(work, M + j * n + i, lane, value)
        if parents[i] >= 0:
            _join_bodies(work, own, up)


@compiled
def _join_bodies(work, own, up):
    """Add a composite body, seen from its parent, to the parent's."""
    for lane in range(LANES):
        X, Y = _get3(work, own + _R, lane), _get3(work, own + _R + 3, lane)
        Z, p = _get3(work, own + _R + 6, lane), _get3(work, own + _P, lane)
        m = get(work, own + _C, lane)
        c = _into_parent(X, Y, Z, _get3(work, own + _C + 1, lane))
        I0, I1, I2 = _get3(work, own + _C + 4, lane)
        I3, I4, I5 = _get3(work, own + _C + 7, lane)
        # R J: its columns are R applied to the columns of J
        U = _into_parent(X, Y, Z, (I0, I1, I3))
        V = _into_parent(X, Y, Z, (I1, I2, I4))
        W = _into_parent(X, Y, Z, (I3, I4, I5))
        row0, row1, row2 = (X[0], Y[0], Z[0]), (X[1], Y[1], Z[1]), (X[2], Y[2], Z[2])
        u0, u1, u2 = (U[0], V[0], W[0]), (U[1], V[1], W[1]), (U[2], V[2], W[2])
        pc, pp = dot(p, c), dot(p, p)
        s = 2.0 * pc + m * pp
        put(work, up + _C, lane, get(work, up + _C, lane) + m)
        c0 = _get3(work, up + _C + 1, lane)
        put3(work, up + _C + 1, lane, add(c0, add(c, scale(m, p))))
        first, second = _get3(work, up + _C + 4, lane), _get3(work, up + _C + 7, lane)
        xx = dot(u0, row0) + s - 2.0 * p[0] * c[0] - m * p[0] * p[0]
        xy = dot(u0, row1) - p[0] * c[1] - p[1] * c[0] - m * p[0] * p[1]
        yy = dot(u1, row1) + s - 2.0 * p[1] * c[1] - m * p[1] * p[1]
        xz = dot(u0, row2) - p[0] * c[2] - p[2] * c[0] - m * p[0] * p[2]
        yz = dot(u1, row2) - p[1] * c[2] - p[2] * c[1] - m * p[1] * p[2]
        zz = dot(u2, row2) + s - 2.0 * p[2] * c[2] - m * p[2] * p[2]
        put3(work, up + _C + 4, lane, add(first, (xx, xy, yy)))
        put3(work, up + _C + 7, lane, add(second, (xz, yz, zz)))


@compiled
def _seed(work, own, joint, v, is_speed):
    """Write how velocity and acceleration of a joint's body change with its position or speed."""
    slide, turn = (joint[33], joint[34], joint[35]), (joint[36], joint[37], joint[38])
    for lane in range(LANES):
        if is_speed:
            w, u = _get3(work, own + _W, lane), _get3(work, own + _V, lane)
            put3(work, own + _TV, lane, turn)
            put3(work, own + _TV + 3, lane, slide)
            put3(work, own + _TA, lane, cross(w, turn))
            put3(work, own + _TA + 3, lane, add(cross(w, slide), cross(u, turn)))
        else:
            rate = get(work, v, lane)
            w, u = _get3(work, own + _XV, lane), _get3(work, own + _XV + 3, lane)
            dw, du = _get3(work, own + _XA, lane), _get3(work, own + _XA + 3, lane)
            tw, tv = cross(w, turn), add(cross(w, slide), cross(u, turn))
            ta = add(cross(dw, slide), cross(du, turn))
            bent = add(cross(tw, scale(rate, slide)), cross(tv, scale(rate, turn)))
            put3(work, own + _TV, lane, tw)
            put3(work, own + _TV + 3, lane, tv)
            put3(work, own + _TA, lane, add(cross(dw, turn), cross(tw, scale(rate, turn))))
            put3(work, own + _TA + 3, lane, add(ta, bent))


@compiled
def _carry(work, own, up, joint, v):
    """Write the same of a body below, from its parent's."""
    slide, turn = (joint[33], joint[34], joint[35]), (joint[36], joint[37], joint[38])
    for lane in range(LANES):
        X, Y = _get3(work, own + _R, lane), _get3(work, own + _R + 3, lane)
        Z, p = _get3(work, own + _R + 6, lane), _get3(work, own + _P, lane)
        w0, v0 = _get3(work, up + _TV, lane), _get3(work, up + _TV + 3, lane)
        dw0, a0 = _get3(work, up + _TA, lane), _get3(work, up + _TA + 3, lane)
        rate = get(work, v, lane)
        w, u = into_child(X, Y, Z, w0), into_child(X, Y, Z, add(v0, cross(w0, p)))
        dw, a = into_child(X, Y, Z, dw0), into_child(X, Y, Z, add(a0, cross(dw0, p)))
        sw, sv = scale(rate, turn), scale(rate, slide)
        put3(work, own + _TV, lane, w)
        put3(work, own + _TV + 3, lane, u)
        put3(work, own + _TA, lane, add(dw, cross(w, sw)))
        put3(work, own + _TA + 3, lane, add(a, add(cross(w, sv), cross(u, sw))))


@compiled
def _force_change(work, own, body):
    """Write how the force on a body changes, from the changes of velocity and acceleration."""
    m, c, J = body[0], (body[1], body[2], body[3]), body[4:10]
    for lane in range(LANES):
        w, v = _get3(work, own + _W, lane), _get3(work, own + _V, lane)
        tw, tv = _get3(work, own + _TV, lane), _get3(work, own + _TV + 3, lane)
        f, n = _momentum(m, c, J, _get3(work, own + _TA, lane), _get3(work, own + _TA + 3, lane))
        lin, ang = _momentum(m, c, J, w, v)
        tlin, tang = _momentum(m, c, J, tw, tv)
        put3(work, own + _TF, lane, add(f, add(cross(tw, lin), cross(w, tlin))))
        n = add(n, add(cross(tw, ang), cross(w, tang)))
        put3(work, own + _TF + 3, lane, add(n, add(cross(tv, lin), cross(v, tlin))))


@compiled
def derivatives(work, parents, joints, bodies, is_below, v, T, is_speed):
    """Write the derivatives of the torques by positions or speeds, T[i, k] = d tau_i / d q_k."""
    n = len(parents)
    for k in range(n):
        for i in range(k, n):
            own = (i + 1) * BODY
            if i == k:
                _seed(work, own, joints[k], v + k, is_speed)
            elif is_below[i, k]:
                _carry(work, own, (parents[i] + 1) * BODY, joints[i], v + i)
            else:
                continue
            _force_change(work, own, bodies[i])
        for i in range(n):
            if not is_below[i, k]:
                for lane in range(LANES):
                    put(work, T + i * n + k, lane, 0.0)
                if is_below[k, i]:
                    for e in range(6):
                        for lane in range(LANES):
                            put(work, (i + 1) * BODY + _TF + e, lane, 0.0)
        slide = (joints[k, 33], joints[k, 34], joints[k, 35])
        turn = (joints[k, 36], joints[k, 37], joints[k, 38])
        for i in range(n - 1, -1, -1):
            if not (is_below[i, k] or is_below[k, i]):
                continue
            own = (i + 1) * BODY
            for lane in range(LANES):
                put(work, T + i * n + k, lane, _along(work, own, _TF, joints[i], lane))
            if i == k and not is_speed:
                for lane in range(LANES):
                    f, t = _get3(work, own + _F, lane), _get3(work, own + _F + 3, lane)
                    tf = add(_get3(work, own + _TF, lane), cross(turn, f))
                    tt = add(cross(turn, t), cross(slide, f))
                    put3(work, own + _TF, lane, tf)
                    put3(work, own + _TF + 3, lane, add(_get3(work, own + _TF + 3, lane), tt))
            if parents[i] >= 0:
                _pass_up(work, own, (parents[i] + 1) * BODY, _TF)


@compiled
def inertial_column(work, parents, joints, works, body, index, own):
    """Write the torques of a change of a body's ten parameters."""
    _force(work, (body + 1) * BODY, works[index], _TF)
    i = body
    while i >= 0:
        at, up = (i + 1) * BODY, (parents[i] + 1) * BODY
        for lane in range(LANES):
            put(work, own + i, lane, _along(work, at, _TF, joints[i], lane))
        if parents[i] >= 0:
            for e in range(6):
                for lane in range(LANES):
                    put(work, up + _TF + e, lane, 0.0)
            _pass_up(work, at, up, _TF)
        i = parents[i]


@compiled
def factor(work, n, H):
    """Write the lower Cholesky factor of the symmetric positive definite H, in place."""
    for j in range(n):
        for k in range(j):
            for i in range(j, n):
                for lane in range(LANES):
                    x = get(work, H + j * n + k, lane) * get(work, H + i * n + k, lane)
                    put(work, H + i * n + j, lane, get(work, H + i * n + j, lane) - x)
        for lane in range(LANES):
            put(work, H + j * n + j, lane, math.sqrt(get(work, H + j * n + j, lane)))
        for i in range(j + 1, n):
            for lane in range(LANES):
                x = get(work, H + i * n + j, lane) / get(work, H + j * n + j, lane)
                put(work, H + i * n + j, lane, x)


@compiled
def solve(work, n, H, x, step):
    """Solve H y = x with the factor of H, in place; the entries of x are ``step`` apart."""
    for i in range(n):
        for k in range(i):
            for lane in range(LANES):
                y = get(work, H + i * n + k, lane) * get(work, x + k * step, lane)
                put(work, x + i * step, lane, get(work, x + i * step, lane) - y)
        for lane in range(LANES):
            y = get(work, x + i * step, lane) / get(work, H + i * n + i, lane)
            put(work, x + i * step, lane, y)
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for lane in range(LANES):
                y = get(work, H + k * n + i, lane) * get(work, x + k * step, lane)
                put(work, x + i * step, lane, get(work, x + i * step, lane) - y)
        for lane in range(LANES):
            y = get(work, x + i * step, lane) / get(work, H + i * n + i, lane)
            put(work, x + i * step, lane, y)
