"""The content of a report, on torques or on positions, and its page."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, TypeVar

from robotid.base.findings import Cause, Finding, grouped, tally
from robotid.base.versions import __version__
from robotid.diagnosis.verdict.verdict import uses_line
from robotid.estimation.fitting.evaluation import Evaluated
from robotid.identification.result import Identification
from robotid.identification.summary import verdict_cell
from robotid.output.pages.html import (
    Section,
    block,
    code,
    command_html,
    facts_html,
    folded,
    page,
    verdict_html,
)
from robotid.output.report.dock import Clip, Dock, Residual, worst_html, worst_second
from robotid.output.report.errors import Errors, Quantity, error_bars, error_table, worst_errors
from robotid.output.report.next_steps import Origin, Step
from robotid.output.report.tables import sources_fact

_ROWS = 24_000  # of all charts: about half a MB
_LONGEST = 2000  # rows of one chart
_OPEN = 2  # joints that are open at most
_MOST_PLOTS = 84  # twelve recordings of a 7-joint arm

EvaluatedT = TypeVar("EvaluatedT", bound=Evaluated)


@dataclass(frozen=True)
class Report:
    """The content of a report. Texts are HTML."""

    title: str  # title of the page, not escaped
    robot: str  # name of the robot, not escaped
    rows: Sequence[str]  # names of its joints
    verdict: Mapping[str, Any]  # the verdict, as in result.json
    findings: Sequence[Finding]
    quantity: Quantity  # the predicted quantity
    counted: Sequence[Errors]  # the recordings whose errors the verdict uses
    recordings: Sequence[Errors]  # all recordings
    facts: Mapping[str, str]  # figures by their names
    steps: Sequence[Step]  # the next steps
    made: str  # description of the identification
    errors: tuple[str, str]  # definition of the errors, and content after their tables
    curves: tuple[str, str]  # title and content of the section of charts over time
    why: str  # residual analysis of each joint; "" if there is none
    parameters: str  # content of the section of parameters
    entries: Sequence[Mapping[str, Any]]  # the parameters, as in result.json
    # title and content of the parts of the appendix, by their keys
    appendix: Mapping[str, tuple[str, str]]
    friction: str = ""  # friction against speed; "" if there is none
    bodies: str = ""  # pictures of the links, URDF and identified; "" if there are none
    variation: str = ""  # variation of drive parameters between logs; "" for fewer than three logs

    @property
    def verdicts(self) -> Mapping[str, Mapping[str, Any]]:
        """The verdict on each joint."""
        verdicts: Mapping[str, Mapping[str, Any]] = self.verdict.get("per_joint", {})
        return verdicts


def first_screen(report: Report, files: Mapping[str, str]) -> str:
    """Return the HTML of the first screen: verdict, figures, errors of joints, next steps."""
    verdict, uses = report.verdict, uses_line(report.verdict.get("use_for", {}))
    uses = f"{uses[:1].upper()}{uses[1:]}." if uses else ""
    return block(
        "report.first",
        verdict=verdict_html(report.robot, verdict["status"], verdict["reasons"], uses),
        facts=facts_html({**report.facts, **sources_fact(report.entries)}, files),
        bars=error_bars(
            report.quantity, report.counted, report.rows, report.verdicts, has_why=bool(report.why)
        ),
        steps=_steps(report.steps),
    )


def _steps(steps: Sequence[Step]) -> str:
    """Return the HTML of the next steps; nothing if there are none."""
    items = "".join(
        f"<li><p>{escape(step.words)}</p>"
        + "".join(f'<div class="copy">{command_html(text)}</div>' for text in step.blocks)
        + "</li>\n"
        for step in steps
    )
    return f'<h2 id="next">Do next</h2>\n<ol class="next">{items}</ol>\n' if items else ""


def page_of(report: Report, files: Mapping[str, str]) -> str:
    """Return the HTML of the report."""
    worst, (definition, after) = list(worst_errors(report.counted)), report.errors
    tables = "".join(
        error_table(report.quantity, errors, report.rows, report.verdicts)
        for errors in report.recordings
    )
    count = sum(entry["source"] in ("data", "mixed") for entry in report.entries)
    determined = f"{count} of {len(report.entries)} determined by the data, fully or partly"
    appendix = "".join(
        folded(key, title, html) for key, (title, html) in report.appendix.items() if html
    )
    causes = grouped(report.findings, report.rows)
    findings = "".join(map(_cause, causes)) or "<p>None.</p>\n"
    notes = [cause for cause in causes if cause.severity == "note"]
    serious = [cause for cause in causes if cause.severity != "note"]
    line = tally(serious, notes, escape(next(iter(worst), ""))) or "none"
    by_log = f"{len(report.verdicts)} joints, by recording"
    sections = {
        "errors": Section("Errors", f"{definition}{tables}{after}", by_log, False),
        "findings": Section("Findings", findings, line, False),
        "friction": Section("Friction against speed", report.friction),
        "curves": Section(*report.curves),
        "why": Section("Residual analysis", report.why, "torque components of each joint", False),
        "variation": Section("Variation between logs", report.variation, "", False),
        "bodies": Section("Links", report.bodies),
        "parameters": Section("Parameters", report.parameters, determined, False),
        "appendix": Section("Appendix", appendix),
    }
    written = block("report.written", version=__version__)
    made = folded("made", "Method and data", f"{report.made}{written}")
    known = {key: section for key, section in sections.items() if section.html}
    return page(report.title, first_screen(report, files) + made, known)


def _cause(cause: Cause) -> str:
    """Return one cause: its messages, and each finding where there are several."""
    findings = ""
    if len(cause.findings) > len(cause.messages):
        items = "".join(f"<li>{escape(finding.message)}</li>" for finding in cause.findings)
        title = f"all {len(cause.findings)} findings"
        findings = f"<details><summary>{title}</summary><ul>{items}</ul></details>\n"
    return block(
        "report.cause",
        severity=cause.severity,
        key=escape(cause.code),
        code=code(cause.code).html,
        about=f": {escape(', '.join(cause.joints))}" if cause.joints else "",
        messages="".join(f"<p>{escape(message)}</p>\n" for message in cause.messages),
        findings=findings,
    )


def drawn(runs: Sequence[EvaluatedT], rows: Sequence[str]) -> Sequence[EvaluatedT]:
    """Return the recordings that are drawn: the first ones, to limit the page's size."""
    return runs[: max(1, _MOST_PLOTS // len(rows))]


def curves_section(
    found: Identification,
    evaluations: Sequence[EvaluatedT],
    worst: Sequence[str],
    dock: tuple[str, Origin],
    intro: str,
    charts: Callable[[EvaluatedT, int, str, int], str],
    residuals: Callable[[int], Iterable[Residual]],
    quantity: Quantity,
    units: Sequence[str],
    most: int = _OPEN,
) -> str:
    """A part for each joint; the worst joint and the worst ones that are not good are open.

    ``dock`` is the file of the replay and the source of the result.
    """
    rows, verdicts = found.model.row_names, found.verdict.to_dict()["per_joint"]
    shown = drawn(evaluations, rows)
    runs = {f"recording {k}": e for k, e in enumerate(shown)}
    clips = [Clip(link, str(e.log.path), e.extent.start, e.extent.end) for link, e in runs.items()]
    player = Dock(*dock, str(found.model.tree.path), clips)
    points = min(_LONGEST, max(200, _ROWS // (2 * len(rows) * max(1, len(runs)))))
    parts, first = [player.html, intro], [*worst][:most]
    if left := [e.name for e in evaluations[len(shown) :]]:
        parts.append(block("report.not_drawn", names=escape(", ".join(left))))
    for row, name in enumerate(rows):
        status = verdict_cell(name, verdicts[name]) if name in verdicts else ""
        unit = f"{quantity.prefix}{units[row]}"
        note = worst_html(worst_second(residuals(row)), name, unit, player, quantity.scale)
        html = note + "".join(charts(e, row, link, points) for link, e in runs.items())
        summary = f"<strong>{code(name).html}</strong> {escape(status)}"
        is_open = name in first[:1] or (status.startswith(("poor", "usable")) and name in first)
        parts.append(folded(f"joint-{row}", summary, html, is_open=is_open))
    return "".join(parts)
