"""The robot as scene of the viewer: joints as nodes, meshes or a skeleton as their parts."""

import itertools
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from robotid.base.typing import Array
from robotid.output.pages.html import packed, stepped
from robotid.robot.geometry import Shape, Surface, find_mesh, joined, read_shapes, read_surfaces
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

_TRIANGLES = 20_000  # of all meshes as they are drawn: at most 0.9 MB in the page
_LINK, _JOINT, _BASE = "#9aa7b4", "#e07b1f", "#4a5560"
_THICKNESS = 0.035  # radius of a link over the robot's reach
_SHORT = 1e-4  # [m] joints closer than this are one point
_UP = np.array([0.0, 1.0, 0.0])  # the viewer's axis of a cylinder
#: Where a mesh is, its scale, and when it was written and how long it is; None if there is none.
_File = tuple[Path | None, tuple[float, ...], tuple[int, int] | None]


@dataclass(frozen=True, eq=False)
class Scene:
    """The scene, in plain values for JSON, lengths in m."""

    # ``nodes``: one per joint, the first fixed to the world, each with its parent, its pose at 0
    # and its kind of motion; ``parts``: shapes on nodes; ``meshes``: triangles that parts share;
    # ``reach``: the size of the robot
    content: dict[str, Any]
    notes: tuple[str, ...]  # shapes that are not drawn, as sentences
    # points on each node whose hull contains its parts, shape (k, 3) each [m]
    corners: tuple[Array, ...]


def robot_scene(model: RobotModel) -> Scene:
    """Return nodes and parts: visual shapes of the links, or capsules and drums without any."""
    tree = model.pin_model
    parts, meshes, boxes, missing = _visuals(model)
    notes: tuple[str, ...] = ()
    if missing:
        words = "meshes were not found or are not readable, for example"
        notes = (f"{len(missing)} {words} {missing[0]}",)
    for i in sorted({*range(tree.njoints)} - {part["node"] for part in parts}):
        parts += _skeleton(model, i)
    content = {
        "nodes": [_node(model, i) for i in range(tree.njoints)],
        "parts": parts,
        "meshes": meshes,
        "reach": _reach(model),
    }
    corners = [[np.zeros((1, 3))] for _ in range(tree.njoints)]
    for part in parts:
        corners[part["node"]].append(_corners(part, boxes))
    return Scene(content, notes, tuple(map(np.vstack, corners)))


def coordinates(model: RobotModel, q: Array) -> Array:
    """Return the displacements of the nodes of a scene: q (N, n) [rad, m] -> (N, nv) [rad, m]."""
    base, first = (7, 6) if model.free_flyer else (0, 0)
    G = model.velocity_map[first:, first:]
    moved: Array = np.hstack([q[:, :base], q[:, base:] @ G.T + model.position_offset[first:]])
    return moved


def mass_marks(model: RobotModel, pi: Array, label: str) -> dict[str, Any]:
    """Return the centre of mass and the equimomental ellipsoid of each body: pi (p,)."""
    J = pseudo_inertia(pi[: model.layout.n_inertial])
    bodies = [
        {"node": i, "name": body, **ellipsoid(own)}
        for i, (body, own) in enumerate(zip(model.layout.bodies, J, strict=True), start=1)
    ]
    return {"label": label, "bodies": bodies}


def ellipsoid(J: Array) -> dict[str, Any]:
    """Return mass, centre of mass and equimomental ellipsoid of a pseudo-inertia (4, 4), as plain.

    The second moments about the centre of mass, Sigma_c = Sigma - m c c', are those of a solid
    ellipsoid of uniform density whose semi-axes have the lengths sqrt(5 s_i / m), s_i the
    eigenvalues of Sigma_c.

    References:
        Wensing, Kim, Slotine (2018), Linear matrix inequalities for physically consistent
        inertial parameter identification, section IV.
    """
    m, place = float(J[3, 3]), {"com": None, "semi_axes": None, "quaternion": [0.0, 0.0, 0.0, 1.0]}
    if not m > 0:
        return {"mass": m, **place, "fault": "no mass" if m == 0 else "negative mass"}
    c = J[:3, 3] / m
    s, axes = np.linalg.eigh(J[:3, :3] - m * np.outer(c, c))
    place["com"] = c.tolist()
    if s[0] < -1e-12 * float(np.trace(J[:3, :3])):  # beyond rounding
        return {"mass": m, **place, "fault": "no solid has this inertia"}
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    place["semi_axes"] = np.sqrt(5.0 * np.maximum(s, 0.0) / m).tolist()
    place["quaternion"] = pin.Quaternion(axes).coeffs().tolist()
    return {"mass": m, **place, "fault": ""}


