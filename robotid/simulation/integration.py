"""The classical Runge-Kutta method, for every plant of the package."""

from collections.abc import Callable

from robotid._typing import Array

__all__ = ["rk4"]


def rk4(
    acceleration: Callable[[Array, Array, float], Array],
    q: Array,
    v: Array,
    h: float | Array,
    a: Array | None = None,
) -> tuple[Array, Array]:
    """Return positions and velocities one step later, by Runge-Kutta of order 4.

    Args:
        acceleration: Acceleration of a state q, v at a share of the step, 0, 0.5 or 1.
        q: Positions, any shape [rad or m].
        v: Velocities, shape as q.
        h: Length of the step, a number or a shape that multiplies q [s].
        a: Accelerations at the start of the step, where they are known.

    Returns:
        q and v.
    """
    a1 = acceleration(q, v, 0.0) if a is None else a
    v2 = v + h / 2 * a1
    a2 = acceleration(q + h / 2 * v, v2, 0.5)
    v3 = v + h / 2 * a2
    a3 = acceleration(q + h / 2 * v2, v3, 0.5)
    v4 = v + h * a3
    a4 = acceleration(q + h * v3, v4, 1.0)
    return q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
