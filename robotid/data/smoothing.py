"""Smooth motion of segments without gaps, as a whole or part by part.

A part is resampled and filtered together with neighbouring rows, which are removed afterwards.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.typing import Array
from robotid.data.base_motion import BaseMotion, base_state, pose_jumps
from robotid.data.friction_direction import acting_directions
from robotid.data.log import Log, Trajectory
from robotid.data.signal_filters import butterworth_poles, zero_phase
from robotid.data.signal_settings import SignalSettings
from robotid.data.splines import cubic_spline

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
    """Return the smooth motion of segments without gaps, or of a part of them.

    The result for a part equals that for the whole, if the log has the rows of its segments
    within ``filter_reach`` of the part.

    speeds (c, n).
    """
    is_sharp = settings.cutoff is None and settings.friction_band == 0
    ratios = np.empty((0, len(log.joints))) if speeds is None or is_sharp else speeds
    if len(log.t) > KEPT or first or own.indices(len(log.t)) != (0, len(log.t), 1):
        return _process(log, segments, settings, first, own, ratios, {})
    known = _KNOWN.setdefault(log, {})
    key = settings, tuple(segments), ratios.shape, ratios.tobytes()
    if key not in known:
        channels = _CHANNELS.setdefault(log, {})
        known[key] = _process(log, segments, settings, first, own, ratios, channels)
    return known[key].at(slice(None))  # with a cache of its own


def _process(
    log: Log,
    segments: Sequence[Segment],
    settings: SignalSettings,
    first: int,
    own: slice,
    ratios: Array,
    known: dict[object, Array],
) -> Trajectory:
    """Return the motion as of ``process_segments``, for the speeds of Coulomb friction.

    The ``known`` channels of these rows are used; others are added to them.
    """
    n, base = len(log.joints), 0 if log.base is None else 6
    parts, counts = [], []
    for segment in segments:
        rows = slice(max(segment.first - first, 0), min(segment.stop - first, len(log.t)))
        part = _process_part(log, rows, segment, settings, first, own, ratios, known)
        counts.append(0 if part is None else len(part[0]))
        parts += [] if part is None else [part]
    empty = np.empty((0, base + n))
    q0 = np.empty((0, n + (base and 7)))
    nothing = (
        np.empty(0), q0, empty, empty, empty, np.empty((0, len(ratios))),
        np.empty((0, len(log.wrenches))),
    )  # fmt: skip
    t, q, v, a, tau, direction, wrenches = (
        np.concatenate(x) for x in zip(nothing, *parts, strict=True)
    )
    contacts, switching = _contacts(log, t, settings) if log.contacts else (None, None)
    if log.base is not None and log.base.imu is None and len(t):
        jumping = _jumping(log.t, log.base.pose, t, settings)
        switching = jumping if switching is None else switching | jumping
    return Trajectory(
        t=t, q=q, v=v, a=a, tau=tau, joints=log.joints, rate=settings.rate,
        segment=np.repeat([segment.number for segment in segments], counts),
        direction=direction if len(ratios) else None,
        contacts=contacts,
        switching=switching,
        wrenches=wrenches if log.wrenches else None,
    )  # fmt: skip


def filter_reach(settings: SignalSettings) -> float:
    """Return the settling time of the filter, before and after a row [s].

    It is more than twice the settling time of one filter: the sign of a smooth speed depends on
    the longest time of stiction, and is filtered a second time.
    """
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
    """Return values after the zero-phase Butterworth filter, same shape; unchanged without one.

    values (N, ...).
    """
    if settings.cutoff is None or len(values) < 2:
        return values
    pad = min(len(values) - 1, int(2 * rate / settings.cutoff))  # two periods
    return zero_phase(values, settings.order, settings.cutoff, rate, pad)


def too_short(where: str, segments: int, settings: SignalSettings) -> DataError:
    """Return the error of a log without a segment that is long enough."""
    return DataError(
        f"{where}: none of its {segments} segments without gaps is long "
        f"enough for the filter and a trim of {settings.trim:g} s at each end; record longer, "
        "or lower trim",
        code="too_short",
    )


def _process_part(
    log: Log,
    rows: slice,
    segment: Segment,
    settings: SignalSettings,
    first: int,
    own: slice,
    speeds: Array,
    known: dict[object, Array],
) -> tuple[Array, Array, Array, Array, Array, Array, Array] | None:
    """Return t, q, v, a, tau, direction and wrenches of the own rows, None if there are none."""
    t = log.t[rows]
    if segment.rows < 5 or segment.end - segment.start <= 2 * settings.trim:
        return None
    grid = _Grid.of(segment, settings)
    if grid.count < 5:
        return None
    local = rows.start + first - segment.first  # number of the first row in the segment
    numbers = grid.numbers(t, local, is_last=rows.stop + first == segment.stop)
    times = t if grid.step is None else grid.at(numbers)
    channels = {"q": log.q, "tau": log.tau}
    if settings.velocity == "measured" and log.v is not None:
        channels["v"] = log.v
    if settings.acceleration == "measured" and log.a is not None:
        channels["a"] = log.a
    if log.base is not None:
        channels |= _base_channels(log.base, settings)
    if log.wrenches:
        channels["wrenches"] = np.column_stack([*log.wrenches.values()])
    delay = {"tau": settings.torque_delay, "v": settings.velocity_delay}
    smooth = {}
    for name, x in channels.items():
        late = delay.get(name, 0.0)
        on_grid = name, segment, grid, late
        filtered = *on_grid, settings.cutoff, settings.order
        if on_grid not in known:
            known[on_grid] = _resample(t - late, x[rows], times)
        if filtered not in known:
            known[filtered] = low_pass(known[on_grid], grid.rate, settings)
        smooth[name] = known[filtered]
    v = smooth["v"] if "v" in smooth else np.gradient(smooth["q"], times, axis=0)
    a = smooth["a"] if "a" in smooth else np.gradient(v, times, axis=0)
    # filtered as the torque, before rows are left out
    direction = low_pass(_acting(times, v @ speeds.T, settings), grid.rate, settings)
    inside = (times >= grid.start + settings.trim) & (times <= grid.last - settings.trim)
    if grid.decimation > 1:
        inside &= (numbers - grid.number_of(grid.start + settings.trim)) % grid.decimation == 0
    if own.start is not None and own.start > segment.first:
        inside &= times >= log.t[own.start - first]
    if own.stop is not None and own.stop < segment.stop:
        inside &= times < log.t[own.stop - first]
    chosen = np.flatnonzero(inside)
    if len(chosen) == 0:
        return None
    q, tau = smooth["q"], smooth["tau"]
    if log.base is not None:
        measured = smooth.get("twist"), smooth.get("base acceleration")
        imu = log.base.imu and replace(log.base.imu, values=smooth["imu"])
        state = base_state(times, smooth["pose"], *measured, imu)
        q, v, a = (np.hstack(pair) for pair in zip(state, (q, v, a), strict=True))
        tau = np.hstack([np.zeros((len(tau), 6)), tau])  # no torque acts on the base
    wrenches = smooth.get("wrenches", np.empty((len(times), 0)))
    arrays = times, q, v, a, tau, direction, wrenches
    return tuple(x[chosen] for x in arrays)  # type: ignore[return-value]


def _base_channels(base: BaseMotion, settings: SignalSettings) -> dict[str, Array]:
    """Return the channels of a floating base by name, measured ones where the joints' are."""
    channels = {"pose": base.pose}
    if base.imu is not None:
        return channels | {"imu": base.imu.values}
    if settings.velocity == "measured" and base.twist is not None:
        channels["twist"] = base.twist
    if settings.acceleration == "measured" and base.acceleration is not None:
        channels["base acceleration"] = base.acceleration
    return channels


