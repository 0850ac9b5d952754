"""Assumptions for motions without a recording: noise of torques, friction of a typical size."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.settings import SIZE, is_number
from robotid.base.typing import Array
from robotid.data.log import suggestion
from robotid.dynamics.prediction import predict_instants
from robotid.robot.model import RobotModel

#: Assumed correlation time of noise [s].
CORRELATION = 0.1
_NOISE = 0.01  # assumed standard deviation of noise, as a share of the largest torque
_FRICTION = 0.05  # assumed Coulomb friction, and viscous at full speed, as such a share
_POSES = 200  # random poses at which gravity is evaluated
#: Smallest largest torque of a joint, as a share of that of all joints.
FAINTEST = 1e-3


@dataclass(frozen=True, eq=False)
class TorqueNoise:
    """Noise of the torque of each joint.

    Attributes:
        std: Standard deviation of each joint, shape (n,) [N m or N].
        correlation: Time over which it is correlated, shape (n,) [s]; 0 for white noise.
        origins: Origin for each joint: "stated", "assumed", or "found" in an earlier run.
    """

    std: Array
    correlation: Array
    origins: tuple[str, ...]

    def last(self, count: int) -> "TorqueNoise":
        """Return the noise of the last rows, those of the joints."""
        return TorqueNoise(self.std[-count:], self.correlation[-count:], self.origins[-count:])

    def density(self, step: float) -> Array:
        """Return the density of each joint's noise at low frequency, shape (n,) [(N m)^2 s]."""
        density: Array = self.std**2 * np.maximum(self.correlation, step)
        return density


def assumed_noise(
    model: RobotModel,
    size: Array,
    stated: Mapping[str, float],
    correlation: float | None = None,
    found: TorqueNoise | None = None,
) -> TorqueNoise:
    """Return the noise of each joint: stated, or of an earlier run, or assumed.

    The assumed noise is 1 % of the joint's largest torque.

    size (n,) [N m or N].
    """
    for joint, value in stated.items():
        if joint not in model.joints:
            raise SettingsError(
                f"noise is stated for {joint!r}, which is not among the joints "
                f"{listed(model.joints)}{suggestion(str(joint), model.joints)}"
            )
        if not (is_number(value) and SIZE.holds(value)):
            raise SettingsError(f"noise of {joint!r} is {value!r}, wanted {SIZE.words}")
    if correlation is not None and not 0 <= correlation < np.inf:
        raise SettingsError(f"correlation is {correlation:g} s, wanted 0 (white noise) or more")
    is_stated = np.isin(model.joints, list(stated))
    values = np.array([stated.get(joint, np.nan) for joint in model.joints])
    std = _NOISE * size if found is None else found.std
    time = np.full(len(size), CORRELATION) if found is None else found.correlation
    if correlation is not None:
        time = np.where(is_stated | (found is None), correlation, time)
    other = "assumed" if found is None else "found"
    origins = tuple("stated" if own else other for own in is_stated)
    return TorqueNoise(np.where(is_stated, values, std), time, origins)


def largest_gravity(model: RobotModel) -> Array:
    """Return the largest gravity torque of each joint over random poses, shape (n,)."""
    ranges = [(j.lower, j.upper) if j.has_limits else (-np.pi, np.pi) for j in model.limits]
    low, high = np.array(ranges).T
    q = np.random.default_rng(0).uniform(low, high, (_POSES, len(ranges)))
    torque: Array = np.abs(predict_instants(model, model.standard_parameters(), q)).max(axis=0)
    return torque


def largest_torques(model: RobotModel, peak: Array) -> Array:
    """Return the largest torque of each joint, shape (n,): the URDF's limit, or that of a motion.

    peak (n,) [N m or N].
    """
    peak = np.maximum(peak, FAINTEST * max(float(peak.max()), 1e-300))
    limit = np.array([joint.effort for joint in model.limits])
    return np.where(np.isfinite(limit) & (limit > 0), limit, peak)


def assumed_parameters(model: RobotModel, size: Array, fastest: Array) -> Array:
    """Return the URDF's bodies with friction of a typical size, shape (p,).

    size (n,) [N m or N], fastest (n,) [rad/s or m/s].
    """
    pi = model.standard_parameters()
    for j, limits in enumerate(model.limits):
        speed = limits.velocity if 0 < limits.velocity < np.inf else max(float(fastest[j]), 1e-3)
        for term, value in (("coulomb", 1.0), ("viscous", 1.0 / speed)):
            name = f"{model.joints[j]}.{term}"
            if name in model.layout.names:
                pi[model.layout.names.index(name)] = _FRICTION * size[j] * value
    return pi
