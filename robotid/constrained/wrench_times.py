"""Checks of measured forces of the ground over time: delay, offsets, gains, exchanged steps."""

from collections.abc import Iterator, Sequence

import numpy as np

from robotid._text import seconds
from robotid._typing import Array
from robotid.findings import Finding, listed, log_finding
from robotid.logs.data import Trajectory

__all__ = ["check_delay", "check_exchanged_steps", "check_gains", "check_level", "check_offsets"]

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
_GAIN = 0.05  # smallest error of a foot's gain that is reported
_EQUAL = 1e-4  # weight of equal gains, relative to the loads
_TILT = 0.01  # of the weight: smallest mean horizontal force that is reported
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


def check_gains(name: str, frames: Sequence[str], loads: Array, left: Array) -> Iterator[Finding]:
    """Yield a finding if the force of one foot has another gain than those of the other feet.

    The bodies cause the force of the base, the sum of the feet's forces times their gains. As load
    shifts from foot to foot, the sum remains only with the right ratios of these gains. Gains of
    all feet together are like another mass of the robot. A foot is compared with the median of the
    others, in the log without each of eight parts (jackknife).

    Args:
        name: Name of the log.
        frames: The k feet.
        loads: Force of the base that each foot causes as measured, shape (N, 3, k) [N].
        left: Force of the base that the bodies cause, shape (N, 3) [N].
    """
    count = len(frames)
    if count < 2 or len(left) < 2 * _BLOCKS:
        return
    blocks = np.array_split(np.arange(len(left)), _BLOCKS)
    G = np.array([np.einsum("nik,nil->kl", loads[k], loads[k]) for k in blocks])
    g = np.array([np.einsum("nik,ni->k", loads[k], left[k]) for k in blocks])
    whole, sums = G.sum(axis=0), g.sum(axis=0)
    alike = _EQUAL * np.trace(whole) * (np.eye(count) - 1.0 / count)

    def gains(G: Array, g: Array) -> tuple[Array, Array]:
        """Return the factors of the forces, and these over the median of the others."""
        factors = np.linalg.solve(G + alike, g)
        others = [np.median(np.delete(factors, k)) for k in range(count)]
        return factors, factors / np.array(others)

    factors, ratios = gains(whole, sums)
    parts = np.array([gains(whole - x, sums - y)[1] for x, y in zip(G, g, strict=True)])
    error = np.sqrt((_BLOCKS - 1) * np.mean((parts - parts.mean(axis=0)) ** 2, axis=0))
    is_wrong = np.abs(np.log(np.abs(ratios))) > np.log1p(_GAIN)
    is_wrong &= np.abs(ratios - 1.0) > _BEYOND * error
    square, common = np.sum(left**2), sums.sum() / whole.sum()
    before = square - common * sums.sum()  # of the residual with one gain
    after = square - 2.0 * factors @ sums + factors @ whole @ factors
    if not is_wrong.any() or after > _REDUCED * before:
        return
    # of two feet, that whose factor is further from that of the URDF's weight
    far = np.abs(np.log(np.abs(ratios if count > 2 else factors)))
    k = int(np.argmax(np.where(is_wrong, far, -1.0)))
    others = [x for x in frames if x != frames[k]]
    which = "" if count > 2 else (
        f". The log does not show which of both is wrong: with the URDF's weight, {frames[0]} "
        f"needs the factor {factors[0]:.3g}, {frames[1]} {factors[1]:.3g}"
    )  # fmt: skip
    message = (
        f"as load shifts between the feet, their forces are consistent if that of {frames[k]} is "
        f"multiplied by {ratios[k]:.3g} +- {error[k]:.1g} relative to {listed(others)}: the gain "
        f"of a sensor is wrong{which}. Calibrate it, or multiply the columns wrench_... of "
        f"{frames[k]} by {ratios[k]:.3g}"
    )
    evidence = {"factor": float(ratios[k]), "std_error": float(error[k])}
    yield log_finding(name, "wrench_gain", "warning", message, **evidence)


def check_level(name: str, excess: Array, gravity: Array, weight: float) -> Iterator[Finding]:
    """Yield a finding if the mean of the measured horizontal forces is not that of the motion.

    Args:
        name: Name of the log.
        excess: Measured forces less that of the motion of the bodies, with the axes of the world,
            shape (N, 3) [N].
        gravity: Gravity in the world, shape (3,) [m/s^2].
        weight: Weight of the robot [N].
    """
    if len(excess) < 2 * _BLOCKS:
        return
    down = gravity / np.linalg.norm(gravity)
    level = excess - np.outer(excess @ down, down)
    means = np.array([x.mean(axis=0) for x in np.array_split(level, _BLOCKS)])
    mean = level.mean(axis=0)
    error = float(np.linalg.norm(means.std(axis=0, ddof=1))) / np.sqrt(_BLOCKS)
    size = float(np.linalg.norm(mean))
    if size < max(_TILT * weight, _BEYOND * error):
        return
    angle = float(np.degrees(np.arctan(size / weight)))
    message = (
        f"the measured horizontal forces of all feet together are {size:.3g} +- {error:.1g} N "
        f"({listed([f'{x:+.3g}' for x in mean])} N along x, y, z of the world) on average more "
        "than the motion needs: a sensor has an offset, or forces and motion have axes that are "
        f"tilted by {angle:.2g} deg. Record the unloaded sensors and subtract their values, or "
        "level the axes"
    )
    evidence = {"horizontal": size, "std_error": error, "angle": angle}
    yield log_finding(name, "wrench_offset", "warning", message, **evidence)
