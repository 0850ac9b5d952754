"""Text output: lines that fit the terminal, aligned columns, significant digits."""

import json
import math
import os
import re
import shutil
import textwrap
from collections.abc import Sequence
from typing import Any, TextIO

_ARGUMENT = re.compile(r"(?:'[^'\n]*'|[^\s'])+")  # of a command, with its quotes
_PATH = re.compile(r"'[^' ]*/[^'\n]*'")  # a quoted path, which may have blanks
_UNIT = re.compile(r"(?<=\d) (?=%|(?:m?s|kg|N|m|Hz|rad)\b)")  # between a number and its unit
_PLAIN = (-3, 6)  # powers of ten that are written without an exponent
_GAP = "  "  # between columns
_NARROWEST = 40
_YAML_WORDS = ("y", "n", "yes", "no", "on", "off", "true", "false", "null")  # not text in YAML 1.1
_TONES = {"good": 32, "usable": 33, "poor": 31, "error": 31, "warning": 33}  # of ANSI terminals


def terminal_width() -> int:
    """Return the characters per line of the terminal, 80 if unknown."""
    return max(shutil.get_terminal_size((80, 24)).columns, _NARROWEST)


def tinted(text: str, word: str, tone: str, stream: TextIO) -> str:
    """Return text with the first occurrence of a word in colour, for a terminal with colours."""
    has_codes = "WT_SESSION" in os.environ if os.name == "nt" else os.getenv("TERM") != "dumb"
    if tone not in _TONES or os.environ.get("NO_COLOR") or not (has_codes and stream.isatty()):
        return text
    return text.replace(word, f"\x1b[{_TONES[tone]}m{word}\x1b[0m", 1)


def wrapped(text: str, width: int | None, indent: str = "") -> str:
    """Return text in lines of at most a width; words, paths and numbers with units stay whole."""
    if width is None:
        return text
    lines = []
    text = _PATH.sub(lambda path: path.group().replace(" ", "\0"), _UNIT.sub("\0", text))
    for line in text.split("\n"):
        indentation = line[: len(line) - len(line.lstrip())] + indent
        lines += textwrap.wrap(
            line,
            max(width, 2 * len(indentation), 20),
            subsequent_indent=indentation,
            break_long_words=False,
            break_on_hyphens=False,
        ) or [""]
    return "\n".join(lines).replace("\0", " ")


def arguments(command: str) -> list[str]:
    """Return the arguments of a command line as they are typed, quotes included."""
    return _ARGUMENT.findall(command)


def command_lines(command: str, width: int) -> list[str]:
    """Return a command in lines of at most a width, to paste into a shell."""
    lines = [""]
    for argument in arguments(command):
        if lines[-1].strip() and len(lines[-1]) + len(argument) + 3 > width:
            lines[-1] += " \\"
            lines.append("   ")
        lines[-1] += f" {argument}" if lines[-1] else argument
    return lines


def columns(
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    width: int | None = None,
    needed: int | None = None,
    left: Sequence[int] = (0,),
) -> list[str]:
    """Return the lines of a table, indented by two."""
    table = [*zip(*(head.split("\n") for head in heads), strict=True), *rows]
    sizes = [max(map(len, column)) for column in zip(*table, strict=True)]
    count = len(heads)
    while count > (len(heads) if needed is None else needed) and width is not None:
        if sum(sizes[:count]) + len(_GAP) * count <= width:
            break
        count -= 1
    lines = []
    for row in table:
        cells = [
            cell.ljust(size) if k in left else cell.rjust(size)
            for k, (cell, size) in enumerate(zip(row[:count], sizes[:count], strict=True))
        ]
        lines.append((_GAP + _GAP.join(cells)).rstrip())
    if count < len(heads):
        names = ", ".join(" ".join(head.split()) for head in heads[count:])
        lines.append(f"  in wider terminals: {names}")
    return lines


def in_digits_of(value: float, error: float | None) -> tuple[str, str]:
    """Return a value rounded to the second digit of its error, and the error."""
    if error is None or not (math.isfinite(error) and error > 0):
        return f"{value:.4g}", "-"
    error = float(f"{error:.1e}")  # 0.0996 rounds to 0.10, which moves the second digit
    last = math.floor(math.log10(error)) - 1
    value = round(value, -last) + 0.0  # no "-0.0"
    top = max(math.floor(math.log10(abs(value))) if value else last, last + 1)
    if _PLAIN[0] <= top < _PLAIN[1]:
        return f"{value:.{max(-last, 0)}f}", f"{error:.{max(-last, 0)}f}"
    shown, half = (f"{x / 10**top:.{top - last}f}e{top:+03d}" for x in (value, error))
    return (shown if value else "0"), half


def period(start: float, end: float) -> str:
    """Return a range of time with its unit, in four digits and three of its length: "0-11.99 s"."""
    sizes = ((3, max(abs(start), abs(end))), (2, end - start))  # digits after the first one [s]
    digits = max(
        (n - max(math.floor(math.log10(x)), 0) for n, x in sizes if 0 < x < math.inf), default=0
    )
    return f"{seconds(start, digits)}-{seconds(end, digits)} s"


def seconds(t: float, digits: int = 3) -> str:
    """Return a time without exponent: of 0.0000050167 "0", of 1.7e9 + 0.25 "1700000000.25"."""
    return f"{round(float(t), max(digits, 0)) + 0.0:.15g}"


def yaml_name(text: str) -> str:
    """Return a name for YAML in one line, quoted unless it is a plain word."""
    is_plain = text.isascii() and text.isidentifier() and text.lower() not in _YAML_WORDS
    return text if is_plain else yaml_plain(text)


def yaml_plain(entry: Any) -> str:  # noqa: ANN401
    """Return a plain value for YAML; characters that end a line of YAML are escaped."""
    text = json.dumps(entry, ensure_ascii=False)
    return "".join(c if c.isprintable() else _escaped(ord(c)) for c in text)


def _escaped(code: int) -> str:
    return f"\\u{code:04x}" if code < 2**16 else f"\\U{code:08x}"
