"""How far an open loop runs from what was measured, and how far plainer models run."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import NotConvergedError
from robotid.fitting.metrics import JointMetrics, Metrics
from robotid.logs.data import Log
from robotid.robot.model import RobotModel
from robotid.simulation.loops import ClosedLoopRobot, Loops, cut_windows

__all__ = ["DRIFTS", "HORIZONS", "OpenLoop", "position_metrics", "position_units", "run_open_loop"]

#: How long an open loop runs before it is put back to what was measured [s].
HORIZONS = (0.1, 0.5, 2.0)
#: After this time what a logged torque drives is put back to the log: nothing else brings it back.
DRIFTS = 0.5  # [s]
_COMMANDED = ("command", "urdf", "second_order")  # baselines of what follows commands ...
_DRIVEN = (*_COMMANDED, "rows", "steady")  # ... and of what a torque drives


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """A log beside open loops on its commands; errors are root mean squares of shape (n,).

    What the logged torque drives is put back to the log every ``DRIFTS``.

    Attributes:
        log: The log.
        q: Positions of the identified robot, started once, shape (N, n) [rad or m]; NaN of a
            sample that stands alone between gaps.
        rmse: Its error.
        baselines: Those of plainer models, by name, None of one that is not known or runs away:
            "command", taken for the position; "urdf", with the stated gains, or with drives fitted
            to the torques; "second_order", the plain model, joint by joint. Where the torque drives
            it also "rows", what the rows of torque determine by themselves, and "steady", going on
            at the speed of the start.
        horizons: Error over short horizons, by their length [s].
        spread: Size of the motion about its mean, or about where it was put back.
    """

    log: Log
    q: Array
    rmse: Array
    baselines: Mapping[str, Array | None]
    horizons: Mapping[float, Array]
    spread: Array

    @property
    def name(self) -> str:
        """Name of the log's file and the window of it, as ``run3.parquet 5-7.4 s``."""
        return f"{self.log.name} {self.log.t[0]:.4g}-{self.log.t[-1]:.4g} s"

    @property
    def is_driven(self) -> bool:
        """Whether the logged torque drives the robot, which no loop is closed on."""
        return "steady" in self.baselines

    @property
    def moves(self) -> Array:
        """Which joints the log moves, shape (n,), bool: else errors are no share of a motion."""
        if self.is_driven or self.log.q_ref is None:
            return np.ones(len(self.rmse), dtype=bool)
        return np.asarray(np.ptp(self.log.q_ref, axis=0) > 0)


def run_open_loop(
    robot: ClosedLoopRobot,
    loops: Loops,
    log: Log,
    others: Mapping[str, Loops] | None = None,
    *,
    horizons: Sequence[float] = HORIZONS,
) -> OpenLoop:
    """Return how far open loops run from a log.

    Args:
        robot: The robot.
        loops: Its loops as they were identified; without gains, the logged torque drives it.
        log: The log, with commands, in the URDF's sense of the joints.
        others: Plainer models, by name of the baseline: "urdf", "second_order", "rows".
        horizons: How long open loops run, beside the whole log, before they are put back [s].

    Raises:
        NotConvergedError: If the identified robot cannot be simulated.
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
    baselines: dict[str, Array | None] = dict.fromkeys(_DRIVEN if is_driven else _COMMANDED)
    baselines |= {key: _error(robot, plain, log, length) for key, plain in (others or {}).items()}
    own = {"steady": np.concatenate(steady)} if is_driven else {"command": told}
    baselines |= {key: _size(e) for key, e in own.items()}
    return OpenLoop(
        log=log,
        q=q,
        rmse=np.sqrt(np.nanmean((log.q - q) ** 2, axis=0)),
        baselines=baselines,
        horizons={
            h: error
            for h in horizons
            if h < log.t[-1] - log.t[0] and (error := _error(robot, loops, log, h)) is not None
        },
        spread=_size(np.concatenate(moved)) if is_driven else np.std(log.q, axis=0),
    )


def position_metrics(
    model: RobotModel, runs: Sequence[OpenLoop], *, moving: bool = False
) -> Metrics:
    """Return the metrics of simulated positions, all logs together.

    Relative errors are those of the motion, 100 rmse / spread; a log counts as much as another.

    Args:
        model: The robot.
        runs: Open loops beside logs.
        moving: Whether, of each joint, only the logs count that move it; one that none moves is
            missing.
    """
    found: dict[str, JointMetrics] = {}
    units = position_units(model)
    for j, joint in enumerate(model.joints):
        own = [run for run in runs if not moving or run.moves[j]]
        if own:
            found[joint] = _joint_metrics(own, j, units[j])
    return Metrics(found, _mean(rmse for run in runs for rmse in run.rmse))


def position_units(model: RobotModel) -> tuple[str, ...]:
    """Return the unit of the position of each joint.

    Args:
        model: The robot.
    """
    return tuple("m" if joint in model.layout.prismatic else "rad" for joint in model.joints)


def _joint_metrics(runs: Sequence[OpenLoop], j: int, unit: str) -> JointMetrics:
    rmse, size = (_mean(getattr(run, key)[j] for run in runs) for key in ("rmse", "spread"))

    def share(errors: Sequence[Array | None]) -> float | None:
        own = [error[j] for error in errors if error is not None]
        return 100.0 * _mean(own) / size if size > 0 and len(own) == len(runs) else None

    left = (rmse / size) ** 2 if size > 0 else 1.0
    return JointMetrics(
        rmse=rmse,
        unit=unit,
        relative_error_pct=share([run.rmse for run in runs]),
        r2=1.0 - left,
        rows=sum(len(run.log.t) for run in runs),
        baselines={key: share([x.baselines[key] for x in runs]) for key in runs[0].baselines},
        better_than_constant=left < 1.0,
    )


def _mean(values: Iterable[float]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(list(values)))))


def _size(e: Array) -> Array:
    size: Array = np.sqrt(np.mean(e**2, axis=0))
    return size


def _error(robot: ClosedLoopRobot, loops: Loops, log: Log, length: float) -> Array | None:
    """Return the error of loops put back to the log every so often; None if they run away."""
    try:
        outs = robot.roll_out(loops, cut_windows(log, length, 0.0))
    except NotConvergedError:
        return None  # a baseline that has no roll-out is said to have none
    return _size(np.concatenate([o.window.log.q[o.window.counted] - o.q for o in outs]))