def _contacts(log: Log, t: Array, settings: SignalSettings) -> tuple[Array, Array]:
    """Return which links may touch the ground at times (N, k), and where that changes (N,), bool.

    A contact begins and ends between two rows of the log. The filter of the torque spreads its
    force before and after it: there, too, the force is unknown. What is neglected adds up over
    steps to an error of the mass. Without a filter the acceleration jumps between the two rows.
    """
    reach = _SPREAD * _time_constant(settings)
    reach += 1e-9 * float(log.t[-1] - log.t[0])
    touching = np.zeros((len(t), len(log.contacts)), dtype=bool)
    for k, flags in enumerate(log.contacts.values()):
        edges = np.diff(flags.astype(np.int8), prepend=0, append=0)
        first, last = np.flatnonzero(edges > 0) - 1, np.flatnonzero(edges < 0)
        begins = log.t[first.clip(0)] - reach
        ends = log.t[last.clip(max=len(flags) - 1)] + reach
        started = np.searchsorted(begins, t, side="right")
        touching[:, k] = started > np.searchsorted(ends, t, side="left")
    changing = np.zeros(len(t), dtype=bool)
    if not settings.cutoff:
        flags = np.column_stack(list(log.contacts.values()))
        rows = np.flatnonzero((flags[1:] != flags[:-1]).any(axis=1))
        started = np.searchsorted(log.t[rows] - reach, t, side="right")
        changing = started > np.searchsorted(log.t[rows + 1] + reach, t, side="left")
    return touching, changing


def _jumping(stamps: Array, pose: Array, t: Array, settings: SignalSettings) -> Array:
    """Return the times (N,) at which a jump of the pose of the base is in its motion, bool."""
    rows, reach = pose_jumps(stamps, pose)[0], _JUMPS * _time_constant(settings)
    begins = stamps[(rows - 1 - _BESIDE).clip(0)] - reach
    ends = stamps[(rows + _BESIDE).clip(max=len(stamps) - 1)] + reach
    started = np.searchsorted(begins, t, side="right")
    return started > np.searchsorted(ends, t, side="left")


@dataclass(frozen=True)
class _Grid:
    """The ``count`` times at which a segment is filtered, and the decimation afterwards.

    Without a step, they are the rows of the log.
    """

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
        times: Array = self.start + (self.step or 0.0) * numbers
        return times

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
        linear: Array = np.clip(w / settings.friction_band, -1.0, 1.0)
        return linear
    longest = _LONGEST / (settings.cutoff or np.inf)
    return acting_directions(t, w, settings.min_velocity, longest)


def _resample(t: Array, values: Array, grid: Array) -> Array:
    """Return the values on the grid, by cubic splines through the true time stamps."""
    if len(grid) == len(t) and np.array_equal(grid, t):
        return values
    # a channel with a delay is constant beyond its ends
    return cubic_spline(t, values, np.clip(grid, t[0], t[-1]))
