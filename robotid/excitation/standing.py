"""A robot on its feet as a robot with a fixed base whose first six joints are those of the base."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.excitation.feet import Feet, Frame, Placed
from robotid.excitation.forces import Ground, projection
from robotid.excitation.information import MotionInformation, MotionRows
from robotid.findings import listed
from robotid.logs.base import BaseMotion, in_base, quaternions_of_angles
from robotid.logs.data import Log, suggestion
from robotid.regressor.base_parameters import BaseMapping
from robotid.robot.constraints import Contact, link_positions
from robotid.robot.model import RobotModel
from robotid.robot.parameters import INERTIAL_TERMS
from robotid.robot.tree import Joint
from robotid.simulation.motions import Motion

__all__ = ["BASE", "Stand", "Standing", "StandingMotion", "standing", "with_base_joints"]

#: The joints of the base, in the order of the chain, and their kinds and axes.
BASE = ("base_x", "base_y", "base_z", "base_yaw", "base_pitch", "base_roll")
_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_SHIFT = 0.5  # range of the base about its first place, as a share of its height ...
_TURN = 0.5  # [rad] ... and of each angle
_APART = 1e-3  # [m] least distance of the points of contact from a line
_FASTEST = 10.0  # [m/s, rad/s] speed limit of the base


def with_base_joints(model: RobotModel, height: float) -> RobotModel:
    """Return a robot whose floating base is moved by three prismatic and three revolute joints.

    Its bodies are those of the robot after five without mass.

    Args:
        model: The robot, whose base floats.
        height: Height of the base at the middle of its range [m].
    """
    tree, links = model.tree, [f"{name}_link" for name in ("world", *BASE[:-1])]
    ranges = [_SHIFT * height] * 3 + [_TURN] * 3
    joints = []
    for k, (name, size) in enumerate(zip(BASE, ranges, strict=True)):
        middle = height if name == "base_z" else 0.0
        child = links[k + 1] if k < 5 else tree.root
        joints.append(
            Joint(
                name, "prismatic" if k < 3 else "revolute", links[k], child, middle - size,
                middle + size, _FASTEST, axis=_AXES[k] if k < 3 else _AXES[5 - k],
            )
        )  # fmt: skip
    if taken := [x for x in (*BASE, *links) if x in (*tree.links, *(j.name for j in tree.joints))]:
        raise SettingsError(f"{model.name} has {taken[0]!r}, a name of the base here; rename it")
    whole = replace(
        tree, root=links[0], links=(*links, *tree.links), joints=(*joints, *tree.joints)
    )
    options = {key: value for key, value in model.options.items() if key not in ("own_terms",)}
    return RobotModel.from_urdf(
        whole,
        **options
        | {
            "joints": [*BASE, *model.joints],
            "free_flyer": False,
            "passive": [*BASE, *model.passive],
        },
        couplings=model.layout.couplings,
        own_terms=model.layout.own,
    )


@dataclass(frozen=True, eq=False)
class StandingMotion(Motion):
    """A motion on the feet: base and joints, from a motion of the free coordinates.

    Attributes:
        feet: The feet.
        free: The motion of the free coordinates.
    """

    feet: Feet
    free: Motion

    def evaluate(self, t: Array) -> tuple[Array, Array, Array]:
        q, v, a, _ = self.feet.along(*self.free.evaluate(t))
        return q, v, a


def _base(q: Array, v: Array, a: Array) -> BaseMotion:
    """Return the motion of the base from its joint coordinates, shape (N, 6 or more) each."""
    turn = quaternions_of_angles(q[:, 5:2:-1])
    (cp, cy), (sp, sy) = np.cos(q[:, [4, 3]].T), np.sin(q[:, [4, 3]].T)
    zero = np.zeros_like(cp)
    axes = np.array([[zero, zero, zero + 1.0], [-sy, cy, zero], [cp * cy, cp * sy, -sp]])
    rates = v[:, 3:6].T[:, None] * axes  # (3, 3, N): joint, world's axis
    w = rates.sum(axis=0)  # (3, N)
    yaw, pitch, _ = rates
    dw = (a[:, 3:6].T[:, None] * axes).sum(axis=0)
    dw += np.cross(yaw, rates[1], axis=0) + np.cross(yaw + pitch, rates[2], axis=0)
    speed, change = in_base(turn, v[:, :3]), in_base(turn, a[:, :3])
    turning, turned = in_base(turn, w.T), in_base(turn, dw.T)
    twist = np.hstack([speed, turning])
    acceleration = np.hstack([change - np.cross(turning, speed), turned])
    return BaseMotion(np.hstack([q[:, :3], turn]), twist, acceleration)


@dataclass(frozen=True, eq=False)
class Stand:
    """A robot on its feet.

    Attributes:
        robot: The robot, whose base floats.
        feet: Its feet on the ground, and the robot with joints of its base.
        ground: The forces of the ground.
    """

    robot: RobotModel
    feet: Feet
    ground: Ground

    @property
    def model(self) -> RobotModel:
        """The robot with joints of its base."""
        return self.feet.model

    def log(self, motion: tuple[Array, Array, Array], t: Array, path: str) -> Log:
        """Return a motion as a log without torques.

        Args:
            motion: Coordinates of base and joints, velocities, accelerations, (N, 6 + n) each.
            t: Times, shape (N,) [s].
            path: Name of the log.
        """
        own = [x.frame for x in self.feet.contacts]
        flags = {x.frame: np.full(len(t), x.frame in own) for x in self.robot.contacts}
        q, v, a = (z[:, len(BASE) :] for z in motion)
        return Log(
            t, q, np.zeros_like(q), self.robot.joints, v, a, path, has_torque=False,
            base=_base(*motion), contacts=flags,
        )  # fmt: skip

    def information(self, mapping: BaseMapping, pi: Array) -> "Standing":
        """Return the rows along motions.

        Args:
            mapping: Base parameters of the robot whose base floats.
            pi: Standard parameters by which torques are computed, shape (p,); those of bodies
                without mass before them are ignored.
        """
        more = len(self.model.layout.names) - len(mapping.names)  # of bodies without mass
        whole = BaseMapping(
            np.hstack([np.zeros((len(mapping.K), more)), mapping.K]),
            mapping.independent + more,
            self.model.layout.names,
            mapping.pivots,
        )
        beta = mapping.to_base(pi[-len(mapping.names) :])
        return Standing(MotionInformation(self.model, whole, beta), self)


@dataclass(frozen=True, eq=False)
class Standing:
    """The projected rows of a robot on its feet along a motion of free coordinates.

    The interface is that of ``MotionInformation``. The rows are those of the base's joints and of
    the robot's, without the forces of the feet.

    Attributes:
        inner: The rows before the projection.
        stand: The feet and the ground.
    """

    inner: MotionInformation
    stand: Stand

    @property
    def model(self) -> RobotModel:
        """The robot with the joints of its base."""
        return self.inner.model

    @property
    def mapping(self) -> BaseMapping:
        """Its base parameters."""
        return self.inner.mapping

    @property
    def beta(self) -> Array:
        """Base parameters by which torques are computed, shape (b,)."""
        return self.inner.beta

    @property
    def chains(self) -> Array:
        """As of ``MotionInformation``."""
        return self.inner.chains

    @property
    def free(self) -> Array:
        """Coordinates that are designed, shape (k,)."""
        return self.stand.feet.free

    @property
    def constraints(self) -> int:
        """Number of margins."""
        return 2 * len(self.stand.ground.points) + 1

    def motion(self, free: Motion) -> Motion:
        """Return a motion of all coordinates from one of the designed ones.

        Args:
            free: A motion of the designed coordinates.
        """
        return StandingMotion(self.stand.feet, free)

    def rows(self, q: Array, v: Array, a: Array) -> MotionRows:
        """Return the rows along a motion of N samples.

        Args:
            q: Free coordinates, shape (N, k) [rad or m].
            v: Velocities, shape (N, k) [rad/s or m/s].
            a: Accelerations, shape (N, k) [rad/s^2 or m/s^2].
        """
        *motion, error = self.stand.feet.along(q, v, a)
        whole = self.inner.rows(motion[0], motion[1], motion[2])
        placed = self.stand.feet.placed(motion[0])
        P, _ = projection(self.stand.feet.jacobian(placed))
        W = np.moveaxis(P @ np.moveaxis(whole.W, 2, 0), 0, 2)
        return replace(whole, W=W, support=Support(placed, whole.W, error))

    def torque(self, rows: MotionRows) -> Array:
        """Return the torques of the joints, shape (N, 6 + n); those of the base's are 0.

        Args:
            rows: The rows.
        """
        return self._forces(rows)[1]

    def forces(self, rows: MotionRows) -> Array:
        """Return the forces of the ground on the points, shape (N, k, 3) [N].

        Args:
            rows: The rows.
        """
        return self._forces(rows)[0]

    def margins(self, rows: MotionRows) -> Array:
        """Return margins of forces and, in the last row, of the feet's places, shape (m, N).

        Args:
            rows: The rows.
        """
        support = _support(rows)
        closed = 1.0 - 1e3 * np.maximum(support.error - 1e-9, 0.0) - (support.error > 1e-9)
        return np.vstack([self.stand.ground.margins(self.forces(rows)), closed])

    def _forces(self, rows: MotionRows) -> tuple[Array, Array]:
        support = _support(rows)
        return self.stand.ground.forces(support.placed, self._before(support))

    def _before(self, support: "Support") -> Array:
        """Return the torques without forces of the ground, shape (N, 6 + n)."""
        torque: Array = (self.beta @ support.W).T
        return torque

    def gradient(
        self,
        rows: MotionRows,
        by_W: Array,
        by_torque: Array,
        by_motion: tuple[Array, Array, Array],
        by_margins: Array,
    ) -> tuple[Array, Array, Array]:
        """Return a gradient by the designed coordinates, shape (N, k) each; see ``Information``.

        Args:
            rows: The rows.
            by_W: The gradient by their entries, shape (n, b, N).
            by_torque: By the torques, shape (N, n).
            by_motion: By all coordinates and their derivatives, shape (N, n) each.
            by_margins: By the margins, shape (m, N).
        """
        support = _support(rows)
        P, back = projection(self.stand.feet.jacobian(support.placed))
        weights = np.moveaxis(by_W, 2, 0)  # (N, n, b)
        mixed = weights @ np.moveaxis(support.W, 2, 0).swapaxes(1, 2)  # (N, n, n)
        by_J = -(P @ (mixed + mixed.swapaxes(1, 2)) @ back).swapaxes(1, 2)
        by_own = np.moveaxis(P @ weights, 0, 2)
        before = self._before(support)
        by_q, by_w = self.stand.ground.pull(support.placed, before, by_torque, by_margins[:-1])
        by_q = by_q + self.stand.feet.jacobian_pulled(support.placed, by_J) + by_motion[0]
        by_own = by_own + self.beta[:, None] * by_w.T[:, None]
        inner = replace(rows, W=support.W)
        along_q, along_v, along_a = self.inner.pull(inner, by_own)
        whole = (along_q + by_q, along_v + by_motion[1], along_a + by_motion[2])
        return self.stand.feet.pull(rows.motion, whole)


@dataclass(frozen=True, eq=False)
class Support:
    """What the projected rows of a robot on its feet were computed from.

    Attributes:
        placed: Where everything is.
        W: The rows before the projection, shape (n, b, N).
        error: Largest error of the feet, shape (N,) [m, rad].
    """

    placed: Placed
    W: Array
    error: Array


def _support(rows: MotionRows) -> Support:
    support: Support = rows.support
    return support


def standing(
    model: RobotModel,
    *,
    posture: Mapping[str, float],
    lifted: Sequence[str] = (),
    soles: Mapping[str, Sequence[float]],
    friction: float,
) -> Stand:
    """Return a robot on its feet.

    Args:
        model: The robot, whose base floats, with contacts.
        posture: Positions of joints in the first posture; others are 0, or the nearest limit.
        lifted: Links of contacts that are in the air.
        soles: x0, y0, x1, y1, z of the rectangle of each flat foot, in the frame of its link [m].
        friction: Coefficient of friction that may be used [-].

    Raises:
        SettingsError: If a setting is not usable.
    """
    names = [x.frame for x in model.contacts]
    for what, stated, known in (
        ("posture", posture, model.joints), ("lifted", lifted, names), ("sole", soles, names)
    ):  # fmt: skip
        for name in stated:
            if name not in known:
                raise SettingsError(
                    f"{what} is stated for {name!r}, wanted one of {listed(known)}"
                    f"{suggestion(name, known)}"
                )
    contacts = [x for x in model.contacts if x.frame not in lifted]
    _check_contacts(model, contacts, soles)
    q = np.array([posture.get(j.name, _at_rest(j)) for j in model.limits])
    for joint, value in zip(model.limits, q.tolist(), strict=True):
        if joint.has_limits and not joint.lower <= value <= joint.upper:
            raise SettingsError(
                f"posture of {joint.name} is {value:g}, wanted {joint.lower:g} to "
                f"{joint.upper:g}, its position limits in the URDF"
            )
    upright = np.r_[np.zeros(6), 1.0, q]
    places = link_positions(
        model.pin_model, model.configurations(upright[None]), [x.frame for x in contacts]
    )[0]
    height = -float(places[:, 2].mean())
    if height <= 0.0:
        raise SettingsError(
            f"the feet are {-height:.3g} m above the base in this posture; state another one "
            "(--posture JOINT=RAD)"
        )
    whole = with_base_joints(model, height)
    middles = [_middle(x, soles) for x in contacts]
    feet = Feet(whole, contacts, np.r_[0.0, 0.0, height, np.zeros(3), q], middles)
    points = {
        contact.frame: _points(contact, frame, soles)
        for contact, frame in zip(contacts, feet.frames, strict=True)
    }
    names = [name for name, own in points.items() for _ in own]
    every = [point for own in points.values() for point in own]
    at = np.array([feet.placed(feet.posture[None]).position(point)[0, :2] for point in every])
    if np.linalg.svd(at - at.mean(axis=0), compute_uv=False)[1] < _APART:
        raise SettingsError(
            f"the points of contact of {listed(points)} are on a line, on which no robot can "
            "balance; lift fewer feet, or state another posture"
        )
    mass = model.standard_parameters()[: model.layout.n_inertial : len(INERTIAL_TERMS)].sum()
    weight = float(mass * np.linalg.norm(model.pin_model.gravity.linear))
    return Stand(model, feet, Ground(every, names, whole.velocity_map, friction, weight))


def _check_contacts(
    model: RobotModel, contacts: Sequence[Contact], soles: Mapping[str, Sequence[float]]
) -> None:
    if model.loops:
        raise SettingsError(
            f"{model.name} has loops: motions on the feet are designed for robots without loops"
        )
    for x in contacts:
        if x.kind == "surface" and x.frame not in soles:
            raise SettingsError(
                f"{x.frame} is a surface of unknown size: state its rectangle, "
                f"--sole {x.frame}=X0,Y0,X1,Y1,Z [m]"
            )
        if x.radius > 0.0:
            raise SettingsError(
                f"{x.frame} has the radius {x.radius:g} m: feet that roll are not designed for. "
                "Omit the radius in the job file of the design"
            )
    points = sum(1 if x.kind == "point" else 4 for x in contacts)
    if points < 3:
        raise SettingsError(
            f"{points} points of contact are on the ground ({listed([x.frame for x in contacts])})"
            ", wanted at least 3 points or a surface; lift fewer feet"
        )


def _at_rest(joint: Joint) -> float:
    """Return 0, or the nearest limit."""
    return float(np.clip(0.0, joint.lower, joint.upper)) if joint.has_limits else 0.0


def _middle(contact: Contact, soles: Mapping[str, Sequence[float]]) -> Array:
    """Return the middle of a contact in the frame of its link, shape (3,) [m]."""
    if contact.kind == "point":
        return np.zeros(3)
    x0, y0, x1, y1, z = soles[contact.frame]
    return np.array([(x0 + x1) / 2.0, (y0 + y1) / 2.0, z])


def _points(contact: Contact, frame: Frame, soles: Mapping[str, Sequence[float]]) -> list[Frame]:
    """Return the points of a contact that carry forces."""
    if contact.kind == "point":
        return [frame]
    x0, y0, x1, y1, z = soles[contact.frame]
    corners = [np.array([x, y, z]) for x in (x0, x1) for y in (y0, y1)]
    return [replace(frame, origin=frame.origin + frame.axes @ corner) for corner in corners]
