"""What a robot may do while it moves: positions, speeds, torques, and how much a motion uses."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.findings import listed
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint

__all__ = ["LIMITS", "MotionLimits"]

#: What is limited, in the order of ``MotionLimits.sizes``.
LIMITS = ("position", "velocity", "acceleration", "jerk", "torque", "power")
_FREE = np.pi  # [rad] either way of a revolute joint freely


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """The limits of each of n joints; inf where there is none.

    Attributes:
        middle: Middle of the positions allowed, shape (n,) [rad or m].
        sizes: Half the range of positions, and the largest velocity, acceleration, jerk, torque
            and power, shape (6, n), SI units.
    """

    middle: Array
    sizes: Array

    @classmethod
    def of_model(
        cls,
        model: RobotModel,
        *,
        share: float = 0.9,
        acceleration: float | Mapping[str, float] = np.inf,
        jerk: float | Mapping[str, float] = np.inf,
        power: float | Mapping[str, float] = np.inf,
    ) -> "MotionLimits":
        """Return the limits that a URDF states, and those stated beside it.

        Args:
            model: The robot.
            share: How much of the URDF's range, speed and torque is used.
            acceleration: Largest acceleration of all joints, or of some [rad/s^2 or m/s^2].
            jerk: Largest jerk, likewise [rad/s^3 or m/s^3].
            power: Largest mechanical power, likewise [W].

        Raises:
            SettingsError: If a limit that is needed is missing from the URDF, or one is unusable.
        """
        if not 0 < share <= 1:
            raise SettingsError(f"share is {share}, wanted more than 0 and at most 1")
        missing = [text for joint in model.limits if (text := _missing(joint))]
        if missing:
            raise SettingsError(
                f"{Path(model.tree.path).name} states no limit of {listed(missing)}: a motion "
                "cannot be kept safe without; add <limit lower upper velocity effort> to these "
                "joints, or lock them"
            )
        middle = [(j.lower + j.upper) / 2 if j.has_limits else 0.0 for j in model.limits]
        half = [(j.upper - j.lower) / 2 if j.has_limits else _FREE for j in model.limits]
        effort = [j.effort if j.effort > 0 else np.inf for j in model.limits]
        sizes = [
            share * np.array(half),
            share * np.array([j.velocity for j in model.limits]),
            _each(model, acceleration, "acceleration"),
            _each(model, jerk, "jerk"),
            share * np.array(effort),
            _each(model, power, "power"),
        ]
        return cls(np.array(middle), np.array(sizes))

    def used(self, q: Array, v: Array, a: Array, jerk: Array, torque: Array) -> Array:
        """Return how much of each limit a motion uses at each instant, shape (6, N, n), signed.

        Args:
            q: Joint coordinates, shape (N, n); the others likewise, SI units.
            v: Velocities.
            a: Accelerations.
            jerk: Jerks.
            torque: Torques.
        """
        values = np.array([q - self.middle, v, a, jerk, torque, torque * v])
        return values / self.sizes[:, None]


def _missing(joint: Joint) -> str:
    """Return what the URDF does not state of a joint, in words; empty if nothing."""
    known = {
        "position": joint.has_limits or joint.type == "continuous",
        "velocity": 0 < joint.velocity < np.inf,
    }
    lacks = [what for what, is_known in known.items() if not is_known]
    return f"{joint.name} ({' and '.join(lacks)})" if lacks else ""


def _each(model: RobotModel, stated: float | Mapping[str, float], what: str) -> Array:
    by_name = stated if isinstance(stated, Mapping) else dict.fromkeys(model.joints, stated)
    for name, value in by_name.items():
        if name not in model.joints:
            raise SettingsError(
                f"{what} is stated of {name!r}, which is no joint that moves; joints: "
                f"{listed(model.joints)}"
            )
        if not value > 0:
            raise SettingsError(f"{what} of {name} is {value:g}, wanted a positive number")
    return np.array([by_name.get(name, np.inf) for name in model.joints], dtype=float)
