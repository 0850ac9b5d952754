"""What a simulated robot logs: sensor models, and base and contacts of a robot on the ground."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.typing import Array
from robotid.data.base_motion import BaseMotion
from robotid.data.log import Log
from robotid.dynamics.constraint_rows import constraint_jacobian, logged_base
from robotid.dynamics.simulation.motions import FloatingMotion
from robotid.dynamics.simulation.simulation_settings import PerJoint, Sensors, by_joint
from robotid.robot.model import RobotModel

_LEFT = 1e-6  # largest part of the wrench on the base that contacts cannot cause [-]
_RANK = 1e-8  # singular values below this share of the largest are of dependent forces


@dataclass(frozen=True, eq=False)
class Stand:
    """Base and contacts of a robot along its motion."""

    pose: Array  # pose of the base, shape (N, 7) [m, -]
    twist: Array  # twist with the axes of the base, shape (N, 6) [m/s, rad/s]
    acceleration: Array  # its time derivative, shape (N, 6)
    # whether links touch the ground, by link; only of those that may leave it
    contacts: Mapping[str, Array]
    # measured components of wrenches, by name as "fz l_sole", each (N,) [N or N m]
    wrenches: Mapping[str, Array]

    def logged(self, sensors: Sensors, rows: Array) -> dict[str, Any]:
        """Return base, contacts and wrenches of a log: rows (N,)."""
        return {
            "base": BaseMotion(
                self.pose[rows],
                self.twist[rows] if sensors.velocity else None,
                self.acceleration[rows] if sensors.acceleration else None,
            ),
            "contacts": {link: flags[rows] for link, flags in self.contacts.items()},
            "wrenches": {name: values[rows] for name, values in self.wrenches.items()},
        }


def contact_forces(J: Array, wrench: Array) -> tuple[Array, Array]:
    """Return the smallest forces with J^T f = w, shape (N, m), and what they leave, (N, 6).

    J (N, m, 6), wrench (N, 6) [N, N m].
    """
    f = np.einsum("kmi,ki->km", np.linalg.pinv(J.swapaxes(1, 2), rcond=_RANK), wrench)
    return f, wrench - np.einsum("kmi,km->ki", J, f)


def supported(
    model: RobotModel,
    motion: FloatingMotion,
    t: Array,
    state: tuple[Array, Array, Array],
    torque: Array,
) -> tuple[Array, Stand]:
    """Return the torques of the joints, shape (N, n), and the stand of a robot along a motion.

    The forces of the ground f are the smallest ones that cause the motion of the base: of W pi =
    tau + J^T f the first six rows, where tau is 0. The other rows give tau.

    t (N,) [s], torque (N, 6 + n) [N m, N].
    """
    if model.loops or not model.contacts:
        found = "loops" if model.loops else "no contacts"
        raise SettingsError(
            f"{model.name} has {found}: a floating base is simulated with contacts and without "
            "loops; state [[contact]] in the job file"
        )
    q, v, a = state
    flags = motion.touching(t)
    J = constraint_jacobian(model, q, flags)
    f, left = contact_forces(J[:, :, :6], torque[:, :6])
    sizes = np.linalg.norm(left, axis=1)
    k = int(sizes.argmax())
    if sizes[k] > _LEFT * (1.0 + np.linalg.norm(torque[k, :6])):
        raise DataError(
            f"forces at the contacts cannot cause the motion of the base at t = {t[k]:.3f} s: "
            f"{sizes[k]:.3g} N of the wrench remain, with {int(flags[k].sum())} links on the "
            "ground. Three feet on the ground can support any motion"
        )
    tau = torque[:, 6:] - np.einsum("kmj,km->kj", J[:, :, 6:], f)
    wanted, names = logged_base(model), [c.frame for c in model.contacts]
    parts = [
        f"{part} {c.frame}" for c in model.contacts for part in c.components[: c.sizes[c.kind]]
    ]
    contacts = {link: flags[:, names.index(link)] for link in wanted.contacts}
    wrenches = {name: f[:, parts.index(name)] for name in wanted.wrenches}
    return tau, Stand(q[:, :7], v[:, :6], a[:, :6], contacts, wrenches)


_TICK = 1e-6  # smallest step between time stamps [s]


@dataclass(frozen=True, eq=False)
class Run:
    """The exact motion of a robot; arrays of shape (N, n)."""

    t: Array  # shape (N,) [s]
    q: Array  # [rad or m]
    v: Array  # [rad/s or m/s]
    a: Array  # [rad/s^2 or m/s^2]
    tau: Array  # [N m or N]
    reference: Array  # reference position [rad or m]
    saturated: Array  # share of the time at the torque limit of each drive, shape (n,) [-]
    stand: Stand | None = None  # of a robot whose base floats


def measure(
    run: Run,
    sensors: Sensors,
    joints: tuple[str, ...],
    rng: np.random.Generator,
    *,
    delay: Array | float = 0.0,
) -> Log:
    """Return the log of a robot's motion by sensors, its torques with a delay (n,) [s].

    Delay, noise and rounding are applied in this order. Jitter changes only the time stamps.
    """

    def of(value: PerJoint, name: str) -> Array:
        return by_joint(value, joints, f"sensors: {name}")

    noise, step, n = sensors.noise, sensors.step, len(joints)
    v = _delayed(run.t, run.v, np.full(n, sensors.velocity_delay))
    tau = _delayed(run.t, run.tau, sensors.torque_delay + delay * np.ones(n))
    share = of(noise.tau, "noise.tau") * np.sqrt(np.mean(tau**2, axis=0))
    level = np.hypot(share, of(noise.torque, "noise.torque"))
    q = _noisy(run.q, of(noise.q, "noise.q"), rng)
    v = _noisy(v, of(noise.v, "noise.v"), rng)
    signals = {"q": q, "v": v, "tau": _noisy(tau, level, rng)}
    q, v, tau = (_rounded(x, of(getattr(step, k), f"step.{k}")) for k, x in signals.items())
    logged = np.ones(len(run.t), dtype=bool)
    if sensors.dropped:
        logged = rng.random(len(logged)) >= sensors.dropped
        if logged.sum() < 2:
            raise DataError(
                f"{logged.sum()} of {len(logged)} samples remain, wanted at least 2. Set a smaller "
                "dropped, or a longer duration"
            )
    t = run.t
    if sensors.jitter:
        spread = _TICK * np.arange(len(t))
        t = t + sensors.jitter * rng.standard_normal(len(t))
        t = np.maximum.accumulate(t - spread) + spread
    of_stand = {} if run.stand is None else run.stand.logged(sensors, logged)
    return Log(
        t=t[logged],
        q=q[logged],
        v=v[logged] if sensors.velocity else None,
        a=run.a[logged] if sensors.acceleration else None,
        tau=tau[logged],
        joints=joints,
        **of_stand,
    )


def _delayed(t: Array, values: Array, delay: Array) -> Array:
    """Return values delayed by joint; before the start, the first values."""
    if not delay.any():
        return values
    columns = [np.interp(t - d, t, x) for d, x in zip(delay, values.T, strict=True)]
    return np.column_stack(columns)


def _noisy(values: Array, level: Array, rng: np.random.Generator) -> Array:
    """Return values with white noise, its standard deviation given by joint."""
    if not level.any():
        return values
    noisy: Array = values + level * rng.standard_normal(values.shape)
    return noisy


def _rounded(values: Array, step: Array) -> Array:
    """Return values rounded to steps, for the joints that have one."""
    size = np.where(step > 0, step, 1.0)
    return np.where(step > 0, np.round(values / size) * size, values)
