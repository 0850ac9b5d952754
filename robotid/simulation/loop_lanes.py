"""Roll-outs of a robot under the loops of its drives, with their sensitivities, in Numba.

Imported only where a loop is simulated. ``LANES`` roll-outs go on at once, one in each
lane of the work space of ``tree_lanes``: windows of logs, which begin where the log was.

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
from typing import NamedTuple

from robotid._typing import Array
from robotid.regressor.lanes import Work, compiled, factor, get, put, put3, solve, work_space
from robotid.regressor.tree_lanes import (
    ACCELERATION,
    BODY,
    derivatives,
    inertial_column,
    inverse_dynamics,
    mass_matrix,
    place,
)
from robotid.robot.drive_term import BRISTLES, LOADED
from robotid.simulation.law_lanes import coded_term, deflection, loop_torque, slid, term, turned

__all__ = [
    "ARMATURE",
    "INERTIAL",
    "KD",
    "KP",
    "LANES",
    "LATE",
    "LIMIT",
    "SPEED",
    "START",
    "TERM",
    "ZERO",
    "coded_term",
    "roll_out",
    "work_of",
]

_DOUBLINGS = 3  # of lanes
LANES = 1 << _DOUBLINGS
THETA = 0.5  # of a step, where its forces act: exact to second order
_SLID = 0.1  # [s] for which drives are taken to have moved before a roll-out begins
_NEWTON = 60  # steps, of which three or four are typical
_CLOSE = 1e-12  # of the speed, relative to 1 + its size

# kinds of sensitivities
ARMATURE, KP, KD, LIMIT, TERM, LATE, ZERO, INERTIAL, START, SPEED = range(10)


class Terms(NamedTuple):
    """Friction and offset of the joints: T terms, joint by joint.

    Attributes:
        codes: Those of ``coded_term``, shape (T, 5), int; the kind of a term is the third.
        shapes: Numbers of its laws, or those of bristles and its number among them, shape (T, 11).
        values: Its parameter, shape (T,).
        spans: Where the terms of a joint begin, where those do that are bristles or are in the
            drives' numbers, and where they end, shape (n, 3), int.
    """

    codes: Array
    shapes: Array
    values: Array
    spans: Array


class Columns(NamedTuple):
    """What roll-outs are differentiated by.

    Attributes:
        kinds: Kind, joint and index of each column, shape (C, 3), int.
        sums: Column with which each of the P sensitivities begins, which is the sum of its columns,
            and their number, shape (P + 1,), int.
        directions: Changes of a body's ten parameters, shape (D, 10).
    """

    kinds: Array
    sums: Array
    directions: Array


class Course(NamedTuple):
    """What roll-outs are told, step by step.

    Attributes:
        command: Position, its derivative by the delay, speed, torque, and the derivatives of speed
            and torque by the delay, on average over each step, or those of its tick, shape
            (K, n, 6, LANES).
        steps: Length of each step, shape (K, LANES) [s].
        ticks: Where the controllers have a tick as the step begins, shape (K, LANES), bool, all at
            the first; of no entries if they have no clock.
        every: Steps from a sample to the next.
        start: Positions and speeds, shape (2, n, LANES).
    """

    command: Array
    steps: Array
    ticks: Array
    every: int
    start: Array


class Motion(NamedTuple):
    """What comes out, at N samples.

    Attributes:
        q: Positions, shape (N, n, LANES).
        v: Speeds, likewise.
        S: Sensitivities of position, shape (N, n, P, LANES), or of position and then of speed,
            shape (N, 2n, P, LANES).
    """

    q: Array
    v: Array
    S: Array


def work_of(joints: int, columns: int, memories: int) -> Work:
    """Return a new work space.

    Args:
        joints: Number of joints.
        columns: Number of sensitivities.
        memories: Number of terms that are taken up over a way.
    """
    n = joints
    own = (n + 1) * BODY + 4 * n * n + 16 * n + 3 * n * columns
    return work_space(own + memories * (5 + columns), _DOUBLINGS)


@compiled
def _balance(work, n, at, drives, terms, step, command):
    """Write the residual G of a step's equation for the speeds u, and its derivative H.

    Row i is divided by e = 1 + mu s(u) sign(tau), by which a gear that loses a share mu of its
    load multiplies the bodies' torque tau: so H stays symmetric.
    """
    q, v, u, middle, h, M, G, H, by_q, gains, load, loss, held, memory, grip = at
    codes, shapes, values, spans = terms
    if memory >= 0:
        _hold_on(work, n, at, terms, step)
    for i in range(n):
        for lane in range(LANES):
            put(work, load + i, lane, get(work, h + i, lane))
        for j in range(n):
            for lane in range(LANES):
                m = get(work, M + i * n + j, lane) / (THETA * step[lane])
                moved = get(work, u + j, lane) - get(work, v + j, lane)
                put(work, load + i, lane, get(work, load + i, lane) + m * moved)
                put(work, H + i * n + j, lane, m)
        armature, kp, kd = drives[i, 0], drives[i, 1], drives[i, 2]
        offset, viscous, coulomb = drives[i, 4], drives[i, 5], drives[i, 6]
        for lane in range(LANES):
            span, tau = THETA * step[lane], get(work, load + i, lane)
            speed, angle = get(work, u + i, lane), get(work, middle + i, lane)
            s, s_u = turned(speed)
            f = get(work, grip + i, lane) + offset + viscous * speed + coulomb * s
            f_u = get(work, grip + n + i, lane) + viscous + coulomb * s_u
            f_q, e, e_u = 0.0, 1.0, 0.0
            for k in range(spans[i, 0], spans[i, 1]):
                y, y_u, y_q = term(codes, shapes, k, angle, speed, s, s_u)
                if codes[k, 2] == LOADED:
                    side = math.copysign(values[k], tau)
                    e += side * y
                    e_u += side * y_u
                    f_q += side * y_q * tau
                else:
                    f += values[k] * y
                    f_u += values[k] * y_u
                    f_q += values[k] * y_q
            if held >= 0:  # what the joint does within a tick changes nothing
                torque, is_on = get(work, held + i, lane), 0.0
            else:
                reach = command[i, 0, lane] - get(work, q + i, lane) - span * speed
                slip, forward = command[i, 2, lane] - speed, command[i, 3, lane]
                torque, is_on = loop_torque(drives[i], reach, slip, forward)
            rest = armature * (speed - get(work, v + i, lane)) / span + f - torque
            slope = armature / span + f_u + is_on * (kd + span * kp)
            put(work, G + i, lane, tau + rest / e)
            own = get(work, H + i * n + i, lane) + (slope + tau * e_u) / e
            put(work, H + i * n + i, lane, own)
            put(work, by_q + i, lane, f_q)
            put(work, gains + i, lane, is_on)
            put(work, loss + i, lane, e)


@compiled
def _hold_on(work, n, at, terms, step):
    """Write the friction of memories for the speeds u, and its derivative."""
    u, memory, grip = at[2], at[13], at[14]
    codes, shapes, values, spans = terms
    for i in range(n):
        for lane in range(LANES):
            speed, f, f_u = get(work, u + i, lane), 0.0, 0.0
            for k in range(spans[i, 0], spans[i, 2]):
                if codes[k, 2] == BRISTLES:
                    before = get(work, memory + 5 * int(shapes[k, 3]), lane)
                    z, z_u, _ = deflection(shapes[k], before, speed, THETA * step[lane])
                    f += values[k] * z
                    f_u += values[k] * z_u
            put(work, grip + i, lane, f)
            put(work, grip + n + i, lane, f_u)


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
        factor(work, n, H)
        if is_found:
            return True
        solve(work, n, H, G)
        is_found = True
        for i in range(n):
            for lane in range(LANES):
                before = get(work, u + i, lane)
                after = before - share * get(work, G + i, lane)
                halts = after * before < 0.0
                after = 0.0 if halts else after
                if halts or not abs(after - before) <= _CLOSE * (1.0 + abs(after)):
                    is_found = False
                put(work, u + i, lane, after)
    return False


@compiled
def _advance(work, n, at, step):
    """Advance positions and speeds over a step that is solved."""
    q, v, u = at[0], at[1], at[2]
    for i in range(n):
        for lane in range(LANES):
            speed, before = get(work, u + i, lane), get(work, v + i, lane)
            put(work, q + i, lane, get(work, q + i, lane) + step[lane] * speed)
            put(work, v + i, lane, before + (speed - before) / THETA)


@compiled
def _centre(work, n, at, step, tree, bodies, zeros, speeds, a):
    """Write M and h of the middle of the step, where some speeds lead to."""
    q, middle, h, M = at[0], at[3], at[4], at[5]
    for i in range(n):
        for lane in range(LANES):
            ahead = THETA * step[lane] * get(work, speeds + i, lane)
            put(work, middle + i, lane, get(work, q + i, lane) + ahead)
            put(work, a + i, lane, 0.0)
        place(work, (i + 1) * BODY, tree.joints[i], middle + i, zeros[i])
    inverse_dynamics(work, tree, bodies, speeds, a, h)
    mass_matrix(work, tree, bodies, M)


@compiled
def _propagate(work, n, at, sweeps, columns, drives, terms, step, command, tree):
    """Advance the sensitivities S of q and v, shape (2n, P), over a step that is solved."""
    q, v, u, middle, h, M, G, H, by_q, gains, load, loss, held, memory, grip = at
    T_q, T_v, S, own, change, by_hold, by_state = sweeps
    codes, shapes, values, spans = terms
    kinds, sums, directions = columns
    P = len(sums) - 1
    _combine(work, n, at, sweeps, drives, step)
    for p in range(P):
        for i in range(n):
            for lane in range(LANES):
                put(work, own + i, lane, 0.0)
        for c in range(sums[p], sums[p + 1]):
            kind, j, index = kinds[c, 0], kinds[c, 1], kinds[c, 2]
            if kind == INERTIAL:
                inertial_column(work, tree, directions[index], j, own)
            elif kind == ZERO:  # what position does but for gain and friction
                for i in range(n):
                    for lane in range(LANES):
                        x = get(work, T_q + i * n + j, lane)
                        put(work, own + i, lane, get(work, own + i, lane) + x)
                for lane in range(LANES):
                    kp = get(work, gains + j, lane) * drives[j, 1]
                    x = (get(work, by_q + j, lane) + kp) / get(work, loss + j, lane)
                    put(work, own + j, lane, get(work, own + j, lane) - x)
            elif kind != START and kind != SPEED:
                _drive_column(work, at, drives, terms, step, command, kinds[c], own)
        if held >= 0:
            for i in range(n):
                for lane in range(LANES):
                    x = get(work, by_hold + i * P + p, lane) / get(work, loss + i, lane)
                    put(work, own + i, lane, get(work, own + i, lane) - x)
        if memory >= 0:
            _recall(work, n, at, sweeps, terms, p, P, False)
        _advance_column(work, n, at, sweeps, step, p, P)
        if memory >= 0:
            _recall(work, n, at, sweeps, terms, p, P, True)


@compiled
def _drive_column(work, at, drives, terms, step, command, column, own):
    """Add what a parameter of a drive changes in its row of a step's equation."""
    q, v, u, middle, load, loss, held, memory = (
        at[0], at[1], at[2], at[3], at[10], at[11], at[12], at[13]
    )  # fmt: skip
    codes, shapes = terms.codes, terms.shapes
    kind, j, index = column
    kp, kd = drives[j, 1], drives[j, 2]
    for lane in range(LANES):
        span, speed, x = THETA * step[lane], get(work, u + j, lane), 0.0
        if kind == ARMATURE:
            x = (speed - get(work, v + j, lane)) / span
        elif kind == TERM and codes[index, 2] == BRISTLES:
            x = get(work, memory + 5 * int(shapes[index, 3]) + 1, lane)
        elif kind == TERM:
            angle, (s, s_u) = get(work, middle + j, lane), turned(speed)
            x, _, _ = term(codes, shapes, index, angle, speed, s, s_u)
            x *= abs(get(work, load + j, lane)) if codes[index, 2] == LOADED else 1.0
        elif held < 0:
            reach = command[j, 0, lane] - get(work, q + j, lane) - span * speed
            slip = command[j, 2, lane] - speed
            torque, is_on = loop_torque(drives[j], reach, slip, command[j, 3, lane])
            late = kp * command[j, 1, lane] + kd * command[j, 4, lane] + command[j, 5, lane]
            x = -_by_loop(kind, is_on, reach, slip, late, torque)
        put(work, own + j, lane, get(work, own + j, lane) + x / get(work, loss + j, lane))


