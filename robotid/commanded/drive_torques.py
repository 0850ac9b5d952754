"""What drives give along a roll-out, and what changes it: the output of closed-loop input error."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.simulation.loops import Column, Loops, RollOut

__all__ = ["DriveTorques", "drive_torques", "find_behind"]

_AROUND = (0, -1, 1)  # rows about the delay, that a torque's command may be behind it
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
        self, joints: Array, columns: Sequence[Column], motion: Array, kinds: Mapping[str, int]
    ) -> Array:
        """Return the derivatives of what some drives give, shape (N, k, c).

        The command of a row is held, so a delay changes the motion alone.

        Args:
            joints: Which, shape (k,).
            columns: What they are by, c columns as of ``LoopedRobot.roll_out``.
            motion: Derivatives of their positions and then speeds, shape (N, 2k, c).
            kinds: Numbers of the columns' kinds.
        """
        k, loops = len(joints), self.loops
        change: Array = (
            -loops.kp[joints, None] * motion[:, :k] - loops.kd[joints, None] * motion[:, k:]
        )
        own = {kinds["kp"]: self.reach, kinds["kd"]: self.rate}
        at_limit = (np.abs(self.asked) >= loops.limit)[:, joints]
        for c, (kind, joint, _) in enumerate(columns):
            if kind in own:
                change[:, joints == joint, c] += own[kind][:, [joint]]
        change[at_limit] = 0.0
        for c, (kind, joint, _) in enumerate(columns):
            if kind == kinds["limit"]:
                side = np.sign(self.asked[:, [joint]])
                change[:, joints == joint, c] += at_limit[:, joints == joint] * side
        return change


def drive_torques(out: RollOut, loops: Loops, behind: Array) -> DriveTorques:
    """Return what the drives give along a roll-out.

    Args:
        out: The roll-out.
        loops: The loops that it was rolled out with.
        behind: How many rows the command that a torque follows is behind it, shape (n,), int.
    """
    log, rows = out.window.log, np.arange(out.window.first, out.window.stop)
    sent = np.maximum(rows[:, None] - behind, 0)  # the first one was held before
    q_ref, v_ref, tau_ref = (
        np.zeros(out.q.shape) if x is None else np.take_along_axis(x, sent, axis=0)
        for x in (log.q_ref, log.v_ref, log.tau_ref)
    )
    reach, rate = q_ref - out.q, v_ref - out.v
    return DriveTorques(loops.kp * reach + loops.kd * rate + tau_ref, reach, rate, loops)


def find_behind(outs: Sequence[RollOut], loops: Loops, is_open: Array) -> Array:
    """Return how many rows the command that each torque follows is behind it, shape (n,), int.

    A held command jumps from row to row, and with it the torque of a stiff loop; which of the rows
    about the delay it is, the torques themselves tell.

    Args:
        outs: Roll-outs of windows with measured torques.
        loops: The loops that they were rolled out with.
        is_open: Whether gains of position and of speed are yet to be found, shape (2, n), bool.
    """
    n, tau = len(loops.kp), np.concatenate([o.window.log.tau[o.window.counted] for o in outs])
    dt = float(np.median(np.diff(outs[0].window.log.t)))
    delayed = np.ceil(loops.delay / dt - 1e-6).astype(int)
    cost, tries = np.full((len(_AROUND), n), np.inf), [np.maximum(delayed + k, 0) for k in _AROUND]
    for k, behind in enumerate(tries):
        found = [drive_torques(out, loops, behind) for out in outs]
        asked, reach, rate = (
            np.concatenate([getattr(own, name) for own in found])
            for name in ("asked", "reach", "rate")
        )
        for j in range(n):
            free = np.abs(tau[:, j]) < _FREE * loops.limit[j]
            A = np.column_stack([reach[free, j], rate[free, j]])[:, is_open[:, j]]
            b = tau[free, j] - asked[free, j]
            if A.shape[1]:
                b = b - A @ np.linalg.lstsq(A, b, rcond=None)[0]
            cost[k, j] = b @ b
    best: Array = np.array(tries)[np.argmin(cost, axis=0), np.arange(n)]
    return best