def _visuals(
    model: RobotModel,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], list[Array], list[str]]:
    """Return the parts of a robot, its meshes, each once, their boxes (2, 3), and missing files."""
    parts, meshes, boxes, missing = list[dict[str, Any]](), list[dict[str, Any]](), [], []
    visuals = [v for v in read_shapes(model.tree.robot) if v.kind]
    # each mesh once at each scale, with the current file
    uses = Counter((v.file, v.size) for v in visuals if v.kind == "mesh")
    files = {(v.file, v.size): _file(model, v) for v in visuals if v.kind == "mesh"}
    thinned = _thinned(tuple(files.values()), tuple(uses[key] for key in files))
    numbers: dict[tuple[str, tuple[float, ...]], list[tuple[int, Surface]]] = {}
    for key, surfaces in zip(files, thinned, strict=True):
        if not surfaces:
            missing.append(key[0])
        numbers[key] = [*enumerate(surfaces, len(meshes))]
        for surface in surfaces:
            boxes.append(np.array([surface.vertices.min(0), surface.vertices.max(0)]))
            kind = "<u2" if len(surface.vertices) <= 2**16 else "<u4"
            meshes.append(
                {"vertices": stepped(surface.vertices), "faces": packed(surface.faces, kind),
                 "closed": surface.is_closed}
            )  # fmt: skip
    for visual in visuals:
        parts += _visual_parts(model, visual, numbers.get((visual.file, visual.size), []))
    return parts, meshes, boxes, missing


def _file(model: RobotModel, visual: Shape) -> _File:
    path = find_mesh(visual.file, model.tree.path)
    stamp = None if path is None else os.stat(path)
    return path, visual.size, stamp and (stamp.st_mtime_ns, stamp.st_size)


