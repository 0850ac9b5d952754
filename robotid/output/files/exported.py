"""A written result in the drive terms of a format: friction is projected on these terms."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.dynamics.friction_projection import Projection, project_friction
from robotid.output.files.commanded import CommandedDrive, commanded_drives
from robotid.robot.model import RobotModel

if TYPE_CHECKING:
    from robotid.output.files.result_file import Result

_GRAVITY = (
    "the controller compensates gravity with the URDF's model, which the file cannot state; add "
    "this torque to that of the actuators (in MuJoCo, gravcomp = 1 of each body is close to it)"
)
_RATE = (
    "the controller runs at {rate:g} Hz with a zero-order hold; the actuators run at each step of "
    "the simulator. If the difference matters, compute the torques at that rate in your own loop"
)


@dataclass(frozen=True, eq=False)
class Exported:
    """A result with its drives in the terms of a format.

    Attributes:
        result: The result.
        projection: Its robot and parameters, with friction projected on those terms.
    """

    result: "Result"
    projection: Projection

    @classmethod
    def of(cls, result: "Result", terms: Collection[str]) -> "Exported":
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
    """The written files of a result.

    Attributes:
        files: The files.
        notes: Properties that the files do not state, a sentence each.
        projected: The projection of friction, by drive.
    """

    files: Sequence[Path]
    notes: Sequence[str]
    projected: Mapping[str, Any]


def unstated_terms(
    model: RobotModel, pi: Array, name: str, terms: Collection[str], *, has_couplings: bool = False
) -> list[str]:
    """Return a sentence on drive parameters and loops that a format cannot state, if any.

    pi (p,).
    """
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
