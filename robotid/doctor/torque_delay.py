"""How late the torque is against the position, as far as the model's physics tells.

The regressor is made of a motion of thrice the bandwidth, and torque and regressor then go through
the same filter: what a filter takes from one of them alone looks like a delay.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import svd

from robotid._typing import Array
from robotid.doctor.sample import coupled_columns, smooth_motion
from robotid.findings import Finding, log_finding
from robotid.logs.data import Log, Trajectory
from robotid.logs.settings import SignalSettings
from robotid.logs.smoothing import low_pass
from robotid.logs.splines import cubic_spline
from robotid.regressor.torque import carried_columns
from robotid.robot.model import RobotModel

__all__ = ["check_torque_delay"]

_LONGEST = 0.1  # [s] delays are sought up to this
_ROUNDING = 1e-10  # of the longest column
_DEPENDENT = 1e-5  # of the largest singular value: columns that hold no more are dependent
_GRID = np.linspace(-_LONGEST, _LONGEST, 81)
_NEAR = 0.01  # [s] about the delay, where the misfit is a parabola
_FINEST = 0.001  # [s] by which friction that no curve describes imitates a delay
_HELD = 0.1  # [samples] ... or a torque that is held from row to row
_SURE = 3.0  # standard errors from which a delay is reported
_DELAYED = (
    0.04  # [s] a longer delay that hardly shows is none: other errors of the model imitate it
)
_HELPS = 0.15  # share of what is unexplained that it must take away
_FEW = 100  # rows from which a joint counts for the delay
_MOVING = 0.1  # share of the instants in which it must move
_SLOW = 0.05  # [rad/s] slower than this a drive may stick
_STILL = 0.02  # [rad/s] about which the direction of friction changes
_AWAY = 0.75  # [periods of the filter] so near a slow instant friction is not known
_ROWS = 2000  # instants that are looked at
_WINDOWS = 8  # segments they are in, where the log has more of them
_BLOCKS = 8  # parts of the log that are left out in turn
_OVERSAMPLED = 8.0  # instants per period of the filter: products of motions are faster than they
# Cut-off of the comparison over the job's, and over the rate at most: noise that is interpolated
# between rows would be smoothed there.
_BAND = 1.5, 0.15
_WIDE = 3.0, 0.4  # the same of the motion that the regressor is made of
_SETTLED = 1.5  # [periods of the filter] from an end the filter of a segment has settled
_HARMONICS = 4  # of a torque that is periodic in the position, as of gears and magnets
_EXACT = 1e-5  # share of a torque that is taken for noise in a log without any
# One joint's torque is delayed by itself if that explains so much of what is unexplained, and part
# of it in each block of the log; friction and elasticity alone explain up to 0.71 of it
_EXPLAINS = 0.75


@dataclass(frozen=True, eq=False)
class _Misfit:
    """What is unexplained of each torque at each delay of the grid.

    Attributes:
        squares: Sums of squares in each block of the log, as shares of the joint's torque, shape
            (n, blocks, delays).
        rows: Number of instants of each joint, shape (n,).
        joints: Names of these joints.
    """

    squares: Array
    rows: Array
    joints: tuple[str, ...]

    def delays_without(self, axis: int) -> list[float]:
        """Return the delays if one joint (axis 0) or block of the log (1) is left out in turn."""
        parts = range(self.squares.shape[axis])
        if axis == 0:
            return [self.without({k}).delay() for k in parts]
        return [replace(self, squares=np.delete(self.squares, k, axis=1)).delay() for k in parts]

    def without(self, left_out: Collection[int]) -> "_Misfit":
        """Return the misfit of the joints that are not left out."""
        kept = [k for k in range(len(self.rows)) if k not in left_out]
        names = tuple(self.joints[k] for k in kept)
        return _Misfit(self.squares[kept], self.rows[kept], names)

    def own_delay(self, k: int) -> "_OwnDelay":
        """Return the delay of one joint's torque that explains it best by itself."""
        common = self.without({k}).delay()
        common = common if np.isfinite(common) else 0.0
        squares = self.squares[k]
        others = [np.delete(squares, b, axis=0).sum(axis=0) for b in range(len(squares))]
        delays = [float(_GRID[np.argmin(other)]) for other in others]
        pairs = list(zip(delays, squares, strict=True))
        now = np.array([np.interp(common, _GRID, block) for block in squares])
        then = np.array([np.interp(delay, _GRID, block) for delay, block in pairs])
        best = float(_GRID[np.argmin(squares.sum(axis=0))])
        error = float(np.hypot(_GRID[1] - _GRID[0], np.sqrt((len(delays) - 1) * np.var(delays))))
        explained = 1.0 - float((then.sum() + _EXACT) / (now.sum() + _EXACT))
        is_sure = abs(best - common) > _SURE * error and bool((then < now).all())
        return _OwnDelay(best, error, common, explained, is_sure and explained > _EXPLAINS)

    def delay(self) -> float:
        """Return the delay that explains most [s], NaN if it is at an end of the grid."""
        share = self.squares.sum(axis=1) + _EXACT
        # relative to the best of each joint: one that is explained well says more
        cost = self.rows @ (share / share.min(axis=1, keepdims=True)) / self.rows.sum()
        best = float(_GRID[np.argmin(cost)])
        if abs(best) + _NEAR > _LONGEST:
            return float("nan")
        near = np.abs(_GRID - best) <= _NEAR
        square, slope, _ = np.polyfit(_GRID[near] - best, cost[near], 2)
        return best - float(slope / (2 * square)) if square > 0 else float("nan")

    def error(self) -> float:
        """Return the standard error of the delay [s]: jackknife over joints and over blocks."""
        variance = 0.0
        for delays in (self.delays_without(0), self.delays_without(1)):
            variance += (len(delays) - 1) * float(np.var(delays))
        return float(np.sqrt(variance))

    def gain(self) -> float:
        """Return the share of what is unexplained that the delay of the other blocks explains."""
        now, then = np.zeros((2, len(self.squares)))
        delays = self.delays_without(1)
        for j, squares in enumerate(self.squares):
            for delay, block in zip(delays, squares, strict=True):
                now[j] += np.interp(0.0, _GRID, block)
                then[j] += np.interp(delay, _GRID, block)
        return float(1.0 - np.mean((then + _EXACT) / (now + _EXACT)))


