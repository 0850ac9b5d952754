"""Estimate of the delay of the torque relative to the position, from the model.

The regressor is computed from a motion with three times the bandwidth. The same filter is then
applied to torque and regressor, because a filter of only one of them looks like a delay.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from robotid.base.findings import Finding
from robotid.base.tolerances import REMAINDER
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import low_pass
from robotid.data.units import AT_REST, LARGEST_LAG
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.decisions import (
    BEYOND_NOISE,
    DIFFERS,
    EXACT,
    FEWEST,
    LEAST_SHARE,
    ROWS,
    SEGMENTS,
)
from robotid.diagnosis.logs.channels import MOVING, distance
from robotid.diagnosis.logs.probe import coupled_columns, smooth_motion
from robotid.dynamics.rows import inertial_rows
from robotid.robot.model import RobotModel

_LONGEST = 0.1  # [s] largest delay
_GRID = np.linspace(-_LONGEST, _LONGEST, 81)
_NEAR = DIFFERS * _LONGEST  # [s] half-width of the misfit's parabola around the delay
_OVERSAMPLED = 8.0  # instants per period of the filter: the regressor has a larger bandwidth
# Cut-off of the comparison over the job's, and over the rate at most, since interpolation smooths
# the noise at higher frequencies; the motion from which the regressor is computed has twice both.
_TIMES = 1.5
_OF_RATE = 0.15
_SLOW = 0.05  # [rad/s] slower: a drive may be in stiction, and its friction is unknown around
NEAR = 0.5  # [periods of the job's filter] time over which it smears stiction
_HARMONICS = 4  # of a torque that is periodic in the position, as of gears and magnets


@dataclass(frozen=True, eq=False)
class _Misfit:
    """The unexplained part of each torque at each delay of the grid."""

    # The parts are sums of squares in each block of the log, as shares of the joint's torque.

    squares: Array  # (n, blocks, delays)
    loaded: Array  # the same if friction also grows with the load
    rows: Array  # (n,), number of instants of each joint

    def delays_without(self, axis: int) -> list[float]:
        """Return the delays of the jackknife over joints (axis 0) or blocks of the log (1)."""
        delays = []
        for k in range(self.squares.shape[axis]):
            rows = np.delete(self.rows, k) if axis == 0 else self.rows
            squares = np.delete(self.squares, k, axis=axis)
            delays.append(replace(self, squares=squares, rows=rows).delay())
        return delays

    @property
    def by_load(self) -> float:
        """The share of the unexplained torque that friction by load explains without a delay."""
        now, then = (_at(0.0, x).sum(axis=1) for x in (self.squares, self.loaded))
        return float((1.0 - (then + EXACT) / (now + EXACT)).mean())

    def delay(self) -> float:
        """Return the delay with the smallest misfit [s], NaN if it is at an end of the grid."""
        share = self.squares.sum(axis=1) + EXACT
        # relative to the smallest of each joint: a joint that is explained well has more weight
        cost = self.rows @ (share / share.min(axis=1, keepdims=True)) / self.rows.sum()
        best = float(_GRID[np.argmin(cost)])
        if abs(best) + _NEAR > _LONGEST:
            return float("nan")
        near = np.abs(_GRID - best) <= _NEAR
        square, slope, _ = np.polyfit(_GRID[near] - best, cost[near], 2)
        return best - float(slope / (2 * square)) if square > 0 else float("nan")

    def error(self) -> float:
        """Return the standard error of the delay [s]: jackknife over joints and over blocks."""
        jackknife = (self.delays_without(axis) for axis in (0, 1))
        return float(np.sqrt(sum((len(x) - 1) * float(np.var(x)) for x in jackknife)))

    def gain(self) -> float:
        """Return the share of the unexplained torque that the delay of other blocks explains."""
        blocks = zip(self.delays_without(1), np.swapaxes(self.squares, 0, 1), strict=True)
        then = np.sum([_at(delay, block) for delay, block in blocks], axis=0)
        now = _at(0.0, self.squares).sum(axis=1)
        return float(1.0 - np.mean((then + EXACT) / (now + EXACT)))


def _at(delay: float, values: Array) -> Array:
    """Return values on the grid, shape (..., delays), at a delay of it, linear in between."""
    k = min(max(int(np.searchsorted(_GRID, delay)), 1), len(_GRID) - 1)
    share = (delay - _GRID[k - 1]) / (_GRID[k] - _GRID[k - 1])
    return np.asarray(values[..., k - 1] + share * (values[..., k] - values[..., k - 1]))


def check_torque_delay(
    model: RobotModel, log: Log, signals: SignalSettings, name: str
) -> Iterator[Finding]:
    """Yield the delay of the torque relative to the position: "torque_delay", at most once."""
    # It minimises the unexplained torque. The model has friction antisymmetric in the speed and a
    # torque periodic in the position; instants near slow ones are not used. The standard error is
    # the jackknife's over joints and blocks of the log. The delay of the other blocks must explain
    # each block better.
    step = float(np.median(np.diff(log.t)))
    rate = min(1 / step, signals.rate or np.inf)
    # the comparison is filtered even if the job has no filter: see _BAND
    cutoff = min(_TIMES * (signals.cutoff or np.inf), _OF_RATE * rate)
    wide = replace(signals, cutoff=signals.cutoff and 2 * cutoff)
    motion = smooth_motion(model, log, wide)
    misfit = _misfit(model, motion, replace(signals, cutoff=cutoff), 1 / cutoff)
    if misfit is None:
        return
    delay, error, gain = misfit.delay(), misfit.error(), misfit.gain()
    if not np.isfinite([delay, error, gain]).all():
        return
    # friction, and a torque that is held between rows, look like a delay of a tenth of these
    error = float(np.hypot(error, DIFFERS * max(_NEAR, step)))
    least = LEAST_SHARE if abs(delay) > 2 * LARGEST_LAG else 0.0  # other errors look like one
    todo = "none"
    if abs(delay) > BEYOND_NOISE * error and gain > least:
        todo = "of_load" if gain < misfit.by_load else "clear" if gain > LEAST_SHARE else "filter"
    yield finding(
        "torque_delay", name, severity="note" if todo in ("none", "of_load") else "warning",
        todo=todo, sense=delay > 0, delay=delay, std_error=error, gain=gain,
        total=delay + signals.torque_delay,
    )  # fmt: skip


def _misfit(
    model: RobotModel, motion: Trajectory, signals: SignalSettings, period: float
) -> _Misfit | None:
    """Return the misfit of the joints that move enough, None if they are less than half of all."""
    step = float(np.median(np.diff(motion.t)))
    every = max(1, int(period / (step * _OVERSAMPLED)))
    parts = [
        _window(model, motion, part, step, every, signals, period)
        for part in _segments(model, motion, every)
    ]
    if not parts:
        return None
    inertial, *others = map(np.concatenate, zip(*parts, strict=True))
    ends = np.cumsum(model.support[:, : model.layout.n_inertial].sum(axis=1))[:-1]
    squares = [
        _squares(columns, *(x[:, j] for x in others))
        for j, columns in enumerate(np.split(inertial, ends, axis=1))
    ]
    used = [one for one in squares if one is not None]
    if len(used) < max(2.0, len(squares) / 2):
        return None
    plain, loaded, rows = zip(*used, strict=True)
    return _Misfit(np.array(plain), np.array(loaded), np.array(rows, dtype=float))


def _segments(model: RobotModel, motion: Trajectory, every: int) -> list[Array]:
    """Return contiguous rows, of one segment each, spread over the motion."""
    speed = np.abs(motion.v) / model.layout.drive_speeds[: len(model.joints)]
    moving = np.flatnonzero((speed > AT_REST).any(axis=1))
    if len(moving) == 0:
        return []
    first, stop = int(moving[0]), int(moving[-1]) + 1
    windows = SEGMENTS // 2
    length = ROWS * every // windows
    if stop - first > windows * length:
        starts = np.linspace(first, stop - length, windows).astype(int)
        chosen = [np.arange(start, start + length) for start in starts]
    else:
        chosen = [np.arange(first, stop)]
    cuts = [np.flatnonzero(np.diff(motion.segment[rows])) + 1 for rows in chosen]
    return [part for rows, at in zip(chosen, cuts, strict=True) for part in np.split(rows, at)]


def _window(
    model: RobotModel, motion: Trajectory, rows: Array, step: float, every: int,
    signals: SignalSettings, period: float,
) -> tuple[Array, ...]:  # fmt: skip
    """Return the filtered columns at every n-th of contiguous rows, without the ends."""
    speeds = motion.v / model.layout.drive_speeds[: len(model.joints)]  # 1 as 1 rad/s
    t, q, v, coarse = motion.t[rows], motion.q[rows], speeds[rows], rows[::every]
    edge = max(_LONGEST, _TIMES * period)  # the job's filter has settled
    inner = (motion.t[coarse] >= t[0] + edge) & (motion.t[coarse] <= t[-1] - edge)
    # friction as an antisymmetric function of the speed and torques periodic in the position, so
    # that they do not look like a delay; filtered before decimation, because friction jumps
    top = np.maximum(np.abs(speeds).max(axis=0), AT_REST)
    signs = [np.tanh(v / speed) for speed in (AT_REST, 0.1 * top, 0.3 * top)]
    waves = [wave(k * q) for k in range(1, 1 + _HARMONICS) for wave in (np.cos, np.sin)]
    own = np.stack([motion.a[rows], v, *signs, v * np.abs(v), *waves], axis=2)
    own = low_pass(own, 1 / step, signals)[::every][inner]
    state = motion.q[coarse], motion.v[coarse], motion.a[coarse]
    bodies, coupled = inertial_rows(model, *state), coupled_columns(model, *state)
    (urdf,) = bodies.torque(model.standard_parameters()[:, None])
    load = _interpolated(motion.t[coarse], np.abs(urdf), t) * signs[0]
    load = low_pass(load, 1 / step, signals)[::every][inner]
    inertial, coupled = (
        low_pass(columns, 1 / (step * every), signals)[inner]
        for columns in (bodies.values.T, coupled)
    )
    at = motion.t[coarse[inner]]
    is_reversal = np.diff(np.sign(v), axis=0, append=np.sign(v[-1:])) != 0
    slow = is_reversal | (np.abs(v) < _SLOW)
    steady = [distance(at, t[slow[:, j]]) > NEAR * _TIMES * period for j in range(v.shape[1])]
    tau = low_pass(motion.tau[rows], 1 / step, signals)
    delayed = np.moveaxis(_interpolated(t, tau, at + _GRID[:, None]), 0, 2)  # (N, n, delays)
    drive = np.concatenate([own, coupled], axis=2)  # (N, n, k)
    return inertial, drive, np.column_stack(steady), delayed, load


def _interpolated(t: Array, values: Array, times: Array) -> Array:
    """Return values, shape (N, n), at times of any shape, shape (..., n)."""
    if len(t) < 2:
        return np.empty((*times.shape, values.shape[1]))
    from scipy.interpolate import CubicSpline  # takes long to import

    return np.asarray(CubicSpline(t, values)(times))


def _squares(
    inertial: Array, drive: Array, steady: Array, delayed: Array, load: Array
) -> tuple[Array, Array, int] | None:
    """Return the unexplained part of a joint's torque, and its instants."""
    # Shapes (blocks, delays), in the second friction grows with the load; None if it hardly moves.
    used = int(np.count_nonzero(steady))
    if used < max(SEGMENTS * FEWEST, MOVING * len(steady)):
        return None
    inertial, drive, load = inertial[steady], drive[steady], load[steady]
    tau = np.ascontiguousarray(delayed[steady].T)
    tau -= tau.mean(axis=1, keepdims=True)  # (delays, N)
    size = np.sum(tau**2, axis=1)
    if size.min() <= 0:
        return None
    Q = _orthonormal(np.hstack([inertial, drive, np.ones((used, 1))]))
    tau -= (tau @ Q) @ Q.T
    blocks = np.array_split(tau, SEGMENTS, axis=1)
    plain = np.array([np.sum(b**2, axis=1) for b in blocks]) / size
    rest = load - Q @ (Q.T @ load)
    if rest @ rest > EXACT**2 * load @ load:
        tau -= np.outer(tau @ rest, rest / (rest @ rest))  # of the blocks, too
    return plain, np.array([np.sum(b**2, axis=1) for b in blocks]) / size, used


def _orthonormal(X: Array) -> Array:
    """Return an orthonormal basis of columns, (N, k), without those that are dependent."""
    length = np.linalg.norm(X, axis=0)
    is_excited = length > REMAINDER * length.max()  # other columns are 0 except for rounding
    X = X[:, is_excited] / length[is_excited]
    squares, V = np.linalg.eigh(X.T @ X)
    independent = squares > EXACT**2 * squares[-1]
    return np.asarray(X @ (V[:, independent] / np.sqrt(squares[independent])))
