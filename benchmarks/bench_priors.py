"""Prediction of a NEW motion: weighted least squares against fits that know the URDF.

Every fit sees one segment of motion only, and chooses the weight of its prior from that alone;
figures are the error per joint in % of the torque of another segment. Simulated: a UR10 whose
masses are unlike its URDF's. Recorded, if ROBOTID_DATA names the folder: other laboratories' logs,
and the first tenth of each ("short"), where the excitation is poor. "auto" is the default: by
held-out segments where the log is long enough, else 1.

    ROBOTID_DATA=folder python benchmarks/bench_priors.py [--quick | --weights]

``--weights`` compares the chosen weight with fixed ones on the job files of tests/jobs.
"""

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import numpy as np
from setting import machine, robot

from robotid.commands.job import read_job
from robotid.fitting.evaluation import pool
from robotid.fitting.settings import EstimatorSettings
from robotid.identification.pipeline import identify
from robotid.logs.data import Log
from robotid.logs.settings import SignalSettings
from robotid.regressor.torque import joint_torque_regressor
from robotid.simulation.closed_loop import another_robot
from robotid.simulation.motions import random_fourier

JOBS = Path(__file__).parents[1] / "tests" / "jobs"
DATA = os.environ.get("ROBOTID_DATA")
FITS = {
    "euclidean, 1": {"prior": "euclidean", "prior_weight": 1.0},
    "riemannian, 1": {"prior": "riemannian", "prior_weight": 1.0},
    "entropic, 1": {"prior": "entropic", "prior_weight": 1.0},
    "euclidean, evidence": {"prior": "euclidean", "prior_weight": "evidence"},
    "riemannian, evidence": {"prior": "riemannian", "prior_weight": "evidence"},
    "entropic, evidence": {"prior": "entropic", "prior_weight": "evidence"},
    "euclidean, auto": {"prior": "euclidean", "prior_weight": "auto"},
    "riemannian, auto": {"prior": "riemannian", "prior_weight": "auto"},
    "entropic, auto": {"prior": "entropic", "prior_weight": "auto"},
}
QUICK = ["euclidean, 1", "euclidean, auto", "riemannian, auto"]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few cases and fits")
    parser.add_argument(
        "--weights", action="store_true", help="the selected weight and fixed weights"
    )
    options = parser.parse_args()
    if options.weights:
        weights()
        return
    names = QUICK if options.quick else list(FITS)
    ratios, shorts = {name: [] for name in names}, {name: [] for name in names}
    for title, model, signals, train, test in cases(options.quick):
        errors = compare(model, signals, train, test, names)
        print(
            f"\n### {title}\n\n| fit | weight | error per joint [%] | over WLS |\n|---|---|---|---|"
        )
        wls = errors["wls"][1]
        for name, (weight, error, seconds) in errors.items():
            ratio = float(np.exp(np.mean(np.log(error / wls))))
            shown = "-" if weight is None else f"{weight:.3g}"
            print(f"| {name} | {shown} | {row(error)} | {ratio:.2f} |")
            if name != "wls" and (DATA is None or "simulated" not in title):
                (shorts if "short" in title else ratios)[name].append((ratio, seconds))
    print("\n### Error divided by that of WLS, geometric mean over joints and recordings\n")
    print("| fit | segments | short segments | worst segment | worst short one | s per fit |")
    print("|---|---|---|---|---|---|")
    for name in names:
        cells = [summary(ratios[name], mean), summary(shorts[name], mean)]
        cells += [summary(ratios[name], max), summary(shorts[name], max)]
        seconds = np.mean([s for _, s in ratios[name] + shorts[name]])
        print(f"| {name} | {' | '.join(cells)} | {seconds:.2f} |")
    print(f"\n{machine()}")


def weights():
    """Print validation errors with the chosen and with fixed weights, for each job file."""
    print("| job | weight | error per joint [%] | over the best fixed weight | worst joint |")
    print("|---|---|---|---|---|")
    for path in sorted(JOBS.glob("*.toml")):
        job, errors = read_job(path), {}
        model = job.model()
        fitted, kept = (
            [job.read(e, model) for e in x] for x in (job.identification, job.validation)
        )
        for weight in (100.0, 10.0, 1.0, 0.1, "auto"):
            settings = replace(job.estimator, prior_weight=weight, draws=0)
            found = identify(
                model, fitted, validation=kept, signals=job.signals, estimator=settings
            )
            errors[weight] = error_per_joint(found, "estimate")
            chosen = found.estimate.details["prior"]["weight"]
            best = min((errors[w] for w in errors if w != "auto"), key=mean)
            ratio = errors[weight] / best
            shown = f"{chosen:.3g}" if weight != "auto" else f"auto: {chosen:.3g}"
            beside = f"{mean(ratio):.3f} | {ratio.max():.3f}" if weight == "auto" else "- | -"
            print(f"| {path.stem} | {shown} | {row(errors[weight])} | {beside} |", flush=True)
    print(f"\n{machine()}")


