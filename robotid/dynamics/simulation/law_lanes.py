"""Laws of drives in closed-loop simulations, in Numba: friction, control, and averaged commands.

Imported only for closed-loop simulations. Friction has the laws of the terms of ``drives``,
compiled one by one; the code here calls a law by its address. ``drive`` has armature, kp, kd and
torque limit.
"""

import math
from functools import cache

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.dynamics.kernels.lanes import (
    LANES,
    applied,
    compiled,
    copysign,
    lane_of,
    pointed,
    read,
    where,
    wide,
    with_lane,
)
from robotid.robot.drive_term import BRISTLES, PLAIN, DriveTerm, Law, MemorylessTerm
from robotid.robot.drives import Bristles

_SIGN = 1e-5  # speed over which friction reverses [rad/s or m/s]

# kinds of sensitivities
ARMATURE, KP, KD, LIMIT, TERM, DELAY, ZERO, INERTIAL, START, SPEED = range(10)

_bristles = compiled(Bristles.law)
_pointed = cache(pointed)


def coded_term(term: DriveTerm) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Return a term for ``term`` and ``deflection``: five codes and eleven numbers.

    The codes are the addresses of its laws of speed and position (0 without one), its kind, and the
    number of shape parameters of each law. The numbers are four shape parameters of each law, and
    the ranges.
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


@compiled
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
    """Return the regressor of a term, and its derivatives by speed and position.

    ``s`` and ``s_u`` are of ``direction``; the joint load torque is left out.
    """
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


@compiled
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


@compiled
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


@compiled
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
    """Return the deflection z of a drive that has moved for a time, and its derivative by speed.

    It is that of steady sliding, unless the drive needs more time for its displacement.
    """
    g, g_v, _ = _bristles(x, 0.0, v)
    s, s_v = direction(v, x[0] / time)
    return s * g, s_v * g + s * g_v


@compiled
def initial_deflection_by_lane(x, v, time):
    """Return ``initial_deflection`` of vectors."""
    z, z_v = wide(0.0), wide(0.0)
    for lane in range(LANES):
        y, y_v = initial_deflection(x, lane_of(v, lane), time)
        z, z_v = with_lane(z, lane, y), with_lane(z_v, lane, y_v)
    return z, z_v


@compiled
def loop_torque(drive, error, speed_error, forward):
    """Return the torque that a loop commands, and 1 below its limit, else 0.

    ``error`` and ``speed_error`` are those of position and speed, ``forward`` is the feed-forward
    torque.
    """
    unlimited, limit = drive[1] * error + drive[2] * speed_error + forward, drive[3]
    is_free = abs(unlimited) < limit
    return where(is_free, unlimited, copysign(limit, unlimited)), where(is_free, 1.0, 0.0)


@compiled
def read_command(now, i, kind):
    """Return an input of joint i over a step; ``now`` has all inputs and the step's first."""
    inputs, first = now
    return read(inputs, (first + 6 * i + kind) * LANES)


@compiled
def by_delay(drive, now, i):
    """Return the derivative of a loop's torque by the delay of its commands, below its limit."""
    by_position = drive[1] * read_command(now, i, 1)
    return by_position + drive[2] * read_command(now, i, 4) + read_command(now, i, 5)


@compiled
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
    """Write the mean command over each step, and its derivative by the delay.

    stamps (N,) [s], values (N,), times (K + 1,) [s], change (K,).
    """
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
def divide_rows(stamps, ticks, times, is_tick):
    """Write the ends of the steps: an equal number in each row, and none across a tick.

    Ticks divide a row. The longest steps are divided further, into two, three and so on, until the
    row has the required number.

    stamps (N,) [s], is_tick ((N - 1) every,).
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
