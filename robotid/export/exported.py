"""A written result as a format takes it: with friction projected on the drive terms it has."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid._typing import Array
from robotid.export.commanded import CommandedDrive, commanded_drives
from robotid.findings import listed
from robotid.regressor.friction_projection import Projection, project_friction
from robotid.robot.model import RobotModel

if TYPE_CHECKING:
    from robotid.export.result import Result

__all__ = ["Exported", "Written", "unstated_terms"]

_GRAVITY = (
    "the controller adds the torque of gravity by the URDF, for which there is no place; add it to "
    "what the actuators give (in MuJoCo, gravcomp = 1 of each body is near it)"
)
_RATE = (
    "the controller reads its joints {rate:g} times a second and holds its torque between; the "
    "actuators follow at each step of the simulator. Where it matters, let a loop of your own set "
    "torques at that rate"
)


@dataclass(frozen=True, eq=False)
class Exported:
    """A result, and its drives in the terms of a format.

    Attributes:
        result: The result.
        projection: Its robot and parameters, friction projected on those terms.
    """

    result: "Result"
    projection: Projection

    @classmethod
    def of(cls, result: "Result", terms: Collection[str]) -> "Exported":
        """Return a result in the drive terms of a format.

        Args:
            result: The result.
            terms: The terms.

        Raises:
            DataError: If the result has no URDF.
            ModelError: If its URDF was changed.
        """
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
        """Its drives that follow position commands; none of a result without gains."""
        return commanded_drives(self.model, self.pi, self.result.content, self.result.path.name)

    @property
    def original(self) -> str | None:
        """The URDF that was identified, beside which meshes are."""
        inputs = self.result.content["inputs"]
        return next((entry["path"] for entry in inputs if entry["role"] == "urdf"), None)

    @property
    def notes(self) -> list[str]:
        """What is to be said of any file of it, a sentence each."""
        said = [*map(str, self.projection.drives)]
        controller = self.result.content["settings"].get("controller", {})
        if self.commanded and controller.get("gravity_compensation"):
            said.append(_GRAVITY)
        if self.commanded and self.result.rate is not None:
            said.append(_RATE.format(rate=self.result.rate))
        return said

    def written(self, *files: Path, notes: Sequence[str] = ()) -> "Written":
        """Return what was written of it.

        Args:
            files: The files.
            notes: What they do not state, a sentence each.
        """
        drives = {drive.name: drive.to_dict() for drive in self.projection.drives}
        return Written(files, notes, drives)


@dataclass(frozen=True)
class Written:
    """What was written of a result.

    Attributes:
        files: The files.
        notes: What they do not state, a sentence each.
        projected: How friction was projected, by drive.
    """

    files: Sequence[Path]
    notes: Sequence[str]
    projected: Mapping[str, Any]


def unstated_terms(
    model: RobotModel, pi: Array, name: str, terms: Collection[str], *, has_couplings: bool = False
) -> list[str]:
    """Return a sentence on the drive parameters that a format has no place for, if any.

    Args:
        model: The robot.
        pi: Standard parameters, shape (p,), SI units, in ``layout.names`` order.
        name: The format.
        terms: The drive terms that it states.
        has_couplings: Whether it states drives that turn with several joints.
    """
    layout = model.layout
    drives = zip(layout.drive_parameters, layout.drive_names, pi[layout.n_inertial :], strict=True)
    missing = [
        drive
        for (d, term), drive, value in drives
        if value != 0.0
        and not (term.name in terms and (has_couplings or layout.drives[d] not in layout.couplings))
    ]
    sentence = f"{name} has no place for {listed(missing)}; the sidecar of the URDF has them"
    return [sentence] if missing else []
