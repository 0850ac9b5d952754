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
_WELD = 1e-6  # corners this near are one, over the size of the largest surface
_FIRST_CELL = 1 / 4000  # the same where there are far too many: those of one cell of a grid ...
_CHEAP = 0.5  # share of the edges that a pass may collapse
_RIM = 20.0  # weight of the rim of a surface over that of the surface
_FINE = 4  # ... until so many times too many triangles are left


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one colour.

    Attributes:
        vertices: Corners, shape (V, 3) [m].
        faces: Triangles as indices of corners, shape (F, 3).
        rgba: Colour, shape (4,), 0 to 1; None if the file states none.
        is_closed: Whether it, with the other colours of its file, is known to have an inside.
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


def thin(solids: Sequence[Sequence[Surface]], most: int) -> list[list[Surface]]:
    """Return surfaces with so few triangles together: closed where they were, edges kept sharp.

    Edges are collapsed, those first that change the shape least; an edge that becomes a point
    opens no hole. The triangles of a surface turn the same way, outwards where it is closed, and
    each side of a sharp edge has a corner of its own.

    Args:
        solids: The surfaces of each file of a robot, all in one scale; those of one file are
            patches of one surface.
        most: Triangles that may be left of all of them.

    References:
        Garland, Heckbert (1997), Surface simplification using quadric error metrics.
    """
    patches = [surface for solid in solids for surface in solid]
    if not patches:
        return [[] for _ in solids]
    solid = np.repeat(np.arange(len(solids)), [len(s) for s in solids])  # of each patch
    whole = _joined(patches)
    patch = np.repeat(np.arange(len(patches)), [len(s.faces) for s in patches])
    of_vertex = np.repeat(solid, [len(s.vertices) for s in patches])
    cell = _WELD * (float(np.ptp(whole.vertices, axis=0).max()) or 1.0)
    which, V = _cells(whole.vertices, of_vertex, cell)
    F, patch = _proper(which[whole.faces], patch)
    F = _oriented(V, F)
    of_vertex = np.bincount(which, of_vertex) / np.bincount(which)
    Q = _quadrics(V, F, patch)
    cell *= _FIRST_CELL / _WELD
    while len(F) > _FINE * most:  # collapsing half a million would take too long
        which, V = _cells(V, of_vertex, cell)
        F, patch = _proper(which[F], patch)
        of_vertex = np.bincount(which, of_vertex) / np.bincount(which)
        Q = np.column_stack([np.bincount(which, x) for x in Q.reshape(-1, 16).T])
        Q = Q.reshape(-1, 4, 4)
        V = _lowest(Q, V, np.full(len(V), cell))
        cell *= min(max(np.sqrt(len(F) / (_FINE * most)), 1.2), 2.0)
    V, F, patch = _collapsed(V, F, patch, Q, most)
    is_open = np.unique(solid[patch[_open_faces(F)]])
    left = [
        _creased(Surface(V, F[patch == k], p.rgba, solid[k] not in is_open))
        for k, p in enumerate(patches)
    ]
    return [[s for s, k in zip(left, solid, strict=True) if k == i] for i in range(len(solids))]


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


def _cells(V: Array, solid: Array, cell: float) -> tuple[Array, Array]:
    """Return the cell of its solid's grid that each corner lies in, and the mean of each cell."""
    keys = solid.astype(np.int64)
    for column in np.floor((V - V.min(axis=0)) / cell + 0.5).astype(np.int64).T:
        _, keys = np.unique(keys * (column.max() + 1) + column, return_inverse=True)
    count = np.bincount(keys)
    return keys, np.column_stack([np.bincount(keys, x) / count for x in V.T])


def _proper(F: Array, patch: Array) -> tuple[Array, Array]:
    """Return the triangles that are none of a line, one of those on the same three corners."""
    F, patch = (x[(np.roll(F, 1, axis=1) != F).all(axis=1)] for x in (F, patch))
    _, first = np.unique(_keys(np.sort(F, axis=1)), return_index=True)
    first.sort()
    return F[first], patch[first]


def _keys(rows: Array) -> Array:
    """Return one number for each row of indices."""
    n = np.int64(rows.max(initial=0) + 1)  # below 2 million, whose cube is a number yet
    key = rows[:, 0].astype(np.int64)
    for column in rows.T[1:]:
        key = key * n + column
    return key


