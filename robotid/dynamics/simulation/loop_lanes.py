"""Closed-loop simulation of a robot with sensitivities, in Numba: the steps and the drives' laws.

``LANES`` windows of logs are simulated together, one in each lane of the work space of
``tree_lanes``, each from the initial state of its window. One step solves for the speed u at the
instant t + theta dt

    D (u - v) / (theta dt) + h(q', v) + f(q', u) = kp (r - q - theta dt u) + kd (w - u) + ff,

with D = M(q') + armature, q' = q + theta dt v, h the torque of gravity and speeds, f that of
friction and offset, r and w the mean commands over the step; then q += dt u and
v += (u - v) / theta. Newton's method ends at rounding error, so that the sensitivities, by the
implicit function theorem, are those of the computed motion.

Torques of gravity and speeds are exact to first order. ``corrects`` solves each step a second time,
with M and h at the midpoint q + theta dt u of the first solution: exact to second order, except
where friction reverses within the step. Such roll-outs have no sensitivities.

The bristle deflection z of presliding friction x z is a further state; over a step its equation is
linear and solved exactly. The torque is that of z at t + theta dt. A discrete-time controller
samples q, v and commands at its ticks, which no step crosses, with a zero-order hold of the torque.
Friction has the laws of ``drives``, compiled one by one and called by address.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.tolerances import ROUNDING
from robotid.base.typing import Array
from robotid.dynamics.kernels.lanes import (
    LANES,
    applied,
    compiled,
    copysign,
    factor,
    get,
    inner,
    is_any,
    lane_of,
    pointed,
    put,
    put3,
    read,
    solve,
    where,
    wide,
    with_lane,
    work_space,
    write,
)
from robotid.dynamics.kernels.tree_lanes import (
    ACCELERATION,
    BODY,
    derivatives,
    inertial_column,
    inverse_dynamics,
    mass_matrix,
    place,
)
from robotid.dynamics.rows import Tree
from robotid.robot.drive_term import BRISTLES, LOADED, PLAIN, DriveTerm, Law, MemorylessTerm
from robotid.robot.drives import Bristles

THETA = 0.5  # instant of the forces, relative to the step: exact to second order
_NEWTON = 60  # largest number of steps; three or four are typical
_MOVED_BEFORE = 0.1  # assumed time of motion before the simulation, for initial deflections [s]
_SIGN = 1e-5  # speed over which friction reverses [rad/s or m/s]

# kinds of sensitivities
ARMATURE, KP, KD, LIMIT, TERM, DELAY, ZERO, INERTIAL, START, SPEED = range(10)

_bristles = inner(Bristles.law)
_pointed = cache(pointed)


class Terms(NamedTuple):
    """Friction and offset of the joints: T terms, joint by joint."""

    codes: Array  # codes of ``coded_term``, shape (T, 5), int; the third is the kind of the term
    shapes: Array  # shape parameters of laws or bristles, shape (T, 11)
    values: Array  # parameters, shape (T,)
    spans: Array  # index of each joint's first term, and first bristle or affine term, (n, 2), int
    bristles: Array  # index of each bristle term, and its joint, shape (B, 2), int


class Robot(NamedTuple):
    """The part of a robot that is simulated, with n joints."""

    tree: Tree  # its bodies and joints
    zeros: Array  # position of the URDF at position 0 of each encoder, shape (n,) [rad or m]
    bodies: Array  # inertial parameters, shape (n, 10)
    # armature, kp, kd, torque limit; sums of affine terms: 1, speed, its direction; shape (n, 7)
    drives: Array
    terms: Terms  # friction and offset


class Columns(NamedTuple):
    """Parameters of the sensitivities."""

    kinds: Array  # kind, joint and index of each column, shape (C, 3), int
    sums: Array  # first column of each of the P sums that are sensitivities, and end, (P + 1,), int
    directions: Array  # directions in a body's ten parameters, shape (D, 10)
    factors: Array  # derivative of each column's quantity by its parameter, shape (C,)


class Course(NamedTuple):
    """Inputs of roll-outs."""

    # position, its derivative by the delay, speed, torque, and the derivatives of speed and
    # torque by the delay: means over each step, or values of its tick, shape (K, n, 6, LANES)
    command: Array
    steps: Array  # length of each step, shape (K, LANES) [s]
    ticks: Array  # 1 at steps that start with a tick, as the first; (K, LANES); else empty
    every: int  # number of steps from one sample to the next
    start: Array  # initial positions and speeds, shape (2, n, LANES)


class Motion(NamedTuple):
    """Simulated motion at N samples."""

    q: Array  # positions, shape (N, n, LANES)
    v: Array  # speeds, shape (N, n, LANES)
    S: Array  # sensitivities of positions, (N, n, P, LANES), or also of speeds, (N, 2n, P, LANES)


class Places(NamedTuple):
    """Sizes, and the places of a step's quantities in the work space after those of the bodies."""

    n: int  # joints
    P: int  # sensitivities
    q: int
    v: int
    u: int  # speed at the instant of the forces
    middle: int  # position at that instant
    h: int  # torque of gravity and speeds
    a: int  # acceleration
    G: int  # residual of the step's equation, then the correction of u
    by_q: int  # derivative of friction by the position
    gains: int  # 1 for a loop below its torque limit, else 0
    load: int  # torque of the bodies
    loss: int  # factor of the load in a gear with friction
    own: int  # derivative of the equation by one parameter
    change: int  # of u by one parameter
    held: int  # torque until the next tick; -1 in continuous time
    grip: int  # friction of bristles, then its derivative by the speed
    M: int  # mass matrix of the bodies, (n, n)
    H: int  # derivative of G by u, then its factor, (n, n)
    T_q: int  # derivative of the equation by positions before the step, (n, n)
    T_v: int  # and by speeds, (n, n)
    S: int  # sensitivities of positions and speeds, (2n, P)
    by_hold: int  # sensitivities of the held torques, (n, P)
    bristles: int  # of each: z, the acting z, and three derivatives
    by_state: int  # sensitivities of the bristles, (bristles, P)
    end: int


