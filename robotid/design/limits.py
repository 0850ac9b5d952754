"""The limits of a robot's motion: position, velocity, torque, ..., and a motion's use of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint

#: The limited quantities, in the order of ``MotionLimits.sizes``.
LIMITS = ("position", "velocity", "acceleration", "jerk", "torque", "power")
_FREE = np.pi  # [rad] half the range of a continuous joint


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
        velocity: float | Mapping[str, float] = np.inf,
        torque: float | Mapping[str, float] = np.inf,
        acceleration: float | Mapping[str, float] = np.inf,
        jerk: float | Mapping[str, float] = np.inf,
        power: float | Mapping[str, float] = np.inf,
    ) -> "MotionLimits":
        """Return the limits stated in a URDF, and those stated in addition."""
        if not 0 < share <= 1:
            raise SettingsError(f"share is {share}, wanted more than 0 and at most 1")
        fastest = np.array([j.velocity if j.velocity > 0 else np.inf for j in model.limits])
        fastest = np.minimum(share * fastest, _each(model, velocity, "velocity"))
        missing = [
            text
            for joint, limit in zip(model.limits, fastest, strict=True)
            if (text := _missing(joint, float(limit)))
        ]
        if missing:
            raise SettingsError(
                f"{Path(model.tree.path).name} states no limit of {listed(missing)}: without it no "
                "safe motion can be designed; add <limit lower upper velocity effort> to these "
                "joints, state velocities as --max-velocity JOINT=X, or lock the joints"
            )
        middle = [(j.lower + j.upper) / 2 if j.has_limits else 0.0 for j in model.limits]
        half = [(j.upper - j.lower) / 2 if j.has_limits else _FREE for j in model.limits]
        effort = [j.effort if j.effort > 0 else np.inf for j in model.limits]
        sizes = [
            share * np.array(half),
            fastest,
            _each(model, acceleration, "acceleration"),
            _each(model, jerk, "jerk"),
            np.minimum(share * np.array(effort), _each(model, torque, "torque")),
            _each(model, power, "power"),
        ]
        return cls(np.array(middle), np.array(sizes))

    def used(self, q: Array, v: Array, a: Array, jerk: Array, torque: Array) -> Array:
        """Return a motion's quantities divided by their limits, signed, shape (6, N, n).

        q (N, n).
        """
        values = np.array([q - self.middle, v, a, jerk, torque, torque * v])
        return values / self.sizes[:, None]


def _missing(joint: Joint, velocity: float) -> str:
    """Return a joint and the limits that neither the URDF nor the user states; empty if none."""
    known = {
        "position": joint.has_limits or joint.type == "continuous",
        "velocity": velocity < np.inf,
    }
    lacks = [what for what, is_known in known.items() if not is_known]
    return f"{joint.name} ({' and '.join(lacks)})" if lacks else ""


def _each(model: RobotModel, stated: float | Mapping[str, float], what: str) -> Array:
    by_name = stated if isinstance(stated, Mapping) else dict.fromkeys(model.joints, stated)
    for name, value in by_name.items():
        if name not in model.joints:
            raise SettingsError(
                f"{what} is stated for {name!r}, which is not a moving joint; moving joints: "
                f"{listed(model.joints)}"
            )
        if not value > 0:
            raise SettingsError(f"{what} of {name} is {value:g}, wanted a positive number")
    return np.array([by_name.get(name, np.inf) for name in model.joints], dtype=float)
