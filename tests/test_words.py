"""Texts that users read use the field's words: messages, help, pages, docstrings and docs."""

import ast
import re
from functools import cache

import pytest
from helpers.paths import DOCS, ROOT

#: What is refused, as a regular expression, and what to write in its place.
REFUSED = {
    r"tell|tells|told|telling": "command (a controller), determine, indicate (data), distinguish",
    r"begun": "initialised, started",
    r"kept": "validation (logs), held-out (segments), fixed, retained",
    r"stretch|stretches": "segment (of a log), fold, window (of a simulation), cluster",
    r"late|lateness": "delay, delayed",
    r"miss|misses|missed": "error, residual, prediction error",
    r"mend|mends|mended": "fix, correct",
    r"taken up|takes up": "deflection, displacement",
    r"that slides?": "prismatic joint", r"that turns?|friction turns": "revolute joint, reverses",
    r"stands|stand still|stood": "is at rest, holds position, is", r"outvoted": "downweighted",
    r"witness|witnesses": "scale check", r"chance": "p-value, probability",
    r"doubt|doubts|doubted|alarm|alarms|surprise": "finding, warning",
    r"refuted|refutes|speaks? against": "rejected, contradicted",
    r"heavier (?:weight|prior)": "larger", r"spent": "effective degrees of freedom",
    r"loops miss|open loops": "simulated position error",
    r"rolled out|rolls out|roll out": "simulated", r"usual": "typical, RMS",
    r"house|room|rooms": "package, module", r"renewed": "updated",
    r"as quick as": "broadband, above the cut-off", r"bears?": "is loaded by, loads",
    r"lost in": "not identifiable above", r"rests? on": "depends on",
    r"says?|said|speaks?|has a say|have a say": "states, indicates, is consistent with",
    r"at once": "together, immediately", r"hangs on|hung on": "payload, is attached",
    r"weighs": "has the mass, weights", r"fits ill": "poorly", r"gives way": "moves under load",
    r"made large": "criterion, maximised", r"unlooked|looked at": "checked",
    r"in words": "with an explanation", r"told apart|tells? apart": "distinguished",
    r"(?:is|are|if|not) stated": "given, specified, default", r"feigns?|feigned": "imitate",
}  # fmt: skip
#: Phrases in which a word has its usual meaning.
ALLOWED = (
    r"stands? for", r"of late", r"part by part", r"apart from", r"take(s|n)? apart",
    r"drives = .usual.", r"0: usual, none",
    r"room temperature", r"false alarms?", r"joint room", r"ends? late",
)  # fmt: skip
WORDS = {
    re.compile(rf"\b(?:{words})\b", re.IGNORECASE): wanted for words, wanted in REFUSED.items()
}
PARTS = sorted({path.relative_to(ROOT).parts[1] for path in (ROOT / "robotid").rglob("*.py")})
SCRIPTS = [p for p in (ROOT / "robotid").rglob("assets/*.js") if not p.name.endswith(".min.js")]
TEXTS = (p for kind in ("toml", "html") for p in (ROOT / "robotid").rglob(f"*.{kind}"))
PAGES = (*sorted(DOCS.rglob("*.md")), ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(TEXTS))
#: Code in pages, slots of templates, and keys of TOML files, which are no text.
CODE = re.compile(r"```.*?```|`[^`]*`|\$\w+|\{[^}\n]*\}|^[\w.]+ = |^\[[^\n]*\]$", re.DOTALL | re.M)


def faults(text):
    """Return the refused words of a text, each with its surroundings and what is wanted."""
    for phrase in ALLOWED:
        text = re.sub(phrase, lambda m: " " * len(m[0]), text, flags=re.IGNORECASE)
    return [
        f"{text[max(0, m.start() - 40) : m.end() + 40]!r}: {m[0]!r}, wanted {wanted}"
        for pattern, wanted in WORDS.items()
        for m in pattern.finditer(text)
    ]


@cache
def strings(path):
    """Return the docstrings of a module that others use, and the texts that users read."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    docs, texts, skipped = [], [], set()
    for node in nodes:
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                skipped.add(first.value)
                if not getattr(node, "name", "").startswith("_"):
                    docs.append(str(first.value.value))
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in skipped:
            texts.append(node.value)
    return docs, [text for text in texts if " " in text.strip()]


def modules(part):
    path = ROOT / "robotid" / part
    return sorted(path.rglob("*.py")) if path.is_dir() else [path]


def test_a_refused_word_is_found_and_the_wanted_one_named():
    (fault,) = faults("the log tells nothing; stands for a full turn")
    assert "'tells', wanted command" in fault
    assert not faults("isolated, storytelling, missing")


@pytest.mark.parametrize("kind", ["docstrings", "messages and help"])
@pytest.mark.parametrize("part", PARTS)
def test_the_package_uses_the_words_of_the_field(part, kind):
    which = int(kind != "docstrings")
    found = [
        f"{path.relative_to(ROOT)}: {fault}"
        for path in modules(part)
        for text in strings(path)[which]
        for fault in faults(text)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_pages_use_the_words_of_the_field(page):
    found = faults(CODE.sub("", page.read_text()))
    assert not found, "\n".join(found)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_texts_of_scripts_use_the_words_of_the_field(script):
    quoted = re.findall(r'"((?:[^"\\\n]|\\.)*)"|`([^`]*)`', script.read_text())
    found = [fault for pair in quoted for text in pair if " " in text for fault in faults(text)]
    assert not found, "\n".join(found)
