"""MuJoCo's inverse dynamics of an exported MJCF beside the prediction of the result.

Identifies each job of tests/jobs, saves, exports, and takes the difference over the rows of the
validation motions in which all joints move. "least" is the smallest difference that viscous
friction and Coulomb friction, neither below 0, and an offset in the place of the drive's own
friction can have, fitted to these very rows; the export's are fitted to the rows of the
identification, at their speeds.

    ROBOTID_DATA=folder python benchmarks/bench_exports.py [--quick]
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import mujoco
import numpy as np
import scipy.optimize
from setting import machine

from robotid.cli.export import export
from robotid.cli.identify import run_job
from robotid.cli.job import read_job
from robotid.output.files.result_file import load_result

JOBS = Path(__file__).parents[1] / "tests" / "jobs"
MOST = 3000  # rows


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one recording")
    options = parser.parse_args()
    if "ROBOTID_DATA" not in os.environ:
        sys.exit("set ROBOTID_DATA to the folder of the recordings")
    print("| job | joint | projected | error [% of the torque] | least [%] | ratio |")
    print("|---|---|---|---|---|---|")
    for name in ("ur10e",) if options.quick else sorted(p.stem for p in JOBS.glob("*.toml")):
        with tempfile.TemporaryDirectory() as folder:
            compare(name, Path(folder))
    print(f"\n{machine()}")


def compare(name, folder):
    run_job(read_job(JOBS / f"{name}.toml"), folder / "out")
    result = load_result(folder / "out")
    if "urdf" not in result.content["outputs"]:
        print(f"| {name} | - | no URDF: {result.verdict['status']} | - | - | - |")
        return
    projected = export(folder / "out", "mjcf", folder / "a.xml")["projected"]
    model, _ = result.identified
    q, v, a = validation_rows(name, model)
    predicted, exported = result.predict(q, v, a), inverse(folder / "a.xml", model, q, v, a)
    for j, joint in enumerate(model.joints):
        if joint not in projected:
            continue
        gap = predicted[:, j] - exported[:, j]
        A = np.column_stack([v[:, j], np.sign(v[:, j]), np.ones(len(v))])
        stated = [projected[joint].get(term, 0.0) for term in ("viscous", "coulomb", "offset")]
        bounds = ([0.0, 0.0, -np.inf], np.inf)
        best = scipy.optimize.lsq_linear(A, gap + A @ stated, bounds, method="bvls")
        size = np.linalg.norm(predicted[:, j])
        error, least = np.linalg.norm(gap) / size, np.sqrt(2.0 * best.cost) / size
        ratio = f"{error / least:.3f}" if error > 1e-6 else "-"
        terms = ", ".join(projected[joint]["replaced"])
        print(
            f"| {name} | {joint} | {terms} | {100 * error:.2f} | {100 * least:.2f} | {ratio} |",
            flush=True,
        )


def validation_rows(name, model):
    """Return q, v, a of the validation motions where all joints move, at most ``MOST`` rows."""
    from robotid.estimation.fitting.recorded import hold_log

    job = read_job(JOBS / f"{name}.toml")
    rows = [hold_log(model, job.read(e, model), job.signals).whole for e in job.validation]
    moving = [r.mask.all(axis=1) for r in rows]
    parts = [
        np.concatenate([getattr(r.trajectory, key)[m] for r, m in zip(rows, moving, strict=True)])
        for key in ("q", "v", "a")
    ]
    step = max(len(parts[0]) // MOST, 1)
    return [part[::step] for part in parts]


def inverse(path, model, q, v, a):
    """Return MuJoCo's torques of motion, its actuators' bias on the other side."""
    robot = mujoco.MjModel.from_xml_path(str(path))
    robot.opt.disableflags = mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, tau = mujoco.MjData(robot), np.empty_like(v)
    at = [robot.joint(joint).dofadr[0] for joint in model.joints]
    for k in range(len(v)):
        data.qpos[at], data.qvel[at], data.qacc[at] = q[k], v[k], a[k]
        mujoco.mj_inverse(robot, data)
        data.ctrl = 0.0
        mujoco.mj_fwdActuation(robot, data)
        tau[k] = (data.qfrc_inverse - data.qfrc_actuator)[at]
    return tau


if __name__ == "__main__":
    main()
