"""Regressor alone: microseconds of processor time per sample, and the ratio to the bare loop.

The bare loop calls Pinocchio's computeJointTorqueRegressor from Python into an array made before.
"blocks" is what ``build_problem(...).blocks()`` yields, "rows" the same joint by joint, both from
Pinocchio; "compiled" the rows of compiled code, on one thread. All inertial columns, no
drive columns. The four are run in turn, the shortest time of each counts.

    python benchmarks/bench_regressor.py [--quick]
"""

import argparse

import numpy as np
from setting import ROBOTS, bare_loop, exhaust, machine, motion, robot, rows_of, side_by_side

from robotid.dynamics.torque import build_problem


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer samples")
    options = parser.parse_args()
    samples, repeats = (512, 3) if options.quick else (4096, 7)
    print("| robot | joints | bare loop, us | blocks | rows | compiled, us | ratio |")
    print("|---|---|---|---|---|---|---|")
    for name in ROBOTS:
        model = robot(name, terms=())
        trajectory = motion(model, samples, np.random.default_rng(0))
        print(row(name, model, trajectory, repeats), flush=True)
    print(f"\n{samples} samples, best of {repeats}; {machine()}")


def row(name, model, trajectory, repeats):
    N, n = trajectory.v.shape
    W = np.empty((512, n, model.layout.n_inertial))

    plain = build_problem(model, trajectory, compiled=False)
    compiled = build_problem(model, trajectory, compiled=True)
    exhaust(rows_of(compiled))  # reads the compiled code
    functions = [
        lambda: bare_loop(model, trajectory, W),
        lambda: exhaust(plain.blocks()),
        lambda: exhaust(rows_of(plain)),
        lambda: exhaust(rows_of(compiled)),
    ]
    loop, blocks, rows, fast = side_by_side(functions, repeats)
    cells = (
        f"{blocks / loop:.2f}",
        f"{rows / loop:.2f}",
        f"{fast / N * 1e6:.2f}",
        f"{fast / loop:.3f}",
    )
    return f"| {name} | {n} | {loop / N * 1e6:.2f} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
