"""Constraints between frames: contacts with the ground, and joints that close kinematic chains."""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import ModelError, SettingsError
from robotid.base.findings import listed, suggestion
from robotid.base.settings import Range, Settings, require_each, require_flag, require_kind, setting
from robotid.base.typing import Array
from robotid.robot.drive_term import DriveTerm

_LENGTH = Range("a length [m], at least 0", lambda x: 0.0 <= x < np.inf)
_FORCE = Range("a force [N]", lambda x: abs(x) < np.inf)


@dataclass(frozen=True)
class Contact(Settings):
    """A link that touches the ground."""

    frame: str = setting(
        MISSING,
        "the link whose frame is at the contact; at the centre of the foot if it has a radius",
    )
    kind: str = setting(
        "point",
        "point, which transmits a force, or surface, which also transmits a moment",
        among=("point", "surface"),
    )
    measured: tuple[str, ...] = setting(
        (),
        "measured components of the wrench of the ground on the link, fx to mz (columns "
        "wrench_fz_<link>), at the origin of the link; the others are unknown",
    )
    always: bool = setting(
        False,
        "whether it always touches the ground (true if all components are measured); else logs "
        "have contact_<link>, or contacts are found",
    )
    radius: float = setting(
        0.0, "radius of a round foot, which rolls on level ground [m]", within=_LENGTH
    )
    uncertainty: float | None = setting(
        None,
        "standard deviation of the point of contact along each axis [m], part of the "
        "intervals; default: estimated from the logs",
        within=_LENGTH,
    )
    axes: str = setting(
        "world",
        "axes of the components: world, or link (a sensor in the link)",
        among=("world", "link"),
        dump=lambda axes: None if axes == "world" else axes,
    )
    threshold: float | None = setting(
        None,
        "force above which it touches the ground [N], if contact_<link> is a force",
        within=_FORCE,
    )

    sizes: ClassVar[dict[str, int]] = {"point": 3, "surface": 6}
    components: ClassVar[tuple[str, ...]] = ("fx", "fy", "fz", "mx", "my", "mz")

    def __post_init__(self) -> None:
        require_kind(self.frame, str, "a frame", "the name of a link")
        super().__post_init__()
        known = self.components[: self.sizes[self.kind]]
        for component in require_each(self.measured, str, "measured", f"a list of {listed(known)}"):
            if component not in known or self.measured.count(component) > 1:
                raise SettingsError(
                    f"measured of the {self.kind} contact {self.frame!r} has {component!r}, "
                    f"expected some of {listed(known)}, each once"
                )
        require_flag(self.always, "always")
        if self.radius > 0.0 and self.kind != "point":
            raise SettingsError(
                f"radius of the {self.kind} contact {self.frame!r} is {self.radius:g}, expected a "
                "positive length [m] of a point contact, or 0"
            )
        if self.is_measured:
            object.__setattr__(self, "always", True)

    @property
    def _table(self) -> str:  # type: ignore[override]
        return f"contact {self.frame!r}"

    @property
    def frames(self) -> tuple[str, ...]:
        """The link."""
        return (self.frame,)

    @property
    def name(self) -> str:
        """Name for messages."""
        return self.frame

    @property
    def is_measured(self) -> bool:
        """Whether its whole wrench is measured."""
        return len(self.measured) == self.sizes[self.kind]

    def rows(self, jacobians: Sequence[Array], placement: pin.SE3) -> Array:
        """Return the velocity that the contact prevents, per speed of the robot, shape (m, nv)."""
        rows = jacobians[0][: self.sizes[self.kind]].copy()  # axes of the world, (6, nv)
        rows[0] -= self.radius * jacobians[0][4]  # v + w x (0, 0, -radius)
        rows[1] += self.radius * jacobians[0][3]
        if self.axes == "link":
            return np.reshape(placement.rotation.T @ rows.reshape(-1, 3, rows.shape[1]), rows.shape)
        return rows


