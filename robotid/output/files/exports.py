"""Exports of a written result: the formats, and friction projected on the terms of a format.

A module of this folder with a ``FORMAT`` and a function ``export`` adds a format.
"""

import pkgutil
import xml.etree.ElementTree as ET
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from robotid.base.exceptions import ModelError
from robotid.base.files import write_text
from robotid.base.findings import listed
from robotid.base.settings import require_kind
from robotid.base.text import yaml_name, yaml_plain
from robotid.base.tolerances import ROUNDING
from robotid.base.typing import Array
from robotid.base.versions import __version__
from robotid.dynamics.friction_projection import Projection, project_friction
from robotid.output.files.result_file import CommandedDrive, Result, commanded_drives
from robotid.output.files.urdf import DYNAMICS_TERMS, link_parameters, write_urdf
from robotid.robot.bodies import Shape, find_mesh, inertial_parameters, link_places, read_shapes
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia
from robotid.robot.tree import Joint

_WIDEST = 120  # characters of a YAML table in one line
_GRAVITY = (
    "the controller compensates gravity with the URDF's model, which the file lacks; add "
    "this torque to the actuators' torque (in MuJoCo, gravcomp = 1 of each body is close to it)"
)
_RATE = (
    "the controller runs at {rate:g} Hz with a zero-order hold; the actuators run at each step of "
    "the simulator. If the difference matters, compute the torques at that rate in your own loop"
)


@dataclass(frozen=True)
class Option:
    """An option of a format: its words with its default, placeholder, type and permitted words."""

    words: str
    metavar: str
    kind: type[int] | type[float] | type[str] = str
    among: tuple[str, ...] = ()


@dataclass(frozen=True)
class Format:
    """A format, which the function ``export`` of its module writes."""

    name: str
    words: str
    suffix: str  # suffix after the robot's name in the name of its file
    use: str = ""  # the advice for any result; "" without advice
    use_of_gains: str = ""  # the advice for a result with gains of drives
    options: Mapping[str, Option] = field(default_factory=dict)  # its options, by name


FORMAT = Format("urdf", "URDF with <dynamics>, and its drive parameters file", ".urdf")


@cache
def writers() -> dict[str, Any]:
    """Return the modules that write a format, by its name."""
    folder = Path(__file__).parent
    names = [module.name for module in pkgutil.iter_modules([str(folder)])]
    modules = [import_module(f"{__package__}.{name}") for name in names]
    return {module.FORMAT.name: module for module in modules if hasattr(module, "FORMAT")}


def formats() -> dict[str, Format]:
    """Return the formats by name."""
    return {name: module.FORMAT for name, module in writers().items()}


def options_of(kinds: Mapping[str, Format]) -> dict[str, dict[str, Option]]:
    """Return the options of formats, by name: the formats that have it, with its description."""
    options: dict[str, dict[str, Option]] = {}
    for kind, form in kinds.items():
        for name, option in form.options.items():
            options.setdefault(name, {})[kind] = option
    return options


@dataclass(frozen=True, eq=False)
class Exported:
    """A result with its drives in the terms of a format."""

    result: Result
    projection: Projection  # its robot and parameters, with friction projected on those terms

    @classmethod
    def of(cls, result: Result, terms: Collection[str]) -> "Exported":
        """Return a result in the drive terms of a format."""
        return cls(result, project_friction(*result.identified, result.drive_moments, terms))

    @property
    def model(self) -> RobotModel:
        """The robot."""
        return self.projection.model

    @property
    def pi(self) -> Array:
        """Its standard parameters, shape (p,), SI units, in ``layout.names`` order."""
        return self.projection.pi

    @cached_property
    def commanded(self) -> tuple[CommandedDrive, ...]:
        """Its drives with position controllers; none for a result without gains."""
        return commanded_drives(self.model, self.pi, self.result.content, self.result.path.name)

    @property
    def original(self) -> str | None:
        """The URDF that was identified; paths of meshes are relative to it."""
        inputs = self.result.content["inputs"]
        return next((entry["path"] for entry in inputs if entry["role"] == "urdf"), None)

    @property
    def notes(self) -> list[str]:
        """Notes that apply to each exported file, a sentence each."""
        notes = [*map(str, self.projection.drives)]
        controller = self.result.content["settings"].get("controller", {})
        if self.commanded and controller.get("gravity_compensation"):
            notes.append(_GRAVITY)
        if self.commanded and self.result.rate is not None:
            notes.append(_RATE.format(rate=self.result.rate))
        return notes

    def written(self, *files: Path, notes: Sequence[str] = ()) -> "Written":
        """Return the written files with their notes."""
        drives = {drive.name: drive.to_dict() for drive in self.projection.drives}
        return Written(files, notes, drives)


