"""The extent of each body from the URDF's collision or visual geometry, for bounds on its mass."""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import SettingsError
from robotid.base.typing import Array
from robotid.robot.bodies import link_places
from robotid.robot.meshes import Shape, find_mesh, read_shapes, read_surfaces
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

_SIDES = 16  # of the prism around a cylinder
_MOST_FACES = 100  # a hull with more is replaced by an outer polytope with this many faces
_GROWN = 0.05  # enlargement on each side of the box of a body's geometry, over its diagonal
_GROWN_BLIND = 0.35  # the same of the box of its frames only, which have no width ...
_NARROWEST = 0.1  # ... and at least this share of the longest link
_HOUSINGS = 0.1  # of the robot's length, for the parts of a body beyond its joints


def geometry_half_spaces(model: RobotModel, shape: str) -> dict[str, tuple[Array, Array]]:
    """Return bounds on the centres of mass from the URDF's geometry."""
    if shape == "none":
        return {}
    points = body_points(model)
    if not points:
        raise SettingsError(
            f"com_within is {shape!r}, but no link has readable geometry in "
            f"{Path(model.tree.path).name}; state boxes with 'com', or omit com_within"
        )
    around = box_half_spaces if shape == "box" else hull_half_spaces
    return {body: around(cloud) for body, cloud in points.items()}


def body_points(model: RobotModel, *, with_visual: bool = False) -> dict[str, Array]:
    """Return points whose convex hull contains each body, in the frame of its moved link.

    They are those of a link's collision geometry, or of its visual one if it has none. Curved
    shapes are replaced by polyhedra around them. A body is omitted if one of its links with mass
    has no geometry, or a mesh that is not found: its mass has no bounds.

    -> (k, 3) [m].
    """
    clouds = _clouds(model.tree.robot, model.tree.path)
    if with_visual:
        visual = _visual_clouds(model.tree.robot, model.tree.path)
        clouds = {x: [*own, *visual[x]] if x in visual else own for x, own in clouds.items()}
    found: dict[str, list[Array]] = {body: [] for body in model.layout.bodies}
    open_bodies = set()
    for place in link_places(model):
        if place.body < 0:
            continue
        body = model.layout.bodies[place.body]
        parts = clouds.get(place.link, [])
        known = [points for points in parts if points is not None]
        if len(known) < len(parts) or (not known and place.parameters.any()):
            open_bodies.add(body)
        elif known:
            index = model.pin_model.getFrameId(place.link, pin.FrameType.BODY)
            placement = model.pin_model.frames[index].placement.homogeneous
            found[body].append(_moved(np.vstack(known), placement))
    return {
        body: np.vstack(parts) for body, parts in found.items() if parts and body not in open_bodies
    }


def link_clouds(model: RobotModel) -> tuple[list[tuple[str, int, Array]], list[str]]:
    """Return points whose convex hulls contain each shape of each link, in the frame of its body.

    They are those of a link's collision geometry, or of its visual one if it has none.

    -> (k, 3) [m].
    """
    shapes = _clouds(model.tree.robot, model.tree.path)
    clouds, unread = [], []
    for link in model.tree.links:
        frame = model.pin_model.frames[model.pin_model.getFrameId(link, pin.FrameType.BODY)]
        for points in shapes.get(link, []):
            if points is None:
                unread.append(link)
                continue
            points = _moved(points, frame.placement.homogeneous)
            clouds.append((link, frame.parentJoint - 1, points))
    return clouds, list(dict.fromkeys(unread))


def body_boxes(model: RobotModel) -> dict[str, Array]:
    """Return a box that contains all mass of each body, in the frame of its moved link.

    It contains the body's geometry, enlarged by 5 % of its diagonal on each side. For a body
    without geometry it contains its frames (of its joints, links and tools), enlarged by 35 % and
    at least 10 % of the robot's longest link. It also contains the URDF's body: the uniform box of
    equal mass, centre and second moments.

    -> (2, 3) [m].
    """
    bodies, frames = model.layout.bodies, body_frames(model)
    shapes, boxes = body_points(model), {}
    J = pseudo_inertia(model.standard_parameters()[: model.layout.n_inertial])
    for body, J_i in zip(bodies, J, strict=True):
        points = np.array(shapes.get(body, frames[body]))
        low, high = points.min(axis=0), points.max(axis=0)
        diagonal = float(np.linalg.norm(high - low))
        blind = max(_GROWN_BLIND * diagonal, _NARROWEST * model.length)
        grown = _GROWN * diagonal if body in shapes else blind
        low, high = low - grown, high + grown
        if J_i[3, 3] > 0:
            centre = J_i[:3, 3] / J_i[3, 3]
            half = np.sqrt(3.0 * np.maximum(np.diag(J_i)[:3] / J_i[3, 3] - centre**2, 0.0))
            low, high = np.minimum(low, centre - half), np.maximum(high, centre + half)
        boxes[body] = np.array([low, high])
    return boxes


