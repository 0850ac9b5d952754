"""Sensor models: noise, resolution, delay, jitter, and dropped samples."""

from dataclasses import dataclass

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.dynamics.simulation.simulation_settings import PerJoint, Sensors, by_joint
from robotid.dynamics.simulation.stand import Stand

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
