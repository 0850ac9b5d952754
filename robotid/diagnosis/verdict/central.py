"""Mass, centre of mass and inertia about it of each body, with intervals and sources."""

from dataclasses import dataclass

import numpy as np

from robotid.base.typing import Array
from robotid.estimation.fitting.fitted import FROM_DATA, FROM_PRIOR, Fit, sources_of

#: Mass [kg], centre of mass [m], inertia about it [kg m^2], in the axes of the joint frame.
CENTRAL_TERMS = ("m", "cx", "cy", "cz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
_PAIRS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))  # axes of Pinocchio's six inertias
_ORDER = [0, 1, 2, 3, 4, 6, 9, 5, 7, 8]  # of CENTRAL_TERMS in Pinocchio's order
_STAYED = 0.3  # change in prior standard deviations up to which the source may be the prior


@dataclass(frozen=True, eq=False)
class CentralParameters:
    """Parameters of the n bodies in the order of ``CENTRAL_TERMS``, SI units."""

    urdf: Array  # Values of the URDF, shape (n, 10); NaN for the centre and inertia without mass
    values: Array  # Identified values, likewise
    half: Array  # Half-widths of their 95 % intervals, shape (n, 10); inf if there is none
    #: What determined each value, of ``SOURCES``, shape (n, 10), text
    sources: np.ndarray[tuple[int, int], np.dtype[np.str_]]


def central_parameters(found: Fit) -> CentralParameters:
    """Return the parameters of each body about its centre of mass.

    Standard errors are those of the standard parameters, propagated to first order.
    """
    n, size = len(found.model.layout.bodies), found.model.layout.n_inertial
    pi, before = (x[:size].reshape(n, 10) for x in (found.standard, found.prior))
    error = found.standard_error[:size]
    unbounded = error if found.errors.unbounded is None else found.errors.unbounded[:size]
    wider = np.where(error > 0, unbounded / np.where(error > 0, error, 1.0), 1.0)
    of_standard = np.array(found.sources[:size]).reshape(n, 10)
    quantile = found.standard_quantile[:size].reshape(n, 10).max(axis=1)
    urdf, values, half, share, moved = (np.full((n, 10), np.nan) for _ in range(5))
    for i in range(n):
        urdf[i], _ = _central(before[i])
        values[i], G = _central(pi[i])
        own = slice(10 * i, 10 * i + 10)
        C = found.standard_covariance[own, own]
        S = np.diag(found.prior_std[own] ** 2)
        D = np.diag(np.where(np.isfinite(wider[own]), wider[own], 1.0))
        std, free, prior = (_std(G, X) for X in (C, D @ C @ D, S))
        half[i] = np.where(np.isfinite(error[own]).all(), quantile[i] * std, np.inf)
        share[i] = free / np.maximum(prior, 1e-300)
        moved[i] = np.abs(values[i] - urdf[i]) > _STAYED * prior
    is_kept = (of_standard == "prior").all(axis=1, keepdims=True)
    is_prior = is_kept | ((share > FROM_PRIOR) & (moved == 0))
    is_bound = (of_standard == "bound").any(axis=1, keepdims=True) & (share >= FROM_DATA)
    sources = np.array(sources_of(share.ravel(), is_prior.ravel(), is_bound.ravel()))
    sources = sources.reshape(n, 10)
    sources[:, 0] = of_standard[:, 0]
    urdf, values, half = (x[:, _ORDER] for x in (urdf, values, half))
    return CentralParameters(urdf, values, half, sources[:, _ORDER])


def _std(G: Array, C: Array) -> Array:
    """Return the standard deviations of G x, x with the covariance C."""
    std: Array = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", G, C, G), 0.0))
    return std


def _central(pi: Array) -> tuple[Array, Array]:
    """Return m, c and I_c in Pinocchio's order, shape (10,), and their derivatives, (10, 10).

    c = h / m and I_c = I - m (c c 1 - c c'), with the first moments h.
    """
    m, G = float(pi[0]), np.eye(10)
    if not m > 0:
        return np.append(m, np.full(9, np.nan)), G
    c, values = pi[1:4] / m, np.array(pi)
    G[1:4, 0], G[1:4, 1:4] = -c / m, np.eye(3) / m
    steiner = c @ c * np.eye(3) - np.outer(c, c)  # (3, 3) [m^2]
    for row, (i, j) in enumerate(_PAIRS, 4):
        values[row] -= m * steiner[i, j]
        G[row, 0] = steiner[i, j]
        for k in range(3):
            G[row, 1 + k] = (i == k) * c[j] + (j == k) * c[i] - 2 * (i == j) * c[k]
    values[1:4] = c
    return values, G
