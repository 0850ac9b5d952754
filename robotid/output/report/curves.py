"""The section of charts over time: of each joint, in each recording that is drawn."""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any, TypeVar

from robotid.identification.summary import verdict_cell
from robotid.output.pages.html import code, folded

_ROWS = 24_000  # of all charts: about half a MB
_LONGEST = 2000  # rows of one chart
_OPEN = 2  # joints that are open at most
_MOST_PLOTS = 84  # twelve recordings of a 7-joint arm

RunT = TypeVar("RunT")


def drawn(runs: Sequence[RunT], rows: Sequence[str]) -> Sequence[RunT]:
    """Return the recordings that are drawn: the first ones, to limit the page's size."""
    return runs[: max(1, _MOST_PLOTS // len(rows))]


def curves_section(
    intro: str,
    runs: Mapping[str, RunT],
    rows: Sequence[str],
    verdicts: Mapping[str, Mapping[str, Any]],
    worst: Sequence[str],
    charts: Callable[[RunT, int, str, int], str],
    note: Callable[[int], str],
    most: int = _OPEN,
) -> str:
    """A part for each joint; the worst joint and the worst ones that are not good are open."""
    points = min(_LONGEST, max(200, _ROWS // (2 * len(rows) * max(1, len(runs)))))
    parts, first = [intro], [*worst][:most]
    for row, name in enumerate(rows):
        status = verdict_cell(name, verdicts[name]) if name in verdicts else ""
        html = note(row) + "".join(charts(run, row, link, points) for link, run in runs.items())
        summary = f"<strong>{code(name).html}</strong> {escape(status)}"
        is_open = name in first[:1] or (status.startswith(("poor", "usable")) and name in first)
        parts.append(folded(f"joint-{row}", summary, html, is_open=is_open))
    return "".join(parts)
