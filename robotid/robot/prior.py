"""What is assumed of a robot before its logs: boxes for missing inertials, plausible deviations."""

from collections import Counter
from dataclasses import replace
from itertools import compress
from types import MappingProxyType

import numpy as np

from robotid.base.tolerances import SLACK, TINY
from robotid.base.typing import Array
from robotid.robot.bodies import (
    BEYOND_FRAMES,
    body_frames,
    body_points,
    held_parameters,
    link_places,
    negligible_bodies,
)
from robotid.robot.drive_term import DriveMotion
from robotid.robot.mass_matrix import carried_inertia
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia, pseudo_inertia
from robotid.robot.tree import SMALLEST_LENGTH

_SMALLEST_MASS = 0.1  # of the mean mass: deviation of a link's mass even if its URDF states 0
_POSITIONS = 16  # of a revolution at which terms that depend on the position are evaluated
_FAINTEST = 1e-6  # smallest RMS of a column
#: Why the inertial of a body is assumed, by the code of the finding.
REASONS = MappingProxyType({
    "missing_inertial": "no <inertial> with a mass",
    "not_positive_definite": "an inertia that no body can have",
    "default_inertial": "the placeholder that other links have, too",
    "inertial_units": "masses or lengths in another unit than kg and m",
})  # fmt: skip
_DENSITY = 1000.0  # [kg/m^3] without a body to take it from
_COPIES = 3  # identical isotropic inertials are placeholders
# medians over the bodies of all robots in example-robot-data: at most 2e4 kg/m^3 and 7
_DENSEST = 5e4  # [kg/m^3] over the box of a body's frames; with masses in g 1e5 and more
FARTHEST = 30.0  # RMS distance of the mass from the joint over that box; in mm 160 and more


def prior_spread(model: RobotModel, squares: Array, samples: int) -> Array:
    """Return the prior standard deviation of each standard parameter, (p,): squares (3, n_rows).

    That of a body is its mass m, m r and m r^2, with r the distance of the centre of mass plus the
    radius of gyration. That of a drive term is rms(tau) over the RMS of its column; for an armature
    at least the inertia of the bodies about its joint.
    """
    rms = np.sqrt(squares / max(samples, 1))
    return np.concatenate([_inertial_spread(model), _drive_spread(model, rms)])


def payload_spread(model: RobotModel) -> Array:
    """Return the prior deviations (10,) of a payload: the robot's mass at its longest link."""
    masses = model.standard_parameters()[: model.layout.n_inertial : 10]
    mass, radius = max(float(np.abs(masses).sum()), 1e-3), model.length
    return mass * np.array([1.0, *[radius] * 3, *[radius**2] * 6])


def _inertial_spread(model: RobotModel) -> Array:
    size = model.layout.n_inertial
    J = pseudo_inertia(model.standard_parameters()[:size])
    mean = max(float(np.mean(J[:, 3, 3])), 1e-6)
    mass = np.maximum(np.abs(J[:, 3, 3]), _SMALLEST_MASS * mean)
    gyration = np.sqrt(np.abs(np.trace(J[:, :3, :3], axis1=1, axis2=2)) / mass)
    radius = np.linalg.norm(J[:, :3, 3], axis=1) / mass + gyration
    radius = np.maximum(radius, BEYOND_FRAMES * model.length)
    by_term = np.column_stack([radius**0, *[radius] * 3, *[radius**2] * 6])
    return np.ravel(mass[:, None] * by_term)


def _drive_spread(model: RobotModel, rms: Array) -> Array:
    rms = rms[:, -len(model.joints) :]
    largest = rms.max(axis=1, keepdims=True)
    tau, v, a = np.maximum(rms, np.where(largest > 0.0, 1e-3 * largest, 1.0))  # never 0
    carried = carried_inertia(model)
    q = np.linspace(-np.pi, np.pi, _POSITIONS, endpoint=False)[:, None]
    typical = DriveMotion(*np.broadcast_arrays(q, v, a, np.ones(()), tau, tau * a / v))
    spread = []
    for d, term in model.layout.drive_parameters:
        size = np.sqrt(np.mean(term.column(typical) ** 2, axis=0))
        alone = tau / np.maximum(size, _FAINTEST)
        rows = [model.joints.index(joint) for joint, _ in model.layout.drives[d].ratios]
        spread.append((np.maximum(carried, alone) if term.is_inertia else alone)[rows].mean())
    return np.array(spread)


