"""Figures of Matplotlib as SVG with the colours of the page: light, dark or print."""

import re
from html import escape
from io import StringIO
from typing import Any

__all__ = [
    "INK",
    "STYLE",
    "svg_element",
]

#: Colour of text and axes; in a page it becomes the colour of the page's text.
INK = "#010101"
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


def svg_element(figure: Any, title: str, key: str) -> str:  # noqa: ANN401
    """Return a figure as an SVG element of a page.

    Args:
        figure: A figure of Matplotlib, drawn in ``STYLE``.
        title: Its description, for screen readers.
        key: Prefix of its ids, unique on the page.
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
    svg = svg.replace(INK, "currentColor")
    label = f'<title id="{key}-title">{escape(title)}</title>'
    head, rest = svg.split(">", 1)
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    return f'{head} role="img" aria-labelledby="{key}-title">{label}{rest}'


def _rounded(path: re.Match[str]) -> str:
    return re.sub(r"-?\d+\.\d{3,}", lambda found: f"{float(found.group()):.2f}", path.group())
