"""The doctor's confusion table: what it finds in clean logs, spoilt logs and real recordings.

Each row is a way to spoil a clean simulated log of a UR5 that its URDF does not describe (other
masses, a tool, friction, noise); the columns are the findings of severity warning or error, which
a user sees, as shares of the seeds. A note does not count.

    python benchmarks/bench_doctor.py [--quick] [--seeds N]
"""

import argparse
import itertools
import os
import platform
import sys
import tempfile
import time
from collections import Counter
from importlib.metadata import version
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np
from helpers.corruptions import CASES, ROBOTS, clean_log, robot, table_of
from helpers.servos import record
from random_servos import bandwidth, faulty_logs, good_commands, some_servos

from robotid.cli.job import Job, LogEntry, read_job
from robotid.cli.logs import examine
from robotid.data.files.read import write_columns
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.diagnosis.logs.command_channels import check_commands
from robotid.dynamics.simulation.simulator import another_robot
from robotid.robot.examples import example_urdf
from robotid.robot.parameters import INERTIAL_TERMS

DURATIONS = (8.0, 20.0)  # [s] of clean logs


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one seed, every fifteenth corruption")
    parser.add_argument("--seeds", type=int, default=8)
    options = parser.parse_args()
    seeds = range(1 if options.quick else options.seeds)
    clean(seeds)
    spoilt(seeds, dict(itertools.islice(CASES.items(), 0, None, 15 if options.quick else 1)))
    same_motion(seeds)
    payload(seeds)
    commands(seeds)
    recordings()
    speed()
    print(
        f"\nPython {platform.python_version()}, pin {version('pin')}, numpy {version('numpy')}, "
        f"{platform.machine()}, {os.cpu_count()} cores"
    )


def clean(seeds):
    print(
        "\nclean simulated logs: findings above a note\n"
        "\n| robot | seconds | logs | findings |\n|---|---|---|---|"
    )
    for name, duration in itertools.product(ROBOTS, DURATIONS):
        model, found = robot(name), Counter()
        for seed in seeds:
            log = clean_log(model, seed, duration=duration)
            found.update(loud(diagnose(model, [log], [], SignalSettings())))
        print(f"| {name} | {duration:g} | {len(seeds)} | {dict(found) or 'none'} |")


def spoilt(seeds, cases):
    print(f"\ncorrupted logs of a UR5, {len(seeds)} seeds each\n")
    print("| corruption | wanted | found | other findings above a note |\n|---|---|---|---|")
    model = robot("ur5")
    tables = [table_of(clean_log(model, seed)) for seed in seeds]
    hits = 0
    for name, case in cases.items():
        found, other = 0, Counter()
        for table in tables:
            seen = loud(examine_table(case, table))
            found += not seen.isdisjoint(case.codes)
            other.update(seen - set(case.codes))
        hits += found
        side = ", ".join(f"{code} {count}/{len(seeds)}" for code, count in other.most_common())
        print(f"| {name} | {', '.join(case.codes)} | {found}/{len(seeds)} | {side or '-'} |")
    print(f"\nfound with the right code: {hits} of {len(cases) * len(seeds)}")


def examine_table(case, table):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.csv"
        write_columns(case.change(table), path)
        job = Job(
            urdf=example_urdf(case.urdf), gravity=case.gravity, identification=(LogEntry(path),)
        )
        return examine(job)


def same_motion(seeds):
    model, found, false = robot("ur5"), 0, 0
    for seed in seeds:
        first, again = clean_log(model, seed), clean_log(model, seed, rate=125.0)
        other = clean_log(model, seed + 1000)
        found += "repeated_motion" in loud(diagnose(model, [first], [again], SignalSettings()))
        false += "repeated_motion" in loud(diagnose(model, [first], [other], SignalSettings()))
    print(f"\nsame motion recorded again for validation: found {found}/{len(seeds)}")
    print(f"another motion for validation: found {false}/{len(seeds)}")


def payload(seeds):
    print("\n| payload on a UR5 | payload found (warning) | mean estimate [kg] |\n|---|---|---|")
    model = robot("ur5")
    for mass in (0.0, 1.5, 3.0, 5.0):
        found, estimates = 0, []
        for seed in seeds:
            findings = diagnose(model, [loaded_log(model, seed, mass)], [], SignalSettings())
            found += "payload" in loud(findings)
            estimates += [f.evidence["mass"] for f in findings if f.code == "payload"]
        mean = f"{sum(estimates) / len(estimates):.2f}" if estimates else "-"
        print(f"| {mass:g} kg in addition to the 1.2 kg tool | {found}/{len(seeds)} | {mean} |")


def loaded_log(model, seed, mass):
    pi = another_robot(model, np.random.default_rng(seed))
    last = pi[: model.layout.n_inertial].reshape(-1, len(INERTIAL_TERMS))[-1]
    last += mass * np.array([1, 0, 0.05, 0.1, 0.02, 0, 0.02, 0, 0, 0.02])
    return clean_log(model, seed, pi=pi)


def commands(seeds):
    """Print what is found in logs of commands of three joints, with servos drawn at random."""
    logs, false, faulty = 0, Counter(), {}
    for seed in seeds:
        rng = np.random.default_rng(1000 + seed)
        servos = some_servos(rng)
        rate = 15 * max(bandwidth(servo) for servo in servos)
        for told in good_commands(rng, servos).values():
            logs += 1
            false.update(loud(check_commands(record(told, servos, rate=max(rate, 100.0)))))
        for name, code, log in faulty_logs(rng):
            seen = loud(check_commands(log))
            found, other = faulty.setdefault((name, code), (Counter(), Counter()))
            found[code] += code in seen
            other.update(seen - {code})
    print(f"\nclean logs of commands: {logs}; findings above a note: {dict(false) or 'none'}")
    print("\n| commands | wanted | found | other findings above a note |\n|---|---|---|---|")
    for (name, code), (found, other) in faulty.items():
        side = ", ".join(f"{x} {count}/{len(seeds)}" for x, count in other.most_common())
        print(f"| {name} | {code} | {found[code]}/{len(seeds)} | {side or '-'} |")


def recordings():
    if "ROBOTID_DATA" not in os.environ:
        print("\nno real recordings: set ROBOTID_DATA to their folder")
        return
    print("\n| recording | findings above a note | notes | s |\n|---|---|---|---|")
    for path in sorted((ROOT / "tests" / "jobs").glob("*.toml")):
        start = time.perf_counter()
        findings = examine(read_job(path))
        seconds = time.perf_counter() - start
        shown = Counter(f"{f.code} ({f.severity})" for f in findings if f.severity != "note")
        notes = sorted({f.code for f in findings if f.severity == "note"})
        loudly = ", ".join(f"{code} x{count}" for code, count in shown.items())
        print(f"| {path.stem} | {loudly or '-'} | {', '.join(notes)} | {seconds:.1f} |")


def speed():
    model = robot("panda")
    log = clean_log(model, 0, rate=1000.0)
    start = time.perf_counter()
    diagnose(model, [log], [], SignalSettings())
    print(f"\n{len(log.t)} samples of 7 joints: {time.perf_counter() - start:.2f} s")


def loud(findings):
    return {f.code for f in findings if f.severity != "note"}


if __name__ == "__main__":
    main()
