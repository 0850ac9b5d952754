"""Drives with position controllers, as identified from position commands."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint

if TYPE_CHECKING:
    from robotid.dynamics.simulation.loops import Loops

#: Parameters of a joint's controller, 0 if a result lacks them.
_OF_CONTROLLER = ("kd", "delay", "zero")
_OF_DRIVE = ("armature", "viscous", "coulomb", "offset")


@dataclass(frozen=True)
class CommandedDrive:
    """A joint whose drive has a position controller.

    The torque of the controller is tau = kp (q_ref(t - delay) - q) - kd v, within +-effort_limit.
    The torque on the bodies is tau - armature a - viscous v - coulomb sign(v) - offset. The
    encoder reads q = q_urdf - zero.
    """

    joint: str
    kp: float  # proportional gain [N m/rad or N/m]
    kd: float  # derivative gain [N m s/rad or N s/m]
    delay: float  # delay of the command [s]
    zero: float  # position of the URDF's joint at which the encoder reads 0 [rad or m]
    armature: float  # inertia of the rotor, reflected to the joint [kg m^2 or kg]
    viscous: float  # viscous friction [N m s/rad or N s/m]
    coulomb: float  # Coulomb friction [N m or N]
    offset: float  # constant torque [N m or N]
    effort_limit: float  # torque limit of the controller, inf if it has none [N m or N]


def commanded_drives(
    model: RobotModel, pi: Array, content: Mapping[str, Any], name: str
) -> tuple[CommandedDrive, ...]:
    """Return the drives of a result with gains, in the order of the joints; none without gains.

    pi (p,).
    """
    stated = {entry["name"]: float(entry["value"]) for entry in content["drive_parameters"]}
    if not any(f"{joint}.kp" in stated for joint in model.joints):
        return ()
    missing = [joint for joint in model.joints if f"{joint}.kp" not in stated]
    if missing:
        raise DataError(
            f"{name} has gains of some joints, but no kp of {listed(missing)}; identify again with "
            "gains of all joints in [controller]"
        )
    for joint in model.joints:
        for term, wanted, is_right in (
            ("kp", "more than 0", stated[f"{joint}.kp"] > 0),
            ("kd", "0 or more", stated.get(f"{joint}.kd", 0.0) >= 0),
            ("delay", "0 or more", stated.get(f"{joint}.delay", 0.0) >= 0),
        ):
            if not is_right:
                value = stated[f"{joint}.{term}"]
                raise DataError(f"{name}: {joint}.{term} is {value:g}, wanted {wanted}")
    controller = content.get("simulation", {}).get("controller", {})
    efforts = controller.get("effort_limit") or {}
    found = dict(zip(model.layout.names, pi.tolist(), strict=True))
    return tuple(
        CommandedDrive(
            joint,
            stated[f"{joint}.kp"],
            **{key: stated.get(f"{joint}.{key}", 0.0) for key in _OF_CONTROLLER},
            **{key: found.get(f"{joint}.{key}", 0.0) for key in _OF_DRIVE},
            effort_limit=stated.get(f"{joint}.limit") or efforts.get(joint, np.inf),
        )
        for joint in model.joints
    )


def loops_of(
    model: RobotModel, pi: Array, drives: Sequence[CommandedDrive], rate: float | None = None
) -> "Loops":
    """Return bodies, drives and controllers for simulation: pi (p,)."""
    from robotid.dynamics.simulation.loops import open_loops

    kp, kd, delay, zero, limit = (
        np.array([getattr(drive, key) for drive in drives])
        for key in ("kp", "kd", "delay", "zero", "effort_limit")
    )
    found = open_loops(model, pi)
    return replace(found, kp=kp, kd=kd, delay=delay, zero=zero, limit=limit, rate=rate)


def limit_of(drive: CommandedDrive, joint: Joint) -> float:
    """Return the torque limit of a drive; the URDF's where none was stated or found, else inf."""
    stated = joint.effort if joint.effort > 0 else np.inf
    return drive.effort_limit if np.isfinite(drive.effort_limit) else stated
