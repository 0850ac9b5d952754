"""Start-up in fresh processes: imports, the command line's help, first uses of the compiled path.

Each line is run in processes of its own, in turn, so that all meet the same load; the median of
the processor's time counts. "over bare Python" takes the time of an empty program off. The compiled
path is used first with an empty cache of compiled code (it compiles, once per installation), then
first in a process (it reads that code), then again in the same process.

    python benchmarks/bench_startup.py [--quick]
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile

from setting import machine

PROGRAMS = {
    "bare Python": ["-c", ""],
    "import numpy": ["-c", "import numpy"],
    "import pinocchio": ["-c", "import pinocchio"],
    "import robotid": ["-c", "import robotid"],
    "every name of robotid": ["-c", "from robotid import *"],
    "robotid --help": ["-m", "robotid", "--help"],
}
FIRST_USE = """
import time
import numpy as np
from robotid.data.log import Trajectory
from robotid.robot.examples import example_urdf
from robotid.dynamics.factors import compress
from robotid.robot.model import RobotModel
from robotid.dynamics.torque import build_problem
model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"))
x = np.ones((64, 6))
log = Trajectory(t=np.arange(64.0), q=x, v=x, a=x, tau=x, joints=model.joints, rate=1.0,
                 segment=np.zeros(64, dtype=int))
for _ in range(2):
    start = time.process_time()
    compress(build_problem(model, log, compiled={compiled}))
    print(time.process_time() - start)
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer processes")
    options = parser.parse_args()
    seconds = in_turn(PROGRAMS.values(), 1 if options.quick else 15)
    times = dict(zip(PROGRAMS, seconds, strict=True))
    bare, pinocchio = times["bare Python"], times["import pinocchio"]
    print("| program | s | over bare Python, s | ratio to import pinocchio |")
    print("|---|---|---|---|")
    for name, value in times.items():
        print(f"| {name} | {value:.3f} | {value - bare:.3f} | {value / pinocchio:.2f} |")
    print("\n64 samples of UR10 to factors, imports not counted:")
    with tempfile.TemporaryDirectory() as folder:
        first, later = ("compiled, first ever", True), ("compiled, first in a process", True)
        for name, compiled in (("Pinocchio", False), first, later):
            first, second = first_uses(compiled, folder)
            print(f"{name}: {first:.3f} s, then {second * 1e3:.2f} ms")
    print(f"\nprocessor time; {machine()}")


def in_turn(programs, repeats):
    """Return the median processor time of each program [s], after one run that fills the caches."""
    seconds = [[] for _ in programs]
    for k in range(repeats + 1):
        for own, arguments in zip(seconds, programs, strict=True):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            if k:
                own.append(sum(after[:2]) - sum(before[:2]))  # of the user and of the system
    return [statistics.median(own) for own in seconds]


def first_uses(compiled, folder):
    """Return the time of the first and of the second use in a process [s]."""
    run = subprocess.run(
        [sys.executable, "-c", FIRST_USE.format(compiled=compiled)],
        capture_output=True, text=True, check=True,
        env={**os.environ, "NUMBA_CACHE_DIR": folder},
    )  # fmt: skip
    return map(float, run.stdout.split())


if __name__ == "__main__":
    main()
