"""The report of an identification as one HTML file that fetches nothing."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from robotid._files import write_text
from robotid._settings import require_each, require_kind
from robotid.export.entries import build_result
from robotid.identification.result import Identification
from robotid.report.advice import Origin
from robotid.report.shown import Shown, page_of
from robotid.report.torques import shown_torques

if TYPE_CHECKING:
    from robotid.closed_loop.result import LoopIdentification

__all__ = ["write_report"]


def write_report(
    identification: "Identification | LoopIdentification",
    target: str | Path,
    *,
    files: Mapping[str, str] | None = None,
    origin: Origin | None = None,
) -> Path:
    """Write what an identification found, and how far to trust it, as one HTML file.

    The file fetches nothing. It is made beside its target and then put in place.

    Args:
        identification: What was found.
        target: The file to write.
        files: Files beside it to link to, by what they are, as "URDF".
        origin: How it was identified and where its results are, for the commands that it shows;
            none are shown that need what is not said.

    Returns:
        Path of the file.

    Raises:
        DataError: If the folder of the target does not exist.
    """
    require_kind(target, (str, Path), "target", "the path of a page to write")
    require_kind(files, (Mapping, type(None)), "files", "a table of file names")
    for what, name in (files or {}).items():
        require_each([what, name], str, "an entry of files", "text, and the name of a file")
    require_kind(origin, (Origin, type(None)), "origin", "an Origin")
    at = origin or Origin()
    if isinstance(identification, Identification):
        shown = shown_torques(identification, at)
    else:
        shown = _of_loops(identification, at)
    return write_text(page_of(shown, files or {}), target)


def _of_loops(found: "LoopIdentification", at: Origin) -> Shown:
    """Return what is shown of an identification by simulation, which few need to import."""
    from robotid.closed_loop.result import LoopIdentification
    from robotid.report.positions import shown_positions

    require_kind(found, LoopIdentification, "identification", "a robotid.Identification")
    result = build_result(found, {"estimator": found.estimator.to_dict()})
    return shown_positions(
        result, found.fitted, found.validation, at, (found.model, found.standard)
    )
