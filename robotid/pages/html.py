"""HTML of the pages: scaffold, style, sections, tables. Everything inline, nothing fetched."""

import base64
import hashlib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import NamedTuple

__all__ = [
    "Cell",
    "Section",
    "asset",
    "code",
    "facts_html",
    "figure",
    "folded",
    "number",
    "page",
    "percent",
    "scaffold",
    "steps_html",
    "table",
    "text",
    "verdict_html",
    "with_error",
]

_ASSETS = Path(__file__).parent / "assets"
_FIRST = 3  # reasons of a verdict that are seen at once
#: What in a page asks for which script.
_SCRIPTS = {"page.js": '<details|<table class="data"', "tables.js": '<table class="data"'}


@cache
def asset(name: str) -> str:
    """Return the text of a file that pages are made of.

    Args:
        name: Its name in the folder of assets.
    """
    return (_ASSETS / name).read_text(encoding="utf-8")


@dataclass(frozen=True)
class Cell:
    """One cell of a table."""

    html: str  # already escaped
    kind: str = ""  # of its style: "" for prose, "text" for short words, "number", "code", "flag"
    value: float | None = None  # the number that it shows, in full


class Section(NamedTuple):
    """A section of a page.

    Attributes:
        title: Its heading, HTML.
        html: What it holds.
        said: What it holds in a few words, HTML, if it is folded.
        is_open: Whether it is open at first; None if it cannot be folded.
    """

    title: str
    html: str
    said: str = ""
    is_open: bool | None = None


def text(value: str, *, flag: bool = False) -> Cell:
    """Return a cell of text.

    Args:
        value: The text, not escaped yet; one of a few words is kept on one line.
        flag: Whether it is shown as a fault.
    """
    return Cell(escape(value), "flag" if flag else "text" if len(value) < 24 else "")


def code(value: str) -> Cell:
    """Return a cell for names, hashes and formulas.

    Args:
        value: The text, not escaped yet.
    """
    # long names and formulas may break behind a dot, an underscore or a slash, not elsewhere
    html = escape(value)
    for mark in (".", "_", "/"):
        html = html.replace(mark, f"{mark}<wbr>")
    return Cell(html, "code")


def number(value: float | None, spec: str = ".4g") -> Cell:
    """Return a cell for a number.

    Args:
        value: The number; None and non-finite ones are shown as a dash.
        spec: How it is written.
    """
    if value is None or not math.isfinite(value):
        return Cell("–", "number")
    return Cell(format(value, spec).replace("-", "−"), "number", float(value))


def percent(value: float | None) -> Cell:
    """Return a cell for a percentage.

    Args:
        value: The percentage; None and non-finite ones are shown as a dash.
    """
    if value is not None and value >= 1000:
        return number(value, ".0f")
    return number(value, ".1f" if value is None or value >= 1 else ".2f")


def with_error(value: float, error: float, *, sign: str = "") -> tuple[Cell, Cell]:
    """Return cells for a number and its error: two digits of it, and the number to its last one.

    Args:
        value: The number.
        error: Its error; one that is not finite is a dash.
        sign: "+" to write the number with its sign in any case.
    """
    if not (math.isfinite(error) and error > 0 and math.isfinite(value)):
        return number(value, f"{sign}.4g"), number(None)
    exponent = math.floor(math.log10(float(f"{error:.1e}")))  # of its first digit, rounded
    size = math.floor(math.log10(abs(value))) if value else exponent
    if max(size, exponent) < -3 or exponent > 4:
        digits = max(size - exponent + 1, 0)
        return number(value, f"{sign}z.{digits}e"), number(error, ".1e")
    decimals = max(1 - exponent, 0)
    return number(value, f"{sign}z.{decimals}f"), number(error, f".{decimals}f")


def table(
    caption: str,
    headers: Sequence[str],
    rows: Sequence[Sequence[Cell]],
    foot: Sequence[Cell] = (),
    *,
    is_data: bool = False,
) -> str:
    """Return the HTML of a table in a box of its own, which scrolls where the page is narrow.

    Args:
        caption: What it shows.
        headers: Heads of the columns.
        rows: Cells; the first of each row is its head.
        foot: Cells of a last row that sums up, if any.
        is_data: Whether its rows can be sorted, filtered and taken away, by tables.js.
    """
    first = rows[0] if rows else [Cell("")] * len(headers)
    kinds = ["number" if cell.kind == "number" else "text" for cell in first]
    head = "".join(
        f'<th scope="col" class="{kind}">{escape(title)}</th>'
        for title, kind in zip(headers, kinds, strict=True)
    )
    body = "".join(_row(row, is_data=is_data) for row in rows)
    last = f"<tfoot>{_row(foot)}</tfoot>" if foot else ""
    title, kind = escape(caption), ' class="data"' if is_data else ""
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{title}">'
        f"<table{kind}><caption>{title}</caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody>{last}</table></div>\n"
    )


def figure(caption: str, svg: str, *, single: bool = False) -> str:
    """Return the HTML of a figure, which scrolls where the page is narrow, by keys too.

    Args:
        caption: What it shows, HTML.
        svg: The ``<svg>`` element.
        single: Whether it stands alone and is kept from filling the page.
    """
    kind = ' class="single"' if single else ""
    return f'<figure{kind} tabindex="0"><figcaption>{caption}</figcaption>{svg}</figure>\n'


def folded(key: str, summary: str, html: str, *, is_open: bool = False) -> str:
    """Return the HTML of what opens at a click or a key, and is open in print.

    Args:
        key: Its id, which links open it by.
        summary: What is seen when it is closed, HTML.
        html: What it holds.
        is_open: Whether it is open at first.
    """
    opened = " open" if is_open else ""
    return f'<details id="{key}"{opened}><summary>{summary}</summary>\n{html}</details>\n'


