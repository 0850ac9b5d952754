"""What the benchmarks of speed share: robots, motions, timing, the plain way to compare with."""

import os
import platform
import time
import tracemalloc
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np
import pinocchio as pin

from robotid.data.log import Trajectory
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import compress
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.torque import build_problem
from robotid.estimation.estimators import WLS
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

PLANAR = Path(__file__).parents[1] / "urdf" / "planar_2r.urdf"
ROBOTS = {
    "planar 2R": (PLANAR, {}),
    "UR10": ("ur10_robot.urdf", {}),
    "panda": ("panda.urdf", {"joints": [f"panda_joint{i}" for i in range(1, 8)]}),
    "TALOS": ("talos_full_v2.urdf", {}),
}
MORE_ROBOTS = {
    "Solo12": ("solo12.urdf", {}),
    "TIAGo": ("tiago_no_hand.urdf", {}),
    "TALOS reduced": ("talos_reduced.urdf", {}),
}


def robot(name, **options):
    path, own = (ROBOTS | MORE_ROBOTS)[name]
    return RobotModel.from_urdf(
        path if isinstance(path, Path) else example_urdf(path), **own, **options
    )


def motion(model, samples, rng):
    """Return a smooth motion with the torques of random parameters and noise of 1 %."""
    t = np.arange(samples) * max(1e-3, 20.0 / samples)  # [s], at least one period
    q, v, a = random_fourier(model, rng, period=20.0).evaluate(t)
    tau = np.empty(v.shape)
    data, pin_model = model.pin_model.createData(), model.pin_model
    for k, (configuration, v_k, a_k) in enumerate(zip(model.configurations(q), v, a, strict=True)):
        tau[k] = pin.rnea(pin_model, data, configuration, v_k, a_k) + np.sign(v_k) + v_k
    tau += 0.01 * np.std(tau, axis=0) * rng.standard_normal(tau.shape)
    segment = np.zeros(samples, dtype=int)
    return Trajectory(
        t=t, q=q, v=v, a=a, tau=tau, joints=model.joints, rate=1000.0, segment=segment
    )


def bare_loop(model, trajectory, W):
    """Compute W with Pinocchio's function and nothing else, over and over into (k, nv, c)."""
    pin_model, data = model.pin_model, model.pin_model.createData()
    q, v, a = model.configurations(trajectory.q), trajectory.v, trajectory.a
    for start in range(0, len(q), len(W)):
        for k in range(min(len(W), len(q) - start)):
            i = start + k
            W[k] = pin.computeJointTorqueRegressor(pin_model, data, q[i], v[i], a[i])


def exhaust(blocks):
    for _ in blocks:
        pass


def rows_of(problem):
    """Yield the rows joint by joint, as the factors take them."""
    for source in problem.sources:
        yield from source.blocks(0, source.samples)


def identify(model, trajectory, compiled, threads):
    """Return the estimate of all base parameters by weighted least squares."""
    problem = structural_mapping(model).reduce(build_problem(model, trajectory, compiled=compiled))
    return WLS().fit(compress(problem, threads=threads))


def full_qr(model, mapping, trajectory):
    """Return estimate and covariance by the QR of the whole of W_b, all stacked: the plain way."""
    pin_model, data = model.pin_model, model.pin_model.createData()
    q, v, a = model.configurations(trajectory.q), trajectory.v, trajectory.a
    W = np.vstack(
        [pin.computeJointTorqueRegressor(pin_model, data, *x) for x in zip(q, v, a, strict=True)]
    )
    terms = {"armature": a, "viscous": v, "coulomb": np.sign(v), "offset": np.ones_like(v)}
    drives = [
        np.eye(v.shape[1])[j] * terms[term][:, [j]]
        for j in range(v.shape[1])
        for term in model.layout.terms
    ]
    columns = [W, *(drive.reshape(-1, 1) for drive in drives)]
    W_b = np.hstack(columns)[:, mapping.independent]
    R = np.linalg.qr(np.column_stack([W_b, trajectory.tau.reshape(-1)]), mode="r")
    inverse = np.linalg.inv(R[:-1, :-1])
    variance = R[-1, -1] ** 2 / (len(W_b) - W_b.shape[1])
    return inverse @ R[:-1, -1], variance * inverse @ inverse.T


def side_by_side(functions, repeats, clock=time.process_time):
    """Return the shortest time of each function [s], run in turn so that all meet the same load."""
    best = [np.inf] * len(functions)
    for _ in range(repeats):
        for k, function in enumerate(functions):
            start = clock()
            function()
            best[k] = min(best[k], clock() - start)
    return best


def peak_memory(function):
    """Return the largest amount of memory that Python and NumPy hold over that before [MiB]."""
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    function()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return (peak - before) / 2**20


def machine():
    """Return versions, cores, threads and mean load of the last 15 minutes in one line."""
    parts = [f"Python {platform.python_version()}"]
    for name in ("pin", "numpy", "scipy", "numba"):
        try:
            parts.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            parts.append(f"no {name}")
    return (
        ", ".join(parts) + f", {platform.machine()}, {os.cpu_count()} cores, "
        f"BLAS threads {os.environ['OPENBLAS_NUM_THREADS']}, load {os.getloadavg()[2]:.1f}"
    )
