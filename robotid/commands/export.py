"""A written result in the formats of simulators."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from robotid._files import write_text
from robotid.exceptions import DataError
from robotid.export.links import unstated_terms
from robotid.export.mjcf import write_mjcf
from robotid.export.ranges import ranges_text
from robotid.export.result import Result, load_result
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
    result = load_result(path)
    files, notes = _WRITERS[kind](result, Path(target))
    return {"result": str(path), "format": kind, "files": files, "not_stated": list(notes)}


def _urdf(result: Result, target: Path) -> tuple[list[str], list[str]]:
    model, pi = result.identified
    sidecar = write_urdf(model, pi, target, dynamics=True)
    terms = [name for name, term in TERMS.items() if term.dynamics]
    return [str(target), str(sidecar)], unstated_terms(model, pi, "URDF", terms)


def _simulator(
    write: Callable[..., tuple[str, ...]], result: Result, target: Path
) -> tuple[list[str], tuple[str, ...]]:
    originals = (entry["path"] for entry in result.content["inputs"] if entry["role"] == "urdf")
    notes = write(*result.identified, target, original=next(originals, None))
    return [str(target)], notes


def _ranges(result: Result, target: Path) -> tuple[list[str], list[str]]:
    if "ranges" not in result.content:
        reason = (
            "it was written by an earlier version; identify again"
            if result.has_urdf
            else f"its parameters are wrong or impossible: {result.verdict['reasons'][0]}"
        )
        raise DataError(f"{result.path.name} has no ranges, for {reason}")
    write_text(ranges_text(result.content["ranges"]), target)
    return [str(target)], []


_WRITERS: Mapping[str, Callable[[Result, Path], Any]] = {
    "urdf": _urdf,
    "mjcf": partial(_simulator, write_mjcf),
    "sdf": partial(_simulator, write_sdf),
    "ranges": _ranges,
}
