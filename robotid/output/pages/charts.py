"""Charts of the pages: their data in HTML, which charts.js draws with uPlot."""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotid.base.files import write_text
from robotid.base.typing import Array
from robotid.output.pages.html import asset, scaffold

TONES = 8  # distinguishable colours of lines in one chart: tone-1 to tone-8
POINTS = 2000  # rows of a chart's data
_AROUND = 112  # [px] of caption, axis and legend of each chart in a notebook
_STYLE = "main { padding: .5rem 1rem; } h1 { font-size: 1.125rem; margin: 0 0 .5rem; }"


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
    series = [(s, _sorted(s.y, order), _sorted(s.half, order)) for s in chart.series]
    rows = _union([y for _, y, _ in series], points, len(x))
    is_log = "y" in chart.logarithmic
    data = {
        "title": chart.title,
        "x": _packed(x[rows], is_log="x" in chart.logarithmic, bits=32),
        "series": [
            {
                "label": s.label,
                "tone": s.tone,
                "kind": s.kind,
                "faint": s.is_weak,
                "hidden": s.is_hidden,
                "y": _packed(y[rows], is_log=is_log),
                "half": None if half is None else _packed(half[rows]),
            }
            for s, y, half in series
        ],
        "x_label": chart.x_label,
        "y_label": chart.y_label,
        "link": chart.link,
        "spans": chart.spans,
        "logarithmic": chart.logarithmic,
        "height": chart.height,
    }
    # "<" is an escape in JSON, so no text in it can end the script
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    head = f"<figcaption>{caption}</figcaption>" if caption else ""
    return (
        f'<figure class="chart">{head}<noscript>This chart needs JavaScript.</noscript>'
        f'<script type="application/json">{text}</script></figure>\n'
    )


def thin(y: Array, points: int) -> NDArray[np.int_]:
    """Return the points of a line that are sufficient to draw it: its extremes and its breaks.

    y (N,).
    """
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
    """Return x and lines with a row of NaN between the segments of a recording.

    segment (N,), x (N,), *lines (N,).
    """
    ends = np.flatnonzero(np.diff(segment)) + 1
    between = (x[ends - 1] + x[ends]) / 2
    return np.insert(x, ends, between), *(np.insert(y, ends, np.nan) for y in lines)


def _sorted(values: Array | None, order: NDArray[np.int_]) -> Any:  # noqa: ANN401
    return None if values is None else np.asarray(values, dtype=float)[order]


def _union(lines: Sequence[Array], points: int, count: int) -> NDArray[np.int_]:
    """Return points that are sufficient for every line."""
    if count <= points:
        return np.arange(count)
    share = max(points // len(lines), 8)
    return np.unique(np.concatenate([thin(y, share) for y in lines]))


def _packed(values: Array, *, is_log: bool = False, bits: int = 16) -> dict[str, Any]:
    """Return numbers as base64: steps from low to high, the last code for NaN."""
    code, last = np.dtype(f"<u{bits // 8}"), 2**bits - 1
    if is_log:
        values = np.log10(np.where(values > 0, values, np.nan))
    finite = np.isfinite(values)
    known = values[finite]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    steps = np.rint((known - low) / ((high - low) or 1.0) * (last - 1))
    codes = np.full(len(values), last, dtype=code)
    codes[finite] = steps.astype(code)
    data = base64.b64encode(codes.tobytes()).decode("ascii")
    return {"data": data, "low": low, "high": high, "log": is_log, "bits": bits}
