"""FIGAROH and robotid on the same robot and log: time and memory from arrays to the estimate.

FIGAROH needs other packages than robotid, hence an environment of its own (about 1 GB):

    python -m venv figaroh_env && figaroh_env/bin/pip install figaroh
    python benchmarks/bench_figaroh.py --python figaroh_env/bin/python [--samples 10000 100000]

Each way runs in a fresh process: a first run of 200 samples spread over the log, then all of it;
imports are not counted. FIGAROH: its regressor, removal of silent columns, and double QR with the
estimate of the base parameters. robotid: base parameters, factors, weighted least squares with
the covariance.
The first ratio is of processor times. "memory" is how far the resident set grew in the second run
over what was held before it: Linux's peak is reset in between, so that no earlier stage hides it;
other systems cannot reset theirs and show "-". "difference" is the root mean square of what the
two predictions of the torque differ by, as a share of the torque.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

WAYS = {"FIGAROH": "figaroh", "plain": "plain", "compiled": "compiled"}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", default="figaroh_env/bin/python", metavar="PATH")
    parser.add_argument("--samples", type=int, nargs="+", default=[10_000, 100_000])
    parser.add_argument("--quick", action="store_true", help="500 samples; FIGAROH may be missing")
    parser.add_argument("--child", nargs=2, metavar=("WAY", "FILE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(child(*options.child)))
        return 0
    if not has_figaroh(options.python):
        print(
            f"{options.python} has no FIGAROH; make an environment with it: python -m venv "
            "figaroh_env && figaroh_env/bin/pip install figaroh"
        )
        return 0 if options.quick else 1
    print("| samples | way | wall, s | processor, s | ratio | memory, MiB | ratio | difference |")
    print("|" + "---|" * 8)
    for samples in [500] if options.quick else options.samples:
        print("\n".join(rows(options.python, samples)), flush=True)
    from setting import machine

    print(f"\npanda, friction, armature, offset; {machine()}")
    return 0


def has_figaroh(python):
    """Return whether an interpreter exists and can import FIGAROH."""
    try:
        run = subprocess.run([python, "-c", "import figaroh"], capture_output=True)
    except OSError:
        return False
    return run.returncode == 0


def rows(python, samples):
    """Return the lines of the table for one log."""
    results = compare(python, samples)
    theirs = results["FIGAROH"]
    lines = []
    for way, own in results.items():
        lines.append(
            f"| {samples:.0e} | {way} {own['version']} | {own['wall']:.3f} | {own['cpu']:.3f} "
            f"| {theirs['cpu'] / own['cpu']:.0f} | {memory_cells(own['memory'], theirs['memory'])} "
            f"| {own['difference']:.0e} |"
        )
    return lines


def memory_cells(own, theirs):
    """Return memory [MiB] and ratio, where they could be measured."""
    return "- | -" if own is None or theirs is None else f"{own:.0f} | {theirs / max(own, 1.0):.0f}"


def compare(python, samples):
    """Return wall-clock and processor time [s], memory [MiB] and version of each way."""
    from setting import motion, robot

    model = robot("panda")
    trajectory = motion(model, samples, np.random.default_rng(0))
    results, predicted = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        log, xml = Path(folder, "log.npz"), Path(folder, "model.xml")
        model.pin_model.saveToXML(str(xml), "model")
        arrays = {key: getattr(trajectory, key) for key in ("t", "q", "v", "a", "tau")}
        np.savez(log, configurations=model.configurations(trajectory.q), **arrays)
        for name, way in WAYS.items():
            interpreter = python if way == "figaroh" else sys.executable
            run = subprocess.run(
                [interpreter, __file__, "--child", way, str(log)],
                stdout=subprocess.PIPE, text=True, check=True,
            )  # fmt: skip
            results[name] = json.loads(run.stdout.splitlines()[-1])
            predicted[name] = np.load(f"{log}.{way}.npy")
    size = np.sqrt(np.mean(trajectory.tau**2))
    for name, own in results.items():
        gap = predicted[name] - predicted["FIGAROH"]
        own["difference"] = float(np.sqrt(np.mean(gap**2)) / size)
    return results


def child(way, path):
    """Return the figures of one way in this process; write the torque it predicts."""
    with np.load(path) as log:
        arrays = dict(log)
    run, predict, version = figaroh(path) if way == "figaroh" else robotid(way == "compiled")
    every = max(1, len(arrays["t"]) // 200)
    run({key: values[::every] for key, values in arrays.items()})
    can_reset, before = reset_peak(), resident("VmRSS")
    wall, cpu = time.perf_counter(), time.process_time()
    found = run(arrays)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    memory = resident("VmHWM") - before if can_reset else None
    np.save(f"{path}.{way}.npy", predict(found, {key: x[:500] for key, x in arrays.items()}))
    return {"wall": wall, "cpu": cpu, "memory": memory, "version": version}


def figaroh(path):
    """Return FIGAROH's identification, its prediction and its version."""
    from importlib.metadata import version
    from types import SimpleNamespace

    import pinocchio as pin
    from figaroh.tools.qrdecomposition import TOL_QR, QRDecomposer
    from figaroh.tools.regressor import (
        RegressorBuilder,
        RegressorConfig,
        build_regressor_reduced,
        get_index_eliminate,
    )

    model = pin.Model()
    model.loadFromXML(str(Path(path).with_name("model.xml")), "model")
    settings = RegressorConfig(has_friction=True, has_actuator_inertia=True, has_joint_offset=True)

    def regressor(arrays):
        robot = SimpleNamespace(model=model, data=model.createData())
        return RegressorBuilder(robot, settings).build_basic_regressor(
            arrays["configurations"], arrays["v"], arrays["a"], {"act_idxv": list(range(model.nv))}
        )

    def run(arrays):
        W = regressor(arrays)
        names = {str(k): 1.0 for k in range(W.shape[1])}
        eliminated, left = get_index_eliminate(W, names)
        tau = arrays["tau"].T.reshape(-1)  # FIGAROH's rows: joint after joint
        decomposer = QRDecomposer(tolerance=TOL_QR)
        W_e = build_regressor_reduced(W, eliminated)
        return eliminated, left, decomposer.double_decomposition(tau, W_e, left)

    def predict(found, arrays):
        # W_b = Q R: the torque is W_b times the estimate, both in the decomposition's order
        eliminated, left, (_, _, base_names, phi, *_) = found
        W = build_regressor_reduced(regressor(arrays), eliminated)
        leaders = [str(name).split(" ")[0] for name in base_names]
        columns = [list(left).index(leader) for leader in leaders]
        return (W[:, columns] @ phi).reshape(model.nv, -1).T

    return run, predict, version("figaroh")


