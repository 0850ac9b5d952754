"""What a second motion adds, and whether a motion for a payload finds it.

    python benchmarks/bench_motions.py [--picture] [--quick]

A second motion: a first one is simulated with noise of 2 % in the torque and identified; then
``robotid preview --given`` says by how much each second motion of 10 s narrows the widest quarter
of the intervals, widest against what is plausible: the first one again, one designed as if nothing
were known (criteria D and A), and one designed with ``--given``. The first is either a design of
5 s, or what people record: a random Fourier series of 20 s, 4 harmonics, at 30 % of the speeds and
half of the ranges.

A payload of 2 kg on the last link: ``excite --kind payload``, then robots that differ from their
URDF by 10 % are simulated with it and without it, following the motion by the URDF's inverse
dynamics and PD, and ``robotid payload`` finds it.

Every design has one start, and is followed until it settles; collisions are looked at for payloads
alone. ``--picture`` writes docs/pictures/next_motion.svg.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_excitation import identified, must, record

from robotid.design.basis import DesignedMotion, FourierBasis
from robotid.design.design import Designer
from robotid.design.motion_files import write_motion
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
PAYLOADS = {
    "ur10_robot": ("tool0",),
    "panda": ("panda_hand", "--lock", "panda_finger_joint1=0", "--lock", "panda_finger_joint2=0"),
}
COM, INERTIA = (0.02, 0.01, 0.05), (0.02, 0.0, 0.025, 0.0, 0.0, 0.015)
PICTURE = Path(__file__).resolve().parents[1] / "docs" / "pictures" / "next_motion.svg"


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


def draw(found):
    """Write the picture of what second motions add."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "robotid", "font.size": 9})
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(found), figsize=(9.0, 2.6), sharey=True)
    for axis, ((robot, first), by_name) in zip(axes, found.items(), strict=True):
        for k, (name, values) in enumerate(by_name.items()):
            colour = "#c44e00" if name.startswith("--given") else "#44617b"
            axis.plot(values, np.full(len(values), -k), "o", color=colour, alpha=0.5, ms=4)
            axis.plot(values.mean(), -k, "|", color=colour, ms=16, mew=2)
        axis.set_title(f"{robot}\nfirst: {first}", fontsize=9)
        axis.set_xlim(left=0)
        axis.grid(axis="x", alpha=0.3)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    axes[0].set_yticks(-np.arange(len(SECOND)), list(SECOND))
    axes[0].set_ylim(-len(SECOND) + 0.5, 0.5)
    figure.supxlabel("the widest quarter of the intervals is cut by [%]; a dot per seed, bar: mean",
                     fontsize=9)  # fmt: skip
    figure.tight_layout()
    figure.savefig(PICTURE, metadata={"Date": None})


def payload_row(folder, robot, options, seeds):
    """Return what a motion for a payload tells, expected and found."""
    urdf, (link, *locked) = example_urdf(f"{robot}.urdf"), options
    motion, plant = folder / "motion.parquet", folder / "plant.toml"
    words = ("--kind", "payload", "--link", link, "--mass", 2, "--com", "0.02,0.01,0.05",
             "--starts", 1)  # fmt: skip
    said = must("excite", urdf, "--out", motion, *locked, *words, "--json")
    told = json.loads(said)["payload"]
    plant.write_text(
        f'[payload]\nlink = "{link}"\nmass = 2.0\ncom = {list(COM)}\ninertia = {list(INERTIA)}\n'
    )
    noisy = ("--rate", 200, "--torque-noise", 0.02, "--perturb", 0.1, "--json")
    errors, inside, stds, com, inertia = [], 0, [], [], 0
    for seed in range(seeds):
        logs = [folder / f"{name}.parquet" for name in ("loaded", "bare")]
        for log, own in zip(logs, (("--plant", plant), ()), strict=True):
            must("simulate", urdf, motion, "--out", log, "--seed", seed, *noisy, *locked, *own)
        said = must("payload", urdf, logs[0], "--reference", logs[1], "--link", link, *locked,
                    "--json")  # fmt: skip
        found = json.loads(said)["payloads"][0]
        errors.append(abs(found["mass"] - 2.0))
        stds.append(found["mass_std_error"])
        inside += found["mass_interval"][0] <= 2.0 <= found["mass_interval"][1]
        com.append(np.abs(np.subtract(found["com"], COM)).max())
        inertia += found["inertia"] is not None
    return (
        f"| {robot} | {', '.join(told['moving'])} | {told['std_error']['m']:.3f} | "
        f"{np.mean(stds):.3f} | {np.max(errors):.3f} | {inside} of {seeds} | "
        f"{1e3 * np.max(com):.1f} | {inertia} of {seeds} |"
    )


def payloads(seeds):
    print("| robot | joints that move | mass of 2 kg, expected standard error at 1 % noise, kg | "
          "stated, kg | largest error, kg | in its 95 % interval | largest error of the centre, mm "
          "| inertia determined |")  # fmt: skip
    print("|---" * 8 + "|")
    for robot, options in PAYLOADS.items():
        with tempfile.TemporaryDirectory() as folder:
            print(payload_row(Path(folder), robot, options, seeds), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--picture", action="store_true", help="also draw the gain of second motions"
    )
    parser.add_argument("--quick", action="store_true", help="one seed, as a trial")
    options = parser.parse_args()
    found = second_motions(1 if options.quick else 5)
    if options.picture:
        draw(found)
    print()
    payloads(1 if options.quick else 10)
    print(f"\n{setting.machine()}")


if __name__ == "__main__":
    main()
