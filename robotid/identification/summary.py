"""How results show themselves: a line, a text, and HTML for a notebook."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from robotid._html import code, number, percent, table, text

if TYPE_CHECKING:
    from robotid.identification.metrics import Metrics
    from robotid.identification.pipeline import Identification

__all__ = [
    "identification_html",
    "identification_line",
    "identification_text",
]


def identification_line(found: Identification) -> str:
    """Return an identification in one line.

    Args:
        found: The identification.

    Returns:
        One line.
    """
    return (
        f"<Identification of {found.model.name}: {len(found.base)} base parameters by "
        f"{found.estimator.name}, verdict {found.verdict.status}>"
    )


def identification_text(found: Identification) -> str:
    """Return an identification as text: verdict, reasons, errors by joint.

    Args:
        found: The identification.

    Returns:
        Lines.
    """
    verdict, lines = found.verdict, [identification_line(found)[1:-1]]
    lines += [f"  - {reason}" for reason in verdict.reasons]
    for caption, metrics in _tables(found):
        lines.append(caption)
        width = max(len(joint) for joint in metrics.per_joint)
        for joint, m in metrics.per_joint.items():
            error = percent(m.relative_error_pct).html
            urdf = percent(m.baselines["urdf"]).html
            rmse = f"{m.rmse:.3g} {m.unit}"
            lines.append(f"  {joint:{width}} {error:>6} %  {rmse:12} URDF {urdf:>6} %")
    if found.report:
        lines.append(f"report: {found.report}")
    return "\n".join(lines)


def identification_html(found: Identification) -> str:
    """Return an identification as HTML: verdict, reasons, errors by joint, link to the report.

    Args:
        found: The identification.

    Returns:
        HTML without scripts or styles.
    """
    reasons = "".join(f"<li>{escape(reason)}</li>" for reason in found.verdict.reasons)
    tables = "".join(_errors(caption, metrics) for caption, metrics in _tables(found))
    link = (
        f'<a href="{escape(found.report)}">{escape(found.report)}</a>'
        if found.report
        else "robotid.write_report(found, 'report.html') writes the whole report"
    )
    return (
        f"<p><strong>{escape(found.model.name)}</strong>: {len(found.base)} base parameters by "
        f"{found.estimator.name}; verdict <strong>{found.verdict.status}</strong></p>\n"
        f"<ul>{reasons}</ul>\n{tables}<p>{link}</p>\n"
    )


def _tables(found: Identification) -> list[tuple[str, Metrics]]:
    kept = [(f"{e.recording.name}: not fitted", e.metrics["estimate"]) for e in found.validation]
    return [*kept, ("fitted rows", found.metrics())]


def _errors(caption: str, metrics: Metrics) -> str:
    rows = [
        [
            code(joint),
            percent(m.relative_error_pct),
            number(m.rmse, ".3g"),
            text(m.unit),
            percent(m.baselines["urdf"]),
        ]
        for joint, m in metrics.per_joint.items()
    ]
    return table(caption, ["joint", "error %", "RMSE", "unit", "URDF %"], rows)
