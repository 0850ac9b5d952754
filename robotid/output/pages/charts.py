"""Charts of the pages: data and a static picture in HTML, which charts.js makes interactive."""

import base64
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotid.base.exceptions import DataError
from robotid.base.typing import Array

_KINDS = ("line", "dots", "bars", "area")
_POINTS = 2000  # rows of a chart's data
_STILL = 200  # points of a line in the static picture
_LEFT, _RIGHT, _TOP, _BOTTOM = 54, 10, 20, 34  # [px] around its axes
_THIN = 0.05  # [px] narrower areas are not drawn
_LINE = 14  # [px] of a row of labels
_LETTER = 6.2  # [px] about the width of a letter


@dataclass(frozen=True, eq=False)
class Series:
    """One line, cloud or set of bars of a chart.

    Attributes:
        label: Its name in the legend.
        y: Values, shape (N,), NaN where the line breaks.
        tone: Its colour: a variable of tones.css without its dashes, as "predicted" or "tone-1".
        kind: "line", "dots", "bars", which are side by side, or "area"; the areas of a chart
            are stacked, positive values upwards and negative values downwards.
        half: Half width of a band about a line, of error bars about dots and bars, shape (N,).
        is_weak: Whether it is drawn faintly.
        is_hidden: Whether it is hidden until its key in the legend is pressed.
    """

    label: str
    y: Array
    tone: str
    kind: str = "line"
    half: Array | None = None
    is_weak: bool = False
    is_hidden: bool = False


@dataclass(frozen=True, eq=False)
class Chart:
    """A chart: series over a common x.

    Attributes:
        title: Its description, for screen readers.
        x: Shape (N,); the log's own time where it is time. Points are drawn in its order.
        series: The series, the last one on top.
        x_label: Its name and unit, as "time [s]".
        y_label: Name and unit of the values, as "torque [N m]".
        link: Charts of one link share the cursor and the zoom along x.
        spans: Segments of x with a shaded background, as samples that are not used.
        marks: Positions of dotted lines on x.
        logarithmic: The logarithmic axes: "", "x", "y" or "xy".
        height: Height of the plot [px].
        width: Width of the static picture [px], about that of the chart on a page.
        x_names: Names at x = 0, 1, ... in place of numbers, if any.
    """

    title: str
    x: Array
    series: tuple[Series, ...]
    x_label: str
    y_label: str
    link: str = ""
    spans: tuple[tuple[float, float], ...] = ()
    marks: tuple[float, ...] = ()
    logarithmic: str = ""
    height: int = 180
    width: int = 640
    x_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for series in self.series:
            if series.kind not in _KINDS:
                raise DataError(
                    f"series '{series.label}' of the chart '{self.title}' is of kind "
                    f"'{series.kind}'; kinds: {', '.join(_KINDS)}"
                )
            for what, values in (("values", series.y), ("half widths", series.half)):
                if values is not None and np.shape(values) != np.shape(self.x):
                    raise DataError(
                        f"series '{series.label}' of the chart '{self.title}' has "
                        f"{np.size(values)} {what}, its x has {np.size(self.x)}"
                    )


