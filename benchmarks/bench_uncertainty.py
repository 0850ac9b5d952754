"""Are the standard errors true? Reported ones against the scatter of many simulated recordings.

    python benchmarks/bench_uncertainty.py [--runs 200] [--quick] [--encoders [--uncorrected]]

Each run draws a robot near the URDF (bodies deformed by 10 % of their size) or far from it (moved
by 10 cm, more than the size of a wrist), always with a tool of 1.2 kg and friction, simulates a log
of 24 s at 200 Hz with noise on the torque, and identifies it: "filtered" with the default signal
settings, "raw" without a filter. Noises: "white", the same share of each joint's torque; "unequal",
from 0.3 to 30 % over the joints; "coloured", AR(1) with 0.9 at 200 Hz.
The ratio of a base parameter is its reported standard error, root mean square over the runs, over
the root mean square of its error; wanted 0.8-1.3. Coverage is how often the 95 % interval holds
the truth; wanted 92-98 %. "band" is the same of the predicted torque on another motion.

``--encoders`` instead: positions behind encoders of 12, 14 and 18 bits a turn, no velocity in the
log, torques by Pinocchio's RNEA and drives with viscous and Coulomb friction, white noise of 1 %.
A motion of its own in each run, of 24 s, or of 12 s that is run twice: rounding errors repeat.
Counted are inertial base parameters; "shift" is the largest correction in standard errors, the
median over the runs, "named" in how many runs there is a finding ``encoder_noise``. With
``--uncorrected`` the coarsest encoders come again, the noise of the regressor left as it is.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse
import itertools

import numpy as np
import pinocchio as pin
import scipy.linalg
import scipy.signal

from robotid.data.log import Log
from robotid.dynamics.simulation.motions import random_fourier
from robotid.estimation.fitting import fit
from robotid.cli.identify import identify
from robotid.dynamics.base_parameters import structural_mapping
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia, pseudo_inertia
from robotid.dynamics.torque import joint_torque_regressor
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.simulation.simulator import another_robot
from robotid.estimation.estimators.estimator import quantile

CHAINS = {"filtered": SignalSettings(), "raw": SignalSettings(cutoff=None)}
NOISES = ("white", "unequal", "coloured")
RATE, DURATION = 200.0, 24.0
MOVED = 0.1  # [m]
FRICTION = "viscous+coulomb"  # the plant's: one mapping for all runs
ENCODER_NOISE = 0.01  # of each joint's torque
ENCODER_ROBOTS = {"UR5": "ur5_robot.urdf"}


def noise(kind, size, rng):
    n = size.shape[-1]
    share = np.geomspace(0.003, 0.3, n) if kind == "unequal" else np.full(n, 0.05)
    white = rng.standard_normal(size.shape)
    if kind == "coloured":
        colour = scipy.signal.lfilter([1.0], [1.0, -0.9], white, axis=0)
        white = colour * np.sqrt(1 - 0.9**2)
    return share * np.std(size, axis=0) * white


def another(model, rng, moved):
    """Return a robot whose bodies differ from the URDF by 10 % of their size, or are far off.

    Args:
        moved: By how much their points are moved [m]; None: by 10 % of the body's size.
    """
    size = model.layout.n_inertial
    pi = another_robot(model, rng)
    J = pseudo_inertia(model.standard_parameters()[:size])
    deform = np.array([scipy.linalg.expm(0.1 * rng.standard_normal((4, 4))) for _ in J])
    deform[:, 3, :3] = 0.0  # an affine map of the body's points
    gyration = np.sqrt(np.trace(J[:, :3, :3], axis1=1, axis2=2) / J[:, 3, 3])
    deform[:, :3, 3] *= gyration[:, None] if moved is None else 10.0 * moved
    deformed = deform @ J @ deform.transpose(0, 2, 1)
    pi[:size] = np.concatenate([inertial_from_pseudo_inertia(J_i) for J_i in deformed])
    return pi


class Study:
    """One robot, chain and noise: estimates of many runs beside the truth of each."""

    def __init__(self, name, chain, kind, runs, moved=None):
        self.model = setting.robot(name)
        self.mapping = structural_mapping(self.model)
        rng = np.random.default_rng(0)
        t = np.arange(round(RATE * DURATION)) / RATE
        q, v, a = random_fourier(self.model, rng, period=DURATION / 2).evaluate(t)
        W = joint_torque_regressor(self.model, q, v, a)
        other = random_fourier(self.model, rng, period=DURATION / 2).evaluate(t[::40])
        W_other = joint_torque_regressor(self.model, *other)[:, self.mapping.independent]
        found = {"wls": [], "consistent": []}
        for run in range(runs):
            draw = np.random.default_rng([1, run])
            pi = another(self.model, draw, moved)
            tau = (W @ pi).reshape(v.shape)
            log = Log(
                t=t, q=q, tau=tau + noise(kind, tau, draw), joints=self.model.joints, v=v, a=a
            )
            identification = identify(
                self.model, [log], signals=CHAINS[chain], friction=FRICTION, doctor=False
            )
            truth = self.mapping.to_base(pi)
            reach = identification.errors.quantile
            wls, consistent = identification.wls, identification
            C = self.mapping.K @ consistent.estimate.covariance @ self.mapping.K.T
            for key, beta, covariance in (
                ("wls", wls.theta, wls.covariance),
                ("consistent", consistent.base, C),
            ):
                error, se = beta - truth, np.sqrt(np.diag(covariance))
                band = np.sqrt(np.einsum("ij,jk,ik->i", W_other, covariance, W_other))
                found[key].append((error, se, np.abs(error) <= reach * se, W_other @ error, band))
        self.found = {
            key: [np.array(values) for values in zip(*rows, strict=True)]
            for key, rows in found.items()
        }

    def row(self, key):
        error, se, is_held, torque, band = self.found[key]
        ratio = np.sqrt((se**2).mean(axis=0) / (error**2).mean(axis=0))
        reach = quantile(np.array([np.inf]))[0]
        return (
            f"{ratio.min():.2f}, {np.median(ratio):.2f}, {ratio.max():.2f} | "
            f"{100 * np.mean((ratio > 0.8) & (ratio < 1.3)):.0f} % | "
            f"{100 * is_held.mean():.1f} % | "
            f"{np.sqrt((band**2).mean() / (torque**2).mean()):.2f} | "
            f"{100 * (np.abs(torque) <= reach * band).mean():.1f} %"
        )


class EncoderStudy:
    """One robot, encoder and motion: errors of inertial base parameters in standard errors."""

    def __init__(self, name, bits, period, friction, runs):
        self.model = encoder_robot(name)
        self.mapping = structural_mapping(self.model)
        inertial = self.mapping.K[:, : self.model.layout.n_inertial].any(axis=1)
        names = np.array(self.mapping.base_names)[inertial].tolist()
        self.z, self.shifts, self.named = {"wls": [], "consistent": []}, [], 0
        for run in range(runs):
            log, truth = self.record(bits, period, np.random.default_rng([7, run]))
            found = identify(self.model, [log], friction=friction, doctor=False)
            own = [found.mapping.base_names.index(key) for key in names]
            reach, noise = found.errors.quantile[own], found.regressor_noise
            for key, beta, error in (
                ("wls", found.wls.theta, found.wls.std_error),
                ("consistent", found.base, found.base_error),
            ):
                self.z[key].append((np.abs(beta[own] - truth[inertial]) / error[own], reach))
            shift = [0.0] if noise is None else np.abs(noise.shift / noise.std_error)[own]
            self.shifts.append(np.max(shift))
            self.named += any(finding.code == "encoder_noise" for finding in found.findings)

    def record(self, bits, period, rng):
        """Return a log and its base parameters."""
        model, t = self.model, np.arange(round(RATE * DURATION)) / RATE
        q, v, a = random_fourier(model, rng, period=period).evaluate(t)
        pi = another(model, rng, None)
        tau = torque(model, pi, q, v, a)
        tau += ENCODER_NOISE * np.std(tau, axis=0) * rng.standard_normal(tau.shape)
        step = 2 * np.pi / 2**bits
        log = Log(t=t, q=np.round(q / step) * step, tau=tau, joints=model.joints)
        return log, self.mapping.to_base(pi)

    def row(self, key):
        z, reach = (np.array(values) for values in zip(*self.z[key], strict=True))
        return (
            f"{100 * np.mean(z <= reach):.1f} % | {np.sqrt(np.mean(z**2)):.2f} | "
            f"{np.median(self.shifts):.2f} | {self.named}"
        )


def encoder_robot(name):
    """Return an arm by the name of its URDF, or as ``setting.robot``."""
    own = ENCODER_ROBOTS.get(name)
    return setting.robot(name) if own is None else RobotModel.from_urdf(example_urdf(own))


def torque(model, pi, q, v, a):
    """Return the torque of bodies, by Pinocchio's RNEA, and of viscous and Coulomb drives."""
    plant, size = model.pin_model.copy(), model.layout.n_inertial
    for body, values in enumerate(pi[:size].reshape(-1, 10)):
        plant.inertias[body + 1] = pin.Inertia.FromDynamicParameters(values)
    data, states = plant.createData(), zip(model.configurations(q), v, a, strict=True)
    rigid = np.array([pin.rnea(plant, data, *state) for state in states])
    value = dict(zip(model.layout.names, pi, strict=True))
    terms = {"armature": a, "viscous": v, "coulomb": np.sign(v), "offset": np.ones_like(v)}
    drives = [
        sum(value[f"{joint}.{term}"] * x[:, j] for term, x in terms.items())
        for j, joint in enumerate(model.joints)
    ]
    return rigid + np.column_stack(drives)