def places_of(n: int, P: int, n_bristles: int, is_held: bool) -> tuple[Places, Array]:
    """Return the places of the quantities, one after the other, and a new work space of them."""
    sizes = [n] * 14 + [2 * n] + [n * n] * 4 + [2 * n * P, n * P, 5 * n_bristles, n_bristles * P]
    at = Places(n, P, *np.cumsum([(n + 1) * BODY, *sizes]).tolist())
    return at if is_held else at._replace(held=-1), work_space(at.end)


@inner
def _balance(work, at, robot, step, now):
    """Write the residual G of a step's equation for the speeds u, and its derivative H."""
    # Rows are divided by e = 1 + mu s(u) sign(tau) of gears with friction mu |tau|: H is symmetric.
    n, drives, terms = at.n, robot.drives, robot.terms
    codes, shapes, values, spans, _ = terms
    _presliding(work, at, terms, THETA * step)
    rate = 1.0 / (THETA * step)
    for i in range(n):
        tau = get(work, at.h + i)
        for j in range(n):
            m = get(work, at.M + i * n + j) * rate
            tau += m * (get(work, at.u + j) - get(work, at.v + j))
            put(work, at.H + i * n + j, m)
        put(work, at.load + i, tau)
        armature, kp, kd = drives[i, 0], drives[i, 1], drives[i, 2]
        offset, viscous, coulomb = drives[i, 4], drives[i, 5], drives[i, 6]
        span = THETA * step
        speed, angle = get(work, at.u + i), get(work, at.middle + i)
        s, s_u = direction(speed)
        f = get(work, at.grip + i) + offset + viscous * speed + coulomb * s
        f_u = get(work, at.grip + n + i) + viscous + coulomb * s_u
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
        if at.held >= 0:  # constant until the next tick
            torque, is_on = get(work, at.held + i), wide(0.0)
        else:
            error = read_command(now, i, 0) - get(work, at.q + i) - span * speed
            speed_error, forward = read_command(now, i, 2) - speed, read_command(now, i, 3)
            torque, is_on = loop_torque(drives[i], error, speed_error, forward)
        rest = armature * rate * (speed - get(work, at.v + i)) + f - torque
        slope = armature * rate + f_u + is_on * (kd + span * kp)
        put(work, at.G + i, tau + rest / e)
        put(work, at.H + i * n + i, get(work, at.H + i * n + i) + (slope + tau * e_u) / e)
        put(work, at.by_q + i, f_q)
        put(work, at.gains + i, is_on)
        put(work, at.loss + i, e)


