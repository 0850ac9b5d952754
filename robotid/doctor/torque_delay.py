"""How late the torque is against the position, and whether moving it back would help.

The torque went through the filter, the regressor did not: on both sides of the fit it does here,
or else what the filter takes from the torque alone looks like a delay.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.findings import Finding, log_finding
from robotid.logs.data import Trajectory
from robotid.logs.settings import SignalSettings
from robotid.logs.smoothing import low_pass
from robotid.regressor.torque import joint_torque_regressor
from robotid.robot.model import RobotModel

__all__ = ["check_torque_delay"]

_LONGEST = 0.1  # [s] delays are sought up to this
_GRID = np.linspace(-_LONGEST, _LONGEST, 81)
_NEAR = 0.01  # [s] about the delay, where the misfit is a parabola
_FINEST = 0.001  # [s] an estimate is not better than this
_FEW = 100  # rows from which a joint counts for the delay
_MOVING = 0.1  # share of the instants in which it must move
_STILL = 0.02  # [rad/s or m/s] slower than this the sign of a friction torque is not known
_ROWS = 2000  # instants that are looked at
_WINDOWS = 8  # stretches they are in, where the log has more of them
_BLOCKS = 8  # parts of the log that are left out in turn
_OVERSAMPLED = 8.0  # instants per period of the cut-off: products of motions are faster than they
_UNFILTERED = 10.0  # [Hz] bandwidth that is taken for a motion without a filter
_SETTLED = 1.5  # [periods of the cut-off] from an end the filter of a stretch has settled
_EXACT = 1e-5  # share of a torque that is taken for noise in a log without any
_LATE = 0.01  # [s] a shorter delay of the torque is within the errors of friction models
_HELD = 0.75  # [samples] ... or comes from a torque that is held from row to row
_HELPS = 0.15  # share of the unexplained torque that a delay must take away to be believed


@dataclass(frozen=True, eq=False)
class _Misfit:
    """What is unexplained of each torque at each delay of the grid.

    Attributes:
        squares: Sums of squares in each block of the log, as shares of the joint's torque, shape
            (n, blocks, delays).
    """

    squares: Array

    def delays_without(self, axis: int) -> list[float]:
        """Return the delays if one joint (axis 0) or block of the log (1) is left out in turn."""
        left_out = range(self.squares.shape[axis])
        return [_Misfit(np.delete(self.squares, k, axis=axis)).delay() for k in left_out]

    def delay(self) -> float:
        """Return the delay that explains most [s], NaN if it is at an end of the grid."""
        share = self.squares.sum(axis=1) + _EXACT
        # relative to the best of each joint: one that is explained well says more
        cost = (share / share.min(axis=1, keepdims=True)).mean(axis=0)
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
        return max(float(np.sqrt(variance)), _FINEST)

    def gain(self) -> float:
        """Return the share of what is unexplained that the delay of the other blocks explains."""
        now, then = np.zeros((2, len(self.squares)))
        delays = self.delays_without(1)
        for j, squares in enumerate(self.squares):
            for delay, block in zip(delays, squares, strict=True):
                now[j] += np.interp(0.0, _GRID, block)
                then[j] += np.interp(delay, _GRID, block)
        return float(1.0 - np.mean((then + _EXACT) / (now + _EXACT)))


@dataclass(frozen=True, eq=False)
class _Window:
    """Contiguous rows of a motion, and the filtered columns that may explain their torques.

    Attributes:
        rows: The N instants, as rows of the motion, shape (N,), int.
        inertial: Of each body, shape (N, n, p).
        drive: Of each joint's inertia and frictions, and of coupled drives, shape (N, n, k).
        steady: Whether a joint is far from a change of its direction, shape (N, n), bool.
    """

    rows: Array
    inertial: Array
    drive: Array
    steady: Array


def check_torque_delay(
    model: RobotModel, motion: Trajectory, signals: SignalSettings, name: str
) -> Iterator[Finding]:
    """Yield at most one "torque_delay", how late the torque is against the position.

    The delay minimises what the regressor leaves of the delayed torque, rows near a change of
    direction apart; its uncertainty is the jackknife's over the joints and over stretches of the
    log. It is worth a warning if the delay of the other stretches explains each stretch better.

    Args:
        model: The robot, with a fixed base.
        motion: The smooth motion.
        signals: How it was smoothed.
        name: What the log is called.
    """
    misfit = _misfit(model, motion, signals)
    if misfit is None:
        return
    delay, error = misfit.delay(), misfit.error()
    if not np.isfinite([delay, error]).all():
        return
    gain = misfit.gain()
    step = float(np.median(np.diff(motion.t)))
    late = abs(delay) > max(_LATE, _HELD * step, 3 * error) and gain > _HELPS
    meaning = (
        f"; moved back, {100 * gain:.0f} % of what no physics explains of it goes: correct the "
        "logger's clock, or"
        if late
        else ". Friction that the model lacks can look like this; if the drive filters its torque,"
    )
    message = (
        f"the torque is {1e3 * delay:.1f} +- {1e3 * error:.1f} ms late against the position"
        f"{meaning} state [signals] torque_delay = {delay:.4f}"
    )
    evidence = {"delay": delay, "std_error": error, "gain": gain}
    yield log_finding(name, "torque_delay", "warning" if late else "note", message, **evidence)


def _misfit(model: RobotModel, motion: Trajectory, signals: SignalSettings) -> _Misfit | None:
    """Return the misfit of the joints that move enough, None if they are less than half of all."""
    step = float(np.median(np.diff(motion.t)))
    every = max(1, int(1 / (step * _OVERSAMPLED * signals.cutoff))) if signals.cutoff else 1
    rows = _stretches(motion, every)
    windows = [_window(model, motion, part, step, every, signals) for part in rows]
    joints = range(len(model.joints))
    found = [_squares(model, motion, windows, j) for j in joints] if windows else []
    told = [squares for squares in found if squares is not None]
    return _Misfit(np.array(told)) if len(told) >= max(2.0, len(joints) / 2) else None


def _stretches(motion: Trajectory, every: int) -> list[Array]:
    """Return contiguous rows, of one segment each, spread over the motion."""
    moving = np.flatnonzero((np.abs(motion.v) > _STILL).any(axis=1))
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


def _window(
    model: RobotModel, motion: Trajectory, rows: Array, step: float, every: int,
    signals: SignalSettings,
) -> _Window:  # fmt: skip
    """Return the filtered columns at every so many of contiguous rows, but for their ends."""
    t, v, coarse = motion.t[rows], motion.v[rows], rows[::every]
    period = 1.0 / (signals.cutoff or _UNFILTERED)
    edge = max(_LONGEST, _SETTLED * period)
    inner = (motion.t[coarse] >= t[0] + edge) & (motion.t[coarse] <= t[-1] - edge)
    # friction of any odd curve of the speed, so that it is not taken for a delay; filtered before
    # rows are left out, for it jumps
    top = np.maximum(np.abs(motion.v).max(axis=0), _STILL)
    signs = [np.tanh(v / speed) for speed in (_STILL, 0.1 * top, 0.3 * top)]
    own = np.stack([motion.a[rows], v, *signs, v * np.abs(v)], axis=2)
    own = low_pass(own, 1 / step, signals)[::every][inner]
    state = motion.q[coarse], motion.v[coarse], motion.a[coarse]
    W = joint_torque_regressor(model, *state).reshape(len(coarse), len(model.joints), -1)
    W = low_pass(W, 1 / (step * every), signals)[inner]
    size = model.layout.n_inertial
    coupled = W[:, :, size + len(model.joints) * len(model.layout.terms) :]
    at = motion.t[coarse[inner]]
    turned = np.diff(np.sign(v), axis=0) != 0
    away = [
        _distance(at, (0.5 * (t[1:] + t[:-1]))[turned[:, j]]) > 0.5 * period
        for j in range(v.shape[1])
    ]
    steady = np.column_stack(away) & (np.abs(motion.v[coarse[inner]]) > _STILL)
    return _Window(coarse[inner], W[:, :, :size], np.concatenate([own, coupled], axis=2), steady)


def _distance(at: Array, turns: Array) -> Array:
    """Return how far each time is from the nearest turn, shape as at [s]."""
    bounds = np.concatenate([[-np.inf], turns, [np.inf]])
    after = np.searchsorted(bounds, at)
    distance: Array = np.minimum(at - bounds[after - 1], bounds[after] - at)
    return distance


def _squares(
    model: RobotModel, motion: Trajectory, windows: Sequence[_Window], j: int
) -> Array | None:
    """Return what is unexplained of joint j's torque, shape (blocks, delays), None of few rows."""
    steady = np.concatenate([window.steady[:, j] for window in windows])
    if steady.sum() < max(_FEW, _MOVING * len(steady)):
        return None
    rows = np.concatenate([window.rows for window in windows])[steady]
    inertial, drive = (
        np.concatenate(parts)[steady]
        for parts in zip(*((w.inertial[:, j], w.drive[:, j]) for w in windows), strict=True)
    )
    carried = model.support()[j, : model.layout.n_inertial]
    X = np.hstack([inertial[:, carried], drive, np.ones((len(rows), 1))])
    t, tau = motion.t, motion.tau[:, j]
    late = np.array([np.interp(t[rows] + delay, t, tau) for delay in _GRID])  # (delays, N)
    late = late - late.mean(axis=1, keepdims=True)
    size = np.einsum("dk,dk->d", late, late)
    if size.min() <= 0:
        return None
    length = np.linalg.norm(X, axis=0)
    U, s, _ = np.linalg.svd(X / np.where(length > 0, length, 1.0), full_matrices=False)
    Q = U[:, s > 1e-5 * s[0]]
    rest = (late - (late @ Q) @ Q.T) ** 2 / size[:, None]
    return np.array([block.sum(axis=1) for block in np.array_split(rest, _BLOCKS, axis=1)])
