"""The true robot: forward dynamics by Pinocchio, with the drives that a URDF does not know."""

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.robot.model import RobotModel

__all__ = ["RobotPlant"]

_SIGN_SPEED = 2e-3  # [rad/s or m/s] speed over which the plant's Coulomb friction changes sign


class RobotPlant:
    """The plant M(q) a + b(q, v) + Ia a + Fv v + Fc sign(v) + off = u of a robot.

    sign(v) is tanh(v / 2 mm/s), so that it can be integrated; drives that turn with several joints
    load all of them.

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
        self._pin_model = model.with_parameters(pi).pin_model
        self._data = self._pin_model.createData()
        self._drives = _drives(model, pi)

    def mass_matrix(self, q: Array) -> Array:
        """Return D(q), the mass matrix with the drives' armature.

        Args:
            q: Joint coordinates, shape (n,) [rad or m].

        Returns:
            Mass matrix, shape (n, n).
        """
        G = self.model.velocity_map
        M = pin.crba(self._pin_model, self._data, self.model.configurations(q[None])[0])
        M = np.triu(M) + np.triu(M, 1).T
        armature = sum(Ia * np.outer(r, r) for r, Ia, _, _, _ in self._drives)
        mass: Array = G.T @ M @ G + armature
        return mass

    def bias(self, q: Array, v: Array) -> Array:
        """Return C(q, v), the torque of Coriolis, centrifugal, gravity and friction forces.

        Args:
            q: Joint coordinates, shape (n,) [rad or m].
            v: Joint velocities, shape (n,) [rad/s or m/s].

        Returns:
            Torque, shape (n,) [N m or N].
        """
        G = self.model.velocity_map
        configuration = self.model.configurations(q[None])[0]
        bias: Array = G.T @ pin.nonLinearEffects(self._pin_model, self._data, configuration, G @ v)
        for r, _, Fv, Fc, offset in self._drives:
            speed = r @ v
            bias = bias + r * (Fv * speed + Fc * np.tanh(speed / _SIGN_SPEED) + offset)
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


def _drives(model: RobotModel, pi: Array) -> list[tuple[Array, float, float, float, float]]:
    """Return ratios over the joints, armature, viscous, Coulomb and offset of each drive."""
    value = dict(zip(model.layout.names, pi.tolist(), strict=True))
    ratios = {joint: {joint: 1.0} for joint in model.joints}
    ratios.update({c.name: dict(c.ratios) for c in model.layout.couplings})
    drives = []
    for owner, by_joint in ratios.items():
        r = np.array([by_joint.get(joint, 0.0) for joint in model.joints])
        terms = (value.get(f"{owner}.{term}", 0.0) for term in ("armature", "viscous", "coulomb"))
        Ia, Fv, Fc = terms
        drives.append((r, Ia, Fv, Fc, value.get(f"{owner}.offset", 0.0)))
    return drives
