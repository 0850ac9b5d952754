"""The paper's recursive estimator: a step along PRX, the gradient of the criterion."""

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

__all__ = ["PRX"]

_SMALLEST = 1e-6  # eigenvalues of D(q, P^) below this share of the largest are raised to it
_RIDGE = 1e-9  # of metric "rows": rows that depend on each other stay soluble


@dataclass(frozen=True, eq=False)
class PRX(RecursiveEstimator[DescentState]):
    """The paper's update P^ <- P^ - gamma Psi^T eta (24), with e = Psi P^ - tau and eta = M e.

    * step "printed": eta = D^-1 e, gamma = sigma_D / |Psi|_F^2, sigma_D the smallest eigenvalue of
      D(q, P^). On an arm of six joints it hardly moves.
    * step "exact": gamma = e^T eta / |Psi^T eta|^2, the minimiser of |P~| along the direction.

    Without noise |P~| never grows: with "exact" for any positive definite M, with "printed" while
    sigma_min(D(q, P^)) <= 2 sigma_min(D(q, P)). With column scaling that is the norm of
    scale * P~.

    With noise each iterate jumps about as far as the noise of its own sample. On the recordings of
    a UR10e and a Panda the last iterate predicts 1.3 to 1.9 times worse than weighted least
    squares; the average of the iterates, the k-th weighted by k^2, 1.03 to 1.05 times after one
    pass. Steps that shrink as 1/k came to 1.03 to 1.2, depending on their rate, and a dead zone of
    the size of the noise to 1.1 to 1.7; so ``average`` takes the average.

    Attributes:
        sigma: Noise level of each joint, shape (n,) [N m or N]: the metric "noise" is made of it.
        prior: Parameters to start from, shape (c,); 0 if None.
        scale: Column scaling, shape (c,); None: ``fit`` takes the column norms of step "exact", a
            state made by ``init`` has none.
        step: "exact" or "printed".
        metric: Of step "exact": "noise" for M = diag(sigma^-2); "mass" for M = D(q, P^)^-1, as
            printed; "rows" for M = (Psi Psi^T)^-1, which fits a sample's rows all at once.
        average: Whether the estimate is the average of the iterates; wanted with noise.
        passes: Largest number of passes of ``fit``.
        rng: Source of the random order in which ``fit`` visits the samples; in the order of time
            if None.
        bounds: Radius of the set Omega (8) about the prior in scaled parameters; None for none.
        eps1: PRX = 0 if its recent mean is within this norm, in scaled parameters.
        eps2: Samples with |Psi|^2 <= eps2 are skipped.

    Raises:
        DataError: If a setting is out of its range.

    References:
        Tzvetkova, Extracting Inertial Parameters from Robotic Manipulators Dynamics, (20)-(25).
    """

    sigma: Array
    prior: Array | None = None
    scale: Array | None = None
    step: str = "exact"
    metric: str = "noise"
    average: bool = True
    passes: int = 4
    rng: np.random.Generator | None = None
    bounds: float | None = None
    eps1: float = 1e-9
    eps2: float = 1e-12

    def __post_init__(self) -> None:
        if self.step not in ("exact", "printed"):
            raise DataError(f"step is {self.step!r}, wanted 'exact' or 'printed'")
        if self.metric not in ("noise", "mass", "rows"):
            raise DataError(f"metric is {self.metric!r}, wanted 'noise', 'mass' or 'rows'")
        for name in ("passes", "eps1", "eps2", "bounds"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise DataError(f"{name} is {value}, wanted a positive number")

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
            sample: One instant, with the mass regressor for step "printed" and metric "mass".

        Returns:
            The state after.

        Raises:
            DataError: If the sample is not finite, of another shape, or lacks the mass regressor;
                the state stays valid.
        """

        def step(Psi: Array, e: Array, used: Rows) -> Array:
            if self.step == "printed" or self.metric == "mass":
                return self._massive_step(state, sample, used)
            if self.metric == "noise":
                return _exact(Psi, e, e)
            A = Psi @ Psi.T
            A.flat[:: len(A) + 1] += _RIDGE * np.trace(A)
            return _exact(Psi, e, np.linalg.solve(A, e))

        moved = advance(
            state, sample, self.sigma, self.scale, step, average=self.average, eps2=self.eps2
        )
        return moved if self.bounds is None else self._bounded(moved)

    def estimate(self, state: DescentState, names: tuple[str, ...]) -> Estimate:
        """Return the estimate that a state holds; see ``RecursiveEstimator.estimate``.

        Args:
            state: The state.
            names: Names of the c parameters.

        Returns:
            The estimate; its covariance is infinite, because PRX does not learn it.
        """
        return descent_estimate(state, self.scale, names, self.eps1)

    def fit(self, data: Problem | Factors) -> Estimate:
        """Visit the samples of a problem, until PRX = 0; see ``Estimator.fit``.

        Args:
            data: A problem in base parameters.

        Returns:
            The estimate after the last sample.

        Raises:
            DataError: If there are fewer rows than parameters, or a sample cannot be used.
        """
        problem = as_problem(data)
        estimator = self
        if self.scale is None and self.step == "exact":
            estimator = replace(self, scale=column_scale(problem, self.sigma))
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

    def _massive_step(self, state: DescentState, sample: Sample, used: Rows) -> Array:
        """Return the step with eta = D^-1 e (20), rows as the paper has them."""
        Psi = sample.Y[used] if self.scale is None else sample.Y[used] / self.scale
        values, vectors = self._inertia(state, sample)
        e = np.zeros(len(values))
        e[used] = Psi @ state.x - sample.tau[used]
        eta = vectors @ ((e @ vectors) / values)  # D^-1 e
        if self.step == "exact":
            return _exact(Psi, e[used], eta[used])
        gamma = values[0] / np.vdot(Psi, Psi)  # sigma_D / |Psi|_F^2
        printed: Array = gamma * (eta[used] @ Psi)  # (24)
        return printed

    def _inertia(self, state: DescentState, sample: Sample) -> tuple[Array, Array]:
        """Return eigenvalues and eigenvectors of D(q, P^), which is linear in P^ (11).

        Any positive definite D keeps the proof, so an estimate that makes it indefinite on its way
        costs nothing: small and negative eigenvalues are raised.
        """
        if sample.mass_regressor is None:
            raise DataError(
                "PRX needs the mass regressor of each sample; build the problem with "
                "build_problem(..., with_mass=True)"
            )
        theta = state.x if self.scale is None else state.x / self.scale
        D = sample.mass_regressor @ theta  # (n, n)
        if not np.isfinite(D).all():
            raise DataError("the mass regressor of the sample is not finite, so it was refused")
        values, vectors = np.linalg.eigh((D + D.T) / 2)
        largest = float(np.abs(values).max())
        return np.maximum(values, _SMALLEST * largest if largest > 0 else 1.0), vectors

    def _bounded(self, state: DescentState) -> DescentState:
        """Return the state with P^ projected onto Omega (8), a ball about the prior."""
        centre = self.init(len(state.x)).x
        away = state.x - centre
        distance = float(np.linalg.norm(away))
        if self.bounds is None or distance <= self.bounds:
            return state
        x = centre + away * (self.bounds / distance)
        return replace(state, x=x, mean=state.mean if self.average else x)


def _exact(Psi: Array, e: Array, eta: Array) -> Array:
    """Return gamma* Psi^T eta, gamma* = e^T eta / |Psi^T eta|^2: the nearest point to P."""
    direction = eta @ Psi
    square = direction @ direction
    gamma = (e @ eta) / square if square > 0 else 0.0
    step: Array = gamma * direction
    return step
