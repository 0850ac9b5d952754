"""Findings about logs, a robot or a result."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

_SPREAD = 0.1  # of the numbers of a setting that is stated once for several findings
_RANK = {"error": 0, "warning": 1, "note": 2}
_NUMBER = r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w|\.\w)"
_RANGE = rf"{_NUMBER}(?: to {_NUMBER})?"
#: Text for a user to type: a flag with its value, or a key of a job file with its value.
_TYPED = (
    r"--[a-z][a-z-]* [^\s,;)]+"
    r"|(?<![\w.])[\w.-]{3,} = (?:\[[^\]]*\]|\{[^}]*\}|\"[^\"]*\"|[-+]?\d[\d.]*(?:e[-+]?\d+)?)"
)


@dataclass(frozen=True)
class Finding:
    """A fault or a property that a user must know.

    Attributes:
        code: A fixed word for programs.
        severity: "note", "warning" or "error".
        where: Its subject: a link, a joint, a parameter or a file.
        message: The fault, the value found, the value expected, the remedy.
        evidence: The numbers it depends on, by name.
    """

    code: str
    severity: str
    where: str
    message: str
    evidence: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Cause:
    """Findings of one code, which probably have a common cause.

    Attributes:
        code: The code.
        severity: The highest severity of the findings.
        joints: The joints concerned, in the order of the robot; none: the whole robot.
        messages: Their messages; those that differ only in names and numbers are one sentence.
        findings: The findings, by descending severity.
    """

    code: str
    severity: str
    joints: tuple[str, ...]
    messages: tuple[str, ...]
    findings: tuple[Finding, ...]


def log_finding(
    log: str, code: str, severity: str, message: str, part: str = "", /, **evidence: float
) -> Finding:
    """Return a finding about a log."""
    where = f"{log}: {part}" if part else log
    figures = {name: float(value) for name, value in evidence.items()}
    return Finding(code, severity, where, f"{log}: {message}", figures)


def not_ignored(findings: Iterable[Finding], ignore: Iterable[str]) -> tuple[Finding, ...]:
    """Return the findings whose codes are not ignored."""
    ignored = set(ignore)
    return tuple(finding for finding in findings if finding.code not in ignored)


def listed(names: Iterable[object], limit: int | None = None) -> str:
    """Return names as text, "a, b and 12 more"."""
    words = [str(name) for name in names]
    shown = words[:limit]
    more = f" and {len(words) - len(shown)} more" if len(words) > len(shown) else ""
    return (", ".join(shown) or "none") + more


def quoted(name: str) -> str:
    """Return a name as text of a job file."""
    return json.dumps(name, ensure_ascii=False)


def toml_key(name: str) -> str:
    """Return a name as a key of a job file, in quotes if required."""
    is_bare = re.fullmatch(r"[A-Za-z0-9_-]+", name) is not None
    return name if is_bare else json.dumps(name, ensure_ascii=False)


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings with the errors first, then warnings, then notes."""
    return tuple(sorted(findings, key=lambda finding: _RANK[finding.severity]))


def grouped(findings: Iterable[Finding], joints: Sequence[str] = ()) -> tuple[Cause, ...]:
    """Return findings by cause, by descending severity."""
    by_code: dict[str, list[Finding]] = {}
    for finding in by_severity(findings):
        by_code.setdefault(finding.code, []).append(finding)
    causes = []
    for code, found in by_code.items():
        about = {joint for finding in found for joint in _joints_of(finding, joints)}
        named = tuple(joint for joint in joints if joint in about)
        messages = _merged(found, joints)
        causes.append(Cause(code, found[0].severity, named, messages, tuple(found)))
    return tuple(causes)


def number_of(causes: Iterable[Cause]) -> int:
    """Return the number of findings; those with one common message count once."""
    return sum(len(cause.messages) for cause in causes)


def _joints_of(finding: Finding, joints: Sequence[str]) -> set[str]:
    """Return the joints in the subject of a finding: a joint, a channel or a parameter."""
    parts = finding.where.rpartition(": ")[2].split(", ")
    names = {x for p in parts for x in (p, p.partition("_")[2], p.rpartition(".")[0])}
    return names.intersection(joints)


