"""The true robot: forward dynamics by Pinocchio, with the drives that a URDF does not know."""

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.exceptions import DataError, NotConvergedError
from robotid.regressor.columns import drive_motion
from robotid.robot.mass_matrix import drive_inertia, rigid_mass_matrices
from robotid.robot.model import RobotModel

__all__ = ["RobotPlant", "rk4"]

_ITERATIONS = 200  # of the load and its friction, which shrink by the size of the parameter
_SETTLED = 1e-12  # relative change of the acceleration that ends them
_SIGN_SPEED = 2e-3  # [rad/s or m/s] speed over which the plant's Coulomb friction changes sign


class RobotPlant:
    """The plant M(q) a + b(q, v) + Ia a + Fv v + Fc sign(v) + off = u of a robot.

    The drives' terms are those of the model; sign(v) is tanh(v / 2 mm/s), so that it can be
    integrated; drives that turn with several joints load all of them. Friction that grows with the
    load knows the load of this very instant. A plant has no past: presliding slides, nothing lags.

    Args:
        model: The robot, with a fixed base.
        pi: Its true standard parameters, shape (p,), drive terms included.

    Raises:
        DataError: If the base floats, or pi does not have p entries.
    """

    def __init__(self, model: RobotModel, pi: Array) -> None:
        if model.free_flyer:
            raise DataError("a robot with a floating base cannot be simulated without contacts")
        if pi.shape != (len(model.layout.names),):
            raise DataError(f"pi has shape {pi.shape}, wanted ({len(model.layout.names)},)")
        self.model = model
        self._bodies = model.with_parameters(pi)
        self._data = self._bodies.pin_model.createData()
        theta = pi[model.layout.n_inertial :]
        self._theta = model.layout.drive_loads * theta  # (n, k)
        self._armature = drive_inertia(model.layout, pi)
        self._is_loaded = bool(theta[list(model.layout.remembering)].any())

    def mass_matrix(self, q: Array) -> Array:
        """Return D(q), the mass matrix with the drives' armature, shape (n, n).

        Args:
            q: Joint coordinates, shape (n,) [rad or m].
        """
        x = self.model.configurations(q[None])
        mass: Array = rigid_mass_matrices(self._bodies, x, self._data)[0] + self._armature
        return mass

    def bias(self, q: Array, v: Array) -> Array:
        """Return C(q, v), Coriolis, centrifugal, gravity and friction torque, (n,) [N m or N].

        Args:
            q: Joint coordinates, shape (n,) [rad or m].
            v: Joint velocities, shape (n,) [rad/s or m/s].
        """
        rigid = self._rigid(q, v)
        return rigid + self._drives(q, v, rigid)

    def _rigid(self, q: Array, v: Array) -> Array:
        """Return the torque of the bodies at constant velocity, shape (n,) [N m or N]."""
        G, x = self.model.velocity_map, self.model.configurations(q[None])[0]
        rigid: Array = G.T @ pin.nonLinearEffects(self._bodies.pin_model, self._data, x, G @ v)
        return rigid

    def _drives(self, q: Array, v: Array, load: Array) -> Array:
        """Return the torque of the drives at constant velocity, shape (n,) [N m or N]."""
        layout = self.model.layout
        signs = np.tanh(layout.drive_ratios @ v / _SIGN_SPEED)
        motion = drive_motion(layout, q[None], v[None], 0.0 * v[None], signs[None], load[None])
        columns = [term.column(motion.of(d))[0] for d, term in layout.drive_parameters]
        torque: Array = self._theta @ np.array(columns)
        return torque

    def acceleration(self, q: Array, v: Array, u: Array) -> Array:
        """Return the acceleration of a torque, D(q)^-1 (u - C(q, v)) [rad/s^2 or m/s^2], as q.

        Args:
            q: Joint coordinates, shape (n,), or (R, n) for R robots [rad or m].
            v: Joint velocities, shape as q [rad/s or m/s].
            u: Torque, shape as q [N m or N].

        References:
            Tzvetkova, (11).
        """
        if q.ndim == 1 and not self._is_loaded:
            return np.linalg.solve(self.mass_matrix(q), u - self.bias(q, v))
        if q.ndim == 1:
            return self._loaded_acceleration(q, v, u)
        return np.stack([self.acceleration(*one) for one in zip(q, v, u, strict=True)])

    def _loaded_acceleration(self, q: Array, v: Array, u: Array) -> Array:
        """Return the acceleration whose load makes the friction that leaves it, by iteration."""
        D, rigid = self.mass_matrix(q), self._rigid(q, v)
        bodies, load, a = D - self._armature, rigid, np.zeros_like(u)
        for _ in range(_ITERATIONS):
            before, a = a, np.linalg.solve(D, u - rigid - self._drives(q, v, load))
            load = rigid + bodies @ a
            if np.abs(a - before).max() <= _SETTLED * (1.0 + np.abs(a).max()):
                return a
        raise NotConvergedError(
            f"the friction that grows with the load does not settle in {_ITERATIONS} steps: its "
            "parameters are too large for a drive that moves",
            "max_iterations",
        )


def rk4(
    acceleration: Callable[[Array, Array, float], Array],
    q: Array,
    v: Array,
    h: float | Array,
    a: Array | None = None,
) -> tuple[Array, Array]:
    """Return positions and velocities one step later, by Runge-Kutta of order 4.

    Args:
        acceleration: Acceleration of a state q, v at a share of the step, 0, 0.5 or 1.
        q: Positions, any shape [rad or m].
        v: Velocities, shape as q.
        h: Length of the step, a number or a shape that multiplies q [s].
        a: Accelerations at the start of the step, where they are known.
    """
    a1 = acceleration(q, v, 0.0) if a is None else a
    v2 = v + h / 2 * a1
    a2 = acceleration(q + h / 2 * v, v2, 0.5)
    v3 = v + h / 2 * a2
    a3 = acceleration(q + h / 2 * v2, v3, 0.5)
    v4 = v + h * a3
    a4 = acceleration(q + h * v3, v4, 1.0)
    return q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
