"""From a raw log to smooth motion: resample, filter, differentiate, trim. Log -> Trajectory."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from weakref import WeakKeyDictionary

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.polynomial.polynomial import polyder, polyval
from scipy.linalg.lapack import dtbtrs

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.findings import listed
from robotid.base.text import seconds
from robotid.base.typing import Array, frozen
from robotid.data.base_motion import GAP_STEPS, base_state, pose_jumps
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.units import is_trustworthy

_SLOWEST = 1e-6  # smallest cut-off over the rate
_UNWRAPPED: WeakKeyDictionary[Log, Log] = WeakKeyDictionary()
GAP_CYCLES = 0.25  # [periods of the filter] shortest gap, if it is longer than ``GAP_STEPS``
#: Rows after which the end of a cubic spline has no effect: it decreases by half or more per row.
SPLINE = 64
_SETTLED = 42.0  # [time constants] after which a filter's transient is negligible: 6e-19
_LONGEST = 8.0  # [periods of the filter] longest time of stiction
_FINEST = 1000  # largest number of points of the uniform grid per row of the log
_ALL = slice(None)
#: Rows of a log up to which its motions are kept as long as the log.
KEPT = 20_000
_KNOWN: WeakKeyDictionary[Log, dict[object, Trajectory]] = WeakKeyDictionary()
#: Channels on the grid, and after the filter; settings may differ in the source of velocities.
_CHANNELS: WeakKeyDictionary[Log, dict[object, Array]] = WeakKeyDictionary()
_SPREAD = 3.6  # [time constants] from a force at which less than 1 % of it is left
_JUMPS = 14.0  # [time constants] after which it has forgotten a jump: 1e-6
_BESIDE = 16  # rows after which splines and differences have
_REST = 1e-6  # [rad/s] slower: at rest, because the sign is a rounding error
# Least time of stiction in the band, over the time by the slopes at its edges.
_REVERSAL = 2.0  # a straight line through zero has 1, a cubic that rests there has 3
_RETURN = 4.0  # a parabola from zero to the far edge of the band has 2 to 4
_LENGTH = 0.25  # [s] of a block whose rows become one sample


def resolve(log: Log, settings: SignalSettings) -> SignalSettings:
    """Return the settings with the automatic values for this log."""
    return decide(
        settings,
        float(np.median(np.diff(log.t))),
        log.path or "log",
        has_velocity=log.v is not None,
        has_acceleration=log.a is not None,
        is_trusted=lambda: is_trustworthy(log, settings.velocity_delay),
    )


def decide(
    settings: SignalSettings,
    step: float,
    where: str,
    *,
    has_velocity: bool,
    has_acceleration: bool,
    is_trusted: Callable[[], bool],
) -> SignalSettings:
    """Return the settings as of ``resolve``, from a few properties of the log."""
    rate, cutoff = settings.rate, settings.cutoff
    if rate is None and cutoff is not None:
        rate = 1.0 / step
    if cutoff is not None and rate is not None and cutoff >= rate / 2:
        raise SettingsError(
            f"{where}: cutoff {cutoff:g} Hz is not below half the rate {rate:g} Hz; lower the "
            "cutoff or set cutoff = false"
        )
    if cutoff is not None and rate is not None and cutoff < _SLOWEST * rate:
        raise SettingsError(
            f"{where}: cutoff {cutoff:g} Hz is less than {_SLOWEST:g} of the rate {rate:g} Hz, so "
            "the filter is not accurate; increase the cutoff, lower rate, or correct the time "
            "stamps"
        )
    measured = {"velocity": ("dq", has_velocity), "acceleration": ("ddq", has_acceleration)}
    for quantity, (column, is_there) in measured.items():
        if getattr(settings, quantity) == "measured" and not is_there:
            raise DataError(
                f"{where} has no measured {quantity} for every joint; add {column}_<joint> "
                f"columns, or set {quantity} = 'differentiated'"
            )
    velocity, acceleration = settings.velocity, settings.acceleration
    if velocity == "auto":
        velocity = "measured" if has_velocity and is_trusted() else "differentiated"
    if acceleration == "auto":
        is_used = has_acceleration and velocity == "measured"
        acceleration = "measured" if is_used else "differentiated"
    gap = settings.max_gap
    if gap is None:
        gap = max(GAP_STEPS * step, GAP_CYCLES / cutoff if cutoff else 0.0)
    return replace(settings, rate=rate, velocity=velocity, acceleration=acceleration, max_gap=gap)


def process(log: Log, settings: SignalSettings, speeds: Array | None = None) -> Trajectory:
    """Return the smooth trajectory of a log, with the number of the ``segment`` of each row."""
    settings = resolve(log, settings)
    breaks = np.flatnonzero(np.diff(log.t) > (settings.max_gap or np.inf)) + 1
    edges = [0, *breaks.tolist(), len(log.t)]
    segments = [
        Segment(first, stop, float(log.t[first]), float(log.t[stop - 1]), number)
        for number, (first, stop) in enumerate(pairwise(edges))
    ]
    trajectory = process_segments(log, segments, settings, speeds=speeds)
    if len(trajectory.t) == 0:
        raise too_short(log.path or "log", len(segments), settings)
    numbers = np.unique(trajectory.segment, return_inverse=True)[1]
    if np.array_equal(numbers, trajectory.segment):
        return trajectory
    return replace(trajectory, segment=numbers)


def unwrap(log: Log, is_free: Array) -> Log:
    """Return the log without jumps of a full turn of joints without limits: is_free (n,)."""
    jumps = np.abs(np.abs(np.diff(log.q, axis=0)) - 2 * np.pi) < 0.5  # [rad]
    has_jump = jumps.any(axis=0)
    for j in np.flatnonzero(has_jump & ~np.asarray(is_free, dtype=bool)):
        k = int(np.argmax(jumps[:, j]))
        raise DataError(
            f"{log.path or 'log'}: q_{log.joints[j]} jumps by a full turn at t = "
            f"{seconds(log.t[k + 1])} s, but the joint has limits in the URDF; correct the "
            "recording",
            code="full_turn",
        )
    if not has_jump.any():
        return log
    if log in _UNWRAPPED:
        return _UNWRAPPED[log]
    q = log.q.copy()
    q[:, has_jump] = np.unwrap(q[:, has_jump], axis=0)
    names = [log.joints[j] for j in np.flatnonzero(has_jump)]
    unwrapped = replace(log, q=q, notes=(*log.notes, turns_note(names)))
    if len(log.t) <= KEPT:  # its motions are kept with it
        _UNWRAPPED[log] = unwrapped
    return unwrapped


def turns_note(joints: Sequence[str]) -> str:
    """Return the note that full turns were removed."""
    return f"full turns removed from the angle of {listed(joints)}"


@dataclass(frozen=True)
class Segment:
    """A segment of a log without a gap."""

    first: int  # its first row
    stop: int  # the row after its last one
    start: float  # time stamp of its first row [s]
    end: float  # time stamp of its last row [s]
    number: int = 0  # of the segment

    @property
    def rows(self) -> int:
        """Number of its rows."""
        return self.stop - self.first


def process_segments(
    log: Log,
    segments: Sequence[Segment],
    settings: SignalSettings,
    *,
    first: int = 0,
    own: slice = _ALL,
    speeds: Array | None = None,
) -> Trajectory:
    """Return the smooth motion of segments without gaps, or of a part of them: speeds (c, n)."""
    # a part equals the whole if the log has the rows of its segments within ``filter_reach``
    is_sharp = settings.cutoff is None and settings.friction_band == 0
    ratios = np.empty((0, len(log.joints))) if speeds is None or is_sharp else speeds
    if len(log.t) > KEPT or first or own.indices(len(log.t)) != (0, len(log.t), 1):
        return _process(_Part(log, settings, first, own, ratios, {}), segments)
    known = _KNOWN.setdefault(log, {})
    key = settings, tuple(segments), ratios.shape, ratios.tobytes()
    if key not in known:
        channels = _CHANNELS.setdefault(log, {})
        known[key] = _process(_Part(log, settings, first, own, ratios, channels), segments)
    return known[key].at(slice(None))  # with a cache of its own


@dataclass(frozen=True, eq=False)
class _Part:
    """Rows of a log that become a trajectory."""

    log: Log
    settings: SignalSettings
    first: int  # number of the first row of the log
    own: slice  # the rows wanted; the others are beside them
    speeds: Array  # of Coulomb friction over those of the joints, (c, n)
    known: dict[object, Array]  # channels of these rows; others are added


def _process(part: _Part, segments: Sequence[Segment]) -> Trajectory:
    """Return the motion as of ``process_segments``."""
    log, settings, n = part.log, part.settings, len(part.log.joints)
    base = 0 if log.base is None else 6
    motions = [_smooth(part, segment) for segment in segments]
    widths = 0, n + (base and 7), *[base + n] * 3, len(part.speeds), len(log.wrenches)
    nothing = [np.empty((0, width) if width or k else 0) for k, width in enumerate(widths)]
    moving = [motion for motion in motions if motion]
    t, q, v, a, tau, direction, wrenches = map(np.concatenate, zip(nothing, *moving, strict=True))
    contacts, switching = _contacts(log, t, settings) if log.contacts else (None, None)
    if log.base is not None and log.base.imu is None and len(t):
        rows, reach = pose_jumps(log.t, log.base.pose)[0], _JUMPS * _time_constant(settings)
        jumping = _are_within(t, log.t, rows - 1 - _BESIDE, rows + _BESIDE, reach)
        switching = jumping if switching is None else switching | jumping
    counts = [len(motion[0]) if motion else 0 for motion in motions]
    return Trajectory(
        t=t, q=q, v=v, a=a, tau=tau, joints=log.joints, rate=settings.rate,
        segment=np.repeat([segment.number for segment in segments], counts),
        direction=direction if len(part.speeds) else None,
        contacts=contacts,
        switching=switching,
        wrenches=wrenches if log.wrenches else None,
    )  # fmt: skip


def filter_reach(settings: SignalSettings) -> float:
    """Return the settling time of filter, stiction and filter, before and after a row [s]."""
    delay = max(abs(settings.torque_delay), abs(settings.velocity_delay))
    if settings.cutoff is None or settings.rate is None:
        return delay
    return delay + 2.0 * _SETTLED * _time_constant(settings) + _LONGEST / settings.cutoff


def _time_constant(settings: SignalSettings) -> float:
    """Return the longest time constant of the filter [s]; 0 without one."""
    order, cutoff, rate = settings.order, settings.cutoff, settings.rate
    if cutoff is None or rate is None:
        return 0.0
    poles = butterworth_poles(order, cutoff, rate)
    digital = 1 / (-np.log(np.abs(poles).max()) * rate)
    analog = 1 / (2 * np.pi * cutoff * np.sin(np.pi / (2 * order)))  # on a finer grid
    return float(max(digital, analog))


def low_pass(values: Array, rate: float, settings: SignalSettings) -> Array:
    """Return values (N, ...) after the zero-phase Butterworth filter, if the settings have one."""
    if settings.cutoff is None or len(values) < 2:
        return values
    pad = min(len(values) - 1, int(2 * rate / settings.cutoff))  # two periods
    return zero_phase(values, settings.order, settings.cutoff, rate, pad)


def too_short(where: str, segments: int, settings: SignalSettings) -> DataError:
    """Return the error of a log without a segment that is long enough."""
    return DataError(
        f"{where}: none of its {segments} segments without gaps is long enough for the filter and "
        f"a trim of {settings.trim:g} s at each end; record longer, or lower trim",
        code="too_short",
    )


def _smooth(part: _Part, segment: Segment) -> list[Array]:
    """Return t, q, v, a, tau, direction and wrenches of the own rows of a segment, or nothing."""
    log, settings, first, own = part.log, part.settings, part.first, part.own
    if segment.rows < 5 or segment.end - segment.start <= 2 * settings.trim:
        return []
    grid = _Grid.of(segment, settings)
    if grid.count < 5:
        return []
    rows = slice(max(segment.first - first, 0), min(segment.stop - first, len(log.t)))
    t, local = log.t[rows], rows.start + first - segment.first  # number of the first row in it
    numbers = grid.numbers(t, local, is_last=rows.stop + first == segment.stop)
    times = t if grid.step is None else grid.at(numbers)
    smooth = _channels(part, segment, grid, rows, times)
    v = smooth["v"] if "v" in smooth else np.gradient(smooth["q"], times, axis=0)
    a = smooth["a"] if "a" in smooth else np.gradient(v, times, axis=0)
    # filtered as the torque, before rows are left out
    direction = low_pass(_acting(times, v @ part.speeds.T, settings), grid.rate, settings)
    inside = (times >= grid.start + settings.trim) & (times <= grid.last - settings.trim)
    if grid.decimation > 1:
        inside &= (numbers - grid.number_of(grid.start + settings.trim)) % grid.decimation == 0
    if own.start is not None and own.start > segment.first:
        inside &= times >= log.t[own.start - first]
    if own.stop is not None and own.stop < segment.stop:
        inside &= times < log.t[own.stop - first]
    chosen = np.flatnonzero(inside)
    if len(chosen) == 0:
        return []
    q, tau = smooth["q"], smooth["tau"]
    if log.base is not None:
        measured = smooth.get("twist"), smooth.get("base acceleration")
        imu = log.base.imu and replace(log.base.imu, values=smooth["imu"])
        state = base_state(times, smooth["pose"], *measured, imu)
        q, v, a = (np.hstack(pair) for pair in zip(state, (q, v, a), strict=True))
        tau = np.hstack([np.zeros((len(tau), 6)), tau])  # no torque acts on the base
    wrenches = smooth.get("wrenches", np.empty((len(times), 0)))
    return [x[chosen] for x in (times, q, v, a, tau, direction, wrenches)]


def _channels(
    part: _Part, segment: Segment, grid: "_Grid", rows: slice, times: Array
) -> dict[str, Array]:
    """Return the filtered channels at times, measured derivatives only where they are used."""
    log, base, settings, known = part.log, part.log.base, part.settings, part.known
    channels: dict[str, Array | None] = {"q": log.q, "tau": log.tau}
    if log.wrenches:
        channels["wrenches"] = np.column_stack([*log.wrenches.values()])
    if base is not None:
        channels["pose"] = base.pose
        channels["imu"] = None if base.imu is None else base.imu.values
    blind = base is not None and base.imu is None
    if settings.velocity == "measured":
        channels |= {"v": log.v, "twist": base.twist if base and blind else None}
    if settings.acceleration == "measured":
        channels |= {"a": log.a, "base acceleration": base.acceleration if base and blind else None}
    delay = {"tau": settings.torque_delay, "v": settings.velocity_delay}
    smooth = {}
    for name, x in channels.items():
        if x is None:
            continue
        late = delay.get(name, 0.0)
        on_grid = name, segment, grid, late
        filtered = *on_grid, settings.cutoff, settings.order
        if on_grid not in known:
            known[on_grid] = _resample(log.t[rows] - late, x[rows], times)
        if filtered not in known:
            known[filtered] = low_pass(known[on_grid], grid.rate, settings)
        smooth[name] = known[filtered]
    return smooth


def _contacts(log: Log, t: Array, settings: SignalSettings) -> tuple[Array, Array]:
    """Return which links may touch the ground at times (N, k), and where that changes (N,)."""
    # the filter spreads the force of a contact before and after it: what is neglected is an error
    # of the mass; without a filter the acceleration jumps between two rows
    reach = _SPREAD * _time_constant(settings)
    reach += 1e-9 * float(log.t[-1] - log.t[0])
    touching = np.zeros((len(t), len(log.contacts)), dtype=bool)
    for k, flags in enumerate(log.contacts.values()):
        edges = np.diff(flags.astype(np.int8), prepend=0, append=0)
        first, last = np.flatnonzero(edges > 0) - 1, np.flatnonzero(edges < 0)
        touching[:, k] = _are_within(t, log.t, first, last, reach)
    if settings.cutoff:
        return touching, np.zeros(len(t), dtype=bool)
    flags = np.column_stack(list(log.contacts.values()))
    rows = np.flatnonzero((flags[1:] != flags[:-1]).any(axis=1))
    return touching, _are_within(t, log.t, rows, rows + 1, reach)


def _are_within(t: Array, stamps: Array, first: Array, last: Array, reach: float) -> Array:
    """Return which times (N,) lie between the stamps of two rows, enlarged by a time, bool."""
    started = np.searchsorted(stamps[first.clip(0)] - reach, t, side="right")
    return started > np.searchsorted(stamps[last.clip(max=len(stamps) - 1)] + reach, t)


@dataclass(frozen=True)
class _Grid:
    """The times at which a segment is filtered, and the decimation; no step: the log's rows."""

    start: float
    last: float
    step: float | None
    count: int
    decimation: int = 1

    @classmethod
    def of(cls, segment: Segment, settings: SignalSettings) -> "_Grid":
        """Return the grid of a whole segment."""
        if settings.rate is None:
            return cls(segment.start, segment.end, None, segment.rows)
        native = (segment.rows - 1) / (segment.end - segment.start)
        # a rate below the log's is reached by decimation after the filter, against aliasing
        decimation = max(1, round(native / settings.rate)) if settings.cutoff is not None else 1
        step = 1.0 / (settings.rate * decimation)
        count = int(np.floor((segment.end - segment.start) / step * (1 + 1e-12))) + 1
        if count > _FINEST * segment.rows:
            raise SettingsError(
                f"{segment.rows} rows over {segment.end - segment.start:.6g} s would become "
                f"{count} rows at {1 / step:.6g} Hz; lower rate, or max_gap if the clock jumps"
            )
        return cls(segment.start, segment.start + step * (count - 1), step, count, decimation)

    @property
    def rate(self) -> float:
        """Points per second."""
        return (self.count - 1) / (self.last - self.start)

    def at(self, numbers: Array) -> Array:
        """Return the times of some points."""
        return self.start + (self.step or 0.0) * numbers

    def number_of(self, t: float) -> int:
        """Return the first point that is not before t."""
        k = np.arange(-2, 3) + round((t - self.start) / (self.step or 1.0))
        return int(k[np.argmax(self.at(k) >= t)])

    def numbers(self, t: Array, first: int, *, is_last: bool) -> Array:
        """Return the numbers of the grid points within rows t, the first of which is ``first``."""
        if self.step is None:
            return np.arange(first, first + len(t))
        start = 0 if first == 0 else self.number_of(float(t[0]))
        return np.arange(start, self.count if is_last else self.number_of(float(t[-1])))


