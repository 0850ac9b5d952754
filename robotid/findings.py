"""What a user should know of logs, of a robot or of a result."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

__all__ = ["Finding", "by_severity", "listed", "log_finding"]

_RANK = {"error": 0, "warning": 1, "note": 2}


@dataclass(frozen=True)
class Finding:
    """Something a user must know.

    Attributes:
        code: A fixed word for programs.
        severity: "note", "warning" or "error".
        where: What it is about: a link, a joint, a parameter or a file.
        message: What was found, what was wanted, what to do.
        evidence: The figures it rests on, by name.
    """

    code: str
    severity: str
    where: str
    message: str
    evidence: Mapping[str, float] = field(default_factory=dict)


def log_finding(
    log: str, code: str, severity: str, message: str, part: str = "", /, **evidence: float
) -> Finding:
    """Return what was found in a log.

    Args:
        log: Name of the log, which the message is made to begin with.
        code: A fixed word for programs.
        severity: "note", "warning" or "error".
        message: What was found, what was wanted, what to do.
        part: Joint, link or channel that it is about; the whole log if empty.
        evidence: The figures it rests on, by name.

    Returns:
        The finding.
    """
    where = f"{log}: {part}" if part else log
    figures = {name: float(value) for name, value in evidence.items()}
    return Finding(code, severity, where, f"{log}: {message}", figures)


def listed(names: Iterable[object], limit: int | None = None) -> str:
    """Return names as a sentence holds them, "a, b and 12 more".

    Args:
        names: The names.
        limit: How many of them are named; all if None.

    Returns:
        The names with commas; "none" if there is none.
    """
    words = [str(name) for name in names]
    shown = words[:limit]
    more = f" and {len(words) - len(shown)} more" if len(words) > len(shown) else ""
    return (", ".join(shown) or "none") + more


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings with the errors first, then warnings, then notes.

    Args:
        findings: The findings; those of one severity keep their order.

    Returns:
        The same, sorted.
    """
    return tuple(sorted(findings, key=lambda finding: _RANK[finding.severity]))
