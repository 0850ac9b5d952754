"""The content of a report, on torques or on positions, and its page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from robotid.base.findings import Finding
from robotid.base.versions import __version__
from robotid.diagnosis.verdict.uses import uses_line
from robotid.output.pages.html import Section, facts_html, folded, page, steps_html, verdict_html
from robotid.output.report.causes_section import findings_line, findings_section
from robotid.output.report.errors import Errors, Quantity, error_bars, error_table, worst_errors
from robotid.output.report.steps import Step
from robotid.output.report.tables import sources_fact

_WRITTEN = (
    f"Written by robotid {__version__}. SI units throughout; inertial parameters in Pinocchio's "
    "order, inertias about the joint frame."
)


@dataclass(frozen=True)
class Shown:
    """The content of a report. Texts are HTML.

    Attributes:
        title: Title of the page, not escaped.
        robot: Name of the robot, not escaped.
        rows: Names of its joints.
        verdict: The verdict, as in result.json.
        findings: The findings.
        quantity: The predicted quantity.
        counted: The recordings whose errors the verdict uses.
        recordings: All recordings.
        facts: Figures by their names.
        steps: The next steps.
        made: Description of the identification.
        errors: Definition of the errors, and content after their tables.
        curves: Title and content of the section of charts over time.
        why: Residual analysis of each joint; "" if there is none.
        parameters: Content of the section of parameters.
        entries: The parameters, as in result.json.
        appendix: Title and content of the parts of the appendix, by their keys.
        friction: Friction against speed; "" if there is none.
        bodies: Pictures of the links, URDF and identified; "" if there are none.
        variation: Variation of drive parameters between logs; "" for fewer than three logs.
    """

    title: str
    robot: str
    rows: Sequence[str]
    verdict: Mapping[str, Any]
    findings: Sequence[Finding]
    quantity: Quantity
    counted: Sequence[Errors]
    recordings: Sequence[Errors]
    facts: Mapping[str, str]
    steps: Sequence[Step]
    made: str
    errors: tuple[str, str]
    curves: tuple[str, str]
    why: str
    parameters: str
    entries: Sequence[Mapping[str, Any]]
    appendix: Mapping[str, tuple[str, str]]
    friction: str = ""
    bodies: str = ""
    variation: str = ""

    @property
    def verdicts(self) -> Mapping[str, Mapping[str, Any]]:
        """The verdict on each joint."""
        verdicts: Mapping[str, Mapping[str, Any]] = self.verdict.get("per_joint", {})
        return verdicts


def first_screen(shown: Shown, files: Mapping[str, str]) -> str:
    """Return the HTML of the first screen: verdict, figures, errors of joints, next steps."""
    facts = {**shown.facts, **sources_fact(shown.entries)}
    bars = error_bars(
        shown.quantity, shown.counted, shown.rows, shown.verdicts, has_why=bool(shown.why)
    )
    steps = steps_html((step.words, step.blocks) for step in shown.steps)
    verdict = shown.verdict
    uses = uses_line(verdict.get("use_for", {}))
    uses = f"{uses[:1].upper()}{uses[1:]}." if uses else ""
    return (
        f"{verdict_html(shown.robot, verdict['status'], verdict['reasons'], uses)}"
        f"{facts_html(facts, files)}"
        f'<div class="halves">\n<div>{bars}</div>\n<div>{steps}</div>\n</div>\n'
    )


def page_of(shown: Shown, files: Mapping[str, str]) -> str:
    """Return the HTML of the report."""
    worst = list(worst_errors(shown.counted))
    definition, after = shown.errors
    tables = "".join(
        error_table(shown.quantity, errors, shown.rows, shown.verdicts)
        for errors in shown.recordings
    )
    found = sum(entry["source"] in ("data", "mixed") for entry in shown.entries)
    appendix = "".join(
        folded(key, title, html) for key, (title, html) in shown.appendix.items() if html
    )
    line = findings_line(shown.findings, shown.rows, next(iter(worst), ""))
    sections = {
        "errors": Section(
            "Errors", f"{definition}{tables}{after}", f"{len(shown.verdicts)} joints, by recording",
            False,
        ),
        "findings": Section(
            "Findings", findings_section(shown.findings, shown.rows, worst), line, False
        ),
        "friction": Section("Friction against speed", shown.friction),
        "curves": Section(*shown.curves),
        "why": Section("Residual analysis", shown.why, "torque components of each joint", False),
        "variation": Section("Variation between logs", shown.variation, "", False),
        "bodies": Section("Links", shown.bodies),
        "parameters": Section(
            "Parameters",
            shown.parameters,
            f"{found} of {len(shown.entries)} determined by the data, fully or partly",
            False,
        ),
        "appendix": Section("Appendix", appendix),
    }  # fmt: skip
    made = folded("made", "Method and data", f'{shown.made}<p class="note">{_WRITTEN}</p>\n')
    there = {key: section for key, section in sections.items() if section.html}
    return page(shown.title, first_screen(shown, files) + made, there)