@compiled
def _remember(work, n, at, terms, step):
    """Write z after a step, that which acts in it, and derivatives of both.

    These are of what acts by z before, of z after by the speed u, and by z before.
    """
    u, memory = at[2], at[13]
    codes, shapes, values, spans = terms
    for i in range(n):
        for k in range(spans[i, 0], spans[i, 2]):
            if codes[k, 2] == BRISTLES:
                z = memory + 5 * int(shapes[k, 3])
                for lane in range(LANES):
                    speed, before = get(work, u + i, lane), get(work, z, lane)
                    acts, _, share = deflection(shapes[k], before, speed, THETA * step[lane])
                    after, by_speed, kept = deflection(shapes[k], before, speed, step[lane])
                    put(work, z, lane, after)
                    put(work, z + 1, lane, acts)
                    put3(work, z + 2, lane, (share, by_speed, kept))


@compiled
def _slide(work, n, at, by_state, kinds, sums, terms):
    """Write z where roll-outs begin, and how it changes with the speed v there.

    It is that of long sliding, but for joints that take longer than ``_SLID`` to go their way.
    """
    v, memory = at[1], at[13]
    codes, shapes, values, spans = terms
    for i in range(n):
        for k in range(spans[i, 0], spans[i, 2]):
            if codes[k, 2] != BRISTLES:
                continue
            slot, P = int(shapes[k, 3]), len(sums) - 1
            for lane in range(LANES):
                z, by_speed = slid(shapes[k], get(work, v + i, lane), _SLID)
                put(work, memory + 5 * slot, lane, z)
                for p in range(P):
                    if kinds[sums[p], 0] == SPEED and kinds[sums[p], 1] == i:
                        put(work, by_state + slot * P + p, lane, by_speed)


