"""Roll-outs of a robot under the loops of its drives, with their sensitivities, in Numba.

Imported only where the extra ``fast`` is installed. ``LANES`` roll-outs go on at once, one in each
lane: windows of logs, which begin where the log was. All numbers of one quantity stand in
neighbouring places, so that the processor works on several lanes at a time.

One step solves for the speed u at the instant t + theta dt

    D (u - v) / (theta dt) + h(q', v) + f(q', u) = kp (r - q - theta dt u) + kd (w - u) + ff,

with D = M(q') + armature, q' = q + theta dt v, h the torque of gravity and speeds, f that of
friction and offset, r and w the commands as they are on average over the step; then
q += dt u and v += (u - v) / theta. Newton's method ends at rounding error, so that the
sensitivities, by the implicit function theorem, are those of the numbers that come out.

Torques of gravity and speeds so are exact to first order only. ``corrects`` solves each step once
more, with M and h at the middle q + theta dt u, u of the solution: exact to second order, but where
friction reverses within the step. Such roll-outs have no sensitivities.

Friction that a joint takes up over a way, x z, has z as a further state: over a step, at the speed
u, its equation is linear and solved exactly. What acts is the z of the instant t + theta dt.

A controller with a clock reads q, v and its commands at its ticks, and holds the torque that it
makes of them until the next. No step crosses a tick. The held torque has sensitivities of its own,
which change at ticks alone.
"""

import math

import numpy as np

from robotid.regressor.lanes import add, compiled, cos_sin, cross, dot, into_child, scale

__all__ = [
    "ARMATURE",
    "BRISTLES",
    "INERTIAL",
    "KD",
    "KP",
    "LANES",
    "LATE",
    "LIMIT",
    "LOAD",
    "SPEED",
    "START",
    "TERM",
    "ZERO",
    "average_command",
    "divide_rows",
    "roll_out",
    "work_size",
]

LANES = 8
THETA = 0.5  # of a step, where its forces act: exact to second order
_SIGN = 1e-5  # [rad/s or m/s]: the speed over which friction turns
_SLID = 0.1  # [s] for which drives are taken to have moved before a roll-out begins
_NEWTON = 60  # steps, of which three or four are usual
_CLOSE = 1e-12  # of the speed, relative to 1 + its size

# kinds of sensitivities
ARMATURE, KP, KD, LIMIT, TERM, LATE, ZERO, INERTIAL, START, SPEED = range(10)
LOAD = 9  # code of the term that multiplies the load of the gear
BRISTLES = 10  # code of terms that are taken up over a way

_R, _P, _W, _V, _DW, _A, _XV, _XA, _F, _C, _TV, _TA, _TF = (
    0, 9, 12, 15, 18, 21, 24, 30, 36, 42, 52, 58, 64,
)  # fmt: skip
_BODY = 70


def work_size(joints: int, columns: int, memories: int) -> int:
    """Return the number of entries of the work space.

    Args:
        joints: Number of joints.
        columns: Number of sensitivities.
        memories: Number of terms that are taken up over a way.
    """
    n = joints
    own = (n + 1) * _BODY + 4 * n * n + 16 * n + 3 * n * columns
    return LANES * (own + memories * (5 + columns))


@compiled
def _get(x, at, lane):
    return x[np.uintp(at * LANES + lane)]


@compiled
def _put(x, at, lane, value):
    x[np.uintp(at * LANES + lane)] = value


@compiled
def _get3(x, at, lane):
    return _get(x, at, lane), _get(x, at + 1, lane), _get(x, at + 2, lane)


@compiled
def _put3(x, at, lane, u):
    _put(x, at, lane, u[0])
    _put(x, at + 1, lane, u[1])
    _put(x, at + 2, lane, u[2])


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
def _place(work, own, joint, q, zero):
    """Write placement of a joint's body in its parent; q is where its coordinates stand."""
    A, B, C = joint[0:9], joint[9:18], joint[18:27]
    for lane in range(LANES):
        angle = _get(work, q, lane) + zero
        cosine, sine = cos_sin(angle)
        for k in range(9):
            _put(work, own + _R + k, lane, A[k] + B[k] * cosine + C[k] * sine)
        for k in range(3):
            _put(work, own + _P + k, lane, joint[27 + k] + joint[30 + k] * angle)


@compiled
def _move(work, own, up, joint, v, a):
    """Write velocity and acceleration of a body; v and a are where the joints' rates stand."""
    slide, turn = (joint[33], joint[34], joint[35]), (joint[36], joint[37], joint[38])
    for lane in range(LANES):
        X, Y = _get3(work, own + _R, lane), _get3(work, own + _R + 3, lane)
        Z, p = _get3(work, own + _R + 6, lane), _get3(work, own + _P, lane)
        w0, v0 = _get3(work, up + _W, lane), _get3(work, up + _V, lane)
        dw0, a0 = _get3(work, up + _DW, lane), _get3(work, up + _A, lane)
        rate, change = _get(work, v, lane), _get(work, a, lane)
        w1, v1 = into_child(X, Y, Z, w0), into_child(X, Y, Z, add(v0, cross(w0, p)))
        dw1, a1 = into_child(X, Y, Z, dw0), into_child(X, Y, Z, add(a0, cross(dw0, p)))
        sw, sv = scale(rate, turn), scale(rate, slide)
        w, v_ = add(w1, sw), add(v1, sv)
        _put3(work, own + _XV, lane, w1)
        _put3(work, own + _XV + 3, lane, v1)
        _put3(work, own + _XA, lane, dw1)
        _put3(work, own + _XA + 3, lane, a1)
        _put3(work, own + _W, lane, w)
        _put3(work, own + _V, lane, v_)
        _put3(work, own + _DW, lane, add(dw1, add(scale(change, turn), cross(w, sw))))
        bent = add(cross(w, sv), cross(v_, sw))
        _put3(work, own + _A, lane, add(a1, add(scale(change, slide), bent)))


