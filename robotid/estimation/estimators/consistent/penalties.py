"""The distance of parameters from their prior values: three dimensionless metrics.

Near the prior each penalty is about |delta / sigma|^2, so a weight has the same meaning for all.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import scipy.linalg

from robotid.base.typing import Array
from robotid.estimation.estimators.consistent.cones import svec
from robotid.robot.parameters import (
    ParameterLayout,
    inertial_from_pseudo_inertia,
    pseudo_inertia,
    pseudo_inertia_basis,
)

METRICS = ("euclidean", "entropic", "riemannian")
_SINGULAR = 1e-12  # ratio of the axes of a body, squared, below which it is singular
_THINNEST = 0.01  # smallest relative thickness of a prior's pseudo-inertia


@dataclass(frozen=True)
class WeightChoice:
    """How the weight of the prior was chosen.

    Attributes:
        weight: The weight [-].
        how: "cv" or "evidence".
        curve: Pairs of weight and score, by ascending weight. The score is the prediction error of
            held-out segments over the noise level ("cv"), or minus the log evidence.
        plausible: The weight with the largest log evidence [-].
        loss: Largest ratio of the held-out error of a joint to that of least squares [-].
    """

    weight: float
    how: str
    curve: tuple[tuple[float, float], ...]
    plausible: float
    loss: float = 0.0


class Penalty(ABC):
    """A convex penalty on the distance from the prior.

    Attributes:
        is_quadratic: Whether its Hessian is constant.
        keeps_positive: Whether it is finite for positive definite pseudo-inertias only.
        centre: Parameters at which it is 0, shape (p,).
    """

    is_quadratic: ClassVar[bool]
    keeps_positive: ClassVar[bool] = False
    centre: Array

    @abstractmethod
    def value(self, pi: Array) -> float:
        """Return the penalty, at least 0; infinite if the metric is not defined: pi (p,)."""

    @abstractmethod
    def gradient(self, pi: Array) -> Array:
        """Return its gradient, shape (p,): pi (p,)."""

    @abstractmethod
    def root(self, pi: Array) -> Array:
        """Return S with S^T S half its second derivative, shape (p, p), upper triangular.

        For a thin body the root is computed directly: its second derivative has a condition number
        too large to be factorised.

        pi (p,).
        """

    def hessian(self, pi: Array) -> Array:
        """Return its second derivative, shape (p, p), positive definite: pi (p,)."""
        S = self.root(pi)
        H: Array = 2.0 * S.T @ S
        return H


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

    def root(self, pi: Array) -> Array:
        S: Array = scipy.linalg.cholesky(self.M)
        return S


@dataclass(frozen=True, eq=False)
class Entropic(Penalty):
    """2 sum_i d(J_i || P_i) of the bodies plus |(pi - centre) / std|^2 of the drives.

    d(J || P) = tr(P^-1 J) - log det(P^-1 J) - 4 is the Bregman divergence of -log det.

    Attributes:
        centre: Prior values, shape (p,).
        precision: 1 / std^2 of the drives, shape (drives,).
        held: Known part of each body, shape (10 bodies,).
    """

    is_quadratic = False
    keeps_positive = True
    centre: Array
    precision: Array
    held: Array

    def value(self, pi: Array) -> float:
        values = np.linalg.eigvalsh(self._ratio(pi))  # of P^-1 J
        if (values[:, 0] <= _SINGULAR * np.maximum(values[:, 3], 1.0)).any():
            return float("inf")
        divergence = (values - np.log(values) - 1.0).sum()
        return float(2.0 * divergence + self.precision @ self._drives(pi) ** 2)

    def gradient(self, pi: Array) -> Array:
        slope = np.linalg.inv(self.prior) - np.linalg.inv(self._rest(pi))
        inertial = 2.0 * np.einsum("nij,kij->nk", slope, pseudo_inertia_basis()).reshape(-1)
        return np.concatenate([inertial, 2.0 * self.precision * self._drives(pi)])

    def root(self, pi: Array) -> Array:
        L = self._prior_factor @ np.linalg.cholesky(self._ratio(pi))
        S: Array = scipy.linalg.block_diag(*metric_root(L), np.diag(np.sqrt(self.precision)))
        return S

    @cached_property
    def prior(self) -> Array:
        """The pseudo-inertias P of the prior without the known parts, shape (n, 4, 4)."""
        return self._rest(self.centre)

    @cached_property
    def _prior_factor(self) -> Array:
        """The factors L of the priors P = L L^T of the bodies."""
        return np.linalg.cholesky(self.prior)

    def _ratio(self, pi: Array) -> Array:
        """Return L^-1 J L^-T of each body, dimensionless, 1 at the prior P = L L^T."""
        return _whitened(self._rest(pi), self._prior_factor)

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

    The latter two do not depend on the frame of a body; for the drives they are Euclidean. If the
    pseudo-inertia of a prior is not physically consistent or its relative thickness is below 1 %,
    its eigenvalues are increased to 1 % first.

    References:
        Lee, Wensing, Park (2019), Geometric robot dynamic identification: a convex programming
        approach, (24), (32).

    prior (p,), prior_std (p,), held (10 bodies,).
    """
    if metric == "euclidean":
        return Quadratic(prior, np.diag(prior_std**-2.0))
    size = layout.n_inertial
    P = _widened(pseudo_inertia(prior[:size] - held), body_units(prior_std[:size]))
    repaired = np.concatenate([inertial_from_pseudo_inertia(P).reshape(-1) + held, prior[size:]])
    precision = prior_std[size:] ** -2.0
    if metric == "entropic":
        return Entropic(repaired, precision, held)
    M = scipy.linalg.block_diag(*pull_back_metric(P), np.diag(precision))
    return Quadratic(repaired, M)


