"""Replay of a motion: the robot in Meshcat's viewer, with torques and parameters, as one page.

Meshcat's own export needs a server process. Here the page contains the viewer and its data, so
no process, socket or port is needed.
"""

import itertools
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import write_text
from robotid.base.settings import is_number, require_each, require_kind
from robotid.base.typing import Array, real_numbers
from robotid.data.units import LONG_STEP
from robotid.output.pages.html import asset, packed, scaffold, script_json, stepped
from robotid.robot.bodies import Shape, Surface, find_mesh, joined, read_shapes, read_surfaces
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
    words = "meshes were not found or are not readable, for example"
    notes = (f"{len(missing)} {words} {missing[0]}",) if missing else ()
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
    eigenvalues of Sigma_c (Wensing, Kim, Slotine 2018, section IV).
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

    fast-simplification collapses edges in the order of the change of shape, which opens no hole.
    Triangles point outwards; each side of a sharp edge has its own corners. Garland, Heckbert
    (1997), Surface simplification using quadric error metrics.
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


_ASSETS = Path(__file__).parent / "assets"
_SCRIPTS = (
    *("data", "scene", "masses", "arcs", "strip", "choice", "plots"),
    *("clock", "picking", "controls", "embed", "start"),
)
_NUMBERS = 500_000  # of a motion, or of all plots: about 3 MB
_BINS = 480  # columns of the heat strip
_PLOT_RATE = 50.0  # [Hz] points of a plot per second
_DATA_RANGE = 100  # poses that determine the camera's view
_GAP = 0.25  # [s] a longer time without samples is a gap ...


@dataclass(frozen=True, eq=False)
class Torques:
    """Torques to plot with a motion, or positions of position-controlled drives."""

    t: Array  # (N,), times on the clock of the motion [s]
    measured: Array  # (N, n) [N m or N]
    # predicted torques by the name of the model, (N, n) each, NaN where there is no prediction;
    # arcs, links and the heat strip show the residual of the first, until another is selected
    predicted: Mapping[str, Array] = field(default_factory=dict)
    # scale of the residuals, (n,): the RMS residual of each joint on the fitted logs of the first
    # model, the RMS torque if None; of positions, the RMS error of the command
    noise: Array | None = None
    quantity: str = "torque"  # or "position", whose units are the joints' [rad or m]


@dataclass(frozen=True, eq=False)
class Bands:
    """Parameters over time, from a recursive estimator."""

    t: Array  # (K,), times on the clock of the motion [s]
    names: Sequence[str]  # of the b parameters, as ``forearm.mcx``
    units: Sequence[str]
    theta: Array  # (K, b), values
    std_error: Array  # (K, b)


@dataclass(frozen=True)
class Mark:
    """An event on the time line."""

    t: float  # on the clock of the motion [s]
    label: str
    kind: str = "note"  # "payload", "gap", "note", or "validation", at which the page starts
    joint: str = ""  # the affected joint, if any


@dataclass(frozen=True, eq=False)
class Replay:
    """A page that plays a motion; a notebook shows it as the value of a cell."""

    data: Mapping[str, Any]  # content of the page, in plain values

    @cached_property
    def html(self) -> str:
        """The page."""
        return page(self.data)

    def write(self, target: str | Path) -> Path:
        """Write the page."""
        return write_text(self.html, target)

    def _repr_html_(self) -> str:
        # its scripts have no access to the notebook
        return (
            f'<iframe title="{escape(self.data["title"])}: replay" sandbox="allow-scripts" '
            f'srcdoc="{escape(self.html)}" style="width: 100%; height: 620px; border: 0"></iframe>'
        )


