"""Prediction of a NEW motion: the consistent fit, which knows the URDF, against its own WLS.

Errors are in % of each joint's torque on a motion that was not fitted. Simulated: four robots,
plain Pinocchio with masses unlike the URDF's, and URDFs with the defects of public ones. Recorded,
if ROBOTID_DATA names the folder: other laboratories' logs, and the first tenth of each ("short"),
where the excitation is poor. "auto" is the default weight of the prior.

    ROBOTID_DATA=folder python benchmarks/bench_priors.py [--quick]
"""

import argparse
import os
import sys
import tempfile
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import numpy as np
import pinocchio as pin
from setting import machine

from robotid.base.exceptions import RobotIdError
from robotid.cli.identify import identify
from robotid.cli.job import read_job
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.simulation.motions import random_fourier
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.evaluation import pool
from robotid.robot.bodies import link_places
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

JOBS = Path(__file__).parents[1] / "tests" / "jobs"
DATA = os.environ.get("ROBOTID_DATA")
ROBOTS = {
    "UR5": ("ur5_robot.urdf", None),
    "Z1": ("z1.urdf", [f"joint{i}" for i in range(1, 7)]),
    "Mico": ("kinova.urdf", [f"j2s6s200_joint_{i}" for i in range(1, 7)]),
    "Panda": ("panda.urdf", [f"panda_joint{i}" for i in range(1, 8)]),
}
#: links that change, mass and moments of inertia of all of them; factors of masses and of lengths
INERTIALS = {
    "as they are": (slice(0, 0), None, 1.0, 1.0),
    "all missing": (slice(None), None, 1.0, 1.0),
    "two missing": (slice(1, None, 3), None, 1.0, 1.0),
    "all 1 g": (slice(None), (1e-3, 1e-6), 1.0, 1.0),
    "last link 7 g": (slice(-1, None), (7e-3, 6e-7), 1.0, 1.0),
    "last four 1 kg, 1 kg m^2": (slice(-4, None), (1.0, 1.0), 1.0, 1.0),
    "grams for kilograms": (slice(0, 0), None, 1e3, 1.0),
    "millimetres for metres": (slice(0, 0), None, 1.0, 1e3),
}
UNITS = ("mass", "origin", "inertia")
PLACEHOLDER = """<inertial><mass value="{0}"/>
<inertia ixx="{1}" iyy="{1}" izz="{1}" ixy="0" ixz="0" iyz="0"/></inertial>"""
WEIGHTS = (100.0, 1.0, 0.01, "evidence", "auto")
QUICK = {"UR5": ["as they are"], "Z1": ["all missing", "last link 7 g"]}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few cases and fits")
    options = parser.parse_args()
    urdfs(QUICK if options.quick else dict.fromkeys(ROBOTS, INERTIALS))
    motions(options.quick)
    print(f"\n{machine()}")


def urdfs(chosen):
    """Print the errors with URDFs whose inertials are missing, placeholders or of another unit."""
    print("| robot | inertials | WLS [%] | consistent [%] | over WLS | worst joint | verdict |")
    print("|---|---|---|---|---|---|---|")
    for name, kinds in chosen.items():
        file, joints = ROBOTS[name]
        path = example_urdf(file)
        model = RobotModel.from_urdf(path, joints=joints)
        logs = simulated(model, 20.0, 20.0, noise=0.01)
        for kind in kinds:
            with tempfile.TemporaryDirectory() as folder:
                changed = Path(folder) / path.name
                write_urdf(model, path, changed, *INERTIALS[kind])
                other = RobotModel.from_urdf(changed, joints=joints)
                try:
                    found = identify(other, logs[:1], validation=logs[1:])
                    wls, error = (error_per_joint(found, which) for which in ("wls", "estimate"))
                    figures = f"{row(wls)} | {row(error)} | {mean(error / wls):.2f}"
                    figures += f" | {max(error / wls):.2f} | {found.verdict.status}"
                except (RobotIdError, np.linalg.LinAlgError) as error:
                    figures = f"- | - | - | - | {type(error).__name__}"
            print(f"| {name} | {kind} | {figures} |", flush=True)


def write_urdf(model, path, target, which, body, mass, length):
    """Write a URDF whose bodies ``which`` have no inertial, or this mass and moment instead."""
    tree, names = ET.parse(path), model.layout.bodies
    moved = {place.link: names[place.body] for place in link_places(model) if place.body >= 0}
    for link in tree.iter("link"):
        for own in link.findall("inertial"):
            if moved.get(link.get("name")) in names[which]:
                link.remove(own)
                if body is not None and link.get("name") in names:
                    link.append(ET.fromstring(PLACEHOLDER.format(*body)))
            for tag, factor in zip(UNITS, (mass, length, mass * length**2), strict=True):
                for element in own.iter(tag):
                    for key in element.attrib.keys() - {"rpy"}:
                        numbers = [repr(float(x) * factor) for x in element.get(key).split()]
                        element.set(key, " ".join(numbers))
    tree.write(target)