@compiled
def _force(work, own, body, at):
    """Write the force J A + V x* J V on a body; body has its ten parameters."""
    m, c, J = body[0], (body[1], body[2], body[3]), body[4:10]
    for lane in range(LANES):
        w, v = _get3(work, own + _W, lane), _get3(work, own + _V, lane)
        dw, a = _get3(work, own + _DW, lane), _get3(work, own + _A, lane)
        f, n = _momentum(m, c, J, dw, a)
        lin, ang = _momentum(m, c, J, w, v)
        _put3(work, own + at, lane, add(f, cross(w, lin)))
        _put3(work, own + at + 3, lane, add(n, add(cross(w, ang), cross(v, lin))))


@compiled
def _pass_up(work, own, up, at):
    """Add a force of a body, seen from its parent, to the parent's."""
    for lane in range(LANES):
        X, Y = _get3(work, own + _R, lane), _get3(work, own + _R + 3, lane)
        Z, p = _get3(work, own + _R + 6, lane), _get3(work, own + _P, lane)
        f = _into_parent(X, Y, Z, _get3(work, own + at, lane))
        n = add(_into_parent(X, Y, Z, _get3(work, own + at + 3, lane)), cross(p, f))
        _put3(work, up + at, lane, add(_get3(work, up + at, lane), f))
        _put3(work, up + at + 3, lane, add(_get3(work, up + at + 3, lane), n))


@compiled
def _along(work, own, at, joint, lane):
    """Return the part of a body's force that its joint has to give."""
    slide, turn = (joint[33], joint[34], joint[35]), (joint[36], joint[37], joint[38])
    return dot(slide, _get3(work, own + at, lane)) + dot(turn, _get3(work, own + at + 3, lane))


@compiled
def _inverse_dynamics(work, parents, joints, bodies, v, a, tau):
    """Write the torques of the bodies for the placements, rates v and their changes a."""
    n = len(parents)
    for i in range(n):
        _move(work, (i + 1) * _BODY, (parents[i] + 1) * _BODY, joints[i], v + i, a + i)
        _force(work, (i + 1) * _BODY, bodies[i], _F)
    for i in range(n - 1, -1, -1):
        own = (i + 1) * _BODY
        for lane in range(LANES):
            _put(work, tau + i, lane, _along(work, own, _F, joints[i], lane))
        _pass_up(work, own, (parents[i] + 1) * _BODY, _F)


@compiled
def _mass_matrix(work, parents, joints, bodies, M):
    """Write the mass matrix by composite bodies (Featherstone 2008, table 6.2)."""
    n = len(parents)
    for i in range(n):
        for k in range(10):
            for lane in range(LANES):
                _put(work, (i + 1) * _BODY + _C + k, lane, bodies[i, k])
    for i in range(n - 1, -1, -1):
        own, up = (i + 1) * _BODY, (parents[i] + 1) * _BODY
        slide = (joints[i, 33], joints[i, 34], joints[i, 35])
        turn = (joints[i, 36], joints[i, 37], joints[i, 38])
        for lane in range(LANES):
            m, c = _get(work, own + _C, lane), _get3(work, own + _C + 1, lane)
            J = (
                _get(work, own + _C + 4, lane), _get(work, own + _C + 5, lane),
                _get(work, own + _C + 6, lane), _get(work, own + _C + 7, lane),
                _get(work, own + _C + 8, lane), _get(work, own + _C + 9, lane),
            )  # fmt: skip
            f, t = _momentum(m, c, J, turn, slide)
            _put3(work, own + _TF, lane, f)
            _put3(work, own + _TF + 3, lane, t)
            _put(work, M + i * n + i, lane, dot(slide, f) + dot(turn, t))
        j = i
        while parents[j] >= 0:
            below, at = (j + 1) * _BODY, (parents[j] + 1) * _BODY
            for lane in range(LANES):
                X, Y = _get3(work, below + _R, lane), _get3(work, below + _R + 3, lane)
                Z, p = _get3(work, below + _R + 6, lane), _get3(work, below + _P, lane)
                f = _into_parent(X, Y, Z, _get3(work, below + _TF, lane))
                t = _into_parent(X, Y, Z, _get3(work, below + _TF + 3, lane))
                _put3(work, at + _TF, lane, f)
                _put3(work, at + _TF + 3, lane, add(t, cross(p, f)))
            j = parents[j]
            for lane in range(LANES):
                value = _along(work, at, _TF, joints[j], lane)
                _put(work, M + i * n + j, lane, value)
                _put(work, M + j * n + i, lane, value)
        if parents[i] >= 0:
            _join_bodies(work, own, up)


@compiled
def _join_bodies(work, own, up):
    """Add a composite body, seen from its parent, to the parent's."""
    for lane in range(LANES):
        X, Y = _get3(work, own + _R, lane), _get3(work, own + _R + 3, lane)
        Z, p = _get3(work, own + _R + 6, lane), _get3(work, own + _P, lane)
        m = _get(work, own + _C, lane)
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
        _put(work, up + _C, lane, _get(work, up + _C, lane) + m)
        c0 = _get3(work, up + _C + 1, lane)
        _put3(work, up + _C + 1, lane, add(c0, add(c, scale(m, p))))
        first, second = _get3(work, up + _C + 4, lane), _get3(work, up + _C + 7, lane)
        xx = dot(u0, row0) + s - 2.0 * p[0] * c[0] - m * p[0] * p[0]
        xy = dot(u0, row1) - p[0] * c[1] - p[1] * c[0] - m * p[0] * p[1]
        yy = dot(u1, row1) + s - 2.0 * p[1] * c[1] - m * p[1] * p[1]
        xz = dot(u0, row2) - p[0] * c[2] - p[2] * c[0] - m * p[0] * p[2]
        yz = dot(u1, row2) - p[1] * c[2] - p[2] * c[1] - m * p[1] * p[2]
        zz = dot(u2, row2) + s - 2.0 * p[2] * c[2] - m * p[2] * p[2]
        _put3(work, up + _C + 4, lane, add(first, (xx, xy, yy)))
        _put3(work, up + _C + 7, lane, add(second, (xz, yz, zz)))


