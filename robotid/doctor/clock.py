"""What a log shows of its own clock and of its joints' motion, without a model of the robot."""

from collections.abc import Iterator

import numpy as np

from robotid._typing import Array
from robotid.findings import Finding, log_finding
from robotid.logs.data import Log, Trajectory
from robotid.robot.parameters import ParameterLayout

__all__ = ["check_clock", "check_rest", "runs_of"]

_JITTER = 0.05  # spread of the steps over their median from which jitter is reported
_GAP = 2.5  # a step longer than this many median steps is a gap
_LONG = 0.05  # [s] ... if it is longer than this, too
_SET = 1.0  # [s] a gap this long over which the position goes on as in one step is none
_STALE = 0.05  # share of stale rows that is more than a blemish
_STILL = 0.02  # [rad/s, of a slider at rest m/s] slower than this a joint is at rest
_REST = 1.0  # [s] a rest this long at an end is reported
_STATIC = 1e-3  # [rad or m] a joint that moves less than this does not move
_HARDLY = 0.2  # [rad] a joint that moves less than this hardly does
_HARDLY_SLIDES = 0.05  # [m] the same of a prismatic joint
_MOVING = 0.1  # share of the log below which a joint's motion is thin


def check_clock(log: Log) -> Iterator[Finding]:
    """Yield what a log's time stamps and rows show of its logger.

    Args:
        log: The log.

    Yields:
        Notes "rate" and "jitter"; at most one "gap", a warning if one is long, one warning
        "clock_step" if the clock was set while it logged, and one "stale_rows", of rows that
        repeat the one before in every channel.
    """
    step = np.diff(log.t)
    median = float(np.median(step))
    yield from _rate(log, step, median)
    yield from _gaps(log, step, median)
    yield from _stale_rows(log, step)


def check_rest(log: Log, motion: Trajectory, layout: ParameterLayout) -> Iterator[Finding]:
    """Yield how long the robot rests at the ends of a log, and joints that do not move, or hardly.

    Args:
        log: The log.
        motion: Its smooth motion, positions without full turns.
        layout: Which joints slide, and how far.

    Yields:
        At most one note "standstill"; a warning "static_joint" or a note "hardly_moves" per joint.
    """
    speed = np.abs(motion.v) / layout.drive_speeds[: len(log.joints)]
    # a slider that twitches by a millimetre is at rest, too
    yield from _standstill(log, motion.t[(np.abs(motion.v) > _STILL).any(axis=1)])
    for j, joint in enumerate(log.joints):
        reach = float(np.ptp(motion.q[:, j]))
        share = float(np.mean(speed[:, j] > _STILL))
        if reach < _STATIC:
            code, severity = "static_joint", "warning"
            message = (
                f"{joint} is at rest (range {reach:.2g}): its friction, its inertia and much of "
                "what it carries cannot be identified from this log; move it, or lock it"
            )
        elif reach < (_HARDLY_SLIDES if joint in layout.prismatic else _HARDLY) or share < _MOVING:
            code, severity = "hardly_moves", "note"
            message = (
                f"{joint} hardly moves (range {reach:.2g}, moving {100 * share:.2g} % of the "
                "time): what it alone excites is poorly known; move it farther and longer"
            )
        else:
            continue
        yield log_finding(log.name, code, severity, message, joint, range=reach, moving_share=share)


