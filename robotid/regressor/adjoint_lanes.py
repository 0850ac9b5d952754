"""The torque regressor along a motion, and its gradient, compiled by Numba; see ``adjoint``.

Imported only where the extra ``fast`` is installed and a motion is designed. It is ``adjoint``
step by step, body after body and pair after pair, with the instants in the innermost loop.
"""

import numpy as np

from robotid.regressor.lanes import add, compiled, cross, dot, scale

__all__ = ["gradient_along", "rows_along"]


@compiled
def _get(x, k, n):
    return x[0, k, n], x[1, k, n], x[2, k, n]


@compiled
def _put(x, k, n, u):
    x[0, k, n], x[1, k, n], x[2, k, n] = u


@compiled
def _gain(x, k, n, u):
    x[0, k, n] += u[0]
    x[1, k, n] += u[1]
    x[2, k, n] += u[2]


@compiled
def _out(R, i, n, u):
    """Return R_i u."""
    return (
        R[0, 0, i, n] * u[0] + R[0, 1, i, n] * u[1] + R[0, 2, i, n] * u[2],
        R[1, 0, i, n] * u[0] + R[1, 1, i, n] * u[1] + R[1, 2, i, n] * u[2],
        R[2, 0, i, n] * u[0] + R[2, 1, i, n] * u[1] + R[2, 2, i, n] * u[2],
    )


@compiled
def _into(R, i, n, u):
    """Return R_i^T u."""
    return (
        R[0, 0, i, n] * u[0] + R[1, 0, i, n] * u[1] + R[2, 0, i, n] * u[2],
        R[0, 1, i, n] * u[0] + R[1, 1, i, n] * u[1] + R[2, 1, i, n] * u[2],
        R[0, 2, i, n] * u[0] + R[1, 2, i, n] * u[1] + R[2, 2, i, n] * u[2],
    )


@compiled
def _symmetric(W, k, n, u):
    """Return M u of the weights of an inertia, xx, xy, yy, xz, yz, zz."""
    xx, xy, yy = W[k, 4, n], W[k, 5, n], W[k, 6, n]
    xz, yz, zz = W[k, 7, n], W[k, 8, n], W[k, 9, n]
    return (
        xx * u[0] + xy * u[1] + xz * u[2],
        xy * u[0] + yy * u[1] + yz * u[2],
        xz * u[0] + yz * u[1] + zz * u[2],
    )


@compiled
def _place(parent, i, joint, slides, q, R, p, screw):
    """Write where body i is, and its joint's screw; ``joint`` as of ``joint_constants``."""
    for n in range(q.shape[1]):
        cosine, sine = np.cos(q[i, n]), np.sin(q[i, n])
        at = _get3(joint, 27)
        at = add(at, scale(q[i, n], _get3(joint, 30)))
        for c in range(3):
            column = add(_get3(joint, 3 * c), scale(cosine, _get3(joint, 9 + 3 * c)))
            column = add(column, scale(sine, _get3(joint, 18 + 3 * c)))
            if parent >= 0:
                column = _out(R, parent, n, column)
            R[0, c, i, n], R[1, c, i, n], R[2, c, i, n] = column
        if parent >= 0:
            at = add(_get(p, parent, n), _out(R, parent, n, at))
        _put(p, i, n, at)
        if slides:
            _put(screw[0], i, n, _out(R, i, n, _get3(joint, 33)))
            _put(screw[1], i, n, (0.0, 0.0, 0.0))
        else:
            axis = _out(R, i, n, _get3(joint, 36))
            _put(screw[0], i, n, cross(at, axis))
            _put(screw[1], i, n, axis)


@compiled
def _get3(x, k):
    return x[k], x[k + 1], x[k + 2]


@compiled
def _move(parent, i, v, a, gravity, screw, velocity, acceleration):
    """Write velocity and acceleration of body i."""
    for n in range(v.shape[1]):
        linear, angular = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        d, dw = (-gravity[0], -gravity[1], -gravity[2]), (0.0, 0.0, 0.0)
        if parent >= 0:
            linear, angular = _get(velocity[0], parent, n), _get(velocity[1], parent, n)
            d, dw = _get(acceleration[0], parent, n), _get(acceleration[1], parent, n)
        s, e = _get(screw[0], i, n), _get(screw[1], i, n)
        linear, angular = add(linear, scale(v[i, n], s)), add(angular, scale(v[i, n], e))
        turned = add(cross(angular, s), cross(linear, e))
        d = add(d, add(scale(a[i, n], s), scale(v[i, n], turned)))
        dw = add(dw, add(scale(a[i, n], e), scale(v[i, n], cross(angular, e))))
        _put(velocity[0], i, n, linear)
        _put(velocity[1], i, n, angular)
        _put(acceleration[0], i, n, d)
        _put(acceleration[1], i, n, dw)


@compiled
def _see(R, p, to, i, what, k, out):
    """Write motions of the world as body i sees them: entry ``k`` of ``what`` to ``to``."""
    for n in range(p.shape[2]):
        linear, angular = _get(what[0], k, n), _get(what[1], k, n)
        linear = add(linear, cross(angular, _get(p, i, n)))
        _put(out[0], to, n, _into(R, i, n, linear))
        _put(out[1], to, n, _into(R, i, n, angular))


