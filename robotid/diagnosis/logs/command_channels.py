"""Checks of the position loops, from commands and positions of a log; no model of the robot."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.data.units import LONG_STEP, quantum
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.decisions import CORRELATED, DIFFERS, SHARE_OF_ROWS, SIGNIFICANT, connected
from robotid.diagnosis.logs.channels import runs_of
from robotid.estimation.fitting.standard_errors import QUANTILE

_SECONDS = 5.0  # [s] of the averaged spectra
_COHERENT = 0.8  # least coherence of a frequency that is used ...
_COHERENCE = 0.999  # ... and the largest that is believed
_EXCITED = 1e-4  # least power of a command, over that of its strongest frequency
_HALF_POWER = np.sqrt(0.5)  # response at the bandwidth of a loop, over the response at rest
_RIPPLE = 5  # number of frequencies over which the size of a response is smoothed
_DELAYS = np.arange(0.0, 0.2, 0.001)  # [s] grid of the delays
_LONGEST = 0.5  # [s] longest delay, or lead, of the position
_AS_ALIKE = 0.9  # share of the largest correlation that counts as equal to it
_DETERMINED = 0.02  # [s] width of the range of delays below which a delay is determined
_UPDATED = 1.5  # [rows] between updates of a command that is zero-order held
_MANY = 20  # values of a smooth command, and rows of a constant one that is intended
_INTERVAL = 0.1  # [s] over which changes of commands are compared
_FOLLOWED = 0.5  # share of slow sweeps that a joint should follow if its lag is known ...
_STUCK = 0.2  # ... and if its lag is unknown, so that it is open which sweeps are slow
_SLOW = 5.0  # [lags] least duration of slow sweeps ...
_SWEEPS = 4  # ... and least number to judge a joint by
_RESOLVED = 10.0  # least number of encoder steps in a sweep, and of rows per period
_SETTLED = 0.5  # [s] after its last change a command is constant ...
_CONSTANT = 2.0  # [s] ... and least total time of this
_DISTURBED = 0.01  # [rad or m] least motion under a constant command ...
_EXPLAINED = 0.7  # ... and share of it that the other joints must explain
# Share of the rows above half of a speed that are near it, in movements at one speed; a sine: 0.43
_FLAT = 0.6
_UNLIKE = 0.2  # least relative difference of this speed from that of the command ...
_PULSES = 3  # ... and least number of such movements


def check_commands(log: Log, prismatic: Collection[str] = ()) -> Iterator[Finding]:
    """Yield the findings on the position loops of the joints."""
    if not log.has_torque:
        what = "commands" if log.q_ref is not None else "forces" if log.wrenches else "nothing"
        yield finding("no_torque", log.name, what=what)
    if log.q_ref is None:
        return
    loops = [
        _Loop(log, j, "m" if name in prismatic else "rad") for j, name in enumerate(log.joints)
    ]
    moved = [loop for loop in loops if loop.is_commanded]
    yield from _shown(log, moved)
    yield from _held(log, moved)
    yield from _alike(log, moved)
    early = [  # a joint that moves before its command
        finding("delayed_command", log.name, loop.name, lag=lag, lead=-lag, std_error=error)
        for loop in moved
        for lag, error in [loop.lag]
        if lag < -max(SIGNIFICANT * error, loop.step)
    ]
    clipped = dict(_saturated(log, moved))
    small = list(_small(log, [loop for loop in moved if loop.name not in clipped]))
    yield from (*early, *clipped.values(), *small)
    if not early and not small:
        yield from _slow(log, moved)
    yield from _sampled(log, moved)
    yield from _disturbed(log, loops)


def largest_speeds(log: Log) -> dict[str, float]:
    """Return the speeds of the joints that run at their largest speed for any position error."""
    moved = [loop for j in range(len(log.joints)) if (loop := _Loop(log, j)).is_commanded]
    return {name: float(one.evidence["speed"]) for name, one in _saturated(log, moved)}


@dataclass(frozen=True, eq=False)
class _Loop:
    """The position loop of one joint, in the longest segment of a log without a gap."""

    log: Log
    joint: int
    unit: str = "rad"

    @property
    def name(self) -> str:
        return self.log.joints[self.joint]

    @cached_property
    def step(self) -> float:
        """Median time step [s]."""
        return float(np.median(np.diff(self.log.t)))

    @cached_property
    def rows(self) -> slice:
        """The longest segment without a gap."""
        breaks = np.flatnonzero(np.diff(self.log.t) > LONG_STEP * self.step) + 1
        edges = np.array([0, *breaks, len(self.log.t)])
        k = int(np.argmax(np.diff(edges)))
        return slice(int(edges[k]), int(edges[k + 1]))

    @property
    def q(self) -> Array:
        """Positions, shape (N,)."""
        return np.asarray(self.log.q[self.rows, self.joint])

    @property
    def command(self) -> Array:
        """Commanded positions, shape (N,)."""
        return np.asarray(self.log.q_ref)[self.rows, self.joint]

    @property
    def is_commanded(self) -> bool:
        """Whether its command changes."""
        return bool(np.ptp(self.command) > 0)

    @cached_property
    def response(self) -> tuple[Array, Array, Array]:
        """Frequency response from command to position: frequency [Hz], response, weight."""
        # Where the command excites it. The weight is 1 / relative variance, from the coherence.
        from scipy.signal import csd, welch

        n = min(len(self.q), max(8, round(_SECONDS / self.step)))
        how = {"fs": 1 / self.step, "nperseg": n, "detrend": "linear"}
        f, both = csd(self.command, self.q, **how)
        command, q = welch(self.command, **how)[1], welch(self.q, **how)[1]
        share = np.abs(both) ** 2 / np.where(command * q > 0, command * q, np.inf)
        used = (share > _COHERENT) & (command > _EXCITED * command.max()) & (f > 0)
        segments = 2 * len(self.q) / n - 1
        share = np.minimum(share[used], _COHERENCE)  # joints are not linear
        return f[used], both[used] / command[used], 2 * segments * share / (1 - share)

    @cached_property
    def bandwidth(self) -> float:
        """Frequency at which the response is 0.71 [Hz]; nan if it is above at all excited ones."""
        from scipy.ndimage import median_filter

        f, H, _ = self.response
        if not len(f):
            return np.nan
        size = median_filter(np.abs(H), size=_RIPPLE, mode="nearest")
        slow = int(np.argmax(size[:3]))  # the first one may be due to drift
        weak = np.flatnonzero(size[slow:] < _HALF_POWER * size[slow])
        return float(f[slow + weak[0]]) if len(weak) else np.nan

    @cached_property
    def lag(self) -> tuple[float, float]:
        """Delay of the position within the bandwidth, and its standard error [s]."""
        # The lag of the largest correlation, plus the weighted mean of phase / frequency left.
        f, H, weight = self.response
        first = self._first_lag()
        phase = np.angle(H * np.exp(2j * np.pi * f * first))
        near = (np.abs(phase) < np.pi / 2) & ~(f >= self.bandwidth)
        w, phase, weight = 2 * np.pi * f[near], phase[near], weight[near]
        if not len(w):
            return np.nan, np.nan
        share = weight * w**2 / np.sum(weight * w**2)
        delay = float(share @ (-phase / w))
        spread = np.sqrt(float(share @ (-phase / w - delay) ** 2) / max(len(w) - 1, 1))
        return first + delay, max(float(spread), float(1 / np.sqrt(np.sum(weight * w**2))))

    def _first_lag(self) -> float:
        """Return the lag at which changes of position and command correlate most [s]."""
        # The shortest of lags with about this correlation, as of a sine; nan if none is positive.
        from scipy.signal import correlate

        alike = correlate(np.diff(self.q), np.diff(self.command), method="fft")
        rows = np.arange(len(alike)) - len(self.q) + 2
        within = np.abs(rows) * self.step <= _LONGEST
        alike, rows = alike[within], rows[within]
        if not alike.max() > 0:
            return np.nan
        best = rows[alike >= _AS_ALIKE * alike.max()]
        return float(best[np.argmin(np.abs(best))]) * self.step

    @cached_property
    def delays(self) -> tuple[float, float]:
        """The shortest and the longest pure delay that are consistent with the response [s]."""
        # H = exp(-i w T) / (g + d i w - j w^2), linear in g, d, j for each T; T <= lag: d >= 0.
        f, H, weight = self.response
        lag, error = self.lag
        delays = _DELAYS[max(lag + 2 * error, 0.0) >= _DELAYS] if np.isfinite(lag) else _DELAYS
        if len(f) < 4:
            return float(delays[0]), float(delays[-1])
        w, root = 2 * np.pi * f, np.sqrt(weight)
        A = np.column_stack([H, 1j * w * H, -(w**2) * H]) * root[:, None]  # (m, 3)
        Q = np.linalg.qr(np.concatenate([A.real, A.imag]))[0]
        b = np.exp(-1j * w * delays[:, None]) * root  # (delays, m)
        b = np.concatenate([b.real, b.imag], axis=1)
        squares = np.sum(b**2, axis=1) - np.sum((b @ Q) ** 2, axis=1)
        least = squares.min()
        noise = max(float(least) / (2 * len(f) - 4), 1.0)
        fits = delays[squares < least + QUANTILE**2 * noise]
        return float(fits[0]), float(fits[-1])

    @cached_property
    def sweeps(self) -> tuple[Array, Array]:
        """Ranges of the command between slow reversals, and of the joint, as arrays."""
        command, q = self.command, self.q
        moves = np.flatnonzero(np.diff(command) != 0)
        reversals = moves[1:][np.diff(np.sign(np.diff(command)[moves])) != 0]
        lag = self.lag[0] if np.isfinite(self.lag[0]) else 0.0
        delay = max(0, round(lag / self.step))  # [samples]
        pairs = [
            (i, k)
            for i, k in pairwise(reversals.tolist())
            if (k - i) * self.step > max(_SLOW * lag, _SETTLED / 2)
        ]
        swept = np.array([abs(command[k] - command[i]) for i, k in pairs])
        followed = np.array([np.ptp(q[i : k + delay + 1]) for i, k in pairs])
        is_large = swept > 0.2 * swept.max(initial=0.0)
        return swept[is_large], followed[is_large]


def _shown(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield the delays of the joints behind their commands, and the bandwidths of their loops."""
    lags = {loop.name: loop.lag[0] for loop in loops if loop.lag[0] > 0}
    if not lags:
        return
    ends = {loop.name: loop.bandwidth for loop in loops if np.isfinite(loop.bandwidth)}
    lines = ", ".join(
        f"{name} {1e3 * lag:.3g} ms" + (f" to {ends[name]:.2g} Hz" if name in ends else "")
        for name, lag in lags.items()
    )
    evidence = {f"lag_{name}": lag for name, lag in lags.items()}
    evidence |= {f"bandwidth_{name}": width for name, width in ends.items()}
    yield finding("loops", log.name, loops=lines, **evidence)


