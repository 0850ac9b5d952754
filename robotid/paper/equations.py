"""The equations of the paper: dynamics linear in their parameters, control, proximity, update.

The formulas accept leading axes for several runs together: "..." stands for () or (R,).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import numpy as np

from robotid.base.exceptions import DataError, RankDeficientError, SettingsError
from robotid.base.typing import Array
from robotid.paper import planar_2r

__all__ = [
    "Bounds",
    "LinearDynamics",
    "LinearPlant",
    "PlanarDynamics",
    "Plant",
    "Sign",
    "mass_matrix",
    "one_shot",
    "proximity",
    "recursive_update",
    "reference_acceleration",
    "smallest_eigenvalue",
    "torque",
]

#: Sign of the second term of (23): with minus it is a gradient, plus is printed in the paper.
Sign: TypeAlias = Literal["corrected", "printed"]


@dataclass(frozen=True)
class Bounds:
    """The bounded set Omega of the parameters: a box.

    Attributes:
        lower: Smallest value of each parameter, shape (c,); -inf for none.
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
            raise DataError(
                f"bounds of parameter {i} are {lower[i]} to {upper[i]}, wanted lower <= upper"
            )

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
        The reference acceleration, which returns the robot to its program, shape (..., n).

    References:
        Tzvetkova, (15).
    """
    q_pr, v_pr, a_pr = program
    q_star: Array = a_pr - alpha * (v - v_pr) - beta * (q - q_pr)
    return q_star


def proximity(Psi: Array, P: Array, u: Array, *, sign: Sign = "corrected") -> Array:
    """Return PRX = Psi^T Psi P - Psi^T u, or with a plus, as printed in the paper.

    With the minus it is the gradient (4) of the criterion (3), J = |u - Psi P|^2 / 2, and zero at
    the true parameters. With the plus it is 2 Psi^T u there.

    Args:
        Psi: Regressor of the motion caused by the torque u, G at the measured acceleration, shape
            (..., n, c). With that of (22), at q_*, PRX is always 0: u is Psi P by (21).
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
        sigma: sigma_D, the smallest eigenvalue of D(q, P), shape (...). If it is not positive, the
            estimate is not physical, (24) would increase the error, and P is not changed.
        is_open: lambda, True if PRX is not zero, shape (...).
        eps2: If |Psi|^2 is not above it, P is not changed [1/s^4].

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

    The torque is G P, with the measured acceleration, and G_* P^, with the reference acceleration
    (15) from which it was computed.

    Args:
        G: Regressors G(q, v, a) of all samples, stacked, shape (N n, c).
        G_star: Regressors G(q, v, q_*), stacked, shape (N n, c).
        P: The current estimate P^, shape (c,).
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


class LinearDynamics(Protocol):
    """A model D(q, P) a + C(q, v, P) = u that is linear in P, (11)-(13)."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the c parameters."""

    @property
    def n_joints(self) -> int:
        """Number n of joints."""

    def regressor(self, q: Array, v: Array, a: Array) -> Array:
        """Return the regressor of R states.

        Args:
            q: Positions, shape (R, n) [rad or m].
            v: Velocities, shape (R, n) [rad/s or m/s].
            a: Accelerations, shape (R, n) [rad/s^2 or m/s^2].

        Returns:
            G(q, v, a), shape (R, n, c).
        """


class Plant(Protocol):
    """A robot that is simulated."""

    def acceleration(self, q: Array, v: Array, u: Array) -> Array:
        """Return the accelerations of R robots.

        Args:
            q: Positions, shape (R, n) [rad or m].
            v: Velocities, shape (R, n) [rad/s or m/s].
            u: Torques, shape (R, n) [N m or N].

        Returns:
            Accelerations, shape (R, n) [rad/s^2 or m/s^2].
        """


