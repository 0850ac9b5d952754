"""Legged robots with unknown contact forces: intervals, prediction, time.

    python benchmarks/bench_legged.py [--runs 20] [--robots go1 g1 talos cassie] [--unseen]
    python benchmarks/bench_legged.py --faults [--robots go1 g1 talos icub]
    python benchmarks/bench_legged.py --robots icub --seconds 15

A Go1 stands on point feet in MuJoCo at 0.1 ms with held torques, 18-bit encoders and 0.05 N m of
torque noise; its joints follow multi-sines, its feet slip and lift at times. G1 and TALOS step in
place on flat feet without support. Cassie with its rods and springs hangs on a gantry whose wrench
is measured, its feet touch the ground. They are identified by weighted least squares, Cassie with
a prior, since not all of its links are excited. Counted is how often the 95 % interval of an
inertial base parameter holds the truth. Beside it the regressor's projected rows are timed against
those of an arm. With the recordings, a Solo12 that trots in PyBullet is identified from the first
half of its log: its URDF is the truth. With --unseen: joint torque of the last 30 % of a recording,
fitted on the others.
Without torques of joints: an iCub that walks on the spot, of whose feet the vertical forces are
measured.
With --faults: how many logs with a wrong pose of the base the doctor names.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import os
import sys
import time
from pathlib import Path
from dataclasses import replace
from tempfile import TemporaryDirectory

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import cassie
from hanging_cassie import hanging
from helpers.legged import recorded, with_other_bodies
from helpers.paths import JOBS
from walkers import G1, ICUB, TALOS, forces, planned

from robotid.base.exceptions import NotConvergedError, RankDeficientError
from robotid.cli.identify import identify, run_job
from robotid.cli.job import read_job
from robotid.data.base_motion import BaseMotion
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.base_checks import examine_base
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import compress
from robotid.dynamics.prepared_logs import base_problem
from robotid.estimation.fitting.estimator_settings import ConsistentSettings
from robotid.estimation.fitting.recorded import hold_log
from robotid.robot.constraints import Contact
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
POSTURE = {"hip": (0.0, 0.12), "thigh": (0.8, 0.25), "calf": (-1.6, 0.3)}  # middle, reach [rad]
SIGNALS = SignalSettings(cutoff=25.0, velocity="differentiated")
ARMATURE, DAMPING = 0.01, 0.2
PRIOR = ConsistentSettings(prior_weight=1.0)
AUTO_PRIOR = ConsistentSettings()
WEAK_PRIOR = ConsistentSettings(prior_weight=1e-4)


def robot():
    return RobotModel.from_urdf(
        example_urdf("go1.urdf"), free_flyer=True, terms=("armature", "viscous"),
        constraints=[Contact(foot) for foot in FEET],
    )  # fmt: skip


class Go1:
    def __init__(self, estimator="wls", share=1.0):
        self.estimator, self.share, self.model = estimator, share, robot()

    def log(self, model, rng, duration, **options):
        middle, reach = np.array([POSTURE[joint.split("_")[1]] for joint in model.joints]).T
        return recorded(
            model, FEET, middle, self.share * reach, rng, duration=duration, kp=100.0, kd=2.0,
            highest=1.5, torque=0.05, armature=ARMATURE, damping=DAMPING, **options,
        )  # fmt: skip

    def truth(self, model):
        pi, names = model.standard_parameters(), model.layout.names
        return pi + [
            ARMATURE * x.endswith(".armature") + DAMPING * x.endswith(".viscous") for x in names
        ]


class Walker:
    """G1 or TALOS; see ``walkers``."""

    estimator = "wls"

    def __init__(self, biped):
        self.model, self.log, self.truth = biped.model, biped.log, biped.truth


class Cassie:
    """Cassie on a gantry with a measured wrench; many of its small links are not excited."""

    estimator = PRIOR

    def __init__(self):
        with TemporaryDirectory() as folder:
            self.model = cassie.cassie(Path(folder))
        self.log, self.truth = hanging, cassie.truth


class Icub:
    """An iCub that steps on the spot, with vertical forces of its feet only."""

    estimator, signals = AUTO_PRIOR, SignalSettings(cutoff=4.0)

    def __init__(self):
        still = ("wrist", "hand", "thumb", "index", "middle", "pinkie", "eye", "neck_yaw")
        contacts = [Contact(foot, measured=("fz",), threshold=10.0) for foot in ICUB.feet]
        every = RobotModel.from_urdf(example_urdf(ICUB.urdf), free_flyer=True).joints
        self.model = RobotModel.from_urdf(
            example_urdf(ICUB.urdf), free_flyer=True, terms=(), constraints=contacts,
            joints=[x for x in every if not any(part in x for part in still)],
        )  # fmt: skip

    def log(self, model, rng, duration):
        """Return the log; the vertical forces are those of the centre of pressure."""
        _, times, places, _, lifts = planned(ICUB, model, rng, duration)
        at, t = CubicSpline(times, places), np.arange(0.0, duration, 0.01)

        def q_at(t):
            q = at(t)
            q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
            return q

        total, feet = forces(model.pin_model, q_at, t, ICUB.feet)
        pressure = np.column_stack([-total[:, 4], total[:, 3]]) / total[:, 2:3]
        soles = np.array([[place.translation[:2] for place in row] for row in feet])
        line = soles[:, 0] - soles[:, 1]
        left = np.sum((pressure - soles[:, 1]) * line, axis=1) / np.sum(line**2, axis=1)
        up = np.array([np.interp(t, times, lift) > 1e-9 for lift in lifts])
        left = np.where(up[0], 0.0, np.where(up[1], 1.0, left.clip(0.0, 1.0)))
        q = q_at(t)
        for row, turn in zip(q[:, 3:7], 1e-3 * rng.standard_normal((len(t), 3)), strict=True):
            row[:] = (pin.Quaternion(row) * pin.Quaternion(pin.exp3(turn))).coeffs()
        q[:, :3] += 5e-4 * rng.standard_normal((len(t), 3))
        q[:, 7:] += 1e-3 * rng.standard_normal((len(t), q.shape[1] - 7))
        vertical = np.stack([left, 1.0 - left]) * total[:, 2] + rng.standard_normal((2, len(t)))
        own = {f"fz {foot}": f for foot, f in zip(ICUB.feet, vertical, strict=True)}
        flags = {foot: f > 10.0 for foot, f in zip(ICUB.feet, vertical, strict=True)}
        return Log(
            t, q[:, 7:], np.zeros_like(q[:, 7:]), model.joints, has_torque=False,
            base=BaseMotion(q[:, :7]), wrenches=own, contacts=flags,
        )  # fmt: skip

    def truth(self, model):
        return model.standard_parameters()


PLANTS = {
    "go1": Go1, "go1_consistent": lambda: Go1("consistent"),
    "go1_still": lambda: Go1("consistent", 0.3),
    "g1": lambda: Walker(G1), "talos": lambda: Walker(TALOS), "cassie": Cassie,
    "icub": Icub,
}  # fmt: skip
WITH_TORQUES = [name for name in PLANTS if name != "icub"]

COVERAGE = (
    "| robot | joints | runs | coverage of base parameters | of masses | total mass | true |\n"
    + "|---" * 7 + "|"
)  # fmt: skip
UNSEEN = (
    "| robot | run | fit | joint torque error | URDF | with fitted drives | least squares | "
    "trunk's mass / true | its Ixx / true |\n" + "|---" * 9 + "|"
)


def of_urdf(seed):
    """Return the source of a URDF's differences."""
    return np.random.default_rng([seed, 1])