def _named(log: Log, names: Sequence[str]) -> Sequence[str]:
    """Return the names of joints, none if they are all of the log."""
    return () if len(names) == len(log.joints) else names


def _held(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield whether smooth commands are updated less often than they are logged."""
    rows: dict[str, Array] = {}
    for loop in loops:
        lengths = np.diff(np.flatnonzero(np.diff(loop.command)))
        lengths = lengths[lengths <= _MANY]
        is_smooth = len(np.unique(loop.command)) >= _MANY
        if len(lengths) > _MANY and is_smooth and lengths.mean() > _UPDATED:
            rows[loop.name] = lengths
    if not rows:
        return
    lengths = np.concatenate(list(rows.values()))
    least, most = (int(x) for x in np.quantile(lengths, [0.05, 0.95]))
    mean, step = float(lengths.mean()), loops[0].step
    yield finding(
        "repeated_command", log.name, _named(log, list(rows)), joint=listed(rows),
        span=f"{least}" if least == most else f"{least} to {most}", rows=mean,
        updated=1 / (mean * step), period=mean * step, half=0.5 * mean * step,
    )  # fmt: skip


def _alike(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield groups of joints with proportional commands."""
    if len(loops) < 2:
        return
    commands = np.stack([loop.command for loop in loops], axis=1)
    lag = max(1, round(_INTERVAL / loops[0].step))
    changes = commands[lag:] - commands[:-lag]
    same = np.minimum(*(np.abs(np.corrcoef(x.T)) for x in (commands, changes)))
    for group in connected(same > CORRELATED):
        least = min(max(same[i, k] for k in group if k != i) for i in group)
        names = [loops[i].name for i in group]
        yield finding(
            "proportional_commands", log.name, names, correlation=least, joints=len(names)
        )


def _slow(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield the joints whose command is too slow to distinguish a delay from damping."""
    slow = []
    for loop in loops:
        (least, most), lag = loop.delays, loop.lag[0]
        is_narrow = most - least <= _DETERMINED
        is_determined = is_narrow and (most < lag - 1e-3 or lag < _DETERMINED)
        if np.isnan(loop.bandwidth) and not is_determined:
            slow.append(loop)
    fastest = max((float(loop.response[0].max(initial=0.0)) for loop in slow), default=0.0)
    if fastest > 0.0:
        names = [loop.name for loop in slow]
        shortest, longest = zip(*(loop.delays for loop in slow), strict=True)
        yield finding(
            "slow_command", log.name, _named(log, names), joint=listed(names),
            frequency=fastest, shortest=min(shortest), longest=max(longest),
        )  # fmt: skip


def _small(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield joints whose slow sweeps are as small as their backlash or their encoder steps."""
    for loop in loops:
        (swept, followed), step = loop.sweeps, quantum(log.q[:, loop.joint])
        sweep = float(np.ptp(loop.command))
        share = float(np.median(followed / swept)) if len(swept) >= _SWEEPS else 1.0
        evidence = {"sweep": sweep, "followed": share, "step": step}
        if share < (_FOLLOWED if loop.lag[0] > 0 else _STUCK):
            what, dead = "suppressed", float(np.median(swept - followed))
            evidence |= {"sweep": float(np.median(swept)), "dead": dead, "wanted": 5 * dead}
        elif sweep < _RESOLVED * step:
            what = "steps"
            evidence |= {"count": sweep / step, "wanted": 5 * _RESOLVED * step}
        else:
            continue
        yield finding("small_command", log.name, loop.name, what=what, unit=loop.unit, **evidence)


def _saturated(log: Log, loops: Sequence[_Loop]) -> Iterator[tuple[str, Finding]]:
    """Yield names and findings of joints that run at their largest speed for any error."""
    for loop in loops:
        v, wanted = np.gradient(loop.q, loop.step), np.gradient(loop.command, loop.step)
        error, top = loop.command - loop.q, float(np.quantile(np.abs(v), 0.995))
        if top < _RESOLVED * quantum(log.q[:, loop.joint]) / loop.step or top == 0:
            continue
        clipped = []
        for start, stop in runs_of(np.abs(v) > 0.5 * top):
            at = np.flatnonzero(np.abs(v[start:stop]) > (1 - DIFFERS) * top) + start
            flat = len(at) / (stop - start)
            if len(at) < 5 or flat < _FLAT:
                continue
            unlike = abs(float(np.mean(wanted[at])) / float(np.mean(v[at])) - 1)
            if unlike > _UNLIKE:
                clipped.append((at, float(np.ptp(error[at]))))
        share = sum(len(at) for at, _ in clipped) / len(v)
        if len(clipped) >= _PULSES and share >= SHARE_OF_ROWS:
            saturated = finding(
                "saturated", log.name, loop.name, unit=loop.unit, movements=len(clipped),
                speed=top, share=share, error=max(x for _, x in clipped),
            )  # fmt: skip
            yield loop.name, saturated


def _sampled(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield the joints whose log rate is too low for the bandwidth of their loops."""
    widths = {}
    for loop in loops:
        highest = float(loop.response[0].max(initial=0.0))
        width = loop.bandwidth if np.isfinite(loop.bandwidth) else highest
        if width * loop.step * _RESOLVED > 1:
            widths[loop.name] = width
    if widths:
        rate, width = 1 / loops[0].step, max(widths.values())
        yield finding(
            "slow_sampling", log.name, _named(log, list(widths)), joint=listed(widths), rate=rate,
            bandwidth=width, rows=rate / width, wanted=_RESOLVED * width,
        )  # fmt: skip


def _disturbed(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield joints with a constant command that move with the other joints."""
    q = log.q[loops[0].rows]
    for loop in loops:
        since = round(_SETTLED / loop.step)
        changed = np.append(True, np.diff(loop.command) != 0)
        last = np.maximum.accumulate(np.where(changed, np.arange(len(changed)), 0))
        runs = runs_of(np.arange(len(last)) - last >= since)
        if sum(k - i for i, k in runs) * loop.step < _CONSTANT:
            continue
        centred = np.concatenate([q[i:k] - q[i:k].mean(axis=0) for i, k in runs])
        moved, others = centred[:, loop.joint], np.delete(centred, loop.joint, axis=1)
        size = float(np.sqrt(2) * moved.std())
        if size < max(_DISTURBED, 3 * quantum(log.q[:, loop.joint])):
            continue
        fit = others @ np.linalg.lstsq(others, moved)[0]
        share = 1 - float(np.sum((moved - fit) ** 2) / np.sum(moved**2))
        if share >= _EXPLAINED:
            yield finding("moved_by_others", log.name, loop.name, size=size, share=share)
