"""A written result in the formats of simulators."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robotid._files import write_text
from robotid.exceptions import DataError, SettingsError
from robotid.export.commanded import commanded_drives, with_mean_friction
from robotid.export.isaac import write_isaac
from robotid.export.links import unstated_terms
from robotid.export.mjcf import write_mjcf
from robotid.export.ranges import ranges_text, stated_ranges
from robotid.export.result import load_result
from robotid.export.sdf import write_sdf
from robotid.export.urdf import write_urdf
from robotid.findings import listed
from robotid.robot.drives import TERMS

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
#: What says something of which formats.
_OPTIONS = {
    "step": ("mjcf", "isaac"),
    "delay": ("mjcf",),
    "mean_friction": ("mjcf", "sdf", "isaac"),
}


def export_result(
    path: str | Path,
    kind: str,
    target: str | Path,
    *,
    step: float | None = None,
    delay: str | None = None,
    mean_friction: bool = False,
) -> dict[str, Any]:
    """Write what an identification found in another format.

    Args:
        path: A result.json, or its folder, with the URDF and sidecar beside it.
        kind: "urdf" (with ``<dynamics>``), "mjcf", "sdf", "isaac" or "ranges".
        target: The file to write.
        step: Time step of the simulator of "mjcf" and "isaac" [s]; None: 1 ms and 5 ms.
        delay: How "mjcf" states the delay of a command, "history" or "filter".
        mean_friction: Whether friction of "mjcf", "sdf" and "isaac" has the mean of what depends on
            the position, for which they have no place.

    Returns:
        {"result", "format", "files", "not_stated": what the files do not state, a sentence each}.

    Raises:
        DataError: If the result has no URDF, or no ranges or gains that the format needs, or the
            folder does not exist.
        ModelError: If the URDF was changed, or a link of it is impossible.
        SettingsError: If the target is a folder, or an option is not of the format.
    """
    _check_options(kind, {"step": step, "delay": delay, "mean_friction": mean_friction})
    result, goal = load_result(path), Path(target)
    model, pi = result.identified
    commanded, said = result.commanded, tuple[str, ...]()
    if mean_friction:
        pi, said = with_mean_friction(model, pi)
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
            files.append(str(write_urdf(model, pi, goal, dynamics=True)))
            terms = [name for name, term in TERMS.items() if term.dynamics]
            notes = unstated_terms(model, pi, "URDF", terms)
        case _:
            if "ranges" not in result.content and not commanded:
                raise DataError(
                    f"{result.path.name} has no ranges: an earlier version wrote it; identify again"
                )
            write_text(ranges_text(stated_ranges(result.content)), goal)
    return {"result": str(path), "format": kind, "files": files, "not_stated": list(notes)}


def _check_options(kind: str, options: dict[str, Any]) -> None:
    """Refuse an option that says nothing of a format."""
    for name, value in options.items():
        if value not in (None, False) and kind not in _OPTIONS[name]:
            raise SettingsError(
                f"--{name.replace('_', '-')} is for the formats {listed(_OPTIONS[name])}, not for "
                f"{kind}: leave it out"
            )
