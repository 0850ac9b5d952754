"""How far an open loop runs from what was measured, and how far plainer models run."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import NotConvergedError
from robotid.logs.data import Log
from robotid.simulation.loops import LoopedRobot, Loops, cut_windows

__all__ = ["HORIZONS", "OpenLoop", "run_open_loop"]

#: How long an open loop runs before it is put back to what was measured [s].
HORIZONS = (0.1, 0.5, 2.0)


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """A log beside open loops on its commands; errors are root mean squares of shape (n,).

    Attributes:
        log: The log.
        q: Positions of the identified robot, started once, shape (N, n) [rad or m]; NaN of a
            sample that stands alone between gaps.
        rmse: Its error.
        command: That of the command, taken for the position.
        urdf: That of the URDF with the stated gains; None if they are not known, or it runs away.
        second_order: That of the plain model, joint by joint; None if it runs away.
        horizons: Error over short horizons, by their length [s].
        spread: Size of the motion about its mean.
    """

    log: Log
    q: Array
    rmse: Array
    command: Array
    urdf: Array | None
    second_order: Array | None
    horizons: Mapping[float, Array]
    spread: Array


def run_open_loop(
    robot: LoopedRobot,
    loops: Loops,
    log: Log,
    *,
    urdf: Loops | None = None,
    plain: Loops | None = None,
) -> OpenLoop:
    """Return how far open loops run from a log.

    Args:
        robot: The robot.
        loops: Its loops as they were identified.
        log: The log, with commands, in the URDF's sense of the joints.
        urdf: The URDF with the stated gains, if they are known.
        plain: The plain model, if there is one.

    Raises:
        NotConvergedError: If the identified robot cannot be rolled out.
    """
    q = np.full_like(log.q, np.nan)
    for out in robot.roll_out(loops, cut_windows(log, np.inf, 0.0)):
        q[out.window.counted] = out.q
    told = log.q_ref - log.q
    return OpenLoop(
        log=log,
        q=q,
        rmse=np.sqrt(np.nanmean((log.q - q) ** 2, axis=0)),
        command=np.sqrt(np.mean(told**2, axis=0)),
        urdf=None if urdf is None else _error(robot, urdf, log, np.inf),
        second_order=None if plain is None else _error(robot, plain, log, np.inf),
        horizons={
            h: error
            for h in HORIZONS
            if h < log.t[-1] - log.t[0] and (error := _error(robot, loops, log, h)) is not None
        },
        spread=np.std(log.q, axis=0),
    )


def _error(robot: LoopedRobot, loops: Loops, log: Log, length: float) -> Array | None:
    """Return the error of loops put back to the log every so often; None if they run away."""
    try:
        outs = robot.roll_out(loops, cut_windows(log, length, 0.0))
    except NotConvergedError:
        return None  # a baseline that has no roll-out is said to have none
    e = np.concatenate([out.window.log.q[out.window.counted] - out.q for out in outs])
    error: Array = np.sqrt(np.mean(e**2, axis=0))
    return error