def verdict_html(robot: str, status: str, reasons: Sequence[str]) -> str:
    """Return the heading of a result: its robot and its verdict, with the first reasons in sight.

    Args:
        robot: Name of the robot, not escaped yet.
        status: The verdict in a word or two.
        reasons: Its reasons, not escaped yet, the gravest first.
    """
    items = [f"<li>{escape(reason)}</li>" for reason in reasons]
    more = "".join(items[_FIRST:])
    if more:
        count = len(items) - _FIRST
        title = f"{count} more reason{'s' if count > 1 else ''}"
        more = f"<details><summary>{title}</summary><ul>{more}</ul></details>"
    return (
        f'<div class="verdict {status.replace(" ", "-")}"><h1>{escape(robot)} '
        f"<span>Verdict: <strong>{status}</strong></span></h1>"
        f"<ul>{''.join(items[:_FIRST])}</ul>{more}</div>\n"
    )


def facts_html(facts: Mapping[str, str], files: Mapping[str, str] | None = None) -> str:
    """Return the HTML of figures beside their names.

    Args:
        facts: What is said by its name, both HTML.
        files: Files to link to, by what they are; they come last.
    """
    links = ", ".join(
        f'<a href="{escape(path)}">{escape("URDF" if kind == "urdf" else kind)}</a>'
        for kind, path in (files or {}).items()
    )
    said = {**facts, "Files": links} if links else facts
    cells = "".join(f"<div><dt>{name}</dt><dd>{html}</dd></div>" for name, html in said.items())
    return f'<dl class="facts">{cells}</dl>\n'


def steps_html(steps: Iterable[tuple[str, Sequence[str]]]) -> str:
    """Return the HTML of what to do next; nothing if there is nothing.

    Args:
        steps: What is done, in words, and the commands or lines to copy, none of it escaped yet.
    """
    items = "".join(
        f"<li><p>{escape(words)}</p>"
        + "".join(
            f'<div class="copy"><pre class="command">{escape(block)}</pre></div>'
            for block in blocks
        )
        + "</li>\n"
        for words, blocks in steps
    )
    return f'<h2 id="next">Do next</h2>\n<ol class="next">{items}</ol>\n' if items else ""


def page(title: str, header: str, sections: Mapping[str, Section | tuple[str, str]]) -> str:
    """Return the HTML of a page to read: links to its sections, its header, the sections.

    Args:
        title: Title of the window, not escaped yet.
        header: HTML of the header.
        sections: The sections by their ids, or title and HTML of each.
    """
    shown = {key: Section(*section) for key, section in sections.items()}
    links = "".join(f'<a href="#{key}">{x.title}</a> ' for key, x in shown.items())
    body = "".join(_section(key, section) for key, section in shown.items())
    named = [name for name, mark in _SCRIPTS.items() if re.search(mark, header + body)]
    return scaffold(
        title,
        f"<style>/*tones*/{asset('page.css')}</style>\n",
        '<a class="skip" href="#content">Skip to the content</a>\n'
        f'<nav aria-label="Sections"><div><a href="#content">{escape(title)}</a> {links}'
        f'</div></nav>\n<main id="content" tabindex="-1">\n<header>\n{header}</header>\n'
        f"{body}</main>\n",
        scripts=named,
    )


def _section(key: str, section: Section) -> str:
    """Return the HTML of a section."""
    head = f'<h2 id="{key}">{section.title}</h2>'
    html = f"{head}\n{section.html}"
    if section.is_open is not None:
        said = f"<span>{section.said}</span>" if section.said else ""
        html = folded(f"{key}-fold", f"{head}{said}", section.html, is_open=section.is_open)
    return f'<section aria-labelledby="{key}">\n{html}</section>\n'


def scaffold(
    title: str, head: str, body: str, *, policy: str = "", scripts: Sequence[str] = ()
) -> str:
    """Return the HTML of a document, which fetches nothing that its policy does not allow.

    Where its body holds charts, it has the scripts that draw them; no script but these and those
    that are named may run.

    Args:
        title: Title of the window, not escaped yet.
        head: HTML of the head: style, icon; ``/*tones*/`` in it becomes the pages' colours.
        body: HTML of the body.
        policy: What the page may do beside having styles and charts, as a content security policy.
        scripts: Names of assets that it runs.
    """
    style, run = "", [asset(name) for name in scripts]
    if '<figure class="chart"' in body:
        style = f"<style>{asset('uPlot.min.css')}\n{asset('charts.css')}</style>\n"
        run += [asset("uPlot.iife.min.js"), asset("charts.js")]
    if run:
        policy += "; script-src " + " ".join(map(_allowed, run))
    inline = "".join(f"<script>{script}</script>\n" for script in run)
    # the policy keeps the page offline whatever a name in it might hold
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta http-equiv="Content-Security-Policy" '
        f"content=\"default-src 'none'; style-src 'unsafe-inline'{policy}\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title>\n{_toned(head)}{style}</head>\n"
        f"<body>\n{body}{inline}</body>\n</html>\n"
    )


@cache
def _allowed(script: str) -> str:
    """Return what allows this one script in a content security policy."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    return f"'sha256-{digest}'"


def _toned(head: str) -> str:
    return head.replace("/*tones*/", "\n" + asset("tones.css"))


def _row(cells: Sequence[Cell], *, is_data: bool = False) -> str:
    first, *others = cells
    html = f'<th scope="row" class="{first.kind}">{first.html}</th>'
    for cell in others:
        value = f' data-value="{cell.value:.10g}"' if is_data and cell.value is not None else ""
        html += f'<td class="{cell.kind}"{value}>{cell.html}</td>'
    return f"<tr>{html}</tr>\n"
