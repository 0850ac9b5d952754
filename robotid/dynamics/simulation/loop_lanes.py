"""Closed-loop simulation of a robot with sensitivities, in Numba.

Imported only for closed-loop simulations. ``LANES`` windows of logs are simulated together, one in
each lane of the work space of ``tree_lanes``, each from the initial state of its window.

One step solves for the speed u at the instant t + theta dt

    D (u - v) / (theta dt) + h(q', v) + f(q', u) = kp (r - q - theta dt u) + kd (w - u) + ff,

with D = M(q') + armature, q' = q + theta dt v, h the torque of gravity and speeds, f that of
friction and offset, r and w the mean commands over the step; then q += dt u and
v += (u - v) / theta. Newton's method ends at rounding error, so that the sensitivities, by the
implicit function theorem, are those of the computed motion.

Torques of gravity and speeds are exact to first order. ``corrects`` solves each step a second time,
with M and h at the midpoint q + theta dt u of the first solution: exact to second order, except
where friction reverses within the step. Such roll-outs have no sensitivities.

Presliding friction x z has the bristle deflection z as a further state. Over a step, at the speed
u, its equation is linear and solved exactly. The torque is that of z at t + theta dt.

A discrete-time controller samples q, v and its commands at its ticks, and has a zero-order hold of
the torque. No step crosses a tick. The held torque has its own sensitivities, which change only at
ticks.
"""

from typing import NamedTuple

from robotid.base.typing import Array
from robotid.dynamics.kernels.lanes import compiled, factor, get, put, solve, work_space
from robotid.dynamics.kernels.tree_lanes import (
    ACCELERATION,
    BODY,
    derivatives,
    inertial_column,
    inverse_dynamics,
    mass_matrix,
    place,
)
from robotid.dynamics.kernels.vector_lanes import LANES, copysign, is_any, read, where, wide, write
from robotid.dynamics.simulation.bristle_lanes import (
    advance_bristles,
    bristle_column,
    initialise_bristles,
    presliding,
)
from robotid.dynamics.simulation.law_lanes import (
    affine_term,
    direction,
    loop_torque,
    term_by_lane,
)
from robotid.robot.drive_term import BRISTLES, LOADED

THETA = 0.5  # instant of the forces, relative to the step: exact to second order
_NEWTON = 60  # largest number of steps; three or four are typical
_CLOSE = 1e-12  # of the speed, relative to 1 + its size

# kinds of sensitivities
ARMATURE, KP, KD, LIMIT, TERM, DELAY, ZERO, INERTIAL, START, SPEED = range(10)


class Terms(NamedTuple):
    """Friction and offset of the joints: T terms, joint by joint.

    Attributes:
        codes: Codes of ``coded_term``, shape (T, 5), int; the third is the kind of the term.
        shapes: Shape parameters of laws, or of bristles with their index, shape (T, 11).
        values: Parameters, shape (T,).
        spans: Indices of each joint's first term, of its first term that is a bristle term or
            part of the drives' sums, and of the end, shape (n, 3), int.
    """

    codes: Array
    shapes: Array
    values: Array
    spans: Array


class Columns(NamedTuple):
    """Parameters of the sensitivities.

    Attributes:
        kinds: Kind, joint and index of each column, shape (C, 3), int.
        sums: Index of the first column of each of the P sensitivities, each the sum of its columns,
            and the number of columns, shape (P + 1,), int.
        directions: Directions in a body's ten parameters, shape (D, 10).
    """

    kinds: Array
    sums: Array
    directions: Array


class Course(NamedTuple):
    """Inputs of roll-outs.

    Attributes:
        command: Position, its derivative by the delay, speed, torque, and the derivatives of speed
            and torque by the delay: means over each step, or values of its tick, shape
            (K, n, 6, LANES).
        steps: Length of each step, shape (K, LANES) [s].
        ticks: 1 where the controller has a tick at the start of a step, else 0, shape (K, LANES);
            1 at the first; empty in continuous time.
        every: Number of steps from one sample to the next.
        start: Initial positions and speeds, shape (2, n, LANES).
    """

    command: Array
    steps: Array
    ticks: Array
    every: int
    start: Array


class Motion(NamedTuple):
    """Simulated motion at N samples.

    Attributes:
        q: Positions, shape (N, n, LANES).
        v: Speeds, shape (N, n, LANES).
        S: Sensitivities of positions, shape (N, n, P, LANES), or of positions and then of speeds,
            shape (N, 2n, P, LANES).
    """

    q: Array
    v: Array
    S: Array


