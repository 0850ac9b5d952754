"""The direction of Coulomb friction: the sign of the speed, and a transition during stiction."""

from itertools import pairwise

import numpy as np

from robotid.base.typing import Array

_REST = 1e-6  # [rad/s] slower: at rest, because the sign is a rounding error
# Least time of stiction in the band, over the time by the slopes at its edges.
_REVERSAL = 2.0  # a straight line through zero has 1, a cubic that rests there has 3
_RETURN = 4.0  # a parabola from zero to the far edge of the band has 2 to 4


def acting_directions(t: Array, w: Array, band: float, longest: float) -> Array:
    """Return the direction of Coulomb friction at each instant, between -1 and 1, shape (N, c).

    It is the sign of the speed. In stiction, a drive stops abruptly and moves again later: its
    friction balances the applied torque, from one bound to the other, while the filtered speed
    oscillates about zero. There the direction changes linearly in time from the sign before to the
    sign after. A drive was in stiction if it was in the band longer than the slopes at the edges
    of the band indicate: by a factor of two if it reverses, of four if it does not.

    References:
        Karnopp (1985), Computer simulation of stick-slip friction in mechanical dynamic systems.

    t (N,) [s], w (N, c) [rad/s].
    """
    directions = np.where(np.abs(w) < _REST, 0.0, np.sign(w))
    for x, direction in zip(w.T, directions.T, strict=True):
        edges = np.flatnonzero(np.diff(np.abs(x) < band)) + 1
        for i, k in pairwise(edges):
            if abs(x[i]) >= band:  # fast after this edge
                continue
            before, after = np.sign(x[i - 1]), np.sign(x[k])
            enters = _crossing(t[i - 1 : i + 1], x[i - 1 : i + 1], before * band)
            leaves = _crossing(t[k - 1 : k + 1], x[k - 1 : k + 1], after * band)
            slow = leaves[0] - enters[0]
            least = _REVERSAL if before != after else _RETURN
            if least * band * (1 / enters[1] + 1 / leaves[1]) <= slow <= longest:
                share = (t[i:k] - enters[0]) / slow
                direction[i:k] = before + (after - before) * share
    return directions


def _crossing(t: Array, x: Array, level: float) -> tuple[float, float]:
    """Return the time at which x crosses the level between two instants, and its slope."""
    slope = (x[1] - x[0]) / (t[1] - t[0])
    return float(t[0] + (level - x[0]) / slope), float(abs(slope))
