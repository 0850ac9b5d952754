"""What drives give along a motion, what changes it, and the gains that logged torques tell."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid._typing import Array
from robotid.logs.filters import local_polynomial
from robotid.simulation.loops import Column, Loops, RollOut, Window

__all__ = ["DriveTorques", "drive_torques", "find_gains", "measured_motion"]

_AROUND = (0, -1, 1)  # rows about the delay, that a torque's command may be behind it
_LATEST = 0.1  # [s] that a command may be behind the torque
_CLEAR = 9.0  # variances of a row, by which a delay between two rows must be better
_NEAR = 0.15  # of a row: nearer to a whole one it is that
_SMOOTH = 0.02  # [s] about each sample, whose slope is its speed
_FREE = 0.95  # of the largest torque, below which a drive is not at its limit


@dataclass(frozen=True, eq=False)
class DriveTorques:
    """Torques of drives at the samples of a roll-out that count; arrays of shape (N, n).

    Attributes:
        asked: kp reach + kd rate + tau_ref [N m or N].
        reach: q_ref - q [rad or m].
        rate: v_ref - v [rad/s or m/s].
        loops: The loops; no drive gives more than its limit.
    """

    asked: Array
    reach: Array
    rate: Array
    loops: Loops

    @property
    def given(self) -> Array:
        """The torque that is given [N m or N]."""
        limited: Array = np.clip(self.asked, -self.loops.limit, self.loops.limit)
        return limited

    def slopes(
        self,
        joints: Array,
        columns: Sequence[tuple[int, Column]],
        motion: Array,
        kinds: Mapping[str, int],
    ) -> Array:
        """Return the derivatives of what some drives give, shape (N, k, c).

        The command of a row is held, so a delay changes the motion alone.

        Args:
            joints: Which, shape (k,).
            columns: What they are by: columns as of ``ClosedLoopRobot.roll_out``, each with the
                place, of c, of its sensitivity.
            motion: Derivatives of their positions and then speeds, shape (N, 2k, c).
            kinds: Numbers of the columns' kinds.
        """
        k, loops = len(joints), self.loops
        change: Array = (
            -loops.kp[joints, None] * motion[:, :k] - loops.kd[joints, None] * motion[:, k:]
        )
        own = {kinds["kp"]: self.reach, kinds["kd"]: self.rate}
        at_limit = (np.abs(self.asked) >= loops.limit)[:, joints]
        for c, (kind, joint, _) in columns:
            if kind in own:
                change[:, joints == joint, c] += own[kind][:, [joint]]
        change[at_limit] = 0.0
        for c, (kind, joint, _) in columns:
            if kind == kinds["limit"]:
                side = np.sign(self.asked[:, [joint]])
                change[:, joints == joint, c] += at_limit[:, joints == joint] * side
        return change


def drive_torques(out: RollOut, loops: Loops, behind: Array) -> DriveTorques:
    """Return what the drives give along a roll-out.

    Args:
        out: The roll-out.
        loops: The loops that it was simulated with.
        behind: How many rows the command that a torque follows is behind it, shape (n,); between
            two rows it is their mean, by how near they are.
    """
    log, rows = out.window.log, np.arange(out.window.first, out.window.stop)
    sent = rows[:, None] - np.ceil(behind).astype(int)  # the first one was held before
    later = np.ceil(behind) - behind
    q_ref, v_ref, tau_ref = (
        np.zeros(out.q.shape)
        if x is None
        else sum(
            share * np.take_along_axis(x, np.clip(row, 0, len(x) - 1), axis=0)
            for share, row in ((1.0 - later, sent), (later, sent + 1))
        )
        for x in (log.q_ref, log.v_ref, log.tau_ref)
    )
    reach, rate = q_ref - out.q, v_ref - out.v
    return DriveTorques(loops.kp * reach + loops.kd * rate + tau_ref, reach, rate, loops)


def measured_motion(window: Window) -> RollOut:
    """Return a window's measured motion as if it had come out of a roll-out.

    Args:
        window: The window.
    """
    q, t = (x[window.counted] for x in (window.log.q, window.log.t))
    dt = float(np.median(np.diff(t)))
    wide = min(2 * max(2, round(_SMOOTH / dt)) + 1, len(t) - 1 + len(t) % 2)
    v = local_polynomial(q, wide, min(2, wide - 1), derivative=1, step=dt)
    return RollOut(window, q, v)


def find_gains(
    outs: Sequence[RollOut], loops: Loops, is_open: Array, *, knows_delay: bool, is_whole: bool
) -> tuple[Array, Loops]:
    """Return how far measured torques are behind, and the loops with the gains that they tell.

    A held command jumps from row to row, and with it the torque of a stiff loop; which of the rows
    about the delay it is, the torques themselves tell; or that they lie between two rows, as means
    over a row do, where they tell it clearly. Gains that would be negative stay.

    Args:
        outs: Motion in windows with measured torques.
        loops: The loops, as far as they are known.
        is_open: Whether gains of position and of speed are yet to be found, shape (2, n), bool.
        knows_delay: Whether the loops' delay is known but for a row.
        is_whole: Whether torques follow whole rows, until motion and gains are better known.

    Returns:
        How many rows the command that each torque follows is behind it, shape (n,); and the loops.
    """
    dt = float(np.median(np.diff(outs[0].window.log.t)))
    delayed = np.ceil(loops.delay / dt - 1e-6)
    around = _AROUND if knows_delay else range(-int(delayed.min()), 1 + round(_LATEST / dt))
    tries = np.array([np.maximum(delayed + rows, 0.0) for rows in around])
    costs = np.array([_told(outs, loops, is_open, behind)[0] for behind in tries])
    behind, least = tries[np.argmin(costs, axis=0), np.arange(len(delayed))], costs.min(axis=0)
    rows, whole = sum(len(out.q) for out in outs), behind.copy()
    for side in () if is_whole else (-1.0, 1.0):  # towards the next row they are a parabola
        half, next_ = (
            _told(outs, loops, is_open, np.maximum(whole + side * x, 0.0))[0] for x in (0.5, 1.0)
        )
        bend, slope = 2 * (least + next_ - 2 * half), 4 * half - 3 * least - next_
        share = np.clip(-slope / np.maximum(2 * bend, 1e-300), 0.0, 1.0)
        gain = -(slope + bend * share) * share
        is_between = (gain > _CLEAR * least / rows) & (share > _NEAR)
        behind = np.where(is_between, whole + side * share, behind)
    gains = _told(outs, loops, is_open, behind)[1]
    kp, kd = np.where(gains > 0, gains, [loops.kp, loops.kd])
    return behind, replace(loops, kp=kp, kd=kd)


def _told(
    outs: Sequence[RollOut], loops: Loops, is_open: Array, behind: Array
) -> tuple[Array, Array]:
    """Return the squares that torques leave, (n,), and the gains that leave least, (2, n)."""
    found = [drive_torques(out, loops, behind) for out in outs]
    asked, reach, rate = (
        np.concatenate([getattr(own, name) for own in found]) for name in ("asked", "reach", "rate")
    )
    tau = np.concatenate([out.window.log.tau[out.window.counted] for out in outs])
    squares, gains = np.zeros(len(behind)), np.stack([loops.kp, loops.kd])
    for j, is_own in enumerate(is_open.T):
        free = np.abs(tau[:, j]) < _FREE * loops.limit[j]
        A, b = np.column_stack([reach[free, j], rate[free, j]])[:, is_own], (tau - asked)[free, j]
        more = np.linalg.lstsq(A, b, rcond=None)[0] if is_own.any() else np.zeros(0)
        gains[is_own, j] += more
        squares[j] = np.sum((b - A @ more) ** 2)
    return squares, gains
