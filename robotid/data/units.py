"""Units of a log: stated by the user, or checked; never guessed."""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.data.signal_settings import PER_SECOND, LogUnits

_TIME_NAMES = {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_DEGREES = 180 / np.pi  # degrees in a radian
_EPOCHS = 6e8, 5e9  # [s] since 1970: dates from 1989 to 2128
_SLOWEST = 0.1  # [s] a longer median step has another unit
_FARTHEST = 4 * np.pi  # [rad] a joint beyond two revolutions is in degrees
_FREE = 10 * np.pi  # [rad] ... one without limits beyond five: pendulums were recorded over 4.5
_USUAL = 2 * np.pi  # [rad] ... and one within a revolution is in radians if others are farther
_SEGMENT = 0.1  # [s] over which the motion is averaged against noise and jitter
_GAP = 5  # [median steps] a longer step is a gap
_ALIKE = 0.9  # correlation from which two signals are proportional
_NEAR = 0.1  # relative tolerance of the factor between them


def check_units(
    log: Log, units: LogUnits, prismatic: Collection[str] = (), turning: Collection[str] = ()
) -> None:
    """Reject a log whose numbers look like another unit than SI, unless the unit is stated.

    The measured velocity is compared with the position over short segments: the factor between
    the integral of dq and the change of q is 1 if both are in SI units.
    """
    is_revolute = np.array([name not in prismatic for name in log.joints])
    factor = _velocity_factor(log)  # (n,), NaN for a joint that does not determine it
    if units.time is None:
        _check_step(float(np.median(np.diff(log.t))), float(log.t[0]), log.name)
        _check_clock(log, factor)
    if units.angle is None:
        check_reach(log, units, prismatic, turning)
        _check_degrees(log, np.where(is_revolute, factor, np.nan))
        _check_commands(log, is_revolute)
    for j in np.flatnonzero(_is_near(factor, -1.0)):
        raise DataError(
            f"{log.name}: dq_{log.joints[j]} has the opposite sign of d(q)/dt of "
            f"q_{log.joints[j]}. Negate one of them in the recording, or leave the dq columns out",
            code="velocity_sign",
        )


def _check_step(step: float, start: float, where: str) -> None:
    """Reject a median time step that is too long for seconds, and dates in other units."""
    epoch = [unit for unit in _TIME_NAMES if _EPOCHS[0] < start / PER_SECOND[unit] < _EPOCHS[1]]
    if not epoch and step <= _SLOWEST * (1 + 1e-6):
        return
    unit = epoch[0] if epoch else "ms" if step <= 1e2 else "us" if step <= 1e5 else "ns"
    since = f", the first time stamp {start:.13g} since 1970" if epoch else ""
    raise DataError(
        f"{where}: median step {step:.6g} looks like {_TIME_NAMES[unit]}{since} "
        f"({PER_SECOND[unit] / step:.4g} Hz); in seconds it would be {1 / step:.3g} Hz. "
        f"{_how_to_state('time', unit, 's')}. To convert it, multiply by "
        f"{1 / PER_SECOND[unit]:g}",
        code="time_unit",
    )


def _check_clock(log: Log, factor: Array) -> None:
    """Reject time stamps with which the measured velocity is wrong by a power of 1000."""
    for power, unit in ((1, "ms"), (2, "us"), (3, "ns"), (-1, "s"), (-2, "s"), (-3, "s")):
        for j in np.flatnonzero(_is_near(np.abs(factor), 1000.0**power)):
            looks = f"; the time looks like {_TIME_NAMES[unit]}" if power > 0 else ""
            raise DataError(
                f"{log.name}: dq_{log.joints[j]} is {abs(factor[j]):.3g} times d(q)/dt{looks}. "
                f"{_how_to_state('time', unit, 's')}",
                code="time_unit",
            )


def check_reach(
    log: Log, units: LogUnits, prismatic: Collection[str] = (), turning: Collection[str] = ()
) -> None:
    """Reject revolute joints with angles too large for radians, unless the unit is stated."""
    if units.angle is not None:
        return
    is_revolute = np.array([name not in prismatic for name in log.joints])
    for kind, values in (("q", log.q), ("qref", log.q_ref)):
        if values is None:
            continue
        largest = np.where(is_revolute, np.abs(values).max(axis=0), 0.0)  # (n,)
        most = np.array([_FREE if name in turning else _FARTHEST for name in log.joints])
        j = int(np.argmax(largest / most))
        if largest[j] > most[j]:
            how = _how_to_state("angle", "deg", "rad")
            if alone := _alone(log, kind, j, np.delete(largest, j)[np.delete(is_revolute, j)]):
                how = f"{alone}. If all joints are in degrees, {how[0].lower()}{how[1:]}"
            raise DataError(
                f"{log.name}: {kind}_{log.joints[j]} reaches {largest[j]:.4g}, which looks like "
                f"degrees (in radians {largest[j] / (2 * np.pi):.1f} revolutions). {how}",
                code="angle_unit",
            )


def turned(joints: Sequence[str], q: Array, turning: Collection[str]) -> tuple[str, ...]:
    """Return what is assumed of joints without limits beyond the angles that others may reach.

    q (N, n).
    """
    far = [name for name, x in zip(joints, q.T, strict=True)
           if name in turning and np.abs(x).max() > _FARTHEST]  # fmt: skip
    if not far:
        return ()
    return (
        f"more than two revolutions of {listed(far)} are read in radians, since the URDF states no "
        'range; if the log is in degrees, state units angle = "deg" (--angle-unit deg)',
    )


def _alone(log: Log, kind: str, j: int, others: Array) -> str:
    """Return how to convert one joint that alone looks like degrees, as text; else ""."""
    if len(others) < 2 or others.max() > _USUAL:
        return ""
    kinds = [kind]
    if kind == "q" and not _is_near(np.abs(_velocity_factor(log)), 1 / _DEGREES)[j]:
        kinds += [name for name, values in (("dq", log.v), ("ddq", log.a)) if values is not None]
    if kind == "q" and log.q_ref is not None and np.abs(log.q_ref[:, j]).max() > _FARTHEST:
        kinds.append("qref")
    *first, last = [f"{each}_{log.joints[j]}" for each in kinds]
    columns = f"{', '.join(first)} and {last}" if first else last
    return (
        f"The other revolute joints reach at most {others.max():.3g}: this joint alone may be in "
        f"degrees. Then multiply {columns} by {np.pi / 180:.7f} (pi / 180) in the recording, "
        "because a stated unit applies to all joints"
    )


def _check_commands(log: Log, is_revolute: Array) -> None:
    """Reject joints with only one of position and commanded position in degrees, of any sign."""
    if log.q_ref is None:
        return
    q, wanted = log.q - log.q.mean(axis=0), log.q_ref - log.q_ref.mean(axis=0)
    both = np.einsum("kj,kj->j", q, wanted)
    sizes = np.linalg.norm(q, axis=0), np.linalg.norm(wanted, axis=0)
    follows = is_revolute & (np.abs(both) > _ALIKE * sizes[0] * sizes[1])
    factor = np.copysign(sizes[1], both) / np.where(follows, sizes[0], np.nan)
    ratio = np.abs(factor)
    for j in np.flatnonzero(_is_near(ratio, _DEGREES) | _is_near(ratio, 1 / _DEGREES)):
        raise DataError(
            f"{log.name}: the motion of qref_{log.joints[j]} is {factor[j]:.3g} times that of "
            f"q_{log.joints[j]}: one of them looks like degrees, the other like radians. Convert "
            f"one of them in the recording. {_how_to_state('angle', 'deg', 'rad', both=True)}",
            code="angle_unit",
        )


def _check_degrees(log: Log, factor: Array) -> None:
    """Reject joints with only one of position and velocity in degrees."""
    for wrong, ratio in (("velocity", _DEGREES), ("position", 1 / _DEGREES)):
        for j in np.flatnonzero(_is_near(np.abs(factor), ratio)):
            raise DataError(
                f"{log.name}: dq_{log.joints[j]} is {abs(factor[j]):.3g} times d(q)/dt: the "
                f"{wrong} looks like degrees, the other like radians. Convert one of them in the "
                "recording. "
                f"{_how_to_state('angle', 'deg', 'rad', both=True)}",
                code="angle_unit",
            )


def _how_to_state(kind: str, unit: str, si: str, both: bool = False) -> str:
    """Return how to state a unit, in the job file, on the command line and in Python."""
    stated = si if both else unit
    ways = (
        f'units {kind} = "{stated}" (job file table [units], CLI --{kind}-unit {stated}, '
        f'Python units=LogUnits({kind}="{stated}"))'
    )
    if stated == si:
        return f"To read the values without conversion, state {ways}"
    return f'State {ways}, or "{si}" if this is the unit'


def _velocity_factor(log: Log) -> Array:
    """Return f with dq = f d(q)/dt for each joint, shape (n,); NaN if they do not correlate."""
    factor = np.full(len(log.joints), np.nan)
    if log.v is None:
        return factor
    dt = np.diff(log.t)
    median = float(np.median(dt))
    length = int(np.clip(round(_SEGMENT / median), 1, max(1, len(dt) // 4)))
    for j, (q, v) in enumerate(zip(log.q.T, log.v.T, strict=True)):
        step = np.diff(q)
        jump = _is_near(np.abs(step), 2 * np.pi) | _is_near(np.abs(step), 360.0)  # a full turn
        broken = (dt > _GAP * median) | jump
        moved = _sums(np.where(broken, 0.0, step), length)
        integral = _sums(np.where(broken, 0.0, dt * (v[1:] + v[:-1]) / 2), length)
        both = float(moved @ integral)
        size = float(np.sqrt((moved @ moved) * (integral @ integral)))
        if len(dt) >= 10 and abs(both) > _ALIKE * size:
            factor[j] = np.copysign(np.sqrt((integral @ integral) / (moved @ moved)), both)
    return factor


def _sums(steps: Array, length: int) -> Array:
    """Return the sums over each segment of ``length`` consecutive steps."""
    total = np.concatenate([[0.0], np.cumsum(steps)])
    sums: Array = total[length:] - total[:-length]
    return sums


def _is_near(values: Array, wanted: float) -> NDArray[np.bool_]:
    """Return which values are within the tolerance of the wanted one."""
    near: NDArray[np.bool_] = np.abs(values / wanted - 1) < _NEAR
    return near
