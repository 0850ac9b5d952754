"""The loop of the drives as a job states it: what is known of it, and what is to be found."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

from robotid._settings import Entries, Range, Settings, setting
from robotid.exceptions import SettingsError
from robotid.findings import listed
from robotid.logs.data import suggestion
from robotid.simulation.settings import DELAY, GAIN, LEVEL, PerJoint

__all__ = ["LoopSettings", "groups_of"]

_CLOCK = Range("1 to 2e4 Hz", lambda x: 1.0 <= x <= 2e4)
#: What a loop has that a logged torque has not.
_OF_LOOPS = ("kp", "kd", "limit", "delay", "delays", "rate", "gravity_compensation", "zeros")


@dataclass(frozen=True)
class LoopSettings(Settings):
    """The controller of logs with commands, torque = kp (q_ref - q) + kd (v_ref - v) + tau_ref.

    With kind "torque" no loop is closed: the logged torque itself drives the robot.
    """

    _table: ClassVar[str] = "controller"

    kind: str = setting(
        "pd", "how the loop is closed: by gains, on the commands of the log; or 'torque', not at "
        "all: the torque of the log drives the robot, which then needs no commands",
        among=("pd", "torque"),
    )  # fmt: skip
    kp: PerJoint | None = setting(
        None, "gain of the position [N m/rad or N/m], for all joints or by joint; found if not "
        "stated, measured by the bodies' gravity and inertia", **GAIN,
    )  # fmt: skip
    kd: PerJoint | None = setting(
        None, "gain of the speed [N m s/rad or N s/m], likewise; counted as viscous friction, with "
        "which it is one, if not stated", **LEVEL,
    )  # fmt: skip
    limit: PerJoint | str | None = setting(
        None,
        "largest torque of the drive [N m or N], likewise; found of joints that run at one largest "
        "speed whatever their error if not stated, of every joint if 'find'",
        reads=(int, float, dict, str),
        within=GAIN["within"],
        among=("find",),
    )
    delay: PerJoint | None = setting(
        None, "how late the command acts [s], likewise; found if not stated", **DELAY
    )
    delays: str = setting(
        "one", "whether the robot has one delay that is found, that of bus and controller, or each "
        "group its own", among=("one", "group"),
    )  # fmt: skip
    rate: float | None = setting(
        None, "how often a second a controller with a clock reads position and speed, to hold its "
        "torque until the next time [Hz]; none if not stated: it follows at once", within=_CLOCK,
    )  # fmt: skip
    gravity_compensation: bool = setting(
        False, "whether the controller adds the torque of gravity by the URDF"
    )
    groups: Mapping[str, Sequence[str]] = setting(
        {}, "joints with equal drives, by a name for each group, which share gains, armature and "
        "viscous friction; joints that are alike in the URDF if not stated",
        reads=Entries(dict, (list,)),
    )  # fmt: skip
    zeros: str = setting(
        "urdf", "zero and sign of the encoders: as the URDF has them, or found, from gravity",
        among=("urdf", "find"),
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind != "torque":
            return
        for each in fields(self):
            if each.name in _OF_LOOPS and getattr(self, each.name) != each.default:
                how = " A late torque: [signals] torque_delay." if each.name == "delay" else ""
                raise SettingsError(
                    f"[controller] {each.name} is {getattr(self, each.name)!r}, but with kind = "
                    "'torque' the torque of the log drives the robot and no loop is closed; "
                    f"leave {each.name} out, or set kind = 'pd'.{how}"
                )


def groups_of(settings: LoopSettings, joints: Sequence[str], alike: Sequence[Any]) -> list[str]:
    """Return the group of each joint.

    Args:
        settings: The stated groups; none: joints that are alike form one.
        joints: Names of the n joints.
        alike: What two joints of a group have in common, n entries.

    Raises:
        SettingsError: If a group names a joint that is not there, or one twice.
    """
    found: dict[str, str] = {}
    for group, members in settings.groups.items():
        if isinstance(members, str) or not isinstance(members, Sequence):
            raise SettingsError(
                f"controller: groups.{group} is {members!r}, wanted a list of joints"
            )
        for joint in members:
            if joint not in joints:
                raise SettingsError(
                    f"controller: groups.{group} has {joint!r}, which is not among the joints that "
                    f"move: {listed(joints)}{suggestion(joint, joints)}"
                )
            if joint in found:
                raise SettingsError(
                    f"controller: joint {joint!r} is in the groups {found[joint]} and {group}; "
                    "name it once"
                )
            found[joint] = group
    if settings.groups:
        return [found.get(joint, joint) for joint in joints]
    first: dict[Any, str] = {}
    named = [first.setdefault(key, joint) for key, joint in zip(alike, joints, strict=True)]
    return [
        joint if named.count(name) == 1 else _common(name, joints, named)
        for name, joint in zip(named, joints, strict=True)
    ]


def _common(name: str, joints: Sequence[str], named: Sequence[str]) -> str:
    """Return a name for a group: the words that the names of its joints share, or its first."""
    members = [joint for joint, first in zip(joints, named, strict=True) if first == name]
    shared = [word for word in members[0].split("_") if all(word in m.split("_") for m in members)]
    shared = [word for word in shared if word != "joint"]
    return "_".join(shared) or members[0]