@compiled
def _seed(work, own, joint, v, is_speed):
    """Write how velocity and acceleration of a joint's body change with its position or speed."""
    slide, turn = (joint[33], joint[34], joint[35]), (joint[36], joint[37], joint[38])
    for lane in range(LANES):
        if is_speed:
            w, u = _get3(work, own + _W, lane), _get3(work, own + _V, lane)
            _put3(work, own + _TV, lane, turn)
            _put3(work, own + _TV + 3, lane, slide)
            _put3(work, own + _TA, lane, cross(w, turn))
            _put3(work, own + _TA + 3, lane, add(cross(w, slide), cross(u, turn)))
        else:
            rate = _get(work, v, lane)
            w, u = _get3(work, own + _XV, lane), _get3(work, own + _XV + 3, lane)
            dw, du = _get3(work, own + _XA, lane), _get3(work, own + _XA + 3, lane)
            tw, tv = cross(w, turn), add(cross(w, slide), cross(u, turn))
            ta = add(cross(dw, slide), cross(du, turn))
            bent = add(cross(tw, scale(rate, slide)), cross(tv, scale(rate, turn)))
            _put3(work, own + _TV, lane, tw)
            _put3(work, own + _TV + 3, lane, tv)
            _put3(work, own + _TA, lane, add(cross(dw, turn), cross(tw, scale(rate, turn))))
            _put3(work, own + _TA + 3, lane, add(ta, bent))


@compiled
def _carry(work, own, up, joint, v):
    """Write the same of a body below, from its parent's."""
    slide, turn = (joint[33], joint[34], joint[35]), (joint[36], joint[37], joint[38])
    for lane in range(LANES):
        X, Y = _get3(work, own + _R, lane), _get3(work, own + _R + 3, lane)
        Z, p = _get3(work, own + _R + 6, lane), _get3(work, own + _P, lane)
        w0, v0 = _get3(work, up + _TV, lane), _get3(work, up + _TV + 3, lane)
        dw0, a0 = _get3(work, up + _TA, lane), _get3(work, up + _TA + 3, lane)
        rate = _get(work, v, lane)
        w, u = into_child(X, Y, Z, w0), into_child(X, Y, Z, add(v0, cross(w0, p)))
        dw, a = into_child(X, Y, Z, dw0), into_child(X, Y, Z, add(a0, cross(dw0, p)))
        sw, sv = scale(rate, turn), scale(rate, slide)
        _put3(work, own + _TV, lane, w)
        _put3(work, own + _TV + 3, lane, u)
        _put3(work, own + _TA, lane, add(dw, cross(w, sw)))
        _put3(work, own + _TA + 3, lane, add(a, add(cross(w, sv), cross(u, sw))))


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
        _put3(work, own + _TF, lane, add(f, add(cross(tw, lin), cross(w, tlin))))
        n = add(n, add(cross(tw, ang), cross(w, tang)))
        _put3(work, own + _TF + 3, lane, add(n, add(cross(tv, lin), cross(v, tlin))))


@compiled
def _derivatives(work, parents, joints, bodies, is_below, v, T, is_speed):
    """Write the derivatives of the torques by positions or speeds, T[i, k] = d tau_i / d q_k."""
    n = len(parents)
    for k in range(n):
        for i in range(k, n):
            own = (i + 1) * _BODY
            if i == k:
                _seed(work, own, joints[k], v + k, is_speed)
            elif is_below[i, k]:
                _carry(work, own, (parents[i] + 1) * _BODY, joints[i], v + i)
            else:
                continue
            _force_change(work, own, bodies[i])
        for i in range(n):
            if not is_below[i, k]:
                for lane in range(LANES):
                    _put(work, T + i * n + k, lane, 0.0)
                if is_below[k, i]:
                    for e in range(6):
                        for lane in range(LANES):
                            _put(work, (i + 1) * _BODY + _TF + e, lane, 0.0)
        slide = (joints[k, 33], joints[k, 34], joints[k, 35])
        turn = (joints[k, 36], joints[k, 37], joints[k, 38])
        for i in range(n - 1, -1, -1):
            if not (is_below[i, k] or is_below[k, i]):
                continue
            own = (i + 1) * _BODY
            for lane in range(LANES):
                _put(work, T + i * n + k, lane, _along(work, own, _TF, joints[i], lane))
            if i == k and not is_speed:
                for lane in range(LANES):
                    f, t = _get3(work, own + _F, lane), _get3(work, own + _F + 3, lane)
                    tf = add(_get3(work, own + _TF, lane), cross(turn, f))
                    tt = add(cross(turn, t), cross(slide, f))
                    _put3(work, own + _TF, lane, tf)
                    _put3(work, own + _TF + 3, lane, add(_get3(work, own + _TF + 3, lane), tt))
            if parents[i] >= 0:
                _pass_up(work, own, (parents[i] + 1) * _BODY, _TF)


