"""The interface of estimators and what they return."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np

from robotid._html import code, number, table
from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.regressor.factors import Factors, compress
from robotid.regressor.problem import Problem

__all__ = [
    "Estimate",
    "Estimator",
    "as_factors",
    "estimate_html",
    "estimate_line",
    "estimate_text",
    "require_rows",
]


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
        return estimate_line(self)

    def _repr_html_(self) -> str:
        return estimate_html(self)

    def summary(self) -> str:
        """Return the parameters with their standard errors as text."""
        return estimate_text(self)

    __str__ = summary

    @property
    def std_error(self) -> Array:
        """Standard error of each parameter, shape (c,); inf where the data say nothing."""
        errors: Array = np.sqrt(np.diag(self.covariance))
        return errors


class Estimator(ABC):
    """Settings go into the constructor, data only into ``fit``."""

    @abstractmethod
    def fit(self, data: Problem | Factors) -> Estimate:
        """Estimate the parameters.

        Args:
            data: A problem in base parameters, or its factors.

        Returns:
            The estimate.

        Raises:
            DataError: If there are fewer rows than parameters.
        """


def as_factors(data: Problem | Factors) -> Factors:
    """Return the factors of the data, and refuse data that cannot determine anything.

    Args:
        data: A problem or its factors.

    Returns:
        The factors.

    Raises:
        DataError: If there are fewer rows than parameters: a perfect fit would mean nothing.
    """
    factors = compress(data) if isinstance(data, Problem) else data
    require_rows(int(factors.rows.sum()), len(factors.names), len(factors.rows))
    return factors


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


def estimate_line(estimate: Estimate) -> str:
    """Return an estimate in one line.

    Args:
        estimate: The estimate.

    Returns:
        One line.
    """
    state = "converged" if estimate.converged else "not converged"
    return (
        f"<Estimate: {len(estimate.names)} parameters, rank {estimate.rank}, condition "
        f"{estimate.condition:.3g}, {state}>"
    )


def estimate_text(estimate: Estimate) -> str:
    """Return an estimate as text: one parameter a line.

    Args:
        estimate: The estimate.

    Returns:
        Lines.
    """
    width = max(len(name) for name in estimate.names)
    lines = [estimate_line(estimate)[1:-1], estimate.message]
    lines += [
        f"  {name:{width}} {value:12.4g} +- {error:.2g}"
        for name, value, error in zip(
            estimate.names, estimate.theta, estimate.std_error, strict=True
        )
    ]
    return "\n".join(lines)


def estimate_html(estimate: Estimate) -> str:
    """Return an estimate as HTML.

    Args:
        estimate: The estimate.

    Returns:
        A table of the parameters.
    """
    rows = [
        [code(name), number(float(value)), number(float(error), ".2g")]
        for name, value, error in zip(
            estimate.names, estimate.theta, estimate.std_error, strict=True
        )
    ]
    head = escape(f"{estimate_line(estimate)[1:-1]}; {estimate.message}")
    return f"<p>{head}</p>\n" + table("Parameters", ["name", "value", "standard error"], rows)
