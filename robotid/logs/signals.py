"""From a raw log to smooth motion: resample, filter, differentiate, trim. Log -> Trajectory.

Nothing is filtered or differentiated across a gap, or from one log into the next. Every step can
be switched off: with ``cutoff=None`` and no ``rate`` the rows stay as they were recorded.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError, SettingsError
from robotid.findings import listed
from robotid.logs.data import Log, Trajectory
from robotid.logs.settings import SignalSettings
from robotid.logs.smoothing import Stretch, process_stretches, too_short

__all__ = ["decide", "process", "resolve", "turns_note", "unwrap", "velocity_lag"]

_HOLE = 100  # median steps: across a longer one no lag is sought
_LATE = 0.02  # [s] a measured velocity that lags more than this is not used by "auto"
_GAP_STEPS = 2.5  # a step longer than this many median steps may be a gap
_GAP_CYCLES = 0.25  # ... if it is also longer than this share of the filter's period


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
    return decide(
        settings,
        float(np.median(np.diff(log.t))),
        log.path or "log",
        has_velocity=log.v is not None,
        has_acceleration=log.a is not None,
        lag=lambda: velocity_lag(log),
    )


def decide(
    settings: SignalSettings,
    step: float,
    where: str,
    *,
    has_velocity: bool,
    has_acceleration: bool,
    lag: Callable[[], float],
) -> SignalSettings:
    """Return the settings as of ``resolve``, decided from a few facts of the log.

    Args:
        settings: The settings as the user gave them.
        step: Median time step of the log [s].
        where: What the log is called in errors.
        has_velocity: Whether it has measured velocities.
        has_acceleration: Whether it has measured accelerations.
        lag: Returns how late the measured velocity is [s]; called if that matters.

    Raises:
        DataError: If measured velocity or acceleration is asked for and the log has none.
        SettingsError: If the cut-off is not below half the rate.
    """
    rate, cutoff = settings.rate, settings.cutoff
    if rate is None and cutoff is not None:
        rate = 1.0 / step
    if cutoff is not None and rate is not None and cutoff >= rate / 2:
        raise SettingsError(
            f"{where}: cutoff {cutoff:g} Hz is not below half the rate {rate:g} Hz; lower the "
            "cutoff or set cutoff = false"
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
        is_timely = has_velocity and lag() - settings.velocity_delay < _LATE
        velocity = "measured" if is_timely else "differentiated"
    if acceleration == "auto":
        is_used = has_acceleration and velocity == "measured"
        acceleration = "measured" if is_used else "differentiated"
    gap = settings.max_gap
    if gap is None:
        gap = max(_GAP_STEPS * step, _GAP_CYCLES / cutoff if cutoff else 0.0)
    return replace(settings, rate=rate, velocity=velocity, acceleration=acceleration, max_gap=gap)


def process(log: Log, settings: SignalSettings, speeds: Array | None = None) -> Trajectory:
    """Return the smooth trajectory of a log, with a ``segment`` number per stretch without a gap.

    Args:
        log: The log.
        settings: The settings; what is automatic in them is resolved first.
        speeds: As of ``process_stretches``; a model with Coulomb friction needs them wherever a
            filter smears its torque.

    Raises:
        DataError: If no stretch is long enough.
        SettingsError: If the cut-off is not below half the rate.
    """
    settings = resolve(log, settings)
    breaks = np.flatnonzero(np.diff(log.t) > (settings.max_gap or np.inf)) + 1
    edges = [0, *breaks.tolist(), len(log.t)]
    stretches = [
        Stretch(first, stop, float(log.t[first]), float(log.t[stop - 1]), number)
        for number, (first, stop) in enumerate(pairwise(edges))
    ]
    trajectory = process_stretches(log, stretches, settings, speeds=speeds)
    if len(trajectory.t) == 0:
        raise too_short(log.path or "log", len(stretches), settings)
    numbers = np.unique(trajectory.segment, return_inverse=True)[1]
    return replace(trajectory, segment=numbers)


def velocity_lag(log: Log) -> float:
    """Return how late the measured velocity is against the derivative of the position [s].

    The delay minimises the distance between the measured velocity and the delayed derivative,
    summed over the joints; found on a uniform grid and refined by a parabola. It is positive if
    the measured velocity is late, and 0 if the joints stand still or there are too few rows.

    Args:
        log: A log with measured velocities.

    Raises:
        DataError: If the log has no velocities.
    """
    if log.v is None:
        raise DataError(f"{log.path or 'log'} has no measured velocity")
    step = float(np.median(np.diff(log.t)))
    # the longest stretch without a hole: the grid must not grow with a jump of the clock
    edges = [0, *(np.flatnonzero(np.diff(log.t) > _HOLE * step) + 1), len(log.t)]
    first, stop = max(pairwise(edges), key=lambda edge: edge[1] - edge[0])
    grid = np.arange(log.t[first], log.t[stop - 1], step)
    if len(grid) < 8:
        return 0.0
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
        is_free: Which joints may, shape (n,), bool: continuous, or revolute without limits. A
            note names those that were changed.

    Raises:
        DataError: If a joint with limits jumps by a full turn.
    """
    jumps = np.abs(np.abs(np.diff(log.q, axis=0)) - 2 * np.pi) < 0.5  # [rad]
    turned = jumps.any(axis=0)
    for j in np.flatnonzero(turned & ~np.asarray(is_free, dtype=bool)):
        k = int(np.argmax(jumps[:, j]))
        raise DataError(
            f"{log.path or 'log'}: q_{log.joints[j]} jumps by a full turn at t = "
            f"{log.t[k + 1]:.6g} s, but the URDF limits this joint; correct the recording",
            code="full_turn",
        )
    if not turned.any():
        return log
    q = log.q.copy()
    q[:, turned] = np.unwrap(q[:, turned], axis=0)
    names = [log.joints[j] for j in np.flatnonzero(turned)]
    return replace(log, q=q, notes=(*log.notes, turns_note(names)))


def turns_note(joints: Sequence[str]) -> str:
    """Return the note that full turns were taken out.

    Args:
        joints: Names of the joints.
    """
    return f"full turns taken out of the angle of {listed(joints)}"


def _distance(slope: Array, v: Array, shift: int) -> float:
    """Return the mean square of v - slope delayed by shift samples."""
    n = v.shape[1]
    late, early = slice(max(shift, 0), n + min(shift, 0)), slice(max(-shift, 0), n - max(shift, 0))
    return float(np.mean((v[:, late] - slope[:, early]) ** 2))
