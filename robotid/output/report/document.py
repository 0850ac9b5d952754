"""The report of an identification as one self-contained HTML file."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from robotid.base.files import write_text
from robotid.base.settings import require_each, require_kind
from robotid.identification.result import Identification
from robotid.output.files.entries import build_result
from robotid.output.report.report_page import Report, page_of
from robotid.output.report.steps import Origin
from robotid.output.report.tables import variation_section
from robotid.output.report.torque_report import torque_report

if TYPE_CHECKING:
    from robotid.identification.closed_loop.loop_result import LoopIdentification


def write_report(
    identification: "Identification | LoopIdentification",
    target: str | Path,
    *,
    files: Mapping[str, str] | None = None,
    origin: Origin | None = None,
) -> Path:
    """Write the report of an identification: result, verdict and evidence, as one HTML file.

    The file loads no other file. It is written atomically.

    Args:
        identification: The identification.
        target: The file to write.
        files: Files of the same folder to link to, by their kind, as "URDF".
        origin: Source and folder of the results, for the commands of the report; commands that
            need more than is given are left out.

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
        report = torque_report(identification, at, (files or {}).get("replay", ""))
    else:
        report = _of_loops(identification, at, (files or {}).get("replay", ""))
    return write_text(page_of(report, files or {}), target)


def _of_loops(found: "LoopIdentification", at: Origin, replay: str) -> Report:
    """Return the content of a report on a closed-loop identification; imported when needed."""
    from robotid.identification.closed_loop.loop_result import LoopIdentification
    from robotid.output.report.position_page import shown_positions

    require_kind(found, LoopIdentification, "identification", "a robotid.Identification")
    result = build_result(found, {"estimator": found.estimator.to_dict()})
    report = shown_positions(
        result, found.fitted, found.validation, at, (found.model, found.standard), replay
    )
    return replace(report, variation=variation_section(found.variation, {}))
