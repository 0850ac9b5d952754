"""Units and measured velocities of a log: stated, or checked against its positions."""

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import wraps
from typing import TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.data.signal_settings import PER_SECOND, LogUnits

_TIME_NAMES = {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_EPOCHS = 6e8, 5e9  # [s] since 1970: dates from 1989 to 2128
_SLOWEST = 0.1  # [s] a longer median step has another unit
_FARTHEST = 4 * np.pi  # [rad] a joint beyond two revolutions is in degrees
_FREE = 10 * np.pi  # [rad] ... one without limits beyond five: pendulums were recorded over 4.5
#: [s] Largest lag of a measured velocity that "auto" uses.
LARGEST_LAG = 0.02
#: Least number of steps over the range of a channel with sufficient resolution.
COARSE = 100
AT_REST = 0.02  # [rad/s, or m/s of a prismatic joint] slower: at rest
STATIC = 1e-3  # [rad or m] smaller range: the joint does not move
#: Largest range of a locked joint, and largest difference from its stated position [rad or m].
STILL = 0.02
LONG_STEP = 5  # [median steps] a longer step is a gap, however irregular the rows are
_FEWEST = 8  # least number of rows of a segment in which a lag is estimated
_LONGEST = 0.3  # [s] largest lag that is tested
_UNLIKE = 0.5  # correlation below which a velocity is not the derivative of its position
_SEGMENT = 0.1  # [s] over which the motion is averaged against noise and jitter
_ALIKE = 0.9  # correlation from which two signals are proportional
_NEAR = 0.1  # relative tolerance of the factor between them

ResultT = TypeVar("ResultT")


def check_units(
    log: Log, units: LogUnits, prismatic: Collection[str] = (), turning: Collection[str] = ()
) -> None:
    """Reject a log whose numbers look like another unit than SI, unless the unit is given."""
    is_revolute = np.array([name not in prismatic for name in log.joints])
    factor = _velocity_factor(log)  # (n,), NaN for a joint that does not determine it
    mixed = _mixed_velocities(log, np.where(is_revolute, factor, np.nan))
    time = [*_wrong_step(log), *_wrong_clock(log, factor)]
    angle = [*_far_angles(log, is_revolute, turning), *mixed, *_mixed_commands(log, is_revolute)]
    unstated = (time[:1] if units.time is None else []) + (angle[:1] if units.angle is None else [])
    if unstated:  # one refusal for both units
        words = ". ".join(str(error).removeprefix(f"{log.name}: ") for error in unstated)
        raise DataError(f"{log.name}: {words}", code=unstated[0].code)
    for j in np.flatnonzero(_is_near(factor, -1.0)):
        raise DataError(
            f"{log.name}: dq_{log.joints[j]} has the opposite sign of d(q)/dt of "
            f"q_{log.joints[j]}. Negate one of them in the recording, or leave the dq columns out",
            code="velocity_sign",
        )


def _wrong_step(log: Log) -> Iterator[DataError]:
    """Yield a median time step that is too long for seconds, and dates in other units."""
    step, start = float(np.median(np.diff(log.t))), float(log.t[0])
    epoch = [unit for unit in _TIME_NAMES if _EPOCHS[0] < start / PER_SECOND[unit] < _EPOCHS[1]]
    if not epoch and step <= _SLOWEST * (1 + 1e-6):
        return
    unit = epoch[0] if epoch else "ms" if step <= 1e2 else "us" if step <= 1e5 else "ns"
    since = f", the first time stamp {start:.13g} since 1970" if epoch else ""
    yield DataError(
        f"{log.name}: median step {step:.6g} looks like {_TIME_NAMES[unit]}{since} "
        f"({PER_SECOND[unit] / step:.4g} Hz); in seconds it would be {1 / step:.3g} Hz. "
        f"{_how_to_state('time', unit, 's')}. To convert it, multiply by {1 / PER_SECOND[unit]:g}",
        code="time_unit",
    )


def _wrong_clock(log: Log, factor: Array) -> Iterator[DataError]:
    """Yield time stamps with which the measured velocity is wrong by a power of 1000."""
    for power, unit in ((1, "ms"), (2, "us"), (3, "ns"), (-1, "s"), (-2, "s"), (-3, "s")):
        for j in np.flatnonzero(_is_near(np.abs(factor), 1000.0**power)):
            looks = f"; the time looks like {_TIME_NAMES[unit]}" if power > 0 else ""
            yield DataError(
                f"{log.name}: dq_{log.joints[j]} is {abs(factor[j]):.3g} times d(q)/dt{looks}. "
                f"{_how_to_state('time', unit, 's')}",
                code="time_unit",
            )


def check_reach(
    log: Log, units: LogUnits, prismatic: Collection[str] = (), turning: Collection[str] = ()
) -> None:
    """Reject revolute joints with angles too large for radians, unless the unit is given."""
    is_revolute = np.array([name not in prismatic for name in log.joints])
    for error in _far_angles(log, is_revolute, turning) if units.angle is None else ():
        raise error


def _far_angles(log: Log, is_revolute: Array, turning: Collection[str]) -> Iterator[DataError]:
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
            yield DataError(
                f"{log.name}: {kind}_{log.joints[j]} reaches {largest[j]:.4g}, which looks like "
                f"degrees (in radians {largest[j] / (2 * np.pi):.1f} revolutions). {how}",
                code="angle_unit",
            )


def turned(joints: Sequence[str], q: Array, turning: Collection[str]) -> tuple[str, ...]:
    """Return what is assumed of joints without limits that rotate farther than others: q (N, n)."""
    far = [name for name, x in zip(joints, q.T, strict=True)
           if name in turning and np.abs(x).max() > _FARTHEST]  # fmt: skip
    if not far:
        return ()
    return (
        f"more than two revolutions of {listed(far)} are read in radians, since the URDF has no "
        'range; if the log is in degrees, set units angle = "deg" (--angle-unit deg)',
    )


def _alone(log: Log, kind: str, j: int, others: Array) -> str:
    """Return how to convert one joint that alone looks like degrees, as text; else ""."""
    if len(others) < 2 or others.max() > _FARTHEST / 2:
        return ""
    kinds = [kind]
    if kind == "q" and not _is_near(np.abs(_velocity_factor(log)), np.radians(1.0))[j]:
        kinds += [name for name, values in (("dq", log.v), ("ddq", log.a)) if values is not None]
    if kind == "q" and log.q_ref is not None and np.abs(log.q_ref[:, j]).max() > _FARTHEST:
        kinds.append("qref")
    *first, last = [f"{each}_{log.joints[j]}" for each in kinds]
    columns = f"{', '.join(first)} and {last}" if first else last
    return (
        f"The other revolute joints reach at most {others.max():.3g}: {log.joints[j]} alone may be "
        f"in degrees. Then multiply {columns} by {np.pi / 180:.7f} (pi / 180) in the recording, "
        "because the unit applies to all joints"
    )


def _mixed_commands(log: Log, is_revolute: Array) -> Iterator[DataError]:
    """Yield joints with only one of position and commanded position in degrees, of any sign."""
    if log.q_ref is None:
        return
    q, wanted = log.q - log.q.mean(axis=0), log.q_ref - log.q_ref.mean(axis=0)
    both = np.einsum("kj,kj->j", q, wanted)
    sizes = np.linalg.norm(q, axis=0), np.linalg.norm(wanted, axis=0)
    follows = is_revolute & (np.abs(both) > _ALIKE * sizes[0] * sizes[1])
    factor = np.copysign(sizes[1], both) / np.where(follows, sizes[0], np.nan)
    ratio = np.abs(factor)
    for j in np.flatnonzero(_is_near(ratio, np.degrees(1.0)) | _is_near(ratio, np.radians(1.0))):
        yield DataError(
            f"{log.name}: the motion of qref_{log.joints[j]} is {factor[j]:.3g} times the "
            f"motion of q_{log.joints[j]}: one looks like degrees, the other like radians. "
            f"Convert one in the recording. {_how_to_state('angle', 'deg', 'rad', both=True)}",
            code="angle_unit",
        )


def _mixed_velocities(log: Log, factor: Array) -> Iterator[DataError]:
    """Yield joints with only one of position and velocity in degrees."""
    for wrong, ratio in (("velocity", np.degrees(1.0)), ("position", np.radians(1.0))):
        for j in np.flatnonzero(_is_near(np.abs(factor), ratio)):
            yield DataError(
                f"{log.name}: dq_{log.joints[j]} is {abs(factor[j]):.3g} times d(q)/dt: the "
                f"{wrong} looks like degrees, the other like radians. Convert one of them in the "
                f"recording. {_how_to_state('angle', 'deg', 'rad', both=True)}",
                code="angle_unit",
            )


def _how_to_state(kind: str, unit: str, si: str, both: bool = False) -> str:
    """Return how to state a unit, in the job file and on the command line."""
    stated = si if both else unit
    ways = f'units {kind} = "{stated}" (job file table [units], CLI --{kind}-unit {stated})'
    if stated == si:
        return f"To read the values without conversion, set {ways}"
    return f'Set {ways}, or "{si}" if this is the unit'


def _velocity_factor(log: Log) -> Array:
    """Return f with dq = f d(q)/dt for each joint, shape (n,); NaN if they do not correlate."""
    if log.v is None or len(log.t) <= 10:
        return np.full(len(log.joints), np.nan)
    moved, integral = displacements(log, log.v)
    both, *squares = (np.sum(x * y, axis=0) for x, y in (
        (moved, integral), (moved, moved), (integral, integral)
    ))  # fmt: skip
    follows = np.abs(both) > _ALIKE * np.sqrt(squares[0] * squares[1])
    factor = np.sqrt(squares[1] / np.where(follows, squares[0], np.nan))
    return np.asarray(np.copysign(factor, both))


def displacements(log: Log, v: Array) -> tuple[Array, Array]:
    """Return displacements over short segments by positions and by speeds, (K, n), but jumps."""
    dt, step = np.diff(log.t)[:, None], np.diff(log.q, axis=0)
    median = float(np.median(dt))
    length = int(np.clip(round(_SEGMENT / median), 1, max(1, len(dt) // 4)))
    jump = _is_near(np.abs(step), 2 * np.pi) | _is_near(np.abs(step), 360.0)
    used = (dt <= LONG_STEP * median) & ~jump
    # the trapezoidal rule with its first correction: few rows per period are no other clock
    area = dt * (v[1:] + v[:-1]) / 2 - dt**2 / 12 * np.diff(np.gradient(v, log.t, axis=0), axis=0)
    totals = (np.cumsum(np.vstack([0.0 * x[:1], used * x]), axis=0) for x in (step, area))
    moved, integral = (total[length:] - total[:-length] for total in totals)
    return moved, integral


def _is_near(values: Array, wanted: float) -> Array:
    """Return which values are within the tolerance of the wanted one."""
    return np.asarray(np.abs(values / wanted - 1) < _NEAR)


def _once(check: Callable[[Log], ResultT]) -> Callable[[Log], ResultT]:
    """Keep the result of a check with each log: the doctor and the fit both use it."""
    known: WeakKeyDictionary[Log, ResultT] = WeakKeyDictionary()

    @wraps(check)
    def result(log: Log) -> ResultT:
        if log not in known:
            known[log] = check(log)
        return known[log]

    return result


def is_trustworthy(log: Log, stated: float = 0.0) -> bool:
    """Return whether velocities have a small lag, resolution, and follow from their positions."""
    return is_timely(log, stated) and not coarse_velocities(log) and not unlike_velocities(log)


def is_timely(log: Log, stated: float = 0.0) -> bool:
    """Return whether the measured velocities lag their positions by less than 20 ms."""
    return velocity_lags(log)[0] - stated < LARGEST_LAG


@_once
def velocity_lags(log: Log) -> tuple[float, Array]:
    """Return the delay of measured velocities after the slopes of positions, and by joint [s]."""
    v = _measured(log)
    step = float(np.median(np.diff(log.t)))
    q = np.unwrap(log.q, axis=0)
    parts = np.split(np.arange(len(log.t)), np.flatnonzero(np.diff(log.t) > LONG_STEP * step) + 1)
    longest = min(int(_LONGEST / step) + 1, max(map(len, parts)) // 4)
    shifts = np.arange(-longest, longest + 1)
    total = np.zeros((len(log.joints), len(shifts)))
    for part in (rows for rows in parts if len(rows) >= max(4 * longest, _FEWEST)):
        t = log.t[part]
        grid = np.arange(t[0], t[-1], step)
        for own, x, measured in zip(total, q[part].T, v[part].T, strict=True):
            slope = np.gradient(np.interp(grid, t, x), step)
            own += len(grid) * _distances(slope, np.interp(grid, t, measured), longest)

    def delay(total: Array) -> float:
        best = int(np.argmin(total))
        if not 0 < best < len(shifts) - 1:
            return 0.0
        left, middle, right = total[best - 1 : best + 2]
        curvature = left - 2 * middle + right
        fraction = 0.5 * (left - right) / curvature if curvature > 0 else 0.0
        return float((shifts[best] + fraction) * step)

    single = [delay(own) if x.any() else 0.0 for own, x in zip(total, v.T, strict=True)]
    return delay(total.sum(axis=0)) if v.any() else 0.0, np.array(single)


@_once
def coarse_velocities(log: Log) -> tuple[str, ...]:
    """Return the joints whose measured velocity is coarsely quantised, as from an encoder."""
    return tuple(
        joint
        for joint, x in zip(log.joints, _measured(log).T, strict=True)
        if 0 < np.ptp(x) < COARSE * quantum(x)
    )


@_once
def unlike_velocities(log: Log) -> dict[str, float]:
    """Joints whose measured velocity is not the derivative of their position at any lag."""
    v, dt = _measured(log), np.diff(log.t)
    moved, integral = displacements(log, v)
    length, median = len(dt) - len(moved) + 1, float(np.median(dt))
    last = min(round(_LONGEST / median), len(moved) // 2)
    shifts = [k for k in range(-last, last + 1, max(length // 2, 1)) if abs(k) < len(moved) // 2]
    unlike = {}
    for j, joint in enumerate(log.joints):
        speed = float(np.sqrt(np.mean(moved[:, j] ** 2))) / (length * median)
        if np.ptp(log.q[:, j]) < STATIC or speed < AT_REST or np.ptp(v[:, j]) == 0:
            continue
        largest = max(_correlation(moved[:, j], integral[:, j], k) for k in [0, *shifts])
        if largest < _UNLIKE:
            unlike[joint] = largest
    return unlike


def quantum(x: Array, *, repeats: bool = True) -> float:
    """Return the quantisation step of a channel, 0 if it is not quantised: x (N,)."""
    levels = np.unique(x)
    if len(levels) < 3 or (repeats and len(levels) > 0.5 * len(x)):
        return 0.0
    steps = np.diff(levels)
    steps = steps[steps > 1e-9 * np.ptp(x)]
    if len(steps) == 0:
        return 0.0
    smallest = float(np.quantile(steps, 0.1))
    counts = np.diff(levels)[:1000] / smallest
    return smallest if np.mean(np.abs(counts - np.round(counts)) < 0.02) > 0.95 else 0.0


def _measured(log: Log) -> Array:
    if log.v is None:
        raise DataError(f"{log.path or 'log'} has no measured velocity")
    return log.v


def _correlation(moved: Array, integral: Array, shift: int) -> float:
    """Return the absolute correlation of one signal with the other shifted by some rows."""
    n = len(moved)
    a = moved[max(-shift, 0) : n - max(shift, 0)]
    b = integral[max(shift, 0) : n + min(shift, 0)]  # not centred: the speed may be constant
    size = float(np.sqrt((a @ a) * (b @ b)))
    return abs(float(a @ b)) / size if size > 0 else 0.0


def _distances(slope: Array, v: Array, longest: int) -> Array:
    """Return the mean squares of v - slope delayed by -longest to longest samples."""
    n, size = len(v), 1 << (len(v) + longest).bit_length()  # of the transform, without overlap
    spectrum = np.fft.rfft(v, size) * np.fft.rfft(slope, size).conj()
    products = np.fft.irfft(spectrum, size)[np.arange(-longest, longest + 1)]
    of_v, of_slope = (np.append(0.0, np.cumsum(x**2)) for x in (v, slope))  # of the first rows
    k = np.arange(longest + 1)
    lag = of_v[n] - of_v[k] + of_slope[n - k]  # squares of the rows compared at a lag of k
    lead = of_v[n - k] + of_slope[n] - of_slope[k]
    squares = np.concatenate([lead[:0:-1], lag])
    return np.asarray((squares - 2 * products) / (n - np.abs(np.arange(-longest, longest + 1))))