def runs_of(flags: Array) -> list[tuple[int, int]]:
    """Return the first row, and the row after the last one, of each run of true flags.

    Args:
        flags: Shape (N,), bool.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def _rate(log: Log, step: Array, median: float) -> Iterator[Finding]:
    """Yield the rate of a log and how its time stamps jitter."""
    rate, duration = 1 / median, float(log.t[-1] - log.t[0])
    message = (
        f"{len(log.t)} rows in {duration:.4g} s, {rate:.4g} Hz in the median; nothing needs doing"
    )
    yield log_finding(
        log.name, "rate", "note", message, rate=rate, samples=len(log.t), duration=duration
    )
    usual = step[step < _GAP * median]
    spread = float(np.std(usual)) / median
    if spread > _JITTER:
        low, high = 1e3 * float(step.min()), 1e3 * float(usual.max())
        message = (
            f"steps jitter from {low:.3g} to {high:.3g} ms about {1e3 * median:.3g} ms (standard "
            f"deviation {100 * spread:.2g} %); use the time column as it is, never row number / "
            "rate; robotid does"
        )
        evidence = {"relative_spread": spread, "shortest": low / 1e3, "longest": high / 1e3}
        yield log_finding(log.name, "jitter", "note", message, **evidence)


def _gaps(log: Log, step: Array, median: float) -> Iterator[Finding]:
    gaps = np.flatnonzero(step > _GAP * median * (1 + 1e-6))
    is_set = np.array(
        [step[k] > _SET and _goes_on(log.q, k) for k in gaps.tolist()], dtype=np.bool_
    )
    if is_set.any():
        k = int(gaps[is_set][0])
        jump = float(step[k]) - median
        message = (
            f"the clock jumps by {jump:.6g} s at t = {log.t[k]:.10g} s while the position goes on "
            "as in one step: the clock was set while it logged, and both sides are taken for "
            f"segments of their own; take {jump:.6g} s off the later time stamps, or log a "
            "monotonic clock"
        )
        evidence = {"jump": jump, "at": float(log.t[k]), "steps": float(is_set.sum())}
        yield log_finding(log.name, "clock_step", "warning", message, **evidence)
        gaps = gaps[~is_set]
    if len(gaps) == 0:
        return
    at = int(gaps[np.argmax(step[gaps])])
    longest, start = float(step[at]), float(log.t[at])
    severity = "warning" if longest > max(_LONG, _GAP * median) else "note"
    message = (
        f"{len(gaps)} gaps, the longest of {longest:.3g} s at t = {start:.6g} s; nothing is "
        "filtered or differentiated across long ones, and the rows beside them are lost: record "
        "without interruption if you can"
    )
    yield log_finding(log.name, "gap", severity, message, gaps=len(gaps), longest=longest, at=start)


def _goes_on(q: Array, k: int) -> bool:
    """Return whether the position goes from row k to the next as far as in the steps around."""
    if not 2 <= k < len(q) - 3:
        return False
    around = (q[k] - q[k - 2] + q[k + 3] - q[k + 1]) / 4
    own, size = q[k + 1] - q[k], float(np.linalg.norm(around))
    return size > 0 and float(np.linalg.norm(own - around)) < 0.5 * size


def _stale_rows(log: Log, step: Array) -> Iterator[Finding]:
    channels = np.hstack([x for x in (log.q, log.v, log.tau) if x is not None])
    same = (np.diff(channels, axis=0) == 0).all(axis=1)
    # where nothing moves on a coarse grid, rows repeat rightly: a repeated row must be passed by
    speed = np.abs(np.diff(log.q, axis=0)).max(axis=1) / step
    passing = np.zeros(len(same), dtype=bool)
    passing[1:-1] = (speed[:-2] > _STILL) | (speed[2:] > _STILL)
    runs = [(a, b) for a, b in runs_of(same) if passing[a] or passing[b - 1]]
    stale = sum(stop - start for start, stop in runs)
    if stale == 0:
        return
    share = stale / len(log.t)
    message = (
        f"{stale} rows ({100 * share:.2g} %) repeat the row before in every channel while the "
        "robot moves: the logger ran faster than the robot's state; log each state once, with its "
        "own time stamp"
    )
    severity, longest = "warning" if share > _STALE else "note", max(b - a for a, b in runs)
    yield log_finding(
        log.name, "stale_rows", severity, message, rows=stale, share=share, longest_run=longest
    )


def _standstill(log: Log, moving: Array) -> Iterator[Finding]:
    """Yield how long the robot rests at the ends of a log, by the times at which it moves."""
    if len(moving) == 0:
        return
    before, after = float(moving[0] - log.t[0]), float(log.t[-1] - moving[-1])
    if max(before, after) < _REST:
        return
    message = (
        f"the robot rests for the first {before:.3g} s and the last {after:.3g} s; rows of resting "
        "joints are left out where friction is identified; cut them with start = "
        f"{moving[0]:.4g} and end = {moving[-1]:.4g}"
    )
    yield log_finding(log.name, "standstill", "note", message, before=before, after=after)
