"""Segments of a motion with unexplained torque: contacts, loads, faults."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robotid.base.typing import Array

_WINDOW = 0.2  # [s] averaging window of a residual
_TIMES = 6.0  # unexplained: a mean residual above this multiple of its median ...
_SHARE = 0.3  # ... and above this share of the joint's torque
_APART = 1.0  # [s] closer segments are merged
_SHORTEST = 0.05  # [s] shorter segments are spikes


@dataclass(frozen=True)
class Unexplained:
    """A segment of unexplained torque."""

    start: float  # its start [s]
    end: float  # its end [s]
    joint: str  # the joint with the largest residual relative to its torque
    residual: float  # largest mean residual of that joint [N m or N]


def find_unexplained(
    t: Array, tau: Array, predicted: Array, joints: Sequence[str]
) -> tuple[Unexplained, ...]:
    """Return the segments with an exceptional difference of measured and predicted torque.

    The RMS residual of a joint over 0.2 s is unexplained if it is above six times its median over
    the motion and above 0.3 of the RMS torque, for 0.05 s or longer.

    t (N,) [s], tau (N, n) [N m or N], predicted (N, n).
    """
    if len(t) < 2:
        return ()
    width = max(1, round(_WINDOW / float(np.median(np.diff(t)))))
    square = (tau - predicted) ** 2
    level = np.sqrt(_running_mean(square, width))  # (N, n)
    known = np.isfinite(level)
    columns = zip(level.T, known.T, strict=True)
    median = np.array([np.median(x[k]) if k.any() else np.inf for x, k in columns])
    size = np.sqrt(np.mean(tau**2, axis=0))
    share = np.where(known, level, 0.0) / np.maximum(size, 1e-12)
    is_large = known & (level > _TIMES * median) & (share > _SHARE)
    rows = np.flatnonzero(is_large.any(axis=1))
    if not len(rows):
        return ()
    found = []
    for part in np.split(rows, np.flatnonzero(np.diff(t[rows]) > _APART) + 1):
        start, end = float(t[part[0]]), float(t[part[-1]])
        if end - start < _SHORTEST:
            continue
        k, j = divmod(int(np.argmax(np.where(is_large, share, 0.0)[part])), len(joints))
        found.append(Unexplained(start, end, joints[j], float(level[part[k], j])))
    return tuple(found)


def residual_levels(edges: Array, t: Array, residual: Array) -> Array:
    """Return the RMS residual of each joint in each segment of time.

    edges (B + 1,) [s], t (N,) [s], residual (N, n) -> (B, n).
    """
    bins = len(edges) - 1
    which = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, bins - 1)
    samples = np.bincount(which, minlength=bins)
    levels = np.full((bins, residual.shape[1]), np.nan)
    for j, known in enumerate(np.isfinite(residual).T):
        count = np.bincount(which[known], minlength=bins)
        square = np.bincount(which[known], residual[known, j] ** 2, minlength=bins)
        levels[:, j] = np.where(samples > 0, -1.0, np.nan)
        levels[count > 0, j] = np.sqrt(square[count > 0] / count[count > 0])
    return levels


def _running_mean(values: Array, width: int) -> Array:
    """Return the running mean without NaN; NaN if half of a window is NaN."""
    known = np.isfinite(values)
    sums = np.cumsum(np.vstack([np.zeros(values.shape[1]), np.where(known, values, 0.0)]), axis=0)
    counts = np.cumsum(np.vstack([np.zeros(values.shape[1]), known]), axis=0)
    rows = np.arange(len(values))
    low, high = np.maximum(rows - width // 2, 0), np.minimum(rows + width // 2 + 1, len(values))
    count = counts[high] - counts[low]
    enough = count > width / 2
    mean: Array = np.where(enough, (sums[high] - sums[low]) / np.maximum(count, 1), np.nan)
    return mean
