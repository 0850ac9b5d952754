"""Drives from commands and positions: errors of open loops, intervals, and time.

    ROBOTID_DATA=folder python benchmarks/bench_commands.py [--quick] [--out FOLDER]
        [--go2] [--so101] [--rollouts] [--coverage RUNS] [--torque]

Without a part named, all of them. --coverage: MuJoCo rolls out a robot with known drives on a
multi-sine of 10 s at 500 Hz, at a step of 0.2 ms and with stiff friction, encoders with noise of
0.1 mrad; gains are stated, bodies are those of the URDF. Times are of the processor, all threads
together, where they do not say otherwise: another load of the machine adds little to them.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "tests"))

from helpers import mujoco_plant

from robotid.commanded.identify import identify_commands
from robotid.commanded.settings import LoopSettings
from robotid.identification.settings import SimulationSettings
from robotid.logs.data import Log

FINE = 2e-4  # [s] step of the plant
STIFF = (0.9999, 0.9999, 0.001, 0.5, 2.0)  # impedance of its friction
RATE, DURATION, NOISE = 500.0, 10.0, 1e-4  # [Hz], [s], [rad]
REACH = 1.96


def coverage(robots, runs, seconds=DURATION):
    """Return rows of a table: by robot and kind of parameter, how well intervals hold the truth."""
    print(f"| robot, {runs} runs | parameter | bias / scatter | error said / scatter | within 95 % |")
    print("|---" * 5 + "|")
    rows = []
    for name in robots:
        found, begun = {}, time.process_time()
        for seed in range(runs):
            for kind, error, said in one_run(name, np.random.default_rng([17, seed]), seconds):
                found.setdefault(kind, []).append((error, said))
        took = (time.process_time() - begun) / runs
        for kind, pairs in found.items():
            error, said = np.array(pairs).T
            share = np.mean(np.abs(error) <= REACH * said)
            row = {
                "robot": name,
                "parameter": kind,
                "values": len(error),
                "bias": float(np.mean(error) / np.std(error)),
                "std_error": float(np.sqrt(np.mean(said**2)) / np.std(error)),
                "coverage": float(share),
                "seconds": took,
            }
            rows.append(row)
            print(
                f"| {name} | {kind}, {len(error)} | {row['bias']:+.2f} | {row['std_error']:.2f} | "
                f"{100 * share:.1f} % |",
                flush=True,
            )
        print(f"| {name} | {took:.1f} s of processor a run | | | |", flush=True)
    return rows


def one_run(name, rng, seconds):
    """Yield kind, error and standard error of each parameter of a run, errors relative to usual."""
    delay = FINE * rng.integers(20, 41)
    plant = mujoco_plant.plant(name, rng, delay=delay)
    log = plant_log(plant, rng, seconds)
    gains = {key: {d.joint: getattr(d, key) for d in plant.drives} for key in ("kp", "kd")}
    first = plant.model.joints[0]
    loop = LoopSettings(**gains, groups={first: [first]})  # every joint has a drive of its own
    settings = SimulationSettings(bodies=0.0)
    found = identify_commands(plant.model, [log], [], loop, settings, chooses=False)
    estimate, truth = found.fitted.estimate, {**plant.truth, "delay": delay}
    for theta, said, key in zip(estimate.theta, estimate.std_error, estimate.names, strict=True):
        yield key.rpartition(".")[2], theta - truth[key], said


def plant_log(plant, rng, seconds, noise=NOISE, torque=None):
    """Return the log of a plant on a multi-sine, at a fine step and with stiff friction."""
    t = np.arange(round(seconds * RATE)) / RATE
    q_ref = mujoco_plant.multisine(t, plant.middle, plant.reach, rng)
    robot = mujoco_plant.loaded(plant, RATE, FINE)
    robot.dof_solref[:] = 2 * FINE, 1.0
    robot.dof_solimp[:] = STIFF
    q, force = mujoco_plant.rolled_out(robot, q_ref, RATE)
    q = q + noise * rng.standard_normal(q.shape)
    if torque is None:
        return Log(t, q, 0 * q, plant.model.joints, q_ref=q_ref, has_torque=False)
    tau = force + torque * rng.standard_normal(q.shape)
    return Log(t, q, tau, plant.model.joints, q_ref=q_ref)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--coverage", type=int, metavar="RUNS")
    parser.add_argument("--robots", nargs="+", default=["planar", "leg", "arm"])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    results = {}
    if options.coverage:
        results["coverage"] = coverage(options.robots, options.coverage)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "bench_commands.json").write_text(json.dumps(results, indent=1))
    print(f"\n{setting.machine()}")


if __name__ == "__main__":
    main()