def kinematic_lengths(model: RobotModel) -> dict[str, float]:
    """Return the length that the kinematics give each body, whether or not it has geometry.

    It is the largest distance between the body's frames (of its joints, links and tools) or from
    its joint to the one before it, and 10 % of the robot's length for housings beyond the joints.
    The travel of prismatic joints at the body is added; next to one without limits a body has no
    length here, and neither has a robot whose joints all coincide.
    """
    pins, bodies, frames = model.pin_model, model.layout.bodies, body_frames(model)
    steps = [float(np.linalg.norm(place.translation)) for place in pins.jointPlacements]
    reach = np.zeros(len(steps))  # from the root along the joints [m]
    for i, parent in enumerate(pins.parents):
        reach[i] = reach[parent] + steps[i]
    travel = np.zeros(len(steps))
    for limits in model.limits:
        if limits.name in model.layout.prismatic:
            i = pins.getJointId(limits.name)
            stroke = limits.upper - limits.lower if limits.has_limits else np.inf
            travel[[i, pins.parents[i]]] += stroke
    lengths = {}
    for i, body in enumerate(bodies, start=1):
        points = np.array(frames[body])
        span = float(np.linalg.norm(points[:, None] - points, axis=2).max())
        length = max(span, steps[i]) + float(travel[i]) + _HOUSINGS * float(reach.max())
        if 0 < length < np.inf:
            lengths[body] = length
    return lengths


def box_half_spaces(points: Array) -> tuple[Array, Array]:
    """Return the axis-parallel box around points: A c <= b, A of shape (6, 3), b of (6,) [m]."""
    A = np.vstack([np.eye(3), -np.eye(3)])
    return A, (A @ points.T).max(axis=1)


def hull_half_spaces(points: Array) -> tuple[Array, Array]:
    """Return the convex hull of points as half-spaces A c <= b: -> (f, 3), (f,) [m]."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        planes = ConvexHull(points).equations  # n^T x + o <= 0
    except QhullError:  # all points in one plane
        return box_half_spaces(points)
    planes = planes[np.unique(np.round(planes, 9), axis=0, return_index=True)[1]]
    if len(planes) <= _MOST_FACES:
        return planes[:, :3], -planes[:, 3]
    k = np.arange(_MOST_FACES) + 0.5
    polar, angle = np.arccos(1 - 2 * k / _MOST_FACES), np.pi * (1 + 5**0.5) * k
    x, y = np.cos(angle) * np.sin(polar), np.sin(angle) * np.sin(polar)
    A = np.column_stack([x, y, np.cos(polar)])
    return A, (A @ points.T).max(axis=1)


def body_frames(model: RobotModel) -> dict[str, list[Array]]:
    """Return the origins of the frames of each body (its joints, links, tools), by its name.

    -> (3,) [m].
    """
    pins, bodies = model.pin_model, model.layout.bodies
    frames: dict[str, list[Array]] = {body: [np.zeros(3)] for body in bodies}
    for frame in pins.frames:
        if frame.parentJoint > 0:
            frames[bodies[frame.parentJoint - 1]].append(frame.placement.translation)
    for i, (parent, place) in enumerate(zip(pins.parents, pins.jointPlacements, strict=True)):
        if i > 0 and parent > 0:
            frames[bodies[parent - 1]].append(place.translation)
    return frames


@lru_cache(maxsize=2)  # the meshes of a robot are read once
def _clouds(robot: ET.Element, urdf: str) -> dict[str, list[Array | None]]:
    """Return the points of each shape of each link, in its frame; None if it cannot be read.

    They are those of the collision shapes of a link, or of its visual ones if it has none.
    """
    shapes = _by_link(read_shapes(robot, "visual")) | _by_link(read_shapes(robot, "collision"))
    return {link: [_cloud(shape, Path(urdf)) for shape in own] for link, own in shapes.items()}


@lru_cache(maxsize=2)
def _visual_clouds(robot: ET.Element, urdf: str) -> dict[str, list[Array]]:
    """Return the points of each visual shape of each link that can be read, in its frame."""
    shapes, path = _by_link(read_shapes(robot, "visual")), Path(urdf)
    clouds = {link: [_cloud(shape, path) for shape in own] for link, own in shapes.items()}
    return {link: [x for x in own if x is not None] for link, own in clouds.items()}


def _by_link(shapes: Sequence[Shape]) -> dict[str, list[Shape]]:
    by_link: dict[str, list[Shape]] = {}
    for shape in shapes:
        by_link.setdefault(shape.link, []).append(shape)
    return by_link


def _cloud(shape: Shape, urdf: Path) -> Array | None:
    points = _shape_points(shape, urdf)
    return None if points is None else _moved(points, shape.placement)


def _shape_points(shape: Shape, urdf: Path) -> Array | None:
    corners: Array = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    size: Array = np.array(shape.size)
    match shape.kind:
        case "box":
            corners *= 0.5 * size
            return corners
        case "sphere":
            corners *= size[0]
            return corners
        case "cylinder":
            angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
            radius, length = size
            ring = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
            ring *= radius / np.cos(np.pi / _SIDES)
            half = 0.5 * length * np.array([0.0, 0.0, 1.0])
            return np.vstack([ring - half, ring + half])
    path = find_mesh(shape.file, urdf) if shape.kind == "mesh" else None
    if path is None:
        return None
    try:
        surfaces = read_surfaces(path)
    except ValueError:  # reported by the finding "geometry_unread"
        return None
    return np.vstack([s.vertices for s in surfaces]) * size if surfaces else None


def _moved(points: Array, H: Array) -> Array:
    moved: Array = points @ H[:3, :3].T + H[:3, 3]
    return moved
