"""Logs of a robot whose drives have terms of their own."""

from dataclasses import dataclass

import numpy as np

from helpers.synthetic import perfect
from robotid.cli.identify import identify
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulation_settings import Sensors
from robotid.dynamics.simulation.simulator import Noise, another_robot
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.identification.pipeline import with_drives
from robotid.robot.drives import AUTO, wanted_families
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

EXACT = SignalSettings(cutoff=None, trim=0.0)
FIT = EstimatorSettings()  # bounds of bodies have no part in what drives have
JOINTS = ("shoulder_lift_joint", "elbow_joint", "wrist_1_joint")
LIFT, ELBOW, WRIST = JOINTS


def arm():
    """Return the three joints of a UR5 in one plane."""
    return RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), joints=JOINTS)


def driven(model, own, values):
    """Return a robot near the model with further terms by joint, values by name; its parameters."""
    model = model.with_terms(own)
    pi = another_robot(model, np.random.default_rng(0))
    names = list(model.layout.names)
    for name, value in values.items():
        pi[names.index(name)] = value
    return model.with_reference(pi), pi


def driven_log(
    model, pi, seed, *, duration=30.0, rate=60.0, noise=0.01, reach=1.0, speed=1.0, still=()
):
    """Return a log of inverse dynamics, of what drives remember, too."""
    # The model's reference are its parameters pi. Noise is the share of each torque's typical size;
    # reach and speed are factors of a random motion; ``still`` numbers joints that stand.
    rng = np.random.default_rng(seed)
    motion = _Scaled(random_fourier(model, rng, period=duration / 3), reach, speed, still)
    sensors = Sensors(acceleration=True, noise=Noise(tau=noise))
    length = (round(duration * rate) - 1) / rate
    return perfect(model, pi, motion, rng, rate=rate, duration=length, sensors=sensors)


@dataclass(frozen=True)
class _Scaled:
    """A motion that goes further, or faster, or whose joints stand in part."""

    motion: object
    reach: float
    speed: float
    still: tuple

    def evaluate(self, t):
        q, v, a = self.motion.evaluate(self.speed * t)
        q, v, a = self.reach * q, self.reach * self.speed * v, self.reach * self.speed**2 * a
        for j in self.still:
            q[:, j], v[:, j], a[:, j] = 0.3, 0.0, 0.0
        return q, v, a


def found_in(model, logs, *, estimator=FIT, **options):
    """Return what is identified of logs without a filter, the doctor aside."""
    return identify(model, logs, signals=EXACT, doctor=False, estimator=estimator, **options)


def fitted_in(model, logs, *, estimator=FIT, friction=AUTO):
    """Return the fit of such logs with the friction that they show, before it is judged."""
    recordings = Recordings(
        model, structural_mapping(model), [hold_log(model, log, EXACT) for log in logs]
    )
    choice = EstimatorSettings(estimator) if isinstance(estimator, str) else estimator
    return with_drives(recordings, choice, wanted_families(friction, model.joints))
