"""Checks of the measured velocities of a log against the derivatives of its positions."""

from collections.abc import Callable
from functools import wraps
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.typing import Array
from robotid.data.log import Log

#: [s] Largest lag of a measured velocity that "auto" uses.
LARGEST_LAG = 0.02
#: Least number of steps over the range of a channel with sufficient resolution.
COARSE = 100
_FEWEST = 8  # least number of rows of a segment in which a lag is estimated
_LONGEST = 0.3  # [s] largest lag that is tested
_GAP = 5  # [median steps] a longer step is a gap
_SEGMENT = 0.1  # [s] over which the motion is averaged against noise
_UNLIKE = 0.5  # correlation below which a velocity is not the derivative of its position
_MOVED, _SPEED = 1e-3, 0.02  # [rad or m], [rad/s or m/s] smaller values: at rest

FoundT = TypeVar("FoundT")


def _once(check: Callable[[Log], FoundT]) -> Callable[[Log], FoundT]:
    """Keep the result of a check with each log: the doctor and the fit both use it."""
    known: WeakKeyDictionary[Log, FoundT] = WeakKeyDictionary()

    @wraps(check)
    def found(log: Log) -> FoundT:
        if log not in known:
            known[log] = check(log)
        return known[log]

    return found


def is_trustworthy(log: Log, stated: float = 0.0) -> bool:
    """Return whether the measured velocities have a small lag and a sufficient resolution.

    They must also correlate with the derivatives of their positions.
    """
    return is_timely(log, stated) and not coarse_velocities(log) and not unlike_velocities(log)


def is_timely(log: Log, stated: float = 0.0) -> bool:
    """Return whether the measured velocities lag their positions by less than 20 ms."""
    return velocity_lag(log) - stated < LARGEST_LAG


def velocity_lag(log: Log) -> float:
    """Delay of the measured velocities relative to the derivatives of the positions [s]."""
    return velocity_lags(log)[0]


@_once
def velocity_lags(log: Log) -> tuple[float, Array]:
    """Return the delays of measured velocities relative to the derivatives of the positions [s].

    The delay minimises the distance between the measured velocity and the delayed derivative. It is
    found on a uniform grid in segments without gaps and refined by a parabola. It is positive if
    the measured velocity lags, and 0 if the joints are at rest.

    -> (n,).
    """
    v = _measured(log)
    step = float(np.median(np.diff(log.t)))
    q = np.unwrap(log.q, axis=0)
    parts = np.split(np.arange(len(log.t)), np.flatnonzero(np.diff(log.t) > _GAP * step) + 1)
    longest = min(int(_LONGEST / step) + 1, max(map(len, parts)) // 4)
    shifts = np.arange(-longest, longest + 1)
    total = np.zeros((len(log.joints), len(shifts)))
    for part in (rows for rows in parts if len(rows) >= max(4 * longest, _FEWEST)):
        t = log.t[part]
        grid = np.arange(t[0], t[-1], step)
        for own, x, measured in zip(total, q[part].T, v[part].T, strict=True):
            slope = np.gradient(np.interp(grid, t, x), step)
            own += len(grid) * _distances(slope, np.interp(grid, t, measured), longest)

    def delay(total: Array) -> float:
        best = int(np.argmin(total))
        if not 0 < best < len(shifts) - 1:
            return 0.0
        left, middle, right = total[best - 1 : best + 2]
        curvature = left - 2 * middle + right
        fraction = 0.5 * (left - right) / curvature if curvature > 0 else 0.0
        return float((shifts[best] + fraction) * step)

    single = [delay(own) if x.any() else 0.0 for own, x in zip(total, v.T, strict=True)]
    return delay(total.sum(axis=0)) if v.any() else 0.0, np.array(single)


@_once
def coarse_velocities(log: Log) -> tuple[str, ...]:
    """Return the joints whose measured velocity is coarsely quantised, as from an encoder."""
    return tuple(
        joint
        for joint, x in zip(log.joints, _measured(log).T, strict=True)
        if 0 < np.ptp(x) < COARSE * quantum(x)
    )


@_once
def unlike_velocities(log: Log) -> dict[str, float]:
    """Joints whose measured velocity is not the derivative of their position at any lag."""
    v, dt = _measured(log), np.diff(log.t)[:, None]
    median = float(np.median(dt))
    is_regular = dt < _GAP * median
    length = int(np.clip(round(_SEGMENT / median), 1, max(1, len(dt) // 4)))
    moved = _means(np.where(is_regular, np.diff(np.unwrap(log.q, axis=0), axis=0), 0.0), length)
    integral = _means(np.where(is_regular, dt * (v[1:] + v[:-1]) / 2, 0.0), length)
    last = min(round(_LONGEST / median), len(moved) // 2)
    shifts = [k for k in range(-last, last + 1, max(length // 2, 1)) if abs(k) < len(moved) // 2]
    found = {}
    for j, joint in enumerate(log.joints):
        speed = float(np.sqrt(np.mean(moved[:, j] ** 2))) / median
        if np.ptp(log.q[:, j]) < _MOVED or speed < _SPEED or np.ptp(v[:, j]) == 0:
            continue
        largest = max(_correlation(moved[:, j], integral[:, j], k) for k in [0, *shifts])
        if largest < _UNLIKE:
            found[joint] = largest
    return found


def quantum(x: Array, *, repeats: bool = True) -> float:
    """Return the quantisation step of a channel, 0 if it is not quantised: x (N,)."""
    levels = np.unique(x)
    if len(levels) < 3 or (repeats and len(levels) > 0.5 * len(x)):
        return 0.0
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * np.ptp(x)]
    if len(steps) == 0:
        return 0.0
    smallest = float(np.quantile(steps, 0.1))
    counts = np.diff(levels)[:1000] / smallest
    return smallest if np.mean(np.abs(counts - np.round(counts)) < 0.02) > 0.95 else 0.0


def _measured(log: Log) -> Array:
    if log.v is None:
        raise DataError(f"{log.path or 'log'} has no measured velocity")
    return log.v


def _means(steps: Array, length: int) -> Array:
    """Return the means over each segment of ``length`` consecutive rows."""
    total = np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])
    means: Array = (total[length:] - total[:-length]) / length
    return means


def _correlation(moved: Array, integral: Array, shift: int) -> float:
    """Return the absolute correlation of one signal with the other shifted by some rows."""
    n = len(moved)
    a = moved[max(-shift, 0) : n - max(shift, 0)]
    b = integral[max(shift, 0) : n + min(shift, 0)]  # not centred: the speed may be constant
    size = float(np.sqrt((a @ a) * (b @ b)))
    return abs(float(a @ b)) / size if size > 0 else 0.0


def _distances(slope: Array, v: Array, longest: int) -> Array:
    """Return the mean squares of v - slope delayed by -longest to longest samples."""
    n, size = len(v), 1 << (len(v) + longest).bit_length()  # of the transform, without overlap
    spectrum = np.fft.rfft(v, size) * np.fft.rfft(slope, size).conj()
    products = np.fft.irfft(spectrum, size)[np.arange(-longest, longest + 1)]
    of_v, of_slope = (np.append(0.0, np.cumsum(x**2)) for x in (v, slope))  # of the first rows
    k = np.arange(longest + 1)
    lag = of_v[n] - of_v[k] + of_slope[n - k]  # squares of the rows compared at a lag of k
    lead = of_v[n - k] + of_slope[n] - of_slope[k]
    squares = np.concatenate([lead[:0:-1], lag])
    distances: Array = (squares - 2 * products) / (n - np.abs(np.arange(-longest, longest + 1)))
    return distances
