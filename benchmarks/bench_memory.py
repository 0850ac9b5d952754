"""Peak memory and time of `robotid identify` on logs larger than memory should hold.

Writes logs of a simulated Panda (7 joints, 22 columns, 1 kHz, white noise) in chunks into a
temporary folder, a CSV of 1e6 rows and a Parquet file of 1e7, and identifies each in a process of
its own. "peak" is the largest resident memory of that process, everything included, as the
operating system counts it. "in memory" is the same job with the log in memory, where that fits;
"difference" is how far the base parameters of weighted least squares then lie apart, relative to
the largest.

    python benchmarks/bench_memory.py [--quick]
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from setting import machine

from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulator import another_robot
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

RATE = 1000.0  # [Hz]
PERIOD = 100.0  # [s] of the motion, which repeats; the noise does not
CHUNK = 100_000  # rows in memory while a log is written
LIMIT = 500e6  # [bytes] wanted
FITS = 2_000_000  # rows that fit into memory here


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a short log, few rows in memory")
    parser.add_argument("--write", nargs=2, metavar=("LOG", "ROWS"), help="write a log only")
    options = parser.parse_args()
    if options.write:
        write(Path(options.write[0]), int(options.write[1]))
        return
    logs = {"parquet": 5_000} if options.quick else {"csv": 10**6, "parquet": 10**7}
    held = 2048 if options.quick else None
    print("| log | rows | file, MB | peak, MB | s | in memory: peak, MB | s | difference |")
    print("|" + "---|" * 8)
    with tempfile.TemporaryDirectory() as folder:
        for suffix, rows in logs.items():
            path = Path(folder) / f"run.{suffix}"
            # in a process of its own: what a process holds counts for those that it starts
            subprocess.run([sys.executable, __file__, "--write", path, str(rows)], check=True)
            found, peak, seconds = identify(path, held)
            cells = ["-", "-", "-"]
            if rows <= FITS:
                whole, large, longer = identify(path, 10 * rows)
                cells = [f"{large / 1e6:.0f}", f"{longer:.1f}", f"{difference(found, whole):.1e}"]
            size = path.stat().st_size / 1e6
            first = [suffix, f"{rows:.0e}", f"{size:.0f}", f"{peak / 1e6:.0f}", f"{seconds:.1f}"]
            print(f"| {' | '.join(first + cells)} |", flush=True)
            path.unlink()
            if peak > LIMIT:
                sys.exit(f"{path.name}: {peak / 1e6:.0f} MB, wanted at most {LIMIT / 1e6:.0f} MB")
    print(f"\n{machine()}")


def write(path, rows):
    """Write a log of so many rows, chunk by chunk."""
    model = panda()
    rng = np.random.default_rng(0)
    t = np.arange(round(min(PERIOD, rows / RATE) * RATE)) / RATE
    q, v, a = random_fourier(model, rng, period=len(t) / RATE).evaluate(t)
    pi = another_robot(model, rng)
    tau = (joint_torque_regressor(model, q, v, a) @ pi).reshape(v.shape)
    names = [f"{kind}_{joint}" for kind in ("q", "dq", "tau") for joint in model.joints]
    schema = pa.schema([(name, pa.float64()) for name in ("time", *names)])
    make = pa.csv.CSVWriter if path.suffix == ".csv" else pa.parquet.ParquetWriter
    noise = np.repeat([1e-5, 1e-3, 0.1], len(model.joints))
    with make(path, schema) as writer:
        for start in range(0, rows, CHUNK):
            row = np.arange(start, min(start + CHUNK, rows))
            motion = np.hstack([x[row % len(t)] for x in (q, v, tau)])
            motion += noise * rng.standard_normal(motion.shape)
            columns = [row / RATE, *motion.T]
            writer.write_table(pa.table([pa.array(c) for c in columns], schema=schema))


def identify(path, rows_in_memory):
    """Return result.json, the peak of resident memory [bytes] and the time [s] of a process."""
    job = path.with_suffix(".toml")
    held = f"\n[reduction]\nrows_in_memory = {rows_in_memory}\n" if rows_in_memory else ""
    job.write_text(
        f'urdf = "{example_urdf("panda.urdf")}"\njoints = {json.dumps(list(panda().joints))}\n'
        f'[[identification]]\nlog = "{path.name}"\n{held}'
    )
    out = path.parent / "out"
    command = [sys.executable, "-m", "robotid", "identify", str(job), "--out", str(out)]
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"robotid identify ended with {process.returncode}")
    return json.loads((out / "result.json").read_text()), 1024 * usage.ru_maxrss, seconds


def difference(one, other):
    first, second = (np.array(result["wls"]["base_values"]) for result in (one, other))
    return np.abs(first - second).max() / np.abs(second).max()


def panda():
    arm = [f"panda_joint{i}" for i in range(1, 8)]
    return RobotModel.from_urdf(example_urdf("panda.urdf"), joints=arm)


if __name__ == "__main__":
    main()
