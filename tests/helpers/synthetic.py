"""Logs whose parameters are known exactly: inverse dynamics of a Fourier motion."""

import numpy as np

from robotid.logs.data import Log
from robotid.regressor.torque import joint_torque_regressor
from robotid.simulation.closed_loop import another_robot
from robotid.simulation.motions import random_fourier


def exact_log(model, pi, rng, *, samples=600, rate=50.0, noise=None):
    """Return a log with measured velocity and acceleration; noise: sigma per joint [N m]."""
    t = np.arange(samples) / rate
    q, v, a = random_fourier(model, rng, period=samples / rate).evaluate(t)
    tau = (joint_torque_regressor(model, q, v, a) @ pi).reshape(v.shape)
    if noise is not None:
        tau = tau + noise * rng.standard_normal(tau.shape)
    return Log(t=t, q=q, tau=tau, joints=model.joints, v=v, a=a)


def truth(model, seed=0):
    return another_robot(model, np.random.default_rng(seed))


def payload_log(model, rng, *, mass=2.0, at=10.0, duration=15.0, rate=200.0, noise=0.02):
    """Return the log of a robot that picks up a load while it moves, without velocities.

    The load, a ball of 5 cm, hangs 10 cm behind the last joint; noise: share of each torque.
    """
    pi = truth(model)
    t = np.arange(round(duration * rate) + 1) / rate
    q, v, a = random_fourier(model, rng, period=10.0).evaluate(t)
    W = joint_torque_regressor(model, q, v, a).reshape(len(t), -1, len(pi))
    loaded, c, moment = pi.copy(), 0.1, 0.4 * mass * 0.05**2
    last = slice(model.layout.n_inertial - 10, model.layout.n_inertial)
    own = moment + mass * c**2
    loaded[last] += [mass, 0.0, 0.0, mass * c, own, 0.0, own, 0.0, 0.0, moment]
    tau = np.where((t >= at)[:, None], W @ loaded, W @ pi)
    tau += noise * np.sqrt(np.mean(tau**2, axis=0)) * rng.standard_normal(tau.shape)
    return Log(t=t, q=q + 2e-5 * rng.standard_normal(q.shape), tau=tau, joints=model.joints)
