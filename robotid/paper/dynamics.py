"""Dynamics that are linear in their parameters, G(q, v, a) P = u: the paper's closed forms."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from robotid._typing import Array
from robotid.paper import planar_2r

__all__ = [
    "LinearDynamics",
    "LinearPlant",
    "PlanarDynamics",
    "Plant",
    "mass_matrix",
    "smallest_eigenvalue",
    "torque",
]


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
    """A robot that moves when torque is applied."""

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
        form: Which of its regressors: ``"printed"``, ``"corrected_five"`` or ``"corrected"``.
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
    """Return D(q, P) from the parameters that the torque shows, base parameters, alone.

    Column j is (G(q, 0, e_j) - G(q, 0, 0)) P: the torque of a unit acceleration without that of
    gravity and constant offsets.

    Args:
        dynamics: The model.
        q: Positions, shape (R, n) [rad or m].
        P: Parameters, shape (c,) or (R, c).

    Returns:
        Mass matrices, shape (R, n, n); they are positive definite only if P is possible.

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