def with_assumed_inertials(model: RobotModel) -> RobotModel:
    """Return the robot with uniform boxes for the bodies that the URDF states in no usable way.

    The box is that of the body's geometry, or of its frames if it has none; its density is the
    median of the other bodies, or 1000 kg/m^3. An inertia that no body can have keeps mass and
    centre. A massless body between the axes of a ball joint remains as it is.
    """
    size, bodies = model.layout.n_inertial, model.layout.bodies
    pi = model.standard_parameters()[:size]
    held = held_parameters(model)  # of links behind locked joints
    J = pseudo_inertia(pi - held)
    frames = body_frames(model)
    points = {body: np.array(frames[body]) for body in bodies}
    half_width = BEYOND_FRAMES * model.length
    boxes = {body: _grown(points[body], half_width) for body in bodies}
    # the frames of a few bodies do not indicate their size
    size_of = {body: boxes[body][1] for body in bodies}
    if len(bodies) < _COPIES:
        shapes = body_points(model)
        size_of = {x: np.maximum(size_of[x], np.ptp(shapes[x], axis=0)) for x in shapes}
    reasons = _reasons(model, J, size_of)
    if not reasons:
        return model
    if "inertial_units" in reasons.values():
        model = replace(model, assumed=reasons)
        held = held_parameters(model)
    geometry = body_points(model)
    boxes |= {body: _grown(geometry[body], 0.0) for body in bodies if body in geometry}
    volumes = np.array([np.prod(boxes[body][1]) for body in bodies])
    trusted = np.array([body not in reasons for body in bodies]) & (J[:, 3, 3] > 0)
    density = np.median((J[:, 3, 3] / volumes)[trusted]) if trusted.any() else _DENSITY
    for k, body in enumerate(bodies):
        if body not in reasons:
            continue
        is_axis = body not in geometry and not np.ptp(points[body], axis=0).any()
        is_axis &= k + 1 in list(model.pin_model.parents)  # it carries another body
        if reasons[body] == "missing_inertial" and is_axis and trusted.any():
            del reasons[body]
            continue
        centre, sides = boxes[body]
        mass = float(density * volumes[k])
        if reasons[body] == "not_positive_definite":
            mass = float(J[k, 3, 3])
            stated = J[k, :3, 3] / mass
            centre = stated if (np.abs(stated - centre) <= sides).all() else centre
        J[k, :3, :3] = mass * (np.diag(sides**2) / 12.0 + np.outer(centre, centre))
        J[k, :3, 3] = J[k, 3, :3] = mass * centre
        J[k, 3, 3] = mass
    if not reasons:
        return model
    filled = model.with_parameters(inertial_from_pseudo_inertia(J).reshape(-1) + held)
    return replace(filled, assumed=reasons)


def assumed_masses(model: RobotModel) -> tuple[str, ...]:
    """Return the bodies whose mass is assumed: the URDF's is no evidence."""
    return tuple(x for x, code in model.assumed.items() if code != "not_positive_definite")


def _reasons(model: RobotModel, J: Array, sides: dict[str, Array]) -> dict[str, str]:
    """Return the code of each body that is not usable: J (n, 4, 4), sides of its box (3,) [m]."""
    bodies = model.layout.bodies
    mass, least = J[:, 3, 3], np.linalg.eigvalsh(J)[:, 0]
    codes = dict.fromkeys(bodies, "")
    codes |= {body: "default_inertial" for body in _placeholders(model)}
    is_impossible, has_mass = least < -SLACK * np.trace(J, axis1=1, axis2=2), mass > 0
    codes |= dict.fromkeys(compress(bodies, is_impossible), "not_positive_definite")
    codes |= dict.fromkeys(compress(bodies, ~has_mass), "missing_inertial")
    centre = np.linalg.norm(J[:, :3, 3], axis=1) / np.maximum(mass, TINY)
    codes |= dict.fromkeys(compress(bodies, centre > FARTHEST * body_sizes(J)), "inertial_units")
    sized = [k for k, body in enumerate(bodies) if mass[k] > 0 and body in sides]
    if sized:
        size = np.array([sides[bodies[k]] for k in sized])
        density = np.median(mass[sized] / size.prod(axis=1))
        second = np.abs(np.trace(J[sized, :3, :3], axis1=1, axis2=2)) / mass[sized]
        distance = np.median(np.sqrt(second) / np.linalg.norm(size, axis=1))
        if density > _DENSEST or distance > FARTHEST:
            codes |= dict.fromkeys(compress(bodies, has_mass), "inertial_units")
    negligible = negligible_bodies(model)  # as between the axes of a ball joint
    return {body: code for body, code in codes.items() if code and body not in negligible}


def body_sizes(J: Array) -> Array:
    """Return the radius of gyration of bodies, at least the side of a cube of water, (n,) [m]."""
    mass = np.maximum(J[:, 3, 3], TINY)
    squares = np.trace(J[:, :3, :3], axis1=1, axis2=2) / mass
    squares -= np.sum(J[:, :3, 3] ** 2, axis=1) / mass**2
    return np.asarray(np.sqrt(np.maximum(squares, np.cbrt(mass / _DENSITY) ** 2)))


def _placeholders(model: RobotModel) -> set[str]:
    """Return the bodies all of whose links with mass have an isotropic inertial of many links."""
    values = {
        link: (inertial.mass, inertial.inertia[0])
        for link, inertial in model.tree.inertials.items()
        if inertial.inertia == tuple(inertial.inertia[0] * x for x in (1, 0, 0, 1, 0, 1))
    }
    by_body: dict[int, list[str]] = {}
    for place in link_places(model):
        if place.body >= 0 and place.role != "held" and place.parameters[0] > 0:
            by_body.setdefault(place.body, []).append(place.link)
    moving = {link for links in by_body.values() for link in links}
    shared = Counter(value for link, value in values.items() if link in moving)
    # two links are enough where every centre of mass is on a joint, as without an <origin>
    least = _COPIES if any(np.any(model.tree.inertials[x].com) for x in moving) else 2
    return {
        model.layout.bodies[k]
        for k, links in by_body.items()
        if all(link in values and shared[values[link]] >= least for link in links)
    }


def _grown(points: Array, half_width: float) -> tuple[Array, Array]:
    """Return centre and sides of the box around points, enlarged on each side [m]."""
    low, high = points.min(axis=0), points.max(axis=0)
    return 0.5 * (low + high), np.maximum(high - low + 2.0 * half_width, SMALLEST_LENGTH)
