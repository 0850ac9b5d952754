"""Legged robots with unknown contact forces: intervals, masses, prediction, time.

    python benchmarks/bench_legged.py [--runs 20] [--quick] [--long]

A Go1 stands on point feet in MuJoCo at 0.1 ms with held torques, 18-bit encoders and 0.05 N m of
torque noise; its joints follow multi-sines, its feet slip and lift at times. It is identified by
weighted least squares. Counted is how often the 95 % interval of an inertial base parameter holds
the truth. --long adds the consistent estimator, and motions in which the feet hardly move. With the
recordings, a Solo12 that trots in PyBullet is identified with the defaults from the first half of
its log: its URDF is the truth. Beside it the regressor's projected rows are timed against those of
an arm.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from helpers.legged import recorded, with_other_bodies
from helpers.paths import JOBS

from robotid.commands.identify import run_job
from robotid.commands.job import read_job
from robotid.exceptions import RankDeficientError
from robotid.fitting.survey import hold_log
from robotid.identification.pipeline import identify
from robotid.logs.settings import SignalSettings
from robotid.regressor.base_parameters import structural_mapping
from robotid.regressor.factors import compress
from robotid.regressor.used_rows import base_problem
from robotid.robot.constraints import Contact
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
POSTURE = {"hip": (0.0, 0.12), "thigh": (0.8, 0.25), "calf": (-1.6, 0.3)}  # middle, reach [rad]
SIGNALS = SignalSettings(cutoff=25.0, velocity="differentiated")
ARMATURE, DAMPING = 0.01, 0.2


def robot():
    return RobotModel.from_urdf(
        example_urdf("go1.urdf"), free_flyer=True, terms=("armature", "viscous"),
        constraints=[Contact(foot) for foot in FEET],
    )  # fmt: skip


def log_of(model, seed, duration, share=1.0):
    middle, reach = np.array([POSTURE[joint.split("_")[1]] for joint in model.joints]).T
    rng = np.random.default_rng(seed)
    log = recorded(
        model, FEET, middle, share * reach, rng, duration=duration, kp=100.0, kd=2.0, highest=1.5,
        torque=0.05, armature=ARMATURE, damping=DAMPING,
    )  # fmt: skip
    return log, with_other_bodies(model, rng)


def coverage(model, runs, duration, estimator="wls", share=1.0):
    """Print the coverage of runs; the amplitude of the joints is a share of the usual one."""
    truth = model.standard_parameters()
    names = model.layout.names
    truth += [ARMATURE * x.endswith(".armature") + DAMPING * x.endswith(".viscous") for x in names]
    print(f"Go1, {estimator}, {share:g} of the amplitude")
    print(f"{'run':>4} {'covered':>8} {'of':>4} {'rms z':>6} {'total mass [kg]':>16} {'s':>6}")
    shares = []
    for seed in range(runs):
        log, other = log_of(model, seed, duration, share)
        start = time.process_time()
        try:
            found = identify(
                other, log, signals=SIGNALS, estimator=estimator, friction="none", doctor=False
            )
        except RankDeficientError as error:
            print(f"{seed:4} {str(error)[:60]}")
            continue
        spent = time.process_time() - start
        is_drive = [x.endswith((".armature", ".viscous")) for x in found.mapping.base_names]
        z, wide = scores(found, truth)
        z, wide = z[~np.array(is_drive)], wide[~np.array(is_drive)]
        mass = found.standard[: model.layout.n_inertial : 10].sum()
        shares.append(np.mean(np.abs(z) < wide))
        print(
            f"{seed:4} {100 * shares[-1]:7.0f}% {len(z):4} {np.sqrt(np.mean(z**2)):6.2f} "
            f"{mass:16.3f} {spent:6.1f}"
        )
    if shares:
        print(f"mean {100 * np.mean(shares):7.0f}%, wanted 90 to 98 %")


def scores(found, truth):
    """Return errors of base parameters in standard errors, and the half-width of intervals."""
    z = (found.base - found.mapping.K @ truth) / found.base_error
    return z, found.errors.quantile


def trot():
    """Print the masses of a Solo12 by the defaults, beside the truth."""
    job = replace(read_job(JOBS / "legged" / "solo12.toml"), report=False)
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        found, _ = run_job(job, folder)
    spent = time.process_time() - start
    truth = found.model.standard_parameters()
    z, wide = scores(found, truth)
    (validation,) = found.validation
    used, tau = validation.recording.mask, validation.recording.trajectory.tau
    left = (tau - validation.torques["estimate"])[used]
    print(
        f"Solo12: {100 * np.linalg.norm(left) / np.linalg.norm(tau[used]):.2f} % of the projected "
        f"torque of the second half, {100 * np.mean(np.abs(z) < wide):.0f}% covered of {len(z)}, "
        f"weight {found.estimate.details['prior']['weight']:g}, {spent:.1f} s"
    )
    error = np.sqrt(np.diag(found.standard_covariance))
    for i, body in enumerate(found.model.layout.bodies):
        own = 10 * i
        print(
            f"  {body:14} {found.standard[own]:.3f} +- {error[own]:.3f} kg, {truth[own]:.3f} true"
        )


def speed(model, duration):
    log, _ = log_of(model, 0, duration)
    rows = hold_log(model, log, SIGNALS).whole
    legged = base_problem(model, structural_mapping(model), rows.trajectory, rows.mask)
    arm = setting.robot("panda")
    motion = setting.motion(arm, 20_000, np.random.default_rng(0))
    mapping = structural_mapping(arm)
    armed = base_problem(arm, mapping, motion, np.ones(motion.tau.shape))
    for name, problem, count in (
        ("Go1, projected", legged, rows.mask.sum()),
        ("panda", armed, motion.tau.size),
    ):
        compress(problem, threads=1)
        start = time.process_time()
        compress(problem, threads=1)
        spent = time.process_time() - start
        print(f"{name:16} {count / spent / 1e3:8.0f} thousand rows/s, {len(problem.names)} columns")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--long", action="store_true")
    options = parser.parse_args()
    model = robot()
    runs, duration = (1, 8.0) if options.quick else (options.runs, 20.0)
    coverage(model, runs, duration)
    if options.long:
        coverage(model, runs, duration, "consistent")
        coverage(model, runs, duration, "consistent", 0.3)
    if "ROBOTID_DATA" in os.environ:
        trot()
    speed(model, 6.0)


if __name__ == "__main__":
    main()
