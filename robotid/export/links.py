"""The links of an identified robot as simulators want them: where they sit, how they move."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robotid._typing import Array
from robotid.exceptions import ModelError
from robotid.export.urdf import link_parameters
from robotid.findings import listed
from robotid.robot.bodies import inertial_parameters, link_places
from robotid.robot.meshes import Shape, find_mesh, read_shapes
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia
from robotid.robot.tree import Joint
from robotid.versions import __version__

__all__ = [
    "WORLD",
    "SimulatedLink",
    "head_comment",
    "leader_of",
    "left_out_notes",
    "quaternion",
    "simulated_links",
]

#: What simulators call the frame that does not move.
WORLD = "world"
_NAMED = 6  # meshes left out
_ROUNDING = 1e-12  # of the largest eigenvalue of a pseudo-inertia: a smaller one below 0 is 0


@dataclass(frozen=True, eq=False)
class SimulatedLink:
    """One link.

    Attributes:
        name: Its name.
        parent: Link that it hangs on, or "world".
        placement: Pose in the parent's frame, of joints at 0 but for locked ones, shape (4, 4).
        joint: The joint that moves it; None if it is fixed to its parent, or floats.
        inertial: Its inertial parameters, shape (10,); None if it has none of its own, as where
            those of the link that it is fixed to hold it.
        shapes: What it looks like, "visual", and what it touches with, "collision"; meshes by the
            path of their file.
    """

    name: str
    parent: str
    placement: Array
    joint: Joint | None
    inertial: Array | None
    shapes: tuple[tuple[str, Shape], ...]


def simulated_links(
    model: RobotModel, pi: Array, is_readable: Callable[[Path], bool], near: Sequence[str | Path]
) -> tuple[tuple[SimulatedLink, ...], tuple[str, ...]]:
    """Return the links of a robot with its parameters, parents first, and the meshes left out.

    A root link named "world" is the world itself and not among them.

    Args:
        model: The robot.
        pi: Standard parameters, shape (p,), SI units, in ``layout.names`` order.
        is_readable: Whether the simulator reads a mesh.
        near: URDFs beside which meshes are looked for, the model's own aside.

    Returns:
        The links, and what the URDF calls the meshes that are not found or not readable.

    Raises:
        DataError: If pi does not have p finite entries.
        ModelError: If a link or a drive would be physically impossible, or has the world's name.
    """
    inertials = _inertials(model, pi)
    shapes, left_out = _shapes(model, is_readable, [*near, model.tree.path])
    arriving = {joint.child: joint for joint in model.tree.joints}
    if WORLD in arriving or (model.free_flyer and model.tree.root == WORLD):
        raise ModelError(
            f"a link that moves is named {WORLD!r}, the name of what does not move; rename it"
        )
    links, names = [], [model.tree.root]
    for name in names:  # which grows by the children of each
        names += [joint.child for joint in model.tree.joints if joint.parent == name]
        if name == WORLD:
            continue
        joint, parent, placement = arriving.get(name), WORLD, np.eye(4)
        if joint is not None:
            parent, placement = joint.parent, _placement(joint, model.locked.get(joint.name, 0.0))
        moves = joint is not None and joint.is_movable and joint.name not in model.locked
        shown = tuple(shapes.get(name, ()))
        links.append(
            SimulatedLink(
                name, parent, placement, joint if moves else None, inertials.get(name), shown
            )
        )
    return tuple(links), left_out


def leader_of(model: RobotModel, joint: Joint) -> tuple[str, float, float] | None:
    """Return the joint that another one follows, the ratio and the offset, None if it leads.

    Args:
        model: The robot.
        joint: One of its moving joints.
    """
    if joint.name in model.joints:
        return None
    row = model.pin_model.joints[model.pin_model.getJointId(joint.name)].idx_v
    ratios = model.velocity_map[row, -len(model.joints) :]
    leader = int(np.flatnonzero(ratios)[0]) if ratios.any() else 0
    return model.joints[leader], float(ratios[leader]), float(model.position_offset[row])


def quaternion(placement: Array) -> Array:
    """Return the rotation of a pose as a quaternion x y z w, shape (4,).

    Args:
        placement: The pose, shape (4, 4).
    """
    found: Array = Rotation.from_matrix(placement[:3, :3]).as_quat(canonical=True)
    return found


def head_comment(model: RobotModel, notes: Sequence[str]) -> str:
    """Return the comment at the head of a file: what it is of, and what it does not state.

    Args:
        model: The robot.
        notes: What the file does not state, a sentence each.
    """
    lines = [f"{model.name}, identified from {Path(model.tree.path).name}; robotid {__version__}"]
    text = "\n    ".join([*lines, *notes])
    while "--" in text:  # which ends a comment
        text = text.replace("--", "- -")
    return f" {text} "


def left_out_notes(
    kind: str,
    model: RobotModel,
    pi: Array,
    terms: Collection[str],
    meshes: Sequence[str] = (),
    *,
    has_couplings: bool = False,
) -> list[str]:
    """Return what a file does not state, a sentence each.

    Args:
        kind: The format.
        model: The robot.
        pi: Standard parameters, shape (p,), SI units, in ``layout.names`` order.
        terms: Names of the drive terms that it states.
        meshes: Meshes that are not found or not readable.
        has_couplings: Whether it states drives that turn with several joints.
    """
    layout, notes = model.layout, []
    drives = zip(layout.drive_parameters, layout.drive_names, pi[layout.n_inertial :], strict=True)
    unstated = [
        name
        for (d, term), name, value in drives
        if value != 0.0 and not (term.name in terms and (has_couplings or d < len(layout.joints)))
    ]
    if unstated:
        notes.append(
            f"{kind} has no place for {listed(unstated)}; the sidecar of the URDF has them"
        )
    if meshes:
        names = listed((Path(mesh).name for mesh in meshes), _NAMED)
        notes.append(f"meshes left out, not found or of a kind that {kind} has not: {names}")
    return notes


def _inertials(model: RobotModel, pi: Array) -> dict[str, Array]:
    """Return the parameters, shape (10,), of the links that have an inertial of their own."""
    found = link_parameters(model, pi)
    for place in link_places(model):
        stated = model.tree.inertials.get(place.link)
        if place.link in found or place.is_lumped or stated is None:
            continue
        values = inertial_parameters(stated)
        eigenvalues = np.linalg.eigvalsh(pseudo_inertia(values)[0])
        if eigenvalues[0] >= -_ROUNDING * abs(eigenvalues[-1]) and values[0] > 0:
            found[place.link] = values
        elif place.body >= 0 and values.any():  # one that is fixed to the world changes nothing
            raise ModelError(
                f"link {place.link!r}, behind a locked joint, has an impossible inertial, which no "
                "simulator reads; correct it in the URDF, and identify again"
            )
    return found


def _placement(joint: Joint, position: float) -> Array:
    """Return the pose of a joint's child in its parent, shape (4, 4)."""
    R = Rotation.from_euler("xyz", joint.rpy)
    axis, shift = np.array(joint.axis), np.zeros(3)
    axis /= np.linalg.norm(axis)
    H = np.eye(4)
    if joint.type == "prismatic":
        shift = position * axis
    H[:3, 3] = np.array(joint.xyz) + R.apply(shift)
    if joint.type != "prismatic":
        R *= Rotation.from_rotvec(position * axis)
    H[:3, :3] = R.as_matrix()
    return H


def _shapes(
    model: RobotModel, is_readable: Callable[[Path], bool], urdfs: Sequence[str | Path]
) -> tuple[dict[str, list[tuple[str, Shape]]], tuple[str, ...]]:
    """Return the shapes of each link, and the meshes left out."""
    found: dict[str, list[tuple[str, Shape]]] = {}
    left_out: dict[str, None] = {}
    for tag in ("visual", "collision"):
        for shape in read_shapes(model.tree.robot, tag):
            path = None
            if shape.kind == "mesh":
                places = (find_mesh(shape.file, urdf) for urdf in urdfs)
                path = next((p for p in places if p is not None), None)
                if path is None or not is_readable(path):
                    left_out[shape.file] = None
                    continue
            if shape.kind:
                whole = replace(shape, file=str(path.resolve()) if path else "")
                found.setdefault(shape.link, []).append((tag, whole))
    return found, tuple(left_out)
