"""Settings of the drives' closed loop in a job file: its known and its fitted parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed, suggestion
from robotid.base.settings import Entries, Range, Settings, setting
from robotid.base.typing import Array
from robotid.dynamics.simulation.simulation_settings import DELAY, GAIN, LEVEL, PerJoint, by_joint

_CLOCK = Range("1 to 2e4 Hz", lambda x: 1.0 <= x <= 2e4)
#: Settings that do not apply where the logged torque drives the robot.
_OF_LOOPS = ("kp", "kd", "limit", "delay", "delays", "rate", "gravity_compensation", "zeros")


@dataclass(frozen=True)
class LoopSettings(Settings):
    """The controller of logs with commands, torque = kp (q_ref - q) + kd (v_ref - v) + tau_ref.

    With kind "torque" there is no closed loop: the logged torque drives the robot.
    """

    _table: ClassVar[str] = "controller"

    kind: str = setting(
        "pd", "input of the simulation: 'pd', a PD controller with the commands of the log; "
        "'torque', the logged torque without controller and commands",
        among=("pd", "torque"),
    )  # fmt: skip
    kp: PerJoint | None = setting(
        None, "position gain [N m/rad or N/m]; default: fitted, relative to gravity and inertia of "
        "the bodies", **GAIN,
    )  # fmt: skip
    kd: PerJoint | None = setting(
        None, "speed gain [N m s/rad or N s/m]; default: part of the viscous friction, or fitted "
        "if the logs have speed commands, torques, or gains of a known ratio", **LEVEL,
    )  # fmt: skip
    limit: PerJoint | str | None = setting(
        None,
        "torque limit of the drive [N m or N]; default: fitted where the drive saturates; 'find': "
        "fitted for every joint",
        reads=(int, float, dict, str),
        within=GAIN["within"],
        among=("find",),
    )
    delay: PerJoint | None = setting(None, "delay of the command [s]; default: fitted", **DELAY)
    delays: str = setting(
        "one", "the fitted delays: 'one' for the robot (bus and controller), or one per 'group'",
        among=("one", "group"),
    )  # fmt: skip
    rate: float | None = setting(
        None, "sampling rate of a discrete-time controller, which holds its torque until the next "
        "sample [Hz]; default: continuous time", within=_CLOCK,
    )  # fmt: skip
    gravity_compensation: bool = setting(
        False, "whether the controller adds the gravity torque of the URDF"
    )
    groups: Mapping[str, Sequence[str]] = setting(
        {}, "joints with equal drives, by name of the group; they share gains, armature and "
        "viscous friction; default: joints that are equal in the URDF form a group",
        reads=Entries(dict, (list,)),
    )  # fmt: skip
    zeros: str = setting(
        "urdf", "zero and sign of the encoders: 'urdf': as in the URDF; 'find': fitted from "
        "gravity",
        among=("urdf", "find"),
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind != "torque":
            return
        default = LoopSettings()
        for name in _OF_LOOPS:
            if (value := getattr(self, name)) != getattr(default, name):
                how = " The delay of a logged torque is [signals] torque_delay."
                raise SettingsError(
                    f"[controller] {name} is {value!r}, but with kind = 'torque' the logged torque "
                    f"drives the robot, without a controller. Leave {name} out, or set kind = "
                    f"'pd'.{how if name == 'delay' else ''}"
                )


@dataclass(frozen=True)
class LogGains(Settings):
    """Gains of one log that differ from those in [controller]."""

    _table: ClassVar[str] = "controller of a log"

    kp: PerJoint | None = setting(
        None, "position gain [N m/rad or N/m], relative to the fitted one [-] if [controller] has "
        "none; default: the gain in [controller]", **GAIN,
    )  # fmt: skip
    kd: PerJoint | None = setting(None, "speed gain, likewise", **GAIN)

    def factors(self, common: LoopSettings, joints: Sequence[str]) -> Array:
        """Return the gains over those of the controller, shape (2, n) [-]."""
        factors = np.ones((2, len(joints)))
        for row, name in zip(factors, ("kp", "kd"), strict=True):
            usual = by_joint(getattr(common, name), joints, f"controller: {name}", 1.0)
            own = by_joint(getattr(self, name), joints, f"{self._table}: {name}", usual)
            if common.kind == "torque" or (usual[own != usual] == 0.0).any():
                has = "kind 'torque'" if common.kind == "torque" else f"{name} = 0"
                raise SettingsError(
                    f"{self._table}: {name} is {getattr(self, name)!r}, but [controller] has "
                    f"{has}, which no gain of a log changes. Correct one of the two"
                )
            row[own != usual] = (own / usual)[own != usual]
        return factors


def groups_of(settings: LoopSettings, joints: Sequence[str], alike: Sequence[Any]) -> list[str]:
    """Return the group of each joint."""
    group_of: dict[str, str] = {}
    for group, members in settings.groups.items():
        if isinstance(members, str) or not isinstance(members, Sequence):
            raise SettingsError(
                f"controller: groups.{group} is {members!r}, expected a list of joints"
            )
        for joint in members:
            if joint not in joints:
                raise SettingsError(
                    f"controller: groups.{group} has {joint!r}, which is not a moving joint: "
                    f"{listed(joints)}{suggestion(joint, joints)}"
                )
            if joint in group_of:
                raise SettingsError(
                    f"controller: joint {joint!r} is in the groups {group_of[joint]} and {group}; "
                    "name it once"
                )
            group_of[joint] = group
    if settings.groups:
        return [group_of.get(joint, joint) for joint in joints]
    alike_joints: dict[Any, list[str]] = {}
    for key, joint in zip(alike, joints, strict=True):
        alike_joints.setdefault(key, []).append(joint)
    return [_common(alike_joints[key]) for key in alike]


def _common(joints: Sequence[str]) -> str:
    """Return the name of a group: the words common to its joints' names, or its first joint."""
    common = set.intersection(*(set(joint.split("_")) for joint in joints)) - {"joint"}
    words = [word for word in joints[0].split("_") if word in common]
    return joints[0] if len(joints) == 1 else "_".join(words) or joints[0]
