"""The section of findings: by cause and by joint."""

from collections.abc import Sequence
from html import escape

from robotid.base.findings import Cause, Finding, grouped, number_of
from robotid.output.pages.html import Cell, code, table


def findings_line(findings: Sequence[Finding], joints: Sequence[str], worst: str = "") -> str:
    """Return the number of findings and causes, and the worst joint."""
    causes, notes = (
        grouped([f for f in findings if (f.severity == "note") == is_note], joints)
        for is_note in (False, True)
    )
    of_notes = [_count(number_of(notes), "note")] if notes else []
    if not causes:
        return ", ".join(of_notes) or "none"
    counts = f"{_count(number_of(causes), 'finding')}, {_count(len(causes), 'cause')}"
    return "; ".join([counts, *([f"worst: {escape(worst)}"] if worst else []), *of_notes])


def findings_section(
    findings: Sequence[Finding], joints: Sequence[str], shown: Sequence[str]
) -> str:
    """Return the causes with their messages, by severity, and the causes of each joint."""
    causes = grouped(findings, joints)
    return _by_joint(shown, causes) + ("".join(map(_cause, causes)) or "<p>None.</p>\n")


def _cause(cause: Cause) -> str:
    """Return one cause: its messages, and each finding where there are several."""
    messages = "".join(f"<p>{escape(message)}</p>\n" for message in cause.messages)
    about = f": {escape(', '.join(cause.joints))}" if cause.joints else ""
    each = ""
    if len(cause.findings) > len(cause.messages):
        items = "".join(f"<li>{escape(finding.message)}</li>" for finding in cause.findings)
        title = f"all {len(cause.findings)} findings"
        each = f"<details><summary>{title}</summary><ul>{items}</ul></details>\n"
    return (
        f'<div class="cause {cause.severity}" id="cause-{escape(cause.code)}"><h3>'
        f"<strong>{cause.severity}</strong> {code(cause.code).html}{about}</h3>\n"
        f"{messages}{each}</div>\n"
    )


def _by_joint(shown: Sequence[str], causes: Sequence[Cause]) -> str:
    rows = []
    for joint in shown:
        mine = [cause for cause in causes if joint in cause.joints]
        if mine:
            serious, notes = (
                ", ".join(
                    f'<a href="#cause-{escape(cause.code)}">{escape(cause.code)}</a>'
                    for cause in mine
                    if (cause.severity == "note") == is_note
                )
                for is_note in (False, True)
            )
            rows.append([code(joint), Cell(serious or "–"), Cell(notes or "–")])
    if not rows:
        return ""
    return table(
        "Findings by joint, the worst first", ["joint", "errors and warnings", "notes"], rows
    )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
