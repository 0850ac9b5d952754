"""How far an open loop runs from what was measured, and how far plainer models run."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import NotConvergedError
from robotid.logs.data import Log
from robotid.simulation.loops import LoopedRobot, Loops, cut_windows

__all__ = ["DRIFTS", "HORIZONS", "OpenLoop", "run_open_loop"]

#: How long an open loop runs before it is put back to what was measured [s].
HORIZONS = (0.1, 0.5, 2.0)
#: After this time what a logged torque drives is put back to the log: nothing else brings it back.
DRIFTS = 0.5  # [s]


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """A log beside open loops on its commands; errors are root mean squares of shape (n,).

    What the logged torque drives is put back to the log every ``DRIFTS``.

    Attributes:
        log: The log.
        q: Positions of the identified robot, started once, shape (N, n) [rad or m]; NaN of a
            sample that stands alone between gaps.
        rmse: Its error.
        command: That of the command, taken for the position; None where the torque drives it.
        urdf: That of the URDF with the stated gains, or with drives fitted to the torques; None if
            they are not known, or it runs away.
        second_order: That of the plain model, joint by joint; None if it runs away.
        horizons: Error over short horizons, by their length [s].
        spread: Size of the motion about its mean, or about where it was put back.
        rows: Error of what the rows of torque tell by themselves, where the torque drives it.
        steady: Error of going on at the speed of the start, where the torque drives it.
    """

    log: Log
    q: Array
    rmse: Array
    command: Array | None
    urdf: Array | None
    second_order: Array | None
    horizons: Mapping[float, Array]
    spread: Array
    rows: Array | None = None
    steady: Array | None = None


def run_open_loop(
    robot: LoopedRobot,
    loops: Loops,
    log: Log,
    *,
    urdf: Loops | None = None,
    plain: Loops | None = None,
    rows: Loops | None = None,
) -> OpenLoop:
    """Return how far open loops run from a log.

    Args:
        robot: The robot.
        loops: Its loops as they were identified; without gains, the logged torque drives it.
        log: The log, with commands, in the URDF's sense of the joints.
        urdf: The URDF with the stated gains, if they are known, or with fitted drives.
        plain: The plain model, if there is one.
        rows: What the rows of torque tell by themselves, if they do.

    Raises:
        NotConvergedError: If the identified robot cannot be rolled out.
    """
    q, is_driven = np.full_like(log.q, np.nan), not loops.kp.any()
    length = DRIFTS if is_driven else np.inf
    windows = cut_windows(log, length, 0.0)
    for out in robot.roll_out(loops, windows):
        q[out.window.counted] = out.q
    told = log.q_ref - log.q
    moved = [w.log.q[w.counted] - w.start[0] for w in windows]
    steady = [
        own - np.outer(w.log.t[w.counted] - w.log.t[w.begin], w.start[1])
        for own, w in zip(moved, windows, strict=True)
    ]
    return OpenLoop(
        log=log,
        q=q,
        rmse=np.sqrt(np.nanmean((log.q - q) ** 2, axis=0)),
        command=None if is_driven else np.sqrt(np.mean(told**2, axis=0)),
        urdf=None if urdf is None else _error(robot, urdf, log, length),
        second_order=None if plain is None else _error(robot, plain, log, length),
        horizons={
            h: error
            for h in HORIZONS
            if h < log.t[-1] - log.t[0] and (error := _error(robot, loops, log, h)) is not None
        },
        spread=_size(np.concatenate(moved)) if is_driven else np.std(log.q, axis=0),
        rows=None if rows is None else _error(robot, rows, log, length),
        steady=_size(np.concatenate(steady)) if is_driven else None,
    )


def _size(e: Array) -> Array:
    size: Array = np.sqrt(np.mean(e**2, axis=0))
    return size


def _error(robot: LoopedRobot, loops: Loops, log: Log, length: float) -> Array | None:
    """Return the error of loops put back to the log every so often; None if they run away."""
    try:
        outs = robot.roll_out(loops, cut_windows(log, length, 0.0))
    except NotConvergedError:
        return None  # a baseline that has no roll-out is said to have none
    return _size(np.concatenate([o.window.log.q[o.window.counted] - o.q for o in outs]))
