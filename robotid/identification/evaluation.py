"""Predicted torque of a recording, and its metrics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import numpy as np

from robotid._typing import Array
from robotid.identification.metrics import Metrics, TorqueSums
from robotid.logs.data import Log, Trajectory
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import process, resolve, unwrap
from robotid.regressor.columns import friction_speeds, sure_rows
from robotid.regressor.prediction import predict
from robotid.robot.model import RobotModel

__all__ = [
    "Evaluation",
    "Extent",
    "Recording",
    "conclude_sums",
    "evaluate",
    "is_shared",
    "pool",
    "predict",
    "predict_all",
    "prepare",
    "row_mask",
    "rows_in",
    "sampled_every",
    "shares_rows",
    "torque_sums",
]


@dataclass(frozen=True)
class Extent:
    """How much of a log there is.

    Attributes:
        samples: Rows of the log.
        rate: Their median rate [Hz].
        start: First time stamp [s].
        end: Last time stamp [s].
        smooth: Samples of its trajectory.
        rows_used: Torque rows of these that are used.
        segments: Uninterrupted stretches of the trajectory.
    """

    samples: int
    rate: float
    start: float
    end: float
    smooth: int
    rows_used: int
    segments: int


@dataclass(frozen=True, eq=False)
class Recording:
    """A log made ready for a model. Of a long log, only some stretches are at hand.

    Attributes:
        log: The raw log, or its first rows.
        signals: The settings it was processed with, everything automatic decided.
        trajectory: The smooth motion, N samples, or stretches of it.
        mask: Rows used, shape (N, n_rows), bool.
        extent: How much of the whole log there is.
    """

    log: Log
    signals: SignalSettings
    trajectory: Trajectory
    mask: Array
    extent: Extent

    @property
    def name(self) -> str:
        """Name of the log's file and the stretch of it, as ``run3.parquet 5-7.4 s``."""
        file = Path(self.log.path).name or "log"
        return f"{file} {self.extent.start:.4g}-{self.extent.end:.4g} s"

    @property
    def is_partial(self) -> bool:
        """Whether only stretches of the motion are at hand."""
        return len(self.trajectory.t) < self.extent.smooth


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A recording with the torques predicted for it.

    Attributes:
        recording: The recording.
        torques: Predicted torques by name of the parameters, each of shape (N, n_rows) [N m, N];
            among them the baselines "urdf" and "gravity_only".
        sums: What the metrics over the whole log are made of, by name of the parameters, without
            the baselines.
        metrics: Metrics over the whole log, likewise.
        is_refitted: Whether it was kept apart, but holds rows that were fitted.
    """

    recording: Recording
    torques: Mapping[str, Array]
    sums: Mapping[str, TorqueSums]
    metrics: Mapping[str, Metrics]
    is_refitted: bool = False


def prepare(model: RobotModel, log: Log, settings: SignalSettings) -> Recording:
    """Return a log made ready for a model: turns taken out, filtered, rows chosen.

    Args:
        model: The robot.
        log: The log, of the model's joints in its order.
        settings: How it becomes a trajectory.

    Returns:
        The recording.

    Raises:
        DataError: If the log is too short or an angle jumps.
        SettingsError: If a setting does not fit the log.
    """
    log = unwrap(log, np.array([joint.turns_freely for joint in model.limits]))
    resolved = resolve(log, settings)
    trajectory = process(log, resolved, friction_speeds(model.layout))
    mask = row_mask(model, trajectory, resolved.min_velocity)
    extent = Extent(
        samples=len(log.t),
        rate=float(1.0 / np.median(np.diff(log.t))),
        start=float(log.t[0]),
        end=float(log.t[-1]),
        smooth=len(trajectory.t),
        rows_used=int(mask.sum()),
        segments=int(trajectory.segment[-1]) + 1,
    )
    return Recording(log, resolved, trajectory, mask, extent)


def shares_rows(one: Log, other: Log) -> bool:
    """Return whether two logs hold the same recorded rows, whatever their files are called.

    Args:
        one: A log.
        other: Another log of the same joints.

    Returns:
        Whether more than 2 % of 200 rows of positions and torques spread over the first are in
        the second; windows that meet share their common row, which counts for nothing.
    """
    rows, others = (np.hstack([log.q, log.tau]) for log in (one, other))
    return is_shared(rows_in(rows[:: sampled_every(len(rows))], others))


def sampled_every(rows: int) -> int:
    """Return how far apart the rows are that ``shares_rows`` looks for.

    Args:
        rows: Rows of the log that they are of.

    Returns:
        Every so many rows.
    """
    return max(1, rows // 200)


def rows_in(sampled: Array, rows: Array) -> Array:
    """Return which rows of positions and torques are among others.

    Args:
        sampled: The rows, shape (m, 2 n).
        rows: The others, shape (N, 2 n).

    Returns:
        Flags, shape (m,), bool.
    """
    found = np.isin(sampled[:, 0], rows[:, 0])
    likely = rows[np.isin(rows[:, 0], sampled[found, 0])]
    for k in np.flatnonzero(found):
        found[k] = (likely == sampled[k]).all(axis=1).any()
    return found


def is_shared(found: Array) -> bool:
    """Return whether so many rows are in another log that it holds the same recording.

    Args:
        found: Which of the rows looked for are in it, bool.

    Returns:
        Whether it does.
    """
    return int(found.sum()) > max(1, 0.02 * len(found))


def row_mask(model: RobotModel, trajectory: Trajectory, min_velocity: float) -> Array:
    """Return which rows are used: those where the sign of every friction speed is sure.

    Args:
        model: The robot. Without Coulomb friction to identify every row is used.
        trajectory: N samples.
        min_velocity: Bound on the speed of a joint or of a coupled drive [rad/s or m/s].

    Returns:
        Flags, shape (N, n_rows), bool.
    """
    return sure_rows(model.layout, trajectory.v, min_velocity)


def evaluate(
    model: RobotModel, recording: Recording, parameters: Mapping[str, Array], prior: Array
) -> Evaluation:
    """Return predicted torques and metrics of a recording.

    Args:
        model: The robot.
        recording: The recording.
        parameters: Standard parameters by name, each of shape (p,).
        prior: Those of the URDF, shape (p,): the baselines are its torque, with and without motion.

    Returns:
        The evaluation.

    Raises:
        DataError: If no row of the recording is used.
    """
    torques = predict_all(model, recording.trajectory, parameters, prior)
    sums = torque_sums(recording.trajectory, recording.mask, torques, list(parameters))
    return conclude_sums(model, recording, torques, sums)


def predict_all(
    model: RobotModel,
    trajectory: Trajectory,
    parameters: Mapping[str, Array],
    prior: Array,
    *,
    compiled: bool | None = None,
) -> dict[str, Array]:
    """Return the torques that parameters and the baselines predict.

    Args:
        model: The robot.
        trajectory: N samples.
        parameters: Standard parameters by name, each of shape (p,).
        prior: Those of the URDF, shape (p,).
        compiled: As of ``predict``.

    Returns:
        Torques by name, each of shape (N, n_rows): those of the parameters, "urdf" and
        "gravity_only".
    """
    *torques, urdf = predict(model, [*parameters.values(), prior], trajectory, compiled=compiled)
    still = np.zeros_like(trajectory.v)
    (gravity,) = predict(
        model,
        [_without_drives(model, prior)],
        replace(trajectory, v=still, a=still, direction=None),
        compiled=compiled,
    )
    predicted = dict(zip(parameters, torques, strict=True))
    return {**predicted, "urdf": urdf, "gravity_only": gravity}


def torque_sums(
    trajectory: Trajectory, mask: Array, torques: Mapping[str, Array], names: Sequence[str]
) -> dict[str, TorqueSums]:
    """Return what the metrics of predictions are made of.

    Args:
        trajectory: N samples.
        mask: Rows used, shape (N, n_rows), bool.
        torques: As of ``predict_all``.
        names: Which of them to measure.

    Returns:
        The sums by name.
    """
    baselines = {key: torques[key] for key in ("urdf", "gravity_only")}
    tau = trajectory.tau
    return {name: TorqueSums.of(tau, torques[name], mask, baselines) for name in names}


def conclude_sums(
    model: RobotModel,
    recording: Recording,
    torques: Mapping[str, Array],
    sums: Mapping[str, TorqueSums],
    *,
    is_refitted: bool = False,
) -> Evaluation:
    """Return the evaluation that predicted torques and their sums make up.

    Args:
        model: The robot.
        recording: The recording.
        torques: Torques predicted for its trajectory.
        sums: Sums over the whole log.
        is_refitted: Whether it was kept apart, but holds rows that were fitted.

    Returns:
        The evaluation.

    Raises:
        DataError: If no row of the recording is used.
    """
    metrics = {name: s.metrics(model.row_names, model.row_units) for name, s in sums.items()}
    return Evaluation(recording, torques, sums, metrics, is_refitted)


def pool(model: RobotModel, evaluations: Sequence[Evaluation], name: str) -> Metrics:
    """Return the metrics over several recordings together.

    Args:
        model: The robot.
        evaluations: The recordings, at least one.
        name: Which parameters predict.

    Returns:
        The metrics.

    Raises:
        DataError: If no row of any recording is used.
    """
    together = reduce(TorqueSums.merge, [evaluation.sums[name] for evaluation in evaluations])
    return together.metrics(model.row_names, model.row_units)


def _without_drives(model: RobotModel, pi: Array) -> Array:
    inertial = pi.copy()
    inertial[model.layout.n_inertial :] = 0.0
    return inertial
