"""Reduction alone: microseconds of processor time per sample from rows in memory to the factor.

The rows of base columns are computed before; each way then reduces copies of them: numpy's QR of
the stacked [W_b tau], LAPACK's geqrf block by block on all columns, robotid's tpqrt per joint.
Error: largest difference of the estimate from numpy's full QR, relative to the largest parameter;
of the Gram matrix on the same data for comparison.

    python benchmarks/bench_reduction.py [--quick]
"""

import argparse

import numpy as np
import scipy.linalg
from setting import ROBOTS, machine, motion, robot, rows_of, side_by_side

from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import Triangle
from robotid.dynamics.torque import build_problem


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer samples, no humanoid")
    options = parser.parse_args()
    samples = 1024 if options.quick else 4096
    names = [name for name in ROBOTS if not (options.quick and name == "TALOS")]
    print("| robot | base columns | numpy, us | geqrf, us | per joint, us | ratio | error | Gram |")
    print("|---|---|---|---|---|---|---|---|")
    for name in names:
        print(row(name, samples // 8 if name == "TALOS" else samples), flush=True)
    print(f"\n{samples} samples (TALOS an eighth of it); {machine()}")


def row(name, samples):
    model = robot(name)
    mapping = structural_mapping(model)
    trajectory = motion(model, samples, np.random.default_rng(0))
    problem = mapping.reduce(build_problem(model, trajectory, compiled=False))
    stacked = np.vstack([np.column_stack([W, tau]) for W, tau, _ in problem.blocks()])
    rows = [[np.array(x, order="F") for x in block] for block in rows_of(problem)]
    times = side_by_side(
        [
            lambda: np.linalg.qr(stacked, mode="r"),
            lambda: block_qr(stacked, 512 * model.n_rows),
            lambda: per_joint(rows),
        ],
        1 if name == "TALOS" else 3,
    )
    full = solve(np.linalg.qr(stacked, mode="r"))
    ours = solve(scatter(per_joint(rows), problem.sources[0].columns, stacked.shape[1]))
    gram = stacked.T @ stacked
    by_gram = np.linalg.lstsq(gram[:-1, :-1], gram[:-1, -1], rcond=None)[0]
    size = np.abs(full).max()
    errors = [f"{np.abs(x - full).max() / size:.0e}" for x in (ours, by_gram)]
    cells = [f"{t / samples * 1e6:.2f}" for t in times] + [f"{times[0] / times[2]:.1f}", *errors]
    return f"| {name} | {len(mapping.independent)} | " + " | ".join(cells) + " |"


def block_qr(stacked, length):
    R = np.zeros((0, stacked.shape[1]))
    for k in range(0, len(stacked), length):
        rows = np.asfortranarray(np.vstack([R, stacked[k : k + length]]))
        R = np.triu(scipy.linalg.lapack.dgeqrf(rows, overwrite_a=True)[0][: rows.shape[1]])
    return R


def per_joint(blocks):
    triangles = [Triangle(rows.shape[1]) for rows in blocks[0]]
    for block in blocks:
        for triangle, rows in zip(triangles, block, strict=True):
            triangle.fold(rows.copy(order="F"))
    return [triangle.R for triangle in triangles]


def scatter(factors, columns, width):
    parts = []
    for R, own in zip(factors, columns, strict=True):
        parts.append(np.zeros((len(R), width)))
        parts[-1][:, np.append(own, width - 1)] = R
    return np.linalg.qr(np.vstack(parts), mode="r")


def solve(R):
    size = R.shape[1] - 1
    return scipy.linalg.solve_triangular(R[:size, :size], R[:size, size])


if __name__ == "__main__":
    main()