@inner
def _solve(work, at, robot, step, now):
    """Solve a step for its speeds u and leave the factor of H; return whether it converged."""
    if _newton(work, at, robot, step, now, False):
        return True
    # friction that falls faster than inertia allows makes H indefinite and several u possible:
    # steps without this fall lead to the one next to the speed before
    for i in range(at.n):
        put(work, at.u + i, get(work, at.v + i))
    _newton(work, at, robot, step, now, True)
    return _newton(work, at, robot, step, now, False)


@inner
def _add_fall(work, at, terms):
    """Add to H the slopes of friction that falls with speed, so that it is positive definite."""
    codes, shapes, values, spans, _ = terms
    for i in range(at.n):
        for k in range(spans[i, 0], spans[i, 1]):
            if codes[k, 2] == LOADED:
                continue
            speed, angle, diagonal = get(work, at.u + i), get(work, at.middle + i), i * at.n + i
            s, _ = direction(speed)
            _, y_u, _ = term_by_lane(codes, shapes, k, angle, speed, s, wide(0.0))
            fall = where(values[k] * y_u < 0.0, -values[k] * y_u, 0.0) / get(work, at.loss + i)
            put(work, at.H + diagonal, get(work, at.H + diagonal) + fall)


@inner
def _newton(work, at, robot, step, now, is_cautious):
    """Iterate Newton's method for ``_solve``, without falling friction in H if cautious."""
    for k in range(_NEWTON):
        share = 1.0 if k < _NEWTON // 4 else 0.5  # against cycles of several joints' friction
        _balance(work, at, robot, step, now)
        if is_cautious:
            _add_fall(work, at, robot.terms)
        factor(work, at.n, at.H)
        solve(work, at.n, at.H, at.G)
        is_found = True
        for i in range(at.n):
            before = get(work, at.u + i)
            after = before - share * get(work, at.G + i)
            halts = after * before < 0.0  # at speed 0, where friction is nonlinear
            after = where(halts, 0.0, after)
            is_close = abs(after - before) <= ROUNDING * (1.0 + abs(after))
            is_found = is_found and not is_any(halts | ~is_close)
            put(work, at.u + i, after)
        if is_found:  # H changes by rounding only
            return True
    return False


@inner
def _advance(work, at, step):
    """Advance positions and speeds over a solved step."""
    for i in range(at.n):
        speed, before = get(work, at.u + i), get(work, at.v + i)
        put(work, at.q + i, get(work, at.q + i) + step * speed)
        put(work, at.v + i, before + (speed - before) / THETA)


@inner
def _centre(work, at, robot, step, speeds):
    """Write M and h at the midpoint of the step that results from the given speeds."""
    for i in range(at.n):
        ahead = THETA * step * get(work, speeds + i)
        put(work, at.middle + i, get(work, at.q + i) + ahead)
        put(work, at.a + i, 0.0)
        place(work, (i + 1) * BODY, robot.tree.joints[i], at.middle + i, robot.zeros[i])
    inverse_dynamics(work, robot.tree, robot.bodies, speeds, at.a, at.h)
    mass_matrix(work, robot.tree, robot.bodies, at.M)