def work_of(joints: int, columns: int, n_bristles: int) -> Array:
    """Return a new work space."""
    n = joints
    own = (n + 1) * BODY + 4 * n * n + 16 * n + 3 * n * columns
    return work_space(own + n_bristles * (5 + columns))


def last_step(work: Array, joints: int) -> tuple[Array, Array]:
    """Return the positions before the last step and its last correction of speeds, (n, LANES)."""
    rows, q = work.reshape(-1, LANES), (joints + 1) * BODY
    return rows[q : q + joints], rows[q + 6 * joints : q + 7 * joints]


@compiled
def _command(command, i, kind):
    """Return an input of joint i over a step; ``command`` is all inputs and the step's first."""
    inputs, first = command
    return read(inputs, (first + 6 * i + kind) * LANES)


@compiled
def _balance(work, n, at, drives, terms, step, command):
    """Write the residual G of a step's equation for the speeds u, and its derivative H.

    Row i is divided by e = 1 + mu s(u) sign(tau), the factor of the bodies' torque tau in a gear
    with friction mu |tau|, so that H is symmetric.
    """
    q, v, u, middle, h, M, G, H, by_q, gains, load, loss, held, bristles, grip = at
    codes, shapes, values, spans = terms
    if bristles >= 0:
        presliding(work, n, at, terms, THETA * step)
    rate = 1.0 / (THETA * step)
    for i in range(n):
        tau = get(work, h + i)
        for j in range(n):
            m = get(work, M + i * n + j) * rate
            tau += m * (get(work, u + j) - get(work, v + j))
            put(work, H + i * n + j, m)
        put(work, load + i, tau)
        armature, kp, kd = drives[i, 0], drives[i, 1], drives[i, 2]
        offset, viscous, coulomb = drives[i, 4], drives[i, 5], drives[i, 6]
        span = THETA * step
        speed, angle = get(work, u + i), get(work, middle + i)
        s, s_u = direction(speed)
        f = get(work, grip + i) + offset + viscous * speed + coulomb * s
        f_u = get(work, grip + n + i) + viscous + coulomb * s_u
        f_q, e, e_u = wide(0.0), wide(1.0), wide(0.0)
        for k in range(spans[i, 0], spans[i, 1]):
            y, y_u, y_q = term_by_lane(codes, shapes, k, angle, speed, s, s_u)
            if codes[k, 2] == LOADED:
                side = copysign(values[k], tau)
                e += side * y
                e_u += side * y_u
                f_q += side * y_q * tau
            else:
                f += values[k] * y
                f_u += values[k] * y_u
                f_q += values[k] * y_q
        if held >= 0:  # constant until the next tick
            torque, is_on = get(work, held + i), wide(0.0)
        else:
            error = _command(command, i, 0) - get(work, q + i) - span * speed
            speed_error, forward = _command(command, i, 2) - speed, _command(command, i, 3)
            torque, is_on = loop_torque(drives[i], error, speed_error, forward)
        rest = armature * rate * (speed - get(work, v + i)) + f - torque
        slope = armature * rate + f_u + is_on * (kd + span * kp)
        put(work, G + i, tau + rest / e)
        own = get(work, H + i * n + i) + (slope + tau * e_u) / e
        put(work, H + i * n + i, own)
        put(work, by_q + i, f_q)
        put(work, gains + i, is_on)
        put(work, loss + i, e)


@compiled
def _solve(work, n, at, drives, terms, step, command):
    """Solve a step for its speeds u and leave the factor of H; return whether it converged.

    Friction that falls with speed faster than the inertia of a step allows makes H indefinite and
    several speeds possible. Steps without this fall then lead to the one next to the speed before.
    """
    if _newton(work, n, at, drives, terms, step, command, False):
        return True
    v, u = at[1], at[2]
    for i in range(n):
        put(work, u + i, get(work, v + i))
    _newton(work, n, at, drives, terms, step, command, True)
    return _newton(work, n, at, drives, terms, step, command, False)


@compiled
def _add_fall(work, n, at, terms):
    """Add to H the slopes of friction that falls with speed, so that it is positive definite."""
    u, middle, H, loss = at[2], at[3], at[7], at[11]
    codes, shapes, values, spans = terms
    for i in range(n):
        for k in range(spans[i, 0], spans[i, 1]):
            if codes[k, 2] == LOADED:
                continue
            speed, angle = get(work, u + i), get(work, middle + i)
            _, y_u, _ = term_by_lane(codes, shapes, k, angle, speed, direction(speed)[0], wide(0.0))
            fall = where(values[k] * y_u < 0.0, -values[k] * y_u, 0.0) / get(work, loss + i)
            put(work, H + i * n + i, get(work, H + i * n + i) + fall)