def pull_back_metric(J: Array) -> Array:
    """Return the affine-invariant metrics g_kl = tr(J^-1 B_k J^-1 B_l), shape (n, 10, 10).

    References:
        Lee, Wensing, Park (2019), cited in ``make_penalty``, (22).

    J (n, 4, 4).
    """
    S = metric_root(np.linalg.cholesky(J))
    metric: Array = S.transpose(0, 2, 1) @ S
    return metric


def metric_root(L: Array) -> Array:
    """Return upper triangles S with S^T S the metric of ``pull_back_metric``, shape (n, 10, 10).

    With J = L L^T, g_kl = tr(C_k C_l) of the symmetric C_k = L^-1 B_k L^-T.

    L (n, 4, 4).
    """
    C = _whitened(pseudo_inertia_basis()[None], L[:, None])  # (n, 10, 4, 4)
    S: Array = np.asarray(np.linalg.qr(svec(C).transpose(0, 2, 1), mode="r"))
    return S


def body_units(spread: Array) -> Array:
    """Return diagonal T^-1/2, which make pseudo-inertias dimensionless, shape (bodies, 4, 4).

    spread (10 bodies,).
    """
    by_body = spread.reshape(-1, 10)
    mass, radius = by_body[:, 0], by_body[:, 1] / by_body[:, 0]
    diagonal = np.column_stack([1 / radius] * 3 + [np.ones_like(mass)])
    return np.eye(4) * (diagonal / np.sqrt(mass)[:, None])[:, None, :]


def _whitened(S: Array, L: Array) -> Array:
    """Return L^-1 S L^-T of symmetric matrices."""
    half = np.linalg.solve(L, S)
    whitened: Array = np.linalg.solve(L, half.swapaxes(-1, -2))
    return whitened


def _widened(J: Array, shrink: Array) -> Array:
    """Return pseudo-inertias whose smallest dimensionless eigenvalue is at least 1 %."""
    values, vectors = np.linalg.eigh(shrink @ J @ shrink)
    floored = (vectors * np.maximum(values, _THINNEST)[:, None]) @ vectors.transpose(0, 2, 1)
    grow = np.linalg.inv(shrink)
    changed = values[:, 0] < _THINNEST
    return np.where(changed[:, None, None], grow @ floored @ grow, J)