@compiled
def term(code, shape, q, u):
    """Return what a term's parameter multiplies, and its derivatives by speed and position."""
    x0, x1 = shape[0], shape[1]
    root = math.sqrt(u * u + _SIGN * _SIGN)
    s, s_u = u / root, _SIGN * _SIGN / (root * root * root)
    y, y_u, y_q = 1.0, 0.0, 0.0  # code 2: offset
    if code == LOAD or code == 1:  # coulomb, and what multiplies the load
        y, y_u = s, s_u
    elif code == 0:  # viscous
        y, y_u = u, 1.0
    elif code == 3:  # coulomb times a power of the position
        seen = min(max(q, shape[2]), shape[3])  # beyond what the fit has seen it stays as it is
        p = (seen - x1) ** (x0 - 1.0)
        y, y_u = s * p * (seen - x1), s_u * p * (seen - x1)
        y_q = s * x0 * p if seen == q else 0.0
    elif code == 4:  # stribeck, x0 the speed
        e = math.exp(-(root - _SIGN) / x0)
        y, y_u = s * e, (s_u - s * s / x0) * e
    elif code == 5:  # asymmetric
        y, y_u = root, s
    elif code == 6:  # cubic
        y, y_u = u * u * u, 3.0 * u * u
    elif code == 7:  # tanh, x0 the speed
        y = math.tanh(u / x0)
        y_u = (1.0 - y * y) / x0
    elif code == 8:  # a harmonic of order x0, from phase x1
        y, y_q = math.cos(x0 * q - x1), -x0 * math.sin(x0 * q - x1)
    elif code == BRISTLES:  # of their own state
        y = 0.0
    return y, y_u, y_q


@compiled
def taken_up(shape, before, u, span):
    """Return z after a time at the speed u, and its derivatives by u and by z before.

    dz/dt = (u - |u| z / g(u)) / s_0, g = 1 + c exp(-(u / w)^2); see ``drives.Bristles``.
    """
    w, extra = shape[1], shape[2] * math.exp(-((u / shape[1]) ** 2))
    g, g_u = 1.0 + extra, -2.0 * u / (w * w) * extra
    s = 1.0 if u > 0.0 or (u == 0.0 and before < 0.0) else -1.0  # at rest, of the stiffer side
    way = span / (shape[0] * g)
    kept = math.exp(-s * u * way)
    kept_u = -kept * s * way * (1.0 - u * g_u / g)
    z_u = s * g_u * (1.0 - kept) + (before - s * g) * kept_u
    return s * g + (before - s * g) * kept, z_u, kept


@compiled
def _factor(work, n, H):
    """Write the lower Cholesky factor of the symmetric positive definite H, in place."""
    for j in range(n):
        for k in range(j):
            for i in range(j, n):
                for lane in range(LANES):
                    x = _get(work, H + j * n + k, lane) * _get(work, H + i * n + k, lane)
                    _put(work, H + i * n + j, lane, _get(work, H + i * n + j, lane) - x)
        for lane in range(LANES):
            _put(work, H + j * n + j, lane, math.sqrt(_get(work, H + j * n + j, lane)))
        for i in range(j + 1, n):
            for lane in range(LANES):
                x = _get(work, H + i * n + j, lane) / _get(work, H + j * n + j, lane)
                _put(work, H + i * n + j, lane, x)


@compiled
def _solve(work, n, H, x, step):
    """Solve H y = x with the factor of H, in place; the entries of x are ``step`` apart."""
    for i in range(n):
        for k in range(i):
            for lane in range(LANES):
                y = _get(work, H + i * n + k, lane) * _get(work, x + k * step, lane)
                _put(work, x + i * step, lane, _get(work, x + i * step, lane) - y)
        for lane in range(LANES):
            y = _get(work, x + i * step, lane) / _get(work, H + i * n + i, lane)
            _put(work, x + i * step, lane, y)
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for lane in range(LANES):
                y = _get(work, H + k * n + i, lane) * _get(work, x + k * step, lane)
                _put(work, x + i * step, lane, _get(work, x + i * step, lane) - y)
        for lane in range(LANES):
            y = _get(work, x + i * step, lane) / _get(work, H + i * n + i, lane)
            _put(work, x + i * step, lane, y)


@compiled
def _balance(work, n, at, drives, terms, step, command):
    """Write the residual G of a step's equation for the speeds u, and its derivative H.

    Row i is divided by e = 1 + mu s(u) sign(tau), by which a gear that loses a share mu of its
    load multiplies the bodies' torque tau: so H stays symmetric.
    """
    q, v, u, middle, h, M, G, H, by_q, gains, load, loss, held, memory, grip = at
    codes, shapes, values, first = terms
    if memory >= 0:
        _hold_on(work, n, at, terms, step)
    for i in range(n):
        for lane in range(LANES):
            _put(work, load + i, lane, _get(work, h + i, lane))
        for j in range(n):
            for lane in range(LANES):
                m = _get(work, M + i * n + j, lane) / (THETA * step[lane])
                moved = _get(work, u + j, lane) - _get(work, v + j, lane)
                _put(work, load + i, lane, _get(work, load + i, lane) + m * moved)
                _put(work, H + i * n + j, lane, m)
        armature, kp, kd, limit = drives[i, 0], drives[i, 1], drives[i, 2], drives[i, 3]
        for lane in range(LANES):
            span, tau = THETA * step[lane], _get(work, load + i, lane)
            speed, angle = _get(work, u + i, lane), _get(work, middle + i, lane)
            f, f_u = _get(work, grip + i, lane), _get(work, grip + n + i, lane)
            f_q, e, e_u = 0.0, 1.0, 0.0
            for k in range(first[i], first[i + 1]):
                y, y_u, y_q = term(codes[k], shapes[k], angle, speed)
                if codes[k] == LOAD:
                    side = math.copysign(values[k], tau)
                    e += side * y
                    e_u += side * y_u
                else:
                    f += values[k] * y
                    f_u += values[k] * y_u
                    f_q += values[k] * y_q
            if held >= 0:  # what the joint does within a tick changes nothing
                torque, is_on = _get(work, held + i, lane), 0.0
            else:
                reach = command[i, 0, lane] - _get(work, q + i, lane) - span * speed
                torque = kp * reach + kd * (command[i, 2, lane] - speed) + command[i, 3, lane]
                is_free = abs(torque) < limit
                torque = torque if is_free else math.copysign(limit, torque)
                is_on = 1.0 if is_free else 0.0
            rest = armature * (speed - _get(work, v + i, lane)) / span + f - torque
            slope = armature / span + f_u + is_on * (kd + span * kp)
            _put(work, G + i, lane, tau + rest / e)
            own = _get(work, H + i * n + i, lane) + (slope + tau * e_u) / e
            _put(work, H + i * n + i, lane, own)
            _put(work, by_q + i, lane, f_q)
            _put(work, gains + i, lane, is_on)
            _put(work, loss + i, lane, e)


