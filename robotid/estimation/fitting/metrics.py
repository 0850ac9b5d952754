"""Prediction errors of torque or position, by joint, compared with baselines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.typing import Array


@dataclass(frozen=True)
class JointMetrics:
    """Prediction error of the torque or the position of one joint over the rows used.

    Attributes:
        rmse: Root mean square of the residual [unit].
        unit: N m or rad; N or m for a prismatic joint.
        relative_error_pct: 100 |tau - prediction| / |tau| [%]; 100 for a prediction of 0. For a
            position, relative to its motion about the mean. None if the measured signal is 0.
        r2: Share of the variance that the prediction explains [-].
        rows: Number of rows used.
        baselines: relative_error_pct of other predictions, by name [%].
        better_than_constant: Whether the residual is smaller than that of the mean.
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
        per_joint: Metrics by name of the joint; joints without rows are not in it.
        pooled_rmse: Root mean square of the residuals of all joints together [N m, N].
    """

    per_joint: Mapping[str, JointMetrics]
    pooled_rmse: float

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as they are written to result.json."""
        return {
            "per_joint": {
                joint: {
                    "rmse": m.rmse,
                    "unit": m.unit,
                    "relative_error_pct": m.relative_error_pct,
                    "r2": m.r2,
                    "rows": m.rows,
                    **{f"{x}_relative_error_pct": error for x, error in m.baselines.items()},
                    "better_than_constant": m.better_than_constant,
                }
                for joint, m in self.per_joint.items()
            },
            "pooled_rmse": self.pooled_rmse,
        }


@dataclass(frozen=True, eq=False)
class TorqueSums:
    """Sums from which the metrics of a prediction are computed; sums of two recordings can merge.

    Attributes:
        rows: Number of rows used per joint, shape (n,), int.
        mean: Mean of the measured torque over them, shape (n,) [N m, N].
        spread: Sum of squared deviations of the torque from the mean, shape (n,).
        torque: Sum of squares of the torque, shape (n,).
        residual: Sum of squared residuals of the prediction, shape (n,).
        baselines: Sums of squared residuals of other predictions, by name, each of shape (n,).
    """

    rows: Array
    mean: Array
    spread: Array
    torque: Array
    residual: Array
    baselines: Mapping[str, Array]

    @classmethod
    def of(
        cls, tau: Array, prediction: Array, mask: Array, baselines: Mapping[str, Array]
    ) -> "TorqueSums":
        """Return the sums over the rows used.

        tau (N, n) [N m, N], prediction (N, n) [N m, N], mask (N, n), baselines (N, n).
        """
        rows = mask.sum(axis=0)
        mean = np.sum(tau, axis=0, where=mask) / np.maximum(rows, 1)

        def squares(values: Array) -> Array:
            return np.asarray(np.sum(values**2, axis=0, where=mask))

        return cls(
            rows=rows,
            mean=mean,
            spread=squares(tau - mean),
            torque=squares(tau),
            residual=squares(tau - prediction),
            baselines={name: squares(tau - torque) for name, torque in baselines.items()},
        )

    def merge(self, other: "TorqueSums") -> "TorqueSums":
        """Return the sums over the rows of both.

        References:
            Chan, Golub, LeVeque (1983), Algorithms for Computing the Sample Variance, (2.1).
        """
        rows = self.rows + other.rows
        share = other.rows / np.maximum(rows, 1)
        step = other.mean - self.mean
        return TorqueSums(
            rows=rows,
            mean=self.mean + share * step,
            spread=self.spread + other.spread + step**2 * self.rows * share,
            torque=self.torque + other.torque,
            residual=self.residual + other.residual,
            baselines={name: x + other.baselines[name] for name, x in self.baselines.items()},
        )

    def metrics(self, names: Sequence[str], units: Sequence[str]) -> Metrics:
        """Return the metrics computed from the sums."""
        if not self.rows.any():
            raise DataError(
                "the prediction error cannot be computed, 0 torque rows are used: no joint moves "
                "faster than min_velocity; lower min_velocity, or use a log with motion"
            )
        per_joint = {name: self._joint(j, units[j]) for j, name in enumerate(names) if self.rows[j]}
        return Metrics(per_joint, float(np.sqrt(self.residual.sum() / self.rows.sum())))

    def _joint(self, j: int, unit: str) -> JointMetrics:
        residual, spread = float(self.residual[j]), float(self.spread[j])
        return JointMetrics(
            rmse=float(np.sqrt(residual / self.rows[j])),
            unit=unit,
            relative_error_pct=self._relative_error(j, residual),
            r2=1.0 - residual / spread if spread > 0 else 0.0,
            rows=int(self.rows[j]),
            baselines={x: self._relative_error(j, float(s[j])) for x, s in self.baselines.items()},
            better_than_constant=residual < spread,
        )

    def _relative_error(self, j: int, residual: float) -> float | None:
        return 100.0 * float(np.sqrt(residual / self.torque[j])) if self.torque[j] > 0 else None
