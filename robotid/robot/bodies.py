"""The bodies of a robot: links joined by fixed or locked joints; their shapes and extents."""

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import MissingDependencyError, ModelError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.robot.examples import example_urdfs
from robotid.robot.model import RobotModel
from robotid.robot.parameters import (
    inertial_from_pseudo_inertia,
    pseudo_inertia,
    pseudo_inertia_basis,
)
from robotid.robot.tree import LARGEST, Inertial, numbers

_NEGLIGIBLE = 1e-5  # of the mass of the robot
_DRAWS = 2000  # bodies that an estimate allows
_FORMATS = (".stl", ".dae", ".obj", ".ply", ".off", ".glb", ".gltf")
_MOST_BYTES = 2**28  # of a mesh; that of a link has about 2**20

_SIDES = 16  # of the prism around a cylinder
_GROWN = 0.05  # enlargement on each side of the box of a body's geometry, over its diagonal
_GROWN_BLIND = 0.35  # the same of the box of its frames only, which have no width
#: Share of the robot's length that a body extends at least beyond its frames, on each side.
BEYOND_FRAMES = 0.1


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
    return parameters_about(inertial.mass, np.array(inertial.com), R @ moments @ R.T)


def parameters_about(mass: float, com: Array, inertia: Array) -> Array:
    """Return the ten parameters of a body from its inertia (3, 3) about its centre of mass."""
    return np.asarray(pin.Inertia(mass, com, inertia).toDynamicParameters())


def negligible_bodies(model: RobotModel) -> tuple[str, ...]:
    """Return the consistent bodies of negligible mass, as between the axes of a ball joint."""
    J = pseudo_inertia(model.standard_parameters()[: model.layout.n_inertial])
    mass, least = J[:, 3, 3], np.linalg.eigvalsh(J)[:, 0]
    is_negligible = (least > 0.0) & (mass <= _NEGLIGIBLE * mass.sum())
    return tuple(np.array(model.layout.bodies)[is_negligible].tolist())


def central_inertial(parameters: Array) -> Inertial:
    """Return mass, centre of mass and inertia about it from ten parameters in the link's frame."""
    body = pin.Inertia.FromDynamicParameters(parameters)
    moments = tuple(body.inertia[np.triu_indices(3)].tolist())  # ixx ixy ixz iyy iyz izz
    return Inertial(float(body.mass), tuple(body.lever.tolist()), (0.0, 0.0, 0.0), moments)


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
    """Return the share of the bodies within the errors that need at most a density [-]."""
    values, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))
    drawn = parameters + rng.standard_normal((_DRAWS, 10)) @ root.T
    J = pseudo_inertia(drawn.ravel())
    is_body = np.linalg.eigvalsh(J)[:, 0] > 0  # ``least_density``: m^3 / (4/3 pi 5^1.5 sqrt(det J))
    needed = drawn[is_body, 0] ** 3 / np.sqrt(np.linalg.det(J[is_body]))
    within = needed <= 4.0 / 3.0 * np.pi * 5.0**1.5 * density
    return float(within.mean()) if is_body.any() else 0.0


