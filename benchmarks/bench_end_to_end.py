"""Arrays in memory to estimate: base parameters, rows, factors and weighted least squares.

"full QR" is the plain way: Pinocchio in a loop, W stacked, numpy's QR (without the estimate). All
ways are run in turn in this process, the shortest counts: wall-clock time, or with --cpu the
processor's, which other work on the machine changes less. "memory" is the largest
amount that Python and NumPy hold over the input arrays, by tracemalloc in a run of its own. Where
FIGAROH is installed (an environment of its own with `pip install robotid[fast] figaroh`), its
regressor and double QR of the same samples are timed too. The last lines are the start: the
compiled path used first ever (it compiles) and first in a process.

    python benchmarks/bench_end_to_end.py [--quick] [--million]
    python benchmarks/bench_end_to_end.py --readme --cpu    # the table of the README
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec

import numpy as np
from setting import (
    ROBOTS,
    figaroh_factor,
    full_qr,
    machine,
    motion,
    peak_memory,
    robot,
    side_by_side,
)

from robotid.compiled import is_installed
from robotid.estimators import WLS
from robotid.factors import compress
from robotid.identification import structural_mapping
from robotid.regressor import build_problem

LARGEST = 2**30  # [bytes] of W that full QR is asked to hold
START = """
import time
start = time.perf_counter()
import numpy as np
from robotid.data import Trajectory
from robotid.examples import example_urdf
from robotid.factors import compress
from robotid.model import RobotModel
from robotid.regressor import build_problem
model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"))
x = np.ones((64, 6))
log = Trajectory(t=np.arange(64.0), q=x, v=x, a=x, tau=x, joints=model.joints, rate=1.0,
                 segment=np.zeros(64, dtype=int))
middle = time.perf_counter()
compress(build_problem(model, log, compiled={compiled}))
print(time.perf_counter() - middle)
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="1e3 samples only, no humanoid")
    parser.add_argument("--million", action="store_true", help="1e6 samples too (half an hour)")
    parser.add_argument("--readme", action="store_true", help="panda at 1e4, 1e5 and 1e6 only")
    parser.add_argument("--cpu", action="store_true", help="processor time, for a busy machine")
    options = parser.parse_args()
    clock = time.process_time if options.cpu else time.perf_counter
    sizes = [1_000] if options.quick else [1_000, 10_000, 100_000]
    sizes += [1_000_000] if options.million else []
    names = list(ROBOTS)
    if options.readme:
        names, sizes = ["panda"], [10_000, 100_000, 1_000_000]
    threads = len(os.sched_getaffinity(0))
    print(
        "| robot | samples | FIGAROH, s | full QR, s | plain, s | ratio | compiled, s | ratio "
        f"| {threads} threads, s | ratio | memory, MiB |"
    )
    print("|" + "---|" * 11)
    for name in names:
        for samples in sizes:
            if name != "TALOS" or (samples <= 1_000 and not options.quick):
                print(row(name, samples, threads, clock), flush=True)
    start()
    print(f"\n{'processor' if options.cpu else 'wall-clock'} time; {machine()}")


def row(name, samples, threads, clock):
    model = robot(name)
    trajectory = motion(model, samples, np.random.default_rng(0))
    mapping = structural_mapping(model)
    ways = {"plain": lambda: identify(model, trajectory, False, 1)}
    if is_installed():
        identify(model, trajectory, True, 1)  # reads the compiled code
        ways["compiled"] = lambda: identify(model, trajectory, True, 1)
        if clock is time.perf_counter:  # threads save no processor time
            ways["threads"] = lambda: identify(model, trajectory, True, threads)
    if 8 * samples * model.n_rows * len(model.layout.names) < LARGEST:
        ways["full"] = lambda: full_qr(model, mapping, trajectory)
        if find_spec("figaroh"):
            ways["figaroh"] = lambda: figaroh_factor(model, trajectory)
    repeats = 1 if samples > 100_000 else 3
    seconds = side_by_side(list(ways.values()), repeats, clock)
    times = dict(zip(ways, seconds, strict=True))
    full = times.get("full")
    cells = [f"{times[key]:.2f}" if key in times else "-" for key in ("figaroh", "full")]
    for key in ("plain", "compiled", "threads"):
        cells.append(f"{times[key]:.3f}" if key in times else "-")
        cells.append(f"{full / times[key]:.0f}" if full and key in times else "-")
    memory = peak_memory(lambda: identify(model, trajectory, is_installed(), threads))
    return f"| {name} | {samples:.0e} | " + " | ".join(cells) + f" | {memory:.0f} |"


def identify(model, trajectory, compiled, threads):
    """Return the estimate of all base parameters."""
    problem = structural_mapping(model).reduce(build_problem(model, trajectory, compiled=compiled))
    return WLS().fit(compress(problem, threads=threads))


def start():
    if not is_installed():
        return
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        for text, compiled in (("first ever", True), ("first in a process", True), ("-", False)):
            run = subprocess.run(
                [sys.executable, "-c", START.format(compiled=compiled)],
                capture_output=True, text=True, check=True, env=environment,
            )  # fmt: skip
            label = f"compiled path, {text}" if compiled else "Pinocchio"
            print(f"\n64 samples by {label}: {float(run.stdout):.2f} s", end="")
    print()


if __name__ == "__main__":
    main()