@inner
def _hold(work, at, columns, drives, now, is_tick):
    """Write the held torques and their sensitivities in lanes whose controllers have a tick."""
    n, P, (kinds, sums, _, factors) = at.n, at.P, columns
    for i in range(n):
        error = read_command(now, i, 0) - get(work, at.q + i)
        speed_error = read_command(now, i, 2) - get(work, at.v + i)
        torque, is_on = loop_torque(drives[i], error, speed_error, read_command(now, i, 3))
        late = by_delay(drives[i], now, i)
        put(work, at.held + i, where(is_tick, torque, get(work, at.held + i)))
        for p in range(P):
            x = drives[i, 1] * get(work, at.S + i * P + p)
            x = x + drives[i, 2] * get(work, at.S + (n + i) * P + p)
            own = wide(0.0)
            for c in range(sums[p], sums[p + 1]):
                if kinds[c, 1] == i:
                    y = by_loop(kinds[c, 0], is_on, error, speed_error, late, torque)
                    own += factors[c] * y
            own = where(is_tick, own - is_on * x, get(work, at.by_hold + i * P + p))
            put(work, at.by_hold + i * P + p, own)


@inner
def _presliding(work, at, terms, span):
    """Write the presliding friction after a time at the speeds u, and its derivative."""
    for i in range(2 * at.n):
        put(work, at.grip + i, 0.0)
    for slot in range(len(terms.bristles)):
        k, i = terms.bristles[slot, 0], terms.bristles[slot, 1]
        before, grip = get(work, at.bristles + 5 * slot), at.grip + i
        z, z_u, _ = deflection_by_lane(terms.shapes[k], before, get(work, at.u + i), span)
        put(work, grip, get(work, grip) + terms.values[k] * z)
        put(work, grip + at.n, get(work, grip + at.n) + terms.values[k] * z_u)


@inner
def _advance_bristles(work, at, terms, span, step):
    """Write z after a step, the z that acts, and d acting / d before, d after / d u, d before."""
    for slot in range(len(terms.bristles)):
        x, speed = terms.shapes[terms.bristles[slot, 0]], get(work, at.u + terms.bristles[slot, 1])
        z = at.bristles + 5 * slot
        before = get(work, z)
        acts, _, share = deflection_by_lane(x, before, speed, span)
        after, by_speed, by_before = deflection_by_lane(x, before, speed, step)
        put(work, z, after)
        put(work, z + 1, acts)
        put3(work, z + 2, (share, by_speed, by_before))


@inner
def _initialise_bristles(work, at, columns, terms):
    """Write the initial z of ``initial_deflection`` and its derivative by the initial speed v."""
    kinds, sums, P = columns.kinds, columns.sums, at.P
    for slot in range(len(terms.bristles)):
        x, i = terms.shapes[terms.bristles[slot, 0]], terms.bristles[slot, 1]
        z, z_v = initial_deflection_by_lane(x, get(work, at.v + i), _MOVED_BEFORE)
        put(work, at.bristles + 5 * slot, z)
        for p in range(P):
            if kinds[sums[p], 0] == SPEED and kinds[sums[p], 1] == i:
                put(work, at.by_state + slot * P + p, z_v)


@inner
def _bristle_column(work, at, terms, p, is_after):
    """Add the effect of bristle states to one column; after the step, advance their columns."""
    for slot in range(len(terms.bristles)):
        k, i = terms.bristles[slot, 0], terms.bristles[slot, 1]
        z, Z = at.bristles + 5 * slot, at.by_state + slot * at.P + p
        x = get(work, Z)
        if is_after:
            x *= get(work, z + 4)
            put(work, Z, x + get(work, z + 3) * get(work, at.change + i))
        else:
            x *= terms.values[k] * get(work, z + 2) / get(work, at.loss + i)
            put(work, at.own + i, get(work, at.own + i) + x)


