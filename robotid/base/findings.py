"""Findings about logs, a robot or a result: data, of which sentences are made."""

import difflib
import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from string import Formatter
from typing import Any

_SPREAD = 0.1  # of the numbers of a setting that is given once for several findings
_RANK = {"error": 0, "warning": 1, "note": 2}
_FACTORS = {" %": 100.0, " ms": 1e3}  # of the units that a slot may have
#: Words that name subjects: sentences that differ only in them are one.
_NAMES = ("joint", "joints", "link", "links", "channel", "setting", "flag")


@dataclass(frozen=True)
class Finding:
    """A fault or a property that a user must know."""

    code: str  # a fixed word for programs
    severity: str  # "note", "warning" or "error"
    where: str  # its subject: a link, a joint, a parameter or a file
    message: str  # the fault, the value found, the value expected, the remedy
    evidence: Mapping[str, float] = field(default_factory=dict)  # numbers it depends on, by name
    log: str = ""  # the log concerned
    joints: tuple[str, ...] = ()  # the joints concerned
    words: Mapping[str, str] = field(default_factory=dict)  # texts of the message, by name
    fault: str = ""  # template of the message, with slots for numbers and words; if there is one
    remedy: str = ""  # template of its second part

    def reworded(self, **changes: Any) -> "Finding":  # noqa: ANN401
        """Return the finding with other fields, and the message that follows from them."""
        other = replace(self, **changes)
        added = other.remedy.removeprefix(self.remedy)
        return replace(other, message=sentence([other]) if other.fault else self.message + added)


@dataclass(frozen=True)
class Cause:
    """Findings of one code, which probably have a common cause."""

    code: str
    severity: str  # the highest of the findings
    joints: tuple[str, ...]  # those concerned, in the order of the robot; none: the whole robot
    messages: tuple[str, ...]  # those that differ only in names and numbers are one sentence
    findings: tuple[Finding, ...]  # by descending severity


def not_ignored(findings: Iterable[Finding], ignore: Collection[str]) -> tuple[Finding, ...]:
    """Return the findings whose codes are not ignored."""
    return tuple(finding for finding in findings if finding.code not in ignore)


def listed(names: Iterable[object], limit: int | None = None) -> str:
    """Return names as text, "a, b and 12 more"."""
    words = [str(name) for name in names]
    shown = words[:limit]
    more = f" and {len(words) - len(shown)} more" if len(words) > len(shown) else ""
    return (", ".join(shown) or "none") + more


def suggestion(name: str, known: Collection[str]) -> str:
    """Return ". Did you mean 'x'?" for the most similar known name, or "" if none is similar."""
    near = difflib.get_close_matches(name, known, n=1)
    return f". Did you mean {near[0]!r}?" if near else ""


def quoted(name: str) -> str:
    """Return a name as text of a job file."""
    return json.dumps(name, ensure_ascii=False)


def toml_key(name: str) -> str:
    """Return a name as a key of a job file, in quotes if required."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else quoted(name)


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings with the errors first, then warnings, then notes."""
    return tuple(sorted(findings, key=lambda finding: _RANK[finding.severity]))


def grouped(findings: Iterable[Finding], joints: Sequence[str] = ()) -> tuple[Cause, ...]:
    """Return findings by cause, by descending severity; notes apart from what is no note."""
    by_code: dict[tuple[str, bool], list[Finding]] = {}
    for finding in by_severity(findings):
        by_code.setdefault((finding.code, finding.severity == "note"), []).append(finding)
    causes = []
    for (code, _), alike in by_code.items():
        about = {joint for finding in alike for joint in finding.joints or (finding.where,)}
        named = tuple(joint for joint in joints if joint in about)
        messages = tuple(dict.fromkeys(map(sentence, _alike(alike))))
        causes.append(Cause(code, alike[0].severity, named, messages, tuple(alike)))
    return tuple(causes)


def tally(causes: Sequence[Cause], worst: str = "", how: str = "") -> str:
    """Return the number of messages by severity, how to see the notes, and the worst joint."""
    counts = Counter(cause.severity for cause in causes for _ in cause.messages)
    words = ", ".join(f"{n} {kind}{'s' * (n != 1)}" for kind, n in counts.items())
    words += how if "note" in counts else ""
    return f"{words}; worst: {worst}" if worst and set(counts) - {"note"} else words


