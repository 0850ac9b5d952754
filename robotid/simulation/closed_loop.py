"""The simulated plant: forward dynamics with drives, a tracking controller, sensor noise -> Log."""

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.logs.data import Log
from robotid.robot.model import RobotModel
from robotid.simulation.motions import Motion
from robotid.simulation.plant import RobotPlant, rk4

__all__ = ["Noise", "another_robot", "simulate"]

_BANDWIDTH = 20.0  # [rad/s] of the tracking controller
_SUBSTEPS = 2  # Runge-Kutta steps per sample, at least
_LONGEST_STEP = 0.005  # [s] of Runge-Kutta, whatever the rate of the log


@dataclass(frozen=True)
class Noise:
    """Standard deviations of white sensor noise; 0 for none."""

    q: float = 0.0  # of positions [rad or m]
    v: float = 0.0  # of velocities [rad/s or m/s]
    tau: float = 0.0  # of torques, as a share of each joint's root mean square torque [-]


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
    """Return what the sensors of a simulated robot log, v and the torque u, as it tracks a motion.

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

    Raises:
        DataError: If the base floats, or the simulation diverges.
    """
    plant = _TrackedPlant(model, pi)
    t = np.arange(round(duration * rate) + 1) / rate
    substeps = max(_SUBSTEPS, math.ceil(1.0 / rate / _LONGEST_STEP - 1e-9))
    h = 1.0 / rate / substeps
    q_r, v_r, a_r = motion.evaluate(h / 2 * np.arange(2 * substeps * (len(t) - 1) + 1))
    q, v, tau = (np.empty((len(t), len(model.joints))) for _ in range(3))
    q_k, v_k = q_r[0], v_r[0]
    for k in range(len(t)):
        first = 2 * substeps * k  # index on the grid of half steps
        q[k], v[k] = q_k, v_k
        tau[k] = plant.torque(q_k, v_k, q_r[first], v_r[first], a_r[first])
        if k + 1 < len(t):
            for i in range(first, first + 2 * substeps, 2):
                reference = [x[i : i + 3] for x in (q_r, v_r, a_r)]  # start, middle, end
                q_k, v_k = plant.advance(q_k, v_k, reference, h)
        if not (np.isfinite(q_k).all() and np.isfinite(v_k).all()):
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
    """Return standard parameters, shape (p,), of a robot like the model, but not the same.

    Every link is 10 to 30 % heavier or lighter, 1.2 kg more are at 10 cm from the last joint, the
    drives have armature and friction.

    Args:
        model: The robot as its URDF describes it.
        rng: Source of the differences.
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
        self.model, self.plant = model, RobotPlant(model, pi)
        self.data = model.pin_model.createData()
        mass = self.plant.mass_matrix(np.zeros(len(model.joints)))
        self.inertia = np.maximum(np.diag(mass), 0.02)

    def torque(self, q: Array, v: Array, q_r: Array, v_r: Array, a_r: Array) -> Array:
        """Return the controller's torque."""
        G, w = self.model.velocity_map, _BANDWIDTH
        x = self.model.configurations(q_r[None])[0]
        forward = pin.rnea(self.model.pin_model, self.data, x, G @ v_r, G @ a_r)
        command: Array = G.T @ forward + self.inertia * (w**2 * (q_r - q) + 2 * w * (v_r - v))
        return command

    def advance(self, q: Array, v: Array, reference: list[Array], h: float) -> tuple[Array, Array]:
        """Return the state one step later; q, v, a of the motion at its start, middle and end."""

        def acceleration(q: Array, v: Array, share: float) -> Array:
            u = self.torque(q, v, *(x[round(2 * share)] for x in reference))
            return self.plant.acceleration(q, v, u)

        return rk4(acceleration, q, v, h)
