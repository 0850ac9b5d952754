"""What a robot looks like: the shapes in its URDF, meshes found, read and thinned."""

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.exceptions import MissingDependencyError
from robotid.robot.examples import example_urdfs
from robotid.robot.urdf_text import LARGEST, numbers

__all__ = ["Shape", "Surface", "find_mesh", "read_shapes", "read_surfaces", "thin"]

_FORMATS = (".stl", ".dae", ".obj", ".ply", ".off", ".glb", ".gltf")
_MOST_BYTES = 2**28  # of a mesh; a link's has 2**20

GREY = (0.6, 0.65, 0.7, 1.0)  # what has no colour
_CREASE = np.radians(30.0)  # faces that meet at a sharper angle than this show an edge
_FIRST_CELL = 1 / 4000  # size of the first cells over that of the largest surface


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one colour.

    Attributes:
        vertices: Corners, shape (V, 3) [m].
        faces: Triangles as indices of corners, shape (F, 3).
        rgba: Colour, shape (4,), 0 to 1; None if the file states none.
    """

    vertices: Array
    faces: Array
    rgba: tuple[float, ...] | None


@dataclass(frozen=True, eq=False)
class Shape:
    """One ``<visual>`` or ``<collision>`` of a link.

    Attributes:
        link: Name of the link.
        placement: Pose in the link's frame, shape (4, 4).
        kind: "mesh", "box", "cylinder" or "sphere"; "" if it is not understood.
        size: Scale of a mesh [-]; edges of a box, radius and length of a cylinder, radius of a
            sphere [m].
        file: What the URDF calls the mesh; empty if it is none.
        rgba: Colour that the URDF states, shape (4,), 0 to 1; None if it states none.
    """

    link: str
    placement: Array
    kind: str
    size: tuple[float, ...]
    file: str
    rgba: tuple[float, ...] | None


def read_shapes(robot: ET.Element, tag: str = "visual") -> tuple[Shape, ...]:
    """Return the shapes in a URDF, in the order of the file.

    Args:
        robot: The ``<robot>`` of the file.
        tag: Which of them: "visual" or "collision".
    """
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
    """Return the file of a mesh, None if there is none.

    A path with ``package://`` or none is looked for in ROS_PACKAGE_PATH, in the URDF's folder and
    those above it, and in example-robot-data, with the name of its package and without it; a path
    in a package does not leave it by "..". Folders, pipes and devices are no meshes.

    Args:
        name: What the URDF calls it.
        urdf: The URDF file.
    """
    if name.startswith("file://"):
        path = Path(name.removeprefix("file://"))
        return path if os.path.isfile(path) else None
    is_package = re.match(r"(package|model)://", name) is not None
    inside = re.sub(r"^(package|model)://", "", name).lstrip("/")
    whole = Path(name)
    if not is_package and whole.is_absolute():
        return whole if os.path.isfile(whole) else None
    if is_package and ".." in Path(inside).parts:
        return None
    _, _, without = inside.partition("/")
    for folder in _folders(Path(urdf)):
        if os.path.isfile(folder / inside):  # unlike Path.is_file, it never raises
            return folder / inside
        # the folder may be that of the package, whatever it is called here
        if is_package and without and os.path.isfile(folder / without):
            return folder / without
    return None


def read_surfaces(path: Path) -> tuple[Surface, ...]:
    """Read a mesh: STL, DAE, OBJ, PLY, OFF or glTF.

    Args:
        path: The file.

    Returns:
        Its surfaces [m], none if it holds no triangles.

    Raises:
        ValueError: If the file cannot be read, is larger than 256 MiB, or a corner of it is no
            finite place.
    """
    if path.suffix.lower() not in _FORMATS:
        raise ValueError(f"{path.name} is no mesh, wanted {', '.join(_FORMATS)}")
    # the readers of the formats raise errors of every kind
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"it has more than {_MOST_BYTES // 2**20} MiB")
        return _read_surfaces(path)
    except Exception as error:
        raise ValueError(f"{path.name} cannot be read: {error}") from error


def _read_surfaces(path: Path) -> tuple[Surface, ...]:
    import trimesh

    scene = trimesh.load_scene(path)
    metres = 1.0
    if path.suffix.lower() == ".dae":  # the one format that states its unit
        metres = float(trimesh.units.unit_conversion(scene.units or "meters", "meters"))
    by_colour: dict[tuple[float, ...] | None, list[Surface]] = {}
    for mesh in scene.dump():
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            rgba = _mesh_colour(mesh.visual)
            surface = Surface(metres * np.asarray(mesh.vertices), np.asarray(mesh.faces), rgba)
            if not np.abs(surface.vertices).max(initial=0.0) <= LARGEST:
                raise ValueError("a corner lies nowhere, or too far away")
            by_colour.setdefault(rgba, []).append(surface)
    return tuple(_joined(surfaces) for surfaces in by_colour.values())


def thin(surfaces: Sequence[Surface], most: int) -> list[Surface]:
    """Return surfaces with so few triangles together, edges kept sharp.

    Corners within a cell of a cube grid become one, at their mean; the cells grow until few
    enough triangles are left, so no corner moves farther than the diagonal of a cell. Each side
    of a sharp edge has a corner of its own.

    Args:
        surfaces: The surfaces of a robot, all in one scale.
        most: Triangles that may be left of all of them.
    """
    extents = [float(np.ptp(s.vertices, axis=0).max()) for s in surfaces if len(s.faces)]
    cell = _FIRST_CELL * (max(extents, default=0.0) or 1.0)
    left = [_clustered(surface, 1e-3 * cell) for surface in surfaces]  # joins equal corners
    while sum(len(s.faces) for s in left) > most:
        left = [_clustered(surface, cell) for surface in surfaces]
        # at most as many triangles as go with the square of the cell
        cell *= min(max(np.sqrt(sum(len(s.faces) for s in left) / most), 1.2), 2.0)
    return [_creased(surface) for surface in left]


def _folders(urdf: Path) -> Iterator[Path]:
    yield from (Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p)
    yield from urdf.resolve().parents
    try:
        urdfs = example_urdfs()
    except MissingDependencyError:
        return
    roots = {folder for path in urdfs for folder in path.parents if folder.name == "robots"}
    for root in sorted(roots):
        yield root.parent.parent
        yield root


def _geometry(element: ET.Element) -> tuple[str, tuple[float, ...], str]:
    """Return the kind, size and file of what a shape shows."""
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
    """Return the pose, shape (4, 4), and whether it is understood."""
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


def _joined(surfaces: Sequence[Surface]) -> Surface:
    starts = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    faces = [s.faces + start for s, start in zip(surfaces, starts, strict=True)]
    vertices = np.vstack([s.vertices for s in surfaces])
    return Surface(vertices, np.vstack(faces), surfaces[0].rgba)


def _clustered(surface: Surface, cell: float) -> Surface:
    """Return a surface whose corners within a cell are one; triangles without area are dropped."""
    corner = np.floor((surface.vertices - surface.vertices.min(axis=0)) / cell).astype(np.int64)
    sides = corner.max(axis=0) + 1
    key = (corner[:, 0] * sides[1] + corner[:, 1]) * sides[2] + corner[:, 2]
    _, which, count = np.unique(key, return_inverse=True, return_counts=True)
    sums = [np.bincount(which, surface.vertices[:, k]) for k in range(3)]
    faces = which[surface.faces]
    flat = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    faces = faces[~flat]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return replace(surface, vertices=np.column_stack(sums) / count[:, None], faces=faces[first])


def _creased(surface: Surface) -> Surface:
    """Return a surface that has a corner for each side of a sharp edge, so that it shows."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    V, F = surface.vertices, surface.faces
    normal = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    corner = np.arange(3 * len(F)).reshape(-1, 3)  # corner k of face f is 3 f + k
    ends = np.stack([np.roll(F, -k, axis=1) for k in (0, 1)], axis=2).reshape(-1, 2)
    pairs = np.stack([np.roll(corner, -k, axis=1) for k in (0, 1)], axis=2).reshape(-1, 2)
    turned = ends[:, 0] > ends[:, 1]
    ends[turned], pairs[turned] = ends[turned, ::-1], pairs[turned, ::-1]
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends, pairs = ends[order], pairs[order]
    meets = (ends[1:] == ends[:-1]).all(axis=1)  # two faces on one edge
    one, other = pairs[:-1][meets], pairs[1:][meets]
    smooth = (normal[one[:, 0] // 3] * normal[other[:, 0] // 3]).sum(axis=1) > np.cos(_CREASE)
    rows, columns = one[smooth].ravel(), other[smooth].ravel()
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(3 * len(F), 3 * len(F)))
    count, which = connected_components(graph, directed=False)
    vertices = np.empty((count, 3))
    vertices[which] = V[F.ravel()]
    return replace(surface, vertices=vertices, faces=which.reshape(-1, 3))
