"""Exports of a written result: the formats, and friction projected on the terms of a format.

A module of this folder with a ``FORMAT`` and a function ``export`` adds a format.
"""

import pkgutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from string import Template
from typing import Any

from robotid.base.findings import listed
from robotid.base.text import yaml_name, yaml_plain
from robotid.base.typing import Array
from robotid.dynamics.friction_projection import Projection, project_friction
from robotid.output.files.result_file import CommandedDrive, Result, commanded_drives
from robotid.output.files.urdf import DYNAMICS_TERMS, write_urdf
from robotid.robot.model import RobotModel

_WIDEST = 120  # characters of a YAML table in one line
_GRAVITY = (
    "the controller compensates gravity with the URDF's model, which the file cannot state; add "
    "this torque to that of the actuators (in MuJoCo, gravcomp = 1 of each body is close to it)"
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
    sentence = (
        f"{name} cannot state {listed(missing)}; the drive parameters file of the URDF has them"
    )
    return [sentence] if missing else []


def export(result: Result, target: Path) -> Written:
    """Write the URDF of a result with ``<dynamics>``, and its sidecar."""
    exported = Exported.of(result, DYNAMICS_TERMS)
    sidecar = write_urdf(*result.identified, target, dynamics=exported.projection)
    unstated = unstated_terms(exported.model, exported.pi, "URDF", DYNAMICS_TERMS)
    return exported.written(target, sidecar, notes=[*exported.notes, *unstated])


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
