"""How good a predicted torque is, joint by joint, against baselines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError

__all__ = ["JointMetrics", "Metrics", "measure"]


@dataclass(frozen=True)
class JointMetrics:
    """How well the torque of one joint is predicted, over the rows used.

    Attributes:
        rmse: Root mean square of the residual [unit].
        unit: N m, or N for a joint that slides.
        relative_error_pct: 100 |tau - prediction| / |tau| [%]; predicting 0 scores 100. None if
            the measured torque is 0 throughout.
        r2: Share of the torque's variance that is explained [-].
        rows: Number of rows used.
        baselines: relative_error_pct of other predictions, by name [%].
        better_than_constant: Whether the residual is smaller than that of the mean torque.
    """

    rmse: float
    unit: str
    relative_error_pct: float | None
    r2: float
    rows: int
    baselines: Mapping[str, float | None]
    better_than_constant: bool


@dataclass(frozen=True)
class Metrics:
    """Metrics of every joint of one recording.

    Attributes:
        per_joint: By name of the joint; a joint without rows is missing.
        pooled_rmse: Root mean square of the residuals of all joints together [N m, N].
    """

    per_joint: Mapping[str, JointMetrics]
    pooled_rmse: float


def measure(
    tau: Array,
    prediction: Array,
    mask: Array,
    names: Sequence[str],
    units: Sequence[str],
    baselines: Mapping[str, Array] | None = None,
) -> Metrics:
    """Return the metrics of a prediction.

    Args:
        tau: Measured torque, shape (N, n) [N m, N].
        prediction: Predicted torque, shape (N, n) [N m, N].
        mask: Rows used, shape (N, n), bool.
        names: Names of the n joints.
        units: Units of their torques.
        baselines: Other predictions to compare with, by name, each of shape (N, n).

    Returns:
        The metrics.

    Raises:
        DataError: If no row is used at all.
    """
    if not mask.any():
        raise DataError(
            "no row is left to measure the prediction with: no joint moves faster than "
            "min_velocity; lower it, or give a log with motion"
        )
    per_joint = {}
    for j, (name, unit) in enumerate(zip(names, units, strict=True)):
        rows = mask[:, j]
        if rows.any():
            others = {key: torque[rows, j] for key, torque in (baselines or {}).items()}
            per_joint[name] = _joint(tau[rows, j], prediction[rows, j], others, unit)
    squares = (tau - prediction)[mask] ** 2
    return Metrics(per_joint, float(np.sqrt(squares.mean())))


def _joint(tau: Array, prediction: Array, others: Mapping[str, Array], unit: str) -> JointMetrics:
    residual = float(np.sum((tau - prediction) ** 2))
    spread = float(np.sum((tau - tau.mean()) ** 2))
    return JointMetrics(
        rmse=float(np.sqrt(residual / len(tau))),
        unit=unit,
        relative_error_pct=_relative_error(tau, prediction),
        r2=1.0 - residual / spread if spread > 0 else 0.0,
        rows=len(tau),
        baselines={key: _relative_error(tau, torque) for key, torque in others.items()},
        better_than_constant=residual < spread,
    )


def _relative_error(tau: Array, prediction: Array) -> float | None:
    size = float(np.linalg.norm(tau))
    return 100.0 * float(np.linalg.norm(tau - prediction)) / size if size > 0 else None
