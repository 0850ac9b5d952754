"""Terms that a drive's model lacks: how often each is named, and how often where there is none.

Each row is a UR5 that its URDF does not describe (other masses, a tool, friction), with 30 s of
motion to fit and 30 s of another kept apart; one joint's torque has a term more, another in each
seed. Clean robots have noise of 3 % of the torque that forgets after so long.

    ROBOTID_DATA=... python benchmarks/bench_misfit.py [--quick] [--seeds N]
"""

import argparse
import os
import sys
import time
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np
from helpers.corruptions import robot
from helpers.misfits import EFFECTS, log_with

from robotid.cli.identify import identify
from robotid.cli.job import read_job
from robotid.diagnosis.residual.misfit import find_misfits
from robotid.diagnosis.residual.term_trials import take_sample

JOINTS = 4  # of the UR5, the first ones, which get a term: a wrist carries no load to speak of
RATE = 100.0  # [Hz]
FORGETS = (0.0, 0.3, 1.0)  # [s]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one seed")
    parser.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args()
    seeds = range(1 if options.quick else options.seeds)
    spoilt(seeds)
    clean(seeds)
    recordings()


def misfits(model, seed, effect=None, joint=0, **options):
    logs = [log_with(model, seed, effect, joint, part=k, **options) for k in (0, 1)]
    return identify(model, logs[:1], validation=logs[1:]).misfits


def spoilt(seeds):
    print(
        "| term | finding | named first on its joint | findings on other joints | share, median |"
    )
    print("|---|---|---|---|---|")
    model = robot("ur5")
    for name, effect in EFFECTS.items():
        right, others, shares = 0, 0, []
        for seed in seeds:
            joint = model.joints[seed % JOINTS]
            found = misfits(model, seed, name, seed % JOINTS)
            own = [m for m in found if m.joint == joint]
            others += len(found) - len(own)
            if own and own[0].term.code == effect.code:
                right += 1
                shares.append(own[0].share)
        share = f"{100 * np.median(shares):.0f} %" if shares else "-"
        print(f"| {name} | `{effect.code}` | {right}/{len(seeds)} | {others} | {share} |")


def clean(seeds):
    print("\n| clean robot | correlation time | joints | terms named | of them warnings |")
    print("|---|---|---|---|---|")
    for name in ("ur5", "panda"):
        model = robot(name)
        for forgets in FORGETS:
            found = [
                m for seed in seeds
                for m in misfits(model, seed, noise=0.03, memory=forgets * RATE)
            ]  # fmt: skip
            count, warned = len(seeds) * len(model.joints), sum(m.matters for m in found)
            print(f"| {name} | {forgets:g} s | {count} | {len(found)} | {warned} |")


def recordings():
    if "ROBOTID_DATA" not in os.environ:
        print("\nno recordings: set ROBOTID_DATA")
        return
    print("\n| recording | joint | finding | share | of the validation log's | size | s |")
    print("|---|---|---|---|---|---|---|")
    for path in sorted((ROOT / "tests" / "jobs").glob("*.toml")):
        job = read_job(path)
        model = job.model()
        fitted, kept = (
            [job.read(entry, model) for entry in some]
            for some in (job.identification, job.validation)
        )
        found = identify(
            model, fitted, validation=kept, signals=job.signals, estimator=job.estimator
        )
        sample = take_sample(found)
        begin = time.process_time()
        named = find_misfits(sample)
        seconds = time.process_time() - begin
        for m in named:
            print(
                f"| {path.stem} | {m.joint} | `{m.term.code}` ({m.term.name}), "
                f"{'warning' if m.matters else 'note'} | {100 * m.share:.0f} % | "
                f"{100 * m.confirmed:.0f} % | {m.size:.2g} ± {m.std_error:.1g} {m.unit} | "
                f"{seconds:.2f} |"
            )
        if not named:
            print(f"| {path.stem} | - | nothing | | | | {seconds:.2f} |")


if __name__ == "__main__":
    main()
