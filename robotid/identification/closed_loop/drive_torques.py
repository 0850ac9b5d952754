"""Torques of drives along a motion, their derivatives, and gains fitted to logged torques."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid.base.typing import Array
from robotid.data.signal_filters import local_polynomial
from robotid.dynamics.simulation.loops import Column, Loops, RollOut, Window

_AROUND = (0, -1, 1)  # lags that are tried about the known delay [samples]
_LATEST = 0.1  # largest lag that is tried [s]
_CLEAR = 9.0  # improvement that a fractional lag needs [variances of one row]
_NEAR = 0.15  # distance from a whole lag below which the lag is whole [samples]
_SMOOTH = 0.02  # half-width of the differentiating filter [s]
_FREE = 0.95  # torque relative to the limit, below which the drive is not saturated


@dataclass(frozen=True, eq=False)
class DriveTorques:
    """Torques of drives at the counted samples of a roll-out; arrays of shape (N, n).

    Attributes:
        unlimited: kp position_error + kd speed_error + tau_ref [N m or N].
        position_error: q_ref - q [rad or m].
        speed_error: v_ref - v [rad/s or m/s].
        loops: The loops, with the torque limits.
    """

    unlimited: Array
    position_error: Array
    speed_error: Array
    loops: Loops

    @property
    def limited(self) -> Array:
        """The torque within the limits of the drives [N m or N]."""
        limited: Array = np.clip(self.unlimited, -self.loops.limit, self.loops.limit)
        return limited

    def slopes(
        self,
        joints: Array,
        columns: Sequence[tuple[int, Column]],
        motion: Array,
        kinds: Mapping[str, int],
    ) -> Array:
        """Return the derivatives of the torques of some drives, shape (N, k, c).

        The command is constant over a row, so a delay changes only the motion.

        joints (k,), motion (N, 2k, c).
        """
        k, loops = len(joints), self.loops
        change: Array = (
            -loops.kp[joints, None] * motion[:, :k] - loops.kd[joints, None] * motion[:, k:]
        )
        own = {kinds["kp"]: self.position_error, kinds["kd"]: self.speed_error}
        at_limit = (np.abs(self.unlimited) >= loops.limit)[:, joints]
        for c, (kind, joint, _) in columns:
            if kind in own:
                change[:, joints == joint, c] += own[kind][:, [joint]]
        change[at_limit] = 0.0
        for c, (kind, joint, _) in columns:
            if kind == kinds["limit"]:
                side = np.sign(self.unlimited[:, [joint]])
                change[:, joints == joint, c] += at_limit[:, joints == joint] * side
        return change


def drive_torques(out: RollOut, loops: Loops, lag: Array) -> DriveTorques:
    """Return the torques of the drives along a roll-out: lag (n,) [samples]."""
    log, rows = out.window.log, np.arange(out.window.first, out.window.stop)
    sent = rows[:, None] - np.ceil(lag).astype(int)  # before the log: its first command
    later = np.ceil(lag) - lag
    q_ref, v_ref, tau_ref = (
        np.zeros(out.q.shape)
        if x is None
        else sum(
            share * np.take_along_axis(x, np.clip(row, 0, len(x) - 1), axis=0)
            for share, row in ((1.0 - later, sent), (later, sent + 1))
        )
        for x in (log.q_ref, log.v_ref, log.tau_ref)
    )
    error, speed_error = q_ref - out.q, v_ref - out.v
    unlimited = loops.kp * error + loops.kd * speed_error + tau_ref
    return DriveTorques(unlimited, error, speed_error, loops)


def measured_motion(window: Window) -> RollOut:
    """Return a window's measured motion in the form of a roll-out."""
    q, t = (x[window.counted] for x in (window.log.q, window.log.t))
    dt = float(np.median(np.diff(t)))
    wide = min(2 * max(2, round(_SMOOTH / dt)) + 1, len(t) - 1 + len(t) % 2)
    v = local_polynomial(q, wide, min(2, wide - 1), derivative=1, step=dt)
    return RollOut(window, q, v)


def find_gains(
    outs: Sequence[RollOut], loops: Loops, is_free: Array, *, knows_delay: bool, is_whole: bool
) -> tuple[Array, Loops]:
    """Return the lag of measured torques, and the loops with gains fitted to these torques.

    A command that is constant over a row jumps between rows, and with it the torque of a stiff
    loop. The lag of least squared error is taken; a fractional one, as of torques averaged over a
    row, only where the improvement is significant. Gains whose estimate is negative do not change.

    is_free (2, n) -> (n,) [samples].
    """
    dt = float(np.median(np.diff(outs[0].window.log.t)))
    delayed = np.ceil(loops.delay / dt - 1e-6)
    around = _AROUND if knows_delay else range(-int(delayed.min()), 1 + round(_LATEST / dt))
    tries = np.array([np.maximum(delayed + rows, 0.0) for rows in around])
    costs = np.array([_fit_gains(outs, loops, is_free, lag)[0] for lag in tries])
    lag, least = tries[np.argmin(costs, axis=0), np.arange(len(delayed))], costs.min(axis=0)
    rows, whole = sum(len(out.q) for out in outs), lag.copy()
    for side in () if is_whole else (-1.0, 1.0):  # the cost is a parabola towards the next row
        half, next_ = (
            _fit_gains(outs, loops, is_free, np.maximum(whole + side * x, 0.0))[0]
            for x in (0.5, 1.0)
        )
        bend, slope = 2 * (least + next_ - 2 * half), 4 * half - 3 * least - next_
        share = np.clip(-slope / np.maximum(2 * bend, 1e-300), 0.0, 1.0)
        gain = -(slope + bend * share) * share
        is_between = (gain > _CLEAR * least / rows) & (share > _NEAR)
        lag = np.where(is_between, whole + side * share, lag)
    gains = _fit_gains(outs, loops, is_free, lag)[1]
    kp, kd = np.where(gains > 0, gains, [loops.kp, loops.kd])
    return lag, replace(loops, kp=kp, kd=kd)


def _fit_gains(
    outs: Sequence[RollOut], loops: Loops, is_free: Array, lag: Array
) -> tuple[Array, Array]:
    """Return the squared torque residuals, (n,), and the gains of least squares, (2, n)."""
    found = [drive_torques(out, loops, lag) for out in outs]
    unlimited, error, speed_error = (
        np.concatenate([getattr(own, name) for own in found])
        for name in ("unlimited", "position_error", "speed_error")
    )
    tau = np.concatenate([out.window.log.tau[out.window.counted] for out in outs])
    squares, gains = np.zeros(len(lag)), np.stack([loops.kp, loops.kd])
    for j, is_own in enumerate(is_free.T):
        free = np.abs(tau[:, j]) < _FREE * loops.limit[j]
        A = np.column_stack([error[free, j], speed_error[free, j]])[:, is_own]
        b = (tau - unlimited)[free, j]
        more = np.linalg.lstsq(A, b, rcond=None)[0] if is_own.any() else np.zeros(0)
        gains[is_own, j] += more
        squares[j] = np.sum((b - A @ more) ** 2)
    return squares, gains