@compiled
def _hold_on(work, n, at, terms, step):
    """Write the friction of memories for the speeds u, and its derivative."""
    u, memory, grip = at[2], at[13], at[14]
    codes, shapes, values, first = terms
    for i in range(n):
        for lane in range(LANES):
            speed, f, f_u = _get(work, u + i, lane), 0.0, 0.0
            for k in range(first[i], first[i + 1]):
                if codes[k] == BRISTLES:
                    before = _get(work, memory + 5 * int(shapes[k, 3]), lane)
                    z, z_u, _ = taken_up(shapes[k], before, speed, THETA * step[lane])
                    f += values[k] * z
                    f_u += values[k] * z_u
            _put(work, grip + i, lane, f)
            _put(work, grip + n + i, lane, f_u)


@compiled
def _newton(work, n, at, drives, terms, step, command):
    """Find the speeds u of a step and leave the factor of H there; return whether it was found.

    Friction bends at speed 0, so a step that would pass it halts there.
    """
    u, G, H = at[2], at[6], at[7]
    is_found = False
    for k in range(_NEWTON):
        share = 1.0 if k < _NEWTON // 4 else 0.5  # friction of several joints may turn in a circle
        _balance(work, n, at, drives, terms, step, command)
        _factor(work, n, H)
        if is_found:
            return True
        _solve(work, n, H, G, 1)
        is_found = True
        for i in range(n):
            for lane in range(LANES):
                before = _get(work, u + i, lane)
                after = before - share * _get(work, G + i, lane)
                halts = after * before < 0.0
                after = 0.0 if halts else after
                if halts or not abs(after - before) <= _CLOSE * (1.0 + abs(after)):
                    is_found = False
                _put(work, u + i, lane, after)
    return False


@compiled
def _advance(work, n, at, step):
    """Advance positions and speeds over a step that is solved."""
    q, v, u = at[0], at[1], at[2]
    for i in range(n):
        for lane in range(LANES):
            speed, before = _get(work, u + i, lane), _get(work, v + i, lane)
            _put(work, q + i, lane, _get(work, q + i, lane) + step[lane] * speed)
            _put(work, v + i, lane, before + (speed - before) / THETA)


@compiled
def _centre(work, n, at, step, parents, joints, bodies, zeros, a):
    """Write M and h of the middle of the step, where the speeds of a solution lead to."""
    q, u, middle, h, M = at[0], at[2], at[3], at[4], at[5]
    for i in range(n):
        for lane in range(LANES):
            ahead = THETA * step[lane] * _get(work, u + i, lane)
            _put(work, middle + i, lane, _get(work, q + i, lane) + ahead)
        _place(work, (i + 1) * _BODY, joints[i], middle + i, zeros[i])
    _inverse_dynamics(work, parents, joints, bodies, u, a, h)
    _mass_matrix(work, parents, joints, bodies, M)


@compiled
def _propagate(work, n, at, sweeps, columns, drives, terms, step, command, parents, joints, works):
    """Advance the sensitivities S of q and v, shape (2n, P), over a step that is solved."""
    q, v, u, middle, h, M, G, H, by_q, gains, load, loss, held, memory, grip = at
    T_q, T_v, S, own, change, by_hold, by_memory = sweeps
    codes, shapes, values, first = terms
    P = len(columns)
    _combine(work, n, at, sweeps, drives, step)
    for p in range(P):
        kind, j, index = columns[p, 0], columns[p, 1], columns[p, 2]
        for i in range(n):
            for lane in range(LANES):
                _put(work, own + i, lane, 0.0)
        if kind == INERTIAL:
            _inertial_column(work, parents, joints, works, j, index, own)
        elif kind == ZERO:  # what position does but for gain and friction
            for i in range(n):
                for lane in range(LANES):
                    _put(work, own + i, lane, _get(work, T_q + i * n + j, lane))
            for lane in range(LANES):
                kp = _get(work, gains + j, lane) * drives[j, 1]
                x = (_get(work, by_q + j, lane) + kp) / _get(work, loss + j, lane)
                _put(work, own + j, lane, _get(work, own + j, lane) - x)
        else:
            kp, kd = drives[j, 1], drives[j, 2]
            for lane in range(LANES):
                span, speed = THETA * step[lane], _get(work, u + j, lane)
                is_on, x = _get(work, gains + j, lane), 0.0
                if kind == ARMATURE:
                    x = (speed - _get(work, v + j, lane)) / span
                elif kind == TERM and codes[index] == BRISTLES:
                    x = _get(work, memory + 5 * int(shapes[index, 3]) + 1, lane)
                elif kind == TERM:
                    x, _, _ = term(codes[index], shapes[index], _get(work, middle + j, lane), speed)
                    x *= abs(_get(work, load + j, lane)) if codes[index] == LOAD else 1.0
                elif held < 0:
                    reach = command[j, 0, lane] - _get(work, q + j, lane) - span * speed
                    slip = command[j, 2, lane] - speed
                    asked = kp * reach + kd * slip + command[j, 3, lane]
                    late = kp * command[j, 1, lane] + kd * command[j, 4, lane] + command[j, 5, lane]
                    x = -_by_loop(kind, is_on, reach, slip, late, asked)
                _put(work, own + j, lane, x / _get(work, loss + j, lane))
        if held >= 0:
            for i in range(n):
                for lane in range(LANES):
                    x = _get(work, by_hold + i * P + p, lane) / _get(work, loss + i, lane)
                    _put(work, own + i, lane, _get(work, own + i, lane) - x)
        if memory >= 0:
            _recall(work, n, at, sweeps, terms, p, P, False)
        _advance_column(work, n, at, sweeps, step, p, P)
        if memory >= 0:
            _recall(work, n, at, sweeps, terms, p, P, True)


