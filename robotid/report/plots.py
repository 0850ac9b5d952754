"""The report's plots: inline SVG whose colours follow the page, light, dark or on paper."""

import re
from collections.abc import Sequence
from html import escape
from io import StringIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotid._typing import Array
from robotid.identification.bands import REACH, TorqueBand
from robotid.identification.evaluation import Evaluation

__all__ = [
    "INK",
    "PREDICTED",
    "RESIDUAL",
    "STYLE",
    "plot_body",
    "plot_torque",
    "stretches",
    "svg_element",
    "thin",
]

# Matplotlib writes each of these colours into the SVG; there it becomes one of the page's own
#: Colour of text and axes; in a page it becomes the colour of the page's text.
INK = "#010101"
_PREDICTED, _RESIDUAL = "#020202", "#030303"
_PAGE_COLOURS = {
    INK: "currentColor",
    _PREDICTED: "var(--predicted)",
    _RESIDUAL: "var(--residual)",
}
#: Colours of predictions and of residuals, which follow the page likewise.
PREDICTED, RESIDUAL = _PREDICTED, _RESIDUAL
#: Matplotlib's settings for every plot.
STYLE: dict[Any, Any] = {
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.labelsize": 8.5,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "font.family": "sans-serif",
    "font.size": 8.5,
    "grid.alpha": 0.15,
    "grid.color": INK,
    "legend.frameon": False,
    "path.simplify_threshold": 0.25,
    "svg.fonttype": "none",
    "svg.hashsalt": "robotid",
    "text.color": INK,
    "text.parse_math": False,
    "xtick.color": INK,
    "ytick.color": INK,
}


def plot_torque(
    evaluation: Evaluation,
    row: int,
    band: TorqueBand,
    *,
    unit: str,
    title: str,
    key: str,
    points: int = 2000,
) -> str:
    """Return a plot of measured against predicted torque, and of the residual below it.

    Lines are never joined across a gap of the recording. Where rows were not used, the ground is
    shaded and only the measured torque is drawn: the sign of friction is not known there.

    Args:
        evaluation: A recording with predictions.
        row: Number of the torque row.
        band: How far its predictions can be trusted; the residual's 95 % band is drawn.
        unit: Its unit.
        title: What the plot shows, for those who cannot see it.
        key: A word that no other plot on the page has.
        points: Longest line that is drawn; extremes are kept.

    Returns:
        An ``<svg>`` element.
    """
    import matplotlib
    from matplotlib.figure import Figure

    trajectory = evaluation.recording.trajectory
    t, tau = trajectory.t, trajectory.tau[:, row]
    prediction = evaluation.torques["estimate"][:, row]
    used: NDArray[np.bool_] = evaluation.recording.mask[:, row].astype(bool)
    whole, kept = stretches(trajectory.segment), stretches(trajectory.segment, used)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.3))
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(5, 2))
        upper.plot(*thin(t, tau, whole, points), color=INK, alpha=0.6, lw=1.3, label="measured")
        upper.plot(*thin(t, prediction, kept, points), color=_PREDICTED, lw=1.0, label="predicted")
        lower.plot(*thin(t, tau - prediction, kept, points), color=_RESIDUAL, lw=0.8)
        lower.axhline(0.0, color=INK, lw=0.5)
        _draw_band(lower, t, whole, band, row)
        for axes in (upper, lower):
            _shade(axes, t, stretches(trajectory.segment, ~used))
            axes.grid(visible=True)
            axes.margins(x=0.01)
            axes.locator_params(axis="y", nbins=5)
        upper.set_ylabel(f"torque [{unit}]" if unit == "N m" else f"force [{unit}]")
        lower.set(xlabel="time [s]", ylabel=f"residual [{unit}]")
        upper.legend(loc="lower left", bbox_to_anchor=(0.0, 0.98), ncols=2, borderpad=0)
        figure.align_ylabels()
        figure.subplots_adjust(left=0.11, right=0.99, top=0.92, bottom=0.13, hspace=0.12)
        return svg_element(figure, title, key)


def plot_body(
    terms: Sequence[str],
    prior: Array,
    value: Array,
    error: Array,
    spread: Array,
    *,
    title: str,
    key: str,
) -> str:
    """Return a plot of one body's parameters with error bars, beside those of the URDF.

    Args:
        terms: Names of its k parameters.
        prior: Those of the URDF, shape (k,).
        value: The identified ones, shape (k,).
        error: Their standard errors, shape (k,).
        spread: The unit each is drawn in: how far its prior may be wrong, shape (k,).
        title: What the plot shows, for those who cannot see it.
        key: A word that no other plot on the page has.

    Returns:
        An ``<svg>`` element.
    """
    import matplotlib
    from matplotlib.figure import Figure

    y = np.arange(len(terms))
    scale = np.where(spread > 0, spread, 1.0)
    bars = np.where(np.isfinite(error), 2 * error, 0.0)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 2.7))
        axes = figure.subplots()
        axes.plot(prior / scale, y - 0.18, "o", mfc="none", mec=INK, ms=4.5, label="URDF")
        axes.errorbar(
            value / scale,
            y + 0.18,
            xerr=bars / scale,
            fmt="o",
            color=_PREDICTED,
            ms=4,
            lw=1.2,
            capsize=2.5,
            label="identified, ±2 standard errors",
        )
        axes.set_yticks(y, terms)
        axes.set_xlabel("value in units of the prior's assumed spread")
        axes.invert_yaxis()
        axes.grid(visible=True, axis="x")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 0.98), ncols=2, borderpad=0)
        figure.subplots_adjust(left=0.11, right=0.99, top=0.91, bottom=0.16)
        return svg_element(figure, title, key)