def coverage(name, seeds, duration):
    plant = PLANTS[name]()
    model = plant.model
    truth, n = plant.truth(model), model.layout.n_inertial
    shares, of_masses, totals = [], [], []
    signals = getattr(plant, "signals", SIGNALS)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        log = plant.log(model, rng, duration)
        other, start = with_other_bodies(model, of_urdf(seed)), time.process_time()
        try:
            found = identify(
                other, log, signals=signals, estimator=plant.estimator, friction="none",
                doctor=False,
            )  # fmt: skip
        except (RankDeficientError, NotConvergedError) as error:
            print(f"{seed:4} {str(error)[:60]}", file=sys.stderr)
            continue
        spent = time.process_time() - start
        is_body = (found.mapping.independent < n) & (found.base_error > 0.0)  # not negligible links
        z = (found.base - found.mapping.K @ truth)[is_body] / found.base_error[is_body]
        masses = slice(0, n, 10)
        mass, error = found.standard[masses].sum(), found.standard_covariance[masses, masses].sum()
        low, high = found.standard_interval[masses].T
        own = truth[masses]
        is_free = high - low > 1e-6 * own.sum()  # links of negligible mass keep the URDF's
        of_masses.append(np.mean(((low <= own) & (own <= high))[is_free]))
        shares.append(100 * np.mean(np.abs(z) < found.errors.quantile[is_body]))
        totals.append(mass)
        print(
            f"{name} {seed}: {shares[-1]:.0f} % of {len(z)}, RMS z {np.sqrt(np.mean(z**2)):.2f}, "
            f"total mass {(mass - own.sum()) / np.sqrt(error):.2f} std. errors off, {spent:.1f} s",
            file=sys.stderr,
        )
    if shares:
        print(
            f"| {name} | {len(model.joints)} | {len(shares)} "
            f"| {np.mean(shares):.1f} % ({min(shares):.0f} to {max(shares):.0f} %) "
            f"| {100 * np.mean(of_masses):.1f} % | {min(totals):.2f} to {max(totals):.2f} kg "
            f"| {truth[:n:10].sum():.2f} kg |",
            flush=True,
        )