def cases(quick):
    """Yield title, model, signal settings, logs to fit and logs of another motion."""
    if not quick:
        yield simulated("UR10 simulated, 20 s", 20.0)
    yield simulated("UR10 simulated, short: 2 s", 2.0)
    if DATA is None:
        return
    kinova = read_job(JOBS / "kinova_gen3.toml")
    model = kinova.model()
    first, *_ = [kinova.read(entry, model) for entry in kinova.identification]
    (fourth,) = [kinova.read(entry, model) for entry in kinova.validation]
    yield "Kinova 1 -> 4", model, kinova.signals, [first], [fourth]
    yield from short("Kinova", model, kinova.signals, [first], [fourth], 6)
    if quick:
        return
    for name in ("tiago", "panda_inria"):
        job = read_job(JOBS / f"{name}.toml")
        model = job.model()
        fitted, kept = (
            [job.read(e, model) for e in x] for x in (job.identification, job.validation)
        )
        yield f"{name}, one segment -> the rest", model, job.signals, fitted, kept
        yield from short(name, model, job.signals, fitted, kept)
    for name in ("tx40", "ur10e"):
        job = read_job(JOBS / f"{name}.toml")
        model = job.model()
        entry = job.identification[0]
        if name == "tx40":
            entry = replace(entry, start=None, end=None)
        thirds = list(split(job.read(entry, model), 3))
        for k in range(3):
            others = [third for i, third in enumerate(thirds) if i != k]
            yield f"{name}, third {k + 1} -> the others", model, job.signals, [thirds[k]], others
        yield from short(name, model, job.signals, [join(thirds)], [thirds[2]])


def short(name, model, signals, logs, kept, parts=10):
    """Yield the case that fits the first part of a log only."""
    part = next(split(logs[0], parts))
    yield f"{name}, short: the first {part.t[-1] - part.t[0]:.1f} s", model, signals, [part], kept


def join(logs):
    return replace(
        logs[0],
        **{
            key: np.concatenate([getattr(log, key) for log in logs])
            for key in ("t", "q", "v", "a", "tau")
            if getattr(logs[0], key) is not None
        },
    )


def split(log, parts):
    """Yield parts of equal duration."""
    edges = np.linspace(log.t[0], log.t[-1], parts + 1)[1:-1]
    for rows in np.split(np.arange(len(log.t)), np.searchsorted(log.t, edges)):
        yield replace(
            log,
            **{
                key: getattr(log, key)[rows]
                for key in ("t", "q", "v", "a", "tau")
                if getattr(log, key) is not None
            },
        )


def simulated(title, duration):
    model, rng = robot("UR10"), np.random.default_rng(0)
    pi = another_robot(model, rng)
    logs = []
    for seconds in (duration, 20.0):
        t = np.arange(round(100.0 * seconds)) / 100.0
        q, v, a = random_fourier(model, rng, period=20.0).evaluate(t)
        tau = (joint_torque_regressor(model, q, v, a) @ pi).reshape(v.shape)
        tau += 0.05 * np.std(tau, axis=0) * rng.standard_normal(tau.shape)
        logs.append(Log(t=t, q=q, tau=tau, joints=model.joints, v=v, a=a))
    return title, model, SignalSettings(cutoff=None, trim=0.0), logs[:1], logs[1:]


def compare(model, signals, train, test, names):
    """Return weight, error per joint on the test logs and seconds of each fit."""
    errors = {}
    for name in names:
        settings = EstimatorSettings(**FITS[name], draws=0)
        start = time.perf_counter()
        found = identify(model, train, validation=test, signals=signals, estimator=settings)
        seconds = time.perf_counter() - start
        if not errors:
            errors["wls"] = (None, error_per_joint(found, "wls"), 0.0)
        weight = found.estimate.details["prior"]["weight"]
        errors[name] = (weight, error_per_joint(found, "estimate"), seconds)
    return errors


def error_per_joint(found, name):
    measured = pool(found.model, found.validation, name).per_joint.values()
    return np.array([m.relative_error_pct for m in measured])


def mean(values):
    return float(np.exp(np.mean(np.log(values))))


def summary(cases, function):
    return f"{function([ratio for ratio, _ in cases]):.3f}" if cases else "-"


def row(errors):
    return " / ".join(f"{error:.1f}" if error < 10 else f"{error:.0f}" for error in errors)


if __name__ == "__main__":
    main()
