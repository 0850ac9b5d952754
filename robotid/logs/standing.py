"""A log as a static model sees it: where the robot stands, and where it moves slowly."""

from itertools import pairwise

import numpy as np

from robotid._typing import Array
from robotid.logs.data import Log, Trajectory

__all__ = ["standing_motion"]

_LENGTH = 0.25  # [s] of a segment whose rows become one sample


def standing_motion(
    log: Log, max_gap: float, least: Array, fastest: Array, hardest: Array
) -> tuple[Trajectory, Array]:
    """Return the means of a log over short segments, and which of them are stands.

    A segment is a quarter of a second, or a row if rows are farther apart. Segments in which a
    joint is too fast, or has just been or is about to be, are left out. Those in which no joint
    moves are joined: a stand is one sample, however long it is. No filter, no derivative of noise:
    the speed is the slope of the positions over the segment, and of a single row 0.

    Args:
        log: The log, without full turns.
        max_gap: A longer step between two rows is a gap, which ends a segment [s].
        least: Speeds below which joints stand, shape (n,) [rad/s or m/s].
        fastest: Speeds above which they are too fast, shape (n,).
        hardest: Likewise of changes of speed, shape (n,) [rad/s^2 or m/s^2].

    Returns:
        K samples with their speeds, 0 at stands and where a joint sets out, stops or turns round,
        without accelerations; and which are stands, shape (K,), bool. The segments are the
        segments between gaps.
    """
    of_block, segment = _blocks(log.t, max_gap)
    first = np.flatnonzero(np.diff(of_block, prepend=-1))
    count = np.diff(np.append(first, len(log.t)))
    t, q, tau = (_means(x, first, count) for x in (log.t, log.q, log.tau))
    dt, dq = log.t - t[of_block], log.q - q[of_block]
    square = np.add.reduceat(dt**2, first)[:, None]
    v = np.add.reduceat(dt[:, None] * dq, first) / np.where(square > 0, square, np.inf)
    # of few rows the slope is noise: what counts is how far they go
    length = log.t[first + count - 1] - log.t[first]
    v = v * np.minimum(1.0, 2 * length / _LENGTH)[:, None]
    beside = np.diff(segment) == 0
    change = np.zeros_like(v)
    steps = np.abs(np.diff(v, axis=0)) / np.diff(t)[:, None] * beside[:, None]
    np.maximum(change[1:], steps, out=change[1:])
    np.maximum(change[:-1], steps, out=change[:-1])
    slow = np.all((np.abs(v) <= fastest) & (change <= hardest), axis=1)
    signs = np.where(np.abs(v) < least, 0.0, np.sign(v))
    still = slow & ~signs.any(axis=1)
    # beside a segment of another sign a joint may have turned round within this one
    turns = (np.diff(signs, axis=0) != 0) & beside[:, None]
    v[1:][turns] = v[:-1][turns] = 0.0
    alike = (np.abs(np.diff(q, axis=0)) < least * np.diff(t)[:, None]).all(axis=1)
    joined = np.append(False, still[1:] & still[:-1] & beside & alike)[slow]
    begins, weight = np.flatnonzero(~joined), count[slow]
    total = np.add.reduceat(weight, begins) if len(begins) else weight
    t, q, tau = (
        _means((x[slow].T * weight).T, begins, total) if len(begins) else x[:0] for x in (t, q, tau)
    )
    v, stands = v[slow][begins], still[slow][begins]
    v[stands] = 0.0
    motion = Trajectory(
        t=t, q=q, v=v, a=np.zeros_like(v), tau=tau, joints=log.joints, rate=None,
        segment=segment[slow][begins],
    )  # fmt: skip
    return motion, stands


def _blocks(t: Array, max_gap: float) -> tuple[Array, Array]:
    """Return the short segment that each row is in, and the number between gaps of each."""
    of_block, segment, number = np.empty(len(t), dtype=int), list[int](), 0
    edges = [0, *(np.flatnonzero(np.diff(t) > max_gap) + 1).tolist(), len(t)]
    for k, (i, j) in enumerate(pairwise(edges)):
        blocks = max(1, round((t[j - 1] - t[i]) / _LENGTH))
        length = (t[j - 1] - t[i]) / blocks or 1.0
        own = np.minimum((t[i:j] - t[i]) // length, blocks - 1)
        own = np.cumsum(np.diff(own, prepend=own[0]) > 0)  # those without a row are none
        of_block[i:j] = own + number
        number += int(own[-1]) + 1
        segment += [k] * (int(own[-1]) + 1)
    return of_block, np.array(segment)


def _means(values: Array, first: Array, total: Array) -> Array:
    """Return sums of the rows from each first one on, over their totals."""
    means: Array = (np.add.reduceat(values, first).T / total).T
    return means
