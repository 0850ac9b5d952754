"""Checks of time stamps, motion, sensors and torque channels of a log; no model of the robot."""

from collections.abc import Iterator, Sequence

import numpy as np

from robotid.base.findings import Finding, listed, quoted, toml_key
from robotid.base.text import seconds
from robotid.base.tolerances import TINY
from robotid.base.typing import Array
from robotid.data import units
from robotid.data.base_motion import GAP_STEPS
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.units import AT_REST, STATIC, STILL
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.decisions import (
    AGREES,
    BETTER,
    BEYOND_NOISE,
    CORRELATED,
    DIFFERS,
    FEWEST,
    MOST,
    NO_ERROR_OF_MASSES,
    OUTLIER,
    ROWS,
    SCATTERED,
    SEGMENTS,
    SHARE_OF_ROWS,
    SIGNIFICANT,
    ZERO,
)
from robotid.robot.parameters import ParameterLayout
from robotid.robot.tree import Joint

MOVING = 0.1  # Share of the log in which a joint must move
_LEAST = {"q": STATIC, "dq": AT_REST}  # [rad or m, rad/s or m/s] smaller values: at rest
_BITS = range(9, 24)  # of encoders
_OTHER = 0.01  # relative difference from which a clock, or the step of an encoder, is another one
_RPM = 30 / np.pi  # [1/min per rad/s]
# [s] A longer rest at an end is reported; in a longer gap, a position that moves as in one step
# shows that the clock was set.
_PAUSE = 1.0
_LONG = 0.05  # [s] a longer gap is a warning
_LENGTHS = {"mm": 1e-3, "cm": 1e-2}  # [m]
_HARDLY = {"rad": 0.2, "m": 0.05}  # smaller range: the joint hardly moves
_AROUND = 9  # rows around one, of the mean torque and of a motion before and after repeated rows


def check_channels(log: Log, signals: SignalSettings) -> Iterator[Finding]:
    """Yield the findings on the sensors behind the channels of a log."""
    every = {"q": log.q, "dq": log.v, "tau": log.tau if log.has_torque else None}
    channels = {kind: values for kind, values in every.items() if values is not None}
    noise = {kind: _white_noise(log.t, values) for kind, values in channels.items()}
    for kind, values in channels.items():
        yield from _quantisation(log, kind, values, signals.velocity)
        yield from _noise(log, kind, values, noise[kind])
        is_used = kind != "dq" or signals.velocity == "measured"
        is_used = is_used or (signals.velocity == "auto" and units.is_trustworthy(log))
        yield from _spikes(log, kind, values, noise[kind], is_used=is_used)
    stuck = {x.joints: x for x in _stuck(log)}
    wrong = [*stuck.values(), *(x for x in _jumps(log) if x.joints not in stuck)]  # as it goes on
    yield from wrong
    if log.v is not None and not wrong:
        moved, integral = units.displacements(log, log.v)
        exchanged = list(_velocity_order(log, moved, integral))
        yield from exchanged
        if not exchanged:
            yield from _unlike_velocity(log, signals.velocity)
        yield from _velocity_delay(log, signals.velocity_delay)
        yield from _velocity_scale(log, log.v, moved, integral, signals.velocity)


def _quantisation(log: Log, kind: str, values: Array, velocity: str) -> Iterator[Finding]:
    """Yield the joints with a quantised channel: those of few steps, and the others."""
    is_used = kind == "tau" or (kind == "dq" and velocity != "differentiated")
    steps = np.array([units.quantum(x) for x in values.T])
    count = np.ptp(values, axis=0) / np.where(steps > 0, steps, 1.0)
    for few in (True, False):
        chosen = np.flatnonzero((steps > 0) & ((count < units.COARSE) == few))
        if len(chosen) == 0:
            continue
        step = float(steps[chosen].max())
        bits = float(np.log2(2 * np.pi / step))
        todo = "few" if few else "more"
        if kind == "dq" and few:
            todo = "few_auto" if velocity == "auto" else "few_velocity"
        elif (
            kind == "q" and abs(2.0 ** (bits - round(bits)) - 1.0) < _OTHER and round(bits) in _BITS
        ):
            todo = "few_encoder" if few else "encoder"
        names = [log.joints[j] for j in chosen]
        yield finding(
            "quantised", log.name, names, subject=kind, todo=todo, channel=kind,
            severity="warning" if few and is_used else "note", step=step, bits=round(bits),
            coarse=units.COARSE, fewest=count[chosen].min(),
            **{f"steps_{log.joints[j]}": count[j] for j in chosen},
        )  # fmt: skip


