"""Friction chosen by evidence: what it buys on recordings, whether its intervals hold, its time.

    ROBOTID_DATA=folder python benchmarks/bench_friction.py [--quick] [--recordings 100]

First: the validation error of each joint of the recordings of other laboratories, with viscous and
Coulomb friction and with ``friction = "auto"``; ratio is the one over the other. Second: simulated
recordings of a UR10 with load friction on lift and elbow and a hook of Stribeck on the pan, noise
of 2 % that forgets after 50 ms: how often 95 % intervals hold the truth. A parameter counts where
the joint has no family beside that of the truth; the torque of a joint's friction, over the speeds
seen and two loads, counts everywhere. Third: processor time on 1e5 samples of a Panda.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import os
import time
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from robotid.cli.job import read_job
from robotid.estimation.fitting.standard_errors import QUANTILE
from robotid.estimation.fitting.fitted import friction_curve
from robotid.cli.identify import identify
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.dynamics.torque import remember
from robotid.dynamics.torque import predict
from robotid.robot.drive_term import DriveMotion
from robotid.robot.drives import LoadFriction, Stribeck
from robotid.robot.drives import AUTO
from robotid.dynamics.simulation.simulator import another_robot
from robotid.dynamics.simulation.motions import random_fourier

JOBS = Path(__file__).parents[1] / "tests" / "jobs"
PLAIN = "viscous+coulomb"
PAN, LIFT, ELBOW = "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"
TRUTH = {LIFT: "load", ELBOW: "load", PAN: "stribeck"}
SHARE, HOOK, SPEED = 0.07, 8.0, 0.15  # [-], [N m], [rad/s]
RATE, DURATION, NOISE = 100.0, 48.0, 0.02  # [Hz], [s], of the RMS torque
FORGETS = 0.05  # [s]
SAMPLES = 100_000  # of the arm that is timed
ARM = "panda"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one recording of each kind")
    parser.add_argument(
        "--recordings", type=int, default=100, help="number of simulated recordings"
    )
    parser.add_argument("--estimator", default="wls", help="estimator of the simulated recordings")
    parser.add_argument(
        "--min-velocity", type=float, default=0.02, help="their min_velocity [rad/s]"
    )
    options = parser.parse_args()
    if "ROBOTID_DATA" in os.environ:
        real_recordings(
            ["kinova_gen3"] if options.quick else sorted(p.stem for p in JOBS.glob("*.toml"))
        )
    else:
        print("no recordings: set ROBOTID_DATA\n")
    signals = SignalSettings(min_velocity=options.min_velocity)
    coverage(1 if options.quick else options.recordings, options.estimator, signals)
    speed(5000 if options.quick else SAMPLES)
    print(f"\n{setting.machine()}")


def real_recordings(names):
    print("| recording | joint | RMSE, viscous and Coulomb | RMSE, auto | ratio | selected |")
    print("|---|---|---|---|---|---|")
    for name in names:
        job = read_job(JOBS / f"{name}.toml")
        model = job.model()
        fitted, kept = (
            [job.read(entry, model) for entry in some]
            for some in (job.identification, job.validation)
        )
        own = {"signals": job.signals, "estimator": job.estimator, "doctor": False}
        plain, auto = (
            identify(model, fitted, validation=kept, friction=friction, **own)
            for friction in (PLAIN, AUTO)
        )
        chosen = {choice.joint: choice.families for choice in auto.drives}
        ratios = []
        (before,), (after,) = plain.predictions.values(), auto.predictions.values()
        for joint, measured in before.per_joint.items():
            rmse = after.per_joint[joint].rmse
            ratios.append(rmse / measured.rmse)
            print(
                f"| {name} | {joint} | {measured.rmse:.3g} {measured.unit} | {rmse:.3g} | "
                f"{ratios[-1]:.2f} | {', '.join(chosen.get(joint, ())) or '-'} |",
                flush=True,
            )
        print(f"| {name} | geometric mean | | | {np.exp(np.mean(np.log(ratios))):.2f} | |")


def robots():
    """Return the UR10 of the URDF, and with the terms of the truth."""
    model = setting.robot("UR10")
    terms = {"load": LoadFriction(), "stribeck": Stribeck(speed=SPEED)}
    return model, model.with_terms({joint: [terms[name]] for joint, name in TRUTH.items()})


def recording(truth, seed):
    """Return the log of a robot with the terms of the truth, and its parameters by name."""
    rng = np.random.default_rng([1, seed])
    pi = another_robot(truth, rng)
    names = list(truth.layout.names)
    for joint, name in TRUTH.items():
        pi[names.index(f"{joint}.{name}")] = {"load": SHARE, "stribeck": HOOK}[name]
    t = np.arange(round(RATE * DURATION)) / RATE
    q, v, a = random_fourier(truth, rng, period=DURATION / 2).evaluate(t)
    still = Log(t=t, q=q, v=v, a=a, tau=np.zeros_like(q), joints=truth.joints)
    motion = process(still, SignalSettings(cutoff=None, trim=0.0))
    tau = predict(truth, [pi], remember(truth.with_reference(pi), motion))[0]
    keep = np.exp(-1.0 / (FORGETS * RATE))
    noise = lfilter([np.sqrt(1 - keep**2)], [1.0, -keep], rng.standard_normal(tau.shape), axis=0)
    tau = tau + NOISE * np.sqrt(np.mean(tau**2, axis=0)) * noise
    return Log(t=t, q=q, v=v, a=a, tau=tau, joints=truth.joints), dict(zip(names, pi, strict=True))


def coverage(recordings, estimator, signals):
    model, truth = robots()
    held = {AUTO: {}, PLAIN: {}}
    right, beside, named = 0, 0, 0
    for seed in range(recordings):
        log, true = recording(truth, seed)
        for friction, by_term in held.items():
            own = {"friction": friction, "estimator": estimator, "signals": signals}
            found = identify(model, [log], doctor=False, **own)
            chosen = {choice.joint: choice.families for choice in found.drives}
            for joint in model.joints:
                where = "with load or hook" if joint in TRUTH else "other joints"
                true_families = (TRUTH[joint],) if joint in TRUTH else ()
                is_same = chosen.get(joint, ()) == true_families
                if set(chosen.get(joint, ())) <= set(true_families):
                    for term, is_held in parameters(found, joint, true):
                        by_term.setdefault((where, term), []).append(is_held)
                by_term.setdefault((where, "torque of friction"), []).extend(
                    curve(found, truth, joint, true)
                )
                if friction == AUTO:
                    right += is_same and joint in TRUTH
                    beside += not is_same and joint not in TRUTH
            if friction == PLAIN:
                missing = {misfit.joint for misfit in found.misfits}
                named += len(missing & set(TRUTH))
    print(
        f"\n| 95 % intervals of {recordings} simulated recordings, {estimator} | auto | {PLAIN} |"
    )
    print("|---|---|---|")
    for key in sorted(held[AUTO]):
        cells = [
            f"{100 * np.mean(held[f][key]):.1f} % of {len(held[f][key])}" if key in held[f] else "-"
            for f in (AUTO, PLAIN)
        ]
        print(f"| {key[1]}, {key[0]} | {' | '.join(cells)} |")
    sums = [
        [x for key, values in held[f].items() if key[1] != "torque of friction" for x in values]
        for f in (AUTO, PLAIN)
    ]
    print(f"| all parameters | {' | '.join(f'{100 * np.mean(x):.1f} %' for x in sums)} |")
    joints = recordings * len(TRUTH)
    print(f"| the true term is selected | {right} of {joints} joints | |")
    print(f"| a term is selected where there is none | {beside} of {joints} joints | |")
    print(f"| a misfit is named on the joint | | {named} of {joints} joints |", flush=True)


def parameters(found, joint, true):
    """Yield each parameter and shape of a joint's friction, and whether its interval holds it."""
    K = found.mapping.K
    for k, name in enumerate(found.mapping.base_names):
        owner, _, term = name.partition(".")
        if owner == joint and term in ("viscous", "coulomb", "load", "stribeck"):
            if np.count_nonzero(K[k]) > 1:
                continue
            miss = abs(found.base[k] - true[name])
            yield term, miss <= found.errors.quantile[k] * found.base_error[k]
    for choice in found.drives:
        for shape in choice.shapes if choice.joint == joint else ():
            yield shape.name, abs(shape.value - SPEED) <= QUANTILE * shape.std_error


