"""The content of a report on an identification from torques."""

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

import numpy as np

from robotid.base.findings import listed
from robotid.base.versions import versions
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.verdict.parameter_table import parameter_entries
from robotid.estimation.fitting.bands import TorqueBand, next_errors
from robotid.estimation.fitting.evaluation import Evaluation
from robotid.identification.result import TorqueIdentification
from robotid.identification.summary import left_out_lines
from robotid.output.files.entries import input_entries
from robotid.output.pages.charts import chart_html
from robotid.output.pages.html import percent
from robotid.output.report.body_table import parameter_picture
from robotid.output.report.curves import curves_section, drawn
from robotid.output.report.ellipsoids import ellipsoid_pictures
from robotid.output.report.errors import TORQUE, errors_of, worst_errors
from robotid.output.report.next_steps import next_steps
from robotid.output.report.pictures import torque_charts
from robotid.output.report.plot_sections import (
    drive_figures,
    friction_section,
    information_section,
    residual_section,
)
from robotid.output.report.shown import Shown
from robotid.output.report.steps import Origin
from robotid.output.report.tables import (
    base_table,
    consistency_section,
    input_table,
    open_section,
    parameter_section,
    settings_tables,
    version_table,
)
from robotid.output.report.variation_section import variation_section
from robotid.output.report.why import why_section
from robotid.output.report.worst_second import Residual

_ERRORS = (
    "<p>error = 100 |τ − prediction| / |τ| over the samples used; a prediction of zero has 100 %. "
    "For comparison: the error of unconstrained weighted least squares (WLS), of the "
    "original URDF without drive parameters, of the URDF's links with drive terms fitted to the "
    "same samples, and of the URDF's gravity torque alone.</p>\n"
)
_PARAMETERS = (
    "One of many sets of standard parameters with the same torque: the data determine the base "
    "parameters only, the URDF determines the rest."
)


def shown_torques(found: TorqueIdentification, origin: Origin, replay: str = "") -> Shown:
    """Return the content of a report on an identification."""
    *validation, fitted = recordings = errors_of(found)
    counted = [errors for errors, e in zip(validation, found.validation, strict=True)
               if not e.is_refitted] or [fitted]  # fmt: skip
    entries = [entry for part in parameter_entries(found) for entry in part]
    verdict, worst = found.verdict.to_dict(), [*worst_errors(counted)]
    return Shown(
        title=f"{found.model.name}: identified parameters",
        robot=found.model.name,
        rows=found.model.row_names,
        verdict=verdict,
        findings=found.findings,
        quantity=TORQUE,
        counted=counted,
        recordings=recordings,
        facts=_facts(found),
        steps=next_steps(found, origin),
        made="".join(f"<p>{escape(text)}</p>\n" for text in (_method(found), _totals(found))),
        errors=(_ERRORS, ""),
        curves=("Torques", torques_section(found, worst, origin, replay)),
        friction=friction_section(found, worst),
        bodies=parameter_picture(found) + ellipsoid_pictures(found),
        why=why_section(found),
        variation=variation_section(found.variation, _next_errors(found)),
        parameters=parameter_section(
            found.model,
            found.standard if found.has_urdf else None,
            entries,
            _PARAMETERS,
            found.on_misfit,
        ),
        entries=entries,
        appendix={
            "residuals": ("Residual spectra", residual_section(found)),
            "drives": ("Drive parameters", drive_figures(found)),
            "base": ("Base parameters", base_table(found)),
            "consistency": ("Physical consistency", consistency_section(found)),
            "information": ("Excitation and correlation", information_section(found)),
            "open": ("Parameters not identifiable", open_section(found)),
            "settings": ("Settings", settings_tables(found)),
            "inputs": ("Inputs", input_table(input_entries(found))),
            "versions": ("Versions", version_table(versions())),
        },
    )


def _next_errors(found: TorqueIdentification) -> dict[str, str]:
    """Return the expected RMS torque error of the next log with its unit, by row."""
    if found.variation is None:
        return {}
    rows = zip(found.model.row_names, found.model.row_units, next_errors(found), strict=True)
    return {row: f"{error:.3g} {unit}" for row, unit, error in rows}


def _names(evaluations: Sequence[Evaluation]) -> str:
    return ", ".join(e.name for e in evaluations)


def _facts(found: TorqueIdentification) -> dict[str, str]:
    before, after, _ = found.scale_check.masses
    is_assumed = found.scale_check.assumed > 0
    is_compared = before > 0 and not is_assumed
    change = f" ({100 * (after / before - 1):+.0f} %)".replace("-", "−") if is_compared else ""
    if not found.scale_check.is_total_determined:
        change += ", not determined by torque alone"
    masses = f"{before:.2f}{' assumed' * is_assumed} → {after:.2f}"
    return {
        "Total mass": f"<strong>{masses} kg</strong>{change}",
        "Base parameters determined": (
            f"<strong>{found.determination.rank} of {len(found.base)}</strong>, condition number "
            f"{found.wls.condition:.3g} (regressor, unit columns)"
        ),
    }