def _acting(t: Array, w: Array, settings: SignalSettings) -> Array:
    """Return the direction of Coulomb friction, before any filter."""
    if settings.friction_band > 0:
        return np.clip(w / settings.friction_band, -1.0, 1.0)
    longest = _LONGEST / (settings.cutoff or np.inf)
    return acting_directions(t, w, settings.min_velocity, longest)


def _resample(t: Array, values: Array, grid: Array) -> Array:
    """Return the values on the grid, by cubic splines through the true time stamps."""
    if len(grid) == len(t) and np.array_equal(grid, t):
        return values
    from scipy.interpolate import CubicSpline  # takes long to import

    # a channel with a delay is constant beyond its ends
    return np.asarray(CubicSpline(t, values)(np.clip(grid, t[0], t[-1])))


def acting_directions(t: Array, w: Array, band: float, longest: float) -> Array:
    """Return the direction of Coulomb friction, -1 to 1, (N, c): the sign of the speed w (N, c).

    In stiction, longer in the band than its slopes indicate, it is linear in time (Karnopp 1985).
    """
    directions = np.where(np.abs(w) < _REST, 0.0, np.sign(w))
    for x, direction in zip(w.T, directions.T, strict=True):
        edges = np.flatnonzero(np.diff(np.abs(x) < band)) + 1
        for i, k in pairwise(edges):
            if abs(x[i]) >= band:  # fast after this edge
                continue
            before, after = np.sign(x[i - 1]), np.sign(x[k])
            enters = _crossing(t[i - 1 : i + 1], x[i - 1 : i + 1], before * band)
            leaves = _crossing(t[k - 1 : k + 1], x[k - 1 : k + 1], after * band)
            slow = leaves[0] - enters[0]
            least = _REVERSAL if before != after else _RETURN
            if least * band * (1 / enters[1] + 1 / leaves[1]) <= slow <= longest:
                share = (t[i:k] - enters[0]) / slow
                direction[i:k] = before + (after - before) * share
    return directions