@lru_cache(maxsize=4)  # thinning needs seconds, and a robot has many pages
def _thinned(files: tuple[_File, ...], uses: tuple[int, ...]) -> list[list[Surface]]:
    """Return each file's scaled surfaces, thinned for a page; none if it is not readable."""
    solids, sizes = [], []
    for path, scale, _ in files:
        try:
            patches = () if path is None else read_surfaces(path)
        except ValueError:
            patches = ()
        solids.append([replace(s, vertices=s.vertices * np.array(scale)) for s in patches])
        sizes.append(sum(len(s.faces) for s in patches))
    drawn = int(np.dot(sizes, uses))  # files of four equal legs count four times
    return thin(solids, _TRIANGLES * sum(sizes) // max(drawn, 1))


def _visual_parts(
    model: RobotModel, visual: Shape, which: Sequence[tuple[int, Surface]]
) -> Iterator[dict[str, Any]]:
    tree = model.pin_model
    frame = tree.frames[tree.getFrameId(visual.link, pin.FrameType.BODY)]
    M = frame.placement.homogeneous @ visual.placement
    if visual.kind == "cylinder":  # of a URDF: along z
        M = M @ _from_y_axis(np.array([0.0, 0.0, 1.0]), np.zeros(3))
    if visual.kind == "mesh":
        for k, surface in which:
            yield _part(frame.parentJoint, "mesh", [k], _hex(surface.rgba or visual.rgba), M)
    else:
        yield _part(frame.parentJoint, visual.kind, visual.size, _hex(visual.rgba), M)


def _corners(part: Mapping[str, Any], boxes: Sequence[Array]) -> Array:
    """Return the corners of the box about a part, in the frame of its node, shape (8, 3)."""
    size, shape = part["size"], part["shape"]
    if shape == "mesh":
        low, high = boxes[size[0]]
    else:
        diameters = {"sphere": [2 * size[0]] * 3, "cylinder": [2 * size[0], size[-1], 2 * size[0]]}
        high = np.array(diameters.get(shape, size)) / 2
        low = -high
    box = np.array(list(itertools.product(*zip(low, high, strict=True))))
    M = np.array(part["matrix"]).reshape(4, 4).T
    moved: Array = box @ M[:3, :3].T + M[:3, 3]
    return moved


def _part(
    node: int, shape: str, size: Sequence[float], colour: str, placement: Array
) -> dict[str, Any]:
    return {
        "node": node,
        "shape": shape,
        "size": list(size),
        "colour": colour,
        "matrix": placement.T.ravel().tolist(),  # by columns
    }


def _hex(rgba: Sequence[float] | None) -> str:
    if rgba is None:
        return _LINK
    return "#" + "".join(f"{round(255 * x):02x}" for x in rgba[:3])


def _node(model: RobotModel, i: int) -> dict[str, Any]:
    tree = model.pin_model
    M = tree.jointPlacements[i]
    kind, axis = _movement(model, i)
    column = tree.joints[i].idx_v + int(model.free_flyer) if kind != "fixed" else -1
    return {
        "name": tree.names[i],
        "parent": int(tree.parents[i]) if i else -1,
        "position": np.array(M.translation).tolist(),
        "quaternion": pin.Quaternion(M.rotation).coeffs().tolist(),
        "kind": kind,
        "axis": axis,
        "column": 0 if kind == "free" else column,
    }


def _movement(model: RobotModel, i: int) -> tuple[str, list[float]]:
    """Return the kind of joint: fixed, free, revolute or prismatic; and its own axis."""
    if i == 0:
        return "fixed", []
    kind = model.pin_model.joints[i]
    if kind.nv != 1:
        return "free", []
    data = kind.createData()
    kind.calc(data, pin.neutral(model.pin_model), np.zeros(model.pin_model.nv))
    S = np.array(data.S).reshape(6)
    return ("revolute", S[3:].tolist()) if S[3:].any() else ("prismatic", S[:3].tolist())


def _skeleton(model: RobotModel, joint: int) -> Iterator[dict[str, Any]]:
    radius = _THICKNESS * _reach(model)
    skin = _LINK if joint else _BASE
    for end in _ends(model, joint):
        length = float(np.linalg.norm(end))
        if length > _SHORT:
            along = _from_y_axis(end / length, end / 2)
            yield _part(joint, "cylinder", [0.7 * radius, length], skin, along)
        yield _part(joint, "sphere", [0.7 * radius], skin, _from_y_axis(_UP, end))
    kind, axis = _movement(model, joint)
    if kind in ("revolute", "prismatic"):
        drum = _from_y_axis(np.array(axis), np.zeros(3))
        yield _part(joint, "cylinder", [radius, 2.6 * radius], _JOINT, drum)
    elif joint == 0 and not model.free_flyer:
        foot = _from_y_axis(np.array([0.0, 0.0, 1.0]), np.zeros(3))
        yield _part(joint, "cylinder", [2 * radius, 0.6 * radius], skin, foot)


def _ends(model: RobotModel, joint: int) -> list[Array]:
    """Return the end points of a joint's links: its children, or its farthest fixed frame."""
    tree = model.pin_model
    if joint == 0 and model.free_flyer:
        return []
    children = [k for k in range(1, tree.njoints) if tree.parents[k] == joint]
    if children:
        return [np.array(tree.jointPlacements[k].translation) for k in children]
    frames = [np.array(f.placement.translation) for f in tree.frames if f.parentJoint == joint]
    farthest = max(frames, key=np.linalg.norm, default=np.zeros(3))
    is_point = np.linalg.norm(farthest) < _SHORT
    return [np.array(tree.inertias[joint].lever) if is_point else farthest]


def _reach(model: RobotModel) -> float:
    """Return the longest path from the root along the joints [m]; 0.1 or more."""
    tree = model.pin_model
    paths = [0.0] * tree.njoints
    for i in range(1, tree.njoints):
        length = np.linalg.norm(tree.jointPlacements[i].translation)
        paths[i] = paths[tree.parents[i]] + float(length)
    return max(0.1, *paths)


def _from_y_axis(axis: Array, position: Array) -> Array:
    """Return the pose that maps the y axis, the viewer's axis of a cylinder, to an axis."""
    M = np.eye(4)
    M[:3, :3] = pin.Quaternion.FromTwoVectors(_UP, axis).toRotationMatrix()
    M[:3, 3] = position
    return M


_CREASE = np.radians(30.0)  # angle between two faces beyond which their edge is sharp
# whether rims are preserved, and growth rate of the error bound, until few enough remain
_ATTEMPTS = ((True, 3.0), (False, 3.0), (False, 7.0))


def thin(solids: Sequence[Sequence[Surface]], most: int) -> list[list[Surface]]:
    """Return surfaces with at most so many triangles in total; closed ones stay closed.

    fast-simplification collapses edges in the order of the change of shape; a collapsed edge opens
    no hole. The triangles of a surface have one orientation, outwards if it is closed. Each side of
    a sharp edge has its own corners.

    References:
        Garland, Heckbert (1997), Surface simplification using quadric error metrics.
    """
    share = most / max(sum(len(patch.faces) for solid in solids for patch in solid), 1)
    return [_thinned_solid(solid, share) if solid else [] for solid in solids]


def _thinned_solid(patches: Sequence[Surface], share: float) -> list[Surface]:
    import trimesh

    whole = joined(patches)
    size = float(np.ptp(whole.vertices, axis=0).max()) or 1.0
    patch = np.repeat(np.arange(len(patches)), [len(surface.faces) for surface in patches])
    mesh = trimesh.Trimesh(whole.vertices / size, whole.faces, process=False)
    mesh.merge_vertices()
    is_proper = mesh.unique_faces() & mesh.nondegenerate_faces()
    mesh.update_faces(is_proper)
    if not len(mesh.faces):
        return []
    faces, patch = _oriented(mesh), patch[is_proper]
    parts = [_simplified(mesh.vertices, faces[patch == k], share) for k in range(len(patches))]
    together: Any = trimesh.util.concatenate(parts)
    together.merge_vertices()
    is_closed = together.is_watertight and together.is_winding_consistent
    surfaces = []
    for part, surface in zip(parts, patches, strict=True):
        if len(part.faces):
            smooth = trimesh.graph.smooth_shade(part, angle=_CREASE, facet_minarea=None)
            vertices, triangles = size * smooth.vertices, np.asarray(smooth.faces)
            surfaces.append(Surface(vertices, triangles, surface.rgba, is_closed))
    return surfaces


def _simplified(V: Array, F: Array, share: float) -> Any:  # noqa: ANN401
    """Return a share of a patch's triangles, for a size of 1; its rim is kept if few remain."""
    import fast_simplification
    import trimesh

    most = int(share * len(F))
    if len(F) > most:
        used, F = np.unique(F, return_inverse=True)
        V, F = np.ascontiguousarray(V[used]), F.reshape(-1, 3).astype(np.int32)
        for keeps_rims, step in _ATTEMPTS:
            places, faces = fast_simplification.simplify(
                V, F, target_count=most, preserve_border=keeps_rims, agg=step
            )
            if len(faces) <= most:
                break
        V, F = places, faces
    mesh = trimesh.Trimesh(V, F, process=False)
    mesh.merge_vertices()
    mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces())
    return mesh


def _oriented(mesh: Any) -> Array:  # noqa: ANN401
    """Return the triangles with one orientation on each connected surface, outwards."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    F, (f, g), n = np.asarray(mesh.faces), mesh.face_adjacency.T, len(mesh.faces)
    first, second = mesh.face_adjacency_edges.T[:, :, None]
    forward = [((F[k] == first) & (np.roll(F[k], -1, axis=1) == second)).any(1) for k in (f, g)]
    opposed = forward[0] == forward[1]  # orientations of the neighbours
    # f is a face as it is, f + n its reverse
    rows, columns = np.r_[f, f + n], np.r_[g + n * opposed, g + n * ~opposed]
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * n, 2 * n))
    _, part = connected_components(graph, directed=False)
    volume = np.linalg.det(mesh.triangles - mesh.vertices.mean(axis=0)) / 6
    sums = np.bincount(part, np.r_[volume, -volume])
    reverse = (part[:n] != part[n:]) & (sums[part[:n]] < sums[part[n:]])
    return np.where(reverse[:, None], F[:, ::-1], F)
