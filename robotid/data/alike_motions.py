"""Motions that repeat one another: the same positions at instants and up to a second after."""

from collections.abc import Sequence

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import Trajectory

#: Share of the instants of a motion in another one, from which it repeats that.
REPEATED = 0.3
_AHEAD = (0.0, 0.25, 0.5, 0.75, 1.0)  # [s] after an instant, positions that are compared
_NEAR = 0.02  # of the range of each joint: closer positions are equal
_INSTANTS = 300
_FEW = 60  # ... of each of many motions


def repeated_share(fitted: Sequence[Trajectory], validation: Trajectory) -> float:
    """Return the largest share of a motion that is in one of others."""
    from scipy.spatial import cKDTree

    size = np.maximum(np.ptp(validation.q, axis=0), 1e-3)
    instants = _segments(validation, size, _INSTANTS)
    share = 0.0
    for known in [_segments(motion, size, None) for motion in fitted if len(instants)]:
        if len(known):
            distance, _ = cKDTree(known).query(instants, p=np.inf, distance_upper_bound=_NEAR)
            share = max(share, float(np.mean(np.isfinite(distance))))
    return share


def alike_motions(motions: Sequence[Trajectory]) -> list[list[int]]:
    """Return the motions in groups: one that repeats another one is in its group."""
    from scipy.spatial import cKDTree

    low, high = (np.array([f(x.q, axis=0) for x in motions]) for f in (np.min, np.max))
    size = np.maximum(high.max(axis=0) - low.min(axis=0), 1e-3)
    trees = [cKDTree(known) if len(known := _segments(x, size, None)) else None for x in motions]
    groups: list[list[int]] = []
    for k, motion in enumerate(motions):
        own, same = _segments(motion, size, _FEW), list[list[int]]()
        for group in groups if len(own) else ():
            others = [tree for j in group if (tree := trees[j]) is not None]
            far = [x.query(own, p=np.inf, distance_upper_bound=_NEAR)[0] for x in others]
            if any(np.mean(np.isfinite(distance)) >= REPEATED for distance in far):
                same.append(group)
        groups = [group for group in groups if group not in same]
        groups.append([*(j for group in same for j in group), k])
    return sorted(sorted(group) for group in groups)


def _segments(motion: Trajectory, size: Array, count: int | None) -> Array:
    """Return positions at instants and up to a second after, over the size, where joints move."""
    step = float(np.median(np.diff(motion.t)))
    ahead = [round(s / step) for s in _AHEAD]
    last = len(motion.t) - ahead[-1]
    if last <= 0:
        return np.empty((0, len(_AHEAD) * len(size)))
    starts = np.arange(last)
    whole = motion.segment[starts] == motion.segment[starts + ahead[-1]]
    moved = np.abs(motion.q[starts + ahead[-1]] - motion.q[starts]) / size
    starts = starts[whole & (moved.max(axis=1) > 2 * _NEAR)]
    if count is not None and len(starts) > count:
        starts = starts[np.linspace(0, len(starts) - 1, count).astype(int)]
    else:
        # instants so close that fast motion moves less than the bound between two of them
        starts = starts[:: max(1, round(0.005 / step))]
    return np.hstack([motion.q[starts + k] / size for k in ahead])