def stretches(segment: NDArray[Any], used: NDArray[np.bool_] | None = None) -> list[slice]:
    """Return the uninterrupted stretches of a recording.

    Args:
        segment: Number of the stretch of each row, shape (N,).
        used: Rows to keep, shape (N,), bool; all if None.

    Returns:
        Slices of neighbouring kept rows of one segment.
    """
    kept = np.ones(len(segment), dtype=bool) if used is None else used
    same = kept[1:] & kept[:-1] & (segment[1:] == segment[:-1])
    starts = np.flatnonzero(kept & ~np.r_[False, same])
    ends = np.flatnonzero(kept & ~np.r_[same, False]) + 1
    return [slice(start, end) for start, end in zip(starts.tolist(), ends.tolist(), strict=True)]


def thin(t: Array, y: Array, parts: Sequence[slice], points: int) -> tuple[Array, Array]:
    """Return a line with fewer points that keeps every extreme, NaN between its stretches.

    Args:
        t: Times, shape (N,) [s].
        y: Values, shape (N,).
        parts: Stretches to draw.
        points: About how many points to keep.

    Returns:
        Times and values, shape (M,); not thinned where there are fewer points than asked for.
    """
    total = sum(part.stop - part.start for part in parts)
    width = max(1, int(np.ceil(2 * total / points))) if total > points else 1
    times: list[Array] = []
    values: list[Array] = []
    for part in parts:
        rows = np.arange(part.start, part.stop)
        if width > 1:
            rows = _extremes(y[part], width) + part.start
        times += [t[rows], np.array([np.nan])]
        values += [y[rows], np.array([np.nan])]
    if not parts:
        return np.empty(0), np.empty(0)
    return np.concatenate(times[:-1]), np.concatenate(values[:-1])


def svg_element(figure: Any, title: str, key: str) -> str:  # noqa: ANN401
    """Return a figure as an element that can stand in a page beside others.

    Args:
        figure: A figure of Matplotlib, drawn in ``STYLE``.
        title: What it shows, for those who cannot see it.
        key: A word that no other plot on the page has.

    Returns:
        An ``<svg>`` element.
    """
    stream = StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(stream, format="svg", transparent=True, metadata=nothing)
    svg: str = stream.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg).replace("xlink:href", "href")
    # ids are unique in a page, not only in a figure
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{key}-", svg)
    svg = re.sub(r'\bd="[^"]*"', _rounded, svg)
    for colour, variable in _PAGE_COLOURS.items():
        svg = svg.replace(colour, variable)
    label = f'<title id="{key}-title">{escape(title)}</title>'
    head, rest = svg.split(">", 1)
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    return f'{head} role="img" aria-labelledby="{key}-title">{label}{rest}'


def _extremes(y: Array, width: int) -> NDArray[np.int_]:
    """Return the rows of the smallest and largest value of each ``width`` rows, and the ends."""
    padded = np.pad(y, (0, -len(y) % width), mode="edge").reshape(-1, width)
    first = width * np.arange(len(padded))
    rows = np.r_[0, first + padded.argmin(axis=1), first + padded.argmax(axis=1), len(y) - 1]
    kept: NDArray[np.int_] = np.unique(np.minimum(rows, len(y) - 1))
    return kept


def _draw_band(
    axes: Any,  # noqa: ANN401
    t: Array,
    parts: Sequence[slice],
    band: TorqueBand,
    row: int,
) -> None:
    """Draw the 95 % band of a residual, stretch by stretch."""
    half = REACH * band.total[:, row]
    for part in parts:
        inside = (band.samples >= part.start) & (band.samples < part.stop)
        times = t[band.samples[inside]]
        axes.fill_between(times, -half[inside], half[inside], color=_RESIDUAL, alpha=0.2, lw=0)


def _shade(axes: Any, t: Array, parts: Sequence[slice]) -> None:  # noqa: ANN401
    """Shade the times of the stretches; those closer than a pixel are drawn as one."""
    spans: list[list[float]] = []
    pixel = (t[-1] - t[0]) / 500
    for part in parts:
        start, end = float(t[part.start]), float(t[part.stop - 1])
        if spans and start - spans[-1][1] < pixel:
            spans[-1][1] = end
        else:
            spans.append([start, end])
    bars = [(start, max(end - start, pixel / 2)) for start, end in spans]
    axes.broken_barh(
        bars, (0.0, 1.0), transform=axes.get_xaxis_transform(), color=INK, alpha=0.09, lw=0
    )


def _rounded(path: re.Match[str]) -> str:
    return re.sub(r"-?\d+\.\d{3,}", lambda found: f"{float(found.group()):.2f}", path.group())