@dataclass(frozen=True)
class _OwnDelay:
    """The delay of one joint's torque [s], its standard error, that of the other joints' torques.

    Attributes:
        explained: Share of what is unexplained that the delay of the other blocks explains.
        is_sure: Whether the joint's torque has a delay of its own.
    """

    delay: float
    error: float
    common: float
    explained: float
    is_sure: bool

    def finding(self, joint: str, log: str) -> Finding:
        """Return that the torque of a joint has a delay of its own."""
        size = 1e3 * abs(self.delay)
        is_end = abs(self.delay) >= _LONGEST - 1e-9
        value = f"{size:.0f} ms or more" if is_end else f"{size:.0f} +- {1e3 * self.error:.0f} ms"
        message = (
            f"the torque of {joint} alone is {value} {'late' if self.delay > 0 else 'early'} "
            f"against the position, the torques of the other joints by {1e3 * self.common:.0f} ms; "
            f"moved back, {100 * self.explained:.0f} % of what no physics explains of it goes: "
            f"correct the time stamps or the filter of tau_{joint} in the logger, for "
            "torque_delay shifts all joints alike"
        )
        evidence = {"delay": self.delay, "std_error": self.error, "gain": self.explained}
        return log_finding(log, "joint_torque_delay", "warning", message, joint, **evidence)


@dataclass(frozen=True, eq=False)
class _Window:
    """Filtered torques of contiguous rows of a motion, and the columns that may explain them.

    Attributes:
        inertial: Of the bodies that each joint carries, joint after joint, shape (N, columns).
        drive: Of each joint's inertia, frictions and position, and of coupled drives, (N, n, k).
        steady: Whether a joint is far from where its drive may stick, shape (N, n), bool.
        late: Torques at each delay of the grid after the instants, shape (n, delays, N).
    """

    inertial: Array
    drive: Array
    steady: Array
    late: Array


