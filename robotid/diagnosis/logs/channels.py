"""Checks of each channel of a log without a model: quantisation, spikes, noise, velocity lag."""

from collections.abc import Iterator

import numpy as np

from robotid.base.findings import Finding
from robotid.base.text import seconds
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.data.measured_velocity import (
    COARSE,
    LARGEST_LAG,
    is_trustworthy,
    quantum,
    unlike_velocities,
    velocity_lags,
)
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.catalogue import finding

_SPIKE = 15.0  # smallest distance of a spike from its neighbours, over the typical distance
_BEYOND = 1.5  # ... and over the amplitude of the channel
_RESTING = 3.0  # [standard deviations of the noise] within which a channel is constant
_LEAST = {"q": 1e-3, "dq": 0.02}  # [rad or m, rad/s or m/s] smaller values: at rest
_LEAST_TORQUE = 0.01  # share of the median joint's torque below which a torque is negligible
_ABSURD = 5.0  # spike over the amplitude of the channel, above which it cannot be motion
_HARM = 0.02  # share of a channel's energy in its spikes that ruins a least-squares fit
_NOISY = 0.3  # noise over signal from which a torque is uninformative
_LAG = 0.002  # [s] a shorter lag is not reported
_ALIKE = 0.8  # least correlation of a velocity with the derivative of its position
_SCALE = 1.1  # velocity over d(q)/dt, or the inverse, from which the unit differs
_ENCODER = 0.01  # largest difference of a step from 2 pi / 2^bits [bits]
_BITS = range(9, 24)  # of encoders
_DEAD = 1e-3  # velocity over d(q)/dt below which the channel is constant


def check_channels(log: Log, signals: SignalSettings) -> Iterator[Finding]:
    """Yield the findings on the sensors behind the channels of a log."""
    channels = dict(_channels(log))
    noise = {kind: _white_noise(log.t, values) for kind, values in channels.items()}
    for kind, values in channels.items():
        yield from _quantisation(log, kind, values, signals.velocity)
    for kind, values in channels.items():
        is_used = kind != "dq" or signals.velocity == "measured"
        is_used = is_used or (signals.velocity == "auto" and is_trustworthy(log))
        yield from _spikes(log, kind, values, noise[kind], is_used=is_used)
    for kind, values in channels.items():
        yield from _noise(log, kind, values, noise[kind])
    if log.v is not None:
        slope, v = _slopes(log, log.v)
        alike = _correlation(slope, v)  # (n, n): position j, velocity k
        exchanged = list(_velocity_order(log, alike))
        yield from exchanged
        if not exchanged:
            yield from _unlike_velocity(log, signals.velocity)
        yield from _velocity_delay(log, signals.velocity_delay)
        yield from _velocity_scale(log, slope, v, np.diag(alike), signals.velocity)


def _quantisation(log: Log, kind: str, values: Array, velocity: str) -> Iterator[Finding]:
    """Yield the joints with a quantised channel: those of few steps, and the others."""
    is_used = kind == "tau" or (kind == "dq" and velocity != "differentiated")
    steps = np.array([quantum(x) for x in values.T])
    count = np.ptp(values, axis=0) / np.where(steps > 0, steps, 1.0)
    for few in (True, False):
        chosen = np.flatnonzero((steps > 0) & ((count < COARSE) == few))
        if len(chosen) == 0:
            continue
        step = float(steps[chosen].max())
        bits = float(np.log2(2 * np.pi / step))
        todo = "few" if few else "more"
        if kind == "dq" and few:
            todo = "few_auto" if velocity == "auto" else "few_velocity"
        elif kind == "q" and abs(bits - round(bits)) < _ENCODER and round(bits) in _BITS:
            todo = "few_encoder" if few else "encoder"
        names = [log.joints[j] for j in chosen]
        yield finding(
            "quantised", log.name, names, subject=kind, todo=todo, channel=kind,
            severity="warning" if few and is_used else "note", step=step, bits=round(bits),
            coarse=COARSE, fewest=count[chosen].min(),
            **{f"steps_{log.joints[j]}": count[j] for j in chosen},
        )  # fmt: skip


