"""Designing a motion: how good after how long, beside random motions and a plain optimiser.

    python benchmarks/bench_excitation.py [--robots] [--quick]

Panda (arm) and UR10, 10 s, 5 harmonics, position, velocity and torque limits of the URDF times
0.9, self-collision and the floor at 2 cm. The criterion is D: minus the mean logarithm of the
eigenvalues of the base problem's information, the smaller the better; 0.1 less are intervals 5 %
narrower. Every motion that is counted keeps all limits on the grid of its design; those of
"design" are scaled until they keep them on a grid 15 times finer. How fast one start settles is
measured by ``bench_designs.py``. All times are of the processor. SLSQP has the same start,
objective and grid, gradients by differences, and the limits at every fifth instant; each of its
iterates is then scaled until it keeps the limits, as a random motion is, and the best counts.

``--robots``: twelve robots through excite, simulate with noise, and identify.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import contextlib
import io
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import scipy.optimize

from robotid.cli import main as robotid
from robotid.design.design import FourierBasis
from robotid.design.clearance import Clearance
from robotid.design.design import Designer
from robotid.design.limits import MotionLimits
from robotid.robot.examples import example_urdf

CASES = ("panda", "UR10")
DURATION, HARMONICS = 10.0, 5
EVERY = 5  # instants at which SLSQP is held to the limits
ARM = [f"arm_{i}_joint" for i in range(1, 8)]
ROBOTS = {  # the joints that move, if not all
    "finger_edu": (),
    "so101": (),
    "kinova": (),
    "ur3_robot": (),
    "ur5_gripper": (),
    "xarm7": (),
    "z1": (),
    "panda": (),
    "talos_left_arm": (),
    "tiago_no_hand": ("torso_lift_joint", *ARM),
    "talos_reduced": ("torso_1_joint", "torso_2_joint", *(f"arm_left_{i}_joint" for i in (1, 2))),
    "anymal": ("LF_HAA", "LF_HFE", "LF_KFE"),
    "double_pendulum_continuous": (),  # states no speeds
}


def designer(name):
    model = setting.robot(name)
    limits = MotionLimits.of_model(model)
    clearance = Clearance(model, floor=0.0)
    basis = FourierBasis(DURATION, HARMONICS)
    return Designer.of_model(model, basis, limits, clearance=clearance)


def run(*words):
    """Run a command; return its code and what it said."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = robotid([str(word) for word in words])
    return code, said.getvalue()


def must(*words):
    code, said = run(*words)
    if code:
        raise SystemExit(f"robotid {' '.join(map(str, words))}: {said}")
    return said


def record(folder, robot, name, motion, seed):
    """Simulate a motion with noise of 2 % in the torque; return the log, the truth beside it."""
    log = folder / f"{name}.parquet"
    plant = ("--seed", seed, "--rate", 200, "--torque-noise", 0.02, "--controller", "perfect")
    must("simulate", *robot, motion, "--out", log, *plant)
    return log


def identified(folder, robot, log):
    """Identify a log; return its result's folder and the errors in standard errors."""
    out = folder / f"{log.stem}-result"
    must("identify", robot[0], log, *robot[1:], "--out", out, "--friction", "viscous+coulomb")
    truth = json.loads(log.with_suffix(".truth.json").read_text())["base_parameters"]
    found = json.loads((out / "result.json").read_text())["base_parameters"]
    true = {entry["name"]: entry["value"] for entry in truth}
    pairs = [(e["value"] - true[e["name"]], e["std_error"]) for e in found if e["std_error"]]
    error, std = np.array(pairs).T
    return out, np.abs(error / std)


def robot_row(folder, name, joints, seconds):
    robot = (example_urdf(f"{name}.urdf"), *(("--joints", ",".join(joints)) if joints else ()))
    motion, initialised = folder / f"{name}-motion.parquet", time.monotonic()
    code, said = run(
        "excite", *robot, "--out", motion, "--json", "--starts", 1, "--seconds", seconds
    )
    if code and "has no limit of" in said:
        return f"| {name} | its URDF lacks limits |" + " -- |" * 5
    if code:
        raise SystemExit(f"{name}: {said}")
    design = json.loads(said)
    taken = time.monotonic() - initialised
    errors = identified(folder, robot, record(folder, robot, name, motion, 1))[1]
    condition, rest = design["condition_number"], time.monotonic() - initialised - taken
    return (
        f"| {name} | {len(design['joints'])} | {len(errors)} | "
        f"{'--' if condition is None else f'{condition:.3g}'} | {np.median(errors):.2f} | "
        f"{100 * np.mean(errors < 1.96):.0f} % | {taken:.0f} + {rest:.0f} |"
    )