def replay(
    model: RobotModel,
    t: Array,
    q: Array,
    *,
    torques: Torques | None = None,
    masses: Mapping[str, Array] | None = None,
    ghosts: Mapping[str, tuple[Array, Array]] | None = None,
    bands: Bands | None = None,
    marks: Sequence[Mark] = (),
    notes: Sequence[str] = (),
    log: str = "",
    rate: float = 30.0,
) -> Replay:
    """Return a page that plays a motion in real time, in three dimensions.

    Args:
        model: The robot; the meshes of its URDF are shown if they are found.
        t: Times, shape (N,), strictly increasing [s].
        q: Joint coordinates, shape (N, n), or (N, 7 + n) with a floating base [rad, m].
        torques: Torques to plot, and to draw as arcs around the joints.
        masses: Standard parameters by label, shape (p,) each: centres of mass and equimomental
            ellipsoids of the links, as ``{"URDF": prior, "identified": pi}``.
        ghosts: Times and joint coordinates of other motions by their labels, shown as ghosts that
            start with the first motion.
        bands: Parameters over time to plot.
        marks: Events to mark.
        notes: Sentences for the head of the page.
        log: Name of the recording's file; a report of this recording shares its clock.
        rate: Largest number of keyframes per second [Hz]; fewer for long motions, to limit the
            page's size.

    Returns:
        The page.

    Raises:
        DataError: If times and values are inconsistent with each other or with the model.
        SettingsError: If the rate is not positive.
    """
    require_kind(model, RobotModel, "model", "a robotid.RobotModel")
    for name, value, kind, wanted in (
        ("torques", torques, Torques, "Torques"), ("bands", bands, Bands, "Bands"),
        ("masses", masses, Mapping, "a table of standard parameters by label"),
        ("ghosts", ghosts, Mapping, "a table of motions (t, q) by label"),
    ):  # fmt: skip
        require_kind(value, (kind, type(None)), name, wanted)
    require_each(marks, Mark, "marks", "a list of marks")
    require_each(notes, str, "notes", "a list of sentences")
    require_kind(log, str, "log", "the name of a file")
    for label, pi in (masses or {}).items():
        _check_masses(model, label, pi)
    _check(t, q, rate)
    others = dict(ghosts or {})
    for label, path in others.items():
        require_each([label], str, "the label of a ghost", "text")
        if len(require_each(path, np.ndarray, f"ghost {label!r}", "two arrays, t and q")) != 2:
            raise SettingsError(f"ghost {label!r} has {len(path)} arrays, expected two, t and q")
        _check(*path, rate)
    gaps = [Mark(float(t[k]), f"gap of {t[k + 1] - t[k]:.2f} s", "gap") for k in _gaps(t)]
    scene = robot_scene(model)
    motions = [q, *(path for _, path in others.values())]
    data = {
        "title": model.name,
        "scene": scene.content,
        "start": float(t[0]),
        "log": log,
        "motion": _moved(model, t, q, rate),
        "ghosts": [{"label": x, **_moved(model, *path, rate)} for x, path in others.items()],
        "masses": [mass_marks(model, pi, label) for label, pi in (masses or {}).items()],
        "torques": None if torques is None else _torque_data(model, torques, t),
        "bands": None if bands is None else _band_data(bands, float(t[0])),
        "marks": [vars(mark) for mark in sorted((*marks, *gaps), key=lambda mark: mark.t)],
        "notes": [*notes, *_fixed_base(model), *(f"{note}." for note in scene.notes)],
        "view": _view(model, scene.corners, motions),
    }
    return Replay(data)


def _check_masses(model: RobotModel, label: str, pi: Array) -> None:
    """Refuse labelled values that are not standard parameters, all or the inertial ones."""
    require_kind(label, str, "the label of masses", "text")
    require_kind(pi, np.ndarray, f"masses of {label!r}", "an array of standard parameters")
    sizes = model.layout.n_inertial, len(model.layout.names)
    values = real_numbers(pi, f"masses of {label!r}")
    if values.shape not in [(size,) for size in sizes] or not np.isfinite(values).all():
        raise DataError(
            f"masses of {label!r} have shape {values.shape}, expected {sizes[0]} or {sizes[1]} "
            "finite numbers, as of model.standard_parameters()"
        )


def _check(t: Array, q: Array, rate: float) -> None:
    for name, values in (("t", t), ("q", q)):
        require_kind(values, np.ndarray, name, "an array of numbers")
        if values.dtype.kind not in "biuf":
            raise DataError(f"{name} is an array of {values.dtype}, expected numbers")
    if not (is_number(rate) and rate > 0):
        raise SettingsError(f"rate is {rate!r}, expected a positive number of keyframes per second")
    if t.ndim != 1 or q.ndim != 2 or len(t) != len(q):
        raise DataError(f"t has shape {t.shape} and q {q.shape}, expected (N,) and (N, n)")
    if len(t) < 2:
        raise DataError(f"the motion has {len(t)} samples, expected at least 2 to play")
    if not (np.isfinite(t).all() and np.isfinite(q).all()):
        raise DataError("t or q has values that are not finite; exclude those samples")
    reversed_rows = np.flatnonzero(np.diff(t) <= 0)
    if len(reversed_rows):
        k = int(reversed_rows[0])
        raise DataError(
            f"t must increase, but t[{k + 1}] = {t[k + 1]:.15g} s follows t[{k}] = {t[k]:.15g} s"
        )


