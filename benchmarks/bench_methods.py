"""What a fit of closed loops compares: positions, positions and torques, torques of roll-outs.

    python benchmarks/bench_methods.py [--quick] [--runs RUNS]

MuJoCo simulates three joints of a leg with known drives at a step of 0.05 ms, with stiff friction,
on multi-sines of 6 s at 500 Hz; encoders have a noise of 0.3 mrad, logged torques one of 0.05 N m.
Gains and delay are stated, as the direct method needs it; bodies are those of the URDF. All methods
begin with a fit to some windows, which is in their time.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests"))

import mujoco
from bench_commands import FINE, QUANTILE, RATE, STIFF
from helpers import mujoco_plant

from robotid.data.log import Log
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.stages import fit_loops

SECONDS, NOISE, TORQUE, DELAY = 6.0, 3e-4, 0.05, 0.005  # [s], [rad], [N m], [s]
STEP = 1e-3  # [s] of our roll-outs
#: Gains of three joints [N m/rad], [N m s/rad], and the highest tone of their commands [Hz].
CASES = {"stiff": (80.0, 3.0, 1.5), "soft": (20.0, 1.2, 4.0)}
METHODS = {
    "positions alone (output)": {"torques": False},
    "positions and torques (output)": {},
    "torques alone (input)": {"error": "input"},
    "the same, motion neglected (direct)": {"error": "direct"},
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one run of 2 s, as a trial")
    parser.add_argument("--runs", type=int, default=4)
    options = parser.parse_args()
    runs, seconds = (1, 2.0) if options.quick else (options.runs, SECONDS)
    print(f"| controller, {runs} runs | fitted to | median error over truth: armature | viscous "
          "| coulomb | stated error / scatter | 95 % interval coverage | steps "
          "| remaining after a step | s |")  # fmt: skip
    print("|---" * 10 + "|")
    for case, (kp, kd, highest) in CASES.items():
        found = {method: [] for method in METHODS}
        for seed in range(runs):
            rng = np.random.default_rng([18, seed])
            plant = mujoco_plant.plant("leg", rng, kp=kp, kd=kd, delay=DELAY)
            log = recorded(plant, rng, seconds, highest)
            for method, changes in METHODS.items():
                found[method].append(one_fit(plant, log, changes))
        for method, fits in found.items():
            print(row(case, method, fits), flush=True)
    print("\nMedians of runs; s: processor time per fit. Remaining: the largest share of its "
          "correction that a step does not achieve, because it neglects the change of "
          "motion.\n")  # fmt: skip
    print(f"{setting.machine()}, mujoco {mujoco.__version__}")


def recorded(plant, rng, seconds, highest):
    """Return the log of a plant."""
    t = np.arange(round(seconds * RATE)) / RATE
    q_ref = mujoco_plant.multisine(t, plant.middle, plant.reach, rng, highest=highest)
    robot = mujoco_plant.loaded(plant, RATE, FINE)
    robot.dof_solref[:] = 2 * FINE, 1.0
    robot.dof_solimp[:] = STIFF
    q, tau, _ = mujoco_plant.rolled_out(robot, q_ref, RATE)
    q = q + NOISE * rng.standard_normal(q.shape)
    tau = tau + TORQUE * rng.standard_normal(q.shape)
    return Log(t, q, tau, plant.model.joints, q_ref=q_ref)


def one_fit(plant, log, changes):
    """Return an estimate, the truth of its parameters, and the time that it took."""
    gains = {key: {d.joint: getattr(d, key) for d in plant.drives} for key in ("kp", "kd")}
    groups = {joint: [joint] for joint in plant.model.joints}  # every joint has its own drive
    loop = LoopSettings(**gains, delay=DELAY, groups=groups)
    settings = SimulationSettings(bodies=0.0, step=STEP, **changes)
    initialised = time.process_time()
    estimate = fit_loops(plant.model, [log], loop, settings, chooses=False).estimate
    took = time.process_time() - initialised
    return estimate, np.array([plant.truth[name] for name in estimate.names]), took


def row(case, method, fits):
    """Return a line of the table."""
    terms = np.array([name.rpartition(".")[2] for name in fits[0][0].names])
    errors = np.array([estimate.theta - truth for estimate, truth, _ in fits])
    said = np.array([estimate.std_error for estimate, *_ in fits])
    sizes = np.array([truth for _, truth, _ in fits])
    is_held = np.abs(errors) <= QUANTILE * said
    shares = [
        f"{100 * np.median(np.abs(errors[:, terms == term] / sizes[:, terms == term])):.2g} %"
        for term in ("armature", "viscous", "coulomb")
    ]
    steps = np.median([estimate.n_iter for estimate, *_ in fits])
    left = np.median([estimate.details["left"] for estimate, *_ in fits])
    settled = sum(estimate.converged for estimate, *_ in fits)
    steps_said = f"{steps:.0f}" + ("" if settled == len(fits) else f", {settled} runs settled")
    cells = [
        case, method, *shares, f"{1.0 / np.sqrt(np.mean((errors / said) ** 2)):.2f}",
        f"{100 * is_held.mean():.0f} %", steps_said, f"{100 * left:.0f} %" if left else "",
        f"{np.median([took for *_, took in fits]):.1f}",
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
