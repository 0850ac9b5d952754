"""Positions simulated from the commands or torques of logs, their errors, and simpler models."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robotid.base.exceptions import NotConvergedError
from robotid.base.text import period
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.diagnosis.decisions import BETTER, DIFFERS, SCATTERED
from robotid.diagnosis.logs.command_channels import EXCITED, SECONDS
from robotid.dynamics.simulation.loops import ClosedLoopRobot, Loops, cut_windows
from robotid.estimation.fitting.evaluation import Extent, JointMetrics, Metrics

#: Horizons after which a simulation restarts from the measured state [s].
HORIZONS = (0.1, 0.5, 2.0)
#: Horizon of simulations driven by the logged torque: without feedback they drift.
DRIFTS = 0.5  # [s]
_COMMANDED = ("command", "urdf", "second_order")  # baselines of simulations driven by commands ...
_DRIVEN = (*_COMMANDED, "rows", "steady")  # ... and of those driven by the logged torque


@dataclass(frozen=True, eq=False)
class PositionEvaluation:
    """A log and its simulation from the commands alone; errors are RMS values of shape (n,)."""

    log: Log
    units: tuple[str, ...]  # of the positions, by joint
    #: Simulated positions of the identified robot, (N, n) [rad or m], started once, or every
    #: ``DRIFTS`` if the logged torque drives it; NaN at a single sample between gaps.
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
        return f"{self.log.name} {period(self.extent.start, self.extent.end)}"

    @property
    def extent(self) -> Extent:
        """Size of the log."""
        t, rows = self.log.t, len(self.log.t)
        rate = 1.0 / float(np.median(np.diff(t)))
        return Extent(rows, rate, float(t[0]), float(t[-1]), rows, rows, 1)

    @cached_property
    def metrics(self) -> Mapping[str, Metrics]:
        """Metrics of the simulated positions."""
        return {"estimate": pool_positions((self,))}

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

    def valid_band(self, j: int) -> dict[str, float] | None:
        """Return the frequency above which all errors of a joint are large, and its errors."""
        # below and above it, relative to the motion, at frequencies of the command [-]
        from scipy.ndimage import median_filter
        from scipy.signal import welch

        longest = max(cut_windows(self.log, np.inf, 0.0), key=lambda w: w.stop - w.first)
        q, q_ref = self.log.q, np.asarray(self.log.q_ref)
        signals = np.stack([q_ref, q, q - self.q])[:, longest.counted, j]
        n = min(signals.shape[1], round(SECONDS / longest.dt))
        f, powers = welch(signals, 1 / longest.dt, nperseg=n, detrend="linear")
        used = (powers[0] > EXCITED * powers[0].max()) & (f > 0)
        f, (_, motion, error) = f[used], powers[:, used]
        share = median_filter(np.sqrt(error / motion), size=2 * SCATTERED - 1, mode="nearest")
        k = 1 + int(np.flatnonzero(share <= DIFFERS).max(initial=-1))
        if not SCATTERED <= k <= len(f) - SCATTERED:
            return None
        below = float(np.sqrt(error[:k].sum() / motion[:k].sum()))
        above = float(np.sqrt(error[k:].sum() / motion[k:].sum()))
        figures = {"frequency": float(f[k]), "below": below, "above": above}
        return figures if below < BETTER * above else None

    def to_dict(self, name: str = "estimate") -> dict[str, Any]:
        """Return the log and its errors as plain values, as result.json has them."""
        content = self.metrics[name].to_dict()
        for j, errors in enumerate(content["per_joint"].values()):
            for key, x in self.baselines.items():
                errors[f"{key}_rmse"] = None if x is None else float(x[j])
        return {
            "log": self.log.path,
            "name": self.name,
            "start": self.extent.start,
            "end": self.extent.end,
            **content,
            "horizons": {
                f"{h:g}": dict(zip(self.log.joints, map(float, errors), strict=True))
                for h, errors in self.horizons.items()
            },
        }


def run_open_loop(
    robot: ClosedLoopRobot,
    loops: Loops,
    log: Log,
    others: Mapping[str, Loops] | None = None,
    *,
    horizons: Sequence[float] = HORIZONS,
) -> PositionEvaluation:
    """Simulate a log from its commands alone and return the position errors."""
    q, is_driven = np.full_like(log.q, np.nan), not loops.kp.any()
    length = DRIFTS if is_driven else np.inf
    windows = cut_windows(log, length, 0.0)
    for out in robot.roll_out(loops, windows):
        q[out.window.counted] = out.q
    moved = [w.log.q[w.counted] - w.start[0] for w in windows]
    baselines: dict[str, Array | None] = dict.fromkeys(_DRIVEN if is_driven else _COMMANDED)
    baselines |= {key: _error(robot, plain, log, length) for key, plain in (others or {}).items()}
    if is_driven:
        drifts = [np.outer(w.log.t[w.counted] - w.log.t[w.start_row], w.start[1]) for w in windows]
        baselines["steady"] = _rms(np.concatenate(moved) - np.concatenate(drifts))
    else:
        baselines["command"] = _rms(log.q_ref - log.q)
    lengths = [h for h in horizons if h < log.t[-1] - log.t[0]]
    errors = {h: _error(robot, loops, log, h) for h in lengths}
    return PositionEvaluation(
        log=log,
        units=tuple("m" if x in robot.model.layout.prismatic else "rad" for x in log.joints), q=q,
        rmse=np.sqrt(np.nanmean((log.q - q) ** 2, axis=0)), baselines=baselines,
        horizons={h: error for h, error in errors.items() if error is not None},
        spread=_rms(np.concatenate(moved)) if is_driven else np.std(log.q, axis=0),
    )  # fmt: skip


def pool_positions(runs: Sequence[PositionEvaluation], *, moving: bool = False) -> Metrics:
    """Return 100 rmse / spread of positions, all logs alike; of joints that move, if ``moving``."""
    per_joint: dict[str, JointMetrics] = {}
    for j, joint in enumerate(runs[0].log.joints):
        if of_joint := [run for run in runs if not moving or run.moves[j]]:
            per_joint[joint] = _joint_metrics(of_joint, j)
    return Metrics(per_joint, float(_rms([x for run in runs for x in run.rmse])))


def _joint_metrics(runs: Sequence[PositionEvaluation], j: int) -> JointMetrics:
    rmse, size = (float(_rms([getattr(x, key)[j] for x in runs])) for key in ("rmse", "spread"))
    moves = size > 0 and any(run.moves[j] for run in runs)

    def share(errors: Sequence[Array | None]) -> float | None:
        known = [error[j] for error in errors if error is not None]
        return 100.0 * float(_rms(known)) / size if moves and len(known) == len(runs) else None

    left = (rmse / size) ** 2 if size > 0 else 1.0
    return JointMetrics(
        rmse=rmse, unit=runs[0].units[j], relative_error_pct=share([run.rmse for run in runs]),
        r2=1.0 - left, rows=sum(len(run.log.t) for run in runs),
        baselines={key: share([x.baselines[key] for x in runs]) for key in runs[0].baselines},
        better_than_constant=left < 1.0,
    )  # fmt: skip


def _rms(x: ArrayLike) -> Array:
    """Return the root mean square over the rows."""
    return np.asarray(np.sqrt(np.mean(np.square(x), axis=0)))


def _error(robot: ClosedLoopRobot, loops: Loops, log: Log, length: float) -> Array | None:
    """Return the error of simulations restarted every ``length`` seconds; None if unstable."""
    try:
        outs = robot.roll_out(loops, cut_windows(log, length, 0.0))
    except NotConvergedError:
        return None  # a baseline that cannot be simulated has no error
    return _rms(np.concatenate([o.window.log.q[o.window.counted] - o.q for o in outs]))
