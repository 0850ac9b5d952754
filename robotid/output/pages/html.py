"""HTML of the pages: scaffold, blocks of templates, sections, tables, charts. All is inline."""

import base64
import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robotid.base.files import write_text
from robotid.base.findings import listed
from robotid.base.text import arguments
from robotid.base.typing import Array

_ASSETS = Path(__file__).parent / "assets"
TONES = 8  # distinguishable colours of lines in one chart: tone-1 to tone-8
POINTS = 2000  # rows of a chart's data
_AROUND = 112  # [px] of caption, axis and legend of each chart in a notebook
_STYLE = "main { padding: .5rem 1rem; } h1 { font-size: 1.125rem; margin: 0 0 .5rem; }"
_UNBROKEN = 16  # characters of a name that always stays on one line
_FIRST = 3  # reasons of a verdict that are visible without unfolding
_KINDS = {"urdf": "URDF", "sidecar": "drive parameters"}  # of files, by key of result.json
_DOCK = '<div id="replay" class="dock"'
_FOLDERS = re.compile(r"^((?:&#x27;)?(?:\w:)?[/\\].*[/\\])")  # of an absolute path
#: Scripts, and the pattern of pages that need them.
_SCRIPTS = {
    "page.js": '<details|<table class="data"', "tables.js": '<table class="data"', "dock.js": _DOCK,
}  # fmt: skip
#: A column of a table: its heading, the form of its cells (``cell``), its key in an entry.
Column = tuple[str, str, str]


@cache
def asset(name: str, folder: Path = _ASSETS) -> str:
    """Return the text of an asset file."""
    return (folder / name).read_text(encoding="utf-8")


def block(key: str, /, **values: object) -> str:
    """Return a block of a template: of "report.fit", the part of report.html after "<!-- fit -->".

    ``$name`` in it stands for a value, which is HTML.
    """
    file, _, name = key.partition(".")
    return _blocks(file)[name].substitute(values)


@cache
def _blocks(file: str) -> dict[str, Template]:
    parts = re.split(r"<!-- (\w+) -->\n", asset(f"{file}.html"))
    return dict(zip(parts[1::2], map(Template, parts[2::2]), strict=True))


@dataclass(frozen=True)
class Cell:
    """One cell of a table."""

    html: str  # escaped
    kind: str = ""  # style: "" for prose, "text" for short texts, "number", "code"; "flag" in red
    value: float | None = None  # the number in full precision


class Section(NamedTuple):
    """A section of a page."""

    title: str  # its heading, HTML
    html: str
    summary: str = ""  # summary of its content, HTML, if it is folded
    is_open: bool | None = None  # whether it is open initially; None if it cannot be folded


def raised(words: str) -> str:
    """Return words with the exponents of their units raised."""
    return re.sub(r"(?<=[a-z])\^[23]", lambda power: "²" if power[0] == "^2" else "³", words)


def text(value: str, *, flag: bool = False) -> Cell:
    """Return a cell of text."""
    return Cell(escape(raised(value)), " ".join(["flag"] * flag + ["text"] * (len(value) < 24)))


def code(value: str) -> Cell:
    """Return a cell for names, hashes and formulas."""
    # long names and formulas may break after a dot, an underscore or a slash only
    html = escape(value)
    is_long = len(value) > _UNBROKEN
    return Cell(re.sub("([._/])", r"\1<wbr>", html) if is_long else html, "code")


def number(value: float | None, spec: str = ".4g") -> Cell:
    """Return a cell for a number."""
    if value is None or not math.isfinite(value):
        return Cell("–", "number")
    return Cell(format(value, spec).replace("-", "−"), "number", float(value))


def plain(value: object) -> str:
    """Return a setting as text."""
    if isinstance(value, list):
        return listed(map(plain, value))
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:g}" if isinstance(value, float) else str(value)


def percent(value: float | None) -> Cell:
    """Return a cell for a percentage."""
    if value is not None and value >= 1000:
        return number(value, ".0f")
    return number(value, ".1f" if value is None or value >= 0.995 else ".2f")


def with_error(value: float, error: float, *, sign: str = "") -> tuple[Cell, Cell]:
    """Cells for a number and its error, the error with two digits, both to the same place."""
    if not (math.isfinite(error) and error > 0 and math.isfinite(value)):
        return number(value, f"{sign}.4g"), number(None)
    exponent = int(f"{error:.1e}".partition("e")[2])  # of the first digit of the rounded error
    size = math.floor(math.log10(abs(value))) if value else exponent
    if max(size, exponent) < -3 or exponent > 4:
        form = f"z.{max(size - exponent + 1, 0)}e" if abs(value) > 1e-3 * error else "z.0f"
        return number(value, sign + form), number(error, ".1e")
    decimals = max(1 - exponent, 0)
    return number(value, f"{sign}z.{decimals}f"), number(error, f".{decimals}f")


