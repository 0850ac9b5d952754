"""Joints with servos of their own, simulated apart from the package: for logs of commands."""

from dataclasses import dataclass

import numpy as np

from robotid.data.log import Log


@dataclass(frozen=True)
class Servo:
    """J a = clip(kp (q_ref(t - delay) - q) - kd v) - viscous v - coulomb sign(v)."""

    stiffness: float = 400.0  # kp / J [1/s^2]
    damping: float = 28.0  # (kd + viscous) / J [1/s]
    coulomb: float = 0.2  # [rad/s^2]
    delay: float = 0.01  # [s]
    top: float = np.inf  # speed that it never exceeds [rad/s]
    play: float = 0.0  # backlash between drive and joint [rad]
    quantum: float = 0.0  # of the encoder [rad]
    noise: float = 1e-4  # [rad]


STEP = 1e-3  # [s]


def record(commands, servos, *, rate=200.0, duration=20.0, seed=0, couple=None, hold=1):
    """Return the log of servos that are told commands(t), shape (N, n)."""
    # The force of Coulomb friction is implicit, so joints stick; couple(t, q) shifts what encoders
    # see, as a base that moves; a command is updated every so many rows.
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration / STEP)) * STEP
    told = hold / rate * np.floor(t / (hold / rate) + 1e-9)
    q_ref = commands(told)
    n = q_ref.shape[1]
    path = np.column_stack([_follow(x, s) for x, s in zip(q_ref.T, servos, strict=True)])
    every = round(1 / (rate * STEP))
    rows = slice(None, None, every)
    seen = path[rows] + np.array([s.noise for s in servos]) * rng.standard_normal(path[rows].shape)
    if couple is not None:
        seen = seen + couple(t[rows], path[rows])
    quantum = np.array([s.quantum for s in servos])
    coarse = np.round(seen / np.where(quantum, quantum, 1)) * quantum
    seen = np.where(quantum, coarse, seen)
    names = tuple(f"joint_{j}" for j in range(n))
    return Log(t[rows], seen, np.zeros_like(seen), names, q_ref=q_ref[rows], has_torque=False)


def _follow(commands, servo):
    """Return where one joint is at each step; plain comparisons are faster than max and min."""
    wanted, late = commands.tolist(), round(servo.delay / STEP)
    k, top, half = servo.stiffness, servo.top, servo.play / 2
    inertia = 1 + STEP * servo.damping + STEP**2 * k
    held = STEP * servo.coulomb / (1 + STEP * servo.damping)
    q, v, joint, path = wanted[0], 0.0, wanted[0], []
    for told in [wanted[0]] * late + wanted[: len(wanted) - late]:
        path.append(joint)
        free = (v + STEP * k * (told - q)) / inertia
        v = free - held if free > held else free + held if free < -held else 0.0
        v = top if v > top else -top if v < -top else v
        q += STEP * v
        joint = q - half if joint < q - half else q + half if joint > q + half else joint
    return path


def chirps(amplitudes, fastest, *, duration=20.0, slowest=0.1, shift=0.7):
    """Return commands: a chirp per joint, of another phase and rate each: none are alike."""
    amplitudes = np.asarray(amplitudes, dtype=float)

    def commands(t):
        phases = []
        for j in range(len(amplitudes)):
            top = fastest * (1 - 0.07 * j)
            sweep = slowest * t + (top - slowest) * t**2 / (2 * duration)
            phases.append(2 * np.pi * sweep + shift * j)
        return amplitudes * np.sin(np.stack(phases, axis=1))

    return commands