def curve(found, truth, joint, true):
    """Return where the band of a joint's friction holds it, over speeds and loads."""
    motion = found.fitted[0].recording
    j = truth.joints.index(joint)
    v = np.abs(motion.trajectory.v[motion.mask[:, j], j])
    v = np.linspace(np.quantile(v, 0.05), v.max(), 10)
    held = []
    for load in (0.0, 60.0) if TRUTH.get(joint) == "load" else (0.0,):
        x = DriveMotion(0 * v, v, 0 * v, np.sign(v), load + 0 * v, 0 * v)
        wanted = sum(
            true[f"{joint}.{term.name}"] * term.column(x)
            for d, term in truth.layout.drive_parameters
            if d == j and not term.is_inertia
        )
        own = friction_curve(found, joint, v, load=load)
        held += list(np.abs(own.torque - wanted) <= QUANTILE * own.std)
    return held


def speed(samples):
    model = setting.robot(ARM)
    print(f"\n| {samples} samples of a {ARM}, processor time | {PLAIN} | auto | ratio |")
    print("|---|---|---|---|")
    timed(model, samples, 0.0)  # what is compiled is ready then
    for what, share in (("no friction but that", 0.0), ("load friction in all joints", SHARE)):
        plain, auto = timed(model, samples, share)
        print(f"| {what} | {plain:.1f} s | {auto:.1f} s | {auto / plain:.1f} |", flush=True)


def timed(model, samples, share):
    """Return the processor time of each identification, of drives with load friction."""
    x = setting.motion(model, samples, np.random.default_rng(0))
    tau = x.tau + share * np.sign(x.v) * np.abs(x.tau)
    log = Log(t=x.t, q=x.q, v=x.v, a=x.a, tau=tau, joints=x.joints)
    seconds = []
    for friction in (PLAIN, AUTO):
        begin = time.process_time()
        identify(model, [log], friction=friction, doctor=False)
        seconds.append(time.process_time() - begin)
    return seconds


if __name__ == "__main__":
    main()
