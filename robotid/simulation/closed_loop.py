"""The simulated plant: forward dynamics with drives, a tracking controller, sensor noise -> Log."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.logs.data import Log
from robotid.robot.model import RobotModel
from robotid.simulation.plant import RobotPlant

__all__ = ["Motion", "Noise", "another_robot", "simulate"]

_BANDWIDTH = 20.0  # [rad/s] of the tracking controller
_SUBSTEPS = 2  # Runge-Kutta steps per sample, at least
_LONGEST_STEP = 0.005  # [s] of Runge-Kutta, whatever the rate of the log


class Motion(Protocol):
    """A motion that a controller can track."""

    def evaluate(self, t: Array) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations.

        Args:
            t: Times, shape (N,) [s].

        Returns:
            q, v, a, each of shape (N, n) [rad, rad/s, rad/s^2 or m, m/s, m/s^2].
        """


@dataclass(frozen=True)
class Noise:
    """Standard deviations of white sensor noise; 0 for none.

    Attributes:
        q: Of positions [rad or m].
        v: Of velocities [rad/s or m/s].
        tau: Of torques, as a share of each joint's root mean square torque [-].
    """

    q: float = 0.0
    v: float = 0.0
    tau: float = 0.0


def simulate(
    model: RobotModel,
    pi: Array,
    motion: Motion,
    *,
    rate: float,
    duration: float,
    rng: np.random.Generator,
    noise: Noise | None = None,
) -> Log:
    """Simulate a robot that tracks a motion, and return what its sensors log.

    The plant is M(q) a + b(q, v) + Ia a + Fv v + Fc sign(v) + off = u with the parameters pi,
    integrated by Runge-Kutta of order 4. The controller knows the model's own inertias only, not
    pi: u = RNEA(q_r, v_r, a_r) + diag(M) (w^2 (q_r - q) + 2 w (v_r - v)).

    Args:
        model: The robot as the controller believes it to be, with a fixed base.
        pi: The true standard parameters, shape (p,), drive terms included.
        motion: The motion to track.
        rate: Sample rate of the log [Hz].
        duration: Length of the log [s].
        rng: Source of the noise.
        noise: Sensor noise; none if None.

    Returns:
        The log, with measured velocities and the torque u.

    Raises:
        DataError: If the base floats, or the simulation diverges.
    """
    plant = _TrackedPlant(model, pi)
    t = np.arange(round(duration * rate) + 1) / rate
    substeps = max(_SUBSTEPS, math.ceil(1.0 / rate / _LONGEST_STEP - 1e-9))
    h = 1.0 / rate / substeps
    q_r, v_r, a_r = motion.evaluate(h / 2 * np.arange(2 * substeps * (len(t) - 1) + 1))
    state = np.concatenate([q_r[0], v_r[0]])
    n = len(model.joints)
    q, v, tau = (np.empty((len(t), n)) for _ in range(3))
    for k in range(len(t)):
        first = 2 * substeps * k  # index on the grid of half steps
        q[k], v[k] = state[:n], state[n:]
        tau[k] = plant.torque(state, q_r[first], v_r[first], a_r[first])
        if k + 1 < len(t):
            for step in range(substeps):
                i = first + 2 * step
                state = plant.advance(state, q_r[i : i + 3], v_r[i : i + 3], a_r[i : i + 3], h)
        if not np.isfinite(state).all():
            raise DataError(f"the simulation diverged at t = {t[k]:.3f} s; slow the motion down")
    level = noise or Noise()
    return Log(
        t=t,
        q=q + level.q * rng.standard_normal(q.shape),
        v=v + level.v * rng.standard_normal(v.shape),
        tau=tau + level.tau * np.sqrt(np.mean(tau**2, axis=0)) * rng.standard_normal(tau.shape),
        joints=model.joints,
    )


def another_robot(model: RobotModel, rng: np.random.Generator) -> Array:
    """Return parameters of a robot like the model, but not the same.

    Args:
        model: The robot as its URDF describes it.
        rng: Source of the differences.

    Returns:
        Standard parameters, shape (p,): every link 10 to 30 % heavier or lighter, 1.2 kg more at
        10 cm from the last joint, drives with armature and friction.
    """
    size = model.layout.n_inertial
    pi = model.standard_parameters()
    by_body = pi[:size].reshape(-1, 10)
    change = rng.uniform(0.1, 0.3, len(by_body)) * rng.choice([-1, 1], len(by_body))
    by_body *= 1 + change[:, None]
    mass, reach = 1.2, 0.1  # [kg], [m]
    tool = [mass, 0.0, mass * reach, 0.0, mass * reach**2, 0.0, 0.0, 0.0, 0.0, mass * reach**2]
    by_body[-1] += tool
    by_body[-1] += [0, 0, 0, 0, 1e-3, 0, 1e-3, 0, 0, 1e-3]  # a tool has an extent
    for i, (_, term) in enumerate(model.layout.drive_parameters, start=size):
        pi[i] = rng.uniform(*term.usual)
    return pi


class _TrackedPlant:
    """The true robot and its controller."""

    def __init__(self, model: RobotModel, pi: Array) -> None:
        self.model = model
        self.n = len(model.joints)
        self.plant = RobotPlant(model, pi)
        self.believed = model.pin_model
        self.believed_data = self.believed.createData()
        self.inertia = np.maximum(np.diag(self.plant.mass_matrix(np.zeros(self.n))), 0.02)

    def torque(self, state: Array, q_r: Array, v_r: Array, a_r: Array) -> Array:
        """Return the controller's torque."""
        q, v = state[: self.n], state[self.n :]
        G, w = self.model.velocity_map, _BANDWIDTH
        configuration = self.model.configurations(q_r[None])[0]
        forward = pin.rnea(self.believed, self.believed_data, configuration, G @ v_r, G @ a_r)
        command: Array = G.T @ forward + self.inertia * (w**2 * (q_r - q) + 2 * w * (v_r - v))
        return command

    def derivative(self, state: Array, u: Array) -> Array:
        """Return the rate of change of the state (q, v) under a torque."""
        q, v = state[: self.n], state[self.n :]
        return np.concatenate([v, self.plant.acceleration(q, v, u)])

    def advance(self, x: Array, q_r: Array, v_r: Array, a_r: Array, h: float) -> Array:
        """Return the state one Runge-Kutta step later; references at its start, middle, end."""

        def slope(at: Array, i: int) -> Array:
            return self.derivative(at, self.torque(at, q_r[i], v_r[i], a_r[i]))

        k1 = slope(x, 0)
        k2 = slope(x + h / 2 * k1, 1)
        k3 = slope(x + h / 2 * k2, 1)
        k4 = slope(x + h * k3, 2)
        advanced: Array = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return advanced
