"""Commands averaged over each step, and the division of rows into steps, in Numba.

Imported only for closed-loop simulations.
"""

import numpy as np

from robotid.dynamics.kernels.lanes import compiled


@compiled
def average_command(stamps, values, times, delay, mean, change):
    """Write the mean command over each step, and its derivative by the delay.

    stamps (N,) [s], values (N,), times (K + 1,) [s], change (K,).
    """
    last, i = len(stamps) - 1, 0
    start = times[0] - delay
    while i < last and stamps[i + 1] <= start:
        i += 1
    for k in range(len(mean)):
        end, before, at, total = times[k + 1] - delay, values[i], start, 0.0
        while i < last and stamps[i + 1] <= end:
            total += values[i] * (stamps[i + 1] - at) if stamps[i + 1] > at else 0.0
            at = max(at, stamps[i + 1])
            i += 1
        total += values[i] * (end - at)
        mean[k] = total / (end - start)
        change[k] = (before - values[i]) / (end - start)
        start = end


@compiled
def divide_rows(stamps, ticks, times, is_tick):
    """Write the ends of the steps: an equal number in each row, and none across a tick.

    Ticks divide a row. The longest steps are divided further, into two, three and so on, until the
    row has the required number.

    stamps (N,) [s], is_tick ((N - 1) every,).
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
            longest, length = 0, 0.0  # np.argmax and np.diff take three seconds to compile
            for j in range(count):
                step = (edges[j + 1] - edges[j]) / shares[j]
                if step > length:
                    longest, length = j, step
            shares[longest] += 1
        at = k * every
        for j in range(count):
            is_tick[at] = is_tick[at] or j > 0
            for part in range(shares[j]):
                times[at] = edges[j] + (edges[j + 1] - edges[j]) * part / shares[j]
                at += 1
    times[-1] = stamps[-1]