def _method(found: TorqueIdentification) -> str:
    """Return a description of the fit and its logs."""
    fitted, validation = found.fitted, found.validation
    samples = sum(e.recording.extent.smooth for e in fitted)
    rows = sum(e.recording.extent.rows_used for e in fitted)
    chains = sorted({_chain(e.recording.signals) for e in (*fitted, *validation)})
    return (
        f"{len(found.base)} base parameters of {len(found.model.joints)} joints were fitted to "
        f"{_names(fitted)} ({samples} samples after filtering, {rows} torque values used) by "
        f"{found.estimator.words} ({found.estimator.name}). "
        + (f"Validation: {_names(validation)}. " if validation else f"{_others(found)}. ")
        + f"Signals: {'; or '.join(chains)}."
    )


def _others(found: TorqueIdentification) -> str:
    """Return that there is no validation log, and the errors of logs left out, as text."""
    lines = left_out_lines([metrics.to_dict() for metrics in found.left_out.values()])
    return "There is no validation log" + "".join(f"; {line}" for line in lines)


def _totals(found: TorqueIdentification) -> str:
    """Return total mass, gravity torque and friction, for comparison with the verdict."""
    scale_check = found.scale_check
    shares = [f"{joint} {100 * share:.0f} %" for joint, share in scale_check.friction.items()]
    before, after, _ = scale_check.masses
    gravity = [f"{joint} {ratio:.2f}" for joint, ratio in scale_check.gravity.items()]
    return (
        f"Total mass {before:.2f} -> {after:.2f} kg. Gravity torque relative to the URDF: "
        f"{listed(gravity)}. Friction relative to the torque: {listed(shares)}."
    )


def _chain(signals: SignalSettings) -> str:
    cutoff = "no filter"
    if signals.cutoff is not None:
        cutoff = (
            f"zero-phase Butterworth low-pass, cut-off {signals.cutoff:g} Hz, order "
            f"{signals.order} run forward and backward"
        )
    rate = f"grid of {signals.rate:.6g} Hz" if signals.rate else "samples as recorded"
    return f"{cutoff}, {rate}, velocity {signals.velocity}"


def torques_section(
    found: TorqueIdentification, worst: Sequence[str], origin: Origin, replay: str = ""
) -> str:
    """Return charts of torques and residuals over time."""
    evaluations, model = found.validation or found.fitted, found.model
    intro = _intro(found, drawn(evaluations, model.row_names))

    def charts(e: Evaluation, row: int, link: str, points: int) -> str:
        return _charts(found, e, found.band(e), row, link=link, points=points)

    def residuals(row: int) -> Iterator[Residual]:
        return _residuals(() if model.is_static else evaluations, row)

    return curves_section(
        found, evaluations, worst, (replay, origin), intro, charts, residuals, TORQUE,
        model.row_units,
    )  # fmt: skip


def _residuals(evaluations: Sequence[Evaluation], row: int) -> Iterator[Residual]:
    """Yield the residuals of a joint, of the samples used."""
    for e in evaluations:
        motion, used = e.recording.trajectory, e.recording.mask[:, row].astype(bool)
        left = np.where(used, motion.tau[:, row] - e.torques["estimate"][:, row], np.nan)
        yield Residual(e.name, Path(e.recording.log.path).name, motion.t, left)


def _intro(found: TorqueIdentification, shown: Sequence[Evaluation]) -> str:
    """Return the description of the charts and their recordings."""
    band = "95 % band" if found.between is not None else "95 % band (for logs of the same day)"
    parts = [
        f"<p>Torque: measured, identified model with its {band}, and URDF; below, the residual "
        "(measured − identified). Shaded: gaps, and samples that are not used because the joint is "
        "at rest and the sign of its friction is unknown. Drag to zoom; double-click or Escape "
        "shows all.</p>\n"
    ]
    if not found.validation:
        parts.append("<p>There is no validation log. The charts show the fitted logs.</p>\n")
    for recording in (evaluation.recording for evaluation in shown):
        if recording.is_partial:
            count, whole = len(recording.trajectory.t), recording.extent.smooth
            parts.append(
                f"<p>{escape(recording.name)} is long: {count} of its {whole} samples are drawn, "
                "from its start, middle and end. Errors are computed from all.</p>\n"
            )
    return "".join(parts)


def _charts(
    found: TorqueIdentification,
    e: Evaluation,
    band: TorqueBand,
    row: int,
    *,
    link: str,
    points: int,
) -> str:
    """Return torque and residual of a joint in a recording."""
    name, unit = found.model.row_names[row], found.model.row_units[row]
    measured, recording = e.metrics["estimate"].per_joint.get(name), e.recording
    words = "no samples used"
    if measured is not None:
        error = percent(measured.relative_error_pct).html
        inside = band.coverage(recording.trajectory.tau, e.torques["estimate"], recording.mask)[row]
        words = (
            f"error {error} %, RMSE {measured.rmse:.3g} {unit}; 95 % band contains "
            f"{100 * inside:.0f} %"
        )
    kind = "not fitted" if found.validation else "fitted"
    torque, residual = torque_charts(found, e, row, band=band, link=link)
    caption = f"{escape(recording.name)}, {kind}: {words}"
    return chart_html(torque, caption, points=points) + chart_html(residual, "", points=points)
