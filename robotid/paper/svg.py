"""Figures of Matplotlib as SVG with the colours of the page: light, dark or print."""

import re
from html import escape
from io import StringIO
from typing import Any

#: Colour of text and axes; in a page it becomes the colour of the page's text.
INK = "#010101"
_WHITE = "#ffffff"
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


def svg_file(figure: Any) -> str:  # noqa: ANN401
    """Return a figure as an SVG file, with a white background behind transparent axes."""
    import matplotlib

    stream = StringIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(
            stream, format="svg", transparent=True, facecolor=_WHITE, metadata={"Date": None}
        )
    return stream.getvalue()


def svg_element(file: str, title: str, key: str) -> str:
    """Return an SVG file of ``svg_file`` as an element of a page, without the background."""
    svg = file[file.index("<svg") :].replace(f"fill: {_WHITE}", "fill: none", 1)
    svg = re.sub(r" <metadata>.*?</metadata>\n", "", svg, flags=re.DOTALL)
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
