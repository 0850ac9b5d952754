"""An identified robot in the form of simulators: poses, motion and shapes of its links."""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robotid.base.exceptions import ModelError
from robotid.base.files import write_text
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.base.versions import __version__
from robotid.output.files.exports import unstated_terms
from robotid.output.files.urdf import ROUNDING, link_parameters
from robotid.robot.bodies import inertial_parameters, link_places
from robotid.robot.geometry import Shape, find_mesh, read_shapes
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia
from robotid.robot.tree import Joint

#: Name of the fixed frame in simulators.
WORLD = "world"
_NAMED = 6  # missing meshes that are listed


@dataclass(frozen=True)
class XmlFormat:
    """The capabilities of a simulator's format."""

    name: str
    terms: Collection[str]  # drive terms of a joint that it can state
    has_couplings: bool  # whether it can state them for drives that move several joints, and loops
    is_readable: Callable[[Path], bool]  # whether the simulator reads a mesh


#: Shapes of a link: "visual" or "collision", the shape, its pose in the link, path of the mesh.
_Shapes = Sequence[tuple[str, Shape, Array, Path | None]]


@dataclass(frozen=True, eq=False)
class SimulatedLink:
    """One link. Poses are x y z [m] and a quaternion x y z w, shape (7,)."""

    name: str
    parent: str  # its parent link, or "world"
    pose: Array  # its pose in the parent's frame, with all joints at 0 except locked ones
    joint: Joint | None  # its parent joint; None if it is the root
    moves: bool  # whether that joint moves it; if not, it is fixed or locked
    # joint that this one follows, ratio, offset; None if it is independent
    leader: tuple[str, float, float] | None
    floats: bool  # whether it is the floating base
    # its inertial parameters, shape (10,); None if it has none, as a link whose inertia is
    # included in that of the link that it is fixed to
    inertial: Array | None
    shapes: _Shapes


def write_model(
    model: RobotModel,
    pi: Array,
    target: str | Path,
    original: str | Path | None,
    to: XmlFormat,
    build: Callable[[Sequence[SimulatedLink], dict[str, float]], ET.Element],
    notes: Sequence[str] = (),
) -> tuple[str, ...]:
    """Write a robot in the format of a simulator: pi (p,)."""
    inertials, meshes = _inertials(model, pi), set[str]()
    shapes = _shapes(model, to, [*([original] if original else []), model.tree.path], meshes)
    values = dict(zip(model.layout.names, pi.tolist(), strict=True))
    if not to.has_couplings:
        values = own_drives(model, values)
    top = build(_links(model, inertials, shapes), values)
    unstated = unstated_terms(model, pi, to.name, to.terms, has_couplings=to.has_couplings)
    names = listed(sorted(Path(mesh).name for mesh in meshes), _NAMED)
    left_out = f"meshes not exported, missing or in a format that {to.name} cannot read: {names}"
    every = (*unstated, *([left_out] if meshes else []), *notes)
    head = f"{model.name}, identified from {Path(model.tree.path).name}; robotid {__version__}"
    comment = "\n    ".join([head, *every])
    while "--" in comment:  # not permitted in a comment
        comment = comment.replace("--", "- -")
    top.insert(0, ET.Comment(f" {comment} "))
    ET.indent(top)
    write_text(ET.tostring(top, encoding="unicode") + "\n", target)
    return every


def own_drives(model: RobotModel, values: Mapping[str, float]) -> dict[str, float]:
    """Return parameters without those of drives that move several joints."""
    shared = {coupling.name for coupling in model.layout.couplings}
    return {name: x for name, x in values.items() if name.rpartition(".")[0] not in shared}


def _links(
    model: RobotModel, inertials: Mapping[str, Array], shapes: Mapping[str, _Shapes]
) -> list[SimulatedLink]:
    """Return the links, parents first; a root link named "world" is the world itself."""
    arriving = {joint.child: joint for joint in model.tree.joints}
    if WORLD in arriving or (model.free_flyer and model.tree.root == WORLD):
        raise ModelError(
            f"a moving link is named {WORLD!r}, the name of the fixed frame in simulators; "
            "rename the link"
        )
    links, names = [], [model.tree.root]
    for name in names:  # the list grows by the children of each link
        names += [joint.child for joint in model.tree.joints if joint.parent == name]
        if name == WORLD:
            continue
        joint, parent, pose = arriving.get(name), WORLD, np.eye(7)[6]
        if joint is not None:
            parent, pose = joint.parent, _pose(joint, model.locked.get(joint.name, 0.0))
        moves = joint is not None and joint.is_movable and joint.name not in model.locked
        follows = joint is not None and moves and joint.name not in model.joints
        leader = _leader(model, joint) if joint is not None and follows else None
        floats = model.free_flyer and name == model.tree.root
        own = inertials.get(name), shapes.get(name, [])
        links.append(SimulatedLink(name, parent, pose, joint, moves, leader, floats, *own))
    return links


def _leader(model: RobotModel, joint: Joint) -> tuple[str, float, float]:
    row = model.pin_model.joints[model.pin_model.getJointId(joint.name)].idx_v
    ratios = model.velocity_map[row, -len(model.joints) :]
    leader = int(np.abs(ratios).argmax())
    return model.joints[leader], float(ratios[leader]), float(model.position_offset[row])


def _pose(joint: Joint, position: float) -> Array:
    R, axis = Rotation.from_euler("xyz", joint.rpy), np.array(joint.axis)
    displacement = position * axis / np.linalg.norm(axis)
    if joint.type == "prismatic":
        return np.append(joint.xyz + R.apply(displacement), R.as_quat())
    return np.append(joint.xyz, (R * Rotation.from_rotvec(displacement)).as_quat())


def _inertials(model: RobotModel, pi: Array) -> dict[str, Array]:
    """Return the parameters, shape (10,), of the links with an inertial."""
    found = link_parameters(model, pi)
    for place in link_places(model):
        stated = model.tree.inertials.get(place.link)
        if place.link in found or place.is_lumped or stated is None:
            continue
        values = inertial_parameters(stated)
        eigenvalues = np.linalg.eigvalsh(pseudo_inertia(values)[0])
        if eigenvalues[0] >= -ROUNDING * abs(eigenvalues[-1]) and values[0] > 0:
            found[place.link] = values
        elif place.body >= 0 and values.any():  # a link fixed to the world has no effect
            raise ModelError(
                f"link {place.link!r}, beyond a locked joint, has a physically impossible "
                "inertial, which no simulator reads; correct it in the URDF, and identify again"
            )
    return found


def _shapes(
    model: RobotModel, to: XmlFormat, urdfs: Sequence[str | Path], left_out: set[str]
) -> Mapping[str, _Shapes]:
    """Return the shapes of each link, and add the URDF's names of unusable meshes to a set."""
    found: dict[str, list[tuple[str, Shape, Array, Path | None]]] = {}
    for tag in ("visual", "collision"):
        for shape in read_shapes(model.tree.robot, tag):
            places = (find_mesh(shape.file, urdf) for urdf in urdfs if shape.file)
            path = next((place.resolve() for place in places if place is not None), None)
            if shape.file and (path is None or not to.is_readable(path)):
                left_out.add(shape.file)
            elif shape.kind:
                H = shape.placement
                pose = np.append(H[:3, 3], Rotation.from_matrix(H[:3, :3]).as_quat())
                found.setdefault(shape.link, []).append((tag, shape, pose, path))
    return found