def simulated(model, *durations, noise):
    """Return logs of a robot whose bodies are unlike the URDF's, by plain Pinocchio."""
    rng, plant = np.random.default_rng(0), model.pin_model.copy()
    for k in range(1, plant.njoints):
        J = plant.inertias[k].toPseudoInertia().toMatrix()
        A = np.eye(4)
        A[:3] += np.column_stack([0.07 * rng.uniform(-1, 1, (3, 3)), 0.01 * rng.uniform(-1, 1, 3)])
        J = np.exp(rng.uniform(-0.15, 0.15)) * A @ J @ A.T  # 1 cm, 15 % of the mass: consistent
        plant.inertias[k] = pin.Inertia.FromPseudoInertia(pin.PseudoInertia.FromMatrix(J))
    data, logs, size = plant.createData(), [], None
    for seconds in durations:
        t = np.arange(round(200.0 * seconds)) / 200.0
        q, v, a = random_fourier(model, rng, period=10.0).evaluate(t)
        rows = zip(model.configurations(q), v, a, strict=True)
        tau = np.array([pin.rnea(plant, data, *instant) for instant in rows])
        size = size if logs else np.std(tau, axis=0)
        tau += size * (
            0.01 * a + 0.1 * v + 0.05 * np.sign(v) + noise * rng.standard_normal(v.shape)
        )
        logs.append(Log(t=t, q=q, tau=tau, joints=model.joints))
    return logs


def motions(is_quick):
    """Print the errors on recorded and on short motions, by the weight of the prior."""
    print("\n| motion | WLS [%] | consistent [%] | weight | over WLS |\n|---|---|---|---|---|")
    weights = WEIGHTS[-1:] if is_quick else WEIGHTS
    ratios = {is_short: {weight: [] for weight in weights} for is_short in (False, True)}
    for title, model, signals, train, test in cases(is_quick):
        for weight in weights:
            settings = EstimatorSettings(prior_weight=weight)
            found = identify(model, train, validation=test, signals=signals, estimator=settings)
            wls, error = (error_per_joint(found, which) for which in ("wls", "estimate"))
            ratios["short" in title][weight].append(mean(error / wls))
        chosen, ratio = found.estimate.details["prior"]["weight"], mean(error / wls)
        print(f"| {title} | {row(wls)} | {row(error)} | {chosen:.3g} | {ratio:.2f} |", flush=True)
    print("\n| weight | long segments | worst | short segments | worst |\n|---|---|---|---|---|")
    for weight in weights:
        found = [ratios[is_short][weight] for is_short in (False, True)]
        cells = [f"{mean(x):.3f} | {max(x):.3f}" if x else "- | -" for x in found]
        print(f"| {weight} | {' | '.join(cells)} |")


def cases(quick):
    """Yield title, model, signal settings, logs to fit and logs of another motion."""
    model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"))
    logs = simulated(model, 20.0, 2.0, 20.0, noise=0.05)
    if not quick:
        yield "UR10 simulated, 20 s", model, SignalSettings(), logs[:1], logs[2:]
    yield "UR10 simulated, short: 2 s", model, SignalSettings(), logs[1:2], logs[2:]
    if DATA is None:
        return
    for name in ("kinova_gen3",) if quick else ("kinova_gen3", "tiago", "panda_inria"):
        job = read_job(JOBS / f"{name}.toml")
        model = job.model()
        fitted, kept = (
            [job.read(e, model) for e in x] for x in (job.identification, job.validation)
        )
        yield f"{name}, one segment -> the rest", model, job.signals, fitted[:1], kept
        yield short(name, model, job.signals, fitted[0], kept, 6 if name == "kinova_gen3" else 10)
    for name in () if quick else ("tx40", "ur10e"):
        job = read_job(JOBS / f"{name}.toml")
        model, entry = job.model(), job.identification[0]
        if name == "tx40":
            entry = replace(entry, start=None, end=None)
        log = job.read(entry, model)
        thirds = split(log, 3)
        for k in range(3):
            others = [third for i, third in enumerate(thirds) if i != k]
            yield f"{name}, third {k + 1} -> the others", model, job.signals, [thirds[k]], others
        yield short(name, model, job.signals, log, [thirds[2]])


def short(name, model, signals, log, kept, parts=10):
    """Return the case that fits the first part of a log only."""
    part = split(log, parts)[0]
    return f"{name}, short: the first {part.t[-1] - part.t[0]:.1f} s", model, signals, [part], kept


def split(log, parts):
    """Return parts of equal duration."""
    edges = np.linspace(log.t[0], log.t[-1], parts + 1)[1:-1]
    keys = [key for key in ("t", "q", "v", "a", "tau") if getattr(log, key) is not None]
    return [
        replace(log, **{key: getattr(log, key)[rows] for key in keys})
        for rows in np.split(np.arange(len(log.t)), np.searchsorted(log.t, edges))
    ]


def error_per_joint(found, name):
    measured = pool(found.model, found.validation, name).per_joint.values()
    return np.array([m.relative_error_pct for m in measured])


def mean(values):
    return float(np.exp(np.mean(np.log(values))))


def row(errors):
    return " / ".join(f"{error:.1f}" if error < 10 else f"{error:.0f}" for error in errors)


if __name__ == "__main__":
    main()
