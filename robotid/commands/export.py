"""A written result in the formats of simulators."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robotid._files import write_text
from robotid.exceptions import DataError, SettingsError
from robotid.export.commanded import commanded_drives
from robotid.export.isaac import ISAAC_TERMS, write_isaac
from robotid.export.links import unstated_terms
from robotid.export.mjcf import MJCF_TERMS, write_mjcf
from robotid.export.ranges import ranges_text, stated_ranges
from robotid.export.result import load_result
from robotid.export.sdf import SDF_TERMS, write_sdf
from robotid.export.urdf import DYNAMICS_TERMS, write_urdf
from robotid.findings import listed
from robotid.regressor.friction_projection import Projection, project_friction

__all__ = ["export_result"]

_GRAVITY = (
    "the controller adds the torque of gravity by the URDF, for which there is no place; add it to "
    "what the actuators give (in MuJoCo, gravcomp = 1 of each body is near it)"
)
_RATE = (
    "the controller reads its joints {rate:g} times a second and holds its torque between; the "
    "actuators follow at each step of the simulator. Where it matters, let a loop of your own set "
    "torques at that rate"
)
#: Which formats an option is for.
_OPTIONS = {"step": ("mjcf", "isaac"), "delay": ("mjcf",)}
#: The drive terms of the formats that friction is projected on.
_TERMS = {"mjcf": MJCF_TERMS, "sdf": SDF_TERMS, "isaac": ISAAC_TERMS, "urdf": DYNAMICS_TERMS}


def export_result(
    path: str | Path,
    kind: str,
    target: str | Path,
    *,
    step: float | None = None,
    delay: str | None = None,
) -> dict[str, Any]:
    """Write what an identification found in another format.

    Args:
        path: A result.json, or its folder, with the URDF and sidecar beside it.
        kind: "urdf" (with ``<dynamics>``), "mjcf", "sdf", "isaac" or "ranges".
        target: The file to write.
        step: Time step of the simulator of "mjcf" and "isaac" [s]; None: 1 ms and 5 ms.
        delay: How "mjcf" states the delay of a command, "history" or "filter".

    Friction that a format has no place for is projected on that it has, see ``project_friction``.

    Returns:
        {"result", "format", "files", "not_stated": what the files do not state, a sentence each,
        "projected": {drive: {"replaced", the parameters written, "error", "torque"}}}.

    Raises:
        DataError: If the result has no URDF, or no ranges or gains that the format needs, or the
            folder does not exist.
        ModelError: If the URDF was changed, or a link of it is impossible.
        SettingsError: If the target is a folder, or an option is not of the format.
    """
    _check_options(kind, {"step": step, "delay": delay})
    result, goal = load_result(path), Path(target)
    full, parameters = result.identified
    projection = Projection(full, parameters, ())
    if kind in _TERMS:
        projection = project_friction(full, parameters, result.drive_moments, _TERMS[kind])
    model, pi, said = projection.model, projection.pi, tuple(map(str, projection.drives))
    commanded = commanded_drives(model, pi, result.content, result.path.name)
    if commanded and result.content["settings"].get("controller", {}).get("gravity_compensation"):
        said = (*said, _GRAVITY)
    if commanded and result.rate is not None:
        said = (*said, _RATE.format(rate=result.rate))
    sources = (entry["path"] for entry in result.content["inputs"] if entry["role"] == "urdf")
    files, original = [str(goal)], next(sources, None)
    given: dict[str, Any] = {"step": step, "delay": delay}
    how = {key: value for key, value in given.items() if value is not None}
    notes: Sequence[str] = ()
    match kind:
        case "mjcf":
            how |= {"commanded": commanded, "notes": said}
            notes = write_mjcf(model, pi, goal, original=original, **how)
        case "sdf":
            notes = write_sdf(model, pi, goal, original=original, notes=said)
        case "isaac":
            notes = write_isaac(model, pi, commanded, goal, notes=said, **how)
        case "urdf":
            files.append(str(write_urdf(full, parameters, goal, dynamics=projection)))
            notes = [*said, *unstated_terms(model, pi, "URDF", DYNAMICS_TERMS)]
        case _:
            if "ranges" not in result.content and not commanded:
                raise DataError(
                    f"{result.path.name} has no ranges: an earlier version wrote it; identify again"
                )
            write_text(ranges_text(stated_ranges(result.content)), goal)
    projected = {drive.name: drive.to_dict() for drive in projection.drives}
    return {
        "result": str(path), "format": kind, "files": files, "not_stated": list(notes),
        "projected": projected,
    }  # fmt: skip


def _check_options(kind: str, options: dict[str, Any]) -> None:
    """Refuse an option that says nothing of a format."""
    for name, value in options.items():
        if value not in (None, False) and kind not in _OPTIONS[name]:
            raise SettingsError(
                f"--{name.replace('_', '-')} is for the formats {listed(_OPTIONS[name])}, not for "
                f"{kind}: leave it out"
            )
