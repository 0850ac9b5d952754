"""The interface of estimators and their result."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, Literal, TypeAlias, TypeVar

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.typing import Array
from robotid.dynamics.factors import Factors, compress
from robotid.dynamics.problem import Problem
from robotid.estimation.estimators.segments import quantile

DataT = TypeVar("DataT", contravariant=True)

#: Weights of rows: "alike", all equal; "by joint", by the noise level; "by age", of a filter with
#: forgetting or a gate; "by step", of a gradient method, which ends near the least squares minimum.
Weighing: TypeAlias = Literal["alike", "by joint", "by age", "by step"]


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimated parameters and their uncertainty.

    Attributes:
        theta: Parameters, shape (c,), SI units.
        covariance: Their covariance, shape (c, c); infinite variance if not identifiable.
        names: Their names.
        sigma: Standard deviation of the torque residual per joint, shape (n,) [N m or N].
        rank: Number of identifiable directions.
        condition: Condition number over those directions, columns scaled to unit norm.
        undetermined: Names of the parameters that are not identifiable.
        converged: Whether the iteration met its convergence criterion.
        n_iter: Number of iterations.
        message: Summary of the run of the estimator.
        prior_std: Prior standard deviation of each parameter, shape (c,), or None.
        details: Settings and results of the fit as plain values by name: prior, constraints,
            solver.
    """

    theta: Array
    covariance: Array
    names: tuple[str, ...]
    sigma: Array
    rank: int
    condition: float
    undetermined: tuple[str, ...]
    converged: bool
    n_iter: int
    message: str
    prior_std: Array | None = None
    details: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<{self._line}>"

    def summary(self) -> str:
        """Return the parameters with their standard errors as text, one per line."""
        width = max(len(name) for name in self.names)
        rows = [
            f"  {name:{width}} {value:12.4g} +- {error:.2g}"
            for name, value, error in zip(self.names, self.theta, self.std_error, strict=True)
        ]
        return "\n".join([self._line, self.message, *rows])

    __str__ = summary

    @property
    def std_error(self) -> Array:
        """Standard error of each parameter, shape (c,); inf if not identifiable."""
        # noise-free data give a variance of rounding size, of either sign
        errors: Array = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return errors

    @property
    def quantile(self) -> Array:
        """Half-width of the 95 % intervals in standard errors, Student's quantile, shape (c,).

        ``details["freedom"]`` has the degrees of freedom if standard errors are from a scatter.
        """
        freedom = self.details.get("freedom", np.inf)
        return quantile(np.broadcast_to(np.asarray(freedom, dtype=float), len(self.theta)))

    @property
    def _line(self) -> str:
        state = "converged" if self.converged else "not converged"
        return (
            f"Estimate: {len(self.names)} parameters, rank {self.rank}, condition "
            f"{self.condition:.3g}, {state}"
        )


class Estimator(ABC, Generic[DataT]):
    """Interface of estimators: settings are constructor arguments, data arguments of ``fit``.

    Attributes:
        reads: Form of the data that it needs: triangular "factors" of all rows, the "samples" one
            by one, or a "simulator" that is compared with the data.
    """

    reads: ClassVar[Literal["factors", "samples", "simulator"]]

    @property
    def needs_mass(self) -> bool:
        """Whether each sample must have the regressor of the mass matrix."""
        return False

    @property
    def weighing(self) -> Weighing:
        """Weights of the rows, which determine how standard errors follow from their scatter."""
        return "by joint"

    @abstractmethod
    def fit(self, data: DataT) -> Estimate:
        """Estimate the parameters.

        Args:
            data: A problem in base parameters; for a batch estimator also its factors; for an
                estimator that reads a simulator, the simulator.

        Raises:
            DataError: If there are fewer rows than parameters, or a row cannot be used.
            RankDeficientError: If parameters are not identifiable and there is no prior.
            NotConvergedError: If an iteration or a solver does not converge.
        """


class BatchEstimator(Estimator[Problem | Factors]):
    """An estimator that needs only the triangular factors of the rows."""

    reads: ClassVar[Literal["factors"]] = "factors"

    def fit(self, data: Problem | Factors) -> Estimate:
        factors = compress(data) if isinstance(data, Problem) else data
        require_rows(int(factors.rows.sum()), len(factors.names), len(factors.rows))
        return self._fit(factors)

    @abstractmethod
    def _fit(self, factors: Factors) -> Estimate:
        """Estimate the parameters from at least as many rows."""


def require_rows(rows: int, columns: int, n_joints: int) -> None:
    """Raise an error if there are fewer rows than parameters."""
    if rows == 0:
        raise DataError(
            f"0 torque rows for {columns} parameters: no joint moves faster than min_velocity, or "
            "trim removes all rows ([signals]); record a motion of every joint"
        )
    if rows < columns:
        raise DataError(
            f"{rows} torque rows for {columns} parameters: too few rows to fit; record at least "
            f"{-(-10 * columns // n_joints)} samples, or reduce min_velocity and trim"
        )
