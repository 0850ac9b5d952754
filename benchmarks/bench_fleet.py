"""A fleet on a local Dask cluster: time, peak memory, killed workers, resumed with the same bits.

Writes small logs (Parquet, 4 s at 50 Hz) of planar arms with two joints, whose friction differs by
15 % between units and 5 % between logs, and identifies all units with two workers of one thread.
The same again: one worker is killed (Dask starts another), then the command itself (SIGKILL), and
then it is resumed in two worker processes without Dask. The files must have the same bits.

``--once`` leaves out the first run: the rows of ten units must have the bits of a run of these
units alone.

    python benchmarks/bench_fleet.py [--quick] [--units 1000] [--logs 10] [--once]
"""

import argparse
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np
import pyarrow.parquet
from distributed import Client, LocalCluster
from setting import PLANAR, machine

from robotid.cli.fleet import UNITS
from robotid.data.files.read import write_log
from robotid.data.log import Log
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.model import RobotModel

BETWEEN, WITHIN, NOISE = 0.15, 0.05, 0.02
FILES = ("fleet.parquet", "fleet.json", "fleet.html")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="4 units with 2 logs")
    parser.add_argument("--units", type=int, default=1000)
    parser.add_argument("--logs", type=int, default=10)
    parser.add_argument("--once", action="store_true", help="the killed run alone")
    options = parser.parse_args()
    units, logs = (4, 2) if options.quick else (options.units, options.logs)
    with tempfile.TemporaryDirectory() as where:
        folder = Path(where)
        start = time.perf_counter()
        table = write(folder, units, logs)
        print(f"{units} units, {logs} logs each, written in {time.perf_counter() - start:.0f} s")
        cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
        with cluster, Client(cluster) as client:
            address = cluster.scheduler_address
            before = os.times()
            start = time.perf_counter()
            if not options.once:
                subprocess.run(command(table, folder / "one", address), check=True)
                seconds = time.perf_counter() - start
            run = subprocess.Popen(command(table, folder / "two", address))
            wait(folder / "two", units // 3, run)
            victim = next(iter(client.run(os.getpid).values()))
            os.kill(victim, signal.SIGKILL)
            wait(folder / "two", 2 * units // 3, run)
            others = max(client.run(peak, on_error="ignore").values())  # of those alive
            run.kill()
            run.wait()
        left = units - len(finished(folder / "two"))
        subprocess.run([*command(table, folder / "two"), "--workers", "2", "--resume"], check=True)
        after = os.times()
        own = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024  # [MiB]
        if options.once:
            seconds = time.perf_counter() - start
            same = are_alone(folder, logs)
        else:
            same = all(
                (folder / "one" / name).read_bytes() == (folder / "two" / name).read_bytes()
                for name in FILES
            )
        size = (folder / "two" / "fleet.parquet").stat().st_size / 2**20
    print(f"| units | logs each | s | logs/s | command, MiB | worker, MiB | results, MiB | "
          f"left after the kills | same bits |\n|{'---:|' * 9}")  # fmt: skip
    rate = units * logs / seconds
    print(f"| {units} | {logs} | {seconds:.0f} | {rate:.1f} | {own:.0f} | {others:.0f} | "
          f"{size:.1f} | {left} | {'yes' if same else 'NO'} |")  # fmt: skip
    used = sum(after[2:4]) - sum(before[2:4])
    what = "commands, and of the workers of the resumed one" if options.once else "commands"
    print(f"\n{used:.0f} s of processor time of the {what}. {machine()}, "
          f"load {os.getloadavg()[0]:.1f}")  # fmt: skip
    if not same:
        sys.exit("the resumed run gave other bits")


def write(folder, units, logs):
    """Write the logs of a fleet and return its table."""
    model = RobotModel.from_urdf(PLANAR)
    names, rng = model.layout.names, np.random.default_rng(0)
    pi = model.standard_parameters()
    friction = [k for k, n in enumerate(names) if n.endswith(("viscous", "coulomb"))]
    pi[friction] = [3.0, 5.0, 2.0, 3.0]
    t = np.arange(200) / 50.0
    motions = []
    for _ in range(20):
        q, v, a = random_fourier(model, rng, period=4.0).evaluate(t)
        W = joint_torque_regressor(model, q, v, a)
        motions.append((q, v, a, W))
    rows = ["unit,log,urdf"]
    for u in range(units):
        unit = pi.copy()
        unit[friction] *= 1 + BETWEEN * rng.normal(size=len(friction))
        (folder / f"u{u:04d}").mkdir()
        for k in range(logs):
            own = unit.copy()
            own[friction] *= 1 + WITHIN * rng.normal(size=len(friction))
            q, v, a, W = motions[rng.integers(len(motions))]
            tau = (W @ own).reshape(v.shape)
            tau += NOISE * tau.std(axis=0) * rng.standard_normal(tau.shape)
            path = folder / f"u{u:04d}" / f"{k:03d}.parquet"
            write_log(Log(t=t, q=q, v=v, a=a, tau=tau, joints=model.joints), path)
            rows.append(f"u{u:04d},{path.relative_to(folder)},{PLANAR.resolve()}")
    (folder / "fleet.csv").write_text("\n".join(rows) + "\n")
    return folder / "fleet.csv"


def command(table, out, address=None):
    words = [sys.executable, "-m", "robotid", "fleet", str(table), "--out", str(out)]
    return words if address is None else [*words, "--scheduler", address]


def are_alone(folder, logs):
    """Return whether ten units have the same rows when they are identified alone."""
    lines = (folder / "fleet.csv").read_text().splitlines()
    few = folder / "few.csv"
    few.write_text("\n".join(lines[: 10 * logs + 1]) + "\n")
    subprocess.run([*command(few, folder / "few"), "--workers", "2"], check=True)
    alone, every = (
        pyarrow.parquet.read_table(folder / name / "fleet.parquet") for name in ("few", "two")
    )
    return alone.equals(every.slice(0, alone.num_rows))


def peak():
    """Return the peak memory of a worker [MiB]; run on it."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def finished(out):
    return list((out / UNITS).glob("*.json"))


def wait(out, count, run):
    """Wait until a number of units are finished."""
    while len(finished(out)) < count:
        if run.poll() is not None:
            sys.exit(f"the run ended with {run.returncode} before {count} units were finished")
        time.sleep(0.02)


if __name__ == "__main__":
    main()
