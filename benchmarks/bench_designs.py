"""One start of a design: its time to converge, and its margins to limits.

    python benchmarks/bench_designs.py [--quick]

The cases of ``bench_excitation.py``. All times are of the processor, of one thread: another load of
the machine adds little to them. Margins are those on a grid ten times as fine as that of the last
rounds. Code is compiled once per installation, before; to import Numba takes the time below.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import time
from dataclasses import replace
from unittest import mock

import numpy as np
from bench_excitation import CASES, DURATION, designer

from robotid.design.design import Multipliers
from robotid.design.information import criterion
from robotid.design.limits import LIMITS
from robotid.data.log import Trajectory
from robotid.dynamics.rows import tree_lanes

FINE = 30  # ten times 3 times the grid of the first rounds


def design_row(name, task, best, seeds):
    """Return how one start went: the median over some seeds, margins of the first."""
    found, passed = [], []
    for seed in range(seeds):
        began, values = time.monotonic(), []

        def progress(_, value, began=began, values=values):
            values.append((time.monotonic() - began, value))

        found.append(task.design(np.random.default_rng(seed), starts=1, progress=progress))
        passed.append(next((t for t, value in values if value < best), np.inf))
    seconds = [f.seconds for f in found]
    settled = sum(f.is_converged for f in found)
    fine = replace(task, finer=FINE)
    used, margin, _ = fine._constraints(found[0].motion.coefficients)
    most = np.abs(used).max(axis=(1, 2))
    shown = [f"{100 * (1 - most[LIMITS.index(k)]):.2f} %" for k in LIMITS[:2] + LIMITS[4:5]]
    return (
        f"| {name} | {best:.3f} | {np.median([f.objective for f in found]):.3f} | "
        f"{found[0].condition:.0f} | {np.median(passed):.2f} s | {np.median(seconds):.1f} s "
        f"({min(seconds):.1f} to {max(seconds):.1f}), {settled} of {seeds} | {' | '.join(shown)} | "
        f"{f'{1e3 * margin:.1f} mm' if margin < 0.01 else '> 10 mm'} |"
    )


def gradient_row(name, task, repeats):
    """Return the times of value, value with gradient, and Pinocchio's regressors."""
    finer = round(500 / (task._functions.shape[1] - 1))
    whole = replace(task, clearance=None, finer=finer)
    C, multipliers = task.random(np.random.default_rng(3)), Multipliers(0.1)
    model, t = task.information.model, np.linspace(0.0, DURATION, whole._functions.shape[1])
    q, v, a, jerk = whole._functions @ C
    segment = np.zeros(len(t), dtype=int)
    trajectory = Trajectory(
        t=t, q=q, v=v, a=a, tau=0 * q, joints=model.joints, rate=50.0, segment=segment
    )
    W = np.empty((len(t), v.shape[1], model.layout.n_inertial))

    def value():
        rows = whole.information.rows(*(whole._functions @ C)[:3])
        multipliers.of_limits(whole.limits.used(q, v, a, jerk, whole.information.torque(rows)))
        criterion(whole.name, whole.matrix(rows))

    functions = [
        value,
        lambda: whole._lagrangian(C, multipliers),
        lambda: setting.bare_loop(model, trajectory, W),
    ]
    times = 1e3 * np.array(setting.side_by_side(functions, repeats))
    return (
        f"| {name} | {v.shape[1]} x {len(t) - 1} | {times[0]:.1f} | {times[1]:.1f} | "
        f"{times[1] / times[0]:.1f} | {times[2]:.1f} |"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one robot, few motions, as a trial")
    options = parser.parse_args()
    cases, count, seeds = (CASES[1:], 20, 1) if options.quick else (CASES, 500, 5)
    initialised = time.process_time()
    tree_lanes()
    start = time.process_time() - initialised
    tasks = {name: designer(name) for name in cases}
    print(
        f"| robot | best of {count} random | design | condition | better than random after "
        "| converged: median of some seeds | margin: position | velocity | torque | distance |"
    )
    print("|---" * 10 + "|")
    for name, task in tasks.items():
        rng = np.random.default_rng(1)
        best = min(task._objective(task.random(rng)) for _ in range(count))
        with mock.patch.object(time, "monotonic", time.process_time):
            print(design_row(name, task, best, seeds), flush=True)
    print("\n| robot | joints x instants | value, ms | with gradient | ratio | Pinocchio |")
    print("|---" * 6 + "|")
    for name, task in tasks.items():
        print(gradient_row(name, task, 3 if options.quick else 20))
    print(f"\nImport of Numba: {start:.1f} s.\n\n{setting.machine()}")


if __name__ == "__main__":
    main()
