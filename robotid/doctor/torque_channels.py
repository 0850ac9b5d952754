"""What the torque channels of a log show of the sensor or driver behind them; no model."""

from collections.abc import Iterator

import numpy as np

from robotid._typing import Array
from robotid.doctor.clock import runs_of
from robotid.findings import Finding, listed, log_finding
from robotid.logs.data import Log
from robotid.logs.measured_velocity import COARSE, quantum

__all__ = ["check_torque_channels"]

_PLATEAU = 5  # rows in a row at the very limit of a channel that are no coincidence
_CLIPPED = 0.01  # share of the rows at the limit from which a channel is clipped
_ZERO = 0.05  # of its top, below which a torque that is never negative has come down to 0
_AWAY = 0.2  # of its top, above which it has left 0 again
_TOUCHES = 3  # times that it comes to 0 and turns back that are no coincidence
_ALL = 3  # joints from which it is no coincidence that no torque is ever negative
_REGULAR = 0.8  # share of holds of about one length that no quantised torque has


def check_torque_channels(log: Log) -> Iterator[Finding]:
    """Yield what the torques of a log show of their sensors.

    Args:
        log: The log.

    Yields:
        Warnings "clipped" per joint and limit, or "constant_torque" per joint; one error
        "unsigned_torque" if no torque has a sign; one warning "repeated_torque" of the joints whose
        torque is updated less often than it is logged.
    """
    moving = np.append((np.diff(log.q, axis=0) != 0).any(axis=1), False)
    for joint, x in zip(log.joints, log.tau.T, strict=True):
        yield from _clipping(log, joint, x, moving)
    yield from _unsigned(log)
    yield from _held(log)


def _clipping(log: Log, joint: str, x: Array, moving: Array) -> Iterator[Finding]:
    """Yield whether a torque stays at a limit, or at one value, in rows where the robot moves."""
    if moving.any() and np.ptp(x) == 0:
        value = float(x[0]) + 0.0  # no -0
        message = (
            f"the torque of {joint} is {value:.6g} in every row while the robot moves: the channel "
            "is dead, and nothing of this joint's drive can be identified; log "
            f"tau_{joint}, or leave the joint out"
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
            f"the torque of {joint} stays at its limit {limit:.6g} in {100 * share:.3g} % of the "
            "rows while the robot moves: it is clipped, and those rows are wrong; record a gentler "
            "motion or cut them out"
        )
        yield log_finding(log.name, "clipped", "warning", message, joint, limit=limit, share=share)


def _unsigned(log: Log) -> Iterator[Finding]:
    """Yield whether no torque is ever negative although several come to 0 again and again.

    One such torque may be that of a joint that gravity loads one way only.
    """
    touching = sum(_touches(x) >= _TOUCHES for x in log.tau.T)
    if log.tau.min() < 0 or touching < _ALL:
        return
    message = (
        f"no torque is ever negative, although those of {touching} joints come down to 0 again and "
        "again: they are sizes without their signs, as some servos report their load, and nothing "
        "identified from them is right; log torques with their signs"
    )
    yield log_finding(log.name, "unsigned_torque", "error", message, joints=touching)


def _touches(x: Array) -> int:
    """Return how often a torque comes to 0 and leaves again."""
    top = float(np.quantile(np.abs(x), 0.995))
    near = runs_of(x < _AWAY * top)
    return sum(x[i:k].min() < _ZERO * top for i, k in near if i > 0 and k < len(x))


def _held(log: Log) -> Iterator[Finding]:
    """Yield the joints whose torque changes every so many rows only, while the robot moves.

    Rows that repeat in every channel are those of the logger and are told elsewhere; a torque of
    few steps stays at one of them for irregular times.
    """
    fresh = np.append(True, (np.diff(log.q, axis=0) != 0).any(axis=1))
    tau = log.tau[fresh]
    lengths = np.array([_hold(x) for x in tau.T])
    for length in np.unique(lengths[lengths > 1]):
        names = [log.joints[j] for j in np.flatnonzero(lengths == length)]
        step = float(np.median(np.diff(log.t)))
        late = 0.5 * (length - 1) * step
        message = (
            f"the torque of {listed(names)} is held for {length:.0f} rows: it is updated at "
            f"{1 / (length * step):.3g} Hz and logged at {1 / step:.3g} Hz, which makes it "
            f"{1e3 * late:.2g} ms late on average; log it as often as the position, or state "
            f"[signals] torque_delay = {late:.4f} (--torque-delay {late:.4f}) and a cutoff below "
            f"{0.25 / (length * step):.2g} Hz"
        )
        part = "" if len(names) == len(log.joints) else listed(names)
        yield log_finding(
            log.name, "repeated_torque", "warning", message, part, rows=length, delay=late
        )


def _hold(x: Array) -> int:
    """Return for how many rows a torque is held at a time, 1 if for none or irregularly."""
    changes = np.flatnonzero(np.diff(x) != 0)
    if len(changes) < 20:
        return 1
    lengths = np.diff(changes)
    usual = int(np.median(lengths))
    # a rate that is no whole share of the log's makes holds of two lengths
    is_regular = np.mean(np.abs(lengths - usual) <= (1 if usual > 2 else 0)) > _REGULAR
    return usual if usual > 1 and is_regular else 1
