"""Figures of Matplotlib as SVG whose colours follow the page: light, dark or on paper."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from io import StringIO
from typing import Any

import numpy as np

__all__ = [
    "INK",
    "PREDICTED",
    "RESIDUAL",
    "STYLE",
    "drawing",
    "legend",
    "plain_decades",
    "svg_element",
]

# Matplotlib writes each of these colours into the SVG; there it becomes one of the page's own
#: Colour of text and axes; in a page it becomes the colour of the page's text.
INK = "#010101"
#: Colours of predictions and of residuals, which follow the page likewise.
PREDICTED, RESIDUAL = "#020202", "#030303"
_PAGE_COLOURS = {
    INK: "currentColor",
    PREDICTED: "var(--predicted)",
    RESIDUAL: "var(--residual)",
}
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


@contextmanager
def drawing(height: float, *, simplify: bool = True) -> Iterator[Any]:
    """Give a figure of the page's width, and the settings to draw and write it in.

    Args:
        height: Its height [inch].
        simplify: Whether points that cannot be told apart are left out of lines.

    Yields:
        A figure of Matplotlib.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context({**STYLE, "path.simplify": simplify}):
        yield Figure(figsize=(6.4, height))


def legend(axes: Any, height: float) -> None:  # noqa: ANN401
    """Draw a legend above the plot, from its left edge.

    Args:
        axes: Axes of Matplotlib, drawn in.
        height: Where it stands, as a share of the height of the axes.
    """
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, height), ncols=3, borderpad=0)


def plain_decades(axes: Any) -> None:  # noqa: ANN401
    """Mark the decades of a logarithmic axis alone, as plain numbers: a page has no formulas.

    Args:
        axes: Axes of Matplotlib, drawn in.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = axes.get_ylim()
    few = np.log10(high / low) < 1.5
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())  # marks between them cost half of the drawing


def svg_element(figure: Any, title: str, key: str) -> str:  # noqa: ANN401
    """Return a figure as an element that can stand in a page beside others.

    Args:
        figure: A figure of Matplotlib, drawn in ``STYLE``.
        title: What it shows, for those who cannot see it.
        key: A word that no other plot on the page has.
    """
    import matplotlib

    stream = StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with matplotlib.rc_context(STYLE):
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


def _rounded(path: re.Match[str]) -> str:
    return re.sub(r"-?\d+\.\d{3,}", lambda found: f"{float(found.group()):.2f}", path.group())
