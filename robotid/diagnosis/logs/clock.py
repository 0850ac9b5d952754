"""Checks of a log's time stamps and of the motion of its joints, without a model of the robot."""

from collections.abc import Iterator

import numpy as np

from robotid.base.findings import Finding, log_finding
from robotid.base.text import seconds
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.data.measured_velocity import quantum
from robotid.robot.parameters import ParameterLayout

_JITTER = 0.05  # spread of the time steps over their median from which jitter is reported
_GAP = 2.5  # [median steps] a longer step is a gap
_LONG = 0.05  # [s] ... a longer gap is a warning
_BUNCHED = 0.2  # [median steps] a shorter step is of rows that were stamped together ...
_BUNCHES = 0.02  # ... which are reported from this share of rows on, if the motion per row in them
_ALIKE = 0.3  # ... over that of all rows is not below this: they were not recorded together
_EVEN = 0.05  # relative difference of mean and median step above which rows may be missing
_SET = 1.0  # [s] in a longer gap, a position that moves as in one step shows that the clock was set
_STALE = 0.05  # share of stale rows from which they are a warning
_CONTINUES = 0.15  # motion after repeated rows, over that in as many rows before and after it,
_AROUND = 10  # ... estimated from at most this many rows
_STILL = 0.02  # [rad/s, or m/s of a prismatic joint] slower: at rest
_REST = 1.0  # [s] a longer rest at an end is reported
_STATIC = 1e-3  # [rad or m] smaller range: the joint does not move
_HARDLY = 0.2  # [rad] smaller range: the joint hardly moves
_HARDLY_PRISMATIC = 0.05  # [m] the same of a prismatic joint
_MOVING = 0.1  # share of the log in which a joint must move


def check_clock(log: Log) -> Iterator[Finding]:
    """Yield the findings on the logger behind a log's time stamps and rows."""
    step = np.diff(log.t)
    median = float(np.median(step))
    yield from _rate(log, step, median)
    yield from _gaps(log, step, median)
    yield from _bunches(log, step)
    yield from _stale_rows(log, step)


def check_rest(log: Log, motion: Trajectory, layout: ParameterLayout) -> Iterator[Finding]:
    """Yield the rests at the ends of a log, and the joints that do not move or hardly move."""
    speed = np.abs(motion.v) / layout.drive_speeds[: len(log.joints)]
    # a prismatic joint that moves by a millimetre is at rest, too
    yield from _standstill(log, motion.t[(np.abs(motion.v) > _STILL).any(axis=1)])
    for j, joint in enumerate(log.joints):
        extent = float(np.ptp(motion.q[:, j]))
        share = float(np.mean(speed[:, j] > _STILL))
        is_prismatic = joint in layout.prismatic
        size = f"range {extent:.2g} {'m' if is_prismatic else 'rad'}"
        if extent < _STATIC:
            code, severity = "static_joint", "warning"
            message = (
                f"{joint} at rest ({size}): this log does not determine friction and inertia of "
                "the joint, nor most parameters of the links that it carries; move it, or lock it"
            )
        elif extent < (_HARDLY_PRISMATIC if is_prismatic else _HARDLY) or share < _MOVING:
            code, severity = "hardly_moves", "note"
            message = (
                f"little motion of {joint} ({size}, moving {100 * share:.2g} % of the time): "
                "parameters that only such a joint excites are poorly determined; move it farther "
                "and longer"
            )
        else:
            continue
        yield log_finding(
            log.name, code, severity, message, joint, range=extent, moving_share=share
        )


