"""Validation error per joint on recordings of other laboratories: WLS and the consistent fit.

Runs the job of each recording as ``robotid identify`` does, doctor and report included, and prints
one row of it, in % of the measured torque, over rows that were not fitted, beside
the figures that plain numpy reached with weighted least squares on the same splits.

    ROBOTID_DATA=folder python benchmarks/bench_validation.py [--quick]
"""

import argparse
import os
import platform
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

from robotid.cli.identify import run_job
from robotid.cli.job import read_job

JOBS = Path(__file__).parents[1] / "tests" / "jobs"
PLAIN_NUMPY = {
    "ur10e": "6.7 / 3.2 / 3.2 / 3.7 / 5.5 / 4.2",
    "tx40": "6.4 / 6.0 / 9.7 / 8.8 / 30 / 21",
    "panda_inria": "5.8 / 1.1 / 1.9 / 0.9 / 6.4 / 3.2 / 15",
    "kinova_gen3": "27 / 11 / 16 / 15 / 19 / 13 / 10",
    "tiago": "-",
}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="the two shortest recordings only")
    options = parser.parse_args()
    if "ROBOTID_DATA" not in os.environ:
        sys.exit("set ROBOTID_DATA to the folder of the recordings")
    names = ["kinova_gen3", "ur10e"] if options.quick else list(PLAIN_NUMPY)
    print("| recording | WLS | consistent | plain numpy, WLS | verdict | s |")
    print("|---|---|---|---|---|---|")
    for name in names:
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            found, _ = run_job(read_job(JOBS / f"{name}.toml"), folder)
        seconds = time.perf_counter() - start
        wls, consistent = (row(found.validation[0].metrics[key]) for key in ("wls", "estimate"))
        verdict = found.verdict.status
        print(
            f"| {name} | {wls} | {consistent} | {PLAIN_NUMPY[name]} | {verdict} | {seconds:.1f} |"
        )
    print(
        f"\nPython {platform.python_version()}, pin {version('pin')}, numpy {version('numpy')}, "
        f"scipy {version('scipy')}, {platform.machine()}, "
        f"{os.cpu_count()} cores, BLAS threads {os.environ['OPENBLAS_NUM_THREADS']}"
    )


def row(metrics):
    errors = [m.relative_error_pct for m in metrics.per_joint.values()]
    return " / ".join(f"{error:.1f}" if error < 10 else f"{error:.0f}" for error in errors)


if __name__ == "__main__":
    main()
