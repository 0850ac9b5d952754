"""What each channel of a log shows of its sensor: steps, limits, spikes, noise, lag; no model."""

from collections.abc import Iterator

import numpy as np

from robotid._typing import Array
from robotid.doctor.clock import runs_of
from robotid.findings import Finding, listed, log_finding
from robotid.logs.data import Log
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import velocity_lag

__all__ = ["check_channels"]

_COARSE = 100  # a channel of fewer steps than this over its range says little
_PLATEAU = 5  # rows in a row at the very limit of a channel that are no coincidence
_CLIPPED = 0.01  # share of the rows at the limit from which a channel is clipped
_SPIKE = 15.0  # a row this many times farther off its neighbours than usual is a spike
_BEYOND = 1.5  # ... if it is also farther off than this many times what the channel ever is
_RESTING = 3.0  # within so many times its noise a channel stays at a value
_LEAST = {"q": 1e-3, "dq": 0.02}  # [rad or m, rad/s or m/s] less than this is standing still
_LEAST_TORQUE = 0.01  # of the median joint's torque that is as good as none
_ABSURD = 5.0  # a spike this many times what the channel ever is cannot be motion
_HARM = 0.02  # share of a channel's energy in its spikes that ruins a least-squares fit
_NOISY = 0.3  # noise over signal from which a torque tells little
_LATE = 0.02  # [s] robotid does not use a measured velocity that is later than this
_LAG = 0.002  # [s] a shorter lag is not reported
_ALIKE = 0.8  # correlation of a velocity with the derivative of its position
_SCALE = 1.1  # a velocity that is this many times d(q)/dt, or its inverse, is in another unit
_DEAD = 1e-3  # a velocity that moves by less than this share of d(q)/dt does not move


def check_channels(log: Log, signals: SignalSettings) -> Iterator[Finding]:
    """Yield what the channels of a log show of their sensors.

    Args:
        log: The log.
        signals: Where velocities come from, and the delay of measured ones that is corrected.

    Yields:
        "quantised" per kind of channel: a warning for torques of few steps, else a note; warnings
        "clipped" per joint and limit, or "constant_torque" per joint; "spikes" per channel: an
        error where they are absurd and strong enough to ruin a fit; notes "noise" per kind of
        channel and "noisy_torque" where noise prevails; of measured velocities an error
        "velocity_order" for each that is the derivative of another joint's position, at most one
        "velocity_delay", with the scatter over the joints as its uncertainty, and
        "velocity_scale" per joint: an error where they are used, else a note.
    """
    for kind, values in _channels(log):
        yield from _quantisation(log, kind, values)
    moving = np.append((np.diff(log.q, axis=0) != 0).any(axis=1), False)
    for joint, x in zip(log.joints, log.tau.T, strict=True):
        yield from _clipping(log, joint, x, moving)
    for kind, values in _channels(log):
        yield from _spikes(log, kind, values)
    for kind, values in _channels(log):
        yield from _noise(log, kind, values)
    if log.v is not None:
        slope, v = _slopes(log, log.v)
        alike = _correlation(slope, v)  # (n, n): position j, velocity k
        yield from _velocity_order(log, alike)
        yield from _velocity_delay(log, signals.velocity_delay)
        yield from _velocity_scale(log, slope, v, np.diag(alike), signals.velocity)


def _quantisation(log: Log, kind: str, values: Array) -> Iterator[Finding]:
    """Yield the joints whose channel moves in steps: those of few steps, and the others."""
    steps = np.array([_quantum(x) for x in values.T])
    count = np.ptp(values, axis=0) / np.where(steps > 0, steps, 1.0)
    for few in (True, False):
        chosen = np.flatnonzero((steps > 0) & ((count < _COARSE) == few))
        if len(chosen) == 0:
            continue
        names = [log.joints[j] for j in chosen]
        evidence = {f"steps_{log.joints[j]}": count[j] for j in chosen}
        todo = "it is uninformative: scale or log it finer" if few else "log more digits"
        message = (
            f"{kind} of {listed(names)} moves in steps of {steps[chosen].max():.3g}, "
            f"{count[chosen].min():.0f} of them over its range; {todo}"
        )
        severity = "warning" if few and kind == "tau" else "note"
        yield log_finding(log.name, "quantised", severity, message, kind, **evidence)


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
    for limit in (float(x.max()), float(x.min())):
        at = (x == limit) & moving
        share = float(at.mean())
        plateau = max((stop - start for start, stop in runs_of(at)), default=0)
        if share < _CLIPPED or plateau < _PLATEAU or _steps(x) < _COARSE:
            continue
        message = (
            f"the torque of {joint} stays at its limit {limit:.6g} in {100 * share:.3g} % of the "
            "rows while the robot moves: it is clipped, and those rows are wrong; record a gentler "
            "motion or cut them out"
        )
        yield log_finding(log.name, "clipped", "warning", message, joint, limit=limit, share=share)


