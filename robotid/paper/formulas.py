"""The formulas of the recursive procedure, free of any physics: control, proximity, update.

Every function takes leading axes, so that many runs go at once: "..." stands for () or (R,).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError, RankDeficientError, SettingsError

__all__ = [
    "Bounds",
    "Sign",
    "deviation",
    "one_shot",
    "proximity",
    "recursive_update",
    "reference_acceleration",
]

#: Sign of the second term of (23): minus makes it a gradient, plus is what the paper prints.
Sign: TypeAlias = Literal["corrected", "printed"]


@dataclass(frozen=True)
class Bounds:
    """The bounded set Omega in which the parameters are known to lie: a box.

    Attributes:
        lower: Least value of each parameter, shape (c,); -inf for none.
        upper: Largest value of each parameter, shape (c,); inf for none.

    References:
        Tzvetkova, (8).
    """

    lower: Array
    upper: Array

    def __post_init__(self) -> None:
        lower, upper = np.asarray(self.lower), np.asarray(self.upper)
        if lower.shape != upper.shape or lower.ndim != 1:
            raise DataError(f"bounds have shapes {lower.shape} and {upper.shape}, wanted one (c,)")
        if not (lower <= upper).all():  # NaN is refused too
            i = int(np.flatnonzero(~(lower <= upper))[0])
            raise DataError(f"bounds of parameter {i} are {lower[i]} to {upper[i]}: an empty set")

    def project(self, P: Array) -> Array:
        """Return the nearest parameters of the set.

        Args:
            P: Parameters, shape (..., c).

        Returns:
            Parameters, shape (..., c).
        """
        return np.clip(P, self.lower, self.upper)


def reference_acceleration(
    q: Array, v: Array, program: tuple[Array, Array, Array], alpha: Array, beta: Array
) -> Array:
    """Return q_* = a_pr - alpha (v - v_pr) - beta (q - q_pr).

    Args:
        q: Measured positions, shape (..., n) [rad or m].
        v: Measured velocities, shape (..., n) [rad/s or m/s].
        program: q_pr, v_pr and a_pr, each of shape (..., n).
        alpha: Gain of the velocity, shape () or (..., 1) [1/s].
        beta: Gain of the position, shape () or (..., 1) [1/s^2].

    Returns:
        The acceleration that brings the robot back to its program, shape (..., n).

    References:
        Tzvetkova, (15).
    """
    q_pr, v_pr, a_pr = program
    q_star: Array = a_pr - alpha * (v - v_pr) - beta * (q - q_pr)
    return q_star


def deviation(a: Array, q_star: Array) -> Array:
    """Return eta = a - q_* = a - a_pr + alpha (v - v_pr) + beta (q - q_pr).

    Args:
        a: Measured accelerations, shape (..., n) [rad/s^2 or m/s^2].
        q_star: Reference acceleration (15), shape (..., n).

    Returns:
        Difference of the real and the program motion, shape (..., n).

    References:
        Tzvetkova, (20).
    """
    return a - q_star


def proximity(Psi: Array, P: Array, u: Array, *, sign: Sign = "corrected") -> Array:
    """Return PRX = Psi^T Psi P - Psi^T u, or with a plus, as the paper prints it.

    With the minus it is the gradient (4) of the criterion (3), J = |u - Psi P|^2 / 2, and zero at
    the true parameters. With the plus it is 2 Psi^T u there.

    Args:
        Psi: Regressor of the motion that the torque u made, shape (..., n, c).
        P: Estimate, shape (..., c).
        u: Torque, shape (..., n) [N m or N].
        sign: ``"corrected"`` (minus) or ``"printed"`` (plus).

    Returns:
        The proximity function, shape (..., c).

    Raises:
        SettingsError: If there is no such sign.

    References:
        Tzvetkova, (23).
    """
    if sign not in ("corrected", "printed"):
        raise SettingsError(f"sign is {sign!r}, wanted 'corrected' or 'printed'")
    predicted = np.einsum("...nc,...c->...n", Psi, P)
    residual = predicted - u if sign == "corrected" else predicted + u
    gradient: Array = np.einsum("...nc,...n->...c", Psi, residual)
    return gradient


def recursive_update(
    P: Array, Psi: Array, eta: Array, sigma: Array, is_open: Array, *, eps2: float | Array = 1e-12
) -> Array:
    """Return P - lambda sigma_D / |Psi|^2 Psi^T eta, with |Psi|^2 = Sp(Psi Psi^T).

    Args:
        P: Estimate, shape (..., c).
        Psi: Gradient (22) of the control, shape (..., n, c).
        eta: Deviation (20), shape (..., n).
        sigma: sigma_D, the smallest eigenvalue of D(q, P), shape (...). Where it is not positive
            the estimate is no arm, (24) would climb, and nothing is changed.
        is_open: lambda, True where PRX is not zero, shape (...).
        eps2: Where |Psi|^2 is not above it, nothing is changed [1/s^4].

    Returns:
        The next estimate, shape (..., c).

    References:
        Tzvetkova, (24).
    """
    size = np.einsum("...nc,...nc->...", Psi, Psi)
    moves = is_open & (size > eps2) & (sigma > 0.0)
    gamma = np.where(moves, sigma, 0.0) / np.where(moves, size, 1.0)
    updated: Array = P - gamma[..., None] * np.einsum("...nc,...n->...c", Psi, eta)
    return updated


def one_shot(G: Array, G_star: Array, P: Array, names: Sequence[str]) -> Array:
    """Return the parameters from one recorded motion, P = G^+ G_* P^.

    The same torque is G P, with the acceleration measured, and G_* P^, with the reference
    acceleration (15) that it was computed from.

    Args:
        G: Regressors G(q, v, a) of all samples, stacked, shape (N n, c).
        G_star: Regressors G(q, v, q_*), stacked, shape (N n, c).
        P: The estimate P^ in use, shape (c,).
        names: Names of the c parameters.

    Returns:
        Parameters, shape (c,).

    Raises:
        RankDeficientError: If the columns of G are linearly dependent; the recursive update (24)
            is for that case.

    References:
        Tzvetkova, (16)-(19).
    """
    U, s, Vt = np.linalg.svd(G, full_matrices=False)
    rank = int(np.sum(s > s[0] * 1e-10)) if s[0] > 0 else 0
    if rank < G.shape[1]:
        open_share = 1.0 - np.sum(Vt[:rank] ** 2, axis=0)
        undetermined = [
            name for name, is_open in zip(names, open_share > 0.01, strict=True) if is_open
        ]
        raise RankDeficientError(rank, undetermined, G.shape[1])
    solved: Array = Vt.T @ ((U.T @ (G_star @ P)) / s)
    return solved
