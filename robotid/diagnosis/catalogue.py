"""The catalogue: what each code of a finding means, read from ``catalogue.toml``.

An entry has the severity, the message as a template, the remedy that follows it, the reason of a
verdict (``verdict``), whether an error may be ignored (``ignorable``), the next step
(``step``), the ``stage`` (see ``explanations``) and the page of the documentation (``page``, with
its ``cause`` and ``about``). Tables of an entry have parts of its sentences, of which a word given
to ``finding`` chooses one.
"""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from robotid.base.findings import Finding, listed


@cache
def entries() -> Mapping[str, Mapping[str, Any]]:
    """Return the entry of each code."""
    text = (Path(__file__).parent / "catalogue.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text)
    return {code: table.get(entry.get("like", ""), {}) | entry for code, entry in table.items()}


@cache
def codes_with(key: str) -> tuple[str, ...]:
    """Return the codes whose entries have a key, in order."""
    return tuple(code for code, entry in entries().items() if key in entry)


def step_of(code: str) -> str:
    """Return the next step that removes the cause of a finding; empty if there is none."""
    return str(entries().get(code, {}).get("step", ""))


def finding(
    code: str,
    log: str = "",
    joints: str | Sequence[str] = (),
    /,
    *,
    subject: Any = "",  # noqa: ANN401
    severity: Any = "",  # noqa: ANN401
    **values: float | str,
) -> Finding:
    """Return a finding: of a log and joints, or at another subject."""
    # Values are figures, words, or choices of parts; behind a colon is another sentence.
    entry, code = entries()[code], code.partition(":")[0]
    joints = (joints,) if isinstance(joints, str) else tuple(joints)
    about = subject or ", ".join(joints)
    words: dict[str, str] = {"joint": listed(joints)} if joints else {}
    fault, remedy = entry["message"], entry.get("remedy", "")
    evidence = {}
    chosen = {}
    for name, value in values.items():
        key = {True: "yes", False: "no"}[value] if isinstance(value, bool) else value
        if isinstance(entry.get(name), dict):
            chosen[f"{{{name}}}"] = entry[name].get(key, "")
        elif isinstance(value, str):
            words[name] = value
        else:
            evidence[name] = float(value)
    for slot, part in (*chosen.items(), *chosen.items()):  # parts may contain others
        fault, remedy = fault.replace(slot, part), remedy.replace(slot, part)
    plain = Finding(
        code, severity or entry["severity"], f"{log}: {about}" if log and about else
        log or about, "", evidence, log, joints, words, fault, remedy,
    )  # fmt: skip
    return plain.reworded()


def sentence_of(code: str, **values: float | str) -> str:
    """Return a sentence of the catalogue that is no finding."""
    return finding(code, **values).message


def reason_of(one: Finding) -> str:
    """Return the reason of a verdict for a warning: without joint and log."""
    entry = entries()[one.code]
    if entry["verdict"] is True:
        return one.message
    return one.reworded(
        log="", fault=entry["verdict"].replace("{term}", entry.get("term", "")), remedy=""
    ).message
