"""How time grows with samples and with joints: seconds from arrays in memory to the estimate.

Samples from 1e3 to 1e6 for the panda, then 2 to 44 joints at one number of samples; friction,
armature and offset of every joint. "full QR" is the plain way in the same process: Pinocchio in a
Python loop, W stacked, numpy's QR (without the estimate); "-" where it would need more than
--memory. All ways of a line are run in turn, the shortest time of each counts.

    python benchmarks/bench_scaling.py [--quick] [--cpu] [--memory GIB]
"""

import argparse
import os
import time

import numpy as np
from setting import full_qr, identify, machine, motion, peak_memory, robot, side_by_side

from robotid.dynamics.base_parameters import structural_mapping

BY_JOINTS = ("planar 2R", "UR10", "panda", "Solo12", "TIAGo", "TALOS reduced", "TALOS")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few samples, at most 12 joints")
    parser.add_argument("--cpu", action="store_true", help="processor time, for a busy machine")
    parser.add_argument("--memory", type=float, default=3.0, help="GiB for full QR")
    options = parser.parse_args()
    clock = time.process_time if options.cpu else time.perf_counter
    threads = 1 if options.cpu else len(os.sched_getaffinity(0))  # they save no processor time
    sizes = [300, 1_000] if options.quick else [1_000, 10_000, 100_000, 1_000_000]
    lines = [("panda", samples) for samples in sizes]
    names, samples = (BY_JOINTS[:4], 300) if options.quick else (BY_JOINTS, 2_000)
    lines += [(name, samples) for name in names]
    print(
        "| robot | joints | base columns | samples | full QR, s | plain, s | ratio | compiled, s "
        f"| ratio | {threads} threads, s | us per sample | memory, MiB |"
    )
    print("|" + "---|" * 12)
    for name, count in lines:
        print(row(name, count, threads, clock, options.memory * 2**30), flush=True)
    print(f"\n{'processor' if options.cpu else 'wall-clock'} time; {machine()}")


def row(name, samples, threads, clock, largest):
    model = robot(name)
    trajectory, mapping = (
        motion(model, samples, np.random.default_rng(0)),
        structural_mapping(model),
    )
    identify(model, trajectory, True, 1)  # reads the compiled code
    ways = {
        "plain": lambda: identify(model, trajectory, False, 1),
        "compiled": lambda: identify(model, trajectory, True, 1),
    }
    if threads > 1:
        ways["threads"] = lambda: identify(model, trajectory, True, threads)
    # numpy holds W, its selected columns, their copy with tau and the one it works on
    if 4 * 8 * samples * model.n_rows * len(model.layout.names) < largest:
        ways["full"] = lambda: full_qr(model, mapping, trajectory)
    seconds = side_by_side(list(ways.values()), 3 if samples <= 100_000 else 1, clock)
    times = dict(zip(ways, seconds, strict=True))
    full = times.get("full")
    cells = [f"{full:.3f}" if full else "-"]
    for key in ("plain", "compiled"):
        cells.append(f"{times[key]:.3f}" if key in times else "-")
        cells.append(f"{full / times[key]:.1f}" if full and key in times else "-")
    cells.append(f"{times['threads']:.3f}" if "threads" in times else "-")
    cells.append(f"{min(times[key] for key in ways if key != 'full') / samples * 1e6:.1f}")
    memory = peak_memory(lambda: identify(model, trajectory, True, threads))
    head = f"| {name} | {len(model.joints)} | {len(mapping.independent)} | {samples:.0e} | "
    return head + " | ".join(cells) + f" | {memory:.0f} |"


if __name__ == "__main__":
    main()
