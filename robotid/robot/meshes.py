"""The visual and collision shapes of a URDF, and its meshes."""

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import MissingDependencyError
from robotid.base.typing import Array
from robotid.robot.examples import example_urdfs
from robotid.robot.urdf_text import LARGEST, numbers

_FORMATS = (".stl", ".dae", ".obj", ".ply", ".off", ".glb", ".gltf")
_MOST_BYTES = 2**28  # of a mesh; that of a link has about 2**20

GREY = (0.6, 0.65, 0.7, 1.0)  # of shapes without colour


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one colour.

    Attributes:
        vertices: Corners, shape (V, 3) [m].
        faces: Triangles as indices of corners, shape (F, 3).
        rgba: Colour, shape (4,), 0 to 1; None if the file states none.
        is_closed: Whether it is known to be closed, together with the other colours of its file.
    """

    vertices: Array
    faces: Array
    rgba: tuple[float, ...] | None
    is_closed: bool = False


@dataclass(frozen=True, eq=False)
class Shape:
    """One ``<visual>`` or ``<collision>`` of a link.

    Attributes:
        link: Name of the link.
        placement: Pose in the link's frame, shape (4, 4).
        kind: "mesh", "box", "cylinder" or "sphere"; "" if it is another one or not valid.
        size: Scale of a mesh [-]; edges of a box, radius and length of a cylinder, radius of a
            sphere [m].
        file: File name of the mesh in the URDF; empty if it is not a mesh.
        rgba: Colour that the URDF states, shape (4,), 0 to 1; None if it states none.
    """

    link: str
    placement: Array
    kind: str
    size: tuple[float, ...]
    file: str
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
    """Return the file of a mesh, None if there is none.

    A relative path, or one with ``package://``, is searched in ROS_PACKAGE_PATH, in the URDF's
    folder and its parents, and in example-robot-data, with the name of its package and without it.
    A path in a package with ".." is not accepted. Folders, pipes and devices are not meshes.
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
        # the folder may be that of the package under another name
        if is_package and without and os.path.isfile(folder / without):
            return folder / without
    return None


def read_surfaces(path: Path) -> tuple[Surface, ...]:
    """Read a mesh: STL, DAE, OBJ, PLY, OFF or glTF."""
    if path.suffix.lower() not in _FORMATS:
        raise ValueError(f"{path.name} is not a mesh, wanted {', '.join(_FORMATS)}")
    # the readers of the formats raise errors of every kind
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"the file has more than {_MOST_BYTES // 2**20} MiB")
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
                raise ValueError(f"a corner is not finite, or beyond {LARGEST:g} m")
            by_colour.setdefault(rgba, []).append(surface)
    return tuple(joined(surfaces) for surfaces in by_colour.values())


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
    starts = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    faces = [s.faces + start for s, start in zip(surfaces, starts, strict=True)]
    vertices = np.vstack([s.vertices for s in surfaces])
    return Surface(vertices, np.vstack(faces), surfaces[0].rgba)
