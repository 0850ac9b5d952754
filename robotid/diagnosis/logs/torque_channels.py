"""Checks of the torque channels of a log for faults of the sensor or driver, without a model."""

from collections.abc import Iterator

import numpy as np

from robotid.base.findings import Finding, listed, quoted
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.data.measured_velocity import COARSE, quantum
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.logs.clock import runs_of
from robotid.diagnosis.logs.locked_joints import STILL

_PLATEAU = 5  # consecutive rows at the limit of a clipped channel, at least
_CLIPPED = 0.01  # share of the rows at the limit from which a channel is clipped
_ZERO = 0.05  # of its largest value, below which a torque that is never negative is 0
_AWAY = 0.2  # of its largest value, above which it is not 0 any more
_TOUCHES = 3  # times that a torque without sign reaches 0 and increases again, at least
_ALL = 3  # joints of which no torque is ever negative, at least
_REGULAR = 0.8  # share of holds of about one length that a quantised torque does not reach


def check_torque_channels(log: Log) -> Iterator[Finding]:
    """Yield the findings on the torque sensors behind a log."""
    moving = np.append((np.diff(log.q, axis=0) != 0).any(axis=1), False)
    for joint, x in zip(log.joints, log.tau.T, strict=True):
        own = bool(np.ptp(log.q[:, log.joints.index(joint)]) > STILL)
        yield from _clipping(log, joint, x, moving, moves=own)
    yield from _unsigned(log)
    yield from _held(log)


def _clipping(log: Log, joint: str, x: Array, moving: Array, *, moves: bool) -> Iterator[Finding]:
    """Yield a torque that is at a limit, or constant, in rows where the robot moves."""
    if moving.any() and np.ptp(x) == 0:
        value = float(x[0]) + 0.0  # no -0
        kind = "undriven" if moves and value == 0.0 else "dead"
        name = quoted(joint)
        yield finding(
            "constant_torque", log.name, joint, value=value, kind=kind, cure=kind, quoted=name
        )
        return
    step = quantum(x)
    for limit in (float(x.max()), float(x.min())):
        at = (x == limit) & moving
        share = float(at.mean())
        plateau = max((stop - start for start, stop in runs_of(at)), default=0)
        is_coarse = step > 0 and np.ptp(x) / step < COARSE
        if share >= _CLIPPED and plateau >= _PLATEAU and not is_coarse:
            yield finding("clipped", log.name, joint, limit=limit, share=share)


def _unsigned(log: Log) -> Iterator[Finding]:
    """Yield a finding if no torque is ever negative although several reach 0 repeatedly.

    A single such torque may belong to a joint that gravity loads in one direction only.
    """
    touching = sum(_touches(x) >= _TOUCHES for x in log.tau.T)
    if log.tau.min() >= 0 and touching >= _ALL:
        yield finding("unsigned_torque", log.name, joints=touching, kind="all", cure="all")


def _touches(x: Array) -> int:
    """Return how often a torque reaches 0 and increases again."""
    top = float(np.quantile(np.abs(x), 0.995))
    near = runs_of(x < _AWAY * top)
    return sum(x[i:k].min() < _ZERO * top for i, k in near if i > 0 and k < len(x))


def _held(log: Log) -> Iterator[Finding]:
    """Yield the joints whose torque is updated less often than it is logged while the robot moves.

    Rows that repeat in every channel are a fault of the logger and reported elsewhere; a quantised
    torque is constant for irregular times.
    """
    fresh = np.append(True, (np.diff(log.q, axis=0) != 0).any(axis=1))
    lengths = np.array([_hold(x) for x in log.tau[fresh].T])
    for length in np.unique(lengths[lengths > 1]):
        names = [log.joints[j] for j in np.flatnonzero(lengths == length)]
        step = float(np.median(np.diff(log.t)))
        yield finding(
            "repeated_torque", log.name, () if len(names) == len(log.joints) else names,
            rows=length, delay=0.5 * (length - 1) * step, updated=1 / (length * step),
            logged=1 / step, below=0.25 / (length * step), joint=listed(names),
        )  # fmt: skip


def _hold(x: Array) -> int:
    """Return for how many rows a torque is constant between updates; 1 if this is irregular."""
    changes = np.flatnonzero(np.diff(x) != 0)
    if len(changes) < 20:
        return 1
    lengths = np.diff(changes)
    typical = int(np.median(lengths))
    # if the log rate is no multiple of the update rate, two lengths occur
    is_regular = np.mean(np.abs(lengths - typical) <= (1 if typical > 2 else 0)) > _REGULAR
    return typical if typical > 1 and is_regular else 1
