"""The report's section of torques over time: each joint's, in every recording that is shown."""

from collections.abc import Sequence
from dataclasses import asdict
from html import escape

from robotid.fitting.bands import TorqueBand
from robotid.fitting.evaluation import Evaluation
from robotid.identification.pictures import torque_charts
from robotid.identification.result import Identification
from robotid.identification.summary import verdict_cell
from robotid.pages.charts import chart_html
from robotid.pages.html import code, folded, percent
from robotid.report.summary_screen import joint_errors

__all__ = ["torques_section"]

_ROWS = 24_000  # of all charts together: about half a MB
_LONGEST = 2000  # rows of one chart
_OPEN = 6  # joints that are open at most
_MOST_PLOTS = 84  # twelve recordings of a 7-joint arm


def torques_section(found: Identification) -> str:
    """Return torques and residuals over time; joints that are not good are open, the worst few.

    Args:
        found: The identification.
    """
    model, evaluations = found.model, found.validation or found.fitted
    shown = evaluations[: max(1, _MOST_PLOTS // model.n_rows)]
    points = min(_LONGEST, max(200, _ROWS // (2 * model.n_rows * len(shown))))
    bands = [found.band(evaluation) for evaluation in shown]
    parts, worst = [_said(found, shown, evaluations[len(shown) :])], [*joint_errors(found)][:_OPEN]
    for row, name in enumerate(model.row_names):
        verdict = found.verdict.joints.get(name)
        said = "" if verdict is None else verdict_cell(name, asdict(verdict))
        charts = "".join(
            _charts(found, evaluation, band, row, link=f"recording {k}", points=points)
            for k, (evaluation, band) in enumerate(zip(shown, bands, strict=True))
        )
        summary = f"<strong>{code(name).html}</strong> {escape(said)}"
        is_bad = said.startswith(("poor", "usable")) and name in worst
        parts.append(folded(f"torque-{row}", summary, charts, is_open=is_bad))
    return "".join(parts)


def _said(found: Identification, shown: Sequence[Evaluation], left: Sequence[Evaluation]) -> str:
    """Return what the charts show, and of which recordings."""
    parts = [
        "<p>Measured torque, the identified model's with its 95 % band, the URDF's; below, the "
        "residual (measured − identified). Shaded: rows not used, for the joint stands still and "
        "the sign of its friction is unknown, and gaps. Drag to zoom; double-click or Escape shows "
        "all.</p>\n"
    ]
    if not found.validation:
        parts.append("<p>No log was kept apart: these are the fitted logs.</p>\n")
    for evaluation in shown:
        if evaluation.recording.is_partial:
            seen, whole = len(evaluation.recording.trajectory.t), evaluation.recording.extent.smooth
            parts.append(
                f"<p>Of {escape(evaluation.recording.name)}, a long log, {seen} of its {whole} "
                "samples are drawn, from its beginning, middle and end; errors are of all.</p>\n"
            )
    if left:
        names = ", ".join(evaluation.recording.name for evaluation in left)
        parts.append(f"<p>Not drawn, to keep the file small: {escape(names)}.</p>\n")
    return "".join(parts)


def _charts(
    found: Identification, e: Evaluation, band: TorqueBand, row: int, *, link: str, points: int
) -> str:
    """Return torque and residual of a joint in a recording."""
    name, unit = found.model.row_names[row], found.model.row_units[row]
    measured, recording = e.metrics["estimate"].per_joint.get(name), e.recording
    said = "no rows used"
    if measured is not None:
        error = percent(measured.relative_error_pct).html
        held = band.held(recording.trajectory.tau, e.torques["estimate"], recording.mask)[row]
        said = (
            f"error {error} %, RMSE {measured.rmse:.3g} {unit}; 95 % band holds {100 * held:.0f} %"
        )
    kind = "not fitted" if found.validation else "fitted"
    torque, residual = torque_charts(found, e, row, band=band, link=link)
    caption = f"{escape(recording.name)}, {kind}: {said}"
    return chart_html(torque, caption, points=points) + chart_html(residual, "", points=points)