def check_torque_delay(
    model: RobotModel, log: Log, signals: SignalSettings, name: str
) -> Iterator[Finding]:
    """Yield "torque_delay", how late the torque is against the position, at most once.

    Before it, a warning "joint_torque_delay" per joint whose torque has a delay of its own, which
    then does not count for the common one.

    The delay minimises what physics, friction of any odd curve of the speed and a torque that is
    periodic in the position leave of the delayed torque, instants near slow ones apart. Its
    uncertainty is the jackknife's over the joints and over segments of the log. It is a warning
    from three standard errors on, if the delay of the other segments explains each segment better:
    one of more than 40 ms clearly so.

    Args:
        model: The robot, with a fixed base.
        log: The log, of the model's joints in its order.
        signals: How it becomes a trajectory.
        name: What the log is called.

    Raises:
        DataError: If the log is too short.
        SettingsError: If a setting does not fit the log.
    """
    step = float(np.median(np.diff(log.t)))
    rate = min(1 / step, signals.rate or np.inf)
    # the comparison is filtered even if the job is not: see _BAND
    times, most = _BAND
    cutoff = min(times * (signals.cutoff or np.inf), most * rate)
    times, most = _WIDE
    wide = replace(signals, cutoff=signals.cutoff and min(times * signals.cutoff, most * rate))
    motion = smooth_motion(model, log, wide)
    misfit = _misfit(model, motion, replace(signals, cutoff=cutoff), 1 / cutoff)
    if misfit is None:
        return
    own = {k: misfit.own_delay(k) for k in range(len(misfit.joints))}
    own = {k: one for k, one in own.items() if one.is_sure}
    if 2 * len(own) < len(misfit.joints):  # more than half are no exception
        yield from (one.finding(misfit.joints[k], name) for k, one in own.items())
        misfit = misfit.without(own)
    if len(misfit.joints) > 1:
        yield from _common(misfit, step, signals, name)


def _common(misfit: _Misfit, step: float, signals: SignalSettings, name: str) -> Iterator[Finding]:
    """Yield the delay that all torques have, if it can be found."""
    delay, error, gain = misfit.delay(), misfit.error(), misfit.gain()
    if not np.isfinite([delay, error, gain]).all():
        return
    error = float(np.hypot(error, max(_FINEST, _HELD * step)))
    is_sure = abs(delay) > _SURE * error and gain > (_HELPS if abs(delay) > _DELAYED else 0.0)
    late = f"{1e3 * abs(delay):.1f} +- {1e3 * error:.1f} ms {'late' if delay > 0 else 'early'}"
    total = delay + signals.torque_delay
    if not is_sure:
        todo = "; that may be none: nothing needs doing"
    elif gain > _HELPS:
        todo = (
            f"; moved back, {100 * gain:.0f} % of what no physics explains of it goes: correct the "
            f"logger's clock, or set torque_delay = {total:.4f} (--torque-delay {total:.4f})"
        )
    else:
        todo = (
            ". Friction that the model lacks can look like this; if the drive filters its torque, "
            f"set torque_delay = {total:.4f} (--torque-delay {total:.4f})"
        )
    message = f"the torque is {late} against the position{todo}"
    evidence = {"delay": delay, "std_error": error, "gain": gain}
    yield log_finding(name, "torque_delay", "warning" if is_sure else "note", message, **evidence)


def _misfit(
    model: RobotModel, motion: Trajectory, signals: SignalSettings, period: float
) -> _Misfit | None:
    """Return the misfit of the joints that move enough, None if they are less than half of all."""
    step = float(np.median(np.diff(motion.t)))
    every = max(1, int(period / (step * _OVERSAMPLED)))
    windows = [
        _window(model, motion, part, step, every, signals, period)
        for part in _segments(model, motion, every)
    ]
    ends = np.cumsum(model.support()[:, : model.layout.n_inertial].sum(axis=1)).tolist()
    own = [slice(*pair) for pair in pairwise([0, *ends])]
    found = [_squares(windows, j, part) for j, part in enumerate(own)] if windows else []
    used = {model.joints[j]: one for j, one in enumerate(found) if one is not None}
    if len(used) < max(2.0, len(own) / 2):
        return None
    squares, rows = zip(*used.values(), strict=True)
    return _Misfit(np.array(squares), np.array(rows, dtype=float), tuple(used))


def _segments(model: RobotModel, motion: Trajectory, every: int) -> list[Array]:
    """Return contiguous rows, of one segment each, spread over the motion."""
    moving = np.flatnonzero((np.abs(motion.v) > _STILL * _units(model)).any(axis=1))
    if len(moving) == 0:
        return []
    first, stop = int(moving[0]), int(moving[-1]) + 1
    length = _ROWS * every // _WINDOWS
    if stop - first > _WINDOWS * length:
        starts = np.linspace(first, stop - length, _WINDOWS).astype(int)
        chosen = [np.arange(start, start + length) for start in starts]
    else:
        chosen = [np.arange(first, stop)]
    cuts = [np.flatnonzero(np.diff(motion.segment[rows])) + 1 for rows in chosen]
    return [part for rows, at in zip(chosen, cuts, strict=True) for part in np.split(rows, at)]


