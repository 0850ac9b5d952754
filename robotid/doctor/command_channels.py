"""What commands and positions of a log show of the loops between them; no model of the robot."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from robotid._typing import Array
from robotid.doctor.clock import runs_of
from robotid.findings import Finding, listed, log_finding
from robotid.logs.data import Log
from robotid.logs.measured_velocity import quantum

__all__ = ["check_commands", "largest_speeds"]

_SECONDS = 5.0  # [s] of the segments whose spectra are averaged
_GAP = 5  # median steps from which a gap ends the segment that is looked at
_COHERENT = 0.8  # share of a position's spectrum that its command explains, from which it counts
_EXCITED = 1e-4  # of its strongest frequency, below which a command does not excite
_SUREST = 0.999  # coherence beyond which no response is known: joints are not linear
_HALF_POWER = np.sqrt(0.5)  # response, of that at rest, at which a loop's bandwidth ends
_RIPPLE = 5  # lines over which the size of a response is smoothed
_DELAYS = np.arange(0.0, 0.2, 0.001)  # [s] that are tried
_LONGEST = 0.5  # [s] by which a joint is sought to be late, or early
_AS_ALIKE = 0.9  # share of the largest correlation that is as good
_SURE = 3.84  # growth of a sum of squares that 5 % of chance exceed
_TOLD = 0.02  # [s] a delay known to within less is told
_RATE = 10.0  # rows per period of the bandwidth that are wanted
_ALIKE = 0.95  # correlation from which two commands are one signal
_RENEWED = 1.5  # rows in the mean, from which a command is held
_LEVELS = 20  # values from which a command is no series of steps
_PAUSE = 20  # rows from which it rests, by intent
_APART = 0.1  # [s] over which changes of commands are compared
_FOLLOWED = 0.5  # share of slow sweeps that a joint should follow
_STUCK = 0.2  # ... where its lag is not known, so neither is what is slow
_SLOW = 5.0  # lags that a sweep must last to be slow
_FEW = 10.0  # steps of an encoder that a sweep should have
_SWEEPS = 4  # sweeps from which a joint is judged by them
_SETTLED = 0.5  # [s] after its last change a command counts as held
_HELD = 2.0  # [s] in all that a command must be held
_GIVES_WAY = 0.01  # [rad or m] a joint that is held may move
_EXPLAINED = 0.7  # share of this that the other joints must explain
_TOP = 0.1  # of its largest speed, within which a joint runs at it
_FLAT = 0.6  # share of a movement above half the largest speed that is at it; of a sine 0.43
_OFTEN = 0.02  # share of the rows at it, from which it matters
_UNLIKE = 0.2  # of the speed, by which that of the command must differ from it
_PULSES = 3  # movements that end at one speed, which are no coincidence


def check_commands(log: Log) -> Iterator[Finding]:
    """Yield what commands and positions of a log show of the loops of its joints.

    Args:
        log: The log; nothing is yielded of one without commands, but that it has no torque.

    Yields:
        A note "no_torque"; a note "loops", of bandwidth and lag of each joint; a note
        "repeated_command"; a warning "proportional_commands" per group of joints
        that are told the same; an error "delayed_command" of joints that move before their command;
        warnings "slow_command", "small_command", "saturated", "slow_sampling" and a warning
        "moved_by_others" of joints that move though they are told to stand.
    """
    if not log.has_torque:
        yield _without_torque(log)
    if log.q_ref is None:
        return
    loops = [_Loop(log, j) for j in range(len(log.joints))]
    moved = [loop for loop in loops if loop.is_told]
    yield from _shown(log, moved)
    yield from _held(log, moved)
    yield from _alike(log, moved)
    early = list(_early(log, moved))
    clipped = dict(_saturated(log, moved))
    small = list(_small(log, [loop for loop in moved if loop.name not in clipped]))
    yield from (*early, *clipped.values(), *small)
    if not early and not small:
        yield from _slow(log, moved)
    yield from _sampled(log, moved)
    yield from _gives_way(log, loops)


def largest_speeds(log: Log) -> dict[str, float]:
    """Return the speeds of the joints that run at one largest speed whatever their error is.

    Args:
        log: The log, with commands.
    """
    moved = [loop for j in range(len(log.joints)) if (loop := _Loop(log, j)).is_told]
    return {name: float(found.evidence["speed"]) for name, found in _saturated(log, moved)}


@dataclass(frozen=True, eq=False)
class _Loop:
    """The loop of one joint, in the longest segment of a log without a gap."""

    log: Log
    joint: int

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
        breaks = np.flatnonzero(np.diff(self.log.t) > _GAP * self.step) + 1
        edges = np.array([0, *breaks, len(self.log.t)])
        k = int(np.argmax(np.diff(edges)))
        return slice(int(edges[k]), int(edges[k + 1]))

    @property
    def q(self) -> Array:
        """Positions, shape (N,)."""
        q: Array = self.log.q[self.rows, self.joint]
        return q

    @property
    def told(self) -> Array:
        """Commanded positions, shape (N,)."""
        assert self.log.q_ref is not None
        told: Array = self.log.q_ref[self.rows, self.joint]
        return told

    @property
    def is_told(self) -> bool:
        """Whether it is told to move."""
        return bool(np.ptp(self.told) > 0)

    @cached_property
    def response(self) -> tuple[Array, Array, Array]:
        """Position over command where the command excites: frequency [Hz], response, weight.

        The weight is the inverse of the relative variance, by the coherence of the two.
        """
        from scipy.signal import csd, welch

        n = min(len(self.q), max(8, round(_SECONDS / self.step)))
        how = {"fs": 1 / self.step, "nperseg": n, "detrend": "linear"}
        f, both = csd(self.told, self.q, **how)
        told, seen = welch(self.told, **how)[1], welch(self.q, **how)[1]
        share = np.abs(both) ** 2 / np.where(told * seen > 0, told * seen, np.inf)
        used = (share > _COHERENT) & (told > _EXCITED * told.max()) & (f > 0)
        segments = 2 * len(self.q) / n - 1
        share = np.minimum(share[used], _SUREST)
        return f[used], both[used] / told[used], 2 * segments * share / (1 - share)

    @cached_property
    def bandwidth(self) -> float:
        """Frequency at which it follows half the power [Hz]; nan if it follows all excited."""
        from scipy.ndimage import median_filter

        f, H, _ = self.response
        if not len(f):
            return np.nan
        size = median_filter(np.abs(H), size=_RIPPLE, mode="nearest")
        slow = int(np.argmax(size[:3]))  # the very first may be that of a drift
        weak = np.flatnonzero(size[slow:] < _HALF_POWER * size[slow])
        return float(f[slow + weak[0]]) if len(weak) else np.nan

    @cached_property
    def lag(self) -> tuple[float, float]:
        """How late it is where it follows, and the standard error [s]; nan if nothing is excited.

        The phase over the frequency, averaged with its weights: that beyond the lag at which their
        changes are most alike.
        """
        f, H, weight = self.response
        first = self._first_lag()
        phase = np.angle(H * np.exp(2j * np.pi * f * first))
        near = (np.abs(phase) < np.pi / 2) & ~(f >= self.bandwidth)
        w, phase, weight = 2 * np.pi * f[near], phase[near], weight[near]
        if not len(w):
            return np.nan, np.nan
        share = weight * w**2 / np.sum(weight * w**2)
        late = float(share @ (-phase / w))
        spread = np.sqrt(float(share @ (-phase / w - late) ** 2) / max(len(w) - 1, 1))
        return first + late, max(float(spread), float(1 / np.sqrt(np.sum(weight * w**2))))

    def _first_lag(self) -> float:
        """Return the lag at which changes of position and command are most alike [s].

        Of lags at which they are about as alike, as of a sine, the shortest.
        """
        from scipy.signal import correlate

        alike = correlate(np.diff(self.q), np.diff(self.told), method="fft")
        rows = np.arange(len(alike)) - len(self.q) + 2
        within = np.abs(rows) * self.step <= _LONGEST
        alike, rows = alike[within], rows[within]
        best = rows[alike >= _AS_ALIKE * alike.max()]
        return float(best[np.argmin(np.abs(best))]) * self.step

    @cached_property
    def delays(self) -> tuple[float, float]:
        """The shortest and the longest pure delay that explain it with some spring and damping [s].

        H = exp(-i w T) / (g + d i w - j w^2), in which g, d and j are linear for each T; as d is
        not negative, T is no longer than the lag.
        """
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
        fits = delays[squares < least + _SURE * noise]
        return float(fits[0]), float(fits[-1])

    @cached_property
    def sweeps(self) -> tuple[Array, Array]:
        """How far its command goes between slow reversals, and how far the joint, as arrays."""
        told, q = self.told, self.q
        moves = np.flatnonzero(np.diff(told) != 0)
        turns = moves[1:][np.diff(np.sign(np.diff(told)[moves])) != 0]  # where it sets out anew
        lag = self.lag[0] if np.isfinite(self.lag[0]) else 0.0
        late = max(0, round(lag / self.step))
        pairs = [
            (i, k)
            for i, k in pairwise(turns.tolist())
            if (k - i) * self.step > max(_SLOW * lag, _SETTLED / 2)
        ]
        far = np.array([abs(told[k] - told[i]) for i, k in pairs])
        gone = np.array([np.ptp(q[i : k + late + 1]) for i, k in pairs])
        usual = far > 0.2 * far.max(initial=0.0)
        return far[usual], gone[usual]


def _without_torque(log: Log) -> Finding:
    message = (
        "it has no torque. Commands and positions show each drive's delay, and its friction, "
        "armature and what it carries as ratios to the gains of its controller; state a gain that "
        "is known, or inertias of the URDF stand for it"
        if log.q_ref is not None
        else "it has neither torque nor commands: nothing can be identified from motion alone"
    )
    return log_finding(log.name, "no_torque", "note", message)


def _shown(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield how late the joints follow, and up to which frequency."""
    late = {loop.name: loop.lag[0] for loop in loops if np.isfinite(loop.lag[0])}
    if not late:
        return
    ends = {loop.name: loop.bandwidth for loop in loops if np.isfinite(loop.bandwidth)}
    shown = ", ".join(
        f"{name} {1e3 * lag:.3g} ms" + (f" to {ends[name]:.2g} Hz" if name in ends else "")
        for name, lag in late.items()
    )
    message = (
        f"joints follow their commands late, up to the bandwidth if the command reaches it: {shown}"
        "; a delay is at most as long as this lag; nothing needs doing"
    )
    evidence = {f"lag_{name}": lag for name, lag in late.items()}
    evidence |= {f"bandwidth_{name}": width for name, width in ends.items()}
    yield log_finding(log.name, "loops", "note", message, **evidence)