def _merged(findings: Sequence[Finding], joints: Sequence[str]) -> tuple[str, ...]:
    """Return the messages; those that differ only in names of joints or logs and numbers are one.

    Text to type has one value, because a user cannot type a range of values. If no log has all the
    joints of a message, the logs with the same joints have one.
    """
    if len(findings) == 1:
        return (findings[0].message,)
    logs = {finding.where.rpartition(": ")[0] or finding.where for finding in findings}
    names = sorted({name for name in (*joints, *logs) if name}, key=len, reverse=True)
    named = "|".join(rf"'{x}'|(?<!\w){x}(?!\w)" for x in map(re.escape, names))
    slots = "|".join([_TYPED, *([named] if named else []), _RANGE])
    slot = re.compile(f"({slots})")
    alike: dict[tuple[str, ...], list[tuple[Finding, list[str]]]] = {}
    for finding in findings:
        parts = slot.split(finding.message)  # text, slot, text, slot, ..., text
        alike.setdefault(tuple(parts[::2]), []).append((finding, parts[1::2]))
    merged = []
    for texts, filled in (
        (x, own) for x, all_ in alike.items() for own in _by_joints(all_, joints)
    ):
        columns = list(zip(*filled, strict=True))
        if any(map(_are_far, columns)):  # one setting does not suit them all
            words = [list(values) for values in filled]
        else:
            words = [[_in_one(list(dict.fromkeys(values))) for values in columns]]
        merged += ["".join(a + b for a, b in zip(texts, [*own, ""], strict=True)) for own in words]
    return tuple(merged)


def _by_joints(
    filled: Sequence[tuple[Finding, list[str]]], joints: Sequence[str]
) -> list[list[list[str]]]:
    """Return the words of findings, together for logs with the same joints.

    They are together for all logs if one of them has all the joints: its own sentence is true.
    """
    of_log: dict[str, set[str]] = {}
    for finding, _ in filled:
        log = finding.where.rpartition(": ")[0]
        of_log.setdefault(log, set()).update(_joints_of(finding, joints))
    if set().union(*of_log.values()) in of_log.values():
        return [[words for _, words in filled]]
    found: dict[frozenset[str], list[list[str]]] = {}
    for finding, words in filled:
        own = of_log[finding.where.rpartition(": ")[0]]
        found.setdefault(frozenset(own), []).append(words)
    return list(found.values())


def _are_far(values: Sequence[str]) -> bool:
    """Whether settings to type differ in numbers alone, by more than a tenth of the largest."""
    if not all(re.fullmatch(_TYPED, value) for value in values):
        return False
    if len({re.sub(_NUMBER, "", value) for value in values}) > 1:
        return False
    numbers = zip(
        *([float(x) for x in re.findall(_NUMBER, value)] for value in values), strict=True
    )
    return any(max(own) - min(own) > _SPREAD * max(map(abs, own)) for own in numbers)


def _in_one(values: list[str]) -> str:
    """Return names with commas, the range of numbers, or the text to type for all of them."""
    if len(values) == 1:
        return values[0]
    if all(re.fullmatch(_TYPED, value) for value in values):
        return _typed_once(values)
    if not all(re.fullmatch(_RANGE, value) for value in values):
        return ", ".join(values)
    ends = [(value.split(" to ")[0], value.split(" to ")[-1]) for value in values]
    if any(float(first) > float(last) for first, last in ends):  # decreases are not ranges
        first, last = max(ends, key=lambda pair: float(pair[1]))  # the smallest decrease
        return f"{first} to {last}"
    numbers = [number for pair in ends for number in pair]
    return f"{min(numbers, key=float)} to {max(numbers, key=float)}"


def _typed_once(values: list[str]) -> str:
    """Return settings; of settings that differ only in their numbers, the middle one."""
    alike: dict[str, list[str]] = {}
    for value in values:
        alike.setdefault(re.sub(_NUMBER, "", value), []).append(value)
    middle = [
        sorted(own, key=lambda x: [float(y) for y in re.findall(_NUMBER, x)])[(len(own) - 1) // 2]
        for own in alike.values()
    ]
    return (" " if middle[0].startswith("--") else ", ").join(middle)
