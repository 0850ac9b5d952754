"""Charts for Python and notebooks, which a page can contain."""

from dataclasses import dataclass
from html import escape
from pathlib import Path

from robotid.base.files import write_text
from robotid.output.pages.charts import Chart, chart_html
from robotid.output.pages.html import asset, scaffold

_AROUND = 112  # [px] of caption, axis and legend of each chart
_STYLE = "main { padding: .5rem 1rem; } h1 { font-size: 1.125rem; margin: 0 0 .5rem; }"
_HIGHEST = 900  # [px] of a notebook cell


@dataclass(frozen=True, eq=False)
class Plot:
    """Charts one below the other: drag to zoom, double click for all, values under the cursor.

    Attributes:
        title: Their subject.
        charts: The charts, each with its caption.
    """

    title: str
    charts: tuple[tuple[Chart, str], ...]

    def __repr__(self) -> str:
        return f"<Plot of {self.title}; .write('plot.html') saves it>"

    def _repr_html_(self) -> str:
        height = min(_HIGHEST, sum(chart.height + _AROUND for chart, _ in self.charts) + 60)
        return (
            f'<iframe title="{escape(self.title)}" srcdoc="{escape(self.html())}" '
            f'style="width:100%;height:{height}px;border:0" loading="lazy"></iframe>\n'
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
