"""The true robot: forward dynamics by Pinocchio, with the drives that a URDF does not know."""

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.robot.drives import TERMS, DriveMotion
from robotid.robot.mass_matrix import drive_inertia, rigid_mass_matrices
from robotid.robot.model import RobotModel

__all__ = ["RobotPlant"]

_SIGN_SPEED = 2e-3  # [rad/s or m/s] speed over which the plant's Coulomb friction changes sign


class RobotPlant:
    """The plant M(q) a + b(q, v) + Ia a + Fv v + Fc sign(v) + off = u of a robot.

    The drives' terms are those of the model; sign(v) is tanh(v / 2 mm/s), so that it can be
    integrated; drives that turn with several joints load all of them.

    Attributes:
        model: The robot.
    """

    def __init__(self, model: RobotModel, pi: Array) -> None:
        """Build the plant.

        Args:
            model: The robot, with a fixed base.
            pi: Its true standard parameters, shape (p,), drive terms included.

        Raises:
            DataError: If the base floats, or pi does not have p entries.
        """
        if model.free_flyer:
            raise DataError("a robot with a floating base cannot be simulated without contacts")
        if pi.shape != (len(model.layout.names),):
            raise DataError(f"pi has shape {pi.shape}, wanted ({len(model.layout.names)},)")
        self.model = model
        self._bodies = model.with_parameters(pi)
        self._data = self._bodies.pin_model.createData()
        theta = {name: np.zeros(len(model.layout.drives)) for name in model.layout.terms}
        for i, (drive, term) in enumerate(model.layout.drive_parameters, model.layout.n_inertial):
            theta[term.name][drive] = pi[i]
        self._drives = [(TERMS[name], of_drives) for name, of_drives in theta.items()]
        self._armature = drive_inertia(model.layout, pi)

    def mass_matrix(self, q: Array) -> Array:
        """Return D(q), the mass matrix with the drives' armature.

        Args:
            q: Joint coordinates, shape (n,) [rad or m].

        Returns:
            Mass matrix, shape (n, n).
        """
        x = self.model.configurations(q[None])
        mass: Array = rigid_mass_matrices(self._bodies, x, self._data)[0] + self._armature
        return mass

    def bias(self, q: Array, v: Array) -> Array:
        """Return C(q, v), the torque of Coriolis, centrifugal, gravity and friction forces.

        Args:
            q: Joint coordinates, shape (n,) [rad or m].
            v: Joint velocities, shape (n,) [rad/s or m/s].

        Returns:
            Torque, shape (n,) [N m or N].
        """
        G, L = self.model.velocity_map, self.model.layout.drive_ratios.T
        pin_model, x = self._bodies.pin_model, self.model.configurations(q[None])[0]
        w = L.T @ v  # (d,), speeds of the drives
        motion = DriveMotion(w, np.zeros_like(w), np.tanh(w / _SIGN_SPEED))
        drives = sum((theta * term.column(motion) for term, theta in self._drives), 0.0 * w)
        bias: Array = G.T @ pin.nonLinearEffects(pin_model, self._data, x, G @ v) + L @ drives
        return bias

    def acceleration(self, q: Array, v: Array, u: Array) -> Array:
        """Return the acceleration that a torque gives, a = D(q)^-1 (u - C(q, v)).

        Args:
            q: Joint coordinates, shape (n,), or (R, n) for R robots [rad or m].
            v: Joint velocities, shape as q [rad/s or m/s].
            u: Torque, shape as q [N m or N].

        Returns:
            Acceleration, shape as q [rad/s^2 or m/s^2].

        References:
            Tzvetkova, (11).
        """
        if q.ndim == 1:
            return np.linalg.solve(self.mass_matrix(q), u - self.bias(q, v))
        return np.stack([self.acceleration(*one) for one in zip(q, v, u, strict=True)])