@compiled
def _newton(work, n, at, drives, terms, step, command, is_cautious):
    """Iterate Newton's method for ``_solve``, without falling friction in H if cautious.

    Friction is nonlinear at speed 0, so a Newton step that would cross it ends there.
    """
    u, G, H = at[2], at[6], at[7]
    for k in range(_NEWTON):
        share = 1.0 if k < _NEWTON // 4 else 0.5  # against cycles of several joints' friction
        _balance(work, n, at, drives, terms, step, command)
        if is_cautious:
            _add_fall(work, n, at, terms)
        factor(work, n, H)
        solve(work, n, H, G)
        is_found = True
        for i in range(n):
            before = get(work, u + i)
            after = before - share * get(work, G + i)
            halts = after * before < 0.0
            after = where(halts, 0.0, after)
            is_close = abs(after - before) <= _CLOSE * (1.0 + abs(after))
            is_found = is_found and not is_any(halts | ~is_close)
            put(work, u + i, after)
        if is_found:  # H changes by rounding only
            return True
    return False


@compiled
def _advance(work, n, at, step):
    """Advance positions and speeds over a solved step."""
    q, v, u = at[0], at[1], at[2]
    for i in range(n):
        speed, before = get(work, u + i), get(work, v + i)
        put(work, q + i, get(work, q + i) + step * speed)
        put(work, v + i, before + (speed - before) / THETA)


@compiled
def _centre(work, n, at, step, tree, bodies, zeros, speeds, a):
    """Write M and h at the midpoint of the step that results from the given speeds."""
    q, middle, h, M = at[0], at[3], at[4], at[5]
    for i in range(n):
        ahead = THETA * step * get(work, speeds + i)
        put(work, middle + i, get(work, q + i) + ahead)
        put(work, a + i, 0.0)
        place(work, (i + 1) * BODY, tree.joints[i], middle + i, zeros[i])
    inverse_dynamics(work, tree, bodies, speeds, a, h)
    mass_matrix(work, tree, bodies, M)


@compiled
def _propagate(work, n, at, sensitivities, columns, drives, terms, step, command, tree):
    """Advance the sensitivities S of q and v, shape (2n, P), over a solved step."""
    q, v, u, middle, h, M, G, H, by_q, gains, load, loss, held, bristles, grip = at
    T_q, T_v, S, own, change, by_hold, by_state = sensitivities
    codes, shapes, values, spans = terms
    kinds, sums, directions = columns
    P = len(sums) - 1
    _combine(work, n, at, sensitivities, drives, step)
    for p in range(P):
        for i in range(n):
            put(work, own + i, 0.0)
        for c in range(sums[p], sums[p + 1]):
            kind, j, index = kinds[c, 0], kinds[c, 1], kinds[c, 2]
            if kind == INERTIAL:
                inertial_column(work, tree, directions[index], j, own)
            elif kind == ZERO:  # like the position, without gain and friction
                for i in range(n):
                    x = get(work, T_q + i * n + j)
                    put(work, own + i, get(work, own + i) + x)
                kp = get(work, gains + j) * drives[j, 1]
                x = (get(work, by_q + j) + kp) / get(work, loss + j)
                put(work, own + j, get(work, own + j) - x)
            elif kind != START and kind != SPEED:
                _drive_column(work, at, drives, terms, step, command, kinds[c], own)
        if held >= 0:
            for i in range(n):
                x = get(work, by_hold + i * P + p) / get(work, loss + i)
                put(work, own + i, get(work, own + i) - x)
        if bristles >= 0:
            bristle_column(work, n, at, sensitivities, terms, p, P, False)
        _advance_column(work, n, at, sensitivities, step, p, P)
        if bristles >= 0:
            bristle_column(work, n, at, sensitivities, terms, p, P, True)