@dataclass(frozen=True)
class PlanarDynamics(LinearDynamics):
    """The paper's arm in closed form.

    Attributes:
        form: Its regressor: ``"printed"``, ``"corrected_five"`` or ``"corrected"``.
    """

    form: planar_2r.Form = "corrected"

    @property
    def names(self) -> tuple[str, ...]:
        return planar_2r.PARAMETER_NAMES[self.form]

    @property
    def n_joints(self) -> int:
        return 2

    def regressor(self, q: Array, v: Array, a: Array) -> Array:
        return planar_2r.regressor(q, v, a, form=self.form)


@dataclass(frozen=True)
class LinearPlant(Plant):
    """A plant whose dynamics are linear in its parameters; it need not be a rigid body.

    Attributes:
        dynamics: Its regressor.
        P: Its true parameters, shape (c,).
    """

    dynamics: LinearDynamics
    P: Array

    def acceleration(self, q: Array, v: Array, u: Array) -> Array:
        # a = D(q, P)^-1 (u - C(q, v, P)), (11)
        D, C = _mass_and_bias(self.dynamics, q, v, self.P)
        a: Array = np.linalg.solve(D, (u - C)[..., None])[..., 0]
        return a


def torque(dynamics: LinearDynamics, q: Array, v: Array, a: Array, P: Array) -> Array:
    """Return u = G(q, v, a) P.

    Args:
        dynamics: The model.
        q: Positions, shape (R, n) [rad or m].
        v: Velocities, shape (R, n) [rad/s or m/s].
        a: Accelerations, shape (R, n) [rad/s^2 or m/s^2].
        P: Parameters, shape (c,) or (R, c).

    Returns:
        Torques, shape (R, n) [N m or N].

    References:
        Tzvetkova, (13).
    """
    G = dynamics.regressor(q, v, a)  # (R, n, c)
    u: Array = np.einsum("rnc,rc->rn", G, np.broadcast_to(P, (len(q), G.shape[-1])))
    return u


def mass_matrix(dynamics: LinearDynamics, q: Array, P: Array) -> Array:
    """Return D(q, P) from the base parameters.

    Column j is (G(q, 0, e_j) - G(q, 0, 0)) P: the torque of a unit acceleration without that of
    gravity and constant offsets.

    Args:
        dynamics: The model.
        q: Positions, shape (R, n) [rad or m].
        P: Parameters, shape (c,) or (R, c).

    Returns:
        Mass matrices, shape (R, n, n); positive definite if P is physically consistent.

    References:
        Tzvetkova, (11); sigma_D of (24) needs it.
    """
    return _mass_and_bias(dynamics, q, np.zeros_like(q), P)[0]


def smallest_eigenvalue(D: Array) -> Array:
    """Return sigma_D, the smallest eigenvalue of each matrix.

    Args:
        D: Symmetric matrices, shape (R, n, n).

    Returns:
        Eigenvalues, shape (R,).

    References:
        Tzvetkova, (24).
    """
    smallest: Array = np.linalg.eigvalsh((D + D.swapaxes(-1, -2)) / 2)[..., 0]
    return smallest


def _mass_and_bias(dynamics: LinearDynamics, q: Array, v: Array, P: Array) -> tuple[Array, Array]:
    """Return D(q, P), shape (R, n, n), and C(q, v, P), shape (R, n), from one call."""
    R, n = q.shape
    unit = np.concatenate([np.eye(n), np.zeros((2, n))])  # accelerations e_1 .. e_n, 0, 0
    a = np.repeat(unit, R, axis=0)  # ((n + 2) R, n)
    speeds = np.zeros_like(a)
    speeds[-R:] = v
    G = dynamics.regressor(np.tile(q, (n + 2, 1)), speeds, a)
    parameters = np.broadcast_to(P, (R, G.shape[-1]))
    u = np.einsum("krnc,rc->krn", G.reshape(n + 2, R, n, -1), parameters)
    return (u[:n] - u[n]).transpose(1, 2, 0), u[n + 1]
