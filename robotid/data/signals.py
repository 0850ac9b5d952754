"""From a raw log to smooth motion: resample, filter, differentiate, trim. Log -> Trajectory.

Signals are not filtered or differentiated across a gap or from one log to another. Every step can
be switched off: with ``cutoff=None`` and no ``rate`` the rows are those of the log.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from weakref import WeakKeyDictionary

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.findings import listed
from robotid.base.text import seconds
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.data.measured_velocity import is_trustworthy
from robotid.data.signal_settings import SignalSettings
from robotid.data.smoothing import KEPT, Segment, process_segments, too_short

_SLOWEST = 1e-6  # smallest cut-off over the rate
_GAP_STEPS = 2.5  # [median steps] a longer step may be a gap
_UNWRAPPED: WeakKeyDictionary[Log, Log] = WeakKeyDictionary()
_GAP_CYCLES = 0.25  # [periods of the filter] ... if it is also longer than this


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
        gap = max(_GAP_STEPS * step, _GAP_CYCLES / cutoff if cutoff else 0.0)
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
