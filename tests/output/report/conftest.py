from dataclasses import replace

import pytest

from robotid.base.findings import Finding
from robotid.output.report.report_content import write_report

FINDINGS = [
    Finding("late", "warning", "second.csv", "torque is 4 ms late"),
    Finding("alike", "error", "elbow_joint", "a column is there twice"),
    Finding("slow", "warning", "first.csv", "the motion is slow"),
]


@pytest.fixture(scope="session")
def report(identified, tmp_path_factory):
    """The report of the identified UR5, as HTML."""
    target = tmp_path_factory.mktemp("report") / "report.html"
    return write_report(replace(identified, findings=FINDINGS), target).read_text(encoding="utf-8")
