"""What each channel of a log shows of its sensor: steps, limits, spikes, noise, lag; no model."""

from collections.abc import Iterator

import numpy as np

from robotid._typing import Array
from robotid.doctor.clock import runs_of
from robotid.findings import Finding, listed
from robotid.logs.data import Log
from robotid.logs.signals import velocity_lag

__all__ = [
    "check_clipping",
    "check_noise",
    "check_quantisation",
    "check_spikes",
    "check_velocity_delay",
    "check_velocity_order",
    "check_velocity_scale",
]

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


def check_quantisation(log: Log) -> Iterator[Finding]:
    """Yield channels that move in steps.

    Args:
        log: The log.

    Yields:
        "quantised" per kind of channel: a warning for joints with few steps, else a note.
    """
    for kind, values in _channels(log):
        steps = np.array([_quantum(x) for x in values.T])
        count = np.array([np.ptp(x) for x in values.T]) / np.where(steps > 0, steps, 1.0)
        for few in (True, False):
            chosen = np.flatnonzero((steps > 0) & ((count < _COARSE) == few))
            if len(chosen) == 0:
                continue
            names = [log.joints[j] for j in chosen]
            evidence = {f"steps_{log.joints[j]}": float(count[j]) for j in chosen}
            message = (
                f"{log.name}: {kind} of {listed(names)} moves in steps of "
                f"{steps[chosen].max():.3g}, "
                f"{count[chosen].min():.0f} of them over its range; "
                + ("it is uninformative: scale or log it finer" if few else "log more digits")
            )
            severity = "warning" if few and kind == "tau" else "note"
            yield Finding("quantised", severity, f"{log.name}: {kind}", message, evidence)


def check_clipping(log: Log) -> Iterator[Finding]:
    """Yield torques that stay at their largest value, or at one value throughout.

    Args:
        log: The log.

    Yields:
        A warning "clipped" per joint and limit, or "constant_torque" per joint.
    """
    moving = np.append((np.diff(log.q, axis=0) != 0).any(axis=1), False)
    for joint, x in zip(log.joints, log.tau.T, strict=True):
        if moving.any() and np.ptp(x) == 0:
            message = (
                f"{log.name}: the torque of {joint} is {x[0] + 0.0:.6g} in every row while the "
                "robot moves: the channel is dead, and nothing of this joint's drive can be "
                f"identified; log tau_{joint}, or leave the joint out"
            )
            evidence = {"value": float(x[0]) + 0.0}
            yield Finding("constant_torque", "warning", f"{log.name}: {joint}", message, evidence)
            continue
        for limit in (float(x.max()), float(x.min())):
            at = (x == limit) & moving
            plateau = max((stop - start for start, stop in runs_of(at)), default=0)
            if at.mean() < _CLIPPED or plateau < _PLATEAU or _steps(x) < _COARSE:
                continue
            message = (
                f"{log.name}: the torque of {joint} stays at its limit {limit:.6g} in "
                f"{100 * at.mean():.3g} % of the rows while the robot moves: it is clipped, and "
                "those rows are wrong; record a gentler motion or cut them out"
            )
            evidence = {"limit": limit, "share": float(at.mean())}
            yield Finding("clipped", "warning", f"{log.name}: {joint}", message, evidence)


def check_spikes(log: Log) -> Iterator[Finding]:
    """Yield rows that jump away from both neighbours.

    Args:
        log: The log.

    Yields:
        "spikes" per channel: an error where they are absurd and strong enough to ruin a fit.
    """
    for kind, values in _channels(log):
        reaches = [_reach(log.t, x) for x in values.T]
        least = _LEAST.get(kind, _LEAST_TORQUE * float(np.median(reaches)))
        for joint, x, own in zip(log.joints, values.T, reaches, strict=True):
            reach = max(own, least)
            rows, height = _spikes(log.t, x, reach)
            if len(rows) == 0:
                continue
            energy = float(np.sum(height**2) / np.sum((x - np.median(x)) ** 2))
            message = (
                f"{log.name}: {kind} of {joint} jumps by up to {np.abs(height).max():.4g} for "
                f"{len(rows)} rows, the first at t = {log.t[rows[0]]:.6g} s; remove these rows "
                "from the recording"
            )
            evidence = {
                "rows": len(rows),
                "largest": float(np.abs(height).max()),
                "energy_share": energy,
                "first": float(log.t[rows[0]]),
            }
            absurd = evidence["largest"] > _ABSURD * reach and energy > _HARM
            severity = "error" if absurd else "note"
            yield Finding("spikes", severity, f"{log.name}: {kind}_{joint}", message, evidence)


def check_noise(log: Log) -> Iterator[Finding]:
    """Yield the noise level of every channel.

    Args:
        log: The log.

    Yields:
        A note "noise" per kind of channel, and a note "noisy_torque" where noise prevails.
    """
    for kind, values in _channels(log):
        noise = np.array([_noise(log.t, x) for x in values.T])
        size = values.std(axis=0)
        share = np.divide(noise, size, out=np.zeros_like(noise), where=size > 0)
        shown = ", ".join(f"{level:.2g}" for level in noise)
        evidence = dict(zip(log.joints, noise.tolist(), strict=True))
        message = (
            f"{log.name}: white noise of {kind} {shown} (standard deviation per joint, in the "
            "channel's unit); nothing needs doing"
        )
        yield Finding("noise", "note", f"{log.name}: {kind}", message, evidence)
        for j in np.flatnonzero(share > _NOISY) if kind == "tau" else ():
            message = (
                f"{log.name}: the torque of {log.joints[j]} is {100 * share[j]:.0f} % noise; "
                "record longer, faster, or with a lower cutoff"
            )
            where = f"{log.name}: {log.joints[j]}"
            yield Finding("noisy_torque", "note", where, message, {"share": float(share[j])})


