"""Logs of drives that do more than the friction model says, and the finding that must say so."""

from dataclasses import dataclass

import numpy as np

from robotid.data.log import Log
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulator import another_robot
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.parameters import Coupling


@dataclass(frozen=True)
class Effect:
    """What a drive adds to the torque, in sizes of the joint's typical torque."""

    code: str
    torque: object  # function of time, position, speed, rigid torque and typical torque


def _counterbalance(t, q, v, load, usual):
    """A spring between points 0.6 m and 0.15 m from the axis, 0.4 m long at rest."""
    length = np.sqrt(0.6**2 + 0.15**2 + 2 * 0.6 * 0.15 * np.cos(q - 0.5))
    pull = (length - 0.4) * 0.6 * 0.15 * np.sin(q - 0.5) / length
    return usual * pull / np.std(pull) * 0.5


def _windup(t, q, v, load, usual):
    """Friction builds up over 0.03 rad after each reversal."""
    turns = np.diff(np.sign(v), prepend=0) != 0
    last = np.maximum.accumulate(np.where(turns, np.arange(len(v)), 0))
    return -0.4 * usual * np.sign(v) * np.exp(-np.abs(q - q[last]) / 0.05)


def _of(code, law):
    """Return an effect in sizes of the typical torque, from time, position and speed."""
    return Effect(code, lambda t, q, v, load, usual: usual * law(t, q, v))


EFFECTS = {
    "stribeck": _of(
        "friction_shape", lambda t, q, v: 0.25 * np.sign(v) * np.exp(-((v / 0.15) ** 2))
    ),
    "saturating": _of("friction_shape", lambda t, q, v: 0.4 * np.cbrt(v)),
    "load": Effect(
        "load_friction", lambda t, q, v, load, usual: 0.1 * np.sign(v) * np.abs(load)
    ),
    "periodic": _of(
        "position_periodic", lambda t, q, v: 0.15 * (np.cos(3 * q + 0.4) + 0.7 * np.sin(4 * q))
    ),
    "ripple": _of("position_periodic", lambda t, q, v: 0.15 * np.cos(13 * q + 0.4)),
    "harmonic drive": _of("position_periodic", lambda t, q, v: 0.15 * np.cos(40 * q + 0.4)),
    "spring": _of("spring", lambda t, q, v: 0.3 * (q - 0.2)),
    "counterbalance": Effect("spring", _counterbalance),
    "windup": Effect("backlash", _windup),
    "drift": _of("drift", lambda t, q, v: 0.3 * np.sign(v) * (1 - t / t[-1])),
}  # fmt: skip
#: What other masses can imitate: 40 N m of the lift of a UR5 with its arm stretched out.
BALANCING = {"balancing": Effect("spring", lambda t, q, *_: 40.0 * np.cos(q + 0.1))}


def coloured(rng, shape, memory):
    """Return noise of variance 1 that forgets after so many samples, shape (N, n); 0 is white."""
    white = rng.standard_normal(shape)
    if not memory:
        return white
    from scipy.signal import lfilter

    keep = np.exp(-1.0 / memory)
    return lfilter([np.sqrt(1 - keep**2)], [1.0, -keep], white, axis=0)


def log_with(
    model, seed, effect=None, joint=1, *, duration=30.0, rate=100.0, noise=0.02, memory=0,
    coupling=None, part=0, size=1.0,
):  # fmt: skip
    """Return a log of a robot like the model whose drives are viscous and Coulomb, but for one."""
    # The seed makes the robot, with ``part`` also motion and noise; noise is the share of each
    # torque's typical size, memory its correlation time [samples]; coupling has ratios of a drive
    # that turns with several joints.
    rng = np.random.default_rng([seed, part])
    truth = model if coupling is None else model.from_urdf(
        model.tree.path, joints=model.joints, couplings=[Coupling("motor", coupling)]
    )  # fmt: skip
    pi = another_robot(truth, np.random.default_rng(seed))
    t = np.arange(round(duration * rate) + 1) / rate
    q, v, a = random_fourier(model, rng, period=duration).evaluate(t)
    Y = joint_torque_regressor(truth, q, v, a).reshape(len(t), len(model.joints), -1)
    tau = Y @ pi
    added = np.zeros_like(tau)
    if effect is not None:
        load = Y[:, joint, : truth.layout.n_inertial] @ pi[: truth.layout.n_inertial]
        usual = np.sqrt(np.mean(tau[:, joint] ** 2))
        added[:, joint] = size * (EFFECTS | BALANCING)[effect].torque(
            t, q[:, joint], v[:, joint], load, usual
        )
    level = noise * np.sqrt(np.mean(tau**2, axis=0))
    return Log(
        t=t, q=q + 2e-5 * rng.standard_normal(q.shape), v=v + 2e-4 * rng.standard_normal(q.shape),
        tau=tau + added + level * coloured(rng, tau.shape, memory), joints=model.joints,
        path=f"run{part}.csv",
    )  # fmt: skip