def _keyframes(t: Array, rate: float, most: int) -> Array:
    """Return the samples to show: the last before each tick of the rate, and the last one."""
    ticks = np.linspace(t[0], t[-1], min(int((t[-1] - t[0]) * rate) + 2, max(most, 2)))
    return np.unique(np.searchsorted(t, ticks, side="right") - 1)


def _gaps(t: Array) -> list[int]:
    steps = np.diff(t)
    return np.flatnonzero((steps > _GAP) & (steps > LONG_STEP * np.median(steps))).tolist()


def _moved(model: RobotModel, t: Array, q: Array, rate: float) -> dict[str, Any]:
    """Return times from 0 and the displacement of each joint, at the keyframes."""
    model.configurations(q)  # refuses a wrong width of q
    q = q.copy()
    base = 7 if model.free_flyer else 0
    free = [base + j for j, joint in enumerate(model.limits) if joint.turns_freely]
    q[:, free] = np.unwrap(q[:, free], axis=0)
    if base:  # a quaternion and its negative are one pose, but not between keyframes
        turn = (q[1:, 3:7] * q[:-1, 3:7]).sum(axis=1) < 0
        q[1:, 3:7] *= np.where(np.cumsum(turn) % 2, -1.0, 1.0)[:, None]
    rows = _keyframes(t, rate, _NUMBERS // q.shape[1])
    return {"t": packed(t[rows] - t[0]), "q": packed(coordinates(model, q[rows]))}


def _fixed_base(model: RobotModel) -> list[str]:
    limbs = sum(int(parent) == 0 for parent in list(model.pin_model.parents)[1:])
    if limbs <= 1 or model.free_flyer:
        return []
    return ["The base is drawn as fixed: the log has no pose of the base."]


def _torque_data(model: RobotModel, torques: Torques, t: Array) -> dict[str, Any]:
    series = [torques.measured, *torques.predicted.values()]
    labels, wanted = ["measured", *torques.predicted], (len(torques.t), len(model.joints))
    for label, values in zip(labels, series, strict=True):
        if values.shape != wanted:
            raise DataError(f"torques {label!r} have shape {values.shape}, expected {wanted}")
    rms = np.sqrt(np.nanmean(torques.measured**2, axis=0))
    noise = rms if torques.noise is None else np.asarray(torques.noise, dtype=float)
    if noise.shape != wanted[1:]:
        raise DataError(f"noise has shape {noise.shape}, expected {wanted[1:]}")
    units = model.row_units[-len(model.joints) :]
    full, unit = (0.5, "RMS torque") if torques.noise is None else (6.0, "RMS noise")
    if torques.quantity == "position":
        full, unit = 0.25, "RMS command error"
        units = tuple("m" if joint in model.layout.prismatic else "rad" for joint in model.joints)
    scale = {"of": np.where(noise > 0, noise, 1.0).tolist(), "full": full, "unit": unit}
    edges = np.linspace(t[0], t[-1], min(_BINS, max(len(torques.t) // 4, 1)) + 1)
    switched = series[1:] if torques.quantity == "torque" else series[1:2]
    levels = [residual_levels(edges, torques.t, series[0] - other) for other in switched]
    strips = [packed(_coded(level, np.array(scale["of"])), "<u2") for level in levels]
    times, values = _plotted(torques.t - t[0], np.hstack(series))
    return {
        "quantity": torques.quantity,
        "joints": [
            {"name": name, "unit": unit, "node": int(model.pin_model.getJointId(name))}
            for name, unit in zip(model.joints, units, strict=True)
        ],
        "labels": labels,
        "scale": scale,
        "strips": strips,
        "t": packed(times),
        "values": stepped(values),
    }


def _coded(levels: Array, of: Array) -> Array:
    """Return residuals in hundredths of their scale; 65,534: not used, 65,535: a gap."""
    hundredths = np.minimum(np.round(100 * levels / of), 60_000)
    return np.where(np.isnan(levels), 65_535, np.where(levels < 0, 65_534, hundredths))


def _band_data(bands: Bands, start: float) -> dict[str, Any]:
    t, values = _plotted(bands.t - start, np.hstack([bands.theta, bands.std_error]))
    return {"names": list(bands.names), "units": list(bands.units), "t": packed(t),
            "values": packed(values)}  # fmt: skip


def _plotted(t: Array, values: Array) -> tuple[Array, Array]:
    """Return the samples of a plot, with a row of NaN in each gap."""
    rows = _keyframes(t, _PLOT_RATE, _NUMBERS // max(values.shape[1], 1))
    holes = np.array(_gaps(t), dtype=int)
    rows = np.unique(np.r_[rows, holes, holes + 1])
    after = np.searchsorted(rows, holes) + 1
    times = np.insert(t[rows], after, (t[holes] + t[holes + 1]) / 2)
    return times, np.insert(values[rows], after, np.nan, axis=0)


def _view(model: RobotModel, corners: Sequence[Array], motions: Sequence[Array]) -> dict[str, Any]:
    """Return the outermost points of a motion, relative to a floating base, and a ground grid."""
    data = model.pin_model.createData()
    points, lowest, first = [], np.inf, int(model.free_flyer)  # without the world's corner
    for q in motions:
        rows = np.unique(np.linspace(0, len(q) - 1, _DATA_RANGE).astype(int))
        for configuration in model.configurations(q[rows]):
            pin.forwardKinematics(model.pin_model, data, configuration)
            base = configuration[:3] if model.free_flyer else np.zeros(3)
            for M, own in zip(list(data.oMi)[first:], corners[first:], strict=True):
                places = own @ M.rotation.T + M.translation
                lowest = min(lowest, float(places[:, 2].min()))
                points.append(places - base)
    places = np.vstack(points)
    towards = np.array([d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)], dtype=float)
    outermost = places[np.unique((places @ towards.T).argmax(axis=0))]
    radius = float(np.linalg.norm(np.ptp(places, axis=0)) / 2) or 0.1
    # the camera is 2.8 radii away; the grid of 40 by 40 cells ends before it
    decade = 10.0 ** math.floor(math.log10(radius / 8.0))
    cell = max(step for step in (decade, 2.0 * decade, 5.0 * decade) if step <= radius / 8.0)
    # the ground is at 0, or below a robot that extends below 0
    ground = lowest if lowest < -0.1 * radius else 0.0
    return {"points": outermost.tolist(), "radius": radius, "cell": cell, "ground": ground}


def residual_levels(edges: Array, t: Array, residual: Array) -> Array:
    """Return the RMS (B, n) of residuals (N, n) at t (N,) between edges (B + 1,) of time."""
    bins = len(edges) - 1
    which = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, bins - 1)
    samples = np.bincount(which, minlength=bins)
    levels = np.full((bins, residual.shape[1]), np.nan)
    for j, known in enumerate(np.isfinite(residual).T):
        count = np.bincount(which[known], minlength=bins)
        square = np.bincount(which[known], residual[known, j] ** 2, minlength=bins)
        levels[:, j] = np.where(samples > 0, -1.0, np.nan)
        levels[count > 0, j] = np.sqrt(square[count > 0] / count[count > 0])
    return levels


def page(data: Mapping[str, Any]) -> str:
    """Return the page of a replay. It loads nothing."""
    title = f"{data['title']}: replay"
    policy = "; script-src 'unsafe-inline'; img-src data: blob:"
    styles = asset("charts.css") + asset("replay.css", _ASSETS)
    style = f"{asset('uPlot.min.css')}\n/*tones*/{styles}"
    body = Template(asset("replay.html", _ASSETS)).substitute(
        title=escape(title),
        notes=" ".join(f"<p>{escape(note)}</p>" for note in data["notes"]),
        data=script_json(data), viewer=_viewer(), script=_script(),
        uplot=asset("uPlot.iife.min.js"), charts=asset("charts.js"),
    )  # fmt: skip
    head = f'<link rel="icon" href="data:,">\n<style>{style}</style>\n'
    return scaffold(title, head, body, policy=policy)


@cache
def _script() -> str:
    sections = "".join(asset(f"{name}.js", _ASSETS) for name in _SCRIPTS)
    return f'"use strict";\n(() => {{\n{sections}}})();\n'


@cache
def _viewer() -> str:
    import meshcat

    viewer = Path(meshcat.viewer_assets_path()) / "dist" / "main.min.js"
    return viewer.read_text(encoding="utf-8")
