"""Errors of simulated positions against validation logs, with simpler models as baselines."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robotid.base.exceptions import NotConvergedError
from robotid.base.text import period
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.dynamics.simulation.loops import ClosedLoopRobot, Loops, cut_windows
from robotid.estimation.fitting.metrics import JointMetrics, Metrics
from robotid.robot.model import RobotModel

#: Horizons after which a simulation restarts from the measured state [s].
HORIZONS = (0.1, 0.5, 2.0)
#: Horizon of simulations driven by the logged torque: without feedback they drift.
DRIFTS = 0.5  # [s]
_COMMANDED = ("command", "urdf", "second_order")  # baselines of simulations driven by commands ...
_DRIVEN = (*_COMMANDED, "rows", "steady")  # ... and of those driven by the logged torque


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """A log and its simulation from the commands alone; errors are RMS values of shape (n,).

    A simulation driven by the logged torque restarts from the log every ``DRIFTS``.
    """

    log: Log
    #: Simulated positions of the identified robot, started once, shape (N, n) [rad or m];
    #: NaN at a single sample between gaps.
    q: Array
    rmse: Array  # error of the simulated positions
    #: Errors of simpler models, by name; None if unknown or unstable. "command": the command
    #: as the position; "urdf": the URDF with the stated gains, or with drives fitted to the
    #: torques; "second_order": a second-order model of each joint. With the logged torque as
    #: input also "rows": the estimate from the torque rows alone, and "steady": the initial
    #: speed held constant.
    baselines: Mapping[str, Array | None]
    horizons: Mapping[float, Array]  # error over short horizons, by their length [s]
    spread: Array  # RMS motion about its mean, or about the last restart

    @property
    def name(self) -> str:
        """Name of the log's file with its time range, as ``run3.parquet 5-7.4 s``."""
        return f"{self.log.name} {period(float(self.log.t[0]), float(self.log.t[-1]))}"

    @property
    def is_driven(self) -> bool:
        """Whether the logged torque drives the robot, without a closed loop."""
        return "steady" in self.baselines

    @property
    def moves(self) -> Array:
        """Which joints the log moves, shape (n,), bool; only these have a relative error."""
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
    """Simulate a log from its commands alone and return the position errors."""
    q, is_driven = np.full_like(log.q, np.nan), not loops.kp.any()
    length = DRIFTS if is_driven else np.inf
    windows = cut_windows(log, length, 0.0)
    for out in robot.roll_out(loops, windows):
        q[out.window.counted] = out.q
    lag_error = log.q_ref - log.q
    moved = [w.log.q[w.counted] - w.start[0] for w in windows]
    steady = [
        own - np.outer(w.log.t[w.counted] - w.log.t[w.start_row], w.start[1])
        for own, w in zip(moved, windows, strict=True)
    ]
    baselines: dict[str, Array | None] = dict.fromkeys(_DRIVEN if is_driven else _COMMANDED)
    baselines |= {key: _error(robot, plain, log, length) for key, plain in (others or {}).items()}
    own = {"steady": np.concatenate(steady)} if is_driven else {"command": lag_error}
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
    """Return the metrics of simulated positions over all logs.

    Relative errors are 100 rmse / spread of the motion, of joints that a log commands to move; all
    logs have equal weight.
    """
    found: dict[str, JointMetrics] = {}
    units = position_units(model)
    for j, joint in enumerate(model.joints):
        own = [run for run in runs if not moving or run.moves[j]]
        if own:
            found[joint] = _joint_metrics(own, j, units[j])
    return Metrics(found, _mean(rmse for run in runs for rmse in run.rmse))


def position_units(model: RobotModel) -> tuple[str, ...]:
    """Return the unit of the position of each joint."""
    return tuple("m" if joint in model.layout.prismatic else "rad" for joint in model.joints)


def _joint_metrics(runs: Sequence[OpenLoop], j: int, unit: str) -> JointMetrics:
    rmse, size = (_mean(getattr(run, key)[j] for run in runs) for key in ("rmse", "spread"))
    moves = size > 0 and any(run.moves[j] for run in runs)

    def share(errors: Sequence[Array | None]) -> float | None:
        own = [error[j] for error in errors if error is not None]
        return 100.0 * _mean(own) / size if moves and len(own) == len(runs) else None

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
    """Return the error of simulations restarted every ``length`` seconds; None if unstable."""
    try:
        outs = robot.roll_out(loops, cut_windows(log, length, 0.0))
    except NotConvergedError:
        return None  # a baseline that cannot be simulated has no error
    return _size(np.concatenate([o.window.log.q[o.window.counted] - o.q for o in outs]))
