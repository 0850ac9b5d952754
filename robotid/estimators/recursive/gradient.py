"""Normalised gradient (NLMS), the cheapest recursive estimator."""

from dataclasses import dataclass, replace

import numpy as np

from robotid._typing import Array
from robotid.estimators.estimator import Estimate
from robotid.estimators.recursive.base import RecursiveEstimator, as_problem
from robotid.estimators.recursive.descent import (
    DescentState,
    Rows,
    advance,
    column_scale,
    descent_estimate,
    run_passes,
    start_state,
)
from robotid.exceptions import DataError
from robotid.regressor.factors import Factors
from robotid.regressor.problem import Problem, Sample

__all__ = ["NormalisedGradient"]

_EPS2 = 1e-12  # a sample with |Psi|^2 below it carries no information


@dataclass(frozen=True, eq=False)
class NormalisedGradient(RecursiveEstimator[DescentState]):
    """Normalised gradient: theta <- theta - mu / (eps + |Psi|_F^2) Psi^T e, e = Psi theta - tau.

    Rows are in units of their noise. Without noise |theta~| never grows while 0 < mu < 2.

    Attributes:
        sigma: Noise level of each joint, shape (n,) [N m or N].
        prior: Parameters to start from, shape (c,); 0 if None.
        scale: Column scaling, shape (c,); None: ``fit`` takes the column norms, a state made by
            ``init`` has none.
        step_size: The relaxation mu, above 0 and below 2 [-].
        regularisation: The small number eps [-].
        average: Whether the estimate is the average of the iterates; wanted with noise.
        passes: Largest number of passes of ``fit``.
        rng: Source of the random order in which ``fit`` visits the samples; in the order of time
            if None.
        eps1: The gradient is 0 if its recent mean is within this norm, in scaled parameters.

    Raises:
        DataError: If a setting is out of its range.

    References:
        Goodwin, Sin (1984), Adaptive Filtering, Prediction and Control, 3.3.
    """

    sigma: Array
    prior: Array | None = None
    scale: Array | None = None
    step_size: float = 1.0
    regularisation: float = 1e-9
    average: bool = True
    passes: int = 4
    rng: np.random.Generator | None = None
    eps1: float = 1e-9

    def __post_init__(self) -> None:
        if not 0 < self.step_size < 2:
            raise DataError(f"step_size is {self.step_size}, wanted above 0 and below 2")
        for name in ("passes", "eps1", "regularisation"):
            if not getattr(self, name) > 0:
                raise DataError(f"{name} is {getattr(self, name)}, wanted a positive number")

    def init(self, c: int) -> DescentState:
        """Return the state before any sample; see ``RecursiveEstimator.init``.

        Args:
            c: Number of parameters.

        Returns:
            The state.
        """
        return start_state(c, len(self.sigma), self.prior, self.scale)

    def update(self, state: DescentState, sample: Sample) -> DescentState:
        """Return the state after one more sample; see ``RecursiveEstimator.update``.

        Args:
            state: The state before.
            sample: One instant.

        Returns:
            The state after.

        Raises:
            DataError: If the sample is not finite or of another shape; the state stays valid.
        """

        def step(Psi: Array, e: Array, used: Rows) -> Array:
            change: Array = self.step_size / (self.regularisation + np.vdot(Psi, Psi)) * (e @ Psi)
            return change

        return advance(
            state, sample, self.sigma, self.scale, step, average=self.average, eps2=_EPS2
        )

    def estimate(self, state: DescentState, names: tuple[str, ...]) -> Estimate:
        """Return the estimate that a state holds; see ``RecursiveEstimator.estimate``.

        Args:
            state: The state.
            names: Names of the c parameters.

        Returns:
            The estimate; its covariance is infinite, because a gradient does not learn it.
        """
        return descent_estimate(state, self.scale, names, self.eps1)

    def fit(self, data: Problem | Factors) -> Estimate:
        """Visit the samples of a problem, until the gradient is 0; see ``Estimator.fit``.

        Args:
            data: A problem in base parameters.

        Returns:
            The estimate after the last sample.

        Raises:
            DataError: If there are fewer rows than parameters, or a sample is not finite.
        """
        problem = as_problem(data)
        scale = column_scale(problem, self.sigma) if self.scale is None else self.scale
        estimator = replace(self, scale=scale)
        state, converged = run_passes(
            estimator.update,
            estimator.init(len(problem.names)),
            problem,
            self.sigma,
            passes=self.passes,
            rng=self.rng,
            eps1=self.eps1,
        )
        return replace(estimator.estimate(state, problem.names), converged=converged)