def check_velocity_delay(log: Log, stated: float = 0.0) -> Iterator[Finding]:
    """Yield how late the measured velocity is against the position.

    Args:
        log: The log.
        stated: The delay that is known and corrected [s].

    Yields:
        At most one "velocity_delay", with the scatter over the joints as its uncertainty.
    """
    if log.v is None:
        return
    lag = velocity_lag(log) - stated
    single = [velocity_lag(log.select([joint])) for joint in log.joints]
    used = np.array([x for x in single if x != 0.0]) - stated
    scatter = float(np.median(np.abs(used - lag))) * 1.48 if len(used) else 0.0
    error = max(scatter / np.sqrt(max(len(used), 1)), 0.02 * float(np.median(np.diff(log.t))))
    if abs(lag) < max(_LAG, 3 * error, 0.1 * float(np.median(np.diff(log.t)))):
        return
    severity = "warning" if abs(lag) >= _LATE else "note"
    what = (
        "velocity = 'auto' differentiates the position instead"
        if abs(lag) >= _LATE
        else "if the torque is as late, keep velocity = 'measured'; else differentiate"
    )
    message = (
        f"{log.name}: the measured velocity is {1e3 * lag:.1f} +- {1e3 * error:.1f} ms late "
        f"against d(q)/dt; {what}, or state [signals] velocity_delay = {lag + stated:.4f}"
    )
    evidence = {"delay": lag, "std_error": error}
    yield Finding("velocity_delay", severity, log.name, message, evidence)


def check_velocity_order(log: Log) -> Iterator[Finding]:
    """Yield joints whose measured velocity is the derivative of another joint's position.

    Args:
        log: The log.

    Yields:
        An error "velocity_order" for each pair of joints that are exchanged.
    """
    if log.v is None:
        return
    alike = _correlation(*_slopes(log, log.v))  # (n, n): position j, velocity k
    for j, joint in enumerate(log.joints):
        k = int(np.argmax(alike[j]))
        if k == j or alike[j, k] < _ALIKE or alike[j, j] > 0.5 * alike[j, k]:
            continue
        message = (
            f"{log.name}: dq_{log.joints[k]} is d(q)/dt of q_{joint} (correlation "
            f"{alike[j, k]:.2f}; with dq_{joint} {alike[j, j]:.2f}): position or velocity columns "
            "are in another order; name them rightly"
        )
        evidence = {"correlation": float(alike[j, k]), "own_correlation": float(alike[j, j])}
        yield Finding("velocity_order", "error", f"{log.name}: {joint}", message, evidence)


def check_velocity_scale(log: Log, velocity: str) -> Iterator[Finding]:
    """Yield measured velocities that are a multiple of d(q)/dt, or none.

    The factor lies between the regression of one on the other and the inverse of the regression
    of the other on the one, whatever the noise of both.

    Args:
        log: The log.
        velocity: Setting of where velocities come from; if "differentiated" these are not used.

    Yields:
        "velocity_scale" per joint: an error where they are used, else a note.
    """
    if log.v is None:
        return
    slope, v = _slopes(log, log.v)
    alike = np.diag(_correlation(slope, v))
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
            f"{log.name}: dq_{joint} is {factor:.3g} times d(q)/dt of q_{joint}: the measured "
            f"velocity {what}, and every friction and inertia with it; correct the column, or set "
            "[signals] velocity = 'differentiated'"
        )
        severity = "note" if velocity == "differentiated" else "error"
        where = f"{log.name}: {joint}"
        yield Finding("velocity_scale", severity, where, message, {"factor": factor})


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


def _spikes(t: Array, x: Array, reach: float) -> tuple[Array, Array]:
    """Return the rows that jump away from their neighbours, and how far."""
    off = x - _without_spikes(x)
    usual = max(1.48 * float(np.median(np.abs(off))), _noise(t, x))
    rows = np.flatnonzero(np.abs(off) > max(_SPIKE * usual, _BEYOND * reach))
    return rows, off[rows]


def _reach(t: Array, x: Array) -> float:
    """Return how far a channel goes from its usual value, spikes apart.

    A joint that rests most of the log is judged by the rest of it.
    """
    usual = np.median(x)
    away = np.abs(_without_spikes(x) - usual)
    away = away[away > _RESTING * _noise(t, x)]
    ever = np.abs(x - usual)
    return max(float(np.quantile(part, 0.995)) for part in (ever, away) if len(part))


def _without_spikes(x: Array) -> Array:
    from scipy.ndimage import median_filter

    smooth: Array = median_filter(x, size=5, mode="nearest")
    return smooth


def _noise(t: Array, x: Array) -> float:
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
