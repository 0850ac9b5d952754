"""Arrays in memory to estimate: base parameters, rows, factors and weighted least squares.

"full QR" is the plain way: Pinocchio in a loop, W stacked, numpy's QR, estimate and covariance by
ordinary least squares. All ways are run in turn in this process, the shortest counts: wall-clock
time, or with --cpu the processor's, which other work on the machine changes less. "memory" is the
largest amount that Python and NumPy hold over the input arrays, by tracemalloc in a run of its own.

    python benchmarks/bench_end_to_end.py [--quick] [--million]
    python benchmarks/bench_end_to_end.py --panda [--cpu] [--figaroh PYTHON]

--figaroh names an interpreter with FIGAROH (see bench_figaroh.py) for a column of its time.
"""

import argparse
import os
import time

import numpy as np
from bench_figaroh import compare
from setting import ROBOTS, full_qr, identify, machine, motion, peak_memory, robot, side_by_side

from robotid.dynamics.base_parameters import structural_mapping

PANDA_SIZES = (10_000, 100_000, 1_000_000)
LARGEST = 2**30  # [bytes] of W that full QR is asked to hold


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="1e3 samples only, no humanoid")
    parser.add_argument("--million", action="store_true", help="1e6 samples too (half an hour)")
    parser.add_argument("--panda", action="store_true", help="panda at 1e4, 1e5 and 1e6 only")
    parser.add_argument("--cpu", action="store_true", help="processor time, for a busy machine")
    parser.add_argument("--figaroh", metavar="PYTHON", help="interpreter with FIGAROH")
    options = parser.parse_args()
    clock = time.process_time if options.cpu else time.perf_counter
    sizes = [1_000] if options.quick else [1_000, 10_000, 100_000]
    sizes += [1_000_000] if options.million else []
    threads = len(os.sched_getaffinity(0))
    if options.panda:
        print(panda_table(threads, clock, options.figaroh), end="")
        print(f"\n{'processor' if options.cpu else 'wall-clock'} time; {machine()}")
        return
    print(
        "| robot | samples | full QR, s | plain, s | ratio | compiled, s | ratio "
        f"| {threads} threads, s | ratio | memory, MiB |"
    )
    print("|" + "---|" * 10)
    for name in ROBOTS:
        for samples in sizes:
            if name != "TALOS" or (samples <= 1_000 and not options.quick):
                print(row(name, samples, threads, clock), flush=True)
    print(f"\n{'processor' if options.cpu else 'wall-clock'} time; {machine()}")


def row(name, samples, threads, clock):
    times, memory = measure(name, samples, threads, clock)
    full = times.get("full")
    cells = [f"{full:.2f}" if full else "-"]
    for key in ("plain", "compiled", "threads"):
        cells.append(f"{times[key]:.3f}" if key in times else "-")
        cells.append(f"{full / times[key]:.1f}" if full and key in times else "-")
    return f"| {name} | {samples:.0e} | " + " | ".join(cells) + f" | {memory:.0f} |"


def measure(name, samples, threads, clock):
    """Return the time of each way [s] and robotid's memory over the input [MiB]."""
    model = robot(name)
    trajectory = motion(model, samples, np.random.default_rng(0))
    mapping = structural_mapping(model)
    identify(model, trajectory, True, 1)  # reads the compiled code
    ways = {
        "plain": lambda: identify(model, trajectory, False, 1),
        "compiled": lambda: identify(model, trajectory, True, 1),
    }
    if clock is time.perf_counter:  # threads save no processor time
        ways["threads"] = lambda: identify(model, trajectory, True, threads)
    if 8 * samples * model.n_rows * len(model.layout.names) < LARGEST:
        ways["full"] = lambda: full_qr(model, mapping, trajectory)
    seconds = side_by_side(list(ways.values()), 1 if samples > 100_000 else 3, clock)
    memory = peak_memory(lambda: identify(model, trajectory, True, threads))
    return dict(zip(ways, seconds, strict=True)), memory


def panda_table(threads, clock, python):
    """Return the table of the panda at 1e4, 1e5 and 1e6 samples."""
    ways = {"full": "numpy's full QR", "plain": "plain", "compiled": "compiled"}
    ways |= {"threads": f"compiled, {threads} threads"} if clock is time.perf_counter else {}
    figaroh = ["FIGAROH"] if python else []
    head = ["panda, friction, armature, offset", *figaroh, *ways.values(), "memory over the input"]
    lines = [head, ["---"] * len(head)]
    for samples in PANDA_SIZES:
        times, memory = measure("panda", samples, threads, clock)
        cells = [f"{samples:,} samples"]
        if python:
            key = "wall" if clock is time.perf_counter else "cpu"
            is_run = samples <= 100_000
            cells += [f"{compare(python, samples)['FIGAROH'][key]:.2f} s" if is_run else "not run"]
        for way in ways:
            ratio = f" ({times['full'] / times[way]:.0f}x)" if "full" in times else ""
            text = f"{times[way]:.3f} s{ratio if way != 'full' else ''}" if way in times else None
            cells.append(text or "not run")
        lines.append([*cells, f"{memory:.0f} MiB"])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    main()
