"""Checks of measured forces of the ground over time: their delay, and steps on the other plate."""

from collections.abc import Iterator

import numpy as np

from robotid._text import seconds
from robotid._typing import Array
from robotid.findings import Finding, listed, log_finding
from robotid.logs.data import Trajectory

__all__ = ["check_delay", "check_exchanged_steps"]

_LONGEST = 0.2  # [s] delay that is searched for
_BLOCKS = 8  # parts of a log whose delays are compared
_SHORTEST = 0.01  # [s] a smaller delay is not reported ...
_BEYOND = 4.0  # standard errors that a delay must exceed
_REDUCED = 0.9  # ratio of the squared residuals, with and without the delay, below which it counts
_WRONG = 0.1  # residual of a sample, over the weight, that may be a step on the other plate ...
_BETTER = 0.5  # ... if it is below this share of it with exchanged forces ...
_SOME = 0.02  # ... in this share of the samples


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
        "exchanged: each foot stands on the plate of the other one. Exchange the columns there, or "
        "select the time with start and end"
    )
    evidence = {"share": float(is_wrong.mean()), "first": first, "last": last}
    yield log_finding(name, "measured_wrench", "error", message, **evidence)
