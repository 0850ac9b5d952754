"""Dynamics that are linear in their parameters, G(q, v, a) P = u: closed forms and any robot."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.paper import planar_2r
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.torque import joint_torque_regressor
from robotid.robot.model import RobotModel

__all__ = [
    "BaseDynamics",
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
class PlanarDynamics:
    """The paper's arm in closed form.

    Attributes:
        form: Which of its regressors: ``"printed"``, ``"corrected_five"`` or ``"corrected"``.
    """

    form: planar_2r.Form = "corrected"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the c parameters."""
        return planar_2r.PARAMETER_NAMES[self.form]

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return 2

    def regressor(self, q: Array, v: Array, a: Array) -> Array:
        """Return the regressor.

        Args:
            q: Joint angles, shape (R, 2) [rad].
            v: Joint velocities, shape (R, 2) [rad/s].
            a: Joint accelerations, shape (R, 2) [rad/s^2].

        Returns:
            Regressor, shape (R, 2, c).

        References:
            Tzvetkova, (13).
        """
        return planar_2r.regressor(q, v, a, form=self.form)


@dataclass(frozen=True, eq=False)
class BaseDynamics:
    """Any robot, in its base parameters.

    Attributes:
        model: The robot, with a fixed base.
        mapping: Its base parameters, over all standard parameters or the inertial ones alone.
    """

    model: RobotModel
    mapping: BaseMapping

    def __post_init__(self) -> None:
        if self.model.free_flyer:
            raise DataError("the base floats; the procedure needs a torque in every row")
        names = self.model.layout.names
        if self.mapping.names != names[: len(self.mapping.names)]:
            raise DataError("the mapping is not one of this model; build both from one model")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the b base parameters."""
        return self.mapping.base_names

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return self.model.n_rows

    def regressor(self, q: Array, v: Array, a: Array) -> Array:
        """Return the base regressor W_b.

        Args:
            q: Joint coordinates, shape (R, n) [rad or m].
            v: Joint velocities, shape (R, n) [rad/s or m/s].
            a: Joint accelerations, shape (R, n) [rad/s^2 or m/s^2].

        Returns:
            Regressor, shape (R, n, b).

        References:
            Tzvetkova, (13).
        """
        W = joint_torque_regressor(self.model, q, v, a)  # (R n, p)
        return W[:, self.mapping.independent].reshape(*q.shape, -1)


@dataclass(frozen=True)
class LinearPlant:
    """A plant whose dynamics are linear in its parameters; it need not be a rigid body.

    Attributes:
        dynamics: Its regressor.
        P: Its true parameters, shape (c,).
    """

    dynamics: LinearDynamics
    P: Array

    def acceleration(self, q: Array, v: Array, u: Array) -> Array:
        """Return a = D(q, P)^-1 (u - C(q, v, P)).

        Args:
            q: Positions, shape (R, n) [rad or m].
            v: Velocities, shape (R, n) [rad/s or m/s].
            u: Torques, shape (R, n) [N m or N].

        Returns:
            Accelerations, shape (R, n) [rad/s^2 or m/s^2].

        References:
            Tzvetkova, (11).
        """
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
