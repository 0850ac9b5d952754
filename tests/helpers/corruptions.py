"""Ways to spoil a clean log, with the codes of the finding that must name each."""

from dataclasses import dataclass, replace
from functools import cache, reduce

import numpy as np

from robotid.data.log import Log
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulation_settings import Controller, Simulation
from robotid.dynamics.simulation.simulator import Noise, another_robot, simulate
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

NOISE = Noise(q=2e-5, v=2e-4, tau=0.02)
ROBOTS = {
    "ur5": ("ur5_robot.urdf", None),
    "panda": ("panda.urdf", [f"panda_joint{i}" for i in range(1, 8)]),
    "tiago": ("tiago.urdf", ["torso_lift_joint", *(f"arm_{i}_joint" for i in range(1, 8))]),
}


@cache
def robot(name, **options):
    file, joints = ROBOTS[name]
    return RobotModel.from_urdf(example_urdf(file), joints=joints, **options)


def clean_log(
    model, seed, *, pi=None, rate=100.0, duration=20.0, path="run.csv", controller="perfect"
):
    """Return the log of a robot like the model, but with other masses, a tool, friction and noise.

    It follows its motion exactly, unless a controller is named that has to make it do so.
    """
    rng = np.random.default_rng(seed)
    truth = another_robot(model, rng) if pi is None else pi
    motion = random_fourier(model, rng, period=duration / 2)
    settings = Simulation(controller=Controller(controller))
    log = simulate(
        model, truth, motion, rate=rate, duration=duration, rng=rng, noise=NOISE, settings=settings
    )
    return replace(log, path=path)


@cache
def controlled_log(name, seed, *, rate=100.0, duration=20.0):
    """Return the clean log of a robot under a controller, as real logs are: made once a process."""
    return clean_log(robot(name), seed, rate=rate, duration=duration, controller="feedforward")


@dataclass(frozen=True)
class Case:
    """How a log's table is changed, the robot it is said to be of, and what must be found."""

    codes: tuple
    change: object = staticmethod(lambda table: table)
    urdf: str = "ur5_robot.urdf"
    gravity: tuple = (0.0, 0.0, -9.81)


def table_of(log: Log):
    columns = {"time": log.t}
    for kind, values in (("q", log.q), ("dq", log.v), ("tau", log.tau)):
        columns |= {f"{kind}_{joint}": values[:, j] for j, joint in enumerate(log.joints)}
    return columns


def column(prefix, function):
    """Change the columns that begin so by a function of values and time."""
    return lambda table: {
        name: function(x.copy(), table["time"]) if name.startswith(prefix) else x
        for name, x in table.items()
    }


def swap(*pairs):
    return lambda table: (
        table | {name: table[other] for a, b in pairs for name, other in ((a, b), (b, a))}
    )


def rows(function):
    return lambda table: {name: function(values) for name, values in table.items()}


def scaled(prefix, factor):
    return column(prefix, lambda x, _t: x * factor)


def late(prefix, delay):
    return column(prefix, lambda x, t: np.interp(t - delay, t, x))


def delayed(log, delay, joint=""):
    table = late(f"tau_{joint}", delay)(table_of(log))
    return replace(log, tau=np.column_stack([table[f"tau_{joint}"] for joint in log.joints]))


def without(name):
    return lambda table: {key: values for key, values in table.items() if key != name}


def set_rows(where, value):
    def function(x, _t):
        x[where] = value
        return x

    return function


def both(*changes):
    return lambda table: reduce(lambda changed, change: change(changed), changes, table)


