"""Watching a robot: false alarms, delay until an alarm, and its cause, in histories of results.

Each history has 20 results of an arm with three joints. The estimates of a result have the mean and
the covariance of weighted least squares on the rows of its motion: the motions, the rows and the
covariance are those of robotid, the noise is drawn. Friction varies by 5 % between results. From
the eleventh result on: no change; friction of the elbow 40 % higher; friction that rises by 5 % per
result; a gain that is 10 % lower; a payload of 0.5 kg. The delay counts results from the change on.
With ROBOTID_DATA: the logs of the UR10e, a result for each, with viscous and Coulomb friction;
logs that determine too little for a result are named.

    ROBOTID_DATA=folder python benchmarks/bench_history.py [--quick]
"""

import argparse
import os
import tempfile
from dataclasses import replace
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np
from bench_runs import JOBS, UNLOADED, WITHIN, arm

from robotid.commands.identify import run_job
from robotid.commands.job import LogEntry, read_job
from robotid.exceptions import RobotIdError
from robotid.logs.data import Trajectory
from robotid.regressor.base_parameters import structural_mapping
from robotid.regressor.factors import compress
from robotid.regressor.torque import build_problem
from robotid.report.comparison import compare_results
from robotid.report.history import history_of
from robotid.robot.drives import DRIVE_TERMS
from robotid.simulation.motions import random_fourier

RESULTS, CHANGED, MOTIONS = 20, 10, 8
JOINT, FRICTION, RISE, GAIN, MASS = "elbow_joint", 0.4, 0.05, 0.9, 0.5
KINDS = {"none": "", "friction, step": "friction", "friction, rising": "friction",
         "gain": "gain", "payload": "payload"}  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="5 histories of each kind, no logs")
    options = parser.parse_args()
    simulated(5 if options.quick else 200)
    if not options.quick and "ROBOTID_DATA" in os.environ:
        recorded()


def motions(model, mapping, rng):
    """Return the information of each joint's rows on the base parameters, (motions, n, b, b)."""
    found = []
    for _ in range(MOTIONS):
        t = np.arange(720) / 60.0
        q, v, a = random_fourier(model, rng, period=12.0).evaluate(t)
        tau = np.zeros(q.shape)
        whole = Trajectory(t=t, q=q, v=v, a=a, tau=tau, joints=model.joints, rate=60.0,
                           segment=np.zeros(len(t), dtype=int))  # fmt: skip
        factors = compress(mapping.reduce(build_problem(model, whole)))
        H = np.zeros((len(model.joints), len(mapping.base_names), len(mapping.base_names)))
        for j, (R, own) in enumerate(zip(factors.triangles, factors.columns, strict=True)):
            H[j][np.ix_(own, own)] = R[:, :-1].T @ R[:, :-1]
        found.append(H)
    return np.array(found)


def history(model, mapping, pi, friction, H, kind, rng):
    """Return the base parameters of the results of a history as a comparison has them."""
    names, values, errors = model.layout.names, [], []
    own_friction = [names.index(f"{JOINT}.{term}") for term in ("viscous", "coulomb")]
    sigma = 0.05 * np.sqrt([x.trace() for x in H.mean(axis=0) @ np.diag(mapping.to_base(pi) ** 2)])
    sigma /= np.sqrt(720)  # [N m] about 5 % of each joint's torque
    for k in range(RESULTS):
        own, gain = pi.copy(), np.ones(len(model.joints))
        own[friction] *= 1 + WITHIN * rng.normal(size=len(friction))
        if k >= CHANGED and kind == "friction, step":
            own[own_friction] *= 1 + FRICTION
        if k >= CHANGED and kind == "friction, rising":
            own[own_friction] *= 1 + RISE * (k - CHANGED + 1)
        if k >= CHANGED and kind == "gain":
            gain[model.joints.index(JOINT)] = GAIN
        if k >= CHANGED and kind == "payload":
            own[10 * len(model.layout.bodies) - 10] += MASS
        rows = H[rng.integers(len(H))] / sigma[:, None, None] ** 2
        C = np.linalg.inv(rows.sum(axis=0))
        x = C @ np.einsum("j,jab,b->a", gain, rows, mapping.to_base(own))
        values.append(rng.multivariate_normal(x, C))
        errors.append(np.sqrt(np.diag(C)))
    return [
        {"name": name, "expression": text, "unit": "", "values": x, "std_errors": e}
        for name, text, x, e in zip(mapping.base_names, mapping.expressions,
                                    np.transpose(values).tolist(), np.transpose(errors).tolist(),
                                    strict=True)
    ]  # fmt: skip


def simulated(count):
    model, pi, friction = arm()
    mapping = structural_mapping(model)
    H = motions(model, mapping, np.random.default_rng(0))
    inputs = [{"role": "identification", "start": 0.0}]
    about = {
        "inputs": inputs,
        "drive_parameters": [{"name": name} for name in model.layout.drive_names],
        "standard_parameters": [
            {"name": name} for name in model.layout.names[: model.layout.n_inertial]
        ],
    }
    labels = [str(k) for k in range(RESULTS)]
    print("| change from result 11 on | histories | alarm before it, or none due | alarm | "
          "results until the alarm: median, 90 % | cause named | another |")  # fmt: skip
    print("|---|" + "---:|" * 6)
    for number, (kind, cause) in enumerate(KINDS.items()):
        false = named = wrong = 0
        delays = []
        for seed in range(count):
            rng = np.random.default_rng([number, seed])
            rows = history(model, mapping, pi, friction, H, kind, rng)
            alarms = history_of([about] * RESULTS, rows, labels)["findings"]
            early = [x for x in alarms if not cause or int(x["result"]) < CHANGED]
            late = [x for x in alarms if cause and int(x["result"]) >= CHANGED]
            false += bool(early)
            if late:
                delays.append(int(late[0]["result"]) - CHANGED + 1)
                where = "wrist_1_link" if cause == "payload" else JOINT
                is_named = (late[0]["kind"], late[0]["where"]) == (cause, where)
                named, wrong = named + is_named, wrong + (not is_named)
        shown = f"{np.median(delays):.0f}, {np.quantile(delays, 0.9):.0f}" if delays else "-"
        print(f"| {kind} | {count} | {false} | {len(delays)} | {shown} | {named} | {wrong} |",
              flush=True)  # fmt: skip


def recorded():
    """Print the alarms of the UR10e's logs, one result for each."""
    job = read_job(JOBS / "ur10e.toml")
    known = {entry.path.stem: entry for entry in (*job.identification, *job.validation)}
    folder = job.identification[0].path.parent
    names = [*UNLOADED, *(x.stem for x in folder.glob("*.parquet") if x.stem.endswith("load"))]
    used = []
    with tempfile.TemporaryDirectory() as where:
        for name in names:
            entry = known.get(name, LogEntry(folder / f"{name}.parquet"))
            own = replace(job, identification=(entry,), validation=(), report=False,
                          terms=DRIVE_TERMS)  # fmt: skip
            try:
                run_job(own, Path(where, name))
            except RobotIdError as error:
                print(f"- {name}: no result: {str(error)[:120]}")
            else:
                used.append(name)
        content = compare_results([Path(where, name, "result.json") for name in used])
    print(f"\nUR10e, {len(used)} results: {', '.join(used)}")
    print(f"{len(content['alarms'])} alarms")
    for each in content["findings"]:
        shown = ", ".join(each["parameters"])
        print(f"- {used[ord(each['result']) - 65]}: {each['message']} ({shown})")


if __name__ == "__main__":
    main()