@compiled
def _remember(work, n, at, terms, step):
    """Write z after a step, that which acts in it, and derivatives of both.

    These are of what acts by z before, of z after by the speed u, and by z before.
    """
    u, memory = at[2], at[13]
    codes, shapes, values, first = terms
    for i in range(n):
        for k in range(first[i], first[i + 1]):
            if codes[k] == BRISTLES:
                z = memory + 5 * int(shapes[k, 3])
                for lane in range(LANES):
                    speed, before = _get(work, u + i, lane), _get(work, z, lane)
                    acts, _, share = taken_up(shapes[k], before, speed, THETA * step[lane])
                    after, by_speed, kept = taken_up(shapes[k], before, speed, step[lane])
                    _put(work, z, lane, after)
                    _put(work, z + 1, lane, acts)
                    _put3(work, z + 2, lane, (share, by_speed, kept))


@compiled
def _slide(work, n, at, by_memory, columns, terms):
    """Write z where roll-outs begin, and how it changes with the speed v there.

    It is that of long sliding, but for joints that take longer than ``_SLID`` to go their way.
    """
    v, memory = at[1], at[13]
    codes, shapes, values, first = terms
    for i in range(n):
        for k in range(first[i], first[i + 1]):
            if codes[k] != BRISTLES:
                continue
            slot, P = int(shapes[k, 3]), len(columns)
            for lane in range(LANES):
                speed = _get(work, v + i, lane)
                extra = shapes[k, 2] * math.exp(-((speed / shapes[k, 1]) ** 2))
                slow = shapes[k, 0] / _SLID
                root = math.sqrt(speed * speed + slow * slow)
                _put(work, memory + 5 * slot, lane, speed / root * (1.0 + extra))
                by_speed = slow * slow / root**3 * (1.0 + extra)
                by_speed -= 2.0 * speed * speed / (root * shapes[k, 1] ** 2) * extra
                for p in range(P):
                    if columns[p, 0] == SPEED and columns[p, 1] == i:
                        _put(work, by_memory + slot * P + p, lane, by_speed)


@compiled
def _recall(work, n, at, sweeps, terms, p, P, is_after):
    """Add to one column what memories make of their past; after the step, advance theirs."""
    loss, memory = at[11], at[13]
    own, change, by_memory = sweeps[3], sweeps[4], sweeps[6]
    codes, shapes, values, first = terms
    for i in range(n):
        for k in range(first[i], first[i + 1]):
            if codes[k] != BRISTLES:
                continue
            slot = int(shapes[k, 3])
            z, Z = memory + 5 * slot, by_memory + slot * P + p
            for lane in range(LANES):
                x = _get(work, Z, lane)
                if is_after:
                    x *= _get(work, z + 4, lane)
                    _put(work, Z, lane, x + _get(work, z + 3, lane) * _get(work, change + i, lane))
                else:
                    x *= values[k] * _get(work, z + 2, lane) / _get(work, loss + i, lane)
                    _put(work, own + i, lane, _get(work, own + i, lane) + x)


@compiled
def _by_loop(kind, is_on, reach, slip, late, asked):
    """Return how the torque of a loop changes with a gain, its delay or its limit."""
    if kind == KP:
        return is_on * reach
    if kind == KD:
        return is_on * slip
    if kind == LATE:
        return is_on * late
    return (1.0 - is_on) * math.copysign(1.0, asked) if kind == LIMIT else 0.0


@compiled
def _hold(work, n, at, sweeps, columns, drives, command, is_tick):
    """Write torques, and their sensitivities, of the lanes whose controllers have a tick."""
    q, v, held = at[0], at[1], at[12]
    S, by_hold, P = sweeps[2], sweeps[5], len(columns)
    for i in range(n):
        kp, kd, limit = drives[i, 1], drives[i, 2], drives[i, 3]
        for lane in range(LANES):
            if not is_tick[lane]:
                continue
            reach = command[i, 0, lane] - _get(work, q + i, lane)
            slip = command[i, 2, lane] - _get(work, v + i, lane)
            asked = kp * reach + kd * slip + command[i, 3, lane]
            late = kp * command[i, 1, lane] + kd * command[i, 4, lane] + command[i, 5, lane]
            is_on = 1.0 if abs(asked) < limit else 0.0
            _put(work, held + i, lane, asked if is_on else math.copysign(limit, asked))
            for p in range(P):
                x = kp * _get(work, S + i * P + p, lane) + kd * _get(
                    work, S + (n + i) * P + p, lane
                )
                own = 0.0
                if columns[p, 1] == i:
                    own = _by_loop(columns[p, 0], is_on, reach, slip, late, asked)
                _put(work, by_hold + i * P + p, lane, own - is_on * x)