def _spikes(
    log: Log, kind: str, values: Array, noise: Array, *, is_used: bool = True
) -> Iterator[Finding]:
    """Yield rows that differ strongly from both neighbours."""
    smooth = _without_spikes(values)
    amplitudes = [_amplitude(*of) for of in zip(values.T, smooth.T, noise, strict=True)]
    least = _LEAST.get(kind, _LEAST_TORQUE * float(np.median(amplitudes)))
    for j, (joint, x) in enumerate(zip(log.joints, values.T, strict=True)):
        amplitude = max(amplitudes[j], least)
        rows, height = _jumps(x - smooth[:, j], noise[j], amplitude)
        if len(rows) == 0:
            continue
        largest, first = np.abs(height).max(), float(log.t[rows[0]])
        energy = np.sum(height**2) / np.sum((x - np.median(x)) ** 2)
        is_harmful = is_used and largest > _ABSURD * amplitude and energy > _HARM
        yield finding(
            "spikes", log.name, joint, subject=f"{kind}_{joint}", channel=kind,
            severity="error" if is_harmful else "note", rows=len(rows), largest=largest,
            energy_share=energy, first=first, when=seconds(first),
        )  # fmt: skip


def _noise(log: Log, kind: str, values: Array, noise: Array) -> Iterator[Finding]:
    """Yield the noise level of a kind of channel, and the torques with too much noise."""
    size = values.std(axis=0)
    share = np.divide(noise, size, out=np.zeros_like(noise), where=size > 0)
    evidence = dict(zip(log.joints, noise.tolist(), strict=True))
    levels = ", ".join(f"{level:.2g}" for level in noise)
    yield finding("noise", log.name, subject=kind, channel=kind, levels=levels, **evidence)
    for j in np.flatnonzero(share > _NOISY) if kind == "tau" else ():
        yield finding("noisy_torque", log.name, log.joints[j], share=share[j])


def _velocity_order(log: Log, alike: Array) -> Iterator[Finding]:
    """Yield joints whose measured velocity is the derivative of another joint's position."""
    for j, joint in enumerate(log.joints):
        k = int(np.argmax(alike[j]))
        found, own = alike[j, k], alike[j, j]
        if k != j and found >= _ALIKE and own <= 0.5 * found:
            evidence = {"correlation": found, "own_correlation": own}
            yield finding("velocity_order", log.name, joint, other=log.joints[k], **evidence)


def _unlike_velocity(log: Log, velocity: str) -> Iterator[Finding]:
    """Yield measured velocities that are not the derivatives of their positions at any delay."""
    severity = {"measured": "error", "auto": "warning"}.get(velocity, "note")
    for joint, alike in unlike_velocities(log).items():
        yield finding(
            "velocity_mismatch", log.name, joint, subject=f"dq_{joint}", severity=severity,
            todo=velocity == "auto", correlation=alike,
        )  # fmt: skip


def _velocity_delay(log: Log, stated: float) -> Iterator[Finding]:
    """Yield the delay of the measured velocity relative to the position, beyond the stated one."""
    common, single = velocity_lags(log)
    lag, used = common - stated, single[single != 0.0] - stated
    scatter = float(np.median(np.abs(used - lag))) * 1.48 if len(used) else 0.0
    step = float(np.median(np.diff(log.t)))
    error = max(scatter / np.sqrt(max(len(used), 1)), 0.02 * step)
    if abs(lag) < max(_LAG, 3 * error, 0.1 * step):
        return
    is_delayed = abs(lag) >= LARGEST_LAG
    yield finding(
        "velocity_delay", log.name, severity="warning" if is_delayed else "note", todo=is_delayed,
        delay=lag, std_error=error, total=lag + stated,
    )  # fmt: skip


