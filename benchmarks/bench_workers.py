"""Worker processes on one long log: time of the reduction, ratio to one process, same bits.

Writes a Parquet log of a simulated Panda (7 joints, 1 kHz), surveys it, and reduces its pieces in
this process and in worker processes, one BLAS thread each. "with start": from nothing to the
result, the start of the workers (about a second each: Python, NumPy, Pinocchio) and first uses
included, which is what one reduction by itself takes. "running": the next reduction by the same
workers, as when a command works on the pieces more than once. Each "ratio" compares with the first
line. The shortest of the runs counts, in wall-clock time: other work on the machine shows in it.

    python benchmarks/bench_workers.py [--quick] [--workers 1 2 4] [--repeats 3]
"""

import argparse
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import bench_memory
from setting import ROBOTS, machine

from robotid.cli.job import Job, LogEntry
from robotid.cli.logs import survey_logs
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import join
from robotid.estimation.fitting.recorded import Recordings, reduce_piece
from robotid.estimation.work_plan import WorkPlan
from robotid.robot.examples import example_urdf

WRITE = Path(bench_memory.__file__)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a short log")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2], metavar="N")
    parser.add_argument("--repeats", type=int, metavar="N", help="default 3, with --quick 1")
    options = parser.parse_args()
    repeats = options.repeats or (1 if options.quick else 3)
    rows = 30_000 if options.quick else 10**6
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.parquet"
        subprocess.run([sys.executable, WRITE, "--write", path, str(rows)], check=True)
        pieces = survey(path, 2**14 if options.quick else 2**17)
        print(
            "| workers | including start, s | ratio | running, s | ratio | samples/s | same bits |"
        )
        print("|" + "---|" * 7)
        first = None
        for workers in options.workers:
            runs = [run(workers, pieces) for _ in range(repeats)]
            started, again = (min(run[k] for run in runs) for k in range(2))
            whole = runs[0][2]
            first = first or (started, again, whole)
            same = identical(whole, first[2])
            cells = [f"{started:.2f}", f"{first[0] / started:.2f}"]
            cells += [f"{again:.2f}", f"{first[1] / again:.2f}", f"{rows / again:,.0f}"]
            print(f"| {workers} | {' | '.join(cells)} | {'yes' if same else 'NO'} |", flush=True)
            if not same:
                sys.exit(f"{workers} workers gave other bits")
    print(
        f"\n{rows:,} rows in {len(pieces)} pieces. With start: workers start anew. Running: they "
        f"are there. {machine()}"
    )


def run(workers, pieces):
    """Return the time of the first reduction and of the next [s], and what it comes down to."""
    with WorkPlan(workers) as plan:
        (started, whole), (again, _) = (timed(plan, pieces) for _ in range(2))
    return started, again, whole


def survey(path, rows_in_memory):
    joints = tuple(ROBOTS["panda"][1]["joints"])
    entry = LogEntry(path)
    job = Job(
        example_urdf("panda.urdf"),
        joints=joints,
        identification=(entry,),
        rows_in_memory=rows_in_memory,
    )
    model = job.model()
    fitted, _ = survey_logs(job, model, job.identification, ())
    return Recordings(model, structural_mapping(model), fitted).pieces


def timed(plan, pieces):
    work = partial(reduce_piece, mapping=structural_mapping(pieces[0].model))
    start = time.perf_counter()
    whole = join(list(plan.map(work, pieces, "reducing")))
    return time.perf_counter() - start, whole


def identical(one, other):
    parts = [(*x.factors.triangles, x.factors.rows, x.squares) for x in (one, other)]
    return all(ours.tobytes() == theirs.tobytes() for ours, theirs in zip(*parts, strict=True))


if __name__ == "__main__":
    main()