def _spikes(
    log: Log, kind: str, values: Array, noise: Array, *, is_used: bool = True
) -> Iterator[Finding]:
    """Yield rows that differ strongly from both neighbours."""
    from scipy.ndimage import median_filter  # takes long to import

    smooth = median_filter(values, size=(5, 1), mode="nearest")
    amplitudes = [_amplitude(*of) for of in zip(values.T, smooth.T, noise, strict=True)]
    least = _LEAST.get(kind, ZERO * float(np.median(amplitudes)))
    for j, (joint, x) in enumerate(zip(log.joints, values.T, strict=True)):
        amplitude, deviation = max(amplitudes[j], least), x - smooth[:, j]
        typical = max(1.48 * float(np.median(np.abs(deviation))), noise[j])
        smallest = max(amplitude / BETTER, OUTLIER * typical)
        rows = np.flatnonzero(np.abs(deviation) > smallest)
        if len(rows) == 0:
            continue
        largest, first = np.abs(deviation[rows]).max(), float(log.t[rows[0]])
        energy = np.sum(deviation[rows] ** 2) / np.sum((x - np.median(x)) ** 2)
        is_harmful = is_used and largest > SIGNIFICANT * amplitude and energy > SHARE_OF_ROWS
        yield finding(
            "spikes", log.name, joint, subject=f"{kind}_{joint}", channel=kind,
            severity="error" if is_harmful else "note", rows=len(rows), largest=largest,
            energy_share=energy, first=first, when=seconds(first),
        )  # fmt: skip


def _jumps(log: Log) -> Iterator[Finding]:
    """Yield positions that jump between two rows: of a joint, or of all where rows are missing."""
    from scipy.ndimage import median_filter  # takes long to import

    step = np.diff(log.t)
    smooth = median_filter(np.unwrap(log.q, axis=0), size=(5, 1), mode="nearest")
    change = np.diff(smooth, axis=0) * (step < GAP_STEPS * np.median(step))[:, None]
    usual = median_filter(change, size=(5, 1), mode="nearest")
    fast = np.quantile(np.abs(usual), 0.995, axis=0)
    jumps = np.abs(change - usual) > np.maximum(STILL, SIGNIFICANT * fast)  # (N - 1, n)
    together = jumps.sum(axis=1) > 1
    places = {joint: jumps[:, j] for j, joint in enumerate(log.joints)}
    if together.sum() > BETTER * jumps.any(axis=1).sum():
        places = {"": together}  # of all joints
    for joint, is_jump in places.items():
        if len(rows := np.flatnonzero(is_jump) + 1):
            figures = {"what": bool(joint), "rows": len(rows), "first": log.t[rows[0]]}
            yield finding("position_jump", log.name, (joint,) * bool(joint), **figures)


def _stuck(log: Log) -> Iterator[Finding]:
    """Yield positions that stop abruptly and are exactly constant, but differ in all other rows."""
    is_same = np.diff(log.q, axis=0) == 0
    for j, joint in enumerate(log.joints):
        runs = runs_of(is_same[:, j])
        first, last = max(runs, key=lambda run: run[1] - run[0], default=(0, 0))
        share, others = (last - first) / len(log.t), is_same[:, j].sum() - (last - first)
        if share < SHARE_OF_ROWS or others > ZERO * (last - first) or is_same[first:last].all():
            continue
        if _stops(log.q[:, [j]], first):
            yield finding("stuck_position", log.name, joint, start=log.t[first], share=share)


