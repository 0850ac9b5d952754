"""What a second motion adds.

    python benchmarks/bench_motions.py [--quick]

A second motion: a first one is simulated with noise of 2 % in the torque and identified; then
``robotid preview --given`` says by how much each second motion of 10 s narrows the widest quarter
of the intervals, widest against what is plausible: the first one again, one designed as if nothing
were known (criteria D and A), and one designed with ``--given``. The first is either a design of
5 s, or what people record: a random Fourier series of 20 s, 4 harmonics, at 30 % of the speeds and
half of the ranges.

Every design has one start, and is followed until it settles; collisions are not looked at.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_excitation import identified, must, record

from robotid.design.design import DesignedMotion, FourierBasis
from robotid.design.design import Designer
from robotid.design.excitation import write_motion
from robotid.design.limits import MotionLimits
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

NEXT = ("ur10_robot", "xarm7")
SECOND = {
    "the first again": None,
    "fresh": (),
    "fresh, criterion A": ("--criterion", "A"),
    "--given the first": ("--given",),
}


def recorded(urdf, target, seed):
    """Write a motion as people record: slow, and not designed."""
    model, basis = RobotModel.from_urdf(urdf), FourierBasis(20.0, 4)
    limits, rng = MotionLimits.of_model(model), np.random.default_rng(seed)
    limits = replace(limits, sizes=limits.sizes * [[0.5], [0.3], [1], [1], [1], [1]])
    designer = Designer.of_model(model, basis, limits)
    C = max((designer.random(rng) for _ in range(5)), key=lambda C: np.abs(C[1:]).sum())
    write_motion(DesignedMotion(basis, C), model.joints, 20.0, 100.0, target)


def cuts(folder, robot, first, seed):
    """Return by how much each second motion narrows the widest quarter of the intervals, in %."""
    urdf, words = example_urdf(f"{robot}.urdf"), ("--json", "--starts", 1, "--clearance", "none")
    motion = folder / "first.parquet"
    if first == "recorded":
        recorded(urdf, motion, seed)
    else:
        must("excite", urdf, "--out", motion, "--seed", seed, "--duration", 5, *words)
    result, _ = identified(folder, (urdf,), record(folder, (urdf,), "log", motion, seed))
    found = {}
    for name, options in SECOND.items():
        second = motion
        if options is not None:
            second = folder / "second.parquet"
            own = (*options, result) if "--given" in options else options
            must("excite", urdf, "--out", second, "--seed", seed + 100, *words, *own)
        said = json.loads(must("preview", urdf, second, "--given", result, "--json"))
        rows = [
            [entry[key] or np.inf for key in ("std_error", "std_error_before", "plausible")]
            for entry in said["base_parameters"]
            if entry["plausible"]
        ]
        after, before, plausible = np.array(rows).T
        widest = np.argsort(before / plausible)[-max(1, round(len(before) / 4)) :]
        found[name] = 100 * (1 - np.exp(np.mean(np.log(after / before)[widest])))
    return found


def second_motions(seeds):
    """Print what second motions add; return it by robot, first and second."""
    print("| robot | first motion | widest quarter reduced by: " + " | ".join(SECOND) + " | "
          "--given better than without |")  # fmt: skip
    print("|---" * (len(SECOND) + 3) + "|")
    all_of_them = {}
    for robot in NEXT:
        for first in ("recorded", "5 s design"):
            with tempfile.TemporaryDirectory() as folder:
                found = [cuts(Path(folder), robot, first, seed) for seed in range(seeds)]
            by_name = {name: np.array([one[name] for one in found]) for name in SECOND}
            all_of_them[robot, first] = by_name
            cells = [f"{x.mean():.0f} % ({x.min():.0f} to {x.max():.0f})" for x in by_name.values()]
            wins = np.sum(by_name["--given the first"] > by_name["fresh"])
            print(f"| {robot} | {first} | {' | '.join(cells)} | {wins} of {seeds} |", flush=True)
    return all_of_them


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one seed, as a trial")
    options = parser.parse_args()
    second_motions(1 if options.quick else 5)
    print(f"\n{setting.machine()}")


if __name__ == "__main__":
    main()