def paragraphs(sentences: Iterable[str]) -> str:
    """Return sentences as paragraphs; empty ones are left out."""
    return "".join(f"<p>{escape(words)}</p>\n" for words in sentences if words)


def cell(value: Any, form: str) -> Cell:  # noqa: ANN401
    """Return a value as a cell: its form is "text", "code", "%" or the format of a number."""
    if isinstance(value, Cell):
        return value
    if form in ("text", "code"):
        return (text if form == "text" else code)("" if value is None else str(value))
    return percent(value) if form == "%" else number(value, form)


def listing(
    caption: str,
    columns: Sequence[Column],
    entries: Iterable[Mapping[str, Any]],
    *,
    is_data: bool = False,
) -> str:
    """Return a table with a row for each entry; "" without entries."""
    rows = [[cell(entry.get(key), form) for _, form, key in columns] for entry in entries]
    heads = [head for head, *_ in columns]
    return table(caption, heads, rows, is_data=is_data) if rows else ""


def table(
    caption: str,
    headers: Sequence[str],
    rows: Sequence[Sequence[Cell]],
    foot: Sequence[Cell] = (),
    *,
    is_data: bool = False,
) -> str:
    """Return the HTML of a table in a box that scrolls on narrow pages."""
    first = rows[0] if rows else [Cell("")] * len(headers)
    head = ""
    for title, cell in zip(headers, first, strict=True):
        kind = "number" if cell.kind == "number" else "text"
        head += f'<th scope="col" class="{kind}">{escape(raised(title))}</th>'
    body = "".join(_row(row, is_data=is_data) for row in rows)
    last = f"<tfoot>{_row(foot)}</tfoot>" if foot else ""
    title, data = escape(caption), ' class="data"' if is_data else ""
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{title}">'
        f"<table{data}><caption>{title}</caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody>{last}</table></div>\n"
    )


def folded(key: str, summary: str, html: str, *, is_open: bool = False) -> str:
    """Return the HTML of foldable content, which is open in print."""
    opened = " open" if is_open else ""
    return f'<details id="{key}"{opened}><summary>{summary}</summary>\n{html}</details>\n'


def verdict_html(robot: str, status: str, reasons: Sequence[str], uses: str = "") -> str:
    """Return the heading of a result: robot, verdict and the first reasons."""
    items = [f"<li>{escape(reason)}</li>" for reason in reasons]
    more = "".join(items[_FIRST:])
    if more:
        title = f"{len(items) - _FIRST} more reason{'s' if len(items) > _FIRST + 1 else ''}"
        more = f"<details><summary>{title}</summary><ul>{more}</ul></details>"
    return block(
        "page.verdict", kind=status.replace(" ", "-"), robot=escape(robot), status=status,
        first="".join(items[:_FIRST]), more=more,
        uses=f'<p class="uses">{escape(uses)}</p>' if uses else "",
    )  # fmt: skip


def facts_html(facts: Mapping[str, str], files: Mapping[str, str] | None = None) -> str:
    """Return the HTML of figures with their names."""
    links = ", ".join(
        f'<a href="{escape(path)}">{escape(_KINDS.get(kind, kind))}</a>'
        for kind, path in (files or {}).items()
    )
    shown = {**facts, "Files": links} if links else facts
    cells = "".join(f"<div><dt>{name}</dt><dd>{html}</dd></div>" for name, html in shown.items())
    return f'<dl class="facts">{cells}</dl>\n'


def command_html(block: str) -> str:
    """Return the HTML of a command, or of lines of a job file; absolute folders are hidden."""
    html = escape(block)
    if block.startswith("robotid ") and "\n" not in block:  # an argument does not end at a hyphen
        words = [_FOLDERS.sub(r"<i>\1</i>", escape(word)) for word in arguments(block)]
        html = " ".join(f"<span>{word}</span>" for word in words)
    return f'<pre class="command">{html}</pre>'


