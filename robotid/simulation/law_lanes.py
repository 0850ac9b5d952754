"""Laws of drives for roll-outs, with their derivatives, in Numba: friction, and position control.

Imported only where the extra ``fast`` is installed. ``drives`` states what the terms mean.
"""

import math

from robotid.regressor.lanes import compiled

__all__ = ["BRISTLES", "LOAD", "loop_torque", "taken_up", "term"]

LOAD = 9  # code of the term that multiplies the load of the gear
BRISTLES = 10  # code of terms that are taken up over a way
_SIGN = 1e-5  # [rad/s or m/s]: the speed over which friction turns


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
def loop_torque(drive, reach, slip, forward):
    """Return the torque that a loop commands, and 1 where its limit leaves it free, else 0.

    ``drive`` holds armature, kp, kd and largest torque; ``reach`` and ``slip`` are the errors of
    position and speed, ``forward`` is the torque commanded beside them.
    """
    asked, limit = drive[1] * reach + drive[2] * slip + forward, drive[3]
    is_free = abs(asked) < limit
    return asked if is_free else math.copysign(limit, asked), 1.0 if is_free else 0.0