def _velocity_scale(
    log: Log, slope: Array, v: Array, alike: Array, velocity: str
) -> Iterator[Finding]:
    """Yield measured velocities that are a multiple of d(q)/dt, or constant.

    The factor lies between the slope of the regression of v on d(q)/dt and the inverse of the
    slope of the regression of d(q)/dt on v, for any noise in the two.
    """
    slope, v = slope - slope.mean(axis=0), v - v.mean(axis=0)
    severity = {"differentiated": "note", "auto": "error" if log.has_torque else "warning"}
    for j, joint in enumerate(log.joints):
        a, b, ab = slope[:, j] @ slope[:, j], v[:, j] @ v[:, j], slope[:, j] @ v[:, j]
        moves = np.ptp(log.q[:, j]) > _LEAST["q"] and np.sqrt(a / len(v)) > _LEAST["dq"]
        is_dead = bool(moves and b < _DEAD**2 * a)
        is_alike = bool(moves and not is_dead and alike[j] > _ALIKE)
        if is_dead or (is_alike and (ab / a > _SCALE or b / ab < 1 / _SCALE)):
            yield finding(
                "velocity_scale", log.name, joint, severity=severity.get(velocity, "error"),
                what=is_dead, factor=0.0 if is_dead else float(np.sqrt(b / a)),
            )  # fmt: skip


def _slopes(log: Log, velocity: Array) -> tuple[Array, Array]:
    """Return d(q)/dt and the measured velocity, shape (m, n) each, of steps of a usual length."""
    step = np.diff(log.t)[:, None]
    median = np.median(step)
    is_regular = ((step > median / 5) & (step < 5 * median))[:, 0]
    every = max(1, len(step) // 20000)
    slope, v = (
        np.diff(np.unwrap(log.q, axis=0), axis=0) / step,
        0.5 * (velocity[1:] + velocity[:-1]),
    )
    return slope[is_regular][::every], v[is_regular][::every]


def _channels(log: Log) -> Iterator[tuple[str, Array]]:
    for kind, values in (("q", log.q), ("dq", log.v), ("tau", log.tau)):
        if values is not None and (kind != "tau" or log.has_torque):
            yield kind, values


def _jumps(deviation: Array, noise: float, amplitude: float) -> tuple[Array, Array]:
    """Return the rows that differ strongly from their neighbours, and their deviations."""
    size = np.abs(deviation)
    rows = np.flatnonzero(size > _BEYOND * amplitude)
    if len(rows):
        typical = max(1.48 * float(np.median(size)), noise)
        rows = rows[size[rows] > _SPIKE * typical]
    return rows, deviation[rows]


def _amplitude(x: Array, smooth: Array, noise: float) -> float:
    """Return the 99.5 % quantile of the distance of a channel from its median, without spikes.

    Of a joint that is at rest in most of the log, only the rows in which it moves count.
    """
    median = np.median(x)
    away = np.abs(smooth - median)
    away = away[away > _RESTING * noise]
    distance = np.abs(x - median)
    return max(float(np.quantile(part, 0.995)) for part in (distance, away) if len(part))


def _without_spikes(x: Array) -> Array:
    """Return the running median over five rows, shape (N, n)."""
    padded = np.pad(x, ((2, 2), (0, 0)), mode="edge")
    a, b, c, d, e = (padded[k : len(x) + k] for k in range(5))
    # the median of five is the median of e and of the middle two of the others
    low = np.maximum(np.minimum(a, b), np.minimum(c, d))
    high = np.minimum(np.maximum(a, b), np.maximum(c, d))
    middle: Array = np.maximum(np.minimum(low, high), np.minimum(np.maximum(low, high), e))
    return middle


def _white_noise(t: Array, values: Array) -> Array:
    """Return the white noise of signals from their third divided differences, shape (n,)."""
    if len(t) < 10:
        return np.zeros(values.shape[1])
    step = float(np.median(np.diff(t)))
    times = np.array([t[k : len(t) - 3 + k] for k in range(4)]) / step
    distance = times[:, None] - times[None]  # (4, 4, N - 3)
    distance[range(4), range(4)] = 1.0
    weight = 1 / distance.prod(axis=1)
    size = np.sqrt(np.einsum("kn,kn->n", weight, weight))
    weight /= size
    differences = sum(w[:, None] * values[k : len(t) - 3 + k] for k, w in enumerate(weight))
    return np.asarray(1.48 * np.median(np.abs(differences), axis=0))


def _correlation(one: Array, other: Array) -> Array:
    """Return the correlation of each column with each of the other, shape (n, n)."""
    a, b = one - one.mean(axis=0), other - other.mean(axis=0)
    size = np.outer(np.linalg.norm(a, axis=0), np.linalg.norm(b, axis=0))
    found: Array = np.divide(a.T @ b, size, out=np.zeros_like(size), where=size > 0)
    return found
