"""Servos drawn at random, and logs of commands that show all or hide something."""

from dataclasses import replace

import numpy as np
from helpers.servos import Servo, chirps, record


def some_servos(rng, count=3):
    """Return servos of 2 to 6 Hz, well or badly damped, with friction, delay, noise and steps."""
    found = []
    for _ in range(count):
        speed, damping = rng.uniform(12, 40), rng.uniform(0.5, 1.2)
        found.append(
            Servo(
                stiffness=speed**2,
                damping=2 * damping * speed,
                coulomb=rng.uniform(0, 2),
                delay=rng.uniform(0, 0.03),
                noise=rng.uniform(1e-5, 3e-4),
                quantum=rng.choice([0, 1e-4, 1.5e-3]),
            )
        )
    return found


def bandwidth(servo):
    """Return about where a servo follows half the power [Hz]."""
    speed = np.sqrt(servo.stiffness)
    return speed / (2 * np.pi) * max(0.6, 1.3 - 0.25 * servo.damping / speed)


def good_commands(rng, servos):
    """Return commands that show all there is, by name: to 2.5 times the largest bandwidth."""
    n, top = len(servos), 2.5 * max(bandwidth(servo) for servo in servos)
    sizes, shift = rng.uniform(0.1, 0.5, n), rng.uniform(0, 6)
    f, phases = rng.uniform(0.1, top, (25, n)), rng.uniform(0, 6, (25, n))
    levels = sizes * rng.choice([-1.0, 1.0], (400, n))
    holds = 0.3 + 0.07 * np.arange(n)

    def multisine(t):
        waves = (np.sin(2 * np.pi * a * t[:, None] + b) for a, b in zip(f, phases, strict=True))
        return sizes / 12 * sum(waves)

    def steps(t):
        return np.take_along_axis(levels, (t[:, None] / holds).astype(int), axis=0)

    return {"chirp": chirps(sizes, top, shift=shift), "multisine": multisine, "steps": steps}


def faulty_logs(rng):
    """Yield what is wrong with commands or joints, the finding that names it, and the log."""
    servos = some_servos(rng)
    first, *others = servos
    widths = [bandwidth(servo) for servo in servos]
    sizes, small = rng.uniform(0.1, 0.5, 3), rng.uniform(0.5, 1)
    loose = rng.uniform(0.06, 0.12) * 0.3 / max(sizes[0], 0.15)

    def told(size=sizes[0], top=None):
        return chirps([size, *sizes[1:]], top or 2.5 * max(widths))

    def of(**changes):
        return [replace(first, **changes), *others]

    def give(t, q):
        return loose * np.column_stack([0 * t, q[:, 0] + q[:, 2], 0 * t])

    sticky = of(coulomb=0.01 * first.stiffness, quantum=0.0, noise=1e-5)
    weak = of(top=0.3 * sizes[0] * np.sqrt(first.stiffness))
    still = chirps([sizes[0], 0, sizes[2]], 2.5 * max(widths))
    good = record(told(), servos)
    late = good.window(0.7, 18.7).q_ref
    logs = {
        "chirp to a third of the bandwidth": ("slow_command", told(top=0.35 * min(widths)), servos),
        "sweeps within friction": ("small_command", told(0.004 * small), sticky),
        "sweeps within backlash": ("small_command", told(0.01 * small), of(play=0.02, quantum=0.0)),
        "sweeps of few encoder steps": ("small_command", told(0.006 * small), of(quantum=0.0015)),
        "a third of the speed that is needed": ("saturated", told(), weak),
        "two joints commanded alike": (
            "proportional_commands", lambda t: told()(t)[:, [0, 0, 2]] * [1, -0.6, 1], servos,
        ),
    }  # fmt: skip
    for name, (code, commands, driven) in logs.items():
        yield name, code, record(commands, driven)
    yield "base that moves", "moved_by_others", record(still, servos, couple=give)
    yield "five rows per period", "slow_sampling", record(told(), servos, rate=5 * max(widths))
    yield (
        "command logged with a delay of 0.3 s",
        "delayed_command",
        replace(good.window(1.0, 19.0), q_ref=late),
    )
    yield (
        "two command columns exchanged",
        "command_order",
        replace(good, q_ref=good.q_ref[:, [1, 0, 2]]),
    )
    yield "a command negated", "command_sign", replace(good, q_ref=good.q_ref * [1, -1, 1])
    stop = np.array([0.6 * np.abs(good.q[:, 0]).max(), 9, 9])
    noise = 1e-4 * rng.standard_normal(good.q.shape)
    yield (
        "end stop at 60 % of the motion",
        "end_stop",
        replace(good, q=np.minimum(good.q, stop) + noise),
    )
    steps = record(good_commands(rng, servos)["steps"], servos)
    q = steps.q.copy()
    q[1000:1800, 0] = q[1000, 0]
    yield "drive off for 4 s, steps", "not_followed", replace(steps, q=q)
