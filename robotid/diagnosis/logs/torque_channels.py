"""Checks of the torque channels of a log for faults of the sensor or driver, without a model."""

from collections.abc import Iterator

import numpy as np

from robotid.base.findings import Finding, listed, log_finding, quoted
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.data.measured_velocity import COARSE, quantum
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
        message = (
            f"the torque of {joint} is {value:.6g} in every row while the robot moves: the channel "
            "is dead. The drive of this joint cannot be identified; log "
            f"tau_{joint}, or leave the joint out"
        )
        if moves and value == 0.0:
            message = (
                f"the torque of {joint} is 0 in every row while the joint moves: it has no drive, "
                f"or the channel is dead. If it has no drive, state passive = [{quoted(joint)}] in "
                f"the job file; else log tau_{joint}"
            )
        yield log_finding(log.name, "constant_torque", "warning", message, joint, value=value)
        return
    step = quantum(x)
    for limit in (float(x.max()), float(x.min())):
        at = (x == limit) & moving
        share = float(at.mean())
        plateau = max((stop - start for start, stop in runs_of(at)), default=0)
        is_coarse = step > 0 and np.ptp(x) / step < COARSE
        if share < _CLIPPED or plateau < _PLATEAU or is_coarse:
            continue
        message = (
            f"the torque of {joint} is at its limit {limit:.6g} in {100 * share:.3g} % of the "
            "rows while the robot moves: it is clipped, and these rows are wrong; record a slower "
            "motion, or remove these rows"
        )
        yield log_finding(log.name, "clipped", "warning", message, joint, limit=limit, share=share)


def _unsigned(log: Log) -> Iterator[Finding]:
    """Yield a finding if no torque is ever negative although several reach 0 repeatedly.

    A single such torque may belong to a joint that gravity loads in one direction only.
    """
    touching = sum(_touches(x) >= _TOUCHES for x in log.tau.T)
    if log.tau.min() < 0 or touching < _ALL:
        return
    message = (
        f"no torque is ever negative, although the torques of {touching} joints reach 0 "
        "repeatedly: they are absolute values, as some servos report their load. An "
        "identification from them is wrong; log torques with their signs"
    )
    yield log_finding(log.name, "unsigned_torque", "error", message, joints=touching)


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
    tau = log.tau[fresh]
    lengths = np.array([_hold(x) for x in tau.T])
    for length in np.unique(lengths[lengths > 1]):
        names = [log.joints[j] for j in np.flatnonzero(lengths == length)]
        step = float(np.median(np.diff(log.t)))
        delay = 0.5 * (length - 1) * step
        message = (
            f"the torque of {listed(names)} is constant for {length:.0f} rows: it is updated at "
            f"{1 / (length * step):.3g} Hz and logged at {1 / step:.3g} Hz. This is a mean delay "
            f"of {1e3 * delay:.2g} ms; log it at the rate of the position, or set "
            f"[signals] torque_delay = {delay:.4f} (--torque-delay {delay:.4f}) and a cutoff below "
            f"{0.25 / (length * step):.2g} Hz"
        )
        part = "" if len(names) == len(log.joints) else listed(names)
        yield log_finding(
            log.name, "repeated_torque", "warning", message, part, rows=length, delay=delay
        )


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
