"""Logs whose parameters are known exactly: inverse dynamics of a Fourier motion."""

import numpy as np

from robotid.data.log import Log
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulation_settings import Controller, Payload, Sensors, Simulation
from robotid.dynamics.simulation.simulator import Noise, another_robot, simulate

EXACT = Sensors(acceleration=True)


def perfect(model, pi, motion, rng, *, rate, duration, sensors=EXACT, payload=None):
    """Return the log of a robot that follows a motion exactly, by inverse dynamics."""
    settings = Simulation(
        controller=Controller("perfect"), sensors=sensors, payload=payload or Payload()
    )
    return simulate(model, pi, motion, rate=rate, duration=duration, rng=rng, settings=settings)


def exact_log(model, pi, rng, *, samples=600, rate=50.0, noise=None):
    """Return a log with measured velocity and acceleration; noise: sigma per joint [N m]."""
    motion = random_fourier(model, rng, period=samples / rate)
    levels = {} if noise is None else np.broadcast_to(noise, len(model.joints)).tolist()
    level = dict(zip(model.joints, levels, strict=True)) if levels else 0.0
    sensors = Sensors(acceleration=True, noise=Noise(torque=level))
    return perfect(
        model, pi, motion, rng, rate=rate, duration=(samples - 1) / rate, sensors=sensors
    )


def truth(model, seed=0):
    return another_robot(model, np.random.default_rng(seed))


def payload_log(model, rng, *, mass=2.0, at=10.0, duration=15.0, rate=200.0, noise=0.02):
    """Return the log of a robot that picks up a load while it moves, without velocities."""
    # The load, a ball of 5 cm, hangs 10 cm behind the last joint; noise: share of each torque.
    ball = 0.4 * mass * 0.05**2
    load = Payload(
        model.layout.bodies[-1], mass, com=(0.0, 0.0, 0.1), start=at,
        inertia=(ball, 0.0, ball, 0.0, 0.0, ball),
    )  # fmt: skip
    sensors = Sensors(velocity=False, noise=Noise(q=2e-5, tau=noise))
    motion = random_fourier(model, rng, period=10.0)
    return perfect(
        model, truth(model), motion, rng, rate=rate, duration=duration, sensors=sensors,
        payload=load,
    )  # fmt: skip


def sine_log(count=60, rate=50, **changes):
    """Return a log of two joints that swing, from 1000 s on."""
    t = 1000.0 + np.arange(count) / rate
    phase = t[:, None] * [2.0, 3.0]
    swing = {"q": np.sin(phase), "v": np.cos(phase) * [2.0, 3.0], "tau": 10 * np.cos(phase)}
    return Log(**({"t": t, "joints": ("shoulder", "elbow")} | swing | changes))
