"""Charts that Python is given: a notebook shows them, and a page holds them."""

from dataclasses import dataclass
from html import escape
from pathlib import Path

from robotid._files import write_text
from robotid.pages.charts import Chart, chart_html
from robotid.pages.html import asset, scaffold

__all__ = ["Plot"]

_AROUND = 112  # [px] of caption, axis and legend around each chart
_STYLE = "main { padding: .5rem 1rem; } h1 { font-size: 1.125rem; margin: 0 0 .5rem; }"
_HIGHEST = 900  # [px] that a cell of a notebook gives


@dataclass(frozen=True, eq=False)
class Plot:
    """Charts below each other: drag to zoom, double click for all, values under the cursor.

    Attributes:
        title: What they show.
        charts: The charts, each with its caption.
    """

    title: str
    charts: tuple[tuple[Chart, str], ...]

    def __repr__(self) -> str:
        return f"<Plot of {self.title}; .write('plot.html') keeps it>"

    def _repr_html_(self) -> str:
        height = min(_HIGHEST, sum(chart.height + _AROUND for chart, _ in self.charts) + 60)
        return (
            f'<iframe title="{escape(self.title)}" srcdoc="{escape(self.html())}" '
            f'style="width:100%;height:{height}px;border:0" loading="lazy"></iframe>\n'
        )

    def html(self) -> str:
        """Return a page of them that fetches nothing."""
        figures = "".join(chart_html(chart, escape(caption)) for chart, caption in self.charts)
        return scaffold(
            self.title,
            f"<style>/*tones*/{asset('page.css')}\n{_STYLE}</style>\n",
            f'<main id="content">\n<h1>{escape(self.title)}</h1>\n{figures}</main>\n',
        )

    def write(self, path: str | Path) -> Path:
        """Write the page, whole or not at all.

        Args:
            path: The file, as "plot.html".

        Returns:
            Its path.

        Raises:
            DataError: If its folder does not exist.
        """
        return write_text(self.html(), path)