def robotid(compiled):
    """Return robotid's identification, its prediction and its version."""
    from setting import identify, robot

    from robotid.base.versions import __version__
    from robotid.data.log import Trajectory
    from robotid.dynamics.base_parameters import structural_mapping
    from robotid.dynamics.torque import joint_torque_regressor

    model = robot("panda")

    def run(arrays):
        motion = {key: arrays[key] for key in ("t", "q", "v", "a", "tau")}
        segment = np.zeros(len(arrays["t"]), dtype=int)
        trajectory = Trajectory(joints=model.joints, rate=1000.0, segment=segment, **motion)
        return identify(model, trajectory, compiled, None)

    def predict(found, arrays):
        W = joint_torque_regressor(model, arrays["q"], arrays["v"], arrays["a"])
        columns = structural_mapping(model).independent
        return (W[:, columns] @ found.theta).reshape(-1, model.n_rows)

    return run, predict, __version__


def reset_peak():
    """Set the peak of this process's resident set to what it holds now; return whether it can."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def resident(which):
    """Return the resident set of this process, VmRSS, or its peak, VmHWM [MiB]; Linux only."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return float("nan")
    return next(int(line.split()[1]) for line in lines if line.startswith(which)) / 2**10


if __name__ == "__main__":
    sys.exit(main())