@compiled
def _drive_column(work, at, drives, terms, step, command, column, own):
    """Add the derivative of a step's equation by a parameter of a drive."""
    q, v, u, middle, load, loss, held, bristles = (
        at[0], at[1], at[2], at[3], at[10], at[11], at[12], at[13]
    )  # fmt: skip
    codes, shapes = terms.codes, terms.shapes
    kind, j, index = column
    kp, kd = drives[j, 1], drives[j, 2]
    span, speed, x = THETA * step, get(work, u + j), wide(0.0)
    if kind == ARMATURE:
        x = (speed - get(work, v + j)) / span
    elif kind == TERM and codes[index, 2] == BRISTLES:
        x = get(work, bristles + 5 * int(shapes[index, 3]) + 1)
    elif kind == TERM and index >= terms.spans[j, 1]:
        x = affine_term(codes, index, speed)
    elif kind == TERM:
        angle, (s, s_u) = get(work, middle + j), direction(speed)
        x, _, _ = term_by_lane(codes, shapes, index, angle, speed, s, s_u)
        if codes[index, 2] == LOADED:
            x *= abs(get(work, load + j))
    elif held < 0:
        error = _command(command, j, 0) - get(work, q + j) - span * speed
        speed_error = _command(command, j, 2) - speed
        torque, is_on = loop_torque(drives[j], error, speed_error, _command(command, j, 3))
        by_delay = (
            kp * _command(command, j, 1) + kd * _command(command, j, 4) + _command(command, j, 5)
        )
        x = -_by_loop(kind, is_on, error, speed_error, by_delay, torque)
    put(work, own + j, get(work, own + j) + x / get(work, loss + j))


@compiled
def _by_loop(kind, is_on, error, speed_error, by_delay, torque):
    """Return the derivative of a loop's torque by a gain, its delay or its limit."""
    if kind == KP:
        return is_on * error
    if kind == KD:
        return is_on * speed_error
    if kind == DELAY:
        return is_on * by_delay
    return (1.0 - is_on) * copysign(1.0, torque) if kind == LIMIT else wide(0.0)


@compiled
def _hold(work, n, at, sensitivities, columns, drives, command, is_tick):
    """Write the held torques and their sensitivities in lanes whose controllers have a tick."""
    q, v, held = at[0], at[1], at[12]
    kinds, sums = columns.kinds, columns.sums
    S, by_hold, P = sensitivities[2], sensitivities[5], len(sums) - 1
    for i in range(n):
        kp, kd = drives[i, 1], drives[i, 2]
        error = _command(command, i, 0) - get(work, q + i)
        speed_error = _command(command, i, 2) - get(work, v + i)
        torque, is_on = loop_torque(drives[i], error, speed_error, _command(command, i, 3))
        by_delay = (
            kp * _command(command, i, 1) + kd * _command(command, i, 4) + _command(command, i, 5)
        )
        put(work, held + i, where(is_tick, torque, get(work, held + i)))
        for p in range(P):
            x = kp * get(work, S + i * P + p) + kd * get(work, S + (n + i) * P + p)
            own = wide(0.0)
            for c in range(sums[p], sums[p + 1]):
                if kinds[c, 1] == i:
                    own += _by_loop(kinds[c, 0], is_on, error, speed_error, by_delay, torque)
            own = where(is_tick, own - is_on * x, get(work, by_hold + i * P + p))
            put(work, by_hold + i * P + p, own)


@compiled
def _combine(work, n, at, sensitivities, drives, step):
    """Write the derivatives of a step's equation by position and speed before it: T_q and T_v.

    H du = T_v dv - T_q dq - own, each row divided by its e.
    """
    M, by_q, gains, loss = at[5], at[8], at[9], at[11]
    T_q, T_v = sensitivities[0], sensitivities[1]
    span, rate = THETA * step, 1.0 / (THETA * step)
    for i in range(n):
        for k in range(i * n, i * n + n):
            m, bent = get(work, M + k) * rate, get(work, T_q + k)
            put(work, T_v + k, m - span * bent - get(work, T_v + k))
        armature, kp, d = drives[i, 0], drives[i, 1], i * n + i
        bent, e = get(work, by_q + i), get(work, loss + i)
        by_speed = (armature * rate - span * bent) / e
        by_position = (bent + get(work, gains + i) * kp) / e
        put(work, T_v + d, get(work, T_v + d) + by_speed)
        put(work, T_q + d, get(work, T_q + d) + by_position)


@compiled
def _advance_column(work, n, at, sensitivities, step, p, P):
    """Advance one sensitivity of position and speed over a step."""
    H = at[7]
    T_q, T_v, S, own, change = sensitivities[:5]
    for i in range(n):
        moved = -get(work, own + i)
        for j in range(n):
            moved += get(work, T_v + i * n + j) * get(work, S + (n + j) * P + p)
            moved -= get(work, T_q + i * n + j) * get(work, S + j * P + p)
        put(work, change + i, moved)
    solve(work, n, H, change)
    for i in range(n):
        du, dv = get(work, change + i), get(work, S + (n + i) * P + p)
        dq = get(work, S + i * P + p) + step * du
        put(work, S + i * P + p, dq)
        put(work, S + (n + i) * P + p, dv + (du - dv) / THETA)