def _units(model: RobotModel) -> Array:
    """Return the speed of each joint that counts as 1 rad/s, shape (n,)."""
    speeds: Array = model.layout.drive_speeds[: len(model.joints)]
    return speeds


def _window(
    model: RobotModel, motion: Trajectory, rows: Array, step: float, every: int,
    signals: SignalSettings, period: float,
) -> _Window:  # fmt: skip
    """Return the filtered columns at every so many of contiguous rows, but for their ends."""
    t, q, v, coarse = motion.t[rows], motion.q[rows], motion.v[rows] / _units(model), rows[::every]
    edge = max(_LONGEST, _SETTLED * period)
    inner = (motion.t[coarse] >= t[0] + edge) & (motion.t[coarse] <= t[-1] - edge)
    # friction of any odd curve of the speed, and torques periodic in the position, so that they are
    # not taken for a delay; filtered before rows are left out, for friction jumps
    top = np.maximum(np.abs(motion.v).max(axis=0) / _units(model), _STILL)
    signs = [np.tanh(v / speed) for speed in (_STILL, 0.1 * top, 0.3 * top)]
    waves = [wave(k * q) for k in range(1, 1 + _HARMONICS) for wave in (np.cos, np.sin)]
    own = np.stack([motion.a[rows], v, *signs, v * np.abs(v), *waves], axis=2)
    own = low_pass(own, 1 / step, signals)[::every][inner]
    state = motion.q[coarse], motion.v[coarse], motion.a[coarse]
    inertial, coupled = (
        low_pass(columns(model, *state), 1 / (step * every), signals)[inner]
        for columns in (carried_columns, coupled_columns)
    )
    at = motion.t[coarse[inner]]
    turns = np.diff(np.sign(v), axis=0, append=np.sign(v[-1:])) != 0
    slow = turns | (np.abs(v) < _SLOW)
    steady = [_distance(at, t[slow[:, j]]) > _AWAY * period for j in range(v.shape[1])]
    tau = low_pass(motion.tau[rows], 1 / step, signals)
    late = np.moveaxis(_interpolated(t, tau, at + _GRID[:, None]), 2, 0).copy()
    drive = np.concatenate([own, coupled], axis=2)
    return _Window(inertial, drive, np.column_stack(steady), late)


def _interpolated(t: Array, values: Array, times: Array) -> Array:
    """Return values, shape (N, n), at times of any shape, shape (..., n)."""
    if len(t) < 2:
        return np.empty((*times.shape, values.shape[1]))
    return cubic_spline(t, values, times)


def _distance(at: Array, turns: Array) -> Array:
    """Return how far each time is from the nearest turn, shape as at [s]."""
    bounds = np.concatenate([[-np.inf], turns, [np.inf]])
    after = np.searchsorted(bounds, at)
    distance: Array = np.minimum(at - bounds[after - 1], bounds[after] - at)
    return distance


def _squares(windows: Sequence[_Window], j: int, own: slice) -> tuple[Array, int] | None:
    """Return what is unexplained of joint j's torque, shape (blocks, delays), and its instants.

    Its inertial columns are ``own``. None of a joint that moves in too few.
    """
    steady = [window.steady[:, j] for window in windows]
    used = sum(map(np.count_nonzero, steady))
    if used < max(_FEW, _MOVING * sum(map(len, steady))):
        return None
    pairs = list(zip(windows, steady, strict=True))
    inertial = np.concatenate([window.inertial[at, own] for window, at in pairs])
    drive = np.concatenate([window.drive[at, j] for window, at in pairs])
    X = np.hstack([inertial, drive, np.ones((used, 1))])
    late = np.concatenate([window.late[j][:, at] for window, at in pairs], axis=1)
    late -= late.mean(axis=1, keepdims=True)  # (delays, N)
    size = np.einsum("dk,dk->d", late, late)
    if size.min() <= 0:
        return None
    length = np.linalg.norm(X, axis=0)
    seen = length > _ROUNDING * length.max()  # other columns are 0 but for rounding
    X = X[:, seen] / length[seen]
    # by QR iterations: of so many dependent columns, divide and conquer need not converge
    _, s, Vt = svd(np.linalg.qr(X, mode="r"), lapack_driver="gesvd")
    kept = s > _DEPENDENT * s[0]
    Q = X @ (Vt[kept].T / s[kept])
    late -= (late @ Q) @ Q.T
    blocks = np.array_split(late, _BLOCKS, axis=1)
    return np.array([np.einsum("dk,dk->d", b, b) / size for b in blocks]), used