def _crossing(t: Array, x: Array, level: float) -> tuple[float, float]:
    """Return the time at which x crosses the level between two instants, and its slope."""
    slope = (x[1] - x[0]) / (t[1] - t[0])
    return float(t[0] + (level - x[0]) / slope), float(abs(slope))


def standing_motion(
    log: Log, max_gap: float, least: Array, fastest: Array, hardest: Array
) -> tuple[Trajectory, Array]:
    """Return the means (K,) of a log over slow blocks of 0.25 s, and which of them are at rest."""
    of_block, segment = _blocks(log.t, max_gap)
    first = np.flatnonzero(np.diff(of_block, prepend=-1))
    count = np.diff(np.append(first, len(log.t)))
    t, q, tau = (_means(x, first, count) for x in (log.t, log.q, log.tau))
    dt, dq = log.t - t[of_block], log.q - q[of_block]
    square = np.add.reduceat(dt**2, first)[:, None]
    v = np.add.reduceat(dt[:, None] * dq, first) / np.where(square > 0, square, np.inf)
    # the slope of a short block is noise: it is reduced with the duration
    length = log.t[first + count - 1] - log.t[first]
    v = v * np.minimum(1.0, 2 * length / _LENGTH)[:, None]
    is_adjacent = np.diff(segment) == 0
    change = np.zeros_like(v)
    steps = np.abs(np.diff(v, axis=0)) / np.diff(t)[:, None] * is_adjacent[:, None]
    np.maximum(change[1:], steps, out=change[1:])
    np.maximum(change[:-1], steps, out=change[:-1])
    slow = np.all((np.abs(v) <= fastest) & (change <= hardest), axis=1)
    signs = np.where(np.abs(v) < least, 0.0, np.sign(v))
    still = slow & ~signs.any(axis=1)
    # next to a block of another sign, a joint may have reversed within this block
    is_reversal = (np.diff(signs, axis=0) != 0) & is_adjacent[:, None]
    v[1:][is_reversal] = v[:-1][is_reversal] = 0.0
    is_same_pose = (np.abs(np.diff(q, axis=0)) < least * np.diff(t)[:, None]).all(axis=1)
    joined = np.append(False, still[1:] & still[:-1] & is_adjacent & is_same_pose)[slow]
    starts, weight = np.flatnonzero(~joined), count[slow]
    total = np.add.reduceat(weight, starts) if len(starts) else weight
    t, q, tau = (
        _means((x[slow].T * weight).T, starts, total) if len(starts) else x[:0] for x in (t, q, tau)
    )
    v, resting = v[slow][starts], still[slow][starts]
    v[resting] = 0.0
    motion = Trajectory(
        t=t, q=q, v=v, a=np.zeros_like(v), tau=tau, joints=log.joints, rate=None,
        segment=segment[slow][starts],
    )  # fmt: skip
    return motion, resting


