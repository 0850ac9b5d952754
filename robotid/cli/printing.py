"""Text of what commands found: lines that fit the terminal, findings, recordings, verdicts."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid._text import terminal_width, tinted, wrapped
from robotid.findings import Finding, grouped

if TYPE_CHECKING:
    from robotid.report.advice import Step


__all__ = [
    "as_finding",
    "print_block",
    "print_causes",
    "print_files",
    "print_steps",
    "print_verdict",
    "recordings_of",
    "say",
    "window_name",
]


def say(text: str, hang: str = "", tone: str = "") -> None:
    """Print text in lines that the terminal holds.

    Args:
        text: The text.
        hang: What a line that goes on begins with.
        tone: A word of it that is shown in its colour, as "error" is, on a terminal that has some;
            the environment variable NO_COLOR ends it.
    """
    print(tinted(wrapped(text, terminal_width(), hang), tone, tone, sys.stdout))


def print_files(folder: str, names: Sequence[str]) -> None:
    """Print which files were written, each on a line of its own.

    Args:
        folder: Where.
        names: Their names.
    """
    print("\nwritten:")
    for name in names:
        print(f"  {Path(folder) / name}")


def print_steps(steps: "Sequence[Step]") -> None:
    """Print what to do next, each step with what to type, on lines to copy.

    Args:
        steps: The steps.
    """
    print("\ndo next:")
    for number, step in enumerate(steps, start=1):
        say(f"  {number}. {step.words}", "   ")
        for block in step.blocks:
            print("\n".join(f"       {line}" for line in block.split("\n")))


def print_block(*lines: str) -> None:
    """Print lines after an empty one.

    Args:
        lines: The lines.
    """
    print("\n" + "\n".join(lines))


def print_causes(
    findings: Sequence[Mapping[str, Any]],
    joints: Sequence[str],
    *,
    is_verbose: bool,
    worst: str = "",
    said: Sequence[str] = (),
) -> None:
    """Print findings by their cause, then how many there are; notes only where they are wanted.

    Args:
        findings: As a command has them, with code, severity, message and where.
        joints: Names, of joints or links, that findings may be about.
        is_verbose: Whether notes are printed.
        worst: What is worst off.
        said: Messages that are printed elsewhere.
    """
    shown = [f for f in findings if is_verbose or f["severity"] != "note"]
    causes = grouped([Finding(**as_finding(f)) for f in shown], joints)
    for cause in causes:
        for message in cause.messages:
            if message not in said:
                say(f"{cause.severity}: {cause.code}: {message}", "  ", cause.severity)
    hidden = len(findings) - len(shown)
    notes = f"{_some(hidden, 'note')} hidden (--verbose)" if hidden else ""
    if shown:
        count = f"{_some(len(shown), 'finding')}, {_some(len(causes), 'cause')}"
        notes = count + (f"; worst: {worst}" if worst else "") + (f"; {notes}" if notes else "")
    say(notes or "nothing was found")


def as_finding(found: Mapping[str, Any]) -> dict[str, Any]:
    """Return what ``Finding`` takes of a finding in JSON.

    Args:
        found: The finding, of more keys.
    """
    return {key: found[key] for key in ("code", "severity", "where", "message")}


def _some(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def recordings_of(inputs: Sequence[Mapping[str, Any]], role: str) -> list[str]:
    """Return the file of each recording of a role, with its path if others have its name.

    Args:
        inputs: Inputs, as result.json has them.
        role: The role.
    """
    paths = {Path(entry["path"]) for entry in inputs}
    names = [path.name for path in paths]
    files = {str(path): path.name if names.count(path.name) == 1 else str(path) for path in paths}
    return [
        window_name(files[str(Path(entry["path"]))] or "log", entry)
        for entry in inputs
        if entry["role"] == role
    ]


def window_name(name: str, entry: Mapping[str, Any]) -> str:
    """Return the name of a recording with the part of its log.

    Args:
        name: The name.
        entry: Its start and end [s].
    """
    return f"{name} {entry['start']:.4g}-{entry['end']:.4g} s"


def print_verdict(verdict: Mapping[str, Any]) -> None:
    """Print a verdict.

    Args:
        verdict: Status, reasons and joints, as in result.json.
    """
    from robotid.identification.summary import verdict_lines

    first, *others = verdict_lines(verdict)
    say(f"\n{first}", tone=verdict["status"])
    for line in others:
        status = line.partition(": ")[2].partition(":")[0]
        say(line, "  ", "" if line.startswith("  - ") else status)
