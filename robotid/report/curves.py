"""The report's section of charts over time: each joint's, in every recording that is shown."""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any, TypeVar

from robotid.identification.summary import verdict_cell
from robotid.pages.html import code, folded

__all__ = ["curves_section", "drawn"]

_ROWS = 24_000  # of all charts together: about half a MB
_LONGEST = 2000  # rows of one chart
_OPEN = 6  # joints that are open at most
_MOST_PLOTS = 84  # twelve recordings of a 7-joint arm

RunT = TypeVar("RunT")


def drawn(runs: Sequence[RunT], rows: Sequence[str]) -> Sequence[RunT]:
    """Return the recordings that are drawn, the first ones, to keep the page small.

    Args:
        runs: All recordings.
        rows: Names of the joints.
    """
    return runs[: max(1, _MOST_PLOTS // len(rows))]


def curves_section(
    said: str,
    runs: Mapping[str, RunT],
    rows: Sequence[str],
    verdicts: Mapping[str, Mapping[str, Any]],
    worst: Sequence[str],
    charts: Callable[[RunT, int, str, int], str],
) -> str:
    """Return a part for each joint; those that are not good are open, the worst few.

    Args:
        said: What the charts show, HTML.
        runs: The recordings, by a name that links their charts.
        rows: Names of the joints.
        verdicts: The verdict on each, as in result.json.
        worst: Joints that have errors, the worst first.
        charts: Returns the charts of a recording and of the number of a joint, of a name that
            links them, of so many points.
    """
    points = min(_LONGEST, max(200, _ROWS // (2 * len(rows) * max(1, len(runs)))))
    parts, first = [said], [*worst][:_OPEN]
    for row, name in enumerate(rows):
        status = verdict_cell(name, verdicts[name]) if name in verdicts else ""
        html = "".join(charts(run, row, link, points) for link, run in runs.items())
        summary = f"<strong>{code(name).html}</strong> {escape(status)}"
        is_open = status.startswith(("poor", "usable")) and name in first
        parts.append(folded(f"joint-{row}", summary, html, is_open=is_open))
    return "".join(parts)
