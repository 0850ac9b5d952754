"""What a log shows of its own clock and of its joints' motion, without a model of the robot."""

from collections.abc import Collection, Iterator

import numpy as np

from robotid._typing import Array
from robotid.findings import Finding
from robotid.logs.data import Log

__all__ = [
    "check_clock",
    "check_gaps",
    "check_stale_rows",
    "check_standstill",
    "check_static",
    "runs_of",
]

_JITTER = 0.05  # spread of the steps over their median from which jitter is reported
_GAP = 2.5  # a step longer than this many median steps is a gap
_LONG = 0.05  # [s] ... if it is longer than this, too
_STALE = 0.05  # share of stale rows that is more than a blemish
_STILL = 0.02  # [rad/s or m/s] slower than this a joint stands still
_REST = 1.0  # [s] a rest this long at an end is reported
_STATIC = 1e-3  # [rad or m] a joint that moves less than this does not move
_HARDLY = 0.2  # [rad] a joint that moves less than this hardly does
_HARDLY_SLIDES = 0.05  # [m] the same of a joint that slides
_MOVING = 0.1  # share of the log below which a joint's motion is thin


def check_clock(log: Log) -> Iterator[Finding]:
    """Yield the rate of a log and how its time stamps jitter.

    Args:
        log: The log.

    Yields:
        Notes "rate" and "jitter".
    """
    step = np.diff(log.t)
    median = float(np.median(step))
    usual = step[step < _GAP * median]
    spread = float(np.std(usual)) / median
    name = log.name
    evidence = {"rate": 1 / median, "samples": len(log.t), "duration": float(log.t[-1] - log.t[0])}
    message = (
        f"{name}: {len(log.t)} rows in {evidence['duration']:.4g} s, {1 / median:.4g} Hz in the "
        "median; nothing needs doing"
    )
    yield Finding("rate", "note", name, message, evidence)
    if spread > _JITTER:
        low, high = 1e3 * float(step.min()), 1e3 * float(usual.max())
        message = (
            f"{name}: steps jitter from {low:.3g} to {high:.3g} ms about {1e3 * median:.3g} ms "
            f"(standard deviation {100 * spread:.2g} %); use the time column as it is, never row "
            "number / rate; robotid does"
        )
        evidence = {"relative_spread": spread, "shortest": low / 1e3, "longest": high / 1e3}
        yield Finding("jitter", "note", name, message, evidence)


def check_gaps(log: Log) -> Iterator[Finding]:
    """Yield the gaps of a log.

    Args:
        log: The log.

    Yields:
        At most one "gap": a warning, or a note if every gap is short.
    """
    step = np.diff(log.t)
    median = float(np.median(step))
    gaps = np.flatnonzero(step > _GAP * median * (1 + 1e-6))
    if len(gaps) == 0:
        return
    longest = int(gaps[np.argmax(step[gaps])])
    severity = "warning" if step[longest] > max(_LONG, _GAP * median) else "note"
    message = (
        f"{log.name}: {len(gaps)} gaps, the longest of {step[longest]:.3g} s at t = "
        f"{log.t[longest]:.6g} s; nothing is filtered or differentiated across long ones, and the "
        "rows beside them are lost: record without interruption if you can"
    )
    evidence = {"gaps": len(gaps), "longest": float(step[longest]), "at": float(log.t[longest])}
    yield Finding("gap", severity, log.name, message, evidence)


def check_stale_rows(log: Log) -> Iterator[Finding]:
    """Yield rows that repeat the one before in every channel.

    Args:
        log: The log.

    Yields:
        At most one "stale_rows".
    """
    channels = np.hstack([x for x in (log.q, log.v, log.tau) if x is not None])
    same = (np.diff(channels, axis=0) == 0).all(axis=1)
    # where nothing moves on a coarse grid, rows repeat rightly: a repeated row must be passed by
    speed = np.abs(np.diff(log.q, axis=0)).max(axis=1) / np.diff(log.t)
    passing = np.zeros(len(same), dtype=bool)
    passing[1:-1] = (speed[:-2] > _STILL) | (speed[2:] > _STILL)
    runs = runs_of(same)
    stale = sum(stop - start for start, stop in runs if passing[start] or passing[stop - 1])
    if stale == 0:
        return
    share = stale / len(log.t)
    message = (
        f"{log.name}: {stale} rows ({100 * share:.2g} %) repeat the row before in every channel "
        "while the robot moves: the logger ran faster than the robot's state; log each state "
        "once, with its own time stamp"
    )
    evidence = {"rows": stale, "share": share, "longest_run": max(e - s for s, e in runs)}
    severity = "warning" if share > _STALE else "note"
    yield Finding("stale_rows", severity, log.name, message, evidence)


def check_standstill(log: Log, motion_t: Array, motion_v: Array) -> Iterator[Finding]:
    """Yield how long the whole robot rests at the ends of a log.

    Args:
        log: The log.
        motion_t: Time stamps of the smooth motion, shape (N,) [s].
        motion_v: Its velocities, shape (N, n) [rad/s or m/s].

    Yields:
        At most one note "standstill".
    """
    moving = np.flatnonzero((np.abs(motion_v) > _STILL).any(axis=1))
    if len(moving) == 0:
        return
    before = float(motion_t[moving[0]] - log.t[0])
    after = float(log.t[-1] - motion_t[moving[-1]])
    if max(before, after) < _REST:
        return
    message = (
        f"{log.name}: the robot rests for the first {before:.3g} s and the last {after:.3g} s; "
        "rows of resting joints are left out where friction is identified; cut them with start "
        f"= {motion_t[moving[0]]:.4g} and end = {motion_t[moving[-1]]:.4g}"
    )
    yield Finding("standstill", "note", log.name, message, {"before": before, "after": after})


def check_static(
    log: Log, motion_q: Array, motion_v: Array, prismatic: Collection[str] = ()
) -> Iterator[Finding]:
    """Yield joints that do not move, or hardly.

    Args:
        log: The log.
        motion_q: Smooth positions without full turns, shape (N, n) [rad or m].
        motion_v: Their velocities, shape (N, n) [rad/s or m/s].
        prismatic: Names of the joints that slide.

    Yields:
        A warning "static_joint", or a note "hardly_moves", per joint.
    """
    for j, joint in enumerate(log.joints):
        reach = float(np.ptp(motion_q[:, j]))
        share = float(np.mean(np.abs(motion_v[:, j]) > _STILL))
        evidence = {"range": reach, "moving_share": share}
        if reach < _STATIC:
            message = (
                f"{log.name}: {joint} stands still (range {reach:.2g}): its friction, its "
                "inertia and much of what it carries cannot be identified from this log; move it, "
                "or lock it"
            )
            yield Finding("static_joint", "warning", _at(log, joint), message, evidence)
        elif reach < (_HARDLY_SLIDES if joint in prismatic else _HARDLY) or share < _MOVING:
            message = (
                f"{log.name}: {joint} hardly moves (range {reach:.2g}, moving {100 * share:.2g} "
                "% of the time): what it alone excites is poorly known; move it farther and longer"
            )
            yield Finding("hardly_moves", "note", _at(log, joint), message, evidence)


def runs_of(flags: Array) -> list[tuple[int, int]]:
    """Return where flags are true without a break.

    Args:
        flags: Shape (N,), bool.

    Returns:
        First row and row after the last one of each run.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def _at(log: Log, joint: str) -> str:
    return f"{log.name}: {joint}"