def _stops(q: Array, row: int, slow: float = 0.0) -> bool:
    """Return whether positions that move faster than slow stop at a row, not slowing down."""
    if row < _AROUND:
        return False
    late, whole = (float(np.linalg.norm(q[row] - q[row - k])) for k in (3, _AROUND))
    return late > max(BETTER * whole / 3, 3 * slow)


def _noise(log: Log, kind: str, values: Array, noise: Array) -> Iterator[Finding]:
    """Yield the noise level of a kind of channel, and the torques with too much noise."""
    size = values.std(axis=0)
    share = np.divide(noise, size, out=np.zeros_like(noise), where=size > 0)
    evidence = dict(zip(log.joints, noise.tolist(), strict=True))
    levels = ", ".join(f"{level:.2g}" for level in noise)
    yield finding("noise", log.name, subject=kind, channel=kind, levels=levels, **evidence)
    for j in np.flatnonzero(share**2 > DIFFERS) if kind == "tau" else ():
        yield finding("noisy_torque", log.name, log.joints[j], share=share[j])


def _velocity_order(log: Log, moved: Array, integral: Array) -> Iterator[Finding]:
    """Yield joints whose measured velocity is the derivative of another joint's position."""
    a, b = moved - moved.mean(axis=0), integral - integral.mean(axis=0)
    size = np.outer(np.linalg.norm(a, axis=0), np.linalg.norm(b, axis=0))
    alike = np.divide(a.T @ b, size, out=np.zeros_like(size), where=size > 0)  # position, velocity
    for j, k in enumerate(np.argmax(alike, axis=1).tolist()):
        largest, own = alike[j, k], alike[j, j]
        if k != j and largest >= CORRELATED and own <= BETTER * largest:
            evidence = {"correlation": largest, "own_correlation": own}
            yield finding(
                "velocity_order", log.name, log.joints[j], other=log.joints[k], **evidence
            )


def _unlike_velocity(log: Log, velocity: str) -> Iterator[Finding]:
    """Yield measured velocities that are not the derivatives of their positions at any delay."""
    severity = {"measured": "error", "auto": "warning"}.get(velocity, "note")
    for joint, alike in units.unlike_velocities(log).items():
        yield finding(
            "velocity_mismatch", log.name, joint, subject=f"dq_{joint}", severity=severity,
            todo=velocity == "auto", correlation=alike,
        )  # fmt: skip


def _velocity_delay(log: Log, stated: float) -> Iterator[Finding]:
    """Yield the delay of the measured velocity relative to the position, beyond the stated one."""
    common, single = units.velocity_lags(log)
    lag, used = common - stated, single[single != 0.0] - stated
    scatter = float(np.median(np.abs(used - lag))) * 1.48 if len(used) else 0.0
    step = float(np.median(np.diff(log.t)))
    error = max(scatter / np.sqrt(max(len(used), 1)), 0.02 * step)
    if abs(lag) < max(BEYOND_NOISE * error, DIFFERS * step):
        return
    is_delayed = abs(lag) >= units.LARGEST_LAG
    yield finding(
        "velocity_delay", log.name, severity="warning" if is_delayed else "note", todo=is_delayed,
        delay=lag, std_error=error, total=lag + stated,
    )  # fmt: skip