def sentence(findings: Sequence[Finding]) -> str:
    """Return the message of findings with one template.

    A slot has a format, and may end in " %" or " ms", which scale its number, or in " %~" if the
    unit is not written; "|" is its absolute value. Of several findings it is the range of their
    numbers, or by its conversion the middle one (!t, which a user types), the smallest (!l), the
    largest (!h), or that of the finding with the largest last of such slots (!w). Names are joined,
    in quotes by !q.
    """
    first = findings[0]
    if not first.fault:
        return first.message
    template, text = first.fault + first.remedy, []
    worst = [name for _, name, _, how in Formatter().parse(template) if name and how == "w"]
    last = max(findings, key=lambda x: x.evidence[worst[-1]] if worst else 0.0)
    for literal, name, spec, how in Formatter().parse(template):
        text.append(literal)
        if name is not None:
            chosen = [last] if how == "w" else findings
            values = [x.words[name] if name in x.words else x.evidence[name] for x in chosen]
            text.append(_filled(values, spec or "", how or ""))
    logs = ", ".join(dict.fromkeys(finding.log for finding in findings))
    return f"{logs}: {''.join(text)}" if logs else "".join(text)


def _filled(values: Sequence[str | float], spec: str, how: str) -> str:
    """Return names with commas, or the range of numbers, or one of them."""
    numbers = sorted(value for value in values if not isinstance(value, str))
    if not numbers:
        each = dict.fromkeys(map(str, values))  # names, or lists of names: each is given once
        each = each if len(each) < 2 else dict.fromkeys(", ".join(each).split(", "))
        names = [f"'{x}'" if how == "q" else x for x in each]
        return (" " if names[0].startswith("--") else ", ").join(names)
    bare = spec.removesuffix("~")
    unit = next((unit for unit in _FACTORS if bare.endswith(unit)), "")
    plain, factor = bare.removesuffix(unit).removeprefix("|"), _FACTORS.get(unit, 1.0)
    numbers = sorted(map(abs, numbers)) if spec.startswith("|") else numbers
    places = {"t": [(len(numbers) - 1) // 2], "l": [0], "h": [-1]}.get(how, [0, -1])
    ends = [format(factor * numbers[k], plain) for k in places]
    return " to ".join(dict.fromkeys(ends)) + unit * (not spec.endswith("~"))


def _alike(findings: Sequence[Finding]) -> list[list[Finding]]:
    """Return the findings whose messages differ only in names and numbers, in groups."""
    # settings and logs with other joints are apart, unless one log has all of the joints
    groups: dict[tuple[object, ...], list[Finding]] = {}
    for k, finding in enumerate(findings):
        other = tuple(sorted(x for x in finding.words.items() if x[0] not in _NAMES))
        key = (finding.fault, finding.remedy, other) if finding.fault else (finding.message, k)
        groups.setdefault(key, []).append(finding)
    apart: list[list[Finding]] = []
    for group in groups.values():
        of_log: dict[str, frozenset[str]] = {}
        for finding in group:
            of_log[finding.log] = of_log.get(finding.log, frozenset()).union(finding.joints)
        same: dict[frozenset[str], list[Finding]] = {}
        every = frozenset[str]().union(*of_log.values())
        for finding in group:
            key_joints = every if every in of_log.values() else of_log[finding.log]
            same.setdefault(key_joints, []).append(finding)
        for members in same.values():
            apart += [[x] for x in members] if _are_far(members) else [members]
    return apart


def _are_far(findings: Sequence[Finding]) -> bool:
    """Whether numbers to type differ by more than a tenth of the largest."""
    slots = Formatter().parse(findings[0].fault + findings[0].remedy)
    for name in (name for _, name, _, how in slots if name and how == "t"):
        numbers = [finding.evidence[name] for finding in findings]
        if max(numbers) - min(numbers) > _SPREAD * max(map(abs, numbers)):
            return True
    return False
