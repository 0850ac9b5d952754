"""The lead of a joint: the time by which it moves before its logged command."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robotid.base.typing import Array

_WINDOW = 1.25  # [s] length of the windows whose scatter gives the standard error
_FEWEST = 3  # windows
_PART = 10.0  # [s] least length of a part that is tested by itself
_LARGEST = 0.5  # [s] largest lead, or lag
_STEP = 0.01  # [s] of the grid of lags
_FALSE = 1e-3  # probability of a false finding in a log, over all joints and parts
_SHARE = 0.2  # least reduction of the squared residual by the lead
_TINY = 1e-9  # least change of a command, relative to its largest value; less is rounding
_ROUNDS = 5  # largest number of Gauss-Newton steps
_ORDER = 2  # of the low-pass filter
_ABOVE = 0.4  # share of the sampling rate from which a bandwidth needs no filter


@dataclass(frozen=True)
class Lead:
    """The lead of a joint before its command.

    Attributes:
        lead: The lead [s].
        std_error: Its standard error, from the scatter of windows [s].
        start: Start of the part of the log that has it [rows].
        stop: Its end [rows].
    """

    lead: float
    std_error: float
    start: int
    stop: int


def find_lead(
    command: Array, q: Array, step: float, bandwidth: float, joints: int = 1
) -> Lead | None:
    """Return the lead of a joint in a log, or in the part of it where it is most significant.

    q(t) = g q_ref(t - T) + offset and drift of each window; T is negative for a lead. Model errors
    and correlated residuals are the same in neighbouring rows but not in all windows, so the
    standard error of T comes from the scores of the windows, and its quantile from Student's t. The
    log, its halves, quarters and so on are tested; the probability of a false finding is divided by
    the number of these tests and of the joints. A lead must also reduce the squared residual by a
    fifth: one that explains nothing of the position error is a model error.

    command (N,), q (N,).
    """
    from scipy.stats import t as student

    found: list[tuple[float, Lead]] = []
    command, q = (_smooth(x, step, bandwidth) for x in (command, q))
    parts = list(_parts(len(q), step))
    for part in parts:
        fitted = _fit(command[part], q[part], step)
        if fitted is None:
            continue
        lag, error, freedom, share = fitted
        least = student.isf(_FALSE / (joints * len(parts)), freedom) * error
        if lag < -max(least, step / 2) and share > _SHARE:
            found.append((least / -lag, Lead(-lag, error, part.start, part.stop)))
    return min(found, key=lambda each: each[0])[1] if found else None


def _smooth(x: Array, step: float, bandwidth: float) -> Array:
    """Return a signal up to the bandwidth of the loop; the filter has no phase."""
    from scipy.signal import butter, sosfiltfilt

    if not bandwidth * step < _ABOVE:
        return x
    smooth: Array = sosfiltfilt(butter(_ORDER, bandwidth, fs=1 / step, output="sos"), x)
    return smooth


def _parts(n: int, step: float) -> Iterator[slice]:
    """Yield the whole log, its halves, quarters and so on, as long as they are long enough."""
    count = 1
    while count == 1 or n * step / count >= _PART:
        edges = np.linspace(0, n, count + 1).astype(int).tolist()
        yield from (slice(*edges[k : k + 2]) for k in range(count))
        count *= 2


def _fit(command: Array, q: Array, step: float) -> tuple[float, float, float, float] | None:
    """Return lag and standard error [s], degrees of freedom, and what a lead explains.

    The last is 1 - |residual|^2 / |residual of the best lag that is not negative|^2. None if the
    command does not determine a lag.
    """
    most, length = round(_LARGEST / step), max(4, round(_WINDOW / step))
    windows = (len(q) - 2 * most) // length
    if windows < _FEWEST:
        return None
    start, stop = most, most + windows * length
    drift = np.linspace(-1.0, 1.0, length)
    trends = np.stack([np.full(length, length**-0.5), drift / np.sqrt(drift @ drift)])

    def delayed(signal: Array, lag: int) -> Array:
        """Return a delayed signal without offset and drift, shape (windows, length)."""
        x: Array = signal[start - lag : stop - lag].reshape(windows, length)
        x = x - (x @ trends.T) @ trends
        return x

    y, speed = delayed(q, 0), np.gradient(command, step)
    later = np.arange(0, most + 1, max(1, round(_STEP / step)))
    lags = np.concatenate([-later[:0:-1], later])
    squares = np.array([_residual(delayed(command, k), y)[1] for k in lags.tolist()])
    lag, rest = int(lags[np.argmin(squares)]), 0.0
    for _ in range(_ROUNDS):
        lag += round(rest / step)
        if abs(lag) >= most:
            return None
        x, v = delayed(command, lag), delayed(speed, lag)
        g, _ = _residual(x, y)
        if g == 0 or np.abs(x).max() < _TINY * np.abs(command).max():
            return None
        v = v - x * np.sum(x * v) / np.sum(x * x)
        e, information = y - g * x, np.sum(v * v, axis=1)
        total = float(information.sum())
        freedom = 1 / float(np.sum((information / total) ** 2)) - 1 if total else 0.0
        if freedom < 1:
            return None
        rest = -float(np.sum(e * v)) / (g * total)  # de/dT = g v
    e = e + g * v * rest
    scores = np.sum(e * v, axis=1)
    error = float(np.sqrt(windows / (windows - 1) * np.sum(scores**2))) / (g * total)
    best = float(squares[lags >= 0].min())
    return lag * step + rest, error, freedom, 1 - float(np.sum(e * e)) / best if best else 0.0


def _residual(x: Array, y: Array) -> tuple[float, float]:
    """Return the gain g >= 0 of y = g x, and the squared residual."""
    size = float(np.vdot(x, x))
    g = max(float(np.vdot(x, y)) / size, 0.0) if size else 0.0
    left = y - g * x
    return g, float(np.vdot(left, left))