def _velocity_scale(
    log: Log, v: Array, moved: Array, integral: Array, velocity: str
) -> Iterator[Finding]:
    """Yield the factor of the clock, if most velocities have one, and velocities with another."""
    groups: list[list[tuple[str, float, float]]] = []  # joints with about one factor, and its error
    for j in np.flatnonzero(np.ptp(log.q, axis=0) > STATIC).tolist():
        known = _factor(moved[:, j], integral[:, j]) if np.ptp(v[:, j]) > 0 else (0.0, 0.0)
        if known is not None:
            least = DIFFERS * known[0] + BEYOND_NOISE * known[1]
            near = [x for x in groups if abs(x[0][1] - known[0]) <= least]
            groups += [] if near else [[]]
            (near or groups)[-1].append((log.joints[j], *known))
    severity = {"differentiated": "note", "auto": "error" if log.has_torque else "warning"}
    least = DIFFERS if units.coarse_velocities(log) else _OTHER  # steps may be truncated
    clock, moving = 1.0, sum(map(len, groups))
    for group in sorted(groups, key=len, reverse=True):
        names, factors, errors = zip(*group, strict=True)
        factor = float(np.mean(factors))
        error = float(np.hypot(np.std(factors), np.mean(errors))) / len(group) ** 0.5
        is_unit = factor == 0.0 or abs(factor / _RPM - 1.0) < _OTHER
        is_common = 2 * len(group) > moving and len(group) >= min(2, len(log.joints))
        if is_common and not is_unit:
            if abs(factor - 1.0) > max(least, BEYOND_NOISE * error):
                clock = factor
                yield finding(
                    "time_scale:velocities", log.name, factor=factor, std_error=error,
                    severity="error" if abs(factor - 1.0) > DIFFERS else "warning",
                )  # fmt: skip
        elif abs(factor / clock - 1.0) > DIFFERS + BEYOND_NOISE * error:
            yield finding(
                "velocity_scale", log.name, names, factor=factor, what=factor == 0.0,
                severity=severity.get(velocity, "error"),
            )  # fmt: skip


def _factor(moved: Array, integral: Array) -> tuple[float, float] | None:
    """Return v over d(q)/dt of a joint and the standard error, from displacements (N,)."""
    # Parts of equal motion are left out in turn; a delay changes both RMS equally.
    travel = np.cumsum(moved**2)
    starts = np.unique(np.searchsorted(travel, travel[-1] * np.arange(SEGMENTS) / SEGMENTS))
    xx, xy, yy = (
        np.add.reduceat(x * y, starts)
        for x, y in ((moved, moved), (moved, integral), (integral, integral))
    )
    if len(starts) < FEWEST or xy.sum() < CORRELATED * np.sqrt(xx.sum() * yy.sum()):
        return None
    without = np.sqrt((yy.sum() - yy) / (xx.sum() - xx))
    return float(np.sqrt(yy.sum() / xx.sum())), float(np.std(without) * np.sqrt(len(starts) - 1))


def _amplitude(x: Array, smooth: Array, noise: float) -> float:
    """Return the 99.5 % quantile of the distance of a channel from its median, without spikes."""
    # Of a joint that is at rest in most of the log, only the rows in which it moves count.
    median = np.median(x)
    away = np.abs(smooth - median)
    away = away[away > BEYOND_NOISE * noise]
    distance = np.abs(x - median)
    return max(float(np.quantile(part, 0.995)) for part in (distance, away) if len(part))


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