@inner
def _propagate(work, at, robot, columns, step, now):
    """Advance the sensitivities S of q and v, shape (2n, P), over a solved step."""
    n, P, drives, own = at.n, at.P, robot.drives, at.own
    kinds, sums, directions, factors = columns
    _combine(work, at, drives, step)
    for p in range(P):
        for i in range(n):
            put(work, own + i, 0.0)
        for c in range(sums[p], sums[p + 1]):
            kind, j, index = kinds[c, 0], kinds[c, 1], kinds[c, 2]
            if kind == INERTIAL:
                inertial_column(work, robot.tree, directions[index], j, own)
            elif kind == ZERO:  # like the position, without gain and friction
                for i in range(n):
                    x = get(work, at.T_q + i * n + j)
                    put(work, own + i, get(work, own + i) + x)
                kp = get(work, at.gains + j) * drives[j, 1]
                x = (get(work, at.by_q + j) + kp) / get(work, at.loss + j)
                put(work, own + j, get(work, own + j) - x)
            elif kind != START and kind != SPEED:
                _drive_column(work, at, robot, step, now, kinds[c], factors[c])
        if at.held >= 0:
            for i in range(n):
                x = get(work, at.by_hold + i * P + p) / get(work, at.loss + i)
                put(work, own + i, get(work, own + i) - x)
        _bristle_column(work, at, robot.terms, p, False)
        _advance_column(work, at, step, p)
        _bristle_column(work, at, robot.terms, p, True)


@inner
def _drive_column(work, at, robot, step, now, column, share):
    """Add a share of the derivative of a step's equation by a parameter of a drive."""
    drives, (codes, shapes, _, spans, bristles) = robot.drives, robot.terms
    kind, j, index = column
    span, speed, x = THETA * step, get(work, at.u + j), wide(0.0)
    if kind == ARMATURE:
        x = (speed - get(work, at.v + j)) / span
    elif kind == TERM and codes[index, 2] == BRISTLES:
        for slot in range(len(bristles)):
            if bristles[slot, 0] == index:
                x = get(work, at.bristles + 5 * slot + 1)
    elif kind == TERM and index >= spans[j, 1]:
        x = affine_term(codes, index, speed)
    elif kind == TERM:
        angle, (s, s_u) = get(work, at.middle + j), direction(speed)
        x, _, _ = term_by_lane(codes, shapes, index, angle, speed, s, s_u)
        if codes[index, 2] == LOADED:
            x *= abs(get(work, at.load + j))
    elif at.held < 0:
        error = read_command(now, j, 0) - get(work, at.q + j) - span * speed
        speed_error = read_command(now, j, 2) - speed
        torque, is_on = loop_torque(drives[j], error, speed_error, read_command(now, j, 3))
        late = by_delay(drives[j], now, j)
        x = -by_loop(kind, is_on, error, speed_error, late, torque)
    put(work, at.own + j, get(work, at.own + j) + share * x / get(work, at.loss + j))


@inner
def _combine(work, at, drives, step):
    """Write T_q and T_v of H du = T_v dv - T_q dq - own, each row divided by its e."""
    n, T_q, T_v = at.n, at.T_q, at.T_v
    span, rate = THETA * step, 1.0 / (THETA * step)
    for i in range(n):
        for k in range(i * n, i * n + n):
            m, bent = get(work, at.M + k) * rate, get(work, T_q + k)
            put(work, T_v + k, m - span * bent - get(work, T_v + k))
        armature, kp, d = drives[i, 0], drives[i, 1], i * n + i
        bent, e = get(work, at.by_q + i), get(work, at.loss + i)
        by_speed = (armature * rate - span * bent) / e
        by_position = (bent + get(work, at.gains + i) * kp) / e
        put(work, T_v + d, get(work, T_v + d) + by_speed)
        put(work, T_q + d, get(work, T_q + d) + by_position)