def runs_of(flags: Array) -> list[tuple[int, int]]:
    """Return the first row, and the row after the last one, of each run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def _rate(log: Log, step: Array, median: float) -> Iterator[Finding]:
    """Yield the rate of a log and the jitter of its time stamps."""
    rate, duration = 1 / median, float(log.t[-1] - log.t[0])
    message = f"{len(log.t)} rows in {duration:.4g} s, median rate {rate:.4g} Hz; no action needed"
    yield log_finding(
        log.name, "rate", "note", message, rate=rate, samples=len(log.t), duration=duration
    )
    regular = step[step < _GAP * median]
    spread = float(np.std(regular)) / median
    if spread > _JITTER:
        low, high = 1e3 * float(step.min()), 1e3 * float(regular.max())
        message = (
            f"time steps vary from {low:.3g} to {high:.3g} ms about {1e3 * median:.3g} ms "
            f"(standard deviation {100 * spread:.2g} %); no action needed: robotid uses the time "
            "stamps, not row number / rate"
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
            f"the clock jumps by {jump:.6g} s at t = {log.t[k]:.10g} s, but the position moves "
            "only as in one step: the clock was set during the recording. The rows before and "
            f"after the jump are separate segments; subtract {jump:.6g} s from the time stamps "
            "after it, or log a monotonic clock"
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
        f"{len(gaps)} gaps, the longest of {longest:.3g} s at t = {seconds(start)} s. A long gap "
        "ends a segment: the log is not filtered or differentiated across it, and the rows beside "
        "it are not used; record without interruption if possible"
    )
    yield log_finding(log.name, "gap", severity, message, gaps=len(gaps), longest=longest, at=start)


def _bunches(log: Log, step: Array) -> Iterator[Finding]:
    """Yield rows whose stamps are those of their arrival: they come together after a pause."""
    mean = float(np.mean(step[step < _SET])) if (step < _SET).any() else 0.0
    is_bunched = step < _BUNCHED * mean
    share = float(np.mean(is_bunched))
    moved = np.abs(np.diff(log.q, axis=0)).mean(axis=0)
    j = int(np.argmax(moved))  # the joint that shows most of the motion
    own = np.abs(np.diff(log.q[:, j]))
    if share < _BUNCHES or own[is_bunched].mean() <= _ALIKE * own.mean():
        return
    usual = float(np.median(step[~is_bunched]))
    is_even = abs(mean / usual - 1.0) < _EVEN
    message = (
        f"{is_bunched.sum()} of {len(log.t)} rows are stamped within "
        f"{1e3 * _BUNCHED * mean:.2g} ms of the row before, after pauses of up to "
        f"{step.max():.2g} s, but the joints move between them as between other rows: the stamps "
        "are those of arrival, not of recording. Velocities and accelerations there are wrong; "
    )
    if is_even:
        message += (
            f"the mean step is {1e3 * mean:.4g} ms, the typical one {1e3 * usual:.4g} ms, so no "
            'rows are missing: state stamp = "even" in [log], or log the time of recording'
        )
    else:
        message += "log the time of recording"
    evidence = {"rows": float(is_bunched.sum()), "share": share, "longest": float(step.max())}
    yield log_finding(log.name, "bunched_stamps", "warning", message, **evidence)


def _goes_on(q: Array, k: int) -> bool:
    """Return whether the position moves from row k to k + 1 as far as in the steps around."""
    if not 2 <= k < len(q) - 3:
        return False
    around = (q[k] - q[k - 2] + q[k + 3] - q[k + 1]) / 4
    own, size = q[k + 1] - q[k], float(np.linalg.norm(around))
    return size > 0 and float(np.linalg.norm(own - around)) < 0.5 * size


def _stale_rows(log: Log, step: Array) -> Iterator[Finding]:
    channels = np.hstack([x for x in (log.q, log.v, log.tau) if x is not None])
    same = (np.diff(channels, axis=0) == 0).all(axis=1)
    runs = _in_motion(log, runs_of(same))
    stale = sum(stop - start for start, stop in runs)
    if stale == 0:
        return
    share = stale / len(log.t)
    message = (
        f"{stale} rows ({100 * share:.2g} %) repeat the row before in every channel while the "
        "robot moves: the logger runs faster than the robot updates its state; log each state "
        "once, with its own time stamp"
    )
    severity, longest = "warning" if share > _STALE else "note", max(b - a for a, b in runs)
    yield log_finding(
        log.name, "stale_rows", severity, message, rows=stale, share=share, longest_run=longest
    )


def _in_motion(log: Log, runs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the runs of repeated rows within a motion, which continues or catches up after them.

    A robot that holds a position starts again from rest, and without further channels, a single
    step of the encoder is that of a slow motion.
    """
    t, q, last_row = log.t, log.q, len(log.t) - 1
    first, last = np.array([run for run in runs if run[1] < last_row], dtype=int).reshape(-1, 2).T
    n = last - first + 1
    change = q[last + 1] - q[last]
    m = np.minimum(n, _AROUND)
    around = np.linalg.norm(q[first] - q[np.maximum(first - m, 0)], axis=1)
    around += np.linalg.norm(q[np.minimum(last + 1 + m, last_row)] - q[last + 1], axis=1)
    moves = np.abs(change).max(axis=1, initial=0.0) > _STILL * (t[last + 1] - t[first])
    if not log.has_torque:
        steps = np.array([quantum(x) for x in q.T])
        moves &= (np.abs(change) > 1.5 * steps).any(axis=1)
    continues = np.linalg.norm(change, axis=1) >= _CONTINUES * around * n / m
    rows = np.flatnonzero(moves & continues)
    return list(zip(first[rows].tolist(), last[rows].tolist(), strict=True))


def _standstill(log: Log, moving: Array) -> Iterator[Finding]:
    """Yield the rests at the ends of a log, from the times at which the robot moves."""
    if len(moving) == 0:
        return
    before, after = float(moving[0] - log.t[0]), float(log.t[-1] - moving[-1])
    if max(before, after) < _REST:
        return
    message = (
        f"the robot is at rest for the first {before:.3g} s and the last {after:.3g} s. Rows of "
        "joints at rest are not used to identify friction; cut them with start = "
        f"{seconds(moving[0])} and end = {seconds(moving[-1])}"
    )
    yield log_finding(log.name, "standstill", "note", message, before=before, after=after)
