"""Build the gallery of the site: identify each robot, write its report and its replay.

    python docs/gallery.py [NAME ...]

It writes to build/gallery, which the site takes in. Recordings are read from the folder that the
variable ROBOTID_DATA names; without it the gallery has the simulated robots alone.
"""

import argparse
import json
import os
import shutil
import tempfile
from contextlib import chdir
from dataclasses import replace
from pathlib import Path

import numpy as np

import robotid
from robotid.commands.demo import run_demo
from robotid.robot.examples import example_urdf
from robotid.simulation.closed_loop import Noise, another_robot, simulate
from robotid.simulation.motions import random_fourier

ROOT = Path(__file__).parents[1]
GALLERY = ROOT / "build" / "gallery"

#: Title and lesson of each recording; tests/jobs has their job files.
RECORDED = {
    "ur10e": (
        "UR10e, Innopolis University",
        "Currents with published gains. Both friction and gravity need motion in both directions; "
        "the validation motion is a point-to-point motion that no identification log contains.",
    ),
    "tx40": (
        "Stäubli TX40, LS2N Nantes",
        "A coupled wrist: one motor also moves another joint, so its friction belongs to the sum "
        "of two joint velocities.",
    ),
    "panda_inria": (
        "Franka Panda, Inria Rennes",
        "Joint torque sensors. The validation motion resembles the identification motion, and the "
        "verdict states it.",
    ),
    "kinova_gen3": (
        "Kinova Gen3, University of Michigan",
        "Harmonic drives: friction depends on load and position. The report names the worst joint "
        "and what its residual correlates with.",
    ),
    "tiago": (
        "TIAGo, LAAS Toulouse",
        "A verdict of poor: the wrist's currents have a resolution of a few quanta, and no "
        "estimator can correct that.",
    ),
}
#: Title, lesson, URDF and locked joints of each simulated robot.
SIMULATED = {
    "xarm7": (
        "xArm 7, simulated",
        "All 43 base parameters of a seven-axis arm from two motions of ten seconds.",
        "xarm7.urdf",
        {},
    ),
    "panda": (
        "Panda, simulated",
        "Locked fingers: their mass is identified with the hand's.",
        "panda.urdf",
        {"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.02},
    ),
    "z1": (
        "Unitree Z1, simulated",
        "A light arm: motor inertia and friction exceed the torques of the links.",
        "z1.urdf",
        {"jointGripper": 0.0},
    ),
}
RATE = 200.0  # [Hz]
PERIOD = 10.0  # [s]
NOISE = Noise(q=2e-5, v=2e-4, tau=0.02)  # [rad], [rad/s], share of the torque


def main():
    """Build the entries that are named, or all, and list those that exist."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME")
    names = parser.parse_args().names
    recorded = RECORDED if os.environ.get("ROBOTID_DATA") else {}
    entries = []
    for name in ["demo", *recorded, *SIMULATED]:
        if not names or name in names:
            print(name, flush=True)
            entries.append(build(name, GALLERY / name))
    GALLERY.mkdir(parents=True, exist_ok=True)
    (GALLERY / "entries.json").write_text(json.dumps(entries, indent=1))


def build(name, folder):
    """Identify one robot into a folder, and return what the page says about it."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as written:
        if name == "demo":
            found = run_demo(written)[0]
            title, lesson = "The demo", "A simulated robot whose masses, friction and motor "
            lesson += "inertia differ from its URDF."
            command = "robotid demo"
        elif name in RECORDED:
            title, lesson = RECORDED[name]
            job = replace(robotid.read_job(ROOT / f"tests/jobs/{name}.toml"), replay=True)
            found = robotid.run_job(job, written)[0]
            command = f"robotid identify tests/jobs/{name}.toml --out {name}"
        else:
            title, lesson, urdf, locked = SIMULATED[name]
            with chdir(written):
                found = simulated(urdf, locked)
            robotid.save_result(found, written, replay=True)
            command = (
                f"robotid identify {urdf} first.csv --validate second.csv --replay --out {name}"
            )
        report = (Path(written) / "report.html").read_text()
        data = os.environ.get("ROBOTID_DATA", written).rstrip("/")
        report = report.replace(f"{data}/", "").replace(written, name)  # where it was built
        (folder / "report.html").write_text(report)
        shutil.copyfile(Path(written) / "replay.html", folder / "replay.html")
    return {"name": name, "title": title, "lesson": lesson, "command": command} | facts_of(found)


def simulated(urdf, locked):
    """Simulate two logs of a robot that its URDF does not describe, and identify it."""
    rng = np.random.default_rng(0)
    model = robotid.RobotModel.from_urdf(example_urdf(urdf), locked=locked)
    truth = another_robot(model, rng)
    for name in ("first.csv", "second.csv"):
        motion = random_fourier(model, rng, period=PERIOD)
        log = simulate(model, truth, motion, rate=RATE, duration=PERIOD, rng=rng, noise=NOISE)
        robotid.write_log(log, name)
    return robotid.identify(model, "first.csv", validation="second.csv")


def facts_of(found):
    """Return the figures of an entry, by name."""
    fitted, held_out = (
        ", ".join(evaluation.recording.log.name for evaluation in logs)
        for logs in (found.fitted, found.validation)
    )
    facts = {
        "robot": f"{found.model.name}, {len(found.model.joints)} joints",
        "identification": fitted,
        "validation": held_out,
        "verdict": found.verdict.status,
        "base parameters": len(found.base),
    }
    return {"facts": facts}


if __name__ == "__main__":
    main()
