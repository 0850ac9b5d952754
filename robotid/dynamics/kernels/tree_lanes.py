"""One compiled tree of bodies: placements, motions, inverse dynamics, mass matrix, derivatives.

Spatial vectors are pairs, of motion (linear, angular) and of force (force, moment), in the frame of
a body, in six adjacent entries of a work space. The entries of the world come first, then those of
each body, ``BODY`` entries each. ``FRAME`` entries of a body are its placement in its parent, its
velocity and its acceleration; the world's acceleration is the negative of gravity.

    V_i = X^-1 V + s v_i,    A_i = X^-1 A + s a_i + V_i x s v_i    from those of the parent.

With a displacement d q_i of joint i, a motion m in the frame of its body changes by m x s d q_i.

Common arguments of the kernels:

- work: The work space.
- tree: The bodies and their joints; see ``compiled.Tree``.
- own, up: First entries of a body and of its parent.
- joint: Constants of a joint; see ``compiled.joint_constants``.
- bodies: Ten inertial parameters of each joint's body, shape (n, 10).
- v, a: First entries of the speeds and accelerations of the joints.

References:
    Featherstone (2008), Rigid Body Dynamics Algorithms, chapters 2, 5 and 6.
"""

from robotid.dynamics.kernels.lanes import (
    add,
    compiled,
    cos_sin,
    cross,
    dot,
    get,
    get3,
    put,
    put3,
    scale,
    times,
)

_R, _P, VELOCITY, ACCELERATION, FRAME = 0, 9, 12, 18, 24
_F, _C, _TV, _TA, _TF, BODY = 24, 30, 40, 46, 52, 58  # of derivatives, T: changes


@compiled
def get6(work, at):
    """Return a spatial vector."""
    return get3(work, at), get3(work, at + 3)


@compiled
def put6(work, at, x):
    """Write a spatial vector."""
    put3(work, at, x[0])
    put3(work, at + 3, x[1])


@compiled
def gather(work, at, x):
    """Add to a spatial vector."""
    put6(work, at, joined(get6(work, at), x))


@compiled
def joined(x, y):
    """Return x + y."""
    return add(x[0], y[0]), add(x[1], y[1])


@compiled
def times6(s, x):
    """Return s x."""
    return scale(s, x[0]), scale(s, x[1])


@compiled
def along(x, f):
    """Return the power of a force along a motion."""
    return dot(x[0], f[0]) + dot(x[1], f[1])


@compiled
def motion_cross(x, y):
    """Return x x y, the derivative of the motion y fixed in a body with velocity x."""
    return add(cross(x[1], y[0]), cross(x[0], y[1])), cross(x[1], y[1])


@compiled
def _force_cross(x, f):
    """Return x x* f, the derivative of the force f fixed in a body with velocity x."""
    return cross(x[1], f[0]), add(cross(x[1], f[1]), cross(x[0], f[0]))


@compiled
def axis(joint):
    """Return the motion of a joint at the speed 1, in its body's frame."""
    return (joint[33], joint[34], joint[35]), (joint[36], joint[37], joint[38])


@compiled
def placement(work, own):
    """Return the columns of R, and p, of a body in its parent."""
    return (
        get3(work, own + _R), get3(work, own + _R + 3),
        get3(work, own + _R + 6), get3(work, own + _P),
    )  # fmt: skip


@compiled
def _into_child(T, x):
    """Return a motion from the parent's frame in the body's frame: X^-1 x."""
    X, Y, Z, p = T
    u, e = add(x[0], cross(x[1], p)), x[1]
    return (dot(X, u), dot(Y, u), dot(Z, u)), (dot(X, e), dot(Y, e), dot(Z, e))


@compiled
def turned(T, u):
    """Return R u."""
    X, Y, Z, _ = T
    return add(add(scale(u[0], X), scale(u[1], Y)), scale(u[2], Z))


@compiled
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


@compiled
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


@compiled
def carry(work, own, seen, to):
    """Write a motion from the parent's frame in the body's frame."""
    T = placement(work, own)
    put6(work, to, _into_child(T, get6(work, seen)))


@compiled
def pass_up(work, own, force, to):
    """Add a force on the body to one in its parent's frame."""
    T = placement(work, own)
    gather(work, to, _into_parent(T, get6(work, force)))


@compiled
def _momentum(body, x):
    """Return J x from ten inertial parameters: momentum of a velocity, force of an acceleration."""
    m, c = body[0], (body[1], body[2], body[3])
    J = body[4], body[5], body[6], body[7], body[8], body[9]
    return add(scale(m, x[0]), cross(x[1], c)), add(cross(c, x[0]), times(J, x[1]))


@compiled
def _force(work, own, body, to):
    """Write the force J A + V x* J V on a body."""
    V, A = get6(work, own + VELOCITY), get6(work, own + ACCELERATION)
    f = joined(_momentum(body, A), _force_cross(V, _momentum(body, V)))
    put6(work, to, f)


@compiled
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


@compiled
def _composite(work, own):
    """Return the ten parameters of the composite of a body and its descendants."""
    at = own + _C
    return (
        get(work, at), get(work, at + 1), get(work, at + 2),
        get(work, at + 3), get(work, at + 4), get(work, at + 5),
        get(work, at + 6), get(work, at + 7), get(work, at + 8),
        get(work, at + 9),
    )  # fmt: skip


@compiled
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


@compiled
def _change_motion(work, own, up, joint, v, is_first, is_speed):
    """Write the derivatives of a body's velocity and acceleration by a position or speed.

    It is that of its own joint if the body is the first one that changes.
    """
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


@compiled
def _change_force(work, own, body):
    """Write the derivative of a body's force from those of its velocity and acceleration."""
    V, TV = get6(work, own + VELOCITY), get6(work, own + _TV)
    f = _momentum(body, get6(work, own + _TA))
    f = joined(f, _force_cross(TV, _momentum(body, V)))
    f = joined(f, _force_cross(V, _momentum(body, TV)))
    put6(work, own + _TF, f)


@compiled
def _clear(work, at):
    """Write a spatial vector of 0."""
    for k in range(6):
        put(work, at + k, 0.0)


@compiled
def derivatives(work, tree, bodies, v, T):
    """Write the derivatives of the torques by positions and speeds, after inverse dynamics.

    T[i, k] = d tau_i / d q_k; n^2 entries further is d tau_i / d v_k.
    """
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


@compiled
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