def _edges(F: Array) -> tuple[Array, Array, Array]:
    """Return the sides (3 F, 2) of triangles, their faces, and whether they were turned to sort."""
    ends = np.stack([F, np.roll(F, -1, axis=1)], axis=2).reshape(-1, 2)
    turned = ends[:, 0] > ends[:, 1]
    ends = np.where(turned[:, None], ends[:, ::-1], ends)
    order = np.argsort(_keys(ends), kind="stable")
    return ends[order], order // 3, turned[order]


def _open_faces(F: Array) -> Array:
    """Return the triangles with a side that is not that of one other, which runs it backwards."""
    ends, face, turned = _edges(F)
    starts = np.flatnonzero(np.r_[True, (ends[1:] != ends[:-1]).any(axis=1)])
    sides = np.diff(np.r_[starts, len(ends)])
    senses = np.add.reduceat(turned.astype(int), starts)
    open_faces: Array = face[np.repeat((sides != 2) | (senses != 1), sides)]
    return open_faces


def _oriented(V: Array, F: Array) -> Array:
    """Return the triangles with one sense of turning on each connected surface, outwards."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends, face, turned = _edges(F)
    same = (ends[1:] == ends[:-1]).all(axis=1)
    alone = ~np.r_[False, same[:-1]] & same & ~np.r_[same[1:], False]  # two faces, no third
    k = np.flatnonzero(alone)
    f, g, odd = face[k], face[k + 1], turned[k] == turned[k + 1]  # neighbours turn an edge apart
    n = len(F)  # f stands for a face as it is, f + n for its reverse
    rows, columns = np.r_[f, f + n], np.r_[g + n * odd, g + n * ~odd]
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * n, 2 * n))
    _, part = connected_components(graph, directed=False)
    corners = V[F] - V[F].mean(axis=(0, 1))
    volume = np.linalg.det(corners) / 6  # of the tetrahedron to the middle
    sums = np.bincount(part, np.r_[volume, -volume])
    reverse = (part[:n] != part[n:]) & (sums[part[:n]] < sums[part[n:]])
    return np.where(reverse[:, None], F[:, ::-1], F)


def _collapsed(V: Array, F: Array, patch: Array, Q: Array, most: int) -> tuple[Array, Array, Array]:
    """Return corners and triangles after so many edges became points that few enough are left."""
    careful = True
    while len(F) > most:
        sides, face, _ = _edges(F)
        first = np.r_[True, (sides[1:] != sides[:-1]).any(axis=1)]
        ends = sides[first]
        place, cost = _best_places(V, Q, ends)
        chosen = _apart(len(V), F, ends, cost, (np.cumsum(first) - 1)[np.argsort(face)])
        if careful:
            chosen = chosen[_is_simple(len(V), ends, chosen)]
            chosen = chosen[~_folds(V, F, ends[chosen], place[chosen])]
            careful = len(chosen) > 0.002 * len(ends)  # or nothing is left that could be done well
        chosen = chosen[: (len(F) - most + 1) // 2]
        keep, drop = ends[chosen].T
        V, which = V.copy(), np.arange(len(V))
        V[keep], which[drop] = place[chosen], keep
        Q[keep] += Q[drop]
        F, patch = _proper(which[F], patch)
    return V, F, patch


def _apart(n: int, F: Array, ends: Array, cost: Array, sides: Array) -> Array:
    """Return the edges that cost less than all of the triangles at their ends, in order of cost.

    Args:
        n: Number of corners.
        F: Triangles, shape (F, 3).
        ends: Corners of each edge, shape (E, 2).
        cost: What each costs, shape (E,).
        sides: The edges of the triangles, three by three, shape (3 F,).
    """
    order = np.argsort(cost)
    rank = np.empty(len(ends), dtype=np.int64)
    rank[order] = np.arange(len(ends))
    lowest = rank[sides.reshape(-1, 3)].min(axis=1)  # of each triangle
    about = np.full(n, len(ends))
    np.minimum.at(about, F.ravel(), np.repeat(lowest, 3))
    taken = (about[ends] == rank[:, None]).all(axis=1) & (rank < _CHEAP * len(ends))
    apart: Array = order[taken[order]]
    return apart


def _is_simple(n: int, ends: Array, chosen: Array) -> Array:
    """Return which edges can be points without laying two triangles upon each other."""
    from scipy.sparse import coo_array

    both = np.vstack([ends, ends[:, ::-1]])
    near = coo_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(n, n)).tocsr()
    shared = near[ends[chosen, 0]].multiply(near[ends[chosen, 1]]).sum(axis=1)
    is_simple: Array = np.asarray(shared).ravel() <= 2  # the tips of its triangles
    owner = np.full(n, -1)
    owner[ends[chosen].ravel()] = np.repeat(np.arange(len(chosen)), 2)
    pairs = np.sort(owner[ends], axis=1)  # of chosen edges that another edge joins
    pairs = pairs[(pairs[:, 0] >= 0) & (pairs[:, 0] < pairs[:, 1])]
    _, first, count = np.unique(_keys(pairs), return_index=True, return_counts=True)
    is_simple[pairs[first[count > 1], 1]] = False  # two do: the dearer one waits
    return is_simple


def _quadrics(V: Array, F: Array, patch: Array) -> Array:
    """Return the quadric (4, 4) of each corner: squared distance to its triangles' planes."""
    from scipy.sparse import coo_array

    n = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])  # (F, 3), twice the area
    area = np.linalg.norm(n, axis=1)
    n /= np.maximum(area, 1e-30)[:, None]
    ends, face, _ = _edges(F)
    same = (ends[1:] == ends[:-1]).all(axis=1) & (patch[face[1:]] == patch[face[:-1]])
    rim = ~(np.r_[False, same] | np.r_[same, False])  # of a surface, or of a colour
    along = V[ends[rim, 1]] - V[ends[rim, 0]]
    across = np.cross(along, n[face[rim]])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    normals, weights = np.vstack([n, across]), np.r_[area, _RIM * (along**2).sum(axis=1)]
    on = np.r_[V[F[:, 0]], V[ends[rim, 0]]]
    plane = np.column_stack([normals, -(normals * on).sum(axis=1)])  # (P, 4)
    K = weights[:, None, None] * plane[:, :, None] * plane[:, None, :]
    rows = np.r_[F.T.ravel(), ends[rim].T.ravel()]
    columns = np.r_[np.tile(np.arange(len(F)), 3), np.tile(np.arange(len(F), len(K)), 2)]
    S = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(V), len(K)))
    Q: Array = (S.tocsr() @ K.reshape(-1, 16)).reshape(-1, 4, 4)
    return Q


