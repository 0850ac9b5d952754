"""Text output of commands: lines that fit the terminal, findings, recordings, verdicts."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid.base.findings import Finding, grouped, number_of
from robotid.base.text import command_lines, period, terminal_width, tinted, wrapped

if TYPE_CHECKING:
    from robotid.output.report.steps import Step


def echo(text: str, indent: str = "", tone: str = "") -> None:
    """Print text in lines that fit the terminal."""
    print(tinted(wrapped(text, terminal_width(), indent), tone, tone, sys.stdout))


def print_files(folder: str, names: Sequence[str]) -> None:
    """Print the files that were written, one per line."""
    print("\nwritten:")
    for name in names:
        print(f"  {Path(folder) / name}")


def print_steps(steps: "Sequence[Step]") -> None:
    """Print the next steps, each with its commands on separate lines, for copying."""
    print("\nnext steps:")
    for number, step in enumerate(steps, start=1):
        echo(f"  {number}. {step.words}", "   ")
        for block in step.blocks:
            lines = block.split("\n")
            if sys.stdout.isatty() and len(lines) == 1 and block.startswith("robotid "):
                lines = command_lines(block, terminal_width() - 7)
            print("\n".join(f"       {line}" for line in lines))


def print_block(*lines: str) -> None:
    """Print lines after an empty line."""
    print("\n" + "\n".join(lines))


def print_causes(
    findings: Sequence[Mapping[str, Any]],
    joints: Sequence[str],
    *,
    is_verbose: bool,
    worst: str = "",
    printed: Sequence[str] = (),
    none: str = "no findings",
) -> None:
    """Print findings by cause, then their number."""
    every = [Finding(**as_finding(f)) for f in findings]
    shown = [f for f in every if is_verbose or f.severity != "note"]
    causes, others = grouped(shown, joints), grouped([f for f in every if f not in shown], joints)
    for cause in causes:
        for message in cause.messages:
            if message not in printed:
                echo(f"{cause.severity}: {cause.code}: {message}", "  ", cause.severity)
    hidden = number_of(others)
    notes = f"{_some(hidden, 'note')} hidden (--verbose)" if hidden else ""
    if shown:
        count = f"{_some(number_of(causes), 'finding')}, {_some(len(causes), 'cause')}"
        notes = count + (f"; worst: {worst}" if worst else "") + (f"; {notes}" if notes else "")
    if summary := notes or none:
        echo(summary)


def as_finding(found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a ``Finding`` from a finding in JSON."""
    return {key: found[key] for key in ("code", "severity", "where", "message")}


def _some(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def recordings_of(inputs: Sequence[Mapping[str, Any]], role: str) -> list[str]:
    """Return the file of each recording of a role, with its path if names occur more than once."""
    paths = {Path(entry["path"]) for entry in inputs}
    names = [path.name for path in paths]
    files = {str(path): path.name if names.count(path.name) == 1 else str(path) for path in paths}
    return [
        window_name(files[str(Path(entry["path"]))] or "log", entry)
        for entry in inputs
        if entry["role"] == role
    ]


def window_name(name: str, entry: Mapping[str, Any]) -> str:
    """Return the name of a recording with its window of the log."""
    return f"{name} {period(entry['start'], entry['end'])}"


def print_verdict(verdict: Mapping[str, Any]) -> None:
    """Print a verdict."""
    from robotid.identification.summary import verdict_lines

    first, *others = verdict_lines(verdict)
    echo(f"\n{first}", tone=verdict["status"])
    for line in others:
        status = line.partition(": ")[2].partition(":")[0]
        echo(line, "  ", "" if line.startswith("  - ") else status)
