"""A written result in the formats of simulators."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robotid._files import write_text
from robotid.exceptions import DataError
from robotid.export.links import unstated_terms
from robotid.export.mjcf import write_mjcf
from robotid.export.ranges import ranges_text
from robotid.export.result import load_result
from robotid.export.sdf import write_sdf
from robotid.export.urdf import write_urdf
from robotid.robot.drives import TERMS

__all__ = ["export_result"]


def export_result(path: str | Path, kind: str, target: str | Path) -> dict[str, Any]:
    """Write what an identification found in another format.

    Args:
        path: A result.json, or its folder, with the URDF and sidecar beside it.
        kind: "urdf" (with ``<dynamics>``), "mjcf", "sdf" or "ranges".
        target: The file to write.

    Returns:
        {"result", "format", "files", "not_stated": what the files do not state, a sentence each}.

    Raises:
        DataError: If the result has no URDF, or no ranges, or the folder does not exist.
        ModelError: If the URDF was changed, or a link of it is impossible.
        SettingsError: If the target is a folder.
    """
    result, goal = load_result(path), Path(target)
    model, pi = result.identified
    sources = (entry["path"] for entry in result.content["inputs"] if entry["role"] == "urdf")
    files, original = [str(goal)], next(sources, None)
    notes: Sequence[str] = ()
    match kind:
        case "mjcf":
            notes = write_mjcf(model, pi, goal, original=original)
        case "sdf":
            notes = write_sdf(model, pi, goal, original=original)
        case "urdf":
            files.append(str(write_urdf(model, pi, goal, dynamics=True)))
            terms = [name for name, term in TERMS.items() if term.dynamics]
            notes = unstated_terms(model, pi, "URDF", terms)
        case _:
            if "ranges" not in result.content:
                raise DataError(
                    f"{result.path.name} has no ranges: an earlier version wrote it; identify again"
                )
            write_text(ranges_text(result.content["ranges"]), goal)
    return {"result": str(path), "format": kind, "files": files, "not_stated": list(notes)}