@compiled
def _recall(work, n, at, sweeps, terms, p, P, is_after):
    """Add to one column what memories make of their past; after the step, advance theirs."""
    loss, memory = at[11], at[13]
    own, change, by_state = sweeps[3], sweeps[4], sweeps[6]
    codes, shapes, values, spans = terms
    for i in range(n):
        for k in range(spans[i, 0], spans[i, 2]):
            if codes[k, 2] != BRISTLES:
                continue
            slot = int(shapes[k, 3])
            z, Z = memory + 5 * slot, by_state + slot * P + p
            for lane in range(LANES):
                x = get(work, Z, lane)
                if is_after:
                    x *= get(work, z + 4, lane)
                    put(work, Z, lane, x + get(work, z + 3, lane) * get(work, change + i, lane))
                else:
                    x *= values[k] * get(work, z + 2, lane) / get(work, loss + i, lane)
                    put(work, own + i, lane, get(work, own + i, lane) + x)


@compiled
def _by_loop(kind, is_on, reach, slip, late, torque):
    """Return how the torque of a loop changes with a gain, its delay or its limit."""
    if kind == KP:
        return is_on * reach
    if kind == KD:
        return is_on * slip
    if kind == LATE:
        return is_on * late
    return (1.0 - is_on) * math.copysign(1.0, torque) if kind == LIMIT else 0.0