def chart_html(chart: Chart, caption: str, *, points: int = _POINTS, still: int = _STILL) -> str:
    """Return a chart as a figure of a page of ``pages.html``.

    It contains a static picture, for print and without scripts, and the data that charts.js
    draws: numbers of 16 bits, exact to 1/65,000 of their range.
    """
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
        "marks": chart.marks,
        "logarithmic": chart.logarithmic,
        "height": chart.height,
        "x_names": chart.x_names,
    }
    # "<" is an escape in JSON, so no text in it can end the script
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    head = f"<figcaption>{caption}</figcaption>" if caption else ""
    return (
        f'<figure class="chart">{head}{_still(chart, x, series, still)}'
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
    low, high = _extent([values[finite]], margin=0.0)
    steps = np.rint((values[finite] - low) / ((high - low) or 1.0) * (last - 1))
    codes = np.full(len(values), last, dtype=code)
    codes[finite] = steps.astype(code)
    data = base64.b64encode(codes.tobytes()).decode("ascii")
    return {"data": data, "low": low, "high": high, "log": is_log, "bits": bits}


def _extent(arrays: Sequence[Array], margin: float) -> tuple[float, float]:
    """Return the smallest and the largest number, and a margin [share] around them."""
    every = np.concatenate([np.ravel(a) for a in arrays]) if arrays else np.empty(0)
    every = every[np.isfinite(every)]
    if not len(every):
        return 0.0, 1.0
    low, high = float(every.min()), float(every.max())
    beyond = margin * ((high - low) or 2.0 * abs(low) or 2.0)
    return low - beyond, high + beyond


# ---- the static picture ---------------------------------------------------------------------

_Drawn = tuple[Series, Array, Array | None]  # a series, its sorted values and half widths


@dataclass(frozen=True)
class _Axis:
    """Numbers to pixels."""

    low: float
    high: float
    start: float
    stop: float
    is_log: bool

    def __call__(self, values: Array | float) -> Array:
        v = np.asarray(values, dtype=float)
        if self.is_log:
            v = np.log10(np.where(v > 0, v, np.nan))
        share = (v - self.low) / (self.high - self.low)
        return np.asarray(self.start + share * (self.stop - self.start))

    @cached_property
    def ticks(self) -> list[float]:
        if self.is_log:
            few = self.high - self.low < 1.5
            decades = range(int(np.floor(self.low)), int(np.ceil(self.high)) + 1)
            every = [s * 10.0**d for d in decades for s in ((1, 2, 5) if few else (1,))]
            return [v for v in every if self.low <= np.log10(v) <= self.high]
        step = self.step
        first, last = np.ceil(self.low / step), np.floor(self.high / step)
        return [float(k * step) for k in np.arange(first, last + 1)]

    @cached_property
    def step(self) -> float:
        """Distance of the ticks: 1, 2 or 5 times a power of ten."""
        distance = 22.0 if self.stop < self.start else 80.0  # [px] at least
        least = (self.high - self.low) * distance / abs(self.stop - self.start)
        power = 10.0 ** np.floor(np.log10(least))
        return float(power * next(s for s in (1, 2, 5, 10) if s * power >= least))

    @property
    def words(self) -> list[str]:
        """The numbers at the ticks, with as many digits as their step needs."""
        digits = 0 if self.is_log else max(0, -int(np.floor(np.log10(self.step) + 1e-9)))
        written = [f"{v:.6g}" if self.is_log else f"{v + 0.0:.{digits}f}" for v in self.ticks]
        return [word.replace("-", "−") for word in written]


_Cover = list[tuple[Array, Array]]  # lower and upper edges of what a series covers


def _slant(names: Sequence[str], width: int) -> int:
    """Return the height [px] of slanted names below the axis; 0 if they fit horizontally."""
    room = (width - _LEFT - _RIGHT) / max(len(names), 1)
    longest = _LETTER * max(map(len, names), default=0)
    return round(0.5 * longest) if longest > room else 0


def _covers(series: Sequence[_Drawn]) -> list[_Cover]:
    """Return the covered ranges of each series; an area has a positive and a negative one."""
    covers: list[_Cover] = []
    up = down = np.zeros(0)  # edges of the areas so far
    for s, y, half in series:
        if s.kind == "area":
            up, down = (up, down) if len(up) else (np.zeros(len(y)), np.zeros(len(y)))
            higher, lower = up + np.fmax(y, 0.0), down + np.fmin(y, 0.0)
            covers.append([(up, higher), (lower, down)])
            up, down = higher, lower
        else:
            margin = 0.0 if half is None else np.where(np.isfinite(half), half, 0.0)
            zero = 0.0 if s.kind == "bars" else np.nan
            covers.append([(np.fmin(y - margin, zero), np.fmax(y + margin, zero))])
    return covers


def _still(chart: Chart, x: Array, series: Sequence[_Drawn], points: int) -> str:
    """Return the chart as an ``<svg>`` of a few points."""
    series = [item for item in series if not item[0].is_hidden]
    covers = _covers(series)
    legend, height = _legend(
        chart, _TOP + chart.height + _BOTTOM + _slant(chart.x_names, chart.width)
    )
    logs = ["x" in chart.logarithmic, "y" in chart.logarithmic]
    edges = [edge for cover in covers for pair in cover for edge in pair]
    values = [x, np.concatenate(edges or [np.empty(0)])]
    scaled = [np.log10(v[v > 0]) if log else v for v, log in zip(values, logs, strict=True)]
    is_wide = any(s.kind == "bars" for s in chart.series) or bool(chart.x_names)
    across = _Axis(
        *_extent([scaled[0]], 0.5 / max(len(x) - 1, 1) if is_wide else 0.0),
        _LEFT, chart.width - _RIGHT, logs[0],
    )  # fmt: skip
    if across.high == across.low:
        across = _Axis(across.low - 0.5, across.low + 0.5, _LEFT, chart.width - _RIGHT, logs[0])
    up = _Axis(*_extent([scaled[1]], 0.04), _TOP + chart.height, _TOP, logs[1])
    drawn = "".join(
        _drawn(chart, x, item, cover, across, up, points)
        for item, cover in zip(series, covers, strict=True)
    )
    return (
        f'<svg viewBox="0 0 {chart.width} {height}" role="img" aria-label="{escape(chart.title)}" '
        f'font-size="11" fill="currentColor">{_frame(chart, across, up)}{drawn}'
        f"{legend}</svg>"
    )


def _frame(chart: Chart, across: _Axis, up: _Axis) -> str:
    """Return shaded segments, grid, ticks, dotted marks and the name of the x axis."""
    bottom, right = up.start, across.stop
    parts = []
    for start, end in chart.spans:
        left, stop = np.clip(across(np.array([start, end])), _LEFT, right)
        parts.append(
            f'<path d="M{left:.1f} {_TOP}H{max(stop, left + 0.5):.1f}V{bottom:.0f}H{left:.1f}z" '
            'fill-opacity="0.09"/>'
        )
    heights = up(np.array(up.ticks)).tolist()
    columns = across(np.array(range(len(chart.x_names)) or across.ticks, dtype=float)).tolist()
    grid = "".join(f"M{_LEFT} {y:.1f}H{right}" for y in heights)
    grid += "".join(f"M{x:.1f} {_TOP}V{bottom}" for x in columns)
    parts.append(f'<path d="{grid}" stroke="currentColor" stroke-opacity="0.15"/>')
    parts += [
        f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{word}</text>'
        for y, word in zip(heights, up.words, strict=True)
    ]
    slant = _slant(chart.x_names, chart.width)
    for x, word in zip(columns, chart.x_names or across.words, strict=True):
        place = f"{x:.1f} {bottom + 14:.0f}"
        slanted = f'transform="translate({place}) rotate(-30)" text-anchor="end"'
        upright = f'transform="translate({place})" text-anchor="middle"'
        parts.append(f"<text {slanted if slant else upright}>{escape(word)}</text>")
    marks = across(np.array(chart.marks, dtype=float)).tolist()
    dotted = "".join(f"M{x:.1f} {_TOP}V{bottom}" for x in marks)
    if dotted:
        parts.append(f'<path d="{dotted}" stroke="currentColor" stroke-dasharray="1 3"/>')
    middle = (_LEFT + right) / 2
    parts.append(
        f'<text x="{middle:.0f}" y="{bottom + 29 + slant:.0f}" text-anchor="middle">'
        f"{escape(chart.x_label)}</text>"
    )
    return "".join(parts)


def _legend(chart: Chart, height: float) -> tuple[str, float]:
    """Return the name of the values with the label of each series, and the total height.

    Labels that do not fit above the axes are below the picture.
    """
    parts = [f'<text x="4" y="12">{escape(chart.y_label)}</text>']
    place, down = 4 + _LETTER * (len(chart.y_label) + 3), 12.0
    for series in (s for s in chart.series if not s.is_hidden):
        width = 16 + _LETTER * (len(series.label) + 3)
        if place + width > chart.width + 3 * _LETTER:
            place, down = float(_LEFT), height + 8
            height += _LINE
        opacity = 0.5 if series.is_weak else 1.0
        parts.append(
            f'<path d="M{place:.0f} {down - 4:.0f}h12" stroke="var(--{series.tone})" '
            f'stroke-width="4" stroke-opacity="{opacity}"/>'
            f'<text x="{place + 16:.0f}" y="{down:.0f}">{escape(series.label)}</text>'
        )
        place += width
    return "".join(parts), height


def _drawn(
    chart: Chart,
    x: Array,
    item: _Drawn,
    cover: _Cover,
    across: _Axis,
    up: _Axis,
    points: int,
) -> str:
    """Return one series as paths."""
    series, y, half = item
    colour, weak = f"var(--{series.tone})", 0.5 if series.is_weak else 1.0
    if series.kind == "bars":
        group = [s for s in chart.series if s.kind == "bars"]
        slot = 0.8 / len(group) * float(np.min(np.diff(x))) if len(x) > 1 else 0.8 / len(group)
        x = x + slot * (group.index(series) - (len(group) - 1) / 2)
        width = 0.9 * float(across(x[0] + slot) - across(x[0])) if len(x) else 0.0
        zero = float(up(0.0))
        path = "".join(
            f"M{a - width / 2:.1f} {zero:.1f}h{width:.1f}V{b:.1f}h{-width:.1f}z"
            for a, b in _finite(across(x), up(y))
        )
        drawn = f'<path d="{path}" fill="{colour}" fill-opacity="{weak}"/>'
        return drawn + (_whiskers(x, y, half, across, up, "currentColor"))
    if series.kind == "dots":
        rows = np.flatnonzero(np.isfinite(y))[:: max(1, int(np.isfinite(y).sum()) // (2 * points))]
        path = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in _finite(across(x[rows]), up(y[rows])))
        return (
            f'<path d="{path}" stroke="{colour}" stroke-width="3" stroke-linecap="round" '
            f'stroke-opacity="{weak}"/>{_whiskers(x, y, half, across, up, colour)}'
        )
    if series.kind == "area":
        style = f'fill="{colour}" fill-opacity="{0.7 * weak}"'
        return _band(x, y, cover, across, up, style, points)
    under = ""
    if half is not None:
        style = f'fill="{colour}" fill-opacity="0.2"'
        under = _band(x, y, cover, across, up, style, points)
    rows = thin(y, points)
    path = "".join(_path(across(x[rows])[r], up(y[rows])[r]) for r in _runs(y[rows]))
    return (
        f'{under}<path d="{path}" fill="none" stroke="{colour}" stroke-width="1.2" '
        f'stroke-opacity="{weak}"/>'
    )


def _band(
    x: Array, y: Array, cover: _Cover, across: _Axis, up: _Axis, style: str, points: int
) -> str:
    """Return the area between edges, as a path."""
    breaks = np.flatnonzero(np.diff(np.isfinite(y)))
    step = max(1, len(x) // points)
    every = np.arange(0, len(x), step)
    rows = np.unique(np.concatenate([every, breaks, breaks + 1, [len(x) - 1]]))
    at = across(x[rows])
    path = ""
    for low, high in cover:
        lower, upper = up(low[rows]), up(high[rows])
        is_wide = np.abs(upper - lower) > _THIN
        is_seen = is_wide.copy()  # ... and the points beside wide ones
        is_seen[:-1] |= is_wide[1:]
        is_seen[1:] |= is_wide[:-1]
        path += "".join(
            _path(np.append(at[r], at[r][::-1]), np.append(upper[r], lower[r][::-1])) + "z"
            for r in _runs(np.where(is_seen, lower + upper + y[rows], np.nan))
        )
    return f'<path d="{path}" {style}/>'


def _whiskers(x: Array, y: Array, half: Array | None, across: _Axis, up: _Axis, colour: str) -> str:
    if half is None:
        return ""
    at, low, high = across(x), up(y - half), up(y + half)
    known = np.isfinite(at + low + high)
    path = "".join(
        f"M{a:.1f} {b:.1f}V{c:.1f}"
        for a, b, c in zip(*(z[known].tolist() for z in (at, low, high)), strict=True)
    )
    return f'<path d="{path}" stroke="{colour}" stroke-width="1.2"/>'


def _runs(y: Array) -> list[slice]:
    """Return the segments of finite numbers."""
    is_inside = np.zeros(len(y) + 2, dtype=bool)
    is_inside[1:-1] = np.isfinite(y)
    edges = np.flatnonzero(is_inside[1:] != is_inside[:-1])
    return [slice(a, b) for a, b in edges.reshape(-1, 2).tolist()]


def _path(x: Array, y: Array) -> str:
    places = np.column_stack([x, y]).ravel().tolist()
    return "M" + "L".join(["%.1f %.1f"] * len(x)) % tuple(places)


def _finite(x: Array, y: Array) -> Iterator[tuple[float, float]]:
    known = np.isfinite(x + y)
    return zip(x[known].tolist(), y[known].tolist(), strict=True)
