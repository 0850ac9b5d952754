"""Checks of measured forces of the ground over time: delay, offsets, steps on the other plate."""

from collections.abc import Iterator, Sequence

import numpy as np

from robotid._text import seconds
from robotid._typing import Array
from robotid.findings import Finding, listed, log_finding
from robotid.logs.data import Trajectory

__all__ = ["check_delay", "check_exchanged_steps", "check_offsets"]

_LONGEST = 0.2  # [s] delay that is searched for
_BLOCKS = 8  # parts of a log whose delays are compared
_SHORTEST = 0.01  # [s] a smaller delay is not reported ...
_BEYOND = 4.0  # standard errors that a delay must exceed
_REDUCED = 0.9  # ratio of the squared residuals, with and without the delay, below which it counts
_WRONG = 0.1  # residual of a sample, over the weight, that may be a step on the other plate ...
_BETTER = 0.5  # ... if it is below this share of it with exchanged forces ...
_SOME = 0.02  # ... in this share of the samples
_SWINGS = 0.15  # [m/s] speed of a foot in the air ...
_ROWS = 5  # ... in at least so many samples together ...
_FEWEST = 4  # ... at least so many times
_UNLOADED = 0.1  # of the weight: largest mean force on a foot in the air
_OFFSET = 0.002  # of the weight (moments: at 0.1 m): a smaller offset is not reported


def check_delay(
    name: str, motion: Trajectory, slopes: Array, left: Array, stated: float
) -> Iterator[Finding]:
    """Yield a finding if forces fit the motion better at another time, in all parts of a log alike.

    Args:
        name: Name of the log.
        motion: Its motion, without rows left out, with wrenches of m components.
        slopes: Rows of the base per component, with equal units, shape (N, m, 6).
        left: Rows of the base that the bodies cause, likewise, shape (N, 6).
        stated: The delay that was corrected [s].
    """
    t, wrenches = motion.t, motion.wrenches
    if wrenches is None:
        return
    step = float(np.median(np.diff(t)))
    reach = int(_LONGEST / step)
    whole = np.arange(reach, len(t) - reach)
    if motion.segment is not None:
        whole = whole[motion.segment[whole - reach] == motion.segment[whole + reach]]
    if reach < 2 or len(whole) < 2 * reach * _BLOCKS:
        return
    shifts = np.arange(-reach, reach + 1)
    squares = np.empty((len(shifts), len(whole)))
    for k, shift in enumerate(shifts):
        caused = np.einsum("kmj,km->kj", slopes[whole], wrenches[whole + shift])
        squares[k] = np.sum((left[whole] - caused) ** 2, axis=1)
    blocks = [part.sum(axis=1) for part in np.array_split(squares, _BLOCKS, axis=1)]
    delays = np.array([step * _minimum(shifts, own) for own in blocks])
    delay = float(np.median(delays))
    error = float(1.858 * np.median(np.abs(delays - delay)) / np.sqrt(_BLOCKS)) + 0.1 * step
    total = squares.sum(axis=1)
    if abs(delay) < max(_SHORTEST, _BEYOND * error) or total.min() > _REDUCED * total[reach]:
        return
    message = (
        f"the measured forces of the ground lag the motion by {1e3 * delay:+.0f} +- "
        f"{1e3 * error:.0f} ms (median of {_BLOCKS} parts of the log): the clocks of forces "
        "and motion differ. Shift the columns wrench_..., or state wrench_delay = "
        f"{stated + delay:.3f} in [signals]"
    )
    yield log_finding(name, "wrench_delay", "warning", message, delay=delay, std_error=error)


def _minimum(shifts: Array, values: Array) -> float:
    """Return the shift of the smallest value, refined by a parabola."""
    k = int(np.argmin(values))
    if not 0 < k < len(values) - 1:
        return float(shifts[k])
    before, now, after = values[k - 1 : k + 2]
    bend = before - 2.0 * now + after
    return float(shifts[k] + (0.5 * (before - after) / bend if bend > 0 else 0.0))


def check_exchanged_steps(
    name: str, t: Array, residuals: tuple[Array, Array], frames: tuple[str, ...], weight: float
) -> Iterator[Finding]:
    """Yield a finding if forces of two feet are exchanged in some of the samples.

    Args:
        name: Name of the log.
        t: Times, shape (N,) [s].
        residuals: Those of the base, moments over the distance of the feet, each of shape (N, 6)
            [N]: as stated, and with exchanged forces.
        frames: The two feet.
        weight: Weight of the robot [N].
    """
    own, exchanged = (np.linalg.norm(x, axis=1) for x in residuals)
    is_wrong = (own > _WRONG * weight) & (exchanged < _BETTER * own)
    if is_wrong.mean() < _SOME:
        return
    first, last = (float(x) for x in t[is_wrong][[0, -1]])
    message = (
        f"in {is_wrong.mean():.0%} of the samples, from {seconds(first)} to {seconds(last)} s, the "
        f"measured forces of the ground fit the motion only if those of {listed(list(frames))} are "
        "exchanged: each foot is on the plate of the other one. Exchange the columns there, or "
        "select the time with start and end"
    )
    evidence = {"share": float(is_wrong.mean()), "first": first, "last": last}
    yield log_finding(name, "measured_wrench", "error", message, **evidence)


def check_offsets(
    name: str, frame: str, speed: Array, wrench: Array, parts: Sequence[str], weight: float
) -> Iterator[Finding]:
    """Yield a finding if a sensor measures a wrench while its foot is in the air.

    Args:
        name: Name of the log.
        frame: The foot.
        speed: Its speed, shape (N,) [m/s].
        wrench: Its measured components, shape (N, m) [N, N m].
        parts: Their names, as "fz".
        weight: Weight of the robot [N].
    """
    edges = np.flatnonzero(np.diff(np.pad(speed > _SWINGS, 1).astype(int))).reshape(-1, 2)
    means = np.array([wrench[i:j].mean(axis=0) for i, j in edges if j - i >= _ROWS])
    if len(means) < _FEWEST:
        return
    mean, error = np.median(means, axis=0), means.std(axis=0, ddof=1) / np.sqrt(len(means))
    is_moment = np.array([part.startswith("m") for part in parts])
    size = np.where(is_moment, 0.1, 1.0) * weight
    chosen = np.flatnonzero(np.abs(mean) > np.maximum(_BEYOND * error, _OFFSET * size)).tolist()
    if not chosen or (np.abs(mean[~is_moment]) > _UNLOADED * weight).any():
        return
    values = [
        f"{parts[k]} {mean[k]:+.3g} +- {error[k]:.1g} {'N m' if is_moment[k] else 'N'}"
        for k in chosen
    ]
    message = (
        f"{frame} is in the air {len(means)} times, but its sensor measures {listed(values)} there "
        "(median): it has an offset, or carries the part of the foot below it. Masses are wrong by "
        "as much; subtract these values from the columns wrench_..."
    )
    evidence = {f"{parts[k]}_{frame}": float(mean[k]) for k in chosen}
    yield log_finding(name, "wrench_offset", "warning", message, **evidence)
