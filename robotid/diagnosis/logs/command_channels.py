"""Checks of the position loops, from commands and positions of a log; no model of the robot."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.data.units import LONG_STEP, STATIC, STILL, quantum
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.decisions import (
    AGREES,
    BETTER,
    CORRELATED,
    DIFFERS,
    MOST,
    SCATTERED,
    SHARE_OF_ROWS,
    SIGNIFICANT,
    connected,
)
from robotid.diagnosis.logs.channels import runs_of

SECONDS = 5.0  # [s] of the averaged spectra, and least total time of constant commands
EXCITED = 1e-4  # least power of a command, over that of its strongest frequency
_LONGEST = 0.5  # [s] longest delay, or lead, of a position; a joint has settled after it
_INTERVAL = 0.05  # [s] over which signals are averaged to compare their changes
# Share of the rows above half of a speed that are near it, in movements at one speed; a sine: 0.43
_FLAT = 0.6
_RESOLVED = 10.0  # least number of encoder steps in a sweep, and of rows per period


def check_commands(log: Log, prismatic: Collection[str] = ()) -> Iterator[Finding]:
    """Yield the findings on the position loops of the joints."""
    if not log.has_torque:
        what = "commands" if log.q_ref is not None else "forces" if log.wrenches else "nothing"
        yield finding("no_torque", log.name, what=what)
    if log.q_ref is None:
        return
    loops = _loops(log, prismatic)
    enough = len(loops[0].means[0]) > loops[0].means[1].shape[1]  # intervals for a response
    moved = [loop for loop in loops if enough and np.ptp(loop.command) > 0]
    yield from _repeated(log, moved)
    yield from _alike(log, moved) if len(moved) > 1 else ()
    confused = list(_confused(log, moved))
    moved = [loop for loop in moved if not any(loop.name in one.joints for one in confused)]
    yield from (*confused, *_shown(log, moved))
    early = [  # a joint that moves before its command
        finding("delayed_command", log.name, loop.name, lag=lag, lead=-lag, std_error=error)
        for loop in moved
        for lag, error in [loop.lag]
        if lag < -max(SIGNIFICANT * error, loop.step)
    ]
    held = [one for loop in moved for one in [*_stopped(log, loop)] or _interrupted(log, loop)]
    held += [*early, *_saturated(log, moved)]
    known = {name for one in held for name in one.joints}
    small = list(_small(log, [loop for loop in moved if loop.name not in known]))
    yield from (*held, *small)
    yield from _slow(log, moved) if not (confused or held or small) else ()
    yield from _sampled(log, moved)
    yield from _disturbed(log, loops)


def largest_speeds(log: Log) -> dict[str, float]:
    """Return the speeds of the joints that run at their largest speed for any position error."""
    moved = [loop for loop in _loops(log) if np.ptp(loop.command) > 0]
    return {one.joints[0]: one.evidence["speed"] for one in _saturated(log, moved)}


@dataclass(frozen=True, eq=False)
class _Loop:
    """The position loop of one joint, in the longest segment of a log without a gap."""

    name: str
    unit: str
    step: float  # median time step [s]
    interval: int  # number of rows over which signals are averaged
    t: Array  # shape (N,) [s]
    q: Array  # shape (N,) [rad or m]
    command: Array  # shape (N,) [rad or m]

    @cached_property
    def means(self) -> tuple[Array, Array]:
        """Mean position of each interval, (M,), and command in it and those before, (M, k)."""
        pieces = np.stack([self.q, self.command])[:, : len(self.q) // self.interval * self.interval]
        q, command = pieces.reshape(2, -1, self.interval).mean(axis=2)
        count = min(1 + round(_LONGEST / (self.interval * self.step)), len(q))
        past = np.lib.stride_tricks.sliding_window_view(command, count)[:, ::-1]
        return q[count - 1 :], past

    def response_to(self, other: "_Loop", sign: int = 1, lead: int = 0) -> tuple[Array, float]:
        """Return the finite impulse response to a command, (k,), and the share of changes left."""
        # it is nowhere negative: a position loop may overshoot, but does not start backwards
        from scipy.optimize import nnls

        changes = np.diff(self.means[0])[: -lead or None]
        response, left = nnls(sign * np.diff(other.means[1], axis=0)[lead:], changes)
        return response, left**2 / float(changes @ changes) if changes.any() else 1.0

    @cached_property
    def response(self) -> tuple[Array, Array, Array]:
        """Frequency response from command to position: frequency [Hz], response, weight."""
        # Where the command excites it. The weight is 1 / relative variance, from the coherence.
        from scipy.signal import csd, welch

        n = min(len(self.q), max(8, round(SECONDS / self.step)))
        how = {"fs": 1 / self.step, "nperseg": n, "detrend": "linear"}
        f, both = csd(self.command, self.q, **how)
        command, q = welch(self.command, **how)[1], welch(self.q, **how)[1]
        share = np.abs(both) ** 2 / np.where(command * q > 0, command * q, np.inf)
        used = (share > MOST) & (command > EXCITED * command.max()) & (f > 0)
        segments = 2 * len(self.q) / n - 1
        share = np.minimum(share[used], 1 - AGREES**2)  # joints are not linear
        return f[used], both[used] / command[used], 2 * segments * share / (1 - share)

    @cached_property
    def bandwidth(self) -> float:
        """Frequency at which the response has half the power [Hz]; nan beyond the excited ones."""
        from scipy.ndimage import median_filter

        f, H, _ = self.response
        if not len(f):
            return np.nan
        power = median_filter(np.abs(H), size=2 * SCATTERED - 1, mode="nearest") ** 2
        slow = int(np.argmax(power[:SCATTERED]))  # the first one may be due to drift
        weak = np.flatnonzero(power[slow:] < power[slow] / 2)
        return float(f[slow + weak[0]]) if len(weak) else np.nan

    @cached_property
    def lag(self) -> tuple[float, float]:
        """Delay of the position within the bandwidth, and its standard error [s]."""
        # That of the largest correlation of changes, plus the weighted mean of phase / frequency
        # left; the shortest of lags with about this correlation, as of a sine.
        from scipy.signal import correlate

        f, H, weight = self.response
        alike = correlate(np.diff(self.q), np.diff(self.command), method="fft")
        rows = np.arange(len(alike)) - len(self.q) + 2
        alike = np.where(np.abs(rows) * self.step <= _LONGEST, alike, 0.0)
        best = rows[alike >= (1 - DIFFERS) * alike.max()]
        first = float(best[np.argmin(np.abs(best))]) * self.step if alike.max() > 0 else np.nan
        phase = np.angle(H * np.exp(2j * np.pi * f * first))
        near = (np.abs(phase) < np.pi / 2) & ~(f >= self.bandwidth)
        w, phase, weight = 2 * np.pi * f[near], phase[near], weight[near]
        if not len(w):
            return np.nan, np.nan
        share = weight * w**2 / np.sum(weight * w**2)
        delay = float(share @ (-phase / w))
        spread = np.sqrt(float(share @ (-phase / w - delay) ** 2) / max(len(w) - 1, 1))
        return first + delay, max(float(spread), float(1 / np.sqrt(np.sum(weight * w**2))))

    @cached_property
    def sweeps(self) -> tuple[Array, Array]:
        """Ranges of the command between slow reversals, and of the joint, as arrays."""
        moves = np.flatnonzero(np.diff(self.command) != 0)
        reversals = moves[1:][np.diff(np.sign(np.diff(self.command)[moves])) != 0]
        lag = max(self.lag[0], 0.0) if np.isfinite(self.lag[0]) else 0.0
        least, delay = _LONGEST / 2, round(lag / self.step)  # [s], [samples]
        slow = [(i, k) for i, k in pairwise(reversals.tolist()) if (k - i) * self.step > least]
        swept = np.array([abs(self.command[k] - self.command[i]) for i, k in slow])
        followed = np.array([np.ptp(self.q[i : k + delay + 1]) for i, k in slow])
        is_large = swept > 2 * DIFFERS * swept.max(initial=0.0)
        return swept[is_large], followed[is_large]


def _loops(log: Log, prismatic: Collection[str] = ()) -> list[_Loop]:
    """Return the position loops of all joints of a log with commands."""
    step = float(np.median(np.diff(log.t)))
    gaps = np.flatnonzero(np.diff(log.t) > LONG_STEP * step) + 1
    rows = max(np.split(np.arange(len(log.t)), gaps), key=len)
    every = max(1, min(round(_INTERVAL / step), len(rows) // 2))
    signals = log.q[rows].T, np.asarray(log.q_ref)[rows].T
    return [
        _Loop(name, "m" if name in prismatic else "rad", step, every, log.t[rows], q, command)
        for name, q, command in zip(log.joints, *signals, strict=True)
    ]


def _of_joints(code: str, log: Log, names: Collection[str], **values: float | str) -> Finding:
    """Return a finding on joints, which is one on the log if they are all of it."""
    named = () if len(names) == len(log.joints) else tuple(names)
    return finding(code, log.name, named, joint=listed(names), **values)


def _shown(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield the delays of the joints behind their commands, and the bandwidths of their loops."""
    behind = [loop for loop in loops if loop.lag[0] > 0]
    ends = {loop.name: loop.bandwidth for loop in loops if np.isfinite(loop.bandwidth)}
    widths = {name: f" to {width:.2g} Hz" for name, width in ends.items()}
    lines = [f"{x.name} {1e3 * x.lag[0]:.3g} ms{widths.get(x.name, '')}" for x in behind]
    if lines:
        evidence = {f"lag_{loop.name}": loop.lag[0] for loop in behind}
        evidence |= {f"bandwidth_{name}": width for name, width in ends.items()}
        yield finding("loops", log.name, loops=listed(lines), **evidence)