@dataclass(frozen=True)
class Loop(Settings):
    """Two links that are connected at all samples, which closes a kinematic chain."""

    frames: tuple[str, str] = setting(
        MISSING, "the two links, whose frames have their origins at the connection"
    )
    kind: str = setting(
        "hinge",
        "point, a ball joint; hinge, a revolute joint; or rigid, whose frames coincide",
        among=("point", "hinge", "rigid"),
    )
    axis: tuple[float, float, float] = setting(
        (0.0, 0.0, 1.0), "axis of the hinge, the same in the frames of both links"
    )

    sizes: ClassVar[dict[str, int]] = {"point": 3, "hinge": 5, "rigid": 6}

    def __post_init__(self) -> None:
        require_each(self.frames, str, "frames of a loop", "two names of links")
        super().__post_init__()
        if len(self.frames) != 2 or self.frames[0] == self.frames[1]:
            found = listed(self.frames) or "none"
            raise SettingsError(f"loop has the frames {found}, expected two links")
        axis = require_each(self.axis, (int, float), "axis of a loop", "x, y, z")
        if len(axis) != 3 or not 1e-6 < np.linalg.norm(np.array(axis, dtype=float)) < np.inf:
            raise SettingsError(
                f"axis of loop {listed(self.frames)} is {self.axis}, expected x, y, z"
            )

    @property
    def _table(self) -> str:  # type: ignore[override]
        return f"loop {listed(self.frames)}"

    @property
    def name(self) -> str:
        """Name for messages."""
        return " - ".join(self.frames)

    def rows(self, jacobians: Sequence[Array], placement: pin.SE3) -> Array:
        """Return the relative velocity that the loop prevents, per speed, shape (m, nv)."""
        relative = jacobians[0] - jacobians[1]  # of the two frames, axes of the world, (6, nv)
        if self.kind != "hinge":
            return relative[: self.sizes[self.kind]]
        return np.vstack([relative[:3], self._across(placement.rotation) @ relative[3:]])

    def error(self, placements: Sequence[pin.SE3]) -> Array:
        """Return the displacement that the loop prevents, (m,) [m, rad]; 0 if it is closed."""
        first, second = placements
        displacement = np.zeros(self.sizes[self.kind])
        displacement[:3] = first.translation - second.translation
        if self.kind == "hinge":
            axis = np.asarray(self.axis, dtype=float) / np.linalg.norm(self.axis)
            turned = np.cross(second.rotation @ axis, first.rotation @ axis)
            displacement[3:] = self._across(first.rotation) @ turned
        elif self.kind == "rigid":
            displacement[3:] = pin.log3(first.rotation @ second.rotation.T)
        return displacement

    def drift(self, accelerations: Sequence[Array], speeds: Sequence[Array], R: Array) -> Array:
        """Return dJ/dt v, (m,): R are the first frame's axes, speeds angular velocities (3,)."""
        relative = accelerations[0] - accelerations[1]  # axes of the world, (6,)
        if self.kind != "hinge":
            return relative[: self.sizes[self.kind]]
        across = self._across(R)
        turning = np.cross(speeds[0], across) @ (speeds[0] - speeds[1])
        return np.append(relative[:3], across @ relative[3:] + turning)

    def _across(self, rotation: Array) -> Array:
        """Return two directions perpendicular to the axis, fixed in the first link, (2, 3)."""
        return np.asarray(self._perpendicular @ rotation.T)

    @cached_property
    def _perpendicular(self) -> Array:
        """Two directions perpendicular to the axis, shape (2, 3)."""
        return np.asarray(np.linalg.svd(np.array(self.axis, dtype=float)[None])[2][1:])


Constraint = Contact | Loop


def check_constraints(
    constraints: Sequence[Constraint],
    links: Sequence[str],
    file: str,
    own_terms: Mapping[str, Sequence[DriveTerm]],
) -> None:
    """Refuse constraints of links that are not in the URDF, or stated twice, and wrong terms."""
    require_each(constraints, (Contact, Loop), "constraints", "a list of Contact and Loop")
    for constraint in constraints:
        for frame in constraint.frames:
            if frame not in links:
                raise ModelError(
                    f"contact or loop at {frame!r}, which is not a link of {file}; links: "
                    f"{listed(links)}{suggestion(frame, links)}"
                )
    stated = [constraint.frames for constraint in constraints]
    if twice := [x for k, x in enumerate(stated) if x in stated[:k]]:
        raise ModelError(f"the contact or loop at {listed(twice[0])} is given twice; remove one")
    for name, terms in own_terms.items() if constraints else ():
        if loaded := [term.name for term in terms if term.needs_load]:
            raise SettingsError(
                f"{name} has the drive term {loaded[0]!r}, which depends on the joint load torque; "
                "it is not known with unknown forces of contacts or loops. Remove the term"
            )


def frame_id(pin_model: pin.Model, link: str) -> int:
    """Return the number of a link's frame."""
    return int(pin_model.getFrameId(link, pin.FrameType.BODY))


def link_positions(pin_model: pin.Model, configurations: Array, links: Sequence[str]) -> Array:
    """Return the positions of links in the world, shape (N, k, 3) [m]: configurations (N, nq)."""
    data, ids = pin_model.createData(), [frame_id(pin_model, link) for link in links]
    positions = np.empty((len(configurations), len(ids), 3))
    for k, q in enumerate(np.ascontiguousarray(configurations)):
        pin.framesForwardKinematics(pin_model, data, q)
        positions[k] = [data.oMf[i].translation for i in ids]
    return positions
