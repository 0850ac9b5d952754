"""Laws of drives for roll-outs, with their derivatives, in Numba: friction, and position control.

Imported only where a loop is simulated. The laws are those of the terms of ``drives``, compiled
one by one: what is compiled here calls a law by its address.
"""

import math
from functools import cache

from robotid.exceptions import SettingsError
from robotid.regressor.lanes import applied, compiled, pointed
from robotid.robot.drive_term import BRISTLES, PLAIN, DriveTerm, Law, MemorylessTerm
from robotid.robot.drives import Bristles

__all__ = ["coded_term", "deflection", "loop_torque", "slid", "term", "turned"]

_SIGN = 1e-5  # [rad/s or m/s]: the speed over which friction turns

_bristles = compiled(Bristles.law)
_pointed = cache(pointed)


def coded_term(term: DriveTerm) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Return what ``term`` and ``deflection`` take of a term: its codes, five, and numbers, eleven.

    Codes are the addresses of its laws of speed and position, 0 of none, its kind, and how many
    numbers shape the one and the other. Numbers are four of each, and the ranges.

    Args:
        term: The term.

    Raises:
        SettingsError: If roll-outs have no such term.
    """
    if isinstance(term, Bristles):
        return (0, 0, BRISTLES, 0, 0), (*term.numbers, *[0.0] * 8)
    if isinstance(term, MemorylessTerm):
        a, b = term.speed_shape, term.position_shape
        laws = _address(term.speed_law, len(a)), _address(term.position_law, len(b))
        shapes = *a, *[0.0] * (4 - len(a)), *b, *[0.0] * (4 - len(b))
        return (*laws, term.kind, len(a), len(b)), (*shapes, *term.ranges)
    raise SettingsError(
        f"the term {type(term).__name__} has no place in roll-outs: it delays the measured torque, "
        "and in a roll-out the commands are late; leave it out, and set delay in [controller] or "
        "have it identified"
    )


def _address(law: Law | None, shapes: int) -> int:
    return 0 if law is None else int(_pointed(law, 1 + shapes).address)


@compiled
def _law(address, shapes, z, x0, x1, x2, x3):
    """Return a law of a speed or position and of as many numbers as shape it, and its slope."""
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
    """Return what a term's parameter multiplies, and its derivatives by speed and position.

    ``s`` and ``s_u`` are of ``turned``; the load of the gear is left out.
    """
    by_speed, by_position, kind = codes[k, 0], codes[k, 1], codes[k, 2]
    x, a, a_u, b, b_q = shapes[k], 1.0, 0.0, 1.0, 0.0
    if by_speed:
        w = min(max(u, -x[8]), x[8])  # beyond what was seen it stays as it is
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
def turned(u, over=_SIGN):
    """Return the direction of friction, which turns over a speed, and its derivative."""
    root = math.sqrt(u * u + over * over)
    return u / root, over * over / (root * root * root)


@compiled
def deflection(x, before, u, span):
    """Return z after a time at the speed u, and its derivatives by u and by z before."""
    g, g_u, kept = _bristles(x, span * u, u)
    s = 1.0 if u > 0.0 or (u == 0.0 and before < 0.0) else -1.0  # at rest, of the stiffer side
    kept_u = -kept * s * span / (x[0] * g) * (1.0 - u * g_u / g)
    z_u = s * g_u * (1.0 - kept) + (before - s * g) * kept_u
    return s * g + (before - s * g) * kept, z_u, kept


@compiled
def slid(x, v, time):
    """Return z of a drive that has moved for a time, and its derivative by the speed v.

    It is that of long sliding, but of one that takes longer to go its way.
    """
    g, g_v, _ = _bristles(x, 0.0, v)
    s, s_v = turned(v, x[0] / time)
    return s * g, s_v * g + s * g_v


@compiled
def loop_torque(drive, reach, slip, forward):
    """Return the torque that a loop commands, and 1 where its limit leaves it free, else 0.

    ``drive`` holds armature, kp, kd and largest torque; ``reach`` and ``slip`` are the errors of
    position and speed, ``forward`` is the torque commanded beside them.
    """
    asked, limit = drive[1] * reach + drive[2] * slip + forward, drive[3]
    is_free = abs(asked) < limit
    return asked if is_free else math.copysign(limit, asked), 1.0 if is_free else 0.0