def usual_links(model: RobotModel) -> tuple[str, ...]:
    """Return the link that has the payload unless stated: the last one, or a floating base."""
    return model.layout.bodies[:1] if model.free_flyer else model.layout.bodies[-1:]


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one colour."""

    vertices: Array  # corners, shape (V, 3) [m]
    faces: Array  # triangles as indices of corners, shape (F, 3)
    rgba: tuple[float, ...] | None  # colour, shape (4,), 0 to 1; None if the file states none
    is_closed: bool = False  # whether it is known to be, with the other colours of its file


@dataclass(frozen=True, eq=False)
class Shape:
    """One ``<visual>`` or ``<collision>`` of a link."""

    link: str  # name of the link
    placement: Array  # pose in the link's frame, shape (4, 4)
    kind: str  # "mesh", "box", "cylinder" or "sphere"; "" if it is another one or not valid
    # scale of a mesh [-]; edges of a box, radius and length of a cylinder, radius of a sphere [m]
    size: tuple[float, ...]
    file: str  # file name of the mesh in the URDF; empty if it is not a mesh
    # colour that the URDF states, shape (4,), 0 to 1; None if it states none
    rgba: tuple[float, ...] | None


def read_shapes(robot: ET.Element, tag: str = "visual") -> tuple[Shape, ...]:
    """Return the shapes in a URDF, in the order of the file."""
    colours = {m.get("name"): _colour(m) for m in robot.findall("material")}
    found = []
    for link in robot.findall("link"):
        for element in link.findall(tag):
            material = element.find("material")
            rgba = None
            if material is not None:
                rgba = _colour(material) or colours.get(material.get("name"))
            placement, known = _placement(element.find("origin"))
            kind, size, file = _geometry(element) if known else ("", (), "")
            found.append(Shape(link.get("name", ""), placement, kind, size, file, rgba))
    return tuple(found)


def find_mesh(name: str, urdf: str | Path) -> Path | None:
    """Return the file of a mesh, None if there is none; not folders, pipes and devices."""
    plain = name.removeprefix("file://")
    is_package = re.match(r"(package|model)://", name) is not None
    inside = re.sub(r"^(package|model)://", "", name).lstrip("/")
    if plain != name or (not is_package and Path(name).is_absolute()):
        return Path(plain) if os.path.isfile(plain) else None
    if is_package and ".." in Path(inside).parts:
        return None
    _, _, without = inside.partition("/")
    # the folder may be that of the package under another name
    ends = [inside, without] if is_package and without else [inside]
    paths = (folder / end for folder in _folders(Path(urdf)) for end in ends)
    return next(filter(os.path.isfile, paths), None)  # unlike Path.is_file, it never raises


def read_surfaces(path: Path) -> tuple[Surface, ...]:
    """Read a mesh: STL, DAE, OBJ, PLY, OFF or glTF."""
    import trimesh

    if path.suffix.lower() not in _FORMATS:
        raise ValueError(f"{path.name} is not a mesh, expected {', '.join(_FORMATS)}")
    by_colour: dict[tuple[float, ...] | None, list[Surface]] = {}
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"the file has more than {_MOST_BYTES // 2**20} MiB")
        scene = trimesh.load_scene(path)
        metres = 1.0
        if path.suffix.lower() == ".dae":  # the one format that states its unit
            metres = float(trimesh.units.unit_conversion(scene.units or "meters", "meters"))
        for mesh in scene.dump():
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
                rgba = _mesh_colour(mesh.visual)
                surface = Surface(metres * np.asarray(mesh.vertices), np.asarray(mesh.faces), rgba)
                if not np.abs(surface.vertices).max(initial=0.0) <= LARGEST:
                    raise ValueError(f"a corner is not finite, or beyond {LARGEST:g} m")
                by_colour.setdefault(rgba, []).append(surface)
    except Exception as error:  # the readers of the formats raise errors of every kind
        raise ValueError(f"{path.name} cannot be read: {error}") from error
    return tuple(joined(surfaces) for surfaces in by_colour.values())


def _folders(urdf: Path) -> Iterator[Path]:
    yield from (Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p)
    yield from urdf.resolve().parents
    yield from _example_folders()


@lru_cache
def _example_folders() -> tuple[Path, ...]:
    """Return the folders that contain the packages of example-robot-data, if it is installed."""
    try:
        parents = {folder for path in example_urdfs() for folder in path.parents}
    except MissingDependencyError:
        return ()
    roots = sorted(folder for folder in parents if folder.name == "robots")
    return tuple(folder for root in roots for folder in (root.parent.parent, root))


def _geometry(element: ET.Element) -> tuple[str, tuple[float, ...], str]:
    """Return the kind, size and file of a shape."""
    for shape in element.iterfind("geometry/*"):
        get = shape.get
        match shape.tag:
            case "mesh":
                size = numbers(get("scale", "1 1 1"), 3)
            case "box":
                size = numbers(get("size", ""), 3)
            case "cylinder":
                size = numbers(f"{get('radius', '')} {get('length', '')}", 2)
            case "sphere":
                size = numbers(get("radius", ""), 1)
            case _:
                continue
        if size and (shape.tag != "mesh" or get("filename")):
            return shape.tag, size, get("filename", "")
    return "", (), ""


def _colour(material: ET.Element) -> tuple[float, ...] | None:
    colour = material.find("color")
    rgba = () if colour is None else numbers(colour.get("rgba", ""), 4)
    return tuple(min(max(x, 0.0), 1.0) for x in rgba) or None


def _placement(origin: ET.Element | None) -> tuple[Array, bool]:
    """Return the pose, shape (4, 4), and whether it is valid."""
    M = np.eye(4)
    pose = {} if origin is None else origin.attrib
    xyz, rpy = (numbers(pose.get(key, "0 0 0"), 3) for key in ("xyz", "rpy"))
    known = bool(xyz and rpy)
    if known:
        M[:3, :3], M[:3, 3] = pin.rpy.rpyToMatrix(*rpy), xyz
    return M, known


def _mesh_colour(visual: Any) -> tuple[float, ...] | None:  # noqa: ANN401
    """Return the colour of trimesh's visual: of its material, or the mean of its corners."""
    if visual.kind == "texture":
        colour = visual.material.main_color
    elif visual.kind in ("face", "vertex"):
        colour = getattr(visual, f"{visual.kind}_colors").mean(axis=0)
    else:
        return None
    return tuple(round(float(x) / 255.0, 3) for x in colour)


