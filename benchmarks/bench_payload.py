"""Coverage of the intervals of a payload, for different runs and joints.

    python benchmarks/bench_payload.py [--runs 20] [--quick]

Pairs of logs of 40 s at 200 Hz, with 2 kg on the flange and without, each of a motion of its own;
rigid-body torques by Pinocchio's RNEA, torque noise of 1 %. Drives have viscous and Coulomb
friction of a tenth of the gravity torque, smoothed over 0.02 rad/s. "day": in each run viscous and
Coulomb friction of each joint are another 15 % off, fall or rise by 15 % while it warms up (time
constant 20 s), and rise by a fifth near standstill, all of which the fit does not know. "gains":
torques of each joint are also scaled by 1 +- 2 %, the same in both runs.
Coverage: how often the 95 % interval holds the mass, and the centre of mass (of Student's quantile
for its mass); error and standard error of the mass: root mean squares over the pairs.
"""

import setting  # noqa: I001 -- pins the threads of BLAS before numpy is imported

import argparse

import numpy as np
import pinocchio as pin

from robotid.identification.payload_fit import identify_payload
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.dynamics.simulation.motions import random_fourier

ARMS = {
    "UR5": ("ur5_robot.urdf", None, "tool0"),
    "panda": ("panda.urdf", [f"panda_joint{i}" for i in range(1, 8)], "panda_link8"),
}
MASS, COM = 2.0, np.array([0.02, 0.03, 0.08])
INERTIA = np.array([[0.03, 0.002, -0.001], [0.002, 0.025, 0.003], [-0.001, 0.003, 0.02]])
RATE, DURATION, WARM, NOISE = 200.0, 40.0, 20.0, 0.01
CASES = {"alike": (0.0, 0.0, 0.0), "day": (0.15, 0.2, 0.0), "gains": (0.15, 0.2, 0.02)}


class Arm:
    """A robot on one day, and the logs that it writes."""

    def __init__(self, name, rng, change, near_rest, scale):
        file, joints, self.link = ARMS[name]
        self.model = RobotModel.from_urdf(example_urdf(file), joints=joints)
        bare, n = self.model.pin_model, len(self.model.joints)
        frame = bare.frames[bare.getFrameId(self.link)]
        loaded = bare.copy()
        loaded.appendBodyToJoint(
            frame.parentJoint, pin.Inertia(MASS, COM, INERTIA), frame.placement
        )
        self.plants = {False: bare, True: loaded}
        self.rng, self.change, self.near_rest = rng, change, near_rest
        self.scale = 1.0 + scale * rng.standard_normal(n)
        self.friction = 0.1 * (1.0 + self._gravity())

    def _gravity(self):
        model = self.plants[False]
        data, still = model.createData(), np.zeros(model.nv)
        torques = [
            pin.rnea(model, data, pin.randomConfiguration(model), still, still) for _ in range(50)
        ]
        return np.abs(torques).mean(axis=0)[: len(self.model.joints)]

    def log(self, is_loaded):
        rng, plant, n = self.rng, self.plants[is_loaded], len(self.model.joints)
        t = np.arange(round(RATE * DURATION)) / RATE
        q, v, a = random_fourier(self.model, rng, period=DURATION / 2).evaluate(t)
        states, data = zip(self.model.configurations(q), v, a, strict=True), plant.createData()
        tau = np.array([pin.rnea(plant, data, *state) for state in states])
        coulomb, viscous, drift = self.change * rng.standard_normal((3, n))
        rise = 1.0 + self.near_rest * np.exp(-((v / 0.1) ** 2))
        own = (1.0 + coulomb) * rise * np.tanh(v / 0.02) + (1.0 + viscous) * v
        tau += self.friction * own * (1.0 + drift * np.exp(-t / WARM)[:, None])
        tau *= self.scale
        tau += NOISE * tau.std(axis=0) * rng.standard_normal(tau.shape)
        noisy = (q + 1e-5 * rng.standard_normal(q.shape), v + 1e-3 * rng.standard_normal(v.shape))
        return Log(t=t, q=noisy[0], v=noisy[1], tau=tau, joints=self.model.joints)


def row(name, case, runs):
    held, errors, stated = [], [], []
    pin.seed(0)
    for run in range(runs):
        arm = Arm(name, np.random.default_rng([5, run]), *CASES[case])
        logs = [arm.log(True), arm.log(False)]
        signals = SignalSettings(cutoff=8.0)
        found = identify_payload(arm.model, logs[:1], logs[1:], links=[arm.link], signals=signals)
        payload = found[arm.link]
        low, high = payload.mass_interval
        reach = (high - payload.mass) / payload.mass_std_error
        centre = np.abs(payload.com - COM) <= reach * payload.com_std_error
        held.append([low <= MASS <= high, *centre])
        errors.append(payload.mass - MASS)
        stated.append(payload.mass_std_error)
    mass, *centre = 100 * np.mean(held, axis=0)
    size, error = (1e3 * np.sqrt(np.mean(np.square(x))) for x in (errors, stated))
    return f"| {name} | {case} | {mass:.0f} | {np.mean(centre):.0f} | {size:.1f} | {error:.1f} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--quick", action="store_true", help="one pair of one robot, as a trial")
    options = parser.parse_args()
    print("| robot | runs | mass coverage [%] | centre coverage [%] | error [g] | std. error [g] |")
    print("|---|---|---|---|---|---|")
    for name in ["UR5"] if options.quick else ARMS:
        for case in ["gains"] if options.quick else CASES:
            print(row(name, case, 1 if options.quick else options.runs), flush=True)
    print(f"\n{setting.machine()}")


if __name__ == "__main__":
    main()