@inner
def _advance_column(work, at, step, p):
    """Advance one sensitivity of position and speed over a step."""
    n, P, S = at.n, at.P, at.S
    for i in range(n):
        moved = -get(work, at.own + i)
        for j in range(n):
            moved += get(work, at.T_v + i * n + j) * get(work, S + (n + j) * P + p)
            moved -= get(work, at.T_q + i * n + j) * get(work, S + j * P + p)
        put(work, at.change + i, moved)
    solve(work, n, at.H, at.change)
    for i in range(n):
        du, dv = get(work, at.change + i), get(work, S + (n + i) * P + p)
        dq = get(work, S + i * P + p) + step * du
        put(work, S + i * P + p, dq)
        put(work, S + (n + i) * P + p, dv + (du - dv) / THETA)


@inner
def _initialise(work, at, robot, columns, start, out_S):
    """Write the initial states of roll-outs and their sensitivities."""
    n, P, kinds, sums = at.n, at.P, columns.kinds, columns.sums
    first = start.reshape(start.size)
    for k in range(3):
        put(work, ACCELERATION + k, -robot.tree.gravity[k])
    for i in range(n):
        put(work, at.q + i, read(first, i * LANES))
        put(work, at.v + i, read(first, (n + i) * LANES))
        put(work, at.u + i, read(first, (n + i) * LANES))
    for p in range(P):
        kind, joint = kinds[sums[p], 0], kinds[sums[p], 1]
        if kind in (START, SPEED):  # of one joint alone
            row = joint + (n if kind == SPEED else 0)
            put(work, at.S + row * P + p, 1.0)
            if row < out_S.shape[1]:
                out_S[0, row, p] = 1.0
    _initialise_bristles(work, at, columns, robot.terms)


@compiled
def roll_out(robot, columns, course, out, work, at, corrects):
    """Simulate a block of lanes; return the first step without a solution, or -1."""
    command, steps, ticks, every, start = course
    out_q, out_v = out.q.reshape(out.q.size), out.v.reshape(out.v.size)
    out_S, rows = out.S.reshape(out.S.size), out.S.shape[1]
    n, P, tree, bodies = at.n, at.P, robot.tree, robot.bodies
    _initialise(work, at, robot, columns, start, out.S)
    commands, starts = command.reshape(command.size), ticks.reshape(ticks.size)
    lengths = steps.reshape(steps.size)
    for k in range(len(steps)):
        step, now = read(lengths, k * LANES), (commands, 6 * n * k)
        if at.held >= 0:
            is_tick = read(starts, k * LANES) > 0.0
            if is_any(is_tick):
                _hold(work, at, columns, robot.drives, now, is_tick)
        for solution in range(2 if corrects else 1):
            _centre(work, at, robot, step, at.u if solution else at.v)
            if not _solve(work, at, robot, step, now):
                return k
        _advance_bristles(work, at, robot.terms, THETA * step, step)
        if P:
            for i in range(n):
                moved = get(work, at.u + i) - get(work, at.v + i)
                put(work, at.a + i, moved / (THETA * step))
            inverse_dynamics(work, tree, bodies, at.v, at.a, at.h)
            derivatives(work, tree, bodies, at.v, at.T_q)  # T_q, followed by T_v
            _propagate(work, at, robot, columns, step, now)
        _advance(work, at, step)
        if (k + 1) % every == 0:
            sample = (k + 1) // every
            for i in range(n):
                write(out_q, (sample * n + i) * LANES, get(work, at.q + i))
                write(out_v, (sample * n + i) * LANES, get(work, at.v + i))
            for row in range(rows * P):
                write(out_S, (sample * rows * P + row) * LANES, get(work, at.S + row))
    return -1


# --- laws of drives: friction, control and averaged commands -------------------------------------


