"""Joints with servos of their own, simulated apart from the package: for logs of commands."""

from dataclasses import dataclass, replace

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
    """Return the log of servos that are told commands(t), shape (N, n).

    The force of Coulomb friction is implicit, so joints stick; couple(t, q) shifts what encoders
    see, as a base that moves; a command is updated every so many rows.
    """
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