@compiled
def _hold(work, n, at, sweeps, columns, drives, command, is_tick):
    """Write torques, and their sensitivities, of the lanes whose controllers have a tick."""
    q, v, held = at[0], at[1], at[12]
    kinds, sums = columns.kinds, columns.sums
    S, by_hold, P = sweeps[2], sweeps[5], len(sums) - 1
    for i in range(n):
        kp, kd = drives[i, 1], drives[i, 2]
        for lane in range(LANES):
            if not is_tick[lane]:
                continue
            reach = command[i, 0, lane] - get(work, q + i, lane)
            slip = command[i, 2, lane] - get(work, v + i, lane)
            torque, is_on = loop_torque(drives[i], reach, slip, command[i, 3, lane])
            late = kp * command[i, 1, lane] + kd * command[i, 4, lane] + command[i, 5, lane]
            put(work, held + i, lane, torque)
            for p in range(P):
                x = kp * get(work, S + i * P + p, lane) + kd * get(work, S + (n + i) * P + p, lane)
                own = 0.0
                for c in range(sums[p], sums[p + 1]):
                    if kinds[c, 1] == i:
                        own += _by_loop(kinds[c, 0], is_on, reach, slip, late, torque)
                put(work, by_hold + i * P + p, lane, own - is_on * x)


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
                bent = get(work, T_q + i * n + j, lane)
                m = get(work, M + i * n + j, lane) / span
                value = m - span * bent - get(work, T_v + i * n + j, lane)
                put(work, T_v + i * n + j, lane, value)
        armature, kp, d = drives[i, 0], drives[i, 1], i * n + i
        for lane in range(LANES):
            span, e = THETA * step[lane], get(work, loss + i, lane)
            bent = get(work, by_q + i, lane)
            by_speed = (armature / span - span * bent) / e
            by_position = (bent + get(work, gains + i, lane) * kp) / e
            put(work, T_v + d, lane, get(work, T_v + d, lane) + by_speed)
            put(work, T_q + d, lane, get(work, T_q + d, lane) + by_position)