def coded_term(term: DriveTerm) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Return a term for ``term`` and ``deflection``: five codes and eleven numbers.

    Codes: addresses of its laws of speed and position (or 0), kind, counts of their shapes.
    """
    if isinstance(term, Bristles):
        return (0, 0, BRISTLES, 0, 0), (*term.numbers, *[0.0] * 8)
    if isinstance(term, MemorylessTerm):
        a, b = term.speed_shape, term.position_shape
        laws = _address(term.speed_law, len(a)), _address(term.position_law, len(b))
        shapes = *a, *[0.0] * (4 - len(a)), *b, *[0.0] * (4 - len(b))
        return (*laws, term.kind, len(a), len(b)), (*shapes, *term.ranges)
    raise SettingsError(
        f"the term {type(term).__name__} is not possible in a closed-loop simulation: it delays "
        "the measured torque, whereas the simulation delays the commands. Leave the term out, and "
        "set delay in [controller] or leave delay out, so that it is fitted"
    )


def _address(law: Law | None, shapes: int) -> int:
    return 0 if law is None else int(_pointed(law, 1 + shapes).address)


@inner
def _law(address, shapes, z, x0, x1, x2, x3):
    """Return the value of a law of a speed or position with its shape parameters, and its slope."""
    if shapes == 0:
        return applied(address, (z,))
    if shapes == 1:
        return applied(address, (z, x0))
    if shapes == 2:
        return applied(address, (z, x0, x1))
    if shapes == 3:
        return applied(address, (z, x0, x1, x2))
    return applied(address, (z, x0, x1, x2, x3))


@compiled
def term(codes, shapes, k, q, u, s, s_u):
    """Return the regressor of a term but its load, and its derivatives by speed and position."""
    by_speed, by_position, kind = codes[k, 0], codes[k, 1], codes[k, 2]
    x, a, a_u, b, b_q = shapes[k], 1.0, 0.0, 1.0, 0.0
    if by_speed:
        w = min(max(u, -x[8]), x[8])  # constant outside the range of the data
        a, a_u = _law(by_speed, codes[k, 3], w, x[0], x[1], x[2], x[3])
        a_u = a_u if w == u else 0.0
    if by_position:
        p = min(max(q, x[9]), x[10])
        b, b_q = _law(by_position, codes[k, 4], p, x[4], x[5], x[6], x[7])
        b_q = b_q if p == q else 0.0
    if kind == PLAIN:
        return a * b, a_u * b, a * b_q
    return s * a * b, (s_u * a + s * a_u) * b, s * a * b_q


@inner
def term_by_lane(codes, shapes, k, q, u, s, s_u):
    """Return ``term`` of vectors."""
    y, y_u, y_q = wide(0.0), wide(0.0), wide(0.0)
    for lane in range(LANES):
        x, x_u, x_q = term(
            codes, shapes, k,
            lane_of(q, lane), lane_of(u, lane), lane_of(s, lane), lane_of(s_u, lane),
        )  # fmt: skip
        y, y_u, y_q = with_lane(y, lane, x), with_lane(y_u, lane, x_u), with_lane(y_q, lane, x_q)
    return y, y_u, y_q


@inner
def affine_term(codes, k, u):
    """Return the regressor of an affine term: the speed, its direction, or 1."""
    if codes[k, 0]:
        return 1.0 * u
    return wide(1.0) if codes[k, 2] == PLAIN else direction(u)[0]


@compiled
def direction(u, over=_SIGN):
    """Return the direction of friction, which reverses over a small speed, and its derivative."""
    root = math.sqrt(u * u + over * over)
    return u / root, over * over / (root * root * root)


@compiled
def deflection(x, before, u, span):
    """Return the deflection z after a time at speed u, and its derivatives by u and z before."""
    g, g_u, decay = _bristles(x, span * u, u)
    s = 1.0 if u > 0.0 or (u == 0.0 and before < 0.0) else -1.0  # at rest: the stiffer side
    decay_u = -decay * s * span / (x[0] * g) * (1.0 - u * g_u / g)
    z_u = s * g_u * (1.0 - decay) + (before - s * g) * decay_u
    return s * g + (before - s * g) * decay, z_u, decay


@inner
def deflection_by_lane(x, before, u, span):
    """Return ``deflection`` of vectors."""
    z, z_u, decay = wide(0.0), wide(0.0), wide(0.0)
    for lane in range(LANES):
        y, y_u, left = deflection(x, lane_of(before, lane), lane_of(u, lane), lane_of(span, lane))
        z, z_u = with_lane(z, lane, y), with_lane(z_u, lane, y_u)
        decay = with_lane(decay, lane, left)
    return z, z_u, decay


@compiled
def initial_deflection(x, v, time):
    """Return z after a time of motion, at most that of steady sliding, and its derivative by v."""
    g, g_v, _ = _bristles(x, 0.0, v)
    s, s_v = direction(v, x[0] / time)
    return s * g, s_v * g + s * g_v


@inner
def initial_deflection_by_lane(x, v, time):
    """Return ``initial_deflection`` of vectors."""
    z, z_v = wide(0.0), wide(0.0)
    for lane in range(LANES):
        y, y_v = initial_deflection(x, lane_of(v, lane), time)
        z, z_v = with_lane(z, lane, y), with_lane(z_v, lane, y_v)
    return z, z_v


@inner
def loop_torque(drive, error, speed_error, forward):
    """Return the torque that a loop commands, and 1 below its limit, else 0."""
    unlimited, limit = drive[1] * error + drive[2] * speed_error + forward, drive[3]
    is_free = abs(unlimited) < limit
    return where(is_free, unlimited, copysign(limit, unlimited)), where(is_free, 1.0, 0.0)


@inner
def read_command(now, i, kind):
    """Return an input of joint i over a step; ``now`` has all inputs and the step's first."""
    inputs, first = now
    return read(inputs, (first + 6 * i + kind) * LANES)