def _best_places(V: Array, Q: Array, ends: Array) -> tuple[Array, Array]:
    """Return where each edge becomes a point, shape (E, 3), and the quadric there."""
    q = Q[ends[:, 0]] + Q[ends[:, 1]]
    one, other = V[ends[:, 0]], V[ends[:, 1]]
    length = np.linalg.norm(other - one, axis=1)
    place = _lowest(q, (one + other) / 2, length)
    x = np.column_stack([place, np.ones(len(place))])
    cost = ((q @ x[:, :, None])[:, :, 0] * x).sum(axis=1)
    # on a plane all cost nothing: short edges first, and not all those side by side
    spread = 1.0 + (0.618034 * np.arange(len(ends))) % 1.0
    size = q[:, 0, 0] + q[:, 1, 1] + q[:, 2, 2]
    return place, np.maximum(cost, 0.0) + 1e-8 * size * length**2 * spread


def _lowest(Q: Array, near: Array, far: Array) -> Array:
    """Return the places of the least quadrics, shape (E, 3), those not too far from others."""
    A, b = Q[:, :3, :3], Q[:, :3, 3]
    size = A[:, 0, 0] + A[:, 1, 1] + A[:, 2, 2] + 1e-30
    slope = (A @ near[:, :, None])[:, :, 0] + b
    firm = A + 1e-6 * size[:, None, None] * np.eye(3)  # along a plane they stay where they are
    step = -np.linalg.solve(firm, slope[:, :, None])[:, :, 0]
    long = np.linalg.norm(step, axis=1) / np.maximum(far, 1e-30)
    places: Array = near + step / np.maximum(long, 1.0)[:, None]
    return places


def _folds(V: Array, F: Array, ends: Array, place: Array) -> Array:
    """Return which collapses would turn a triangle over."""
    moved, edge, which = V.copy(), np.full(len(V), -1), np.arange(len(V))
    moved[ends.ravel()] = np.repeat(place, 2, axis=0)
    edge[ends.ravel()] = np.repeat(np.arange(len(ends)), 2)
    which[ends[:, 1]] = ends[:, 0]
    left = F[(which[F] != np.roll(which[F], 1, axis=1)).all(axis=1)]
    before, after = (
        np.cross(P[left[:, 1]] - P[left[:, 0]], P[left[:, 2]] - P[left[:, 0]]) for P in (V, moved)
    )
    sizes = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    over = (before * after).sum(axis=1) < 0.2 * sizes
    guilty = edge[left[over]].ravel()
    folds = np.zeros(len(ends), dtype=bool)
    folds[guilty[guilty >= 0]] = True
    return folds


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