@compiled
def _inertial_column(work, parents, joints, works, body, index, own):
    """Write the torques of a change of a body's ten parameters."""
    _force(work, (body + 1) * _BODY, works[index], _TF)
    i = body
    while i >= 0:
        at, up = (i + 1) * _BODY, (parents[i] + 1) * _BODY
        for lane in range(LANES):
            _put(work, own + i, lane, _along(work, at, _TF, joints[i], lane))
        if parents[i] >= 0:
            for e in range(6):
                for lane in range(LANES):
                    _put(work, up + _TF + e, lane, 0.0)
            _pass_up(work, at, up, _TF)
        i = parents[i]


@compiled
def _combine(work, n, at, sweeps, drives, step):
    """Write what a step's equation is by position and speed before it, into T_q and T_v.

    H du = T_v dv - T_q dq - own, each row divided by its e.
    """
    M, by_q, gains, loss = at[5], at[8], at[9], at[11]
    T_q, T_v = sweeps[0], sweeps[1]
    for i in range(n):
        for j in range(n):
            for lane in range(LANES):
                span = THETA * step[lane]
                bent = _get(work, T_q + i * n + j, lane)
                m = _get(work, M + i * n + j, lane) / span
                value = m - span * bent - _get(work, T_v + i * n + j, lane)
                _put(work, T_v + i * n + j, lane, value)
        armature, kp, d = drives[i, 0], drives[i, 1], i * n + i
        for lane in range(LANES):
            span, e = THETA * step[lane], _get(work, loss + i, lane)
            bent = _get(work, by_q + i, lane)
            by_speed = (armature / span - span * bent) / e
            by_position = (bent + _get(work, gains + i, lane) * kp) / e
            _put(work, T_v + d, lane, _get(work, T_v + d, lane) + by_speed)
            _put(work, T_q + d, lane, _get(work, T_q + d, lane) + by_position)


@compiled
def _advance_column(work, n, at, sweeps, step, p, P):
    """Advance one sensitivity of position and speed over a step."""
    H = at[7]
    T_q, T_v, S, own, change = sweeps[:5]
    for i in range(n):
        for lane in range(LANES):
            _put(work, change + i, lane, -_get(work, own + i, lane))
        for j in range(n):
            for lane in range(LANES):
                x = _get(work, T_v + i * n + j, lane) * _get(work, S + (n + j) * P + p, lane)
                x -= _get(work, T_q + i * n + j, lane) * _get(work, S + j * P + p, lane)
                _put(work, change + i, lane, _get(work, change + i, lane) + x)
    _solve(work, n, H, change, 1)
    for i in range(n):
        for lane in range(LANES):
            du, dv = _get(work, change + i, lane), _get(work, S + (n + i) * P + p, lane)
            dq = _get(work, S + i * P + p, lane) + step[lane] * du
            _put(work, S + i * P + p, lane, dq)
            _put(work, S + (n + i) * P + p, lane, dv + (du - dv) / THETA)


@compiled
def _begin(work, n, at, sweeps, columns, terms, gravity, start, out_S):
    """Write where roll-outs begin, and how that changes with itself."""
    q, v, u, S, P = at[0], at[1], at[2], sweeps[2], len(columns)
    for lane in range(LANES):
        for k in range(3):
            _put(work, _A + k, lane, -gravity[k])
        for i in range(n):
            _put(work, q + i, lane, start[0, i, lane])
            _put(work, v + i, lane, start[1, i, lane])
            _put(work, u + i, lane, start[1, i, lane])
        for p in range(P):
            if columns[p, 0] == START or columns[p, 0] == SPEED:
                row = columns[p, 1] + (n if columns[p, 0] == SPEED else 0)
                _put(work, S + row * P + p, lane, 1.0)
                if row < out_S.shape[1]:
                    out_S[0, row, p, lane] = 1.0
    if at[13] >= 0:
        _slide(work, n, at, sweeps[6], columns, terms)


