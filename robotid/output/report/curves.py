"""The section of charts over time: of each joint, in each recording that is drawn."""

from collections.abc import Callable, Iterable, Sequence
from html import escape
from typing import TypeVar

from robotid.estimation.fitting.evaluation import Evaluated
from robotid.identification.result import Identification
from robotid.identification.summary import verdict_cell
from robotid.output.pages.html import code, folded
from robotid.output.report.dock import Clip, Dock
from robotid.output.report.errors import Quantity
from robotid.output.report.steps import Origin
from robotid.output.report.worst_second import Residual, worst_html, worst_second

_ROWS = 24_000  # of all charts: about half a MB
_LONGEST = 2000  # rows of one chart
_OPEN = 2  # joints that are open at most
_MOST_PLOTS = 84  # twelve recordings of a 7-joint arm

EvaluatedT = TypeVar("EvaluatedT", bound=Evaluated)


def drawn(runs: Sequence[EvaluatedT], rows: Sequence[str]) -> Sequence[EvaluatedT]:
    """Return the recordings that are drawn: the first ones, to limit the page's size."""
    return runs[: max(1, _MOST_PLOTS // len(rows))]


def curves_section(
    found: Identification,
    evaluations: Sequence[EvaluatedT],
    worst: Sequence[str],
    dock: tuple[str, Origin],
    intro: str,
    charts: Callable[[EvaluatedT, int, str, int], str],
    residuals: Callable[[int], Iterable[Residual]],
    quantity: Quantity,
    units: Sequence[str],
    most: int = _OPEN,
) -> str:
    """A part for each joint; the worst joint and the worst ones that are not good are open.

    ``dock`` is the file of the replay and the source of the result.
    """
    rows, verdicts = found.model.row_names, found.verdict.to_dict()["per_joint"]
    shown = drawn(evaluations, rows)
    runs = {f"recording {k}": e for k, e in enumerate(shown)}
    clips = [Clip(link, str(e.log.path), e.extent.start, e.extent.end) for link, e in runs.items()]
    player = Dock(*dock, str(found.model.tree.path), clips)
    points = min(_LONGEST, max(200, _ROWS // (2 * len(rows) * max(1, len(runs)))))
    parts, first = [player.html, intro], [*worst][:most]
    if left := [e.name for e in evaluations[len(shown) :]]:
        names = escape(", ".join(left))
        parts.append(f"<p>Not drawn, to limit the file size: {names}.</p>\n")
    for row, name in enumerate(rows):
        status = verdict_cell(name, verdicts[name]) if name in verdicts else ""
        unit = f"{quantity.prefix}{units[row]}"
        note = worst_html(worst_second(residuals(row)), name, unit, player, quantity.scale)
        html = note + "".join(charts(e, row, link, points) for link, e in runs.items())
        summary = f"<strong>{code(name).html}</strong> {escape(status)}"
        is_open = name in first[:1] or (status.startswith(("poor", "usable")) and name in first)
        parts.append(folded(f"joint-{row}", summary, html, is_open=is_open))
    return "".join(parts)