def trot():
    """Print the masses of a Solo12 by the defaults, beside the truth."""
    job = replace(read_job(JOBS / "legged" / "solo12.toml"), report=False)
    start = time.process_time()
    with TemporaryDirectory() as folder:
        found, _ = run_job(job, folder)
    spent = time.process_time() - start
    truth = found.model.standard_parameters()
    z, wide = (found.base - found.mapping.K @ truth) / found.base_error, found.errors.quantile
    (validation,) = found.validation
    used, tau = validation.recording.mask, validation.recording.trajectory.tau
    left = (tau - validation.torques["estimate"])[used]
    print(
        f"Solo12: {100 * np.linalg.norm(left) / np.linalg.norm(tau[used]):.2f} % of the projected "
        f"torque of the second half, {100 * np.mean(np.abs(z) < wide):.0f}% covered of {len(z)}, "
        f"weight {found.estimate.details['prior']['weight']:g}, {spent:.1f} s"
    )
    error = np.sqrt(np.diag(found.standard_covariance))
    for i, body in enumerate(found.model.layout.bodies):
        own = 10 * i
        print(
            f"  {body:14} {found.standard[own]:.3f} +- {error[own]:.3f} kg, {truth[own]:.3f} true"
        )


def unseen(name, seed, duration):
    """Print errors on unseen motion, and the trunk, of fits with and without a prior."""
    plant = PLANTS[name]()
    model, rng = plant.model, np.random.default_rng(seed)
    log, n = plant.log(model, rng, duration), model.layout.n_inertial
    other = with_other_bodies(model, of_urdf(seed))
    fitted, rest = log.window(end=0.7 * duration), log.window(0.7 * duration)
    truth = plant.truth(model)[:n]
    for label, settings in (
        ("wls", "wls"), ("weak prior", WEAK_PRIOR), ("consistent", PRIOR)
    ):  # fmt: skip
        try:
            found = identify(
                other, fitted, validation=rest, signals=SIGNALS, estimator=settings,
                friction="none", doctor=False,
            )  # fmt: skip
        except (RankDeficientError, NotConvergedError) as error:
            print(f"{name} {seed}, {label}: {str(error)[:50]}", file=sys.stderr)
            continue
        (own,) = found.validation
        first = model.n_rows - len(model.joints)
        used, tau = own.recording.mask[:, first:], own.recording.trajectory.tau[:, first:]
        errors = {
            key: 100 * np.linalg.norm((tau - torque[:, first:])[used]) / np.linalg.norm(tau[used])
            for key, torque in own.torques.items()
        }
        trunk = found.standard[[0, 4]] / truth[[0, 4]]
        print(
            f"| {name} | {seed} | {label} | {errors['estimate']:.2f} % | {errors['urdf']:.1f} % "
            f"| {errors['urdf_with_drives']:.1f} % | {errors['wls']:.2f} % | {trunk[0]:.2f} "
            f"| {trunk[1]:.2f} |",
            flush=True,
        )


Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
QUARTER, BACK = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), [-1, -1, -1, 1]
#: Poses x y z qx qy qz qw (N, 7) as another tool or a wrong reading has them.
POSES = {
    "none": lambda x: x,
    "qw qx qy qz": lambda x: np.hstack([x[:, :3], np.roll(x[:, 3:], 1, axis=1)]),
    "inverse quaternion": lambda x: np.hstack([x[:, :3], x[:, 3:] * BACK]),
    "y up": lambda x: posed(x, Y_UP, lambda R: Y_UP @ R),
    "y up, base too": lambda x: posed(x, Y_UP, lambda R: Y_UP @ R @ Y_UP.T),
    "y up, position only": lambda x: posed(x, Y_UP, lambda R: R),
    "base turned by 90 deg": lambda x: posed(x, np.eye(3), lambda R: R @ QUARTER),
    "y reversed": lambda x: posed(x, np.diag([1.0, -1.0, 1.0]), lambda R: R),
}