def joined(surfaces: Sequence[Surface]) -> Surface:
    """Return surfaces as one, of the first one's colour."""
    from trimesh.util import append_faces

    vertices, faces = append_faces([s.vertices for s in surfaces], [s.faces for s in surfaces])
    return Surface(vertices, faces, surfaces[0].rgba)


def body_points(model: RobotModel, *, with_visual: bool = False) -> dict[str, Array]:
    """Return points whose hull contains each body with known geometry, (k, 3) [m], its frame."""
    clouds, unread = link_clouds(model)
    seen = {link for link, *_ in clouds}
    if with_visual:
        visual, unseen = link_clouds(model, ("visual",))
        clouds += [cloud for cloud in visual if cloud[0] in seen]
        unread += unseen
    points = {k: [x for _, body, x in clouds if body == k] for _, k, _ in clouds}
    for place in link_places(model):
        if place.link in unread or (place.link not in seen and place.parameters.any()):
            points.pop(place.body, None)
    bodies = enumerate(model.layout.bodies)
    return {body: np.vstack(points[k]) for k, body in bodies if k in points}


def link_clouds(
    model: RobotModel, tags: tuple[str, ...] = ("visual", "collision")
) -> tuple[list[tuple[str, int, Array]], list[str]]:
    """Return link, body and points (k, 3) [m] whose hull contains a shape, and unreadable links."""
    shapes = _clouds(model.tree.robot, model.tree.path, tags)
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
    """Return a box (2, 3) [m] around each body's enlarged geometry or frames, and URDF's body."""
    bodies, frames = model.layout.bodies, body_frames(model)
    shapes, boxes = body_points(model), {}
    J = pseudo_inertia(model.standard_parameters()[: model.layout.n_inertial])
    for body, J_i in zip(bodies, J, strict=True):
        points = np.array(shapes.get(body, frames[body]))
        low, high = points.min(axis=0), points.max(axis=0)
        diagonal = float(np.linalg.norm(high - low))
        blind = max(_GROWN_BLIND * diagonal, BEYOND_FRAMES * model.length)
        grown = _GROWN * diagonal if body in shapes else blind
        low, high = low - grown, high + grown
        if J_i[3, 3] > 0:
            centre = J_i[:3, 3] / J_i[3, 3]
            half = np.sqrt(3.0 * np.maximum(np.diag(J_i)[:3] / J_i[3, 3] - centre**2, 0.0))
            low, high = np.minimum(low, centre - half), np.maximum(high, centre + half)
        boxes[body] = np.array([low, high])
    return boxes


def kinematic_lengths(model: RobotModel) -> dict[str, float]:
    """Return the length that the kinematics give each body, if finite and not 0 [m].

    It is the largest distance between its frames, or to the joint before it, plus the travel of
    prismatic joints at the body, and 10 % of the robot's length for housings beyond the joints.
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
        length = max(span, steps[i]) + float(travel[i]) + BEYOND_FRAMES * float(reach.max())
        if 0 < length < np.inf:
            lengths[body] = length
    return lengths


def body_frames(model: RobotModel) -> dict[str, list[Array]]:
    """Return the origins (3,) [m] of the frames of each body: its joints, links and tools."""
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
def _clouds(robot: ET.Element, urdf: str, tags: tuple[str, ...]) -> dict[str, list[Array | None]]:
    """Return the points of each link's shapes of its last tag; None if a shape cannot be read."""
    by_link: dict[str, list[Shape]] = {}
    for tag in tags:
        groups = groupby(read_shapes(robot, tag), key=attrgetter("link"))
        by_link |= {link: list(shapes) for link, shapes in groups}
    return {
        link: [_shape_points(shape, Path(urdf)) for shape in shapes]
        for link, shapes in by_link.items()
    }


def _shape_points(shape: Shape, urdf: Path) -> Array | None:
    """Return the corners of a polyhedron around a shape, in the frame of its link."""
    points: Array = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    size: Array = np.array(shape.size)
    if shape.kind == "box":
        points *= 0.5 * size
    elif shape.kind == "sphere":
        points *= size
    elif shape.kind == "cylinder":
        radius, length = size
        angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
        ring = np.column_stack([np.cos(angle), np.sin(angle)]) * radius / np.cos(np.pi / _SIDES)
        points = np.vstack([np.insert(ring, 2, z, axis=1) for z in (-0.5 * length, 0.5 * length)])
    else:
        path = find_mesh(shape.file, urdf) if shape.kind == "mesh" else None
        try:
            surfaces = () if path is None else read_surfaces(path)
        except ValueError:  # reported by the finding "geometry_unread"
            return None
        if not surfaces:
            return None
        points = np.vstack([s.vertices for s in surfaces]) * size
    return _moved(points, shape.placement)


def _moved(points: Array, H: Array) -> Array:
    return np.asarray(points @ H[:3, :3].T + H[:3, 3])
