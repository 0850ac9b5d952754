"""The interface of estimators and what they return."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TypeAlias, TypeVar

import numpy as np

from robotid._typing import Array
from robotid.estimators.segments import quantile
from robotid.exceptions import DataError
from robotid.pages.html import code, number, table
from robotid.regressor.factors import Factors, compress
from robotid.regressor.problem import Problem

if TYPE_CHECKING:
    from robotid.estimators.consistent.fit import Consistent

__all__ = ["BatchEstimator", "Estimate", "Estimator", "Weighing", "require_rows"]

DataT = TypeVar("DataT", contravariant=True)

#: "alike"; "by joint", each by its noise level; "by age", as of a filter that forgets or gates; or
#: "by step", as of a gradient method, which ends beside the minimum of least squares.
Weighing: TypeAlias = Literal["alike", "by joint", "by age", "by step"]


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimated parameters and how well they are known.

    Attributes:
        theta: Parameters, shape (c,), SI units.
        covariance: Their covariance, shape (c, c); infinite variance where the data say nothing.
        names: Their names.
        sigma: Standard deviation of the torque residual per joint, shape (n,) [N m or N].
        rank: Number of directions that the data determine.
        condition: Condition number of the columns scaled to unit norm, over those directions.
        undetermined: Names of the parameters that the data leave open.
        converged: Whether the iteration ended by its own criterion.
        n_iter: Number of iterations.
        message: What the estimator says of its run.
        prior_std: Standard deviation of each parameter before the data, shape (c,), or None.
        details: How it was fitted, plain values by name: prior, constraints, solver.
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

    def _repr_html_(self) -> str:
        rows = [
            [code(name), number(float(value)), number(float(error), ".2g")]
            for name, value, error in self._rows
        ]
        head = escape(f"{self._line}; {self.message}")
        return f"<p>{head}</p>\n" + table("Parameters", ["name", "value", "standard error"], rows)

    def summary(self) -> str:
        """Return the parameters with their standard errors as text, one a line."""
        width = max(len(name) for name in self.names)
        rows = [f"  {name:{width}} {x:12.4g} +- {error:.2g}" for name, x, error in self._rows]
        return "\n".join([self._line, self.message, *rows])

    __str__ = summary

    @property
    def std_error(self) -> Array:
        """Standard error of each parameter, shape (c,); inf where the data say nothing."""
        # exact data leave a variance of rounding size, of either sign
        errors: Array = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return errors

    @property
    def quantile(self) -> Array:
        """How many standard errors a 95 % interval reaches, by Student's quantile, shape (c,).

        ``details`` has the degrees of freedom, ``freedom``, of errors from a scatter.
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

    @property
    def _rows(self) -> Iterator[tuple[str, float, float]]:
        return zip(self.names, self.theta, self.std_error, strict=True)


class Estimator(ABC, Generic[DataT]):
    """Settings go into the constructor, data only into ``fit``.

    Attributes:
        reads: What it needs of the data: the "factors" that all rows come down to, the "samples"
            one by one, or a "simulator" that is compared with them.
    """

    reads: ClassVar[Literal["factors", "samples", "simulator"]]

    @property
    def needs_mass(self) -> bool:
        """Whether each sample must carry the regressor of the mass matrix."""
        return False

    @property
    def weighing(self) -> Weighing:
        """How the rows weigh, which decides what their scatter says of the standard errors."""
        return "by joint"

    @property
    def in_cone(self) -> "Consistent | None":
        """The physically consistent fit whose bounds it keeps to, if it is one."""
        return None

    @abstractmethod
    def fit(self, data: DataT) -> Estimate:
        """Estimate the parameters.

        Args:
            data: A problem in base parameters; of a batch estimator also its factors. Of one that
                reads a simulator, the simulator.

        Raises:
            DataError: If there are fewer rows than parameters, or a row cannot be used.
            RankDeficientError: If the data leave parameters open and there is no prior.
            NotConvergedError: If an iteration or a solver does not end.
        """


class BatchEstimator(Estimator[Problem | Factors]):
    """An estimator to which the factors of the rows are enough."""

    reads: ClassVar[Literal["factors"]] = "factors"

    def fit(self, data: Problem | Factors) -> Estimate:
        factors = compress(data) if isinstance(data, Problem) else data
        require_rows(int(factors.rows.sum()), len(factors.names), len(factors.rows))
        return self._fit(factors)

    @abstractmethod
    def _fit(self, factors: Factors) -> Estimate:
        """Estimate the parameters from at least as many rows."""


def require_rows(rows: int, columns: int, n_joints: int) -> None:
    """Refuse fewer rows than parameters: a perfect fit would mean nothing.

    Args:
        rows: Number of rows used.
        columns: Number of parameters.
        n_joints: Rows per sample.

    Raises:
        DataError: If there are fewer rows than parameters.
    """
    if rows == 0:
        raise DataError(
            f"0 torque rows for {columns} parameters: no joint moves faster than min_velocity, or "
            "trim leaves nothing of the logs ([signals]); record a motion of every joint"
        )
    if rows < columns:
        raise DataError(
            f"{rows} torque rows for {columns} parameters: too few rows to fit; record at least "
            f"{-(-10 * columns // n_joints)} samples, or loosen min_velocity and trim"
        )