def check_limits(log: Log, limits: Sequence[Joint]) -> Iterator[Finding]:
    """Yield the joints whose positions or torques are far beyond the limits of the URDF."""
    every = max(1, len(log.t) // ROWS)
    ends = np.array([(x.lower, x.upper) if x.has_limits else (np.nan, np.nan) for x in limits])
    is_prismatic = np.array([x.type == "prismatic" for x in limits])
    q = log.q[::every]

    def extents(size: float) -> Array:
        """Return the extents of the motion over the ranges of the joints, shape (n,)."""
        # of prismatic joints about the middle of the range: the zero of an encoder is no unit
        middle = np.where(is_prismatic, ends.mean(axis=1), size * np.median(q, axis=0))
        farthest = np.quantile(np.abs(size * q - middle), 1 - SHARE_OF_ROWS, axis=0)
        return np.asarray(2 * farthest / np.ptp(ends, axis=1))

    for j in np.flatnonzero(extents(1.0) > NO_ERROR_OF_MASSES).tolist():
        joint, sizes = limits[j], _LENGTHS if is_prismatic[j] else {"degrees": np.pi / 180}
        fitting = [unit for unit, size in sizes.items() if extents(size)[j] <= 1 + DIFFERS]
        key = toml_key(joint.name)
        ways = (f"percent = {{ {key} = [0, {100 * sizes[x]:.4g}] }} ({x})" for x in fitting)
        yield finding(
            "beyond_limits", log.name, joint.name, what=bool(fitting), cure=bool(fitting),
            low=q[:, j].min(), high=q[:, j].max(), lower=joint.lower, upper=joint.upper,
            unit="m" if is_prismatic[j] else "rad", units=" or ".join(fitting),
            settings=" or ".join(ways),
        )  # fmt: skip
    effort = np.array([x.effort if 0 < x.effort < np.inf else np.nan for x in limits])
    is_placeholder = len({*effort}) == 1 and np.log10(effort[0]) % 1 == 0
    if not log.has_torque or is_placeholder:
        return
    times = np.quantile(np.abs(log.tau[::every]), 1 - SHARE_OF_ROWS, axis=0) / effort
    beyond = np.flatnonzero(times > NO_ERROR_OF_MASSES**2)  # of the limit and the torque
    if len(beyond):
        names = [log.joints[j] for j in beyond]
        yield finding("beyond_effort", log.name, names, times=times[beyond].min())


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
    moving = motion.t[(np.abs(motion.v) > AT_REST).any(axis=1)]
    before = after = 0.0
    if len(moving):
        before, after = float(moving[0] - log.t[0]), float(log.t[-1] - moving[-1])
    if max(before, after) >= _PAUSE:
        yield finding(
            "standstill", log.name, before=before, after=after, start=seconds(moving[0]),
            end=seconds(moving[-1]),
        )  # fmt: skip
    for j, joint in enumerate(log.joints):
        extent = float(np.ptp(motion.q[:, j]))
        share = float(np.mean(speed[:, j] > AT_REST))
        unit = "m" if joint in layout.prismatic else "rad"
        code = "static_joint" if extent < STATIC else "hardly_moves"
        if extent < _HARDLY[unit] or share < MOVING:
            yield finding(code, log.name, joint, range=extent, moving_share=share, unit=unit)


def distance(t: Array, instants: Array) -> Array:
    """Return the distance of times from the nearest of some instants, shape as t [s]."""
    bounds = np.concatenate([[-np.inf], instants, [np.inf]])
    after = np.searchsorted(bounds, t)
    return np.asarray(np.minimum(t - bounds[after - 1], bounds[after] - t))


def runs_of(flags: Array) -> list[tuple[int, int]]:
    """Return the first row, and the row after the last one, of each run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def _rate(log: Log, step: Array, median: float) -> Iterator[Finding]:
    """Yield the rate of a log and the jitter of its time stamps."""
    rate, duration = 1 / median, float(log.t[-1] - log.t[0])
    yield finding("rate", log.name, rate=rate, samples=len(log.t), duration=duration)
    regular = step[step < GAP_STEPS * median]
    spread = float(np.std(regular)) / median
    if spread > AGREES:
        even = _white_noise(median * np.arange(len(log.t)), log.q)
        ratio = float(np.median(even / np.maximum(_white_noise(log.t, log.q), TINY)))
        is_wrong = len(regular) == len(step) and ratio < BETTER  # than the motion at even times
        yield finding(
            "jitter", log.name, relative_spread=spread, shortest=float(step.min()),
            longest=float(regular.max()), median=median, ratio=ratio, what=is_wrong, cure=is_wrong,
            severity="warning" if is_wrong else "note",
        )  # fmt: skip


def _gaps(log: Log, step: Array, median: float) -> Iterator[Finding]:
    every = np.flatnonzero(step > GAP_STEPS * median * (1 + 1e-6)).tolist()
    q, jumps = log.q, list[int]()
    for k in (k for k in every if step[k] > _PAUSE and 2 <= k < len(q) - 3):
        around = (q[k] - q[k - 2] + q[k + 3] - q[k + 1]) / 4  # change between two rows
        if np.linalg.norm(q[k + 1] - q[k] - around) < BETTER * np.linalg.norm(around):
            jumps.append(k)
    if jumps:
        jump, at = step[jumps[0]] - median, log.t[jumps[0]]
        yield finding("clock_step", log.name, jump=jump, at=at, steps=len(jumps))
    gaps = [k for k in every if k not in jumps]
    if not gaps:
        return
    at = max(gaps, key=lambda k: step[k])
    longest, start = float(step[at]), float(log.t[at])
    moved = np.ptp([log.q[gaps], log.q[np.add(gaps, 1)]], axis=0).max(axis=1) > STATIC  # no pause
    severity = "warning" if (moved & (step[gaps] > _LONG)).any() else "note"
    yield finding("gap", log.name, severity=severity, gaps=len(gaps), longest=longest, at=start)


def _bunches(log: Log, step: Array) -> Iterator[Finding]:
    """Yield rows whose stamps are those of their arrival: they come together after a pause."""
    mean = float(np.mean(step[step < _PAUSE])) if (step < _PAUSE).any() else 0.0
    is_bunched = step < DIFFERS * mean
    share = float(np.mean(is_bunched))
    moved = np.abs(np.diff(log.q, axis=0)).mean(axis=0)
    change = np.abs(np.diff(log.q[:, int(np.argmax(moved))]))  # of the joint that moves most
    if share < SHARE_OF_ROWS or change[is_bunched].mean() <= BETTER * change.mean():
        return
    even = np.linspace(log.t[0], log.t[-1], len(log.t))
    pause = step[:-1][is_bunched[1:] & ~is_bunched[:-1]].max(initial=0.0)
    yield finding(
        "bunched_stamps", log.name, rows=float(is_bunched.sum()), share=share, of=len(log.t),
        longest=float(step.max()), within=DIFFERS * mean, mean=mean,
        severity="error" if share > BETTER else "warning",
        cure=bool((np.abs(log.t - even) <= pause).all()),
    )  # fmt: skip


def _stale_rows(log: Log, step: Array) -> Iterator[Finding]:
    channels = np.hstack([x for x in (log.q, log.v, log.tau) if x is not None])
    same = (np.diff(channels, axis=0) == 0).all(axis=1)
    runs = _in_motion(log, runs_of(same))
    if not runs:
        return
    lengths = [stop - start for start, stop in runs]
    share = sum(lengths) / len(log.t)
    start, stop = runs[-1]
    yield finding(
        "stale_rows", log.name, severity="warning" if share > AGREES else "note",
        rows=sum(lengths), share=share, longest_run=max(lengths), start=log.t[start],
        what=stop < len(step), cure=stop < len(step),
    )  # fmt: skip


def _in_motion(log: Log, runs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the runs of repeated rows within a motion, or after it if it stops there at once."""
    # After holding a position it starts from rest; a single encoder step is that of a slow motion.
    t, q, last_row = log.t, log.q, len(log.t) - 1
    usual = float(np.linalg.norm(np.diff(q, axis=0), axis=1).mean())
    ends = [run for run in runs if run[1] == last_row and _stops(q, run[0], BETTER * usual)]
    first, last = np.array([run for run in runs if run[1] < last_row], dtype=int).reshape(-1, 2).T
    n = last - first + 1
    change = q[last + 1] - q[last]
    m = np.minimum(n, _AROUND)
    around = np.linalg.norm(q[first] - q[np.maximum(first - m, 0)], axis=1)
    around += np.linalg.norm(q[np.minimum(last + 1 + m, last_row)] - q[last + 1], axis=1)
    moves = np.abs(change).max(axis=1, initial=0.0) > AT_REST * (t[last + 1] - t[first])
    if not log.has_torque:
        steps = np.array([units.quantum(x) for x in q.T])
        moves &= (np.abs(change) > 1.5 * steps).any(axis=1)
    continues = np.linalg.norm(change, axis=1) >= DIFFERS * around * n / m
    rows = np.flatnonzero(moves & continues)
    return [*zip(first[rows].tolist(), last[rows].tolist(), strict=True), *ends]


def check_torque_channels(log: Log) -> Iterator[Finding]:
    """Yield the findings on the torque sensors behind a log."""
    if not log.tau.any():
        yield finding("constant_torque", log.name, severity="error", kind="all", cure="all")
        return
    yield from _clipping(log)
    # a single torque that is never negative may be of a joint that gravity loads in one direction
    touching = sum(_touches(x) >= SCATTERED for x in log.tau.T)
    if log.tau.min() >= 0 and touching >= SCATTERED:
        yield finding("unsigned_torque", log.name, joints=touching, kind="all", cure="all")
    yield from _held(log)


def _clipping(log: Log) -> Iterator[Finding]:
    """Yield the torques that are constant, or at a limit, where the robot moves."""
    # Rows that reach the largest value are compared with those down to four times as far from it:
    # half of them at a maximum, 0.71 at one without curvature. Equal values need no comparison.
    from scipy.ndimage import uniform_filter1d  # takes long to import

    moving = np.append((np.diff(log.q, axis=0) != 0).any(axis=1), False)
    ahead = np.minimum(np.arange(len(log.t)) + _AROUND, len(log.t) - 1)
    travel, least = log.q[ahead] - log.q, AT_REST * (log.t[ahead] - log.t)[:, None]  # (N, n)
    own = np.abs(travel) > least
    noise, fewest = _white_noise(log.t, log.tau), max(_AROUND, SHARE_OF_ROWS * len(log.t))
    smooth = uniform_filter1d(log.tau, _AROUND, axis=0, mode="nearest")
    for j, (joint, x) in enumerate(zip(log.joints, log.tau.T, strict=True)):
        if moving.any() and np.ptp(x) == 0:
            is_undriven = np.ptp(log.q[:, j]) > STILL and not x.any()
            words = dict.fromkeys(("kind", "cure"), "undriven" if is_undriven else "dead")
            value = float(x[0]) + 0.0  # no -0
            yield finding(
                "constant_torque", log.name, joint, value=value, quoted=quoted(joint), **words
            )
            continue
        band = (BEYOND_NOISE + 2) * noise[j] / np.sqrt(_AROUND)  # from 3 errors above to 2 below
        if not own[:, j].any():
            continue
        for sign in (1.0, -1.0):
            depth = np.max(sign * smooth[own[:, j], j]) - sign * smooth[:, j]
            at, limit = (depth <= band) & own[:, j], sign * float(np.max(sign * x))
            rows = np.sum((x == limit) & moving)
            if at.sum() >= fewest > rows:
                runs = [(i, k) for i, k in runs_of(depth <= 4 * band) if at[i:k].any()]
                near = sum(int(own[i:k, j].sum()) for i, k in runs)
                along = sign * travel[:, j] > least[:, 0]
                is_friction = np.sum(at & along) >= MOST * np.sum(along)
                is_flat = MOST * near < at.sum() and not is_friction  # else a maximum
                is_flat &= len(runs) > 1  # else one step of friction
                is_largest = np.ptp(smooth[:, j]) <= 2 * np.max(sign * smooth[:, j]) + 4 * band
                if is_flat and is_largest and 4 * band < BETTER * np.max(depth):
                    limit = float(np.median(x[at]))
                    rows = np.sum((np.abs(x - limit) <= BEYOND_NOISE * noise[j]) & moving)
            if rows >= fewest and not np.ptp(x) < units.COARSE * units.quantum(x):
                yield finding("clipped", log.name, joint, limit=limit, share=rows / len(x))


def _touches(x: Array) -> int:
    """Return how often a torque reaches 0 and increases again."""
    top = float(np.quantile(np.abs(x), 0.995))
    near = runs_of(x < BETTER * top)
    return sum(x[i:k].min() < ZERO * top for i, k in near if i > 0 and k < len(x))


def _held(log: Log) -> Iterator[Finding]:
    """Yield the joints whose torque is updated less often than logged while the robot moves."""
    # Rows that repeat in every channel are a fault of the logger; quantisation repeats irregularly.
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
    is_regular = np.mean(np.abs(lengths - typical) <= (1 if typical > 2 else 0)) > MOST
    return typical if typical > 1 and is_regular else 1
