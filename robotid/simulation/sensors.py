"""What sensors make of how a robot moved: noise, steps, delay, jitter, samples that are lost."""

from typing import TYPE_CHECKING

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.logs.data import Log
from robotid.simulation.settings import PerJoint, Sensors, by_joint

if TYPE_CHECKING:
    from robotid.simulation.closed_loop import Run

__all__ = ["measure"]

_TICK = 1e-6  # [s] a time stamp is at least this long after the one before


def measure(
    run: "Run",
    sensors: Sensors,
    joints: tuple[str, ...],
    rng: np.random.Generator,
    *,
    delay: Array | float = 0.0,
) -> Log:
    """Return what sensors log of a robot's motion.

    Readings are late, then noisy, then rounded; the time stamps of those that are kept err by
    themselves.

    Args:
        run: How the robot moved.
        sensors: What is logged, and what is wrong with it.
        joints: Names of the n joints.
        rng: Source of noise, jitter and losses.
        delay: How late each torque is by its drive, beside the sensors, shape (n,) [s].

    Raises:
        DataError: If fewer than two samples are left.
        SettingsError: If a joint is named that is not there.
    """

    def of(value: PerJoint, name: str) -> Array:
        return by_joint(value, joints, f"sensors: {name}")

    noise, step, n = sensors.noise, sensors.step, len(joints)
    v = _late(run.t, run.v, np.full(n, sensors.velocity_delay))
    tau = _late(run.t, run.tau, sensors.torque_delay + delay * np.ones(n))
    share = of(noise.tau, "noise.tau") * np.sqrt(np.mean(tau**2, axis=0))
    level = np.hypot(share, of(noise.torque, "noise.torque"))
    q = _noisy(run.q, of(noise.q, "noise.q"), rng)
    v = _noisy(v, of(noise.v, "noise.v"), rng)
    tau = _noisy(tau, level, rng)
    q, v, tau = (
        _rounded(x, of(size, f"step.{name}"))
        for x, size, name in ((q, step.q, "q"), (v, step.v, "v"), (tau, step.tau, "tau"))
    )
    kept = np.ones(len(run.t), dtype=bool)
    if sensors.dropped:
        kept = rng.random(len(kept)) >= sensors.dropped
        if kept.sum() < 2:
            raise DataError(
                f"{kept.sum()} of {len(kept)} samples are left, wanted at least 2; lower dropped, "
                "or make the log longer"
            )
    t = run.t
    if sensors.jitter:
        spread = _TICK * np.arange(len(t))
        t = t + sensors.jitter * rng.standard_normal(len(t))
        t = np.maximum.accumulate(t - spread) + spread
    return Log(
        t=t[kept],
        q=q[kept],
        v=v[kept] if sensors.velocity else None,
        a=run.a[kept] if sensors.acceleration else None,
        tau=tau[kept],
        joints=joints,
    )


def _late(t: Array, values: Array, delay: Array) -> Array:
    """Return values as they were some time ago, by joint; before the start, as at the start."""
    if not delay.any():
        return values
    columns = [np.interp(t - d, t, x) for d, x in zip(delay, values.T, strict=True)]
    return np.column_stack(columns)


def _noisy(values: Array, level: Array, rng: np.random.Generator) -> Array:
    """Return values with white noise of a standard deviation by joint."""
    if not level.any():
        return values
    noisy: Array = values + level * rng.standard_normal(values.shape)
    return noisy


def _rounded(values: Array, step: Array) -> Array:
    """Return values rounded to steps, of the joints that have one."""
    size = np.where(step > 0, step, 1.0)
    return np.where(step > 0, np.round(values / size) * size, values)
