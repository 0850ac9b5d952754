"""What loops are told on average over each step, and where their steps begin, in Numba.

Imported only where a loop is simulated.
"""

import numpy as np

from robotid.regressor.lanes import compiled

__all__ = ["average_command", "divide_rows"]


@compiled
def average_command(stamps, values, times, delay, mean, change):
    """Write what a drive is told on average over each step, and how that changes with the delay.

    Args:
        stamps: When each value is sent, shape (N,) [s]; it holds until the next.
        values: Shape (N,).
        times: Where the steps begin and end, shape (K + 1,) [s].
        delay: How much later it acts [s].
        mean: Shape (K,); written.
        change: Derivative of the mean by the delay, shape (K,); written.
    """
    last, i = len(stamps) - 1, 0
    begin = times[0] - delay
    while i < last and stamps[i + 1] <= begin:
        i += 1
    for k in range(len(mean)):
        end, before, at, total = times[k + 1] - delay, values[i], begin, 0.0
        while i < last and stamps[i + 1] <= end:
            total += values[i] * (stamps[i + 1] - at) if stamps[i + 1] > at else 0.0
            at = max(at, stamps[i + 1])
            i += 1
        total += values[i] * (end - at)
        mean[k] = total / (end - begin)
        change[k] = (before - values[i]) / (end - begin)
        begin = end


@compiled
def divide_rows(stamps, ticks, times, is_tick):
    """Write where steps begin and end, as many from each row to the next, none across a tick.

    Ticks divide a row; the longest steps are halved, then cut in three and so on, until there are
    as many as in other rows.

    Args:
        stamps: Of the rows, shape (N,) [s].
        ticks: Those after the first row, ascending; one at a row is its stamp [s].
        times: Shape ((N - 1) every + 1,); written.
        is_tick: Whether a step begins at a tick, or is the first, shape ((N - 1) every,); written.
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
            shares[np.argmax(np.diff(edges[: count + 1]) / shares[:count])] += 1
        at = k * every
        for j in range(count):
            is_tick[at] = is_tick[at] or j > 0
            for part in range(shares[j]):
                times[at] = edges[j] + (edges[j + 1] - edges[j]) * part / shares[j]
                at += 1
    times[-1] = stamps[-1]