def page(title: str, header: str, sections: Mapping[str, tuple[Any, ...]]) -> str:
    """Return the HTML of a page: links to its sections, its header, the sections."""
    shown = {key: Section(*section) for key, section in sections.items()}
    links = "".join(f'<a href="#{key}">{x.title}</a> ' for key, x in shown.items())
    body = "".join(_section(key, section) for key, section in shown.items())
    named = [name for name, mark in _SCRIPTS.items() if re.search(mark, header + body)]
    has_dock = _DOCK in body
    style = asset("page.css") + (asset("dock.css") if has_dock else "")
    return scaffold(
        title,
        f"<style>/*tones*/{style}</style>\n",
        block("page.body", title=escape(title), links=links, header=header, sections=body),
        policy="; frame-src 'self'" if has_dock else "",
        scripts=named,
    )


def _section(key: str, section: Section) -> str:
    head = f'<h2 id="{key}">{section.title}</h2>'
    html = f"{head}\n{section.html}"
    if section.is_open is not None:
        summary = f"<span>{section.summary}</span>" if section.summary else ""
        html = folded(f"{key}-fold", f"{head}{summary}", section.html, is_open=section.is_open)
    return f'<section aria-labelledby="{key}">\n{html}</section>\n'


def scaffold(
    title: str, head: str, body: str, *, policy: str = "", scripts: Sequence[str] = ()
) -> str:
    """Return the HTML of a document, which loads only what its policy allows.

    A body with charts gets the scripts that draw them. Only these and the named scripts may run.
    """
    style, run = "", [asset(name) for name in scripts]
    if '<figure class="chart"' in body:
        style = f"<style>{asset('uPlot.min.css')}\n{asset('charts.css')}</style>\n"
        run += [asset("uPlot.iife.min.js"), asset("charts.js")]
    if run:
        policy += "; script-src " + " ".join(map(_allowed, run))
    inline = "".join(f"<script>{script}</script>\n" for script in run)
    toned = head.replace("/*tones*/", "\n" + asset("tones.css"))
    page = {"title": escape(title), "head": toned + style, "body": body + inline}
    return block("page.document", policy=policy, **page)


@cache
def _allowed(script: str) -> str:
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    return f"'sha256-{digest}'"


def _row(cells: Sequence[Cell], *, is_data: bool = False) -> str:
    first, *others = cells
    html = f'<th scope="row" class="{first.kind}">{first.html}</th>'
    for cell in others:
        value = f' data-value="{cell.value:.10g}"' if is_data and cell.value is not None else ""
        html += f'<td class="{cell.kind}"{value}>{cell.html}</td>'
    return f"<tr>{html}</tr>\n"


# ---- charts: their data, which charts.js draws with uPlot -----------------------------------


@dataclass(frozen=True, eq=False)
class Series:
    """One line, cloud or area of a chart."""

    label: str  # its name in the legend
    y: Array  # values, shape (N,), NaN where the line breaks
    tone: str  # its colour: a variable of tones.css without its dashes, as "predicted" or "tone-1"
    # "line", "dots", or "area"; the areas of a chart are stacked, positive values upwards and
    # negative values downwards
    kind: str = "line"
    half: Array | None = None  # half width of a band about a line, shape (N,)
    is_weak: bool = False  # whether it is drawn faintly
    is_hidden: bool = False  # whether it is hidden until its key in the legend is pressed


@dataclass(frozen=True, eq=False)
class Chart:
    """A chart: series over a common x."""

    title: str  # its description, for screen readers
    x: Array  # shape (N,); the log's own time where it is time. Points are drawn in its order
    series: tuple[Series, ...]  # the series, the last one on top
    x_label: str  # its name and unit, as "time [s]"
    y_label: str  # name and unit of the values, as "torque [N m]"
    link: str = ""  # charts of one link share the cursor and the zoom along x
    # segments of x with a shaded background, as samples that are not used
    spans: tuple[tuple[float, float], ...] = ()
    logarithmic: str = ""  # the logarithmic axes: "", "x", "y" or "xy"
    height: int = 180  # height of the plot [px]


@dataclass(frozen=True, eq=False)
class Plot:
    """Charts one below the other: drag to zoom, double click for all, values under the cursor."""

    title: str  # their subject
    charts: tuple[tuple[Chart, str], ...]  # each with its caption

    def __repr__(self) -> str:
        return f"<Plot of {self.title}; .write('plot.html') saves it>"

    def _repr_html_(self) -> str:
        height = sum(chart.height + _AROUND for chart, _ in self.charts) + 60
        return (
            f'<iframe title="{escape(self.title)}" srcdoc="{escape(self.html())}" '
            f'style="width:100%;height:{height}px;max-height:90vh;border:0" '
            f'loading="lazy"></iframe>\n'
        )

    def html(self) -> str:
        """Return a self-contained page of the charts."""
        figures = "".join(chart_html(chart, escape(caption)) for chart, caption in self.charts)
        return scaffold(
            self.title,
            f"<style>/*tones*/{asset('page.css')}\n{_STYLE}</style>\n",
            f'<main id="content">\n<h1>{escape(self.title)}</h1>\n{figures}</main>\n',
        )

    def write(self, path: str | Path) -> Path:
        """Write the page, atomically."""
        return write_text(self.html(), path)


