"""Recursive estimators: time per step beside plain numpy on Pinocchio, long sweeps, accuracy.

    python benchmarks/bench_recursive.py [--quick]

One BLAS thread, fixed seed. A step is the whole of it: regressor of one instant, then the update.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import platform
import time

import numpy as np
import pinocchio as pin
import scipy

import robotid
from robotid.data.log import Trajectory
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import Problem, Sample
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulator import another_robot
from robotid.dynamics.torque import (
    InstantRegressor,
    build_problem,
    joint_torque_regressor,
)
from robotid.estimation.estimators import PRX, RLS, Kalman, NormalisedGradient, fold
from robotid.estimation.estimators.recursive import column_scale
from robotid.identification.online import OnlineIdentifier
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

ARM = [f"panda_joint{i}" for i in range(1, 8)]
TARGETS = {"RLS": 37.0, "Kalman": 70.0, "PRX": 21.0}  # [us] on the machine they were stated for


class Bench:
    """A panda with friction on a Fourier motion, and its base parameters."""

    def __init__(self, samples, terms=("viscous", "coulomb", "offset")):
        rng = np.random.default_rng(0)
        self.model = RobotModel.from_urdf(example_urdf("panda.urdf"), joints=ARM, terms=terms)
        self.mapping = structural_mapping(self.model)
        pi = another_robot(self.model, rng)
        self.beta = self.mapping.to_base(pi)
        self.start = self.mapping.to_base(self.model.standard_parameters())
        self.t = np.arange(samples) / 200.0
        self.q, self.v, self.a = random_fourier(self.model, rng, period=20.0).evaluate(self.t)
        parts = np.array_split(np.arange(samples), max(1, samples // 1000))
        tau = np.concatenate(
            [
                joint_torque_regressor(self.model, self.q[k], self.v[k], self.a[k]) @ pi
                for k in parts
            ]
        ).reshape(samples, -1)
        self.tau = tau + 0.1 * rng.standard_normal(tau.shape)
        self.sigma = np.full(7, 0.1)
        self.c, self.n = len(self.beta), 7

    def motion(self, part):
        return self.q[part], self.v[part], self.a[part]

    def problem(self):
        segment = np.zeros(len(self.t), dtype=int)
        trajectory = Trajectory(
            self.t, self.q, self.v, self.a, self.tau, self.model.joints, 200.0, segment
        )
        return self.mapping.reduce(build_problem(self.model, trajectory))


def timed(step, samples):
    """Return median and 99th percentile of the processor time per step [us]."""
    times = np.empty(samples)
    for k in range(samples):
        start = time.thread_time_ns()
        step(k)
        times[k] = time.thread_time_ns() - start
    warm = times[samples // 10 :] / 1e3
    return np.median(warm), np.percentile(warm, 99)


def ours(bench, estimator):
    columns, weight = bench.mapping.independent, np.ones(bench.n)
    regressor, state = InstantRegressor(bench.model, columns), [estimator.init(bench.c)]

    def step(k):
        Y = regressor(bench.q[k], bench.v[k], bench.a[k])
        state[0] = estimator.update(state[0], Sample(Y, bench.tau[k], weight))

    return step


def plain(bench, update):
    """Return a step of plain numpy on Pinocchio: no checks, nothing kept from before."""
    model, data = bench.model.pin_model, bench.model.pin_model.createData()
    layout, columns = bench.model.layout, bench.mapping.independent
    size, terms = layout.n_inertial, len(layout.terms)
    Y = np.zeros((bench.n, len(layout.names)))
    rows = np.arange(bench.n)

    def step(k):
        q, v, a = bench.q[k], bench.v[k], bench.a[k]
        Y[:, :size] = pin.computeJointTorqueRegressor(model, data, q, v, a)
        Y[rows, size + terms * rows] = v
        Y[rows, size + terms * rows + 1] = np.sign(v)
        Y[rows, size + terms * rows + 2] = 1.0
        update(Y[:, columns], bench.tau[k], q, model, data)

    return step


def plain_rls(bench):
    theta, P = np.zeros(bench.c), 1e4 * np.eye(bench.c)
    R = np.diag(bench.sigma**2)

    def update(Y, tau, *_):
        nonlocal theta, P
        PY = P @ Y.T
        K = np.linalg.solve(Y @ PY + R, PY.T).T
        theta = theta + K @ (tau - Y @ theta)
        P = P - K @ PY.T
        P = (P + P.T) / 2

    return update


def plain_kalman(bench):
    theta, P = np.zeros(bench.c), 1e4 * np.eye(bench.c)
    R, one, Q = np.diag(bench.sigma**2), np.eye(bench.c), 1e-10 * np.eye(bench.c)

    def update(Y, tau, *_):
        nonlocal theta, P
        P = P + Q
        PY = P @ Y.T
        K = np.linalg.solve(Y @ PY + R, PY.T).T
        theta = theta + K @ (tau - Y @ theta)
        A = one - K @ Y
        P = A @ P @ A.T + K @ R @ K.T

    return update


def plain_prx(bench):
    theta = bench.start.copy()

    def update(Y, tau, q, model, data):
        nonlocal theta
        e = Y @ theta - tau
        M = pin.crba(model, data, q)
        D = np.triu(M) + np.triu(M, 1).T
        eta = np.linalg.solve(D, e)
        theta = theta - np.linalg.eigvalsh(D)[0] / np.vdot(Y, Y) * (eta @ Y)

    return update


def steps(samples):
    bench = Bench(samples)
    std = 10 + np.abs(bench.beta)
    scale = column_scale(bench.problem(), bench.sigma)
    prior = {"prior": bench.start, "prior_std": std}
    reference = {
        "RLS": timed(plain(bench, plain_rls(bench)), samples),
        "Kalman": timed(plain(bench, plain_kalman(bench)), samples),
        "PRX": timed(plain(bench, plain_prx(bench)), samples),
    }
    regressor = InstantRegressor(bench.model, bench.mapping.independent)
    prx = {"prior": bench.start, "scale": scale}
    cases = {
        "regressor alone": (lambda k: regressor(bench.q[k], bench.v[k], bench.a[k]), None),
        "RLS": (ours(bench, RLS(bench.sigma)), "RLS"),
        "RLS, forgetting 0.999": (ours(bench, RLS(bench.sigma, 0.999, **prior)), "RLS"),
        "Kalman, walk and gate": (ours(bench, Kalman(bench.sigma, **prior, walk=1e-6)), "Kalman"),
        "PRX exact": (ours(bench, PRX(bench.sigma, average=False, **prx)), "PRX"),
        "PRX exact, averaged": (ours(bench, PRX(bench.sigma, **prx)), "PRX"),
        "normalised gradient": (ours(bench, NormalisedGradient(bench.sigma, **prx)), None),
    }
    identifier = OnlineIdentifier(bench.model)
    cases["online update(t, q, tau)"] = (
        lambda k: identifier.update(bench.t[k], bench.q[k], bench.tau[k]),
        None,
    )
    print(f"\n7 joints with friction, {bench.c} base parameters, {samples} steps: us per step, CPU")
    print(f"{'':26} {'median':>8} {'99 %':>8} {'plain':>8} {'99 %':>8} {'ratio':>6} {'target':>7}")
    for name, (step, kind) in cases.items():
        median, high = timed(step, samples)
        line = f"{name:26} {median:8.1f} {high:8.1f}"
        if kind:
            there, there_high = reference[kind]
            line += f" {there:8.1f} {there_high:8.1f} {median / there:6.2f} {TARGETS[kind]:7.0f}"
        print(line)


def sweep(samples):
    bench = Bench(samples)
    problem = bench.problem()
    std = 10 + np.abs(bench.beta)
    scale = column_scale(problem, bench.sigma)
    cases = {
        "RLS": RLS(bench.sigma),
        "RLS, forgetting 0.9999": RLS(bench.sigma, 0.9999, bench.start, std),
        "Kalman": Kalman(bench.sigma, bench.start, std, walk=1e-7),
        "PRX exact, averaged": PRX(bench.sigma, bench.start, scale),
        "normalised gradient": NormalisedGradient(bench.sigma, bench.start, scale),
    }
    print(f"\n{samples} samples swept offline, regressors included")
    for name, estimator in cases.items():
        start = time.perf_counter()
        state = fold(estimator, problem.samples(), estimator.init(bench.c))
        seconds = time.perf_counter() - start
        theta = estimator.estimate(state, problem.names).theta
        miss = np.linalg.norm(theta - bench.beta) / np.linalg.norm(bench.beta)
        print(f"{name:26} {seconds:7.2f} s  {1e6 * seconds / samples:6.1f} us   error {miss:.1e}")


def exact_steps():
    """PRX on noise-free UR10 data: independent states, and a smooth motion."""
    print("\nPRX on a UR10, 1000 noise-free samples, start at 1.3 x truth: relative error")
    print(f"{'':42} {'1 pass':>8} {'2':>8} {'5':>8}")
    for terms, label in (
        ((), "inertial"),
        (("armature", "viscous", "coulomb", "offset"), "drives"),
    ):
        model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"), terms=terms)
        mapping = structural_mapping(model)
        beta = mapping.to_base(another_robot(model, np.random.default_rng(0)))
        for kind in ("random states", "20 s Fourier motion"):
            rng = np.random.default_rng(0)
            motion = random_fourier(model, rng, period=20.0)
            q, v, a = (
                motion.evaluate(np.arange(1000) / 50.0)
                if "Fourier" in kind
                else rng.uniform(-1, 1, (3, 1000, 6)) * np.array([np.pi, 2, 5])[:, None, None]
            )
            columns = mapping.independent
            W = joint_torque_regressor(model, q, v, a)[:, columns]
            block = (W, W @ beta, np.ones(len(W)))
            problem = problem_of(block, mapping, model)
            misses = []
            for passes in (1, 2, 5):
                order = np.random.default_rng(0)
                estimator = PRX(np.ones(6), 1.3 * beta, average=False, passes=passes, rng=order)
                theta = estimator.fit(problem).theta
                misses.append(np.linalg.norm(theta - beta) / np.linalg.norm(beta))
            name = f"{label}, {kind}"
            print(f"{name:42} " + " ".join(f"{miss:8.1e}" for miss in misses))


def problem_of(block, mapping, model):
    support = model.support[:, mapping.independent]
    return Problem(lambda: iter([block]), mapping.base_names, 6, support)


def payload():
    """A simulated panda picks up 2 kg at t = 10 s."""
    print("\npanda, 2 kg picked up at 10 s, 2 % torque noise: flagged, onset, mass at 15 s")
    for seed in range(5):
        rng = np.random.default_rng(seed)
        model = RobotModel.from_urdf(example_urdf("panda.urdf"), joints=ARM)
        pi = another_robot(model, np.random.default_rng(0))
        loaded, size = pi.copy(), model.layout.n_inertial
        loaded[size - 10 : size] += [2, 0, 0, 0.2, 0.022, 0, 0.022, 0, 0, 0.002]
        t = np.arange(3001) / 200.0
        q, v, a = random_fourier(model, rng, period=10.0).evaluate(t)
        W = joint_torque_regressor(model, q, v, a).reshape(len(t), 7, -1)
        tau = np.where((t >= 10.0)[:, None], W @ loaded, W @ pi)
        tau += 0.02 * np.sqrt(np.mean(tau**2, axis=0)) * rng.standard_normal(tau.shape)
        q = q + 2e-5 * rng.standard_normal(q.shape)
        identifier = OnlineIdentifier(model)
        for k in range(len(t)):
            identifier.update(t[k], q[k], tau[k])
        if not identifier.changes:
            print(f"seed {seed}: not flagged")
            continue
        change, load = identifier.changes[0], identifier.payload(0)
        print(
            f"seed {seed}: {change.flagged:.2f} s, {change.onset:.2f} s, "
            f"{load.mass:.3f} +- {load.mass_std_error:.3f} kg; {len(identifier.changes)} change(s)"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="for CI: fewer steps")
    quick = parser.parse_args().quick
    print(
        f"robotid {robotid.__version__}, Python {platform.python_version()}, numpy "
        f"{np.__version__}, scipy {scipy.__version__}, pin {pin.__version__}; "
        f"{platform.machine()}, {os.cpu_count()} processors, 1 BLAS thread, seed 0"
    )
    steps(1000 if quick else 5000)
    sweep(2000 if quick else 100_000)
    exact_steps()
    payload()


if __name__ == "__main__":
    main()