def _spikes(log: Log, kind: str, values: Array) -> Iterator[Finding]:
    """Yield rows that jump away from both neighbours."""
    reaches = [_reach(log.t, x) for x in values.T]
    least = _LEAST.get(kind, _LEAST_TORQUE * float(np.median(reaches)))
    for joint, x, own in zip(log.joints, values.T, reaches, strict=True):
        reach = max(own, least)
        rows, height = _jumps(log.t, x, reach)
        if len(rows) == 0:
            continue
        largest, first = np.abs(height).max(), log.t[rows[0]]
        energy = np.sum(height**2) / np.sum((x - np.median(x)) ** 2)
        message = (
            f"{kind} of {joint} jumps by up to {largest:.4g} for {len(rows)} rows, the first at "
            f"t = {first:.6g} s; remove these rows from the recording"
        )
        severity = "error" if largest > _ABSURD * reach and energy > _HARM else "note"
        evidence = {"rows": len(rows), "largest": largest, "energy_share": energy, "first": first}
        yield log_finding(log.name, "spikes", severity, message, f"{kind}_{joint}", **evidence)


def _noise(log: Log, kind: str, values: Array) -> Iterator[Finding]:
    """Yield the noise level of a kind of channel, and torques in which it prevails."""
    noise = np.array([_white_noise(log.t, x) for x in values.T])
    size = values.std(axis=0)
    share = np.divide(noise, size, out=np.zeros_like(noise), where=size > 0)
    message = (
        f"white noise of {kind} {', '.join(f'{level:.2g}' for level in noise)} (standard deviation "
        "per joint, in the channel's unit); nothing needs doing"
    )
    evidence = dict(zip(log.joints, noise.tolist(), strict=True))
    yield log_finding(log.name, "noise", "note", message, kind, **evidence)
    for j in np.flatnonzero(share > _NOISY) if kind == "tau" else ():
        joint = log.joints[j]
        message = (
            f"the torque of {joint} is {100 * share[j]:.0f} % noise; record longer, faster, or "
            "with a lower cutoff"
        )
        yield log_finding(log.name, "noisy_torque", "note", message, joint, share=share[j])


def _velocity_order(log: Log, alike: Array) -> Iterator[Finding]:
    """Yield joints whose measured velocity is the derivative of another joint's position."""
    for j, joint in enumerate(log.joints):
        k = int(np.argmax(alike[j]))
        found, own = alike[j, k], alike[j, j]
        if k == j or found < _ALIKE or own > 0.5 * found:
            continue
        message = (
            f"dq_{log.joints[k]} is d(q)/dt of q_{joint} (correlation {found:.2f}; with dq_{joint} "
            f"{own:.2f}): position or velocity columns are in another order; name them rightly"
        )
        evidence = {"correlation": found, "own_correlation": own}
        yield log_finding(log.name, "velocity_order", "error", message, joint, **evidence)


def _velocity_delay(log: Log, stated: float) -> Iterator[Finding]:
    """Yield how late the measured velocity is against the position, beyond what is stated [s]."""
    lag = velocity_lag(log) - stated
    single = [velocity_lag(log.select([joint])) for joint in log.joints]
    used = np.array([x for x in single if x != 0.0]) - stated
    scatter = float(np.median(np.abs(used - lag))) * 1.48 if len(used) else 0.0
    step = float(np.median(np.diff(log.t)))
    error = max(scatter / np.sqrt(max(len(used), 1)), 0.02 * step)
    if abs(lag) < max(_LAG, 3 * error, 0.1 * step):
        return
    is_late = abs(lag) >= _LATE
    what = (
        "velocity = 'auto' differentiates the position instead"
        if is_late
        else "if the torque is as late, keep velocity = 'measured'; else differentiate"
    )
    message = (
        f"the measured velocity is {1e3 * lag:.1f} +- {1e3 * error:.1f} ms late against d(q)/dt; "
        f"{what}, or state [signals] velocity_delay = {lag + stated:.4f}"
    )
    severity = "warning" if is_late else "note"
    yield log_finding(log.name, "velocity_delay", severity, message, delay=lag, std_error=error)