def print_encoders(robots, frictions, bits, runs):
    print(f"{runs} runs each; inertial base parameters; torque noise {100 * ENCODER_NOISE:g} %")
    print("| robot | bits | motion | friction | estimator | coverage | RMS z | shift | named |")
    print("|---" * 9 + "|")
    correction = fit.find_regressor_noise
    for name, period, friction, (bit, is_corrected) in itertools.product(
        robots, (DURATION, DURATION / 2), frictions, bits
    ):
        fit.find_regressor_noise = correction if is_corrected else lambda *_: None
        study = EncoderStudy(name, bit, period, friction, runs)
        motion = "once" if period == DURATION else "twice"
        encoder = f"{bit}{'' if is_corrected else ', not corrected'}"
        for key in study.z:
            row = f"| {name} | {encoder} | {motion} | {friction} | {key} | {study.row(key)} |"
            print(row, flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--robots", nargs="+")
    parser.add_argument("--quick", action="store_true", help="few runs of one robot, as a trial")
    parser.add_argument("--encoders", action="store_true", help="encoders of 12, 14 and 18 bits")
    parser.add_argument("--uncorrected", action="store_true", help="also without the correction")
    parser.add_argument("--bits", type=int, nargs="+", default=[12, 14, 18])
    parser.add_argument("--friction", nargs="+", default=["viscous+coulomb", "auto"])
    options = parser.parse_args()
    if options.encoders:
        print(setting.machine())
        bits = [(bits, True) for bits in options.bits]
        bits += [(min(options.bits), False)] if options.uncorrected else []
        if options.quick:
            print_encoders(["UR5"], options.friction[:1], bits, 2)
        else:
            robots = options.robots or ["UR5", "panda"]
            print_encoders(robots, options.friction, bits, options.runs)
        return
    robots, runs = (
        (["UR10"], 2) if options.quick else (options.robots or ["UR10", "panda"], options.runs)
    )
    print(setting.machine())
    print(f"{runs} runs each; ratio = reported standard error / root mean square of the error")
    print("| robot | signals | noise | URDF | estimator | ratio: min, median, max | in 0.8-1.3 "
          "| coverage | ratio of the torque band | its coverage |")  # fmt: skip
    print("|---" * 10 + "|")
    cases = [(*case, None) for case in itertools.product(robots, CHAINS, NOISES)]
    cases += [(name, chain, "white", MOVED) for name, chain in itertools.product(robots, CHAINS)]
    for name, chain, kind, moved in [cases[0], cases[-1]] if options.quick else cases:
        study = Study(name, chain, kind, runs, moved)
        urdf = "near" if moved is None else "far"
        for key in study.found:
            row = f"| {name} | {chain} | {kind} | {urdf} | {key} | {study.row(key)} |"
            print(row, flush=True)


if __name__ == "__main__":
    main()
