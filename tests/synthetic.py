"""Logs whose parameters are known exactly: inverse dynamics of a Fourier motion."""

import numpy as np

from robotid.data import Log
from robotid.excitation import random_fourier
from robotid.regressor import joint_torque_regressor
from robotid.simulation import another_robot


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