@compiled
def roll_out(
    parents, joints, zeros, bodies, is_below, gravity, drives, codes, shapes, values, first,
    columns, directions, command, steps, ticks, every, start, out_q, out_v, out_S, work, corrects,
):  # fmt: skip
    """Roll out a block of lanes; return the first step that had no solution, -1 if all had.

    Args:
        parents: Parent of each joint, shape (n,), int; -1: the world.
        joints: Constants of each joint, as of ``regressor.compiled``, shape (n, 41).
        zeros: Angle of the URDF where an encoder reads 0, shape (n,) [rad or m].
        bodies: Ten inertial parameters of each joint's body, shape (n, 10).
        is_below: Whether joint k carries body i, itself included, shape (n, n), bool, [i, k].
        gravity: Shape (3,) [m/s^2].
        drives: Armature, kp, kd and largest torque of each joint, shape (n, 4).
        codes: Kind of each term of friction, shape (T,), int.
        shapes: What shapes it, two numbers and the range of positions seen, shape (T, 4); way,
            speed and excess of a term that is taken up, and its number among those.
        values: Its parameter, shape (T,).
        first: Where the terms of a joint begin, shape (n + 1,), int.
        columns: Kind, joint and index of each sensitivity, shape (P, 3), int.
        directions: Changes of a body's parameters, shape (D, 10).
        command: Position, its derivative by the delay, speed, torque, and the derivatives of speed
            and torque by the delay, on average over each step, or those of its tick, shape
            (K, n, 6, LANES).
        steps: Length of each step, shape (K, LANES) [s].
        ticks: Where the controllers have a tick as the step begins, shape (K, LANES), bool, all at
            the first; of no entries if they have no clock.
        every: Steps from a sample to the next.
        start: Positions and speeds, shape (2, n, LANES).
        out_q: Positions of the samples, shape (N, n, LANES); written.
        out_v: Speeds, likewise; written.
        out_S: Sensitivities of position, shape (N, n, P, LANES), or of position and then of speed,
            shape (N, 2n, P, LANES); written.
        work: Work space of ``work_size``.
        corrects: Whether each step is solved once more, at its middle; without columns alone.
    """
    n, P = len(parents), len(columns)
    q = (n + 1) * _BODY
    v, u, middle, h, a = q + n, q + 2 * n, q + 3 * n, q + 4 * n, q + 5 * n
    G, by_q, gains, own, change = a + n, a + 2 * n, a + 3 * n, a + 4 * n, a + 5 * n
    load, loss, M = change + n, change + 2 * n, change + 3 * n
    H, T_q, T_v, S = M + n * n, M + 2 * n * n, M + 3 * n * n, M + 4 * n * n
    by_hold, held = S + 2 * n * P, S + 3 * n * P if len(ticks) else -1
    memories = (codes == BRISTLES).sum()
    grip = S + (3 * P + 1) * n
    memory, by_memory = grip + 2 * n if memories else -1, grip + 2 * n + 5 * memories
    at = (q, v, u, middle, h, M, G, H, by_q, gains, load, loss, held, memory, grip)
    sweeps = (T_q, T_v, S, own, change, by_hold, by_memory)
    terms = (codes, shapes, values, first)
    work[:] = 0.0
    _begin(work, n, at, sweeps, columns, terms, gravity, start, out_S)
    for k in range(len(steps)):
        step = steps[k]
        if held >= 0 and ticks[k].any():
            _hold(work, n, at, sweeps, columns, drives, command[k], ticks[k])
        for i in range(n):
            for lane in range(LANES):
                ahead = THETA * step[lane] * _get(work, v + i, lane)
                _put(work, middle + i, lane, _get(work, q + i, lane) + ahead)
                _put(work, a + i, lane, 0.0)
            _place(work, (i + 1) * _BODY, joints[i], middle + i, zeros[i])
        _inverse_dynamics(work, parents, joints, bodies, v, a, h)
        _mass_matrix(work, parents, joints, bodies, M)
        if not _newton(work, n, at, drives, terms, step, command[k]):
            return k
        if corrects:
            _centre(work, n, at, step, parents, joints, bodies, zeros, a)
            if not _newton(work, n, at, drives, terms, step, command[k]):
                return k
        if memory >= 0:
            _remember(work, n, at, terms, step)
        if P:
            for i in range(n):
                for lane in range(LANES):
                    moved = _get(work, u + i, lane) - _get(work, v + i, lane)
                    _put(work, a + i, lane, moved / (THETA * step[lane]))
            _inverse_dynamics(work, parents, joints, bodies, v, a, h)
            _derivatives(work, parents, joints, bodies, is_below, v, T_q, False)
            _derivatives(work, parents, joints, bodies, is_below, v, T_v, True)
            _propagate(
                work, n, at, sweeps, columns, drives, terms, step, command[k], parents, joints,
                directions,
            )  # fmt: skip
        _advance(work, n, at, step)
        if (k + 1) % every == 0:
            sample = (k + 1) // every
            for i in range(n):
                for lane in range(LANES):
                    out_q[sample, i, lane] = _get(work, q + i, lane)
                    out_v[sample, i, lane] = _get(work, v + i, lane)
            for i in range(out_S.shape[1]):
                for p in range(P):
                    for lane in range(LANES):
                        out_S[sample, i, p, lane] = _get(work, S + i * P + p, lane)
    return -1


@compiled
def average_command(stamps, values, times, delay, mean, change):
    """Write what a drive is told on average over each step, and how that changes with the delay.

    Args:
        stamps: When each value is sent, shape (N,) [s]; it holds until the next.
        values: Shape (N,).
        times: Where the steps begin and end, shape (K + 1,) [s].
        delay: How much later it acts [s].
        mean: Shape (K,); written.
        change: Derivative of the mean by the delay, shape (K,); written.
    """
    last, i = len(stamps) - 1, 0
    begin = times[0] - delay
    while i < last and stamps[i + 1] <= begin:
        i += 1
    for k in range(len(mean)):
        end, before, at, total = times[k + 1] - delay, values[i], begin, 0.0
        while i < last and stamps[i + 1] <= end:
            total += values[i] * (stamps[i + 1] - at) if stamps[i + 1] > at else 0.0
            at = max(at, stamps[i + 1])
            i += 1
        total += values[i] * (end - at)
        mean[k] = total / (end - begin)
        change[k] = (before - values[i]) / (end - begin)
        begin = end


@compiled
def divide_rows(stamps, ticks, times, is_tick):
    """Write where steps begin and end, as many from each row to the next, none across a tick.

    Ticks divide a row; the longest steps are halved, then cut in three and so on, until there are
    as many as in other rows.

    Args:
        stamps: Of the rows, shape (N,) [s].
        ticks: Those after the first row, ascending; one at a row is its stamp [s].
        times: Shape ((N - 1) every + 1,); written.
        is_tick: Whether a step begins at a tick, or is the first, shape ((N - 1) every,); written.
    """
    every, i = len(is_tick) // (len(stamps) - 1), 0
    edges, shares = np.empty(every + 1), np.empty(every, np.int64)
    is_tick[:], is_tick[0] = False, True
    for k in range(len(stamps) - 1):
        edges[0], count = stamps[k], 1
        while i < len(ticks) and ticks[i] < stamps[k + 1]:
            if ticks[i] > stamps[k]:
                edges[count] = ticks[i]
                count += 1
            else:
                is_tick[k * every] = True
            i += 1
        edges[count] = stamps[k + 1]
        shares[:count] = 1
        for _ in range(every - count):
            shares[np.argmax(np.diff(edges[: count + 1]) / shares[:count])] += 1
        at = k * every
        for j in range(count):
            is_tick[at] = is_tick[at] or j > 0
            for part in range(shares[j]):
                times[at] = edges[j] + (edges[j + 1] - edges[j]) * part / shares[j]
                at += 1
    times[-1] = stamps[-1]