@compiled
def _row(k, i, own_velocity, own_acceleration, seen, rows):
    """Write the ten entries of pair k, whose body is i."""
    for n in range(rows.shape[2]):
        u, e = _get(seen[0], k, n), _get(seen[1], k, n)
        w, dw = _get(own_velocity[1], i, n), _get(own_acceleration[1], i, n)
        d = add(_get(own_acceleration[0], i, n), cross(w, _get(own_velocity[0], i, n)))
        f = cross(e, w)
        first = add(cross(u, dw), cross(d, e))
        first = add(first, add(scale(dot(w, u), w), scale(-dot(w, w), u)))
        rows[k, 0, n] = dot(u, d)
        rows[k, 1, n], rows[k, 2, n], rows[k, 3, n] = first
        rows[k, 4, n] = e[0] * dw[0] + f[0] * w[0]
        rows[k, 5, n] = e[0] * dw[1] + f[0] * w[1] + e[1] * dw[0] + f[1] * w[0]
        rows[k, 6, n] = e[1] * dw[1] + f[1] * w[1]
        rows[k, 7, n] = e[0] * dw[2] + f[0] * w[2] + e[2] * dw[0] + f[2] * w[0]
        rows[k, 8, n] = e[1] * dw[2] + f[1] * w[2] + e[2] * dw[1] + f[2] * w[1]
        rows[k, 9, n] = e[2] * dw[2] + f[2] * w[2]


@compiled
def rows_along(parents, joints, slides, gravity, pairs, q, v, a):
    """Return what ``RegressorState`` holds of a motion of N instants.

    Args:
        parents: Parent of each of m bodies, shape (m,), int; -1: the world.
        joints: As of ``joint_constants``, shape (m, 39).
        slides: Which joints slide, shape (m,), bool.
        gravity: Shape (3,) [m/s^2].
        pairs: Body, and joint that carries it, of each pair, shape (2, pairs), int.
        q: Angles or lengths, shape (m, N) [rad, m].
        v: Velocities, likewise.
        a: Accelerations, likewise.
    """
    m, N = q.shape
    size = pairs.shape[1]
    R, p = np.empty((3, 3, m, N)), np.empty((3, m, N))
    screw = np.empty((3, m, N)), np.empty((3, m, N))
    velocity = np.empty((3, m, N)), np.empty((3, m, N))
    acceleration = np.empty((3, m, N)), np.empty((3, m, N))
    own_velocity = np.empty((3, m, N)), np.empty((3, m, N))
    own_acceleration = np.empty((3, m, N)), np.empty((3, m, N))
    seen = np.empty((3, size, N)), np.empty((3, size, N))
    rows = np.empty((size, 10, N))
    for i in range(m):
        _place(parents[i], i, joints[i], slides[i], q, R, p, screw)
        _move(parents[i], i, v, a, gravity, screw, velocity, acceleration)
        _see(R, p, i, i, velocity, i, own_velocity)
        _see(R, p, i, i, acceleration, i, own_acceleration)
    for k in range(size):
        _see(R, p, k, pairs[0, k], screw, pairs[1, k], seen)
        _row(k, pairs[0, k], own_velocity, own_acceleration, seen, rows)
    return (
        R, p, screw, velocity, acceleration, own_velocity, own_acceleration, seen, rows
    )  # fmt: skip


@compiled
def _turn(y, g):
    """Return g^T (y x) as a force, y and g as (linear, angular)."""
    return cross(g[0], y[1]), add(cross(g[0], y[0]), cross(g[1], y[1]))


@compiled
def _pull_pair(k, i, j, weights, R, p, screw, own_velocity, own_acceleration, seen, work):
    """Add what the ten entries of pair k pull at body i and joint j."""
    for n in range(weights.shape[2]):
        u, e = _get(seen[0], k, n), _get(seen[1], k, n)
        w, dw = _get(own_velocity[1], i, n), _get(own_acceleration[1], i, n)
        d = add(_get(own_acceleration[0], i, n), cross(w, _get(own_velocity[0], i, n)))
        mass, h = weights[k, 0, n], (weights[k, 1, n], weights[k, 2, n], weights[k, 3, n])
        wh, wu, Mw = dot(w, h), dot(w, u), _symmetric(weights, k, n, w)
        to_u = add(add(scale(mass, d), cross(dw, h)), scale(wh, w))
        to_u = add(to_u, scale(-dot(w, w), h))
        to_e = add(add(cross(h, d), _symmetric(weights, k, n, dw)), cross(w, Mw))
        to_w = add(add(scale(wu, h), scale(wh, u)), scale(-2.0 * dot(h, u), w))
        to_w = add(to_w, add(cross(Mw, e), _symmetric(weights, k, n, cross(e, w))))
        _gain(work[0], i, n, add(scale(mass, u), cross(e, h)))
        _gain(work[1], i, n, add(cross(h, u), _symmetric(weights, k, n, e)))
        _gain(work[2], i, n, to_w)
        linear = _out(R, i, n, to_u)
        angular = add(_out(R, i, n, to_e), cross(_get(p, i, n), linear))
        turn = _turn((_get(screw[0], j, n), _get(screw[1], j, n)), (linear, angular))
        _gain(work[3], i, n, turn[0])
        _gain(work[4], i, n, turn[1])
        _gain(work[5], j, n, linear)
        _gain(work[6], j, n, angular)


