"""The slow part of a log, for a static model: poses at rest and slow motion."""

from itertools import pairwise

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory

_LENGTH = 0.25  # [s] of a block whose rows become one sample


def standing_motion(
    log: Log, max_gap: float, least: Array, fastest: Array, hardest: Array
) -> tuple[Trajectory, Array]:
    """Return the means of a log over short blocks, and which of them are at rest.

    A block is a quarter of a second, or a row if the time steps are longer. Blocks in which a joint
    is too fast, or is accelerated or decelerated too much, are left out. Consecutive blocks at rest
    are joined: each pose at rest is one sample. There is no filter and no derivative: the speed is
    the slope of the positions over the block, and 0 for a single row.

    least (n,) [rad/s or m/s], fastest (n,), hardest (n,) [rad/s^2 or m/s^2] -> (K,).
    """
    of_block, segment = _blocks(log.t, max_gap)
    first = np.flatnonzero(np.diff(of_block, prepend=-1))
    count = np.diff(np.append(first, len(log.t)))
    t, q, tau = (_means(x, first, count) for x in (log.t, log.q, log.tau))
    dt, dq = log.t - t[of_block], log.q - q[of_block]
    square = np.add.reduceat(dt**2, first)[:, None]
    v = np.add.reduceat(dt[:, None] * dq, first) / np.where(square > 0, square, np.inf)
    # the slope of a short block is noise: it is reduced with the duration
    length = log.t[first + count - 1] - log.t[first]
    v = v * np.minimum(1.0, 2 * length / _LENGTH)[:, None]
    is_adjacent = np.diff(segment) == 0
    change = np.zeros_like(v)
    steps = np.abs(np.diff(v, axis=0)) / np.diff(t)[:, None] * is_adjacent[:, None]
    np.maximum(change[1:], steps, out=change[1:])
    np.maximum(change[:-1], steps, out=change[:-1])
    slow = np.all((np.abs(v) <= fastest) & (change <= hardest), axis=1)
    signs = np.where(np.abs(v) < least, 0.0, np.sign(v))
    still = slow & ~signs.any(axis=1)
    # next to a block of another sign, a joint may have reversed within this block
    is_reversal = (np.diff(signs, axis=0) != 0) & is_adjacent[:, None]
    v[1:][is_reversal] = v[:-1][is_reversal] = 0.0
    is_same_pose = (np.abs(np.diff(q, axis=0)) < least * np.diff(t)[:, None]).all(axis=1)
    joined = np.append(False, still[1:] & still[:-1] & is_adjacent & is_same_pose)[slow]
    starts, weight = np.flatnonzero(~joined), count[slow]
    total = np.add.reduceat(weight, starts) if len(starts) else weight
    t, q, tau = (
        _means((x[slow].T * weight).T, starts, total) if len(starts) else x[:0] for x in (t, q, tau)
    )
    v, resting = v[slow][starts], still[slow][starts]
    v[resting] = 0.0
    motion = Trajectory(
        t=t, q=q, v=v, a=np.zeros_like(v), tau=tau, joints=log.joints, rate=None,
        segment=segment[slow][starts],
    )  # fmt: skip
    return motion, resting


def _blocks(t: Array, max_gap: float) -> tuple[Array, Array]:
    """Return the block of each row, and the segment between gaps of each block."""
    of_block, segment, number = np.empty(len(t), dtype=int), list[int](), 0
    edges = [0, *(np.flatnonzero(np.diff(t) > max_gap) + 1).tolist(), len(t)]
    for k, (i, j) in enumerate(pairwise(edges)):
        blocks = max(1, round((t[j - 1] - t[i]) / _LENGTH))
        length = (t[j - 1] - t[i]) / blocks or 1.0
        own = np.minimum((t[i:j] - t[i]) // length, blocks - 1)
        own = np.cumsum(np.diff(own, prepend=own[0]) > 0)  # without empty blocks
        of_block[i:j] = own + number
        number += int(own[-1]) + 1
        segment += [k] * (int(own[-1]) + 1)
    return of_block, np.array(segment)


def _means(values: Array, first: Array, total: Array) -> Array:
    """Return sums of the rows of each block, over the totals."""
    means: Array = (np.add.reduceat(values, first).T / total).T
    return means
