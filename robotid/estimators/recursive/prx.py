"""The paper's recursive estimator: a step along PRX, the gradient of the criterion."""

from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.estimators.recursive.descent import Descent, Rows
from robotid.exceptions import DataError
from robotid.regressor.problem import Sample

__all__ = ["PRX"]

_SMALLEST = 1e-6  # eigenvalues of D(q, P^) below this share of the largest are raised to it
_RIDGE = 1e-9  # of metric "rows": rows that depend on each other stay soluble


@dataclass(frozen=True, eq=False)
class PRX(Descent):
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

    ``fit`` scales the columns of step "exact" only.

    Attributes:
        step: "exact" or "printed".
        metric: Of step "exact": "noise" for M = diag(sigma^-2); "mass" for M = D(q, P^)^-1, as
            printed; "rows" for M = (Psi Psi^T)^-1, which fits a sample's rows all at once.
        bounds: Radius of the set Omega (8) about the prior in scaled parameters; None for none.

    References:
        Tzvetkova, Extracting Inertial Parameters from Robotic Manipulators Dynamics, (20)-(25).
    """

    step: str = "exact"
    metric: str = "noise"
    bounds: float | None = None

    @property
    def needs_mass(self) -> bool:
        return self.step == "printed" or self.metric == "mass"

    @property
    def _takes_scale(self) -> bool:
        return self.step == "exact"

    def _check(self) -> None:
        if self.step not in ("exact", "printed"):
            raise DataError(f"step is {self.step!r}, wanted 'exact' or 'printed'")
        if self.metric not in ("noise", "mass", "rows"):
            raise DataError(f"metric is {self.metric!r}, wanted 'noise', 'mass' or 'rows'")
        if self.bounds is not None and not self.bounds > 0:
            raise DataError(f"bounds is {self.bounds}, wanted a positive number")

    def _moved(self, x: Array, Psi: Array, e: Array, used: Rows, sample: Sample) -> Array:
        if self.needs_mass:
            step = self._massive_step(x, sample, used)
        elif self.metric == "noise":
            step = _exact(Psi, e, e)
        else:
            A = Psi @ Psi.T
            A.flat[:: len(A) + 1] += _RIDGE * np.trace(A)
            step = _exact(Psi, e, np.linalg.solve(A, e))
        moved: Array = x - step
        return moved if self.bounds is None else self._bounded(moved, self.bounds)

    def _massive_step(self, x: Array, sample: Sample, used: Rows) -> Array:
        """Return the step with eta = D^-1 e (20), rows as the paper has them."""
        Psi = sample.Y[used] / self._unit
        values, vectors = self._inertia(x, sample)
        e = np.zeros(len(values))
        e[used] = Psi @ x - sample.tau[used]
        eta = vectors @ ((e @ vectors) / values)  # D^-1 e
        if self.step == "exact":
            return _exact(Psi, e[used], eta[used])
        gamma = values[0] / np.vdot(Psi, Psi)  # sigma_D / |Psi|_F^2
        printed: Array = gamma * (eta[used] @ Psi)  # (24)
        return printed

    def _inertia(self, x: Array, sample: Sample) -> tuple[Array, Array]:
        """Return eigenvalues and eigenvectors of D(q, P^), which is linear in P^ (11).

        Any positive definite D keeps the proof, so an estimate that makes it indefinite on its way
        costs nothing: small and negative eigenvalues are raised.
        """
        if sample.mass_regressor is None:
            raise DataError(
                "PRX needs the mass regressor of each sample; build the problem with "
                "build_problem(..., with_mass=True)"
            )
        D = sample.mass_regressor @ (x / self._unit)  # (n, n)
        if not np.isfinite(D).all():
            raise DataError("the mass regressor of the sample is not finite, so it was refused")
        values, vectors = np.linalg.eigh((D + D.T) / 2)
        largest = float(np.abs(values).max())
        return np.maximum(values, _SMALLEST * largest if largest > 0 else 1.0), vectors

    def _bounded(self, x: Array, radius: float) -> Array:
        """Return P^ projected onto Omega (8), a ball about the prior."""
        centre = self.init(len(x)).x
        away = x - centre
        distance = float(np.linalg.norm(away))
        return x if distance <= radius else centre + away * (radius / distance)


def _exact(Psi: Array, e: Array, eta: Array) -> Array:
    """Return gamma* Psi^T eta, gamma* = e^T eta / |Psi^T eta|^2: the nearest point to P."""
    direction = eta @ Psi
    square = direction @ direction
    gamma = (e @ eta) / square if square > 0 else 0.0
    return gamma * direction
