"""The bodies of a robot: links joined by fixed or locked joints are one body."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import ModelError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.robot.model import RobotModel
from robotid.robot.parameters import (
    inertial_from_pseudo_inertia,
    pseudo_inertia,
    pseudo_inertia_basis,
)
from robotid.robot.tree import Inertial

_NEGLIGIBLE = 1e-5  # of the mass of the robot
_DRAWS = 2000  # bodies that an estimate allows


@dataclass(frozen=True)
class LinkPlace:
    """The body that a link belongs to."""

    link: str  # name of the link
    body: int  # index of its body in ``layout.bodies``; -1 if it is fixed to the world
    # "moved": the link that the body's joint moves; "fixed": joined to it by fixed joints only;
    # "held": behind a locked joint, with the URDF's inertial
    role: str
    parameters: Array  # (10,), in the body's frame; 0 without inertial

    @property
    def is_lumped(self) -> bool:
        """Whether its mass is lumped into the moved link of its body."""
        return self.body >= 0 and self.role == "fixed"


def link_places(model: RobotModel) -> tuple[LinkPlace, ...]:
    """Return the body of each link of the URDF, in the order of the file."""
    arriving = {joint.child: joint for joint in model.tree.joints}
    frames = {link: _frame(model, link) for link in model.tree.links}
    inertials = model.tree.inertials
    transfers = _transfers([frames[link] for link in inertials])
    parameters = {
        link: transfer @ inertial_parameters(inertial)
        for (link, inertial), transfer in zip(inertials.items(), transfers, strict=True)
    }
    places = []
    for link, frame in frames.items():
        body, role, at = frame.parentJoint - 1, "moved", link
        while at in arriving and (body < 0 or at != model.layout.bodies[body]):
            joint = arriving[at]
            role = "held" if joint.is_movable or role == "held" else "fixed"
            at = joint.parent
        if body >= 0 and model.assumed.get(model.layout.bodies[body]) == "inertial_units":
            role = "fixed" if role == "held" else role  # its inertial has a wrong unit, too
        places.append(LinkPlace(link, body, role, parameters.get(link, np.zeros(10))))
    return tuple(places)


def link_transfer(model: RobotModel, link: str) -> tuple[int, Array]:
    """Return the body of a link, and the map (10, 10) of parameters from its frame to that."""
    if link not in model.tree.links:
        raise ModelError(
            f"link {link!r} is not in {Path(model.tree.path).name}; links: "
            f"{listed(model.tree.links, 30)}"
        )
    frame = _frame(model, link)
    return frame.parentJoint - 1, _transfers([frame])[0]


def _frame(model: RobotModel, link: str) -> pin.Frame:
    frame: pin.Frame = model.pin_model.frames[model.pin_model.getFrameId(link, pin.FrameType.BODY)]
    return frame


def _transfers(frames: Sequence[pin.Frame]) -> Array:
    """Return the map of ``link_transfer`` of k frames, shape (k, 10, 10)."""
    # a homogeneous matrix H transforms a pseudo-inertia to H J H^T, also without mass
    H = np.array([frame.placement.homogeneous for frame in frames]).reshape(-1, 1, 4, 4)
    moved: Array = H @ pseudo_inertia_basis() @ H.swapaxes(-1, -2)
    return inertial_from_pseudo_inertia(moved).swapaxes(-1, -2)


def held_parameters(model: RobotModel) -> Array:
    """Return the share of links behind locked joints, which keep the URDF's, (10 bodies,)."""
    held = np.zeros((len(model.layout.bodies), 10))
    for place in link_places(model):
        if place.body >= 0 and place.role == "held":
            held[place.body] += place.parameters
    return held.reshape(-1)


def inertial_parameters(inertial: Inertial) -> Array:
    """Return the ten inertial parameters of a link about its own frame, shape (10,)."""
    ixx, ixy, ixz, iyy, iyz, izz = inertial.inertia
    moments = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    R = pin.rpy.rpyToMatrix(*inertial.rpy)
    m, c = inertial.mass, np.array(inertial.com)
    about_origin = R @ moments @ R.T + m * (c @ c * np.eye(3) - np.outer(c, c))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = about_origin.tolist()
    return np.array([m, *(m * c), xx, xy, yy, xz, yz, zz])


def negligible_bodies(model: RobotModel) -> tuple[str, ...]:
    """Return the consistent bodies of negligible mass, as between the axes of a ball joint."""
    J = pseudo_inertia(model.standard_parameters()[: model.layout.n_inertial])
    mass, least = J[:, 3, 3], np.linalg.eigvalsh(J)[:, 0]
    is_negligible = (least > 0.0) & (mass <= _NEGLIGIBLE * mass.sum())
    return tuple(np.array(model.layout.bodies)[is_negligible].tolist())


def central_inertial(parameters: Array) -> Inertial:
    """Return mass, centre of mass and inertia about it from ten parameters in the link's frame."""
    m, c = float(parameters[0]), parameters[1:4] / parameters[0]
    xx, xy, yy, xz, yz, zz = parameters[4:]
    about_origin = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    I = about_origin - m * (c @ c * np.eye(3) - np.outer(c, c))  # (3, 3), Steiner  # noqa: E741
    moments = tuple(I[np.triu_indices(3)].tolist())  # ixx ixy ixz iyy iyz izz
    return Inertial(m, tuple(c.tolist()), (0.0, 0.0, 0.0), moments)


def principal_moments(parameters: Array) -> tuple[Array, Array]:
    """Return the second moments (3,) about the centre along the principal axes, and these."""
    H = np.column_stack([np.eye(3), -parameters[1:4] / parameters[0]])  # to the centre
    moments, axes = np.linalg.eigh(H @ pseudo_inertia(parameters)[0] @ H.T)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return moments, axes


def least_density(parameters: Array) -> float:
    """Return the smallest density that mass and second moments allow, an ellipsoid's [kg/m^3]."""
    mass = float(parameters[0])
    if mass <= 0:
        return 0.0
    # the moments of a homogeneous ellipsoid with semi-axes a are m a^2 / 5
    axes = np.sqrt(5.0 * np.maximum(principal_moments(parameters)[0], 0.0) / mass)  # (3,) [m]
    volume = 4.0 / 3.0 * np.pi * float(np.prod(axes))
    return mass / volume if volume > 0 else float("inf")


def density_share(
    parameters: Array, covariance: Array, density: float, rng: np.random.Generator
) -> float:
    """Return the share of the consistent bodies that the errors allow that need at most a density.

    With J the pseudo-inertia, ``least_density`` is m^3 / (4/3 pi 5^1.5 sqrt(det J)).
    """
    values, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))
    drawn = parameters + rng.standard_normal((_DRAWS, 10)) @ root.T
    J = pseudo_inertia(drawn.ravel())
    is_body = np.linalg.eigvalsh(J)[:, 0] > 0
    needed = drawn[is_body, 0] ** 3 / np.sqrt(np.linalg.det(J[is_body]))
    within = needed <= 4.0 / 3.0 * np.pi * 5.0**1.5 * density
    return float(within.mean()) if is_body.any() else 0.0


def usual_links(model: RobotModel) -> tuple[str, ...]:
    """Return the link that has the payload unless stated: the last one, or a floating base."""
    return model.layout.bodies[:1] if model.free_flyer else model.layout.bodies[-1:]