def _velocity_scale(
    log: Log, slope: Array, v: Array, alike: Array, velocity: str
) -> Iterator[Finding]:
    """Yield measured velocities that are a multiple of d(q)/dt, or none.

    The factor lies between the regression of one on the other and the inverse of the regression
    of the other on the one, whatever the noise of both.
    """
    slope, v = slope - slope.mean(axis=0), v - v.mean(axis=0)
    for j, joint in enumerate(log.joints):
        a, b, ab = slope[:, j] @ slope[:, j], v[:, j] @ v[:, j], slope[:, j] @ v[:, j]
        moves = np.ptp(log.q[:, j]) > _LEAST["q"] and np.sqrt(a / len(v)) > _LEAST["dq"]
        is_dead = bool(moves and b < _DEAD**2 * a)
        is_alike = bool(moves and not is_dead and alike[j] > _ALIKE)
        if not is_dead and not (is_alike and (ab / a > _SCALE or b / ab < 1 / _SCALE)):
            continue
        factor = 0.0 if is_dead else float(np.sqrt(b / a))
        what = "hardly changes while the position moves" if is_dead else "is in another unit"
        message = (
            f"dq_{joint} is {factor:.3g} times d(q)/dt of q_{joint}: the measured velocity {what}, "
            "and every friction and inertia with it; correct the column, or set [signals] velocity "
            "= 'differentiated'"
        )
        severity = "note" if velocity == "differentiated" else "error"
        yield log_finding(log.name, "velocity_scale", severity, message, joint, factor=factor)


def _slopes(log: Log, velocity: Array) -> tuple[Array, Array]:
    """Return d(q)/dt and the measured velocity, shape (m, n) each, without gaps."""
    step = np.diff(log.t)[:, None]
    usual = (step < 5 * np.median(step))[:, 0]
    every = max(1, len(step) // 20000)
    slope, v = np.diff(log.q, axis=0) / step, 0.5 * (velocity[1:] + velocity[:-1])
    return slope[usual][::every], v[usual][::every]


def _channels(log: Log) -> Iterator[tuple[str, Array]]:
    for kind, values in (("q", log.q), ("dq", log.v), ("tau", log.tau)):
        if values is not None:
            yield kind, values


def _quantum(x: Array) -> float:
    """Return the step that all values are multiples of, 0 if there is none."""
    levels = np.unique(x)
    if len(levels) < 3 or len(levels) > 0.5 * len(x):
        return 0.0
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * np.ptp(x)]
    if len(steps) == 0:
        return 0.0
    quantum = float(np.quantile(steps, 0.1))
    counts = np.diff(levels)[:1000] / quantum
    return quantum if np.mean(np.abs(counts - np.round(counts)) < 0.02) > 0.95 else 0.0


def _steps(x: Array) -> float:
    quantum = _quantum(x)
    return float(np.ptp(x)) / quantum if quantum > 0 else float("inf")


def _jumps(t: Array, x: Array, reach: float) -> tuple[Array, Array]:
    """Return the rows that jump away from their neighbours, and how far."""
    off = x - _without_spikes(x)
    usual = max(1.48 * float(np.median(np.abs(off))), _white_noise(t, x))
    rows = np.flatnonzero(np.abs(off) > max(_SPIKE * usual, _BEYOND * reach))
    return rows, off[rows]


def _reach(t: Array, x: Array) -> float:
    """Return how far a channel goes from its usual value, spikes apart.

    A joint that rests most of the log is judged by the rest of it.
    """
    usual = np.median(x)
    away = np.abs(_without_spikes(x) - usual)
    away = away[away > _RESTING * _white_noise(t, x)]
    ever = np.abs(x - usual)
    return max(float(np.quantile(part, 0.995)) for part in (ever, away) if len(part))


def _without_spikes(x: Array) -> Array:
    from scipy.ndimage import median_filter

    smooth: Array = median_filter(x, size=5, mode="nearest")
    return smooth


def _white_noise(t: Array, x: Array) -> float:
    """Return the white noise of a smooth signal, from its third divided differences."""
    if len(x) < 10:
        return 0.0
    step = float(np.median(np.diff(t)))
    times = np.array([t[k : len(t) - 3 + k] for k in range(4)]) / step
    values = np.array([x[k : len(x) - 3 + k] for k in range(4)])
    apart = times[:, None] - times[None]  # (4, 4, N - 3)
    apart[range(4), range(4)] = 1.0
    weight = 1 / apart.prod(axis=1)
    size = np.sqrt(np.einsum("kn,kn->n", weight, weight))
    return 1.48 * float(np.median(np.abs(np.einsum("kn,kn->n", weight, values)) / size))


def _correlation(one: Array, other: Array) -> Array:
    """Return the correlation of each column with each of the other, shape (n, n)."""
    a, b = one - one.mean(axis=0), other - other.mean(axis=0)
    size = np.outer(np.linalg.norm(a, axis=0), np.linalg.norm(b, axis=0))
    found: Array = np.divide(a.T @ b, size, out=np.zeros_like(size), where=size > 0)
    return found