def all_robots(seconds, names):
    print("| robot | joints | base parameters | condition | median error, standard errors | "
          "within 1.96 | excite + rest, s |")  # fmt: skip
    print("|---" * 7 + "|")
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            print(robot_row(Path(folder), name, ROBOTS[name], seconds), flush=True)


class TimeIsOver(Exception):
    pass


def slsqp(task, start, seconds):
    """Return the history of SLSQP by differences: time and criterion of each better motion."""
    unit, least = task.limits.sizes[0], task.clearance.least
    initialised, history, known = time.monotonic(), [], {}

    def looked_at(x):
        key = x.tobytes()
        if key not in known:
            if time.monotonic() - initialised > seconds:
                raise TimeIsOver
            if len(known) > 2 * start.size:  # the differences of value and limits are the same
                known.clear()
            used, _, rows = free._constraints(x.reshape(start.shape) * unit)
            objective = free.judged(free.matrix(rows))[0]
            placed = task.clearance.placed(rows.motion[0])
            near = task.clearance.near(placed, least + 0.03).distance[:, ::EVERY]
            finite = used[np.isfinite(task.limits.sizes).any(axis=1), ::EVERY]
            distance = np.minimum(near.min(axis=0), least + 0.03)
            known[key] = objective, np.r_[1.0 - finite.ravel() ** 2, (distance - least) / 0.05]
        return known[key]

    def keep(x):
        C = task._feasible(x.reshape(start.shape) * unit, 1.0)
        objective = task._objective(C)
        if not history or objective < history[-1][1]:
            history.append((time.monotonic() - initialised, objective))

    free = replace(task, clearance=None)
    x = (start / unit).ravel()
    keep(x)
    with contextlib.suppress(TimeIsOver):
        scipy.optimize.minimize(
            lambda x: looked_at(x)[0],
            x,
            method="SLSQP",
            callback=keep,
            constraints={"type": "ineq", "fun": lambda x: looked_at(x)[1]},
            options={"maxiter": 10_000},
        )
    return history


def at(history, seconds):
    """Return the best criterion of a history after some time."""
    return min((value for when, value in history if when <= seconds), default=np.nan)


def against_time(name, task, budgets, count):
    """Print the criterion against time; return the design that took as long as it wanted."""
    rng = np.random.default_rng(1)
    initialised = time.monotonic()
    random = [(task.random(rng), time.monotonic() - initialised) for _ in range(count)]
    values = [(when, task._objective(C)) for C, when in random]
    best = at(values, np.inf)
    starts = np.random.default_rng(0)  # those that a design begins with
    start = min((task.random(starts) for _ in range(10)), key=task._objective)
    plain = slsqp(task, start, budgets[-1])
    for seconds in budgets:
        found = task.design(np.random.default_rng(0), starts=1000, seconds=seconds)
        cells = f"{found.objective:.3f} ({found.seconds:.1f} s) | {at(plain, seconds):.3f}"
        print(f"| {name} | {seconds:g} s | {cells} | {at(values, seconds):.3f} |", flush=True)
    usual = task.design(np.random.default_rng(0), starts=1)
    cells = f"{usual.objective:.3f} | -- | {best:.3f}"
    print(f"| {name} | one start: {usual.seconds:.1f} s; {count} random: {random[-1][1]:.0f} s | "
          f"{cells} |", flush=True)  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", action="store_true", help="also twelve robots to convergence")
    parser.add_argument(
        "--quick", action="store_true", help="short times and one robot, as a trial"
    )
    options = parser.parse_args()
    cases = CASES[1:] if options.quick else CASES
    budgets, count = ((1,), 10) if options.quick else ((1, 10, 60), 500)
    tasks = {name: designer(name) for name in cases}
    print("| robot | after | design (time) | SLSQP | best random |")
    print("|---" * 5 + "|")
    with mock.patch.object(time, "monotonic", time.process_time):
        for name, task in tasks.items():
            against_time(name, task, budgets, count)
        if options.robots:
            print()
            all_robots(1 if options.quick else 10, list(ROBOTS)[-2:] if options.quick else ROBOTS)
    print(f"\n{setting.machine()}")


if __name__ == "__main__":
    main()