def _held(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield whether smooth commands are updated less often than they are logged."""
    rows: dict[str, Array] = {}
    for loop in loops:
        changes = np.flatnonzero(np.diff(loop.told))
        lengths = np.diff(changes)
        lengths = lengths[lengths <= _PAUSE]
        is_smooth = len(np.unique(loop.told)) >= _LEVELS
        if len(lengths) > 20 and is_smooth and lengths.mean() > _RENEWED:
            rows[loop.name] = lengths
    if not rows:
        return
    lengths = np.concatenate(list(rows.values()))
    least, most = (int(x) for x in np.quantile(lengths, [0.05, 0.95]))
    mean, step = float(lengths.mean()), loops[0].step
    span = f"{least}" if least == most else f"{least} to {most}"
    message = (
        f"the command of {listed(rows)} is updated every {span} rows, {1 / (mean * step):.3g} "
        f"times a second in the mean, and held for {1e3 * mean * step:.3g} ms: this acts as a "
        f"delay of half of that; simulate the rows as they are held, or {500 * mean * step:.2g} ms "
        "are taken for the drive's own delay"
    )
    part = "" if len(rows) == len(log.joints) else listed(rows)
    yield log_finding(
        log.name, "repeated_command", "note", message, part, rows=mean, period=mean * step
    )


def _alike(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield groups of joints whose commands are one signal, up to sign and size."""
    if len(loops) < 2:
        return
    told = np.stack([loop.told for loop in loops], axis=1)
    apart = max(1, round(_APART / loops[0].step))
    changes = told[apart:] - told[:-apart]
    same = np.minimum(*(np.abs(np.corrcoef(x.T)) for x in (told, changes)))
    left = list(range(len(loops)))
    while left:
        group = [left.pop(0)]
        for k in group:
            near = [i for i in left if same[k, i] > _ALIKE]
            group += near
            left = [i for i in left if i not in near]
        if len(group) == 1:
            continue
        least = min(max(same[i, k] for k in group if k != i) for i in group)
        names = [loops[i].name for i in sorted(group)]
        message = (
            f"the commands of {listed(names)} are one signal up to sign and size (correlation "
            f"{least:.3f} or more): what depends on the position or speed of one of them may as "
            "well depend on another's, and what one does to the other is not told from its own "
            "inertia and friction; give each joint frequencies or phases of its own"
        )
        yield log_finding(
            log.name, "proportional_commands", "warning", message, listed(names),
            correlation=float(least), joints=len(names),
        )  # fmt: skip


def _early(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield joints that move before their command, which no drive does."""
    for loop in loops:
        lag, error = loop.lag
        if not lag < -max(3 * error, loop.step / 2):
            continue
        message = (
            f"{loop.name} moves {-1e3 * lag:.3g} +- {1e3 * error:.2g} ms before its command: this "
            "is not the command that its drive was given, or it has another clock; log what is "
            "sent to the drive, when it is sent"
        )
        yield log_finding(
            log.name, "delayed_command", "error", message, loop.name, lag=lag, std_error=error
        )


def _slow(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield the joints whose command is too slow to tell a delay from damping."""
    names, ranges = list[str](), list[tuple[float, float]]()
    fastest = 0.0
    for loop in loops:
        (f, _, _), (least, most), lag = loop.response, loop.delays, loop.lag[0]
        is_told = most - least <= _TOLD and (most < lag - 1e-3 or lag < _TOLD)
        if np.isnan(loop.bandwidth) and not is_told:
            names, ranges = [*names, loop.name], [*ranges, (least, most)]
            fastest = max(fastest, float(f.max(initial=0.0)))
    if fastest == 0.0:
        return
    least, most = min(low for low, _ in ranges), max(high for _, high in ranges)
    message = (
        f"the command of {listed(names)} is too slow for their delays: up to "
        f"{fastest:.2g} Hz, the fastest at which position and command are alike, the joints "
        f"follow, and any delay from {1e3 * least:.0f} to {1e3 * most:.0f} ms explains it with "
        "more damping or less; only their sum is found. Record a chirp beyond the bandwidth of "
        "the loop (where the joint follows 70 %), or steps"
    )
    part = "" if len(names) == len(log.joints) else listed(names)
    yield log_finding(
        log.name, "slow_command", "warning", message, part,
        frequency=fastest, shortest=least, longest=most,
    )  # fmt: skip


def _small(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield joints whose slow sweeps are lost in friction or backlash, or in encoder steps."""
    for loop in loops:
        (far, gone), step = loop.sweeps, quantum(log.q[:, loop.joint])
        usual = float(np.ptp(loop.told))
        share = float(np.median(gone / far)) if len(far) >= _SWEEPS else 1.0
        if share < (_FOLLOWED if loop.lag[0] > 0 else _STUCK):
            usual, lost = float(np.median(far)), float(np.median(far - gone))
            message = (
                f"{loop.name} follows {100 * share:.0f} % of sweeps of {usual:.3g}, slow as they "
                f"are: friction, backlash or the dead band of its drive swallow {lost:.2g}; move "
                f"it by {5 * lost:.2g} or more"
            )
        elif usual < _FEW * step:
            message = (
                f"{loop.name} is told to move by {usual:.3g}, {usual / step:.1f} steps of its "
                f"encoder: they show steps, not motion; move it by {5 * _FEW * step:.2g} or more"
            )
        else:
            continue
        yield log_finding(
            log.name, "small_command", "warning", message, loop.name,
            sweep=usual, followed=share, step=step,
        )  # fmt: skip


def _saturated(log: Log, loops: Sequence[_Loop]) -> Iterator[tuple[str, Finding]]:
    """Yield names and findings of joints that run at one largest speed whatever their error is."""
    for loop in loops:
        v, wanted = np.gradient(loop.q, loop.step), np.gradient(loop.told, loop.step)
        error, top = loop.told - loop.q, float(np.quantile(np.abs(v), 0.995))
        if top < _FEW * quantum(log.q[:, loop.joint]) / loop.step or top == 0:
            continue
        clipped = []
        for start, stop in runs_of(np.abs(v) > 0.5 * top):
            at = np.flatnonzero(np.abs(v[start:stop]) > (1 - _TOP) * top) + start
            flat = len(at) / (stop - start)
            if len(at) < 5 or flat < _FLAT:
                continue
            unlike = abs(float(np.mean(wanted[at])) / float(np.mean(v[at])) - 1)
            if unlike > _UNLIKE:
                clipped.append((at, float(np.ptp(error[at]))))
        share = sum(len(at) for at, _ in clipped) / len(v)
        if len(clipped) < _PULSES or share < _OFTEN:
            continue
        grown = max(grown for _, grown in clipped)
        message = (
            f"{loop.name} runs at {top:.3g} /s in {len(clipped)} movements, {100 * share:.2g} % of "
            f"the rows, whatever its error, which changes by up to {grown:.2g} meanwhile: the "
            "drive is at its limit of speed or torque; state the limit in [controller], or record "
            "a gentler motion"
        )
        evidence = {"speed": top, "share": share, "error": grown}
        found = log_finding(log.name, "saturated", "warning", message, loop.name, **evidence)
        yield loop.name, found


def _sampled(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield the joints that are logged too slowly for the bandwidth of their loops."""
    found = {}
    for loop in loops:
        f = loop.response[0]
        width = loop.bandwidth if np.isfinite(loop.bandwidth) else float(f[-1]) if len(f) else 0.0
        if width * loop.step * _RATE > 1:
            found[loop.name] = width
    if not found:
        return
    rate, width = 1 / loops[0].step, max(found.values())
    message = (
        f"{listed(found)} follow their commands up to {width:.3g} Hz and are logged at {rate:.3g} "
        f"Hz, {rate / width:.2g} rows per period: delay and damping are not told apart between "
        f"rows; log at {_RATE * width:.2g} Hz or more"
    )
    part = "" if len(found) == len(log.joints) else listed(found)
    yield log_finding(
        log.name, "slow_sampling", "warning", message, part, rate=rate, bandwidth=width
    )


def _gives_way(log: Log, loops: Sequence[_Loop]) -> Iterator[Finding]:
    """Yield joints that are told to stand, and move with the others."""
    q = log.q[loops[0].rows]
    for loop in loops:
        since = round(_SETTLED / loop.step)
        changed = np.append(True, np.diff(loop.told) != 0)
        last = np.maximum.accumulate(np.where(changed, np.arange(len(changed)), 0))
        runs = [run for run in runs_of(np.arange(len(last)) - last >= since)]
        held = np.concatenate([np.arange(i, k) for i, k in runs] or [np.empty(0, int)])
        if len(held) * loop.step < _HELD:
            continue
        centred = np.concatenate([q[i:k] - q[i:k].mean(axis=0) for i, k in runs])
        own, others = centred[:, loop.joint], np.delete(centred, loop.joint, axis=1)
        size = float(np.sqrt(2) * own.std())
        if size < max(_GIVES_WAY, 3 * quantum(log.q[:, loop.joint])):
            continue
        fit = others @ np.linalg.lstsq(others, own)[0]
        share = 1 - float(np.sum((own - fit) ** 2) / np.sum(own**2))
        if share < _EXPLAINED:
            continue
        message = (
            f"{loop.name} is told to stand and moves by {size:.2g} with the other joints, which "
            f"explain {100 * share:.0f} % of it: the base moves on its stand, or the joint gives "
            "way, as its gains are low for its load; fix the base, and fit this joint's stiffness"
        )
        yield log_finding(
            log.name, "moved_by_others", "warning", message, loop.name, size=size, share=share
        )
