"""Interface of a simulator whose outputs an estimator compares with measured ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from robotid.base.typing import Array


@dataclass(frozen=True, eq=False)
class Residual:
    """Measured minus simulated output over one window, for joints that are simulated together.

    Attributes:
        e: Residual, shape (N, k) [rad or m].
        slopes: Derivatives of the simulated output by the parameters, shape (N, k, c'); None if
            not requested.
        joints: Indices of the joints, shape (k,).
        columns: Indices of the parameters, shape (c',).
        by_start: Derivatives by the initial state of the window's simulation, shape (N, k, s); None
            or s = 0 if it is known, or if they are not requested.
    """

    e: Array
    slopes: Array | None
    joints: Array
    columns: Array
    by_start: Array | None = None


class Simulator(Protocol):
    """Interface of a simulator and its parameters.

    Attributes:
        names: Names of the c parameters.
        prior: Prior values, shape (c,).
        prior_std: Prior standard deviations, shape (c,); infinite without prior knowledge.
        bounds: Lower and upper bounds, shape (2, c); infinite without a bound.
    """

    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def prior(self) -> Array: ...
    @property
    def prior_std(self) -> Array: ...
    @property
    def bounds(self) -> Array: ...

    def residuals(
        self, theta: Array, *, with_slopes: bool, with_starts: bool = False
    ) -> Sequence[Residual]:
        """Return measured minus simulated outputs, window by window: theta (c,)."""

    def rows(self, theta: Array) -> tuple[Array, Array]:
        """Return additional linearised residuals of unit weight, as those of torques.

        theta (c,) -> (m, c), (m,).
        """
