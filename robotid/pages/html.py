"""HTML of the pages: scaffold, style, sections, tables. Everything inline, nothing fetched."""

import base64
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path

__all__ = [
    "Cell",
    "asset",
    "code",
    "figure",
    "number",
    "page",
    "percent",
    "scaffold",
    "table",
    "text",
]

_ASSETS = Path(__file__).parent / "assets"


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
    return Cell(format(value, spec).replace("-", "−"), "number")


def percent(value: float | None) -> Cell:
    """Return a cell for a percentage.

    Args:
        value: The percentage; None and non-finite ones are shown as a dash.
    """
    if value is not None and value >= 1000:
        return number(value, ".0f")
    return number(value, ".1f" if value is None or value >= 1 else ".2f")


def table(
    caption: str, headers: Sequence[str], rows: Sequence[Sequence[Cell]], foot: Sequence[Cell] = ()
) -> str:
    """Return the HTML of a table in a box of its own, which scrolls where the page is narrow.

    Args:
        caption: What it shows.
        headers: Heads of the columns.
        rows: Cells; the first of each row is its head.
        foot: Cells of a last row that sums up, if any.
    """
    first = rows[0] if rows else [Cell("")] * len(headers)
    kinds = ["number" if cell.kind == "number" else "text" for cell in first]
    head = "".join(
        f'<th scope="col" class="{kind}">{escape(title)}</th>'
        for title, kind in zip(headers, kinds, strict=True)
    )
    body = "".join(_row(row) for row in rows)
    last = f"<tfoot>{_row(foot)}</tfoot>" if foot else ""
    title = escape(caption)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{title}">'
        f"<table><caption>{title}</caption>"
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


def page(title: str, header: str, sections: Mapping[str, tuple[str, str]]) -> str:
    """Return the HTML of a page to read: its header, links to its sections, the sections.

    Args:
        title: Title of the window, not escaped yet.
        header: HTML of the header.
        sections: Title and HTML of each section by its id.
    """
    links = "".join(f'<a href="#{key}">{head}</a> ' for key, (head, _) in sections.items())
    body = "".join(
        f'<section aria-labelledby="{key}">\n<h2 id="{key}">{head}</h2>\n{html}</section>\n'
        for key, (head, html) in sections.items()
    )
    return scaffold(
        title,
        f"<style>/*tones*/{asset('page.css')}</style>\n",
        '<a class="skip" href="#content">Skip to the content</a>\n'
        f'<main id="content" tabindex="-1">\n<header>\n{header}</header>\n'
        f'<nav aria-label="Sections">{links}</nav>\n{body}</main>\n',
    )


def scaffold(title: str, head: str, body: str, *, policy: str = "") -> str:
    """Return the HTML of a document, which fetches nothing that its policy does not allow.

    Where its body holds charts, it has the scripts that draw them, and no other may run.

    Args:
        title: Title of the window, not escaped yet.
        head: HTML of the head: style, icon; ``/*tones*/`` in it becomes the pages' colours.
        body: HTML of the body.
        policy: What the page may do beside having styles and charts, as a content security policy.
    """
    style, scripts = "", ""
    if '<figure class="chart"' in body:
        style = f"<style>{asset('uPlot.min.css')}\n{asset('charts.css')}</style>\n"
        run = (asset("uPlot.iife.min.js"), asset("charts.js"))
        scripts = "".join(f"<script>{script}</script>\n" for script in run)
        policy += "; script-src " + " ".join(map(_allowed, run))
    # the policy keeps the page offline whatever a name in it might hold
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta http-equiv="Content-Security-Policy" '
        f"content=\"default-src 'none'; style-src 'unsafe-inline'{policy}\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title>\n{_toned(head)}{style}</head>\n"
        f"<body>\n{body}{scripts}</body>\n</html>\n"
    )


@cache
def _allowed(script: str) -> str:
    """Return what allows this one script in a content security policy."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    return f"'sha256-{digest}'"


def _toned(head: str) -> str:
    return head.replace("/*tones*/", "\n" + asset("tones.css"))


def _row(cells: Sequence[Cell]) -> str:
    first, *others = cells
    head = f'<th scope="row" class="{first.kind}">{first.html}</th>'
    return f"<tr>{head}{''.join(f'<td class={c.kind!r}>{c.html}</td>' for c in others)}</tr>\n"
