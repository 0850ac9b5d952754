"""Variation between runs and robots: intervals of the next run, and runs that are unlike others.

Recordings: each log is left out of the fit; its drive parameters are compared with the 95 %
prediction interval of the other logs, and with the interval of their mean alone, as if runs were
alike. Simulated arms (Pinocchio's inverse dynamics, not the regressor): coverage for the next robot
and of the spreads, causes named in runs that differ, false alarms in runs that do not.

    ROBOTID_DATA=folder python benchmarks/bench_runs.py [--quick]
"""

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np
import pinocchio as pin

from robotid.commands.job import LogEntry, read_job
from robotid.commands.logs import survey_logs
from robotid.fitting.fit import solve_recordings
from robotid.fitting.recordings import Recordings
from robotid.fitting.settings import EstimatorSettings
from robotid.fitting.survey import hold_log
from robotid.identification.pipeline import with_drives
from robotid.logs.data import Log
from robotid.logs.settings import SignalSettings
from robotid.regressor.base_parameters import structural_mapping
from robotid.robot.examples import example_urdf
from robotid.robot.families import wanted_families
from robotid.robot.model import RobotModel
from robotid.simulation.motions import random_fourier
from robotid.variation.groups import runs_of
from robotid.variation.mixed_effects import UNKNOWN, MixedEffects
from robotid.variation.variation import vary

JOBS = Path(__file__).parents[1] / "tests" / "jobs"
UNLOADED = (
    "ident_20200210_30s12h", "ident_20200212_50s12h", "ident_20200219_14harm", "val_ptp10",
    *(f"jointwise_{k}" for k in range(1, 7)),
)  # fmt: skip
JOINTS = ("shoulder_lift_joint", "elbow_joint", "wrist_1_joint")
WITHIN, BETWEEN = 0.05, 0.15  # spread of friction between runs, between robots
KINDS = ("friction", "gain", "payload")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few left out, few simulated sets")
    options = parser.parse_args()
    if "ROBOTID_DATA" not in os.environ:
        sys.exit("set ROBOTID_DATA to the folder of the recordings")
    print("| recordings | logs | 95 % of the next log | of the mean alone | parameters |")
    print("|---|---|---|---|---|")
    for name, entries in recordings():
        left_out(name, entries, 1 if options.quick else len(entries))
    print()
    fleets(1 if options.quick else 5)
    unlike(1 if options.quick else 20)


def recordings():
    """Yield name and logs of the robots of which there are three logs or more."""
    yield "kinova_gen3", [*read_job(JOBS / "kinova_gen3.toml").identification,
                          *read_job(JOBS / "kinova_gen3.toml").validation]  # fmt: skip
    job = read_job(JOBS / "ur10e.toml")
    known = {entry.path.stem: entry for entry in (*job.identification, *job.validation)}
    folder = job.identification[0].path.parent
    yield "ur10e", [known.get(name, LogEntry(folder / f"{name}.parquet")) for name in UNLOADED]


def left_out(name, entries, count):
    """Print how often drive parameters of a log are within what the other logs predict."""
    job = read_job(JOBS / f"{name}.toml")
    job = replace(job, identification=tuple(entries), validation=())
    model = job.model()
    (logs,) = survey_logs(job, model, entries)
    inside = alike = total = 0
    for k in range(count):
        others = [log for j, log in enumerate(logs) if j != k]
        some = Recordings(model, structural_mapping(model), others)
        fit = with_drives(some, job.estimator, wanted_families(job.friction, model.joints))
        every = some.with_model(fit.model)
        every = replace(every, fitted=[log.with_model(fit.model) for log in logs])
        segments = [every.segments(j, log.whole.trajectory) for j, log in enumerate(every.fitted)]
        unit = np.zeros(len(logs), int)
        for group in runs_of(fit.model, every.mapping, segments, fit.standard, fit.wls.sigma, unit):
            if group.group.kind == "drive":
                found = compared(group.runs, k)
                inside, alike, total = np.add((inside, alike, total), found)
    print(f"| {name} | {len(logs)} | {100 * inside / total:.1f} % | {100 * alike / total:.1f} % "
          f"| {total} |", flush=True)  # fmt: skip


def compared(runs, k):
    """Return how many values of a run are in the prediction of the others, in their mean, of all.

    Values that the run hardly determines are left out.
    """
    C = np.linalg.inv(runs.H[k] + np.diag((UNKNOWN * runs.scale) ** -2.0))
    x, others = C @ runs.h[k], runs.without(k)
    error, known = np.sqrt(np.diag(C)), np.sqrt(np.diag(C)) < runs.scale
    found = MixedEffects(others).predict(np.diag(C))
    ends = np.array([each.ends for each in found])
    inside = (ends[:, 0] < x) & (x < ends[:, 1])
    P = np.linalg.inv(others.H.sum(axis=0) + np.diag((UNKNOWN * runs.scale) ** -2.0))
    alone = np.abs(x - P @ others.h.sum(axis=0)) < 1.96 * np.sqrt(np.diag(P) + error**2)
    return (inside & known).sum(), (alone & known).sum(), known.sum()


