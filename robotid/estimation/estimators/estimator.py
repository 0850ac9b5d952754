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
    """Estimated parameters and their uncertainty, in SI units."""

    theta: Array  # (c,)
    covariance: Array  # (c, c); infinite variance if not identifiable
    names: tuple[str, ...]
    sigma: Array  # (n,), standard deviation of the residual per joint [N m or N]
    rank: int  # number of identifiable directions
    condition: float  # over those directions, columns scaled to unit norm
    undetermined: tuple[str, ...]  # names of the parameters that are not identifiable
    converged: bool
    n_iter: int
    message: str  # summary of the run of the estimator
    prior_std: Array | None = None  # (c,)
    details: Mapping[str, Any] = field(default_factory=dict)  # plain values: prior, constraints

    def summary(self) -> str:
        """Return the parameters with their standard errors as text, one per line."""
        width = max(len(name) for name in self.names)
        rows = [
            f"  {name:{width}} {value:12.4g} +- {error:.2g}"
            for name, value, error in zip(self.names, self.theta, self.std_error, strict=True)
        ]
        state = "converged" if self.converged else "not converged"
        head = f"{len(self.names)} parameters, rank {self.rank}, condition {self.condition:.3g}"
        return "\n".join([f"Estimate: {head}, {state}", self.message, *rows])

    __str__ = summary

    def __repr__(self) -> str:
        return f"<{self.summary().splitlines()[0]}>"

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
        """Estimate the parameters from a problem in base parameters, its factors or a simulator.

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