@dataclass(frozen=True)
class Written:
    """The written files of a result."""

    files: Sequence[Path]
    notes: Sequence[str]  # properties that the files do not state, a sentence each
    projected: Mapping[str, Any]  # the projection of friction, by drive


def unstated_terms(
    model: RobotModel, pi: Array, name: str, terms: Collection[str], *, has_couplings: bool = False
) -> list[str]:
    """Return a sentence on drive parameters and loops that a format cannot state: pi (p,)."""
    layout = model.layout
    drives = zip(layout.drive_parameters, layout.drive_names, pi[layout.n_inertial :], strict=True)
    missing = [
        drive
        for (d, term), drive, value in drives
        if value != 0.0
        and not (term.name in terms and (has_couplings or layout.drives[d] not in layout.couplings))
    ]
    if not has_couplings:
        missing += [f"the loop {loop.name}" for loop in model.loops]
    sentence = f"{name} lacks {listed(missing)}; the drive parameters file of the URDF has them"
    return [sentence] if missing else []


def export(result: Result, target: Path) -> Written:
    """Write the URDF of a result with ``<dynamics>``, and its sidecar."""
    exported = Exported.of(result, DYNAMICS_TERMS)
    sidecar = write_urdf(*result.identified, target, dynamics=exported.projection)
    unstated = unstated_terms(exported.model, exported.pi, "URDF", DYNAMICS_TERMS)
    return exported.written(target, sidecar, notes=[*unstated, *exported.notes])


def head_of(name: str, **values: object) -> str:
    """Return the comment at the head of a file, of the folder assets, with its values."""
    path = Path(__file__).parent / "assets" / f"{name}.txt"
    return Template(path.read_text(encoding="utf-8")).substitute(values)


def yaml_text(table: Mapping[str, Any], head: str) -> str:
    """Return a table as YAML after a comment."""
    lines = [f"# {line}".rstrip() for line in head.splitlines()]
    return "\n".join([*lines, *_lines(table, "")]) + "\n"


def _lines(value: Mapping[str, Any], indent: str) -> Iterator[str]:
    """Yield the lines of a table; a table without tables that fits a line has one line."""
    for key, entry in value.items():
        name = f"{indent}{yaml_plain(key)}:"
        if isinstance(entry, Mapping) and (
            any(isinstance(x, Mapping) for x in entry.values()) or len(_flow(entry)) > _WIDEST
        ):
            yield name
            yield from _lines(entry, indent + "  ")
        else:
            yield f"{name} {_flow(entry)}"


def _flow(entry: Any) -> str:  # noqa: ANN401
    """Return a number, a text, a list or a table in one line."""
    if isinstance(entry, Mapping):
        return "{" + ", ".join(f"{yaml_name(key)}: {_flow(x)}" for key, x in entry.items()) + "}"
    if isinstance(entry, list):
        return "[" + ", ".join(map(_flow, entry)) + "]"
    if isinstance(entry, float):  # YAML 1.1 reads 1e-05 as text, and 1.0e-05 as a number
        mantissa, e, exponent = f"{entry:.6g}".partition("e")
        return mantissa + (".0" if e and "." not in mantissa else "") + e + exponent
    return yaml_plain(entry)


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
    require_kind(target, (str, Path), "target", "the path of a file to write")
    require_kind(original, (str, Path, type(None)), "original", "the path of a URDF, or none")
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
