"""Build the gallery of the site: identify each robot, write its report and its replay.

    python docs/gallery.py [NAME ...]

It writes to build/gallery, as the build of the site does if there is none. Recordings are read from the folder that the
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
import pinocchio as pin
from scipy.spatial import ConvexHull

import robotid
from robotid.cli.demo import run_demo
from robotid.cli.identify import run_job
from robotid.cli.job import read_job
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulator import Noise, another_robot, simulate
from robotid.robot.bodies import link_clouds
from robotid.robot.examples import example_urdf

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
        "verdict reports it.",
    ),
    "kinova_gen3": (
        "Kinova Gen3, University of Michigan",
        "Harmonic drives: friction depends on load and position. The report names the worst joint "
        "and what its residual correlates with.",
    ),
    "tiago": (
        "TIAGo, LAAS Toulouse",
        "The verdict is poor: the wrist's currents have a resolution of a few quanta. No "
        "estimator can correct it.",
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
WIDTH, HEIGHT, MARGIN = 240.0, 170.0, 12.0  # [px] of a picture
LONG = 70  # [%] of the postures have a shorter reach than that of the picture
FLAT = 1e-9  # [m] outlines that are smaller in a direction have no area


def main():
    """Build the entries that are named on the command line, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME")
    build_entries(parser.parse_args().names)


def build_entries(names=()):
    """Build the entries of some names, or all, and list them."""
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
            job = replace(read_job(ROOT / f"tests/jobs/{name}.toml"), replay=True)
            found = run_job(job, written)[0]
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
        (folder / "picture.svg").write_text(picture(found))
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


def picture(found):
    """Return the robot from the side in a posture of the log with a long reach, as SVG."""
    model = found.model
    tree, data = model.pin_model, model.pin_model.createData()
    q = found.fitted[0].recording.trajectory.q[::50]
    origins, placed = [], []
    for posture in model.configurations(q):
        pin.forwardKinematics(tree, data, posture)
        placed.append([M.homogeneous for M in data.oMi])
        origins.append([M[:3, 3] for M in placed[-1]])
    origins = np.array(origins)  # (N, 1 + n, 3)
    reach = origins[:, -1, :2] - origins[:, 0, :2]
    length = np.linalg.norm(reach, axis=1)
    shown = int(np.argsort(length)[LONG * len(length) // 100])
    view = np.array([[*reach[shown] / length[shown], 0.0], [0.0, 0.0, 1.0]])  # (2, 3)
    frames = placed[shown]
    outlines = [
        outline((points @ frames[body + 1][:3, :3].T + frames[body + 1][:3, 3]) @ view.T)
        for _, body, points in link_clouds(model)[0]
    ]
    joints = origins[shown] @ view.T
    every = np.vstack([*outlines, joints])
    low, high = every.min(axis=0), every.max(axis=0)
    scale = np.min((np.array([WIDTH, HEIGHT]) - 2 * MARGIN) / (high - low))  # [px/m]
    start = np.array([WIDTH, HEIGHT]) / 2 - scale * (low + high) / 2 * [1, -1]

    def path(points):
        return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in start + scale * points * [1, -1])

    links = "".join(f'<path d="{path(points)}Z"/>' for points in outlines)
    if not links:  # its meshes are not at hand
        links = f'<path d="{path(joints)}" fill="none" stroke-width="18" stroke-opacity=".2"/>'
    return (
        f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{model.name}" '
        f'fill="currentColor" stroke="currentColor" stroke-linejoin="round">'
        f'<g fill-opacity=".13" stroke-opacity=".45" stroke-width=".8">{links}</g>'
        f'<path d="{path(joints)}" fill="none" stroke-width="2.5" stroke-linecap="round"/></svg>'
    )


def outline(points):
    """Return the corners of the convex hull of points in a plane, shape (k, 2) [m]."""
    if np.linalg.matrix_rank(points - points[0], tol=FLAT) < 2:
        return points[[0, -1]]
    return points[ConvexHull(points).vertices]


def facts_of(found):
    """Return the figures of an entry, by name."""
    fitted, held_out = (
        ", ".join(evaluation.recording.name for evaluation in logs)
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
