"""From a raw log to smooth motion: resample, filter, differentiate, trim. Log -> Trajectory.

Nothing is filtered or differentiated across a gap, or from one log into the next. Every step can
be switched off: with ``cutoff=None`` and no ``rate`` the rows stay as they were recorded.
"""

from dataclasses import dataclass, replace

import numpy as np

from robotid._typing import Array
from robotid.data import Log, Trajectory
from robotid.exceptions import DataError, SettingsError

__all__ = ["SignalSettings", "is_moving", "process", "resolve", "unwrap", "velocity_lag"]

_LATE = 0.02  # [s] a measured velocity that lags more than this is not used by "auto"
_GAP_STEPS = 2.5  # a step longer than this many median steps may be a gap
_GAP_CYCLES = 0.25  # ... if it is also longer than this share of the filter's period


@dataclass(frozen=True)
class SignalSettings:
    """How a log becomes a trajectory.

    Attributes:
        rate: Rate of the uniform grid [Hz]; None takes the log's median rate (and, without a
            filter, the rows as they are).
        cutoff: Cut-off of the zero-phase Butterworth filter [Hz]; None for no filter.
        order: Order of the filter, which runs once forward and once backward.
        velocity: "measured", "differentiated" (from the position), or "auto": measured if the log
            has it and it lags the position by less than 20 ms.
        acceleration: "measured", "differentiated" (from the velocity used), or "auto": measured if
            the log has it and its velocity is used.
        trim: Time cut at each end of each uninterrupted stretch [s].
        min_velocity: Joint speed below which its rows are left out while Coulomb friction is
            identified [rad/s or m/s]; 0 keeps all rows.
        max_gap: A longer step between two rows is a gap [s]; None: 2.5 median steps, or a quarter
            of the filter's period if that is longer.
        torque_delay: How late the log has the torque against the position [s]; it is moved back.
        velocity_delay: The same of the measured velocity [s].
    """

    rate: float | None = None
    cutoff: float | None = 8.0
    order: int = 4
    velocity: str = "auto"
    acceleration: str = "auto"
    trim: float = 0.2
    min_velocity: float = 0.02
    max_gap: float | None = None
    torque_delay: float = 0.0
    velocity_delay: float = 0.0

    def __post_init__(self) -> None:
        for name in ("velocity", "acceleration"):
            value = getattr(self, name)
            if value not in ("auto", "measured", "differentiated"):
                raise SettingsError(
                    f"{name} is {value!r}, wanted 'auto', 'measured' or 'differentiated'"
                )
        for name in ("rate", "cutoff", "max_gap"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise SettingsError(f"{name} is {value}, wanted a positive number")
        for name in ("trim", "min_velocity"):
            value = getattr(self, name)
            if not value >= 0:
                raise SettingsError(f"{name} is {value}, wanted 0 or a positive number")
        for name in ("torque_delay", "velocity_delay"):
            value = getattr(self, name)
            if not abs(value) <= 1:
                raise SettingsError(f"{name} is {value}, wanted seconds between -1 and 1")
        if not 1 <= self.order <= 10:
            raise SettingsError(f"order is {self.order}, wanted 1 to 10")


def resolve(log: Log, settings: SignalSettings) -> SignalSettings:
    """Return the settings with everything automatic decided for this log.

    Args:
        log: The log they are for.
        settings: The settings as the user gave them.

    Returns:
        Settings with rate (unless rows stay as recorded), velocity, acceleration and max_gap
        filled in.

    Raises:
        DataError: If measured velocity or acceleration is asked for and the log has none.
        SettingsError: If the cut-off is not below half the rate.
    """
    step = float(np.median(np.diff(log.t)))
    rate = settings.rate
    if rate is None and settings.cutoff is not None:
        rate = 1.0 / step
    if settings.cutoff is not None and rate is not None and settings.cutoff >= rate / 2:
        raise SettingsError(
            f"{log.path or 'log'}: cutoff {settings.cutoff:g} Hz is not below half the rate "
            f"{rate:g} Hz; lower the cutoff or set cutoff = false"
        )
    velocity = settings.velocity
    if velocity == "measured" and log.v is None:
        raise DataError(
            f"{log.path or 'log'} has no measured velocity for every joint; add dq_<joint> "
            "columns, or set velocity = 'differentiated'"
        )
    if velocity == "auto":
        is_timely = log.v is not None and velocity_lag(log) - settings.velocity_delay < _LATE
        velocity = "measured" if is_timely else "differentiated"
    acceleration = settings.acceleration
    if acceleration == "measured" and log.a is None:
        raise DataError(
            f"{log.path or 'log'} has no measured acceleration for every joint; add ddq_<joint> "
            "columns, or set acceleration = 'differentiated'"
        )
    if acceleration == "auto":
        is_used = log.a is not None and velocity == "measured"
        acceleration = "measured" if is_used else "differentiated"
    gap = settings.max_gap
    if gap is None:
        gap = max(_GAP_STEPS * step, _GAP_CYCLES / settings.cutoff if settings.cutoff else 0.0)
    return replace(settings, rate=rate, velocity=velocity, acceleration=acceleration, max_gap=gap)


def process(log: Log, settings: SignalSettings) -> Trajectory:
    """Return the smooth trajectory of a log.

    Args:
        log: The log.
        settings: The settings; what is automatic in them is resolved first.

    Returns:
        The trajectory; rows of one uninterrupted stretch share a ``segment`` number.

    Raises:
        DataError: If no stretch is long enough.
        SettingsError: If the cut-off is not below half the rate.
    """
    settings = resolve(log, settings)
    breaks = np.flatnonzero(np.diff(log.t) > (settings.max_gap or np.inf)) + 1
    parts = []
    for rows in np.split(np.arange(len(log.t)), breaks):
        part = _process_stretch(log, rows, settings)
        if part is not None:
            parts.append(part)
    if not parts:
        raise DataError(
            f"{log.path or 'log'}: none of its {len(breaks) + 1} uninterrupted stretches is long "
            f"enough for the filter and a trim of {settings.trim:g} s at each end; record longer, "
            "or lower trim",
            code="too_short",
        )
    t, q, v, a, tau = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    segment = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    return Trajectory(
        t=t, q=q, v=v, a=a, tau=tau, joints=log.joints, rate=settings.rate, segment=segment
    )


def is_moving(trajectory: Trajectory, min_velocity: float) -> Array:
    """Return which joints move: near stand-still the sign of the velocity is noise.

    Args:
        trajectory: N samples.
        min_velocity: Bound on the speed [rad/s or m/s].

    Returns:
        Flags, shape (N, n), bool.
    """
    moving: Array = np.abs(trajectory.v) >= min_velocity
    return moving


def velocity_lag(log: Log) -> float:
    """Return how late the measured velocity is against the derivative of the position.

    The delay minimises the distance between the measured velocity and the delayed derivative,
    summed over the joints; found on a uniform grid and refined by a parabola.

    Args:
        log: A log with measured velocities.

    Returns:
        Delay [s]; positive if the measured velocity is late; 0 if the joints stand still.

    Raises:
        DataError: If the log has no velocities.
    """
    if log.v is None:
        raise DataError(f"{log.path or 'log'} has no measured velocity")
    step = float(np.median(np.diff(log.t)))
    grid = np.arange(log.t[0], log.t[-1], step)
    q = np.array([np.interp(grid, log.t, column) for column in log.q.T])  # (n, N)
    v = np.array([np.interp(grid, log.t, column) for column in log.v.T])
    slope = np.gradient(q, step, axis=1)
    longest = min(int(0.3 / step) + 1, len(grid) // 4)
    shifts = np.arange(-longest, longest + 1)
    cost = np.array([_distance(slope, v, int(shift)) for shift in shifts])
    best = int(np.argmin(cost))
    if not v.any() or not 0 < best < len(shifts) - 1:
        return 0.0
    left, middle, right = cost[best - 1 : best + 2]
    curvature = left - 2 * middle + right
    fraction = 0.5 * (left - right) / curvature if curvature > 0 else 0.0
    return float((shifts[best] + fraction) * step)


def unwrap(log: Log, is_free: Array) -> Log:
    """Return the log with jumps of a full turn taken out of joints that may turn without end.

    Args:
        log: The log.
        is_free: Which joints may, shape (n,), bool: continuous, or revolute without limits.

    Returns:
        The log; a note names the joints that were changed.

    Raises:
        DataError: If a joint with limits jumps by a full turn.
    """
    jumps = np.abs(np.abs(np.diff(log.q, axis=0)) - 2 * np.pi) < 0.5  # [rad]
    turned = jumps.any(axis=0)
    for j in np.flatnonzero(turned & ~np.asarray(is_free, dtype=bool)):
        k = int(np.argmax(jumps[:, j]))
        raise DataError(
            f"{log.path or 'log'}: q_{log.joints[j]} jumps by a full turn at t = "
            f"{log.t[k + 1]:.6g} s, but the URDF limits this joint; mend the recording",
            code="full_turn",
        )
    if not turned.any():
        return log
    q = log.q.copy()
    q[:, turned] = np.unwrap(q[:, turned], axis=0)
    names = [log.joints[j] for j in np.flatnonzero(turned)]
    return replace(log, q=q, notes=(*log.notes, f"full turns taken out of the angle of {names}"))


def _distance(slope: Array, v: Array, shift: int) -> float:
    """Return the mean square of v - slope delayed by shift samples."""
    n = v.shape[1]
    late, early = slice(max(shift, 0), n + min(shift, 0)), slice(max(-shift, 0), n - max(shift, 0))
    return float(np.mean((v[:, late] - slope[:, early]) ** 2))


def _process_stretch(
    log: Log, rows: Array, settings: SignalSettings
) -> tuple[Array, Array, Array, Array, Array] | None:
    """Return t, q, v, a, tau of one uninterrupted stretch, or None if it is too short."""
    t = log.t[rows]
    if len(t) < 5 or t[-1] - t[0] <= 2 * settings.trim:
        return None
    grid, keep_every = _grid(t, settings)
    if len(grid) < 5:
        return None
    channels = {"q": log.q, "tau": log.tau}
    if settings.velocity == "measured" and log.v is not None:
        channels["v"] = log.v
    if settings.acceleration == "measured" and log.a is not None:
        channels["a"] = log.a
    late = {"tau": settings.torque_delay, "v": settings.velocity_delay}
    smooth = {
        name: _filter(_resample(t - late.get(name, 0.0), values[rows], grid), grid, settings)
        for name, values in channels.items()
    }
    v = smooth["v"] if "v" in smooth else np.gradient(smooth["q"], grid, axis=0)
    a = smooth["a"] if "a" in smooth else np.gradient(v, grid, axis=0)
    inside = (grid >= grid[0] + settings.trim) & (grid <= grid[-1] - settings.trim)
    kept = np.flatnonzero(inside)[::keep_every]
    if len(kept) == 0:
        return None
    return grid[kept], smooth["q"][kept], v[kept], a[kept], smooth["tau"][kept]


def _grid(t: Array, settings: SignalSettings) -> tuple[Array, int]:
    """Return the time grid to filter on, and which of its rows make up the wanted rate."""
    if settings.rate is None:
        return t, 1
    native = (len(t) - 1) / (t[-1] - t[0])
    # a wanted rate below the log's is reached by decimation after the filter, against aliasing
    keep_every = max(1, round(native / settings.rate)) if settings.cutoff is not None else 1
    step = 1.0 / (settings.rate * keep_every)
    count = int(np.floor((t[-1] - t[0]) / step * (1 + 1e-12))) + 1
    return t[0] + step * np.arange(count), keep_every


def _resample(t: Array, values: Array, grid: Array) -> Array:
    """Return the values on the grid, by cubic splines through the true time stamps."""
    if len(grid) == len(t) and np.array_equal(grid, t):
        return values
    from scipy.interpolate import CubicSpline

    # of a channel moved in time nothing is known beyond its own ends
    resampled: Array = CubicSpline(t, values, axis=0)(np.clip(grid, t[0], t[-1]))
    return resampled


def _filter(values: Array, grid: Array, settings: SignalSettings) -> Array:
    """Return the values after a zero-phase Butterworth filter."""
    if settings.cutoff is None:
        return values
    from scipy.signal import butter, sosfiltfilt

    rate = (len(grid) - 1) / (grid[-1] - grid[0])
    sos = butter(settings.order, settings.cutoff, fs=rate, output="sos")
    pad = min(len(grid) - 1, int(2 * rate / settings.cutoff))  # two periods
    filtered: Array = sosfiltfilt(sos, values.T, axis=1, padlen=pad).T
    return filtered
