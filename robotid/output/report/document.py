"""The report of an identification as one self-contained HTML file."""

from collections.abc import Mapping
from pathlib import Path

from robotid.base.files import write_text
from robotid.identification.result import Identification, TorqueIdentification
from robotid.output.report.next_steps import Origin
from robotid.output.report.report_page import page_of
from robotid.output.report.torque_report import torque_report


def write_report(
    identification: Identification,
    target: str | Path,
    *,
    files: Mapping[str, str] | None = None,
    origin: Origin | None = None,
) -> Path:
    """Write the report of an identification as one HTML file, with links to files by their kind."""
    at, replay = origin or Origin(), (files or {}).get("replay", "")
    if isinstance(identification, TorqueIdentification):
        report = torque_report(identification, at, replay)
    else:  # modules of the simulation are imported here
        from robotid.identification.closed_loop.from_commands import PositionIdentification
        from robotid.output.report.position_page import position_report

        assert isinstance(identification, PositionIdentification)
        report = position_report(identification, at, replay)
    return write_text(page_of(report, files or {}), target)