def _repeated(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield whether smooth commands are updated less often than they are logged."""
    rows: dict[str, Array] = {}
    for loop in loops:
        lengths = np.diff(np.flatnonzero(np.diff(loop.command)))
        lengths = lengths[lengths <= max(_RESOLVED, loop.interval)]  # longer ones are intended
        is_smooth = min(len(lengths), len(np.unique(loop.command))) > _RESOLVED
        if is_smooth and np.median(lengths) > 1:
            rows[loop.name] = lengths
    if rows:
        lengths = np.concatenate(list(rows.values()))
        least, most = (int(x) for x in np.quantile(lengths, [0.05, 0.95]))
        mean, period = float(lengths.mean()), float(lengths.mean()) * loops[0].step
        span = f"{least}" if least == most else f"{least} to {most}"
        figures = {"rows": mean, "updated": 1 / period, "period": period, "half": 0.5 * period}
        yield _of_joints("repeated_command", log, rows, span=span, **figures)


def _alike(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield groups of joints with proportional commands."""
    commands = np.stack([loop.means[1][:, 0] for loop in loops])
    same = np.minimum(*(np.abs(np.corrcoef(x)) for x in (commands, np.diff(commands))))
    for group in connected(same > CORRELATED):
        least = min(max(same[i, k] for k in group if k != i) for i in group)
        figures = {"correlation": least, "joints": len(group)}
        yield finding("proportional_commands", log.name, [loops[i].name for i in group], **figures)


def _confused(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield joints that follow the commands of each other, or the opposite of their own."""
    from scipy.optimize import linear_sum_assignment

    left, joints = np.ones((2, len(loops), len(loops))), np.arange(len(loops))
    for j, loop in enumerate(loops):
        left[0, j, j] = own = loop.response_to(loop)[1]
        if own > 1 - CORRELATED:
            lead = loop.means[1].shape[1] - 1  # its command may also be logged too late
            for k, other in enumerate(loops):  # unexplained by its command, or by the opposite
                left[:, j, k] = [loop.response_to(other, sign)[1] for sign in (1, -1)]
            left[0, j, j] = min(own, loop.response_to(loop, lead=lead)[1])
    best, owner = left.min(axis=0), linear_sum_assignment(left.min(axis=0))[1]
    for group in connected(owner == joints[:, None]):
        stated, others = left[0, group, group], best[group, owner[group]]
        if others.sum() < BETTER * stated.sum():
            names = [loops[j].name for j in group]
            pairs = [f"{loops[j].name} follows qref_{loops[owner[j]].name}" for j in group]
            figures = {"unexplained": stated.max(), "unexplained_so_read": others.max()}
            yield finding("command_order", log.name, names, owners=listed(pairs), **figures)
    for j in joints[(owner == joints) & (left[1] < BETTER * left[0]).diagonal()]:
        figures = {"unexplained": left[0, j, j], "unexplained_if_negated": left[1, j, j]}
        yield finding("command_sign", log.name, loops[j].name, **figures)


def _stopped(log: Log, loop: _Loop) -> Iterator[Finding]:
    """Yield the extreme positions at which a joint stays while its command goes on."""
    response, (means, past) = loop.response_to(loop)[0], loop.means
    for side, sign in (("largest", 1.0), ("smallest", -1.0)) if response.any() else ():
        q, sent = sign * means, sign * past @ response / response.sum()
        # not while it returns: friction may hold the joint then
        beyond = (sent > q.max()) & (np.gradient(sent) >= 0)
        visits, share = len(runs_of(beyond)), float(np.mean(sent > q.max()))
        if share < SHARE_OF_ROWS or visits < SCATTERED:
            continue
        at, near = float(np.median(q[beyond])), DIFFERS * float(sent[beyond].std())
        flat = np.mean(np.abs(q[beyond] - at) < near)
        is_far = quantum(loop.q) < near < DIFFERS * np.ptp(q) and sent.max() - at > STILL
        if flat > 1 - BETTER**2 and is_far and np.mean(q > at + near) < AGREES:
            most = sign * float(np.max(sign * loop.command))
            figures = {"at": sign * at, "command": most, "share": share, "movements": visits}
            yield finding("end_stop", log.name, loop.name, side=side, unit=loop.unit, **figures)


def _interrupted(log: Log, loop: _Loop) -> Iterator[Finding]:
    """Yield when a joint is at rest while its command moves by more than a dead band."""
    q, past = loop.means
    signals = np.stack([q, past @ loop.response_to(loop)[0]])
    (swept, followed), rows = loop.sweeps, min(2 * past.shape[1], len(q))
    dead = np.median(swept - followed) if len(swept) >= SCATTERED else np.ptp(signals[1]) / 4
    windows = np.lib.stride_tricks.sliding_window_view(signals, rows, axis=1)
    moved, expected = np.ptp(windows, axis=2)
    least = max(2 * dead, BETTER * np.median(expected), STILL)
    is_at_rest = moved < max(STATIC, 2 * quantum(loop.q))
    for i, k in runs_of(np.convolve(is_at_rest, np.ones(rows)) > 0):
        if np.ptp(signals[1, i:k]) > least:
            start, rest = loop.t[(i + past.shape[1] - 1) * loop.interval], (k - i) * loop.interval
            words = {"what": "part", "when": f"{start:.4g}"}
            yield finding("not_followed", log.name, loop.name, **words, seconds=rest * loop.step)


def _slow(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield the joints whose command is too slow to distinguish a delay from damping."""
    slow = [loop for loop in loops if np.isnan(loop.bandwidth) and loop.lag[0] > loop.step]
    if 2 * len(slow) >= len(loops) > 0:  # else the other joints show the delay
        figures = {"frequency": max(float(loop.response[0].max()) for loop in slow)}
        figures["longest"] = max(loop.lag[0] + 2 * loop.lag[1] for loop in slow)
        yield _of_joints("slow_command", log, [loop.name for loop in slow], **figures)


def _small(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield joints that follow little of their slow sweeps, or are swept by few encoder steps."""
    farthest = max((float(np.ptp(loop.command)) for loop in loops), default=0.0)
    for loop in loops:
        (swept, followed), step = loop.sweeps, quantum(loop.q)
        code, sweep = "small_command", float(np.ptp(loop.command))
        share, dead = 1.0, 0.0
        if len(swept) >= SCATTERED:
            share, dead = float(np.median(followed / swept)), float(np.median(swept - followed))
        evidence = {"sweep": sweep, "followed": share, "step": step}
        if share < BETTER and sweep < 5 * dead:
            what = "suppressed"
            evidence |= {"sweep": float(np.median(swept)), "dead": dead, "wanted": 5 * dead}
            if loop.response_to(loop)[1] < AGREES:  # it is linear, without a dead band
                what = "weak"
            elif share < DIFFERS and evidence["wanted"] > farthest:
                code, what = "not_followed", "whole"
        elif sweep < _RESOLVED * step:
            what = "steps"
            evidence |= {"count": sweep / step, "wanted": 5 * _RESOLVED * step}
        else:
            continue
        words = {"what": what, "cure": what, "unit": loop.unit}
        yield finding(code, log.name, loop.name, **words, **evidence)


def _saturated(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield the joints that run at their largest speed for any position error."""
    for loop in loops:
        v, wanted = np.gradient(loop.q, loop.step), np.gradient(loop.command, loop.step)
        error, top = loop.command - loop.q, float(np.quantile(np.abs(v), 0.995))
        if top < _RESOLVED * quantum(loop.q) / loop.step or top == 0:
            continue
        clipped = []
        for start, stop in runs_of(np.abs(v) > 0.5 * top):
            at = np.flatnonzero(np.abs(v[start:stop]) > (1 - DIFFERS) * top) + start
            if len(at) >= 5 and len(at) >= _FLAT * (stop - start):
                unlike = abs(float(np.mean(wanted[at])) / float(np.mean(v[at])) - 1)
                if unlike > 2 * DIFFERS:
                    clipped.append((len(at) / len(v), float(np.ptp(error[at]))))
        share, count = sum(part for part, _ in clipped), len(clipped)
        if count >= SCATTERED and share >= SHARE_OF_ROWS:
            figures = {"speed": top, "share": share, "error": max(x for _, x in clipped)}
            figures["movements"] = count
            yield finding("saturated", log.name, loop.name, unit=loop.unit, **figures)


def _sampled(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield the joints whose log rate is too low for the bandwidth of their loops."""
    widths = {x.name: float(np.fmin(x.bandwidth, x.response[0].max(initial=0.0))) for x in loops}
    widths = {name: x for name, x in widths.items() if x * loops[0].step * _RESOLVED > 1}
    if widths:
        rate, width = 1 / loops[0].step, max(widths.values())
        figures = {"rate": rate, "bandwidth": width, "rows": rate / width}
        yield _of_joints("slow_sampling", log, widths, wanted=_RESOLVED * width, **figures)


def _disturbed(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield joints with a constant command that move with the other joints."""
    q = np.column_stack([loop.q for loop in loops])
    for j, loop in enumerate(loops):
        settled, same = round(_LONGEST / loop.step), runs_of(np.diff(loop.command) == 0)
        runs = [(i + settled, k + 1) for i, k in same if k - i >= settled]
        if sum(k - i for i, k in runs) * loop.step < SECONDS:
            continue
        centred = np.concatenate([q[i:k] - q[i:k].mean(axis=0) for i, k in runs])
        moved, others = centred[:, j], np.delete(centred, j, axis=1)
        size = float(np.sqrt(2) * moved.std())
        if size < max(STILL / 2, 3 * quantum(loop.q)):
            continue
        fit = others @ np.linalg.lstsq(others, moved)[0]
        share = 1 - float(np.sum((moved - fit) ** 2) / np.sum(moved**2))
        if share >= MOST:
            figures = {"size": size, "share": share}
            yield finding("moved_by_others", log.name, loop.name, unit=loop.unit, **figures)
