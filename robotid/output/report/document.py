"""The report of an identification as one self-contained HTML file."""

from collections.abc import Mapping
from pathlib import Path

from robotid.base.files import write_text
from robotid.base.settings import require_each, require_kind
from robotid.identification.result import Identification, TorqueIdentification
from robotid.output.report.report_page import Report, page_of
from robotid.output.report.steps import Origin
from robotid.output.report.torque_report import torque_report


def write_report(
    identification: Identification,
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
    require_kind(identification, Identification, "identification", "a robotid.Identification")
    replay = (files or {}).get("replay", "")
    if isinstance(identification, TorqueIdentification):
        report = torque_report(identification, at, replay)
    else:
        report = _of_positions(identification, at, replay)
    return write_text(page_of(report, files or {}), target)


def _of_positions(found: Identification, origin: Origin, replay: str) -> Report:
    """Return the content of a report on positions; modules of the simulation are imported here."""
    from robotid.identification.closed_loop.loop_result import PositionIdentification
    from robotid.output.report.position_page import position_report

    assert isinstance(found, PositionIdentification)
    return position_report(found, origin, replay)