def _blocks(t: Array, max_gap: float) -> tuple[Array, Array]:
    """Return the block of each row, and the segment between gaps of each block."""
    of_block, segment, number = np.empty(len(t), dtype=int), list[int](), 0
    edges = [0, *(np.flatnonzero(np.diff(t) > max_gap) + 1).tolist(), len(t)]
    for k, (i, j) in enumerate(pairwise(edges)):
        blocks = max(1, round((t[j - 1] - t[i]) / _LENGTH))
        length = (t[j - 1] - t[i]) / blocks or 1.0
        own = np.minimum((t[i:j] - t[i]) // length, blocks - 1)
        own = np.cumsum(np.diff(own, prepend=own[0]) > 0)  # without empty blocks
        of_block[i:j] = own + number
        number += int(own[-1]) + 1
        segment += [k] * (int(own[-1]) + 1)
    return of_block, np.array(segment)


def _means(values: Array, first: Array, total: Array) -> Array:
    """Return sums of the rows of each block, over the totals."""
    return (np.add.reduceat(values, first).T / total).T


# The filters equal sosfiltfilt and savgol_filter of scipy.signal, whose import takes longer than
# the doctor.


@cache  # a log has few filters, each for many channels
def butterworth_poles(order: int, cutoff: float, rate: float) -> Array:
    """Return the ceil(order / 2) poles of a Butterworth low-pass, by the bilinear transform."""
    angles = np.pi * (2 * np.arange((order + 1) // 2) + order + 1) / (2 * order)
    analog = np.tan(np.pi * cutoff / rate) * np.exp(1j * angles)
    return frozen((1 + analog) / (1 - analog), np.complex128)


def zero_phase(x: Array, order: int, cutoff: float, rate: float, pad: int) -> Array:
    """Return x (N, ...) filtered forwards and backwards, extended by point reflection."""
    if not x.size:
        return x  # LAPACK would write beyond an empty array
    # (k, N): each signal in one piece of memory
    rows = np.ascontiguousarray(x.reshape(len(x), -1).T)
    first, last = rows[:, :1], rows[:, -1:]
    before, after = 2 * first - rows[:, pad:0:-1], 2 * last - rows[:, -2 : -pad - 2 : -1]
    y = np.concatenate([before, rows, after], axis=1)
    poles = butterworth_poles(order, cutoff, rate)
    work = np.empty_like(y)
    for _ in range(2):
        start = y[:, :1].copy()
        y -= start
        for pole in poles:
            y, work = _filter(y, pole, work)
        y += start
        y = np.ascontiguousarray(y[:, ::-1])
    return np.asarray(y[:, pad : y.shape[1] - pad].T.reshape(x.shape))


def _filter(x: Array, pole: complex, work: Array) -> tuple[Array, Array]:
    """Return y (k, N), y + a y' + b y'' = g (x + 2 x' + x''), b = 0 of one pole, and memory."""
    is_real = abs(pole.imag) < 1e-12 * abs(pole)
    a = np.array([1.0, -pole.real] if is_real else [1.0, -2 * pole.real, abs(pole) ** 2])
    for _ in a[1:]:
        work[:, 0] = x[:, 0]
        np.add(x[:, 1:], x[:, :-1], out=work[:, 1:])  # in place it would copy the signals first
        x, work = work, x
    x *= a.sum() / 2.0 ** (len(a) - 1)  # gain 1 for constant signals
    band = np.tile(a, (x.shape[1], 1)).T  # of the triangle whose solution is the recursion
    return dtbtrs(band, x.T, uplo="L", diag="U", overwrite_b=1)[0].T, work


def local_polynomial(
    x: Array, width: int, degree: int, *, derivative: int = 0, step: float = 1.0
) -> Array:
    """Return signals x (N, ...) smoothed by local polynomials (Savitzky, Golay 1964)."""
    half = width // 2
    offsets = np.arange(-half, half + 1)
    fit = np.linalg.pinv(np.vander(offsets, degree + 1, increasing=True))  # (degree + 1, width)
    terms = polyder(np.eye(degree + 1), derivative, 1 / step)

    def weights(at: Array) -> Array:
        """Return those of the rows in the values at some offsets, shape (k, width)."""
        return np.asarray(polyval(at, terms).T @ fit)

    inner = sliding_window_view(x, width, axis=0) @ weights(offsets[half : half + 1])[0]
    first = np.tensordot(weights(offsets[:half]), x[:width], axes=1)
    last = np.tensordot(weights(offsets[half + 1 :]), x[-width:], axes=1)
    return np.concatenate([first, inner, last])
