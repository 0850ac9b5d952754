"""HTML of the pages: scaffold, style, sections, tables. Everything inline, nothing fetched."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

__all__ = ["Cell", "code", "figure", "number", "page", "percent", "scaffold", "table", "text"]


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
        f"<style>/*tones*/{_STYLE}</style>\n",
        '<a class="skip" href="#content">Skip to the content</a>\n'
        f'<main id="content" tabindex="-1">\n<header>\n{header}</header>\n'
        f'<nav aria-label="Sections">{links}</nav>\n{body}</main>\n',
    )


def scaffold(title: str, head: str, body: str, *, policy: str = "") -> str:
    """Return the HTML of a document, which fetches nothing that its policy does not allow.

    Args:
        title: Title of the window, not escaped yet.
        head: HTML of the head: style, icon; ``/*tones*/`` in it becomes the pages' colours.
        body: HTML of the body.
        policy: What the page may do beside having styles, as a content security policy.
    """
    # the policy keeps the page offline whatever a name in it might hold
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta http-equiv="Content-Security-Policy" '
        f"content=\"default-src 'none'; style-src 'unsafe-inline'{policy}\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title>\n{head.replace('/*tones*/', _TONES)}</head>\n"
        f"<body>\n{body}</body>\n</html>\n"
    )


def _row(cells: Sequence[Cell]) -> str:
    first, *others = cells
    head = f'<th scope="row" class="{first.kind}">{first.html}</th>'
    return f"<tr>{head}{''.join(f'<td class={c.kind!r}>{c.html}</td>' for c in others)}</tr>\n"


_TONES = """
:root { --page: #fff; --text: #1c2126; --quiet: #5b6570; --line: #d5dae0; --soft: #f3f5f7;
  --predicted: #0b63c5; --residual: #b4500f; --good: #1a7f37; --usable: #9a6700; --poor: #c21f2c; }
@media (prefers-color-scheme: dark) { :root { --page: #14181c; --text: #e3e7eb; --quiet: #9aa5b0;
  --line: #353d46; --soft: #1d2328; --predicted: #3f9bff; --residual: #f2a065; --good: #56c271;
  --usable: #e0b040; --poor: #ff7b7f; } }
* { box-sizing: border-box; }
"""
_STYLE = """\
body { margin: 0; background: var(--page); color: var(--text);
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 72rem; margin: 0 auto; padding: 1.5rem 1rem 4rem; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 1rem; }
h1, h2, h3, p, li { overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.5rem 0 .75rem; padding-top: .75rem;
  border-top: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.5rem 0 .5rem; }
p, ul { margin: .5rem 0; max-width: 48rem; }
.skip { position: absolute; left: -100vw; } .skip:focus { left: .5rem; top: .5rem; z-index: 1;
  padding: .5rem .75rem; background: var(--page); }
:focus-visible { outline: .15rem solid var(--predicted); outline-offset: .1rem; }
main:focus { outline: none; }
nav { font-size: .875rem; } nav a { margin-right: 1rem; white-space: nowrap; }
a { color: var(--predicted); }
.verdict { border-left: .4rem solid var(--tone); background: var(--soft); padding: .75rem 1rem;
  margin: 1rem 0; } .verdict strong { color: var(--tone); font-size: 1.25rem; }
.verdict p, .verdict ul { margin: .25rem 0; } .verdict ul { padding-left: 1.25rem; }
.good { --tone: var(--good); } .usable { --tone: var(--usable); } .poor { --tone: var(--poor); }
.note { color: var(--quiet); font-size: .875rem; }
.scroll { overflow-x: auto; margin: .75rem 0 1.25rem; }
table { border-collapse: collapse; font-size: .875rem; line-height: 1.35; }
caption { text-align: left; font-weight: 600; padding: 0 0 .4rem; }
th, td { padding: .28rem .75rem .28rem 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid var(--line); font-weight: 400; min-width: 3.5rem; }
thead th { color: var(--quiet); vertical-align: bottom; border-bottom-width: 2px; }
tfoot th, tfoot td { font-weight: 600; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td.number, th.number { padding-left: .5rem; }
.code { font-family: ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace;
  font-size: .8125rem; }
td.code { min-width: 15rem; } tbody th, .text { white-space: nowrap; }
td.flag { color: var(--poor); font-weight: 600; }
.plots { display: grid; gap: .5rem 1.5rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr)); }
figure { margin: 0; min-width: 0; overflow-x: auto; }
figcaption { font-size: .875rem; overflow-wrap: anywhere; }
figure svg { display: block; width: 100%; min-width: 26rem; height: auto; color: var(--text); }
figure.single { max-width: 40rem; } figure svg.map { width: auto; max-width: none; }
@media (min-width: 40rem) { tbody th wbr { display: none; } }
@page { margin: 14mm; }
@media print { :root { --page: #fff; --text: #000; --quiet: #444; --line: #bbb; --soft: #f3f5f7;
  --predicted: #0b63c5; --residual: #b4500f; --good: #1a7f37; --usable: #9a6700; --poor: #c21f2c; }
  body { font-size: 10pt; } main { max-width: none; padding: 0; }
  nav, .skip { display: none; }
  .scroll, figure { overflow: visible; } table { font-size: 8pt; } .code { font-size: 7pt; }
  td.code { min-width: 8rem; } .plots { grid-template-columns: 1fr 1fr; }
  figure svg, figure svg.map { min-width: 0 !important; max-width: 100% !important; }
  figure, tr { break-inside: avoid; }
  h2, h3, caption { break-after: avoid; } }
"""