@compiled
def _pull_body(i, R, p, velocity, acceleration, own_velocity, work):
    """Turn what is pulled at body i, seen by it, to what is at its motion in the world."""
    for n in range(p.shape[2]):
        to_d, to_dw, w = _get(work[0], i, n), _get(work[1], i, n), _get(own_velocity[1], i, n)
        to_w = add(_get(work[2], i, n), cross(_get(own_velocity[0], i, n), to_d))
        place = _get(p, i, n)
        linear = _out(R, i, n, to_d)
        by_a = linear, add(_out(R, i, n, to_dw), cross(place, linear))
        linear = _out(R, i, n, cross(to_d, w))
        by_v = linear, add(_out(R, i, n, to_w), cross(place, linear))
        one = _turn((_get(velocity[0], i, n), _get(velocity[1], i, n)), by_v)
        other = _turn((_get(acceleration[0], i, n), _get(acceleration[1], i, n)), by_a)
        _gain(work[3], i, n, add(one[0], other[0]))
        _gain(work[4], i, n, add(one[1], other[1]))
        _put(work[0], i, n, by_a[0])
        _put(work[1], i, n, by_a[1])
        _put(work[2], i, n, by_v[0])
        _put(work[7], i, n, by_v[1])


@compiled
def _pull_joint(i, parent, v, a, screw, velocity, work, out):
    """Write the gradient by joint i, whose body has gathered all behind it, and hand it on."""
    for n in range(v.shape[1]):
        s = _get(screw[0], i, n), _get(screw[1], i, n)
        V = _get(velocity[0], i, n), _get(velocity[1], i, n)
        S_A = _get(work[0], i, n), _get(work[1], i, n)
        c = add(cross(V[1], s[0]), cross(V[0], s[1])), cross(V[1], s[1])
        bent, back = _turn(V, S_A), _turn(s, S_A)
        S_V = (
            add(_get(work[2], i, n), scale(-v[i, n], back[0])),
            add(_get(work[7], i, n), scale(-v[i, n], back[1])),
        )
        by_s = (
            add(_get(work[5], i, n), add(scale(a[i, n], S_A[0]), scale(v[i, n], bent[0]))),
            add(_get(work[6], i, n), add(scale(a[i, n], S_A[1]), scale(v[i, n], bent[1]))),
        )
        by_s = (add(by_s[0], scale(v[i, n], S_V[0])), add(by_s[1], scale(v[i, n], S_V[1])))
        own = _turn(s, by_s)
        turn = (
            add(_get(work[3], i, n), scale(-1.0, own[0])),
            add(_get(work[4], i, n), scale(-1.0, own[1])),
        )
        out[0, i, n] = dot(s[0], turn[0]) + dot(s[1], turn[1])
        out[1, i, n] = dot(c[0], S_A[0]) + dot(c[1], S_A[1])
        out[1, i, n] += dot(s[0], S_V[0]) + dot(s[1], S_V[1])
        out[2, i, n] = dot(s[0], S_A[0]) + dot(s[1], S_A[1])
        if parent >= 0:
            _gain(work[0], parent, n, S_A[0])
            _gain(work[1], parent, n, S_A[1])
            _gain(work[2], parent, n, S_V[0])
            _gain(work[7], parent, n, S_V[1])
            _gain(work[3], parent, n, turn[0])
            _gain(work[4], parent, n, turn[1])


@compiled
def gradient_along(
    parents, pairs, v, a, R, p, screw, velocity, acceleration, own_velocity, own_acceleration,
    seen, weights,
):  # fmt: skip
    """Return the gradient of sum(weights * rows) by q, v and a, shape (3, m, N).

    Args:
        parents: As of ``rows_along``, as are pairs, v and a; what follows is what it returned.
        pairs: Body and joint of each pair.
        v: Velocities, shape (m, N).
        a: Accelerations.
        R: Rotations.
        p: Origins.
        screw: Screws of the joints.
        velocity: Of the bodies.
        acceleration: Likewise.
        own_velocity: In their own frames.
        own_acceleration: Likewise.
        seen: Screws as bodies see them.
        weights: What each entry counts, shape (pairs, 10, N).
    """
    m, N = v.shape
    work = np.zeros((8, 3, m, N))
    out = np.empty((3, m, N))
    for k in range(pairs.shape[1]):
        _pull_pair(
            k, pairs[0, k], pairs[1, k], weights, R, p, screw, own_velocity, own_acceleration,
            seen, work,
        )  # fmt: skip
    for i in range(m):
        _pull_body(i, R, p, velocity, acceleration, own_velocity, work)
    for i in range(m - 1, -1, -1):
        _pull_joint(i, parents[i], v, a, screw, velocity, work, out)
    return out