def held(prefix, length):
    return column(prefix, lambda x, _t: x[np.arange(len(x)) // length * length])


def size(x, _t):
    return np.abs(x)


def differenced(bits, name):
    """Replace a velocity by the difference of an encoder's counts."""

    def change(table):
        step = 2 * np.pi / 2**bits
        counts = np.round(table[name.replace("dq_", "q_")] / step) * step
        return {**table, name: np.gradient(counts, table["time"])}

    return change


def compensated(table, speed=0.0):
    """Take off the torque that the URDF says of the motion at a speed: 0 is gravity alone."""
    import pinocchio as pin

    model, t = robot("ur5"), table["time"]
    q, v = (np.column_stack([table[f"{x}_{joint}"] for joint in model.joints]) for x in ("q", "dq"))
    engine, a = model.pin_model, np.gradient(v, t, axis=0)
    at = zip(q, speed * v, speed**2 * a, strict=True)
    loads = np.array([pin.rnea(engine, engine.createData(), *x) for x in at])
    torques = {f"tau_{joint}": loads[:, j] for j, joint in enumerate(model.joints)}
    return {name: x - torques.get(name, 0.0) for name, x in table.items()}


def stale(table):
    kept = np.arange(len(table["time"]))
    kept[1::5] -= 1  # every fifth row repeats the one before
    return {name: x if name == "time" else x[kept] for name, x in table.items()}


A, B = "shoulder_lift_joint", "wrist_1_joint"
# fmt: off
CASES = {
    "two torque columns swapped": Case(("torque_order",), swap((f"tau_{A}", f"tau_{B}"))),
    "three torque columns turned round": Case(("torque_order",), swap(
        ("tau_elbow_joint", f"tau_{B}"), (f"tau_{B}", "tau_wrist_2_joint"),
        ("tau_wrist_2_joint", "tau_elbow_joint"))),
    "two position columns swapped": Case(("velocity_order",), swap((f"q_{A}", f"q_{B}"))),
    "two positions, velocities swapped": Case(("position_order",), swap(
        (f"q_{A}", f"q_{B}"), (f"dq_{A}", f"dq_{B}"))),
    "two joints exchanged whole": Case(("joint_order",), swap(
        (f"q_{A}", f"q_{B}"), (f"dq_{A}", f"dq_{B}"), (f"tau_{A}", f"tau_{B}"))),
    "one torque negated": Case(("torque_sign",), scaled("tau_elbow", -1)),
    "wrist torque negated": Case(("torque_sign",), scaled("tau_wrist_3", -1)),
    "all torques negated": Case(("torque_sign",), scaled("tau_", -1)),
    "one velocity negated": Case(("velocity_sign",), scaled("dq_elbow", -1)),
    "one axis negated": Case(("position_sign",), both(
        scaled("q_elbow", -1), scaled("dq_elbow", -1))),
    "one joint reversed whole": Case(("joint_axis",), both(
        scaled("q_elbow", -1), scaled("dq_elbow", -1), scaled("tau_elbow", -1))),
    "degrees": Case(("angle_unit",), both(scaled("q_", 57.29578), scaled("dq_", 57.29578))),
    "velocity in degrees": Case(("angle_unit",), scaled("dq_", 57.29578)),
    "one velocity halved": Case(("velocity_scale",), scaled("dq_elbow", 0.5)),
    "velocity in rpm": Case(("velocity_scale",), scaled("dq_", 9.5493)),
    "dead velocity channel": Case(("velocity_scale",), scaled("dq_elbow", 0.0)),
    "one velocity replaced by noise": Case(("velocity_mismatch",), column("dq_elbow_joint",
        lambda x, _t: x.std() * np.random.default_rng(0).standard_normal(len(x)))),
    "velocity of a 12-bit encoder": Case(("quantised",), differenced(12, "dq_elbow_joint")),
    "milliseconds": Case(("time_unit",), scaled("time", 1000)),
    "nanoseconds since 1970": Case(("time_unit",), column("time",
        lambda x, _t: np.round((x + 1.7e9) * 1e9))),
    "clock set by 1e6 s": Case(("clock_step",), column("time", lambda x, t: x + 1e6 * (t > 8.0))),
    "clock set by 2 s": Case(("clock_step",), column("time", lambda x, t: x + 2.0 * (t > 8.0))),
    "NaN torque": Case(("not_finite",), column("tau_elbow_joint", set_rows(300, np.nan))),
    "NaN position": Case(("not_finite",), column("q_elbow_joint", set_rows(300, np.nan))),
    "duplicate stamp": Case(("duplicate_stamp",), rows(
        lambda x: np.insert(x, 500, x[500]))),
    "swapped stamps": Case(("stamp_order",), column("time",
        lambda x, t: set_rows([700, 701], x[[701, 700]])(x, t))),
    "gap of 1 s": Case(("gap",), rows(
        lambda x: np.delete(x, slice(len(x) * 9 // 20, len(x) // 2)))),
    "torque of the URDF's model": Case(("model_torque",), lambda table: table | {
        x: table[x] - left for x, left in compensated(table, 1.0).items() if x[:3] == "tau"}),
    "torque delayed by 30 ms": Case(("torque_delay",), late("tau_", 0.03)),
    "velocity delayed by 30 ms": Case(("velocity_delay",), late("dq_", 0.03)),
    "torque clipped": Case(("clipped",), column("tau_elbow_joint",
        lambda x, _t: np.minimum(x, np.quantile(x, 0.9)))),
    "dead torque channel": Case(("constant_torque",), column("tau_wrist_2_joint",
        lambda x, _t: np.full_like(x, 3.0))),
    "torques without their sign": Case(("unsigned_torque",), column("tau_", size)),
    "one torque without its sign": Case(("unsigned_torque",), column(f"tau_{B}", size)),
    "torques held for 5 rows": Case(("repeated_torque",), held("tau_", 5)),
    "one torque held for 3 rows": Case(("repeated_torque",), held("tau_elbow", 3)),
    "gravity-compensated torques": Case(("gravity_compensated",), compensated),
    "torques without a model": Case(("gravity_compensated",), lambda x: compensated(x, 1.0)),
    "clock slow by 20 %": Case(("time_scale",), both(
        scaled("time", 0.8), lambda x: {k: y for k, y in x.items() if k[:2] != "dq"})),
    "static joint": Case(("static_joint",), both(
        column("q_wrist_3_joint", lambda x, _t: np.full_like(x, x[0])), scaled("dq_wrist_3", 0))),
    "stale rows": Case(("stale_rows",), stale),
    "torque in coarse steps": Case(("quantised",), column("tau_wrist_2_joint",
        lambda x, _t: np.round(x / np.ptp(x) * 20) * np.ptp(x) / 20)),
    "currents for torques": Case(("current_for_torque",), scaled("tau_", 0.08)),
    "one current for torque": Case(("current_for_torque",), scaled(f"tau_{A}", 0.08)),
    "URDF of a UR10": Case(("urdf_mismatch",), urdf="ur10_robot.urdf"),
    # five times the torque at the same motion: by the log alone, a gain or another robot
    "URDF of a UR3": Case(("urdf_mismatch", "current_for_torque"), urdf="ur3_robot.urdf"),
    "gravity stated along x": Case(("gravity",), gravity=(9.81, 0.0, 0.0)),
    "gravity stated upside down": Case(("gravity",), gravity=(0, 0, 9.81)),
    "gravity stated 15 deg off": Case(("gravity",), gravity=(2.54, 0.0, -9.476)),
    "missing torque column": Case(("missing_column",), without("tau_elbow_joint")),
    "position offset by 0.5 rad": Case(("position_offset",), column(f"q_{A}",
        lambda x, _t: x + 0.5)),
    "position offset by 0.2 rad": Case(("position_offset",), column(f"q_{A}",
        lambda x, _t: x + 0.2)),
    "five spikes of 1000 N m": Case(("spikes",), column("tau_elbow_joint",
        lambda x, t: set_rows(len(x) * np.arange(1, 10, 2) // 10, 1000.0)(x, t))),
    "too few rows": Case(("too_short",), rows(lambda x: x[:30])),
}
# fmt: on