def simulated(model, pi, rng, *, seconds=12.0, rate=60.0):
    """Return the log of an arm with viscous and Coulomb friction, by Pinocchio's RNEA."""
    t = np.arange(round(seconds * rate)) / rate
    q, v, a = random_fourier(model, rng, period=seconds).evaluate(t)
    robot = loaded(model, pi)
    data, n = robot.createData(), len(model.joints)
    names = model.layout.names
    tau = np.array([pin.rnea(robot, data, *state) for state in
                    zip(model.configurations(q), v, a, strict=True)])  # fmt: skip
    for j, joint in enumerate(model.joints):
        of = {term: pi[names.index(f"{joint}.{term}")] for term in model.layout.terms}
        tau[:, j] += of["armature"] * a[:, j] + of["viscous"] * v[:, j]
        tau[:, j] += of["coulomb"] * np.sign(v[:, j]) + of["offset"]
    tau += 0.02 * np.std(tau, axis=0) * rng.standard_normal((len(t), n))
    return Log(t=t, q=q, v=v, a=a, tau=tau, joints=model.joints)


def loaded(model, pi):
    """Return Pinocchio's model with the inertial parameters of pi."""
    robot = model.pin_model.copy()
    for k in range(len(model.layout.bodies)):
        robot.inertias[k + 1] = pin.Inertia.FromDynamicParameters(pi[10 * k : 10 * k + 10])
    return robot


def arm():
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), joints=JOINTS)
    pi = model.standard_parameters()
    names = model.layout.names
    for joint, viscous, coulomb in zip(JOINTS, (6.0, 4.0, 1.5), (5.0, 3.0, 1.0), strict=True):
        pi[names.index(f"{joint}.viscous")], pi[names.index(f"{joint}.coulomb")] = viscous, coulomb
        pi[names.index(f"{joint}.armature")] = 0.3
    friction = [k for k, n in enumerate(names) if n.endswith(("viscous", "coulomb"))]
    return model, pi, friction


def groups(model, logs, unit):
    """Return the fit's information on each run."""
    held = [
        replace(hold_log(model, log, SignalSettings(cutoff=None, trim=0.0)), unit=str(u))
        for log, u in zip(logs, unit, strict=True)
    ]
    some = Recordings(model, structural_mapping(model), held)
    return solve_recordings(some, EstimatorSettings(draws=0)).with_errors().runs


def fleets(count):
    """Print coverage for the next robot and of the spreads, of 20 robots with 5 runs each."""
    model, pi, friction = arm()
    names, units, runs = model.layout.names, 20, 5
    nexts, spreads, total = 0, 0, 0
    for seed in range(count):
        rng = np.random.default_rng(seed)
        logs, robots = [], []
        for u in range(units + 1):
            robot = pi.copy()
            robot[friction] *= 1 + BETWEEN * rng.normal(size=len(friction))
            robots.append(robot)
            for _ in range(runs if u < units else 0):
                own = robot.copy()
                own[friction] *= 1 + WITHIN * rng.normal(size=len(friction))
                logs.append(simulated(model, own, rng))
        unit = np.repeat([f"{u:02d}" for u in range(units)], runs)
        found = groups(model, logs, unit)
        variation = vary([str(k) for k in range(len(logs))], found)
        new = robots[-1] * (1 + WITHIN * rng.normal(size=len(pi)))
        for each in variation.parameters:
            k = names.index(each.name)
            if k in friction:
                low, high = each.prediction.ends
                nexts += low < new[k] < high
                first, last = each.prediction.spread_ends
                spreads += first < BETWEEN * pi[k] < last
                total += 1
    print(f"| {count} fleets of {units} robots, {runs} runs each | of {total} |")
    print("|---|---|")
    print(f"| next robot within 95 % | {100 * nexts / total:.0f} % |")
    print(
        f"| spread between robots within its 95 % | {100 * spreads / total:.0f} % |\n", flush=True
    )


def unlike(count):
    """Print how often a run that differs is named with its cause, and false alarms."""
    model, pi, friction = arm()
    print(f"| one run of 6 differs, {count} sets of each | named | another | none |")
    print("|---|---|---|---|")
    for kind in ("alike", *KINDS):
        right = wrong = none = 0
        for seed in range(count):
            rng, logs = np.random.default_rng([seed, len(kind)]), []
            for run in range(6):
                own = pi.copy()
                own[friction] *= 1 + WITHIN * rng.normal(size=len(friction))
                if run == 2 and kind == "payload":
                    own[10 * len(model.layout.bodies) - 10] += 1.0
                if run == 2 and kind == "friction":
                    own[model.layout.names.index("elbow_joint.coulomb")] *= 2.5
                log = simulated(model, own, rng)
                if run == 2 and kind == "gain":
                    log = replace(log, tau=log.tau * np.array([1.0, 1.15, 1.0]))
                logs.append(log)
            found = vary([str(k) for k in range(6)], groups(model, logs, ["a"] * 6)).unlike
            cause = {"friction": "drive"}.get(kind, kind)
            is_right = [(each.run, each.kind) == (2, cause) for each in found]
            right += any(is_right)
            wrong += not all(is_right)
            none += not found
        print(f"| {kind} | {right} | {wrong} | {none} |", flush=True)


if __name__ == "__main__":
    main()