@inner
def by_delay(drive, now, i):
    """Return the derivative of a loop's torque by the delay of its commands, below its limit."""
    by_position = drive[1] * read_command(now, i, 1)
    return by_position + drive[2] * read_command(now, i, 4) + read_command(now, i, 5)


@inner
def by_loop(kind, is_on, error, speed_error, by_delay, torque):
    """Return the derivative of a loop's torque by a gain, its delay or its limit."""
    if kind == KP:
        return is_on * error
    if kind == KD:
        return is_on * speed_error
    if kind == DELAY:
        return is_on * by_delay
    return (1.0 - is_on) * copysign(1.0, torque) if kind == LIMIT else wide(0.0)


@compiled
def average_command(stamps, values, times, delay, mean, change):
    """Write the mean command over each step, (K,), and its derivative by the delay."""
    last, i = len(stamps) - 1, 0
    start = times[0] - delay
    while i < last and stamps[i + 1] <= start:
        i += 1
    for k in range(len(mean)):
        end, before, at, total = times[k + 1] - delay, values[i], start, 0.0
        while i < last and stamps[i + 1] <= end:
            total += values[i] * (stamps[i + 1] - at) if stamps[i + 1] > at else 0.0
            at = max(at, stamps[i + 1])
            i += 1
        total += values[i] * (end - at)
        mean[k] = total / (end - start)
        change[k] = (before - values[i]) / (end - start)
        start = end


@compiled
def divide_rows(stamps, ticks, times, is_tick, edges, shares):
    """Write the ends of the steps: an equal number in each row, none across a tick."""
    every, i = len(shares), 0
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
        for _ in range(every - count):  # the longest step is divided further
            longest, length = 0, 0.0  # np.argmax and np.diff take three seconds to compile
            for j in range(count):
                step = (edges[j + 1] - edges[j]) / shares[j]
                if step > length:
                    longest, length = j, step
            shares[longest] += 1
        at = k * every
        for j in range(count):
            is_tick[at] = is_tick[at] or j > 0
            for part in range(shares[j]):
                times[at] = edges[j] + (edges[j + 1] - edges[j]) * part / shares[j]
                at += 1
    times[-1] = stamps[-1]
