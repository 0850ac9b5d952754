"""`robotid identify` on the job files of tests/jobs, from start to finished files, and page sizes.

Each run is a process of its own; --before names another checkout, which is run in turn with this
one. The shortest counts, of processor time, which other work on the machine changes less, and of
wall-clock time.

    ROBOTID_DATA=... python benchmarks/bench_identify.py [--before CHECKOUT] [--runs 3]
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from setting import machine

HERE = Path(__file__).resolve().parent.parent


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--before", type=Path, help="another checkout of robotid")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="one run of one job")
    options = parser.parse_args()
    checkouts = [HERE] if options.before is None else [options.before.resolve(), HERE]
    jobs = sorted((HERE / "tests" / "jobs").glob("*.toml"))[: 1 if options.quick else None]
    print("| job | " + " | ".join(f"{c.name}, cpu s | wall s" for c in checkouts), end=" | ")
    print("ratio of cpu | report, kB |")
    print("|---" * (2 * len(checkouts) + 3) + "|", flush=True)
    for job in jobs:
        seconds = [[] for _ in checkouts]
        for _ in range(1 if options.quick else options.runs):
            for own, checkout in zip(seconds, checkouts, strict=True):
                cpu, wall, size = run(checkout, job)
                own.append((cpu, wall))
        least = [[min(column) for column in zip(*own, strict=True)] for own in seconds]
        cells = " | ".join(f"{cpu:.2f} | {wall:.2f}" for cpu, wall in least)
        ratio = least[-1][0] / least[0][0]
        print(f"| {job.stem} | {cells} | {ratio:.2f} | {size / 1e3:.0f} |", flush=True)
    print(f"\n{machine()}")


def run(checkout, job):
    """Return processor and wall-clock time of a run [s], and the size of its report [bytes]."""
    with tempfile.TemporaryDirectory() as folder:
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        words = ["-m", "robotid", "identify", str(job), "--out", folder]
        done = subprocess.run(
            [sys.executable, *words],
            cwd=checkout,  # where -m looks first
            env={**os.environ, "PYTHONPATH": str(checkout), "PYTHONDONTWRITEBYTECODE": ""},
            capture_output=True,
            text=True,
        )
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        report = Path(folder) / "report.html"
        if not report.exists():  # a poor verdict ends with 1, and has a report all the same
            sys.exit(f"{checkout}: {done.stderr}")
        used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return used, wall, report.stat().st_size


if __name__ == "__main__":
    main()