@compiled
def _initialise(work, n, at, sensitivities, columns, terms, gravity, start, out_S):
    """Write the initial states of roll-outs and their sensitivities."""
    q, v, u, S = at[0], at[1], at[2], sensitivities[2]
    kinds, sums, P = columns.kinds, columns.sums, len(columns.sums) - 1
    first = start.reshape(start.size)
    for k in range(3):
        put(work, ACCELERATION + k, -gravity[k])
    for i in range(n):
        put(work, q + i, read(first, i * LANES))
        put(work, v + i, read(first, (n + i) * LANES))
        put(work, u + i, read(first, (n + i) * LANES))
    for p in range(P):
        kind, joint = kinds[sums[p], 0], kinds[sums[p], 1]
        if kind in (START, SPEED):  # of one joint alone
            row = joint + (n if kind == SPEED else 0)
            put(work, S + row * P + p, 1.0)
            if row < out_S.shape[1]:
                out_S[0, row, p] = 1.0
    if at[13] >= 0:
        initialise_bristles(work, n, at, sensitivities[6], kinds, sums, terms, SPEED)


@compiled
def roll_out(tree, zeros, bodies, drives, terms, columns, course, out, work, corrects):
    """Simulate a block of lanes; return the first step without a solution, or -1.

    zeros (n,) [rad or m], bodies (n, 10), drives (n, 7).
    """
    command, steps, ticks, every, start = course
    out_q, out_v, out_S = (
        out.q.reshape(out.q.size),
        out.v.reshape(out.v.size),
        out.S.reshape(out.S.size),
    )
    codes = terms.codes
    n, P = len(tree.parents), len(columns.sums) - 1
    q = (n + 1) * BODY
    v, u, middle, h, a = q + n, q + 2 * n, q + 3 * n, q + 4 * n, q + 5 * n
    G, by_q, gains, own, change = a + n, a + 2 * n, a + 3 * n, a + 4 * n, a + 5 * n
    load, loss, M = change + n, change + 2 * n, change + 3 * n
    H, T_q, T_v, S = M + n * n, M + 2 * n * n, M + 3 * n * n, M + 4 * n * n
    by_hold, held = S + 2 * n * P, S + 3 * n * P if len(ticks) else -1
    n_bristles = (codes[:, 2] == BRISTLES).sum()
    grip = S + (3 * P + 1) * n
    bristles, by_state = grip + 2 * n if n_bristles else -1, grip + 2 * n + 5 * n_bristles
    at = (q, v, u, middle, h, M, G, H, by_q, gains, load, loss, held, bristles, grip)
    sensitivities = (T_q, T_v, S, own, change, by_hold, by_state)
    work[:] = 0.0
    _initialise(work, n, at, sensitivities, columns, terms, tree.gravity, start, out.S)
    commands, lengths, starts = (
        command.reshape(command.size), steps.reshape(steps.size), ticks.reshape(ticks.size)
    )  # fmt: skip
    outputs = out.S.shape[1]
    for k in range(len(steps)):
        step, now = read(lengths, k * LANES), (commands, 6 * n * k)
        if held >= 0:
            is_tick = read(starts, k * LANES) > 0.0
            if is_any(is_tick):
                _hold(work, n, at, sensitivities, columns, drives, now, is_tick)
        _centre(work, n, at, step, tree, bodies, zeros, v, a)
        if not _solve(work, n, at, drives, terms, step, now):
            return k
        if corrects:
            _centre(work, n, at, step, tree, bodies, zeros, u, a)
            if not _solve(work, n, at, drives, terms, step, now):
                return k
        if bristles >= 0:
            advance_bristles(work, n, at, terms, THETA * step, step)
        if P:
            for i in range(n):
                moved = get(work, u + i) - get(work, v + i)
                put(work, a + i, moved / (THETA * step))
            inverse_dynamics(work, tree, bodies, v, a, h)
            derivatives(work, tree, bodies, v, T_q)  # T_q, followed by T_v
            _propagate(work, n, at, sensitivities, columns, drives, terms, step, now, tree)
        _advance(work, n, at, step)
        if (k + 1) % every == 0:
            sample = (k + 1) // every
            for i in range(n):
                write(out_q, (sample * n + i) * LANES, get(work, q + i))
                write(out_v, (sample * n + i) * LANES, get(work, v + i))
            for row in range(outputs * P):
                write(out_S, (sample * outputs * P + row) * LANES, get(work, S + row))
    return -1