@compiled
def _advance_column(work, n, at, sweeps, step, p, P):
    """Advance one sensitivity of position and speed over a step."""
    H = at[7]
    T_q, T_v, S, own, change = sweeps[:5]
    for i in range(n):
        for lane in range(LANES):
            put(work, change + i, lane, -get(work, own + i, lane))
        for j in range(n):
            for lane in range(LANES):
                x = get(work, T_v + i * n + j, lane) * get(work, S + (n + j) * P + p, lane)
                x -= get(work, T_q + i * n + j, lane) * get(work, S + j * P + p, lane)
                put(work, change + i, lane, get(work, change + i, lane) + x)
    solve(work, n, H, change)
    for i in range(n):
        for lane in range(LANES):
            du, dv = get(work, change + i, lane), get(work, S + (n + i) * P + p, lane)
            dq = get(work, S + i * P + p, lane) + step[lane] * du
            put(work, S + i * P + p, lane, dq)
            put(work, S + (n + i) * P + p, lane, dv + (du - dv) / THETA)


@compiled
def _begin(work, n, at, sweeps, columns, terms, gravity, start, out_S):
    """Write where roll-outs begin, and how that changes with itself."""
    q, v, u, S = at[0], at[1], at[2], sweeps[2]
    kinds, sums, P = columns.kinds, columns.sums, len(columns.sums) - 1
    for lane in range(LANES):
        for k in range(3):
            put(work, ACCELERATION + k, lane, -gravity[k])
        for i in range(n):
            put(work, q + i, lane, start[0, i, lane])
            put(work, v + i, lane, start[1, i, lane])
            put(work, u + i, lane, start[1, i, lane])
        for p in range(P):
            kind, joint = kinds[sums[p], 0], kinds[sums[p], 1]
            if kind in (START, SPEED):  # of one joint alone
                row = joint + (n if kind == SPEED else 0)
                put(work, S + row * P + p, lane, 1.0)
                if row < out_S.shape[1]:
                    out_S[0, row, p, lane] = 1.0
    if at[13] >= 0:
        _slide(work, n, at, sweeps[6], kinds, sums, terms)