def chart_html(chart: Chart, caption: str, *, points: int = POINTS) -> str:
    """Return a chart as a figure: numbers of 16 bits, exact to 1/65,000 of their range."""
    order = np.argsort(chart.x, kind="stable")
    x = np.asarray(chart.x, dtype=float)[order]
    lines = [(s, _sorted(s.y, order), _sorted(s.half, order)) for s in chart.series]
    rows, most = np.arange(len(x)), max(points // max(len(lines), 1), 8)
    if len(x) > points:
        rows = np.unique(np.concatenate([thin(y, most) for _, y, _ in lines]))
    series = [
        {**vars(s), "y": _axis(y[rows], chart, "y"),
         "half": None if half is None else stepped(half[rows])}
        for s, y, half in lines
    ]  # fmt: skip
    labels = {"x_label": raised(chart.x_label), "y_label": raised(chart.y_label)}
    data = {**vars(chart), **labels, "x": _axis(x[rows], chart, "x", "<u4"), "series": series}
    text = script_json(data)
    head = f"<figcaption>{caption}</figcaption>" if caption else ""
    return (
        f'<figure class="chart">{head}<noscript>This chart needs JavaScript.</noscript>'
        f'<script type="application/json">{text}</script></figure>\n'
    )


def script_json(data: Mapping[str, Any]) -> str:
    """Return JSON for a script; "<" is an escape, so that no text in it can end the script."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")


def thin(y: Array, points: int) -> NDArray[np.int_]:
    """Return the points of a line (N,) that are sufficient to draw it: its extremes and breaks."""
    count = len(y)
    if count <= points:
        return np.arange(count)
    width = -(-2 * count // points)
    finite = np.isfinite(y)
    first = np.arange(0, count, width)
    below, above = np.full((2, len(first) * width), [[np.inf], [-np.inf]])
    below[:count][finite] = above[:count][finite] = y[finite]
    extremes = np.concatenate(
        [first + below.reshape(-1, width).argmin(axis=1),
         first + above.reshape(-1, width).argmax(axis=1)]
    )  # fmt: skip
    extremes = extremes[finite[extremes]]
    breaks = np.flatnonzero(finite[1:] != finite[:-1])
    return np.unique(np.concatenate([[0], extremes, breaks, breaks + 1, [count - 1]]))


def broken(segment: Array, x: Array, *lines: Array) -> tuple[Array, ...]:
    """Return x and lines, (N,), with a row of NaN between the segments (N,) of a recording."""
    ends = np.flatnonzero(np.diff(segment)) + 1
    between = (x[ends - 1] + x[ends]) / 2
    return np.insert(x, ends, between), *(np.insert(y, ends, np.nan) for y in lines)


def _axis(values: Array, chart: Chart, axis: str, kind: str = "<u2") -> dict[str, Any]:
    if axis not in chart.logarithmic:
        return stepped(values, kind)
    logarithms = np.log10(np.where(values > 0, values, np.nan))
    return {**stepped(logarithms, kind), "log": True}


def _sorted(values: Array | None, order: NDArray[np.int_]) -> Any:  # noqa: ANN401
    return None if values is None else np.asarray(values, dtype=float)[order]


def packed(values: Array, kind: str = "<f4") -> dict[str, Any]:
    """Return an array for a page: base64 of little-endian numbers."""
    array = np.ascontiguousarray(values, dtype=kind)
    data = base64.b64encode(array.tobytes()).decode("ascii")
    return {"kind": kind, "shape": list(array.shape), "data": data}


def stepped(values: Array, kind: str = "<u2") -> dict[str, Any]:
    """Return columns as whole steps from their lowest to their highest; the last code is NaN."""
    last, known = int(np.iinfo(kind).max), np.isfinite(values)
    low = np.where(known, values, np.inf).min(axis=0, initial=np.inf)
    high = np.where(known, values, -np.inf).max(axis=0, initial=-np.inf)
    low, high = (np.where(np.isfinite(x), x, 0.0) for x in (low, high))
    step = np.maximum((high - low) / (last - 1), 1e-30)
    codes = np.where(known, np.rint((np.where(known, values, low) - low) / step), last)
    return {**packed(codes, kind), "low": low.tolist(), "step": step.tolist()}
