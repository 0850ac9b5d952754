"""How far parameters are from their prior values: three metrics, all free of units.

Each penalty is about |delta / sigma|^2 near the prior, so that one weight means the same for all.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.robot.parameters import (
    ParameterLayout,
    inertial_from_pseudo_inertia,
    pseudo_inertia,
    pseudo_inertia_basis,
)

__all__ = [
    "METRICS",
    "Penalty",
    "Quadratic",
    "WeightChoice",
    "body_units",
    "make_penalty",
    "pull_back_metric",
]

METRICS = ("euclidean", "entropic", "riemannian")
_THINNEST = 0.01  # a prior's pseudo-inertia is not thinner than that, relative to its body's size


@dataclass(frozen=True)
class WeightChoice:
    """How the weight of the prior was chosen.

    Attributes:
        weight: The weight [-].
        how: "cv" or "evidence".
        curve: Pairs of weight and score, ascending: prediction error of held-out stretches over
            the noise level ("cv"), or minus the log evidence; smaller is better.
    """

    weight: float
    how: str
    curve: tuple[tuple[float, float], ...]


class Penalty(ABC):
    """A convex penalty on the distance from the prior.

    Attributes:
        is_quadratic: Whether its Hessian is the same everywhere.
        centre: Where it is 0, shape (p,).
    """

    is_quadratic: ClassVar[bool]
    centre: Array

    @abstractmethod
    def value(self, pi: Array) -> float:
        """Return the penalty, at least 0; infinite where the metric is not defined.

        Args:
            pi: Standard parameters, shape (p,).
        """

    @abstractmethod
    def gradient(self, pi: Array) -> Array:
        """Return its gradient, shape (p,).

        Args:
            pi: Standard parameters, shape (p,).
        """

    @abstractmethod
    def hessian(self, pi: Array) -> Array:
        """Return its second derivative, shape (p, p), positive definite.

        Args:
            pi: Standard parameters, shape (p,).
        """


@dataclass(frozen=True, eq=False)
class Quadratic(Penalty):
    """(pi - centre)^T M (pi - centre).

    Attributes:
        centre: Prior values, shape (p,).
        M: Metric, shape (p, p), positive definite.
    """

    is_quadratic = True
    centre: Array
    M: Array

    def value(self, pi: Array) -> float:
        return float((pi - self.centre) @ self.M @ (pi - self.centre))

    def gradient(self, pi: Array) -> Array:
        slope: Array = 2.0 * self.M @ (pi - self.centre)
        return slope

    def hessian(self, pi: Array) -> Array:
        return 2.0 * self.M


@dataclass(frozen=True, eq=False)
class _Entropic(Penalty):
    """2 sum_i d(J_i || P_i) of the bodies, and |(pi - centre) / std|^2 of the drives.

    d(J || P) = tr(P^-1 J) - log det(P^-1 J) - 4 is the Bregman divergence of -log det, half the
    Kullback-Leibler distance of two mass distributions seen as Gaussians, times 4.

    Attributes:
        centre: Prior values, shape (p,).
        precision: 1 / std^2 of the drives, shape (drives,).
        held: Known share of each body, shape (10 bodies,).
    """

    is_quadratic = False
    centre: Array
    precision: Array
    held: Array

    def value(self, pi: Array) -> float:
        J, P = self._rest(pi), self._rest(self.centre)
        if np.linalg.eigvalsh(J)[:, 0].min() <= 0:
            return float("inf")
        ratio = np.linalg.solve(P, J)
        trace = np.trace(ratio, axis1=1, axis2=2)
        divergence = trace - np.linalg.slogdet(ratio)[1] - 4.0
        return float(2.0 * divergence.sum() + self.precision @ self._drives(pi) ** 2)

    def gradient(self, pi: Array) -> Array:
        J, P = self._rest(pi), self._rest(self.centre)
        slope = np.linalg.inv(P) - np.linalg.inv(J)
        inertial = 2.0 * np.einsum("nij,kij->nk", slope, pseudo_inertia_basis()).reshape(-1)
        return np.concatenate([inertial, 2.0 * self.precision * self._drives(pi)])

    def hessian(self, pi: Array) -> Array:
        inertial = pull_back_metric(self._rest(pi))
        H: Array = 2.0 * scipy.linalg.block_diag(*inertial, np.diag(self.precision))
        return H

    def _rest(self, pi: Array) -> Array:
        return pseudo_inertia(pi[: len(self.held)] - self.held)

    def _drives(self, pi: Array) -> Array:
        return (pi - self.centre)[len(self.held) :]


def make_penalty(
    metric: str, layout: ParameterLayout, prior: Array, prior_std: Array, held: Array
) -> Penalty:
    """Return the penalty of a metric.

    * "euclidean": |(pi - prior) / prior_std|^2;
    * "entropic": twice the Bregman divergence of -log det between the pseudo-inertias of each
      body and its prior;
    * "riemannian": delta^T g delta with g of ``pull_back_metric`` at the prior, half the
      Hessian of the entropic one there.

    The latter two do not depend on the frame a body is stated in; the drives stay Euclidean. A
    prior that is not possible, or thinner than 1 % of its body's size, is widened to that first.

    Args:
        metric: One of ``METRICS``.
        layout: The standard parameters.
        prior: Prior values, shape (p,).
        prior_std: How far they may plausibly be wrong, shape (p,).
        held: Known share of each body, shape (10 bodies,).

    References:
        Lee, Wensing, Park (2019), Geometric robot dynamic identification: a convex programming
        approach, (24), (32).
    """
    if metric == "euclidean":
        return Quadratic(prior, np.diag(prior_std**-2.0))
    size = layout.n_inertial
    P = _widened(pseudo_inertia(prior[:size] - held), body_units(prior_std[:size]))
    rest = [inertial_from_pseudo_inertia(P_i) for P_i in P]
    repaired = np.concatenate([np.concatenate(rest) + held, prior[size:]])
    precision = prior_std[size:] ** -2.0
    if metric == "entropic":
        return _Entropic(repaired, precision, held)
    M = scipy.linalg.block_diag(*pull_back_metric(P), np.diag(precision))
    return Quadratic(repaired, M)


def pull_back_metric(J: Array) -> Array:
    """Return the affine-invariant metrics g_kl = tr(J^-1 B_k J^-1 B_l), shape (n, 10, 10).

    Args:
        J: Pseudo-inertias, shape (n, 4, 4), positive definite.

    References:
        Lee, Wensing, Park (2019), as of ``make_penalty``, (22).
    """
    slopes = np.linalg.solve(J[:, None], pseudo_inertia_basis()[None])  # (n, 10, 4, 4)
    metric: Array = np.einsum("nkij,nlji->nkl", slopes, slopes)
    return metric


def body_units(spread: Array) -> Array:
    """Return T^-1/2, which makes pseudo-inertias free of units: diagonal, shape (bodies, 4, 4).

    Args:
        spread: How far the inertial parameters may lie from their prior, shape (10 bodies,): mass
            m and radius r of a body's size are those of m and m r.
    """
    by_body = spread.reshape(-1, 10)
    mass, radius = by_body[:, 0], by_body[:, 1] / by_body[:, 0]
    diagonal = np.column_stack([1 / radius] * 3 + [np.ones_like(mass)])
    return np.eye(4) * (diagonal / np.sqrt(mass)[:, None])[:, None, :]


def _widened(J: Array, shrink: Array) -> Array:
    """Return pseudo-inertias whose smallest eigenvalue, free of units, is at least 1 %."""
    values, vectors = np.linalg.eigh(shrink @ J @ shrink)
    floored = (vectors * np.maximum(values, _THINNEST)[:, None]) @ vectors.transpose(0, 2, 1)
    grow = np.linalg.inv(shrink)
    changed = values[:, 0] < _THINNEST
    return np.where(changed[:, None, None], grow @ floored @ grow, J)