def posed(pose, place, turn):
    """Return a pose whose position has other axes, and whose rotation matrices are changed."""
    own = [pin.Quaternion(turn(pin.Quaternion(x).matrix())).coeffs() for x in pose[:, 3:]]
    return np.hstack([pose[:, :3] @ place.T, np.array(own)])


def faults(name, seeds, duration):
    """Print how many logs with a wrong pose the doctor names."""
    plant, counts = PLANTS[name](), {}
    signals = getattr(plant, "signals", SIGNALS)
    for seed in seeds:
        log = plant.log(plant.model, np.random.default_rng(seed), duration)
        other = with_other_bodies(plant.model, of_urdf(seed))
        for label, change in POSES.items():
            wrong = replace(log, base=replace(log.base, pose=change(log.base.pose)))
            findings, _ = examine_base(other, wrong, signals)
            codes = [x.code for x in findings if x.severity == "error"]
            counts.setdefault(label, []).append("base_orientation" in codes)
    for label, own in counts.items():
        print(f"{name}, {label}: {sum(own)} of {len(own)} named", flush=True)


def speed(duration):
    model = robot()
    log = Go1().log(model, np.random.default_rng(0), duration)
    rows = hold_log(model, log, SIGNALS).whole
    legged = base_problem(model, structural_mapping(model), rows.trajectory, rows.mask)
    arm = setting.robot("panda")
    motion = setting.motion(arm, 20_000, np.random.default_rng(0))
    mapping = structural_mapping(arm)
    armed = base_problem(arm, mapping, motion, np.ones(motion.tau.shape))
    for name, problem, count in (
        ("Go1, projected", legged, rows.mask.sum()),
        ("panda", armed, motion.tau.size),
    ):
        compress(problem, threads=1)
        start = time.process_time()
        compress(problem, threads=1)
        spent = time.process_time() - start
        print(f"{name:16} {count / spent / 1e3:8.0f} thousand rows/s, {len(problem.names)} columns")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each recording")
    parser.add_argument("--robots", nargs="+", choices=PLANTS, default=WITH_TORQUES)
    parser.add_argument("--unseen", action="store_true", help="only errors on unseen motion")
    parser.add_argument("--faults", action="store_true", help="only wrong poses")
    options = parser.parse_args()
    runs, seconds = (1, 4.0) if options.quick else (options.runs, options.seconds)
    if not options.faults:
        print(UNSEEN if options.unseen else COVERAGE)
    for name in ("go1",) if options.quick else options.robots:
        if options.faults:
            faults(name, range(options.first, options.first + runs), seconds)
        elif options.unseen:
            for seed in range(options.first, options.first + runs):
                unseen(name, seed, seconds)
        else:
            coverage(name, range(options.first, options.first + runs), seconds)
    if not (options.unseen or options.faults):
        if "ROBOTID_DATA" in os.environ:
            trot()
        speed(min(6.0, seconds))
    print(setting.machine())


if __name__ == "__main__":
    main()
