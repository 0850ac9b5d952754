"""Checks of a log's time stamps and of the motion of its joints, without a model of the robot."""

from collections.abc import Iterator

import numpy as np

from robotid.base.findings import Finding
from robotid.base.text import seconds
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.data.measured_velocity import quantum
from robotid.diagnosis.catalogue import finding
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
        unit, least = ("m", _HARDLY_PRISMATIC) if is_prismatic else ("rad", _HARDLY)
        code = "static_joint" if extent < _STATIC else "hardly_moves"
        if extent < least or share < _MOVING:
            yield finding(code, log.name, joint, range=extent, moving_share=share, unit=unit)


def runs_of(flags: Array) -> list[tuple[int, int]]:
    """Return the first row, and the row after the last one, of each run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def _rate(log: Log, step: Array, median: float) -> Iterator[Finding]:
    """Yield the rate of a log and the jitter of its time stamps."""
    rate, duration = 1 / median, float(log.t[-1] - log.t[0])
    yield finding("rate", log.name, rate=rate, samples=len(log.t), duration=duration)
    regular = step[step < _GAP * median]
    spread = float(np.std(regular)) / median
    if spread > _JITTER:
        yield finding(
            "jitter", log.name, relative_spread=spread, shortest=float(step.min()),
            longest=float(regular.max()), median=median,
        )  # fmt: skip


def _gaps(log: Log, step: Array, median: float) -> Iterator[Finding]:
    gaps = np.flatnonzero(step > _GAP * median * (1 + 1e-6))
    is_set = np.array(
        [step[k] > _SET and _goes_on(log.q, k) for k in gaps.tolist()], dtype=np.bool_
    )
    if is_set.any():
        k = int(gaps[is_set][0])
        jump, at = float(step[k]) - median, float(log.t[k])
        yield finding("clock_step", log.name, jump=jump, at=at, steps=float(is_set.sum()))
        gaps = gaps[~is_set]
    if len(gaps) == 0:
        return
    at = int(gaps[np.argmax(step[gaps])])
    longest, start = float(step[at]), float(log.t[at])
    severity = "warning" if longest > max(_LONG, _GAP * median) else "note"
    yield finding(
        "gap", log.name, severity=severity, gaps=len(gaps), longest=longest, at=start,
        when=seconds(start),
    )  # fmt: skip


def _bunches(log: Log, step: Array) -> Iterator[Finding]:
    """Yield rows whose stamps are those of their arrival: they come together after a pause."""
    mean = float(np.mean(step[step < _SET])) if (step < _SET).any() else 0.0
    is_bunched = step < _BUNCHED * mean
    share = float(np.mean(is_bunched))
    moved = np.abs(np.diff(log.q, axis=0)).mean(axis=0)
    change = np.abs(np.diff(log.q[:, int(np.argmax(moved))]))  # of the joint that moves most
    if share < _BUNCHES or change[is_bunched].mean() <= _ALIKE * change.mean():
        return
    usual = float(np.median(step[~is_bunched]))
    yield finding(
        "bunched_stamps", log.name, rows=float(is_bunched.sum()), share=share, of=len(log.t),
        longest=float(step.max()), within=_BUNCHED * mean, mean=mean, usual=usual,
        cure=abs(mean / usual - 1.0) < _EVEN,
    )  # fmt: skip


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
    share, longest = stale / len(log.t), max(b - a for a, b in runs)
    severity = "warning" if share > _STALE else "note"
    yield finding(
        "stale_rows", log.name, severity=severity, rows=stale, share=share, longest_run=longest
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
    if max(before, after) >= _REST:
        yield finding(
            "standstill", log.name, before=before, after=after, start=seconds(moving[0]),
            end=seconds(moving[-1]),
        )  # fmt: skip
