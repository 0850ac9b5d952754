"""Laws of drives in closed-loop simulations, with derivatives, in Numba: friction and control.

Imported only for closed-loop simulations. The laws are those of the terms of ``drives``, compiled
one by one; the code here calls a law by its address.
"""

import math
from functools import cache

from robotid.base.exceptions import SettingsError
from robotid.dynamics.kernels.lanes import applied, compiled, pointed
from robotid.dynamics.kernels.vector_lanes import LANES, copysign, lane_of, where, wide, with_lane
from robotid.robot.drive_term import BRISTLES, PLAIN, DriveTerm, Law, MemorylessTerm
from robotid.robot.drives import Bristles

_SIGN = 1e-5  # speed over which friction reverses [rad/s or m/s]

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
        z, z_u, decay = (
            with_lane(z, lane, y),
            with_lane(z_u, lane, y_u),
            with_lane(decay, lane, left),
        )
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

    ``drive`` has armature, kp, kd and torque limit; ``error`` and ``speed_error`` are the errors of
    position and speed, ``forward`` is the feed-forward torque.
    """
    unlimited, limit = drive[1] * error + drive[2] * speed_error + forward, drive[3]
    is_free = abs(unlimited) < limit
    return where(is_free, unlimited, copysign(limit, unlimited)), where(is_free, 1.0, 0.0)