@compiled
def roll_out(tree, zeros, bodies, drives, terms, columns, course, out, work, corrects):
    """Simulate a block of lanes; return the first step that had no solution, -1 if all had.

    Args:
        tree: The n joints, in the order of their bodies.
        zeros: Angle of the URDF where an encoder reads 0, shape (n,) [rad or m].
        bodies: Ten inertial parameters of each joint's body, shape (n, 10).
        drives: Armature, kp, kd and largest torque of each joint, and the sums of its parameters of
            1, the speed and its direction, shape (n, 7).
        terms: ``Terms`` of the drives.
        columns: ``Columns`` of sensitivities.
        course: ``Course`` of what is told.
        out: ``Motion``; written.
        work: Work space of ``work_of``.
        corrects: Whether each step is solved once more, at its middle; without columns alone.
    """
    command, steps, ticks, every, start = course
    out_q, out_v, out_S = out
    codes = terms.codes
    n, P = len(tree.parents), len(columns.sums) - 1
    q = (n + 1) * BODY
    v, u, middle, h, a = q + n, q + 2 * n, q + 3 * n, q + 4 * n, q + 5 * n
    G, by_q, gains, own, change = a + n, a + 2 * n, a + 3 * n, a + 4 * n, a + 5 * n
    load, loss, M = change + n, change + 2 * n, change + 3 * n
    H, T_q, T_v, S = M + n * n, M + 2 * n * n, M + 3 * n * n, M + 4 * n * n
    by_hold, held = S + 2 * n * P, S + 3 * n * P if len(ticks) else -1
    memories = (codes[:, 2] == BRISTLES).sum()
    grip = S + (3 * P + 1) * n
    memory, by_state = grip + 2 * n if memories else -1, grip + 2 * n + 5 * memories
    at = (q, v, u, middle, h, M, G, H, by_q, gains, load, loss, held, memory, grip)
    sweeps = (T_q, T_v, S, own, change, by_hold, by_state)
    work.numbers[:] = 0.0
    _begin(work, n, at, sweeps, columns, terms, tree.gravity, start, out_S)
    for k in range(len(steps)):
        step = steps[k]
        if held >= 0 and ticks[k].any():
            _hold(work, n, at, sweeps, columns, drives, command[k], ticks[k])
        _centre(work, n, at, step, tree, bodies, zeros, v, a)
        if not _newton(work, n, at, drives, terms, step, command[k]):
            return k
        if corrects:
            _centre(work, n, at, step, tree, bodies, zeros, u, a)
            if not _newton(work, n, at, drives, terms, step, command[k]):
                return k
        if memory >= 0:
            _remember(work, n, at, terms, step)
        if P:
            for i in range(n):
                for lane in range(LANES):
                    moved = get(work, u + i, lane) - get(work, v + i, lane)
                    put(work, a + i, lane, moved / (THETA * step[lane]))
            inverse_dynamics(work, tree, bodies, v, a, h)
            derivatives(work, tree, bodies, v, T_q)  # and T_v behind it
            _propagate(work, n, at, sweeps, columns, drives, terms, step, command[k], tree)
        _advance(work, n, at, step)
        if (k + 1) % every == 0:
            sample = (k + 1) // every
            for i in range(n):
                for lane in range(LANES):
                    out_q[sample, i, lane] = get(work, q + i, lane)
                    out_v[sample, i, lane] = get(work, v + i, lane)
            for i in range(out_S.shape[1]):
                for p in range(P):
                    for lane in range(LANES):
                        out_S[sample, i, p, lane] = get(work, S + i * P + p, lane)
    return -1
