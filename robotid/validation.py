"""Predicted torque of a recording, and its metrics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robotid._typing import Array
from robotid.data import Log, Trajectory
from robotid.metrics import Metrics, measure
from robotid.model import RobotModel
from robotid.prediction import predict
from robotid.signals import SignalSettings, process, resolve, unwrap

__all__ = [
    "Evaluation",
    "Recording",
    "evaluate",
    "pool",
    "predict",
    "prepare",
    "row_mask",
    "shares_rows",
]


@dataclass(frozen=True, eq=False)
class Recording:
    """A log made ready for a model.

    Attributes:
        log: The raw log.
        signals: The settings it was processed with, everything automatic decided.
        trajectory: The smooth motion, N samples.
        mask: Rows used, shape (N, n_rows), bool.
    """

    log: Log
    signals: SignalSettings
    trajectory: Trajectory
    mask: Array

    @property
    def name(self) -> str:
        """Name of the log's file and the stretch of it, as ``run3.parquet 5-7.4 s``."""
        file = Path(self.log.path).name or "log"
        return f"{file} {self.log.t[0]:.4g}-{self.log.t[-1]:.4g} s"


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A recording with the torques predicted for it.

    Attributes:
        recording: The recording.
        torques: Predicted torques by name of the parameters, each of shape (N, n_rows) [N m, N];
            among them the baselines "urdf" and "gravity_only".
        metrics: Metrics by name of the parameters, without the baselines.
    """

    recording: Recording
    torques: Mapping[str, Array]
    metrics: Mapping[str, Metrics]


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
    trajectory = process(log, resolved)
    mask = row_mask(model, trajectory, resolved.min_velocity)
    return Recording(log, resolved, trajectory, mask)


def shares_rows(one: Log, other: Log) -> bool:
    """Return whether two logs hold the same recorded rows, whatever their files are called.

    Args:
        one: A log.
        other: Another log of the same joints.

    Returns:
        Whether more than 2 % of 200 rows of positions and torques spread over the first are in
        the second; windows that meet share their common row, which counts for nothing.
    """
    every = max(1, len(one.t) // 200)
    sampled = np.hstack([one.q, one.tau])[::every]
    likely = sampled[np.isin(sampled[:, 0], other.q[:, 0])]
    rows = np.hstack([other.q, other.tau])[np.isin(other.q[:, 0], likely[:, 0])]
    shared = sum(bool((rows == row).all(axis=1).any()) for row in likely)
    return shared > max(1, 0.02 * len(sampled))


def row_mask(model: RobotModel, trajectory: Trajectory, min_velocity: float) -> Array:
    """Return which rows are used: those where the sign of every friction speed is sure.

    Args:
        model: The robot. Without Coulomb friction to identify every row is used.
        trajectory: N samples.
        min_velocity: Bound on the speed of a joint or of a coupled drive [rad/s or m/s].

    Returns:
        Flags, shape (N, n_rows), bool.
    """
    mask = np.ones((len(trajectory.t), model.n_rows), dtype=bool)
    if "coulomb" not in model.layout.terms or min_velocity == 0:
        return mask
    first = model.n_rows - len(model.joints)
    v = trajectory.v[:, first:]
    mask[:, first:] = np.abs(v) >= min_velocity
    for coupling in model.layout.couplings:
        rows = [model.joints.index(joint) for joint, _ in coupling.ratios]
        w = v[:, rows] @ np.array([ratio for _, ratio in coupling.ratios])
        mask[:, [first + row for row in rows]] &= (np.abs(w) >= min_velocity)[:, None]
    return mask


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
    trajectory = recording.trajectory
    *torques, urdf = predict(model, [*parameters.values(), prior], trajectory)
    still = np.zeros_like(trajectory.v)
    (gravity,) = predict(
        model, [_without_drives(model, prior)], replace(trajectory, v=still, a=still)
    )
    baselines = {"urdf": urdf, "gravity_only": gravity}
    predicted = dict(zip(parameters, torques, strict=True))
    metrics = {
        name: measure(
            trajectory.tau, torque, recording.mask, model.row_names, model.row_units, baselines
        )
        for name, torque in predicted.items()
    }
    return Evaluation(recording, {**predicted, **baselines}, metrics)


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
    tau = np.concatenate([e.recording.trajectory.tau for e in evaluations])
    mask = np.concatenate([e.recording.mask for e in evaluations])
    torques = {
        key: np.concatenate([e.torques[key] for e in evaluations])
        for key in (name, "urdf", "gravity_only")
    }
    prediction = torques.pop(name)
    return measure(tau, prediction, mask, model.row_names, model.row_units, torques)


def _without_drives(model: RobotModel, pi: Array) -> Array:
    inertial = pi.copy()
    inertial[model.layout.n_inertial :] = 0.0
    return inertial
