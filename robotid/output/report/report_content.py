"""The content of a report: on an identification from torques, and on one by simulation."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from html import escape
from pathlib import Path
from statistics import geometric_mean
from typing import TYPE_CHECKING

import numpy as np

from robotid.base.files import write_text
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.decisions import LEAST_SHARE
from robotid.diagnosis.residual.torque_split import JointTorque, friction_split
from robotid.diagnosis.verdict.parameter_table import parameter_entries
from robotid.estimation.fitting.evaluation import Evaluation
from robotid.estimation.fitting.fitted import next_errors
from robotid.identification.closed_loop.position_errors import (
    DRIFTS,
    PositionEvaluation,
    pool_positions,
)
from robotid.identification.result import Identification, TorqueIdentification
from robotid.identification.summary import left_out_lines
from robotid.output.files.entries import loop_parameters
from robotid.output.pages.html import (
    Cell,
    Chart,
    Series,
    block,
    cell,
    chart_html,
    code,
    folded,
    listing,
    number,
    paragraphs,
    percent,
    table,
    text,
)
from robotid.output.report import pictures, tables
from robotid.output.report.errors import POSITION, TORQUE, Errors, errors_of, worst_errors
from robotid.output.report.next_steps import Origin
from robotid.output.report.report_page import Report, Residual, curves_section, drawn, page_of

if TYPE_CHECKING:
    from robotid.identification.closed_loop.from_commands import PositionIdentification

_SELECTED = (
    ("joint", "code", "joint"), ("terms", "text", "terms"), ("shape parameters", "text", "shapes"),
)  # fmt: skip


def write_report(
    found: Identification,
    target: str | Path,
    *,
    files: Mapping[str, str] | None = None,
    origin: Origin | None = None,
) -> Path:
    """Write the report of an identification as one HTML file, with links to files by their kind."""
    at, links = origin or Origin(), files or {}
    replay = links.get("replay", "")
    if isinstance(found, TorqueIdentification):
        report = torque_report(found, at, replay)
    else:  # modules of the simulation are imported here
        from robotid.identification.closed_loop.from_commands import PositionIdentification

        assert isinstance(found, PositionIdentification)
        report = position_report(found, at, replay)
    return write_text(page_of(found, report, at, links), target)


def torque_report(found: TorqueIdentification, origin: Origin, replay: str = "") -> Report:
    """Return the content of a report on an identification from torques."""
    *validation, fitted = errors_of(found)
    counted = [errors for errors, e in zip(validation, found.validation, strict=True)
               if not e.is_refitted] or [fitted]  # fmt: skip
    entries = [entry for part in parameter_entries(found) for entry in part]
    worst = next(iter(worst_errors(counted)))
    return Report(
        title=f"{found.model.name}: identified parameters",
        quantity=TORQUE,
        counted=counted,
        facts=_torque_facts(found),
        made=f"<p>{escape(_torque_method(found))}</p>\n",
        errors=(block("report.torque_errors"), ""),
        curves=("Torques", _torques(found, worst, origin, replay)),
        friction=_friction(found),
        bodies=tables.body_table(found),
        why=why_section(found),
        variation=tables.variation_section(found.variation, _next_errors(found)),
        parameters=tables.parameter_section(
            entries, block("report.torque_parameters"), found.on_misfit
        ),
        entries=entries,
        appendix={
            "drives": ("Selected friction terms", _selected_terms(found)),
            "base": ("Base parameters", tables.base_table(found)),
            "consistency": ("Physical consistency", tables.consistency_section(found)),
            "open": ("Parameters not identifiable", tables.open_section(found)),
            **tables.sources_of(found),
        },
    )


def _next_errors(found: TorqueIdentification) -> dict[str, str]:
    if found.variation is None:
        return {}
    rows = zip(found.model.row_names, found.model.row_units, next_errors(found), strict=True)
    return {row: f"{error:.3g} {unit}" for row, unit, error in rows}


def _torque_facts(found: TorqueIdentification) -> dict[str, str]:
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


def _torque_method(found: TorqueIdentification) -> str:
    fitted, validation = found.fitted, found.validation
    samples = sum(e.recording.extent.smooth for e in fitted)
    rows = sum(e.recording.extent.rows_used for e in fitted)
    chains = sorted({_chain(e.recording.signals) for e in (*fitted, *validation)})
    left_out = left_out_lines([metrics.to_dict() for metrics in found.left_out.values()])
    others = "; ".join(["There is no validation log", *left_out])
    if validation:
        others = f"Validation: {listed(e.name for e in validation)}"
    return (
        f"{len(found.base)} base parameters of {len(found.model.joints)} joints were fitted to "
        f"{listed(e.name for e in fitted)} ({samples} samples after filtering, {rows} torque "
        f"values used) by {found.estimator.words} ({found.estimator.name}). {others}. Signals: "
        f"{'; or '.join(chains)}."
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


def _torques(found: TorqueIdentification, worst: str, origin: Origin, replay: str) -> str:
    evaluations, model = found.validation or found.fitted, found.model
    intro = _intro(found, drawn(evaluations, model.row_names))
    return curves_section(
        found, evaluations, worst, (replay, origin), intro, partial(_torque_charts, found),
        partial(_residuals, () if model.is_static else evaluations), TORQUE, model.row_units,
    )  # fmt: skip


def _residuals(evaluations: Sequence[Evaluation], row: int) -> Iterator[Residual]:
    for e in evaluations:
        motion, used = e.recording.trajectory, e.recording.mask[:, row].astype(bool)
        left = np.where(used, motion.tau[:, row] - e.torques["estimate"][:, row], np.nan)
        yield Residual(e.name, Path(e.recording.log.path).name, motion.t, left)


def _intro(found: TorqueIdentification, shown: Sequence[Evaluation]) -> str:
    band = "95 % band" if found.between is not None else "95 % band (for logs of the same day)"
    html = block("report.torques", band=band)
    html += "" if found.validation else block("report.no_validation")
    for recording in (evaluation.recording for evaluation in shown):
        if recording.is_partial:
            count, samples = len(recording.trajectory.t), recording.extent.smooth
            html += block("report.long", name=escape(recording.name), count=count, all=samples)
    return html


def _torque_charts(
    found: TorqueIdentification, e: Evaluation, row: int, link: str, points: int
) -> str:
    band = found.band(e)
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
    torque, residual = pictures.torque_charts(found, e, row, band=band, link=link)
    caption = f"{escape(recording.name)}, {kind}: {words}"
    return chart_html(torque, caption, points=points) + chart_html(residual, "", points=points)


def _friction(found: TorqueIdentification) -> str:
    model, layout = found.model, found.model.layout
    if model.is_static or all(term.is_inertia for _, term in layout.drive_parameters):
        return ""
    split = friction_split(model, pictures.shown_evaluation(found), found.standard)
    figures = ""
    for joint in model.row_names:
        chart = pictures.friction_chart(found, joint, split=split)
        if chart is None:
            is_driven = joint in model.joints and joint not in model.passive
            why = "no samples used" if is_driven else "no drive"
            figures += f"<p>{escape(joint)}: {why}.</p>\n"
        else:
            figures += chart_html(chart, f"<strong>{escape(joint)}</strong>")
    name = escape(pictures.shown_evaluation(found).name)
    return block("report.friction", log=name, figures=figures)


def _selected_terms(found: TorqueIdentification) -> str:
    """Return the friction terms selected for each joint, with their shape parameters."""
    rows = []
    for drive in found.drives:
        shapes = [
            f"{shape.name} = {shape.value:.3g} ± {shape.std_error:.2g} {shape.unit}"
            + (" (at its bound)" if shape.is_at_bound else "")
            for shape in drive.shapes
        ]
        terms = " + ".join(drive.families) or "none"
        rows.append({"joint": drive.joint, "terms": terms, "shapes": ", ".join(shapes)})
    selected = listing("Friction terms in addition to viscous and Coulomb", _SELECTED, rows)
    return block("report.terms") + selected if rows else ""


def why_section(found: TorqueIdentification) -> str:
    """Return the residual analysis: a part for each joint, the worst joint first and open."""
    torques = sorted(found.joint_torques, key=_relative_residual, reverse=True)
    logs = torques[0].rows.recordings
    kind = "Validation logs" if torques[0].fitted is not None else "Fitted logs, without validation"
    names = [e.name for e in found.validation or found.fitted]
    link = f"recording {names.index(logs[0])}" if logs[0] in names else "fitted"  # as the torques
    joints = "".join(
        folded(
            f"why-{found.model.row_names.index(torque.joint)}",
            f"<strong>{code(torque.joint).html}</strong>: {escape(torque.sentence)}",
            _joint(torque, link),
            is_open=k == 0,
        )
        for k, torque in enumerate(torques)
    )
    return block("report.why", kind=kind, logs=escape(", ".join(logs)), joints=joints)


def _relative_residual(torque: JointTorque) -> float:
    """Return the RMS residual over the RMS torque; -1 if there is no torque."""
    rms = torque.rms
    return rms["residual"] / rms["measured"] if rms["measured"] > 0 else -1.0


def _joint(torque: JointTorque, link: str) -> str:
    if not torque.used.any():
        return ""

    def drawn_chart(chart: Chart, caption: str) -> str:
        return chart_html(chart, caption, points=2 * len(chart.x))

    charts = pictures.why_charts(torque, link=link)
    caption = "Torque components, stacked; shaded: samples not used"
    split = drawn_chart(charts.pop("split"), caption)
    small = "".join(drawn_chart(chart, _caption(torque, name)) for name, chart in charts.items())
    return f'{_parts(torque)}{split}<div class="plots">\n{small}</div>\n'


def _caption(torque: JointTorque, name: str) -> str:
    (dependence,) = (d for d in torque.follows if d.name == name)
    share = percent(100 * (dependence.share or 0.0)).html
    result = "no dependence"
    if dependence.share is None:
        result = "too few samples"
    elif dependence.is_significant:
        result = f"<strong>explains {share} % of the variance</strong>"
    elif dependence.share >= LEAST_SHARE:
        result = f"explains {share} % of the variance, not significant"
    return f"Residual against {name}: {result}"


def _parts(torque: JointTorque) -> str:
    rms, rows = torque.rms, []
    for name in (*sorted(torque.present, key=lambda name: -rms[name]), "residual", "measured"):
        sizes = {term: torque.size(x) for term, x in torque.terms.get(name, {}).items()}
        terms = [f"{term.removeprefix(f'{torque.joint}.')} {x:.3g}" for term, x in sizes.items()]
        share = 100 * rms[name] / rms["measured"] if rms["measured"] else None
        details = Cell(escape(", ".join(terms)) if len(terms) > 1 else "")
        rows.append([cell(name, "text"), cell(rms[name], ".3g"), percent(share), details])
    headers = ["component", f"RMS {torque.unit}", "% of torque", "terms, RMS"]
    return table(f"{torque.joint}: torque components, which may cancel", headers, rows)


# ---- results that predict positions --------------------------------------------------------


def position_report(found: "PositionIdentification", origin: Origin, replay: str = "") -> Report:
    """Return the content of a report on an identification that predicts positions."""
    is_driven, validation = found.loop.kind == "torque", found.validation
    runs = validation or found.fitted
    together = runs[0].name if len(runs) == 1 else f"{len(runs)} logs together"
    moving = pool_positions(runs, moving=True).to_dict()["per_joint"]
    counted = [Errors(together, moving, is_fitted=not validation)]
    entries = [x for part in parameter_entries(found) for x in part] + loop_parameters(found)
    source, kind = ("torque-driven simulation", "driven") if is_driven else ("commands", "position")
    worst = next(iter(worst_errors(counted)))
    return Report(
        title=f"{found.model.name}: drives from {source}",
        quantity=POSITION,
        counted=counted,
        facts=_position_facts(found),
        made=f"<p>{escape(_position_method(found))}</p>\n",
        errors=(block(f"report.{kind}_errors", drift=f"{DRIFTS:g}"), _horizons(runs)),
        curves=("Positions", _positions(found, worst, kind, origin, replay)),
        parameters=tables.parameter_section(entries, block(f"report.{kind}_parameters")),
        entries=entries,
        variation=tables.variation_section(found.variation, {}),
        appendix={
            "open": ("Parameters not identifiable", _open_section(found)),
            **tables.sources_of(found),
        },
    )


def _unit(run: PositionEvaluation) -> str:
    """Return the unit of the errors, "mrad or mm" if some joints are prismatic."""
    return " or ".join(f"{POSITION.prefix}{unit}" for unit in dict.fromkeys(run.units))


def _mean(errors: Array | None) -> float | None:
    """Return the geometric mean of the joints' errors; None if there is none."""
    return None if errors is None or not (errors > 0).all() else geometric_mean(errors)


def _position_facts(found: "PositionIdentification") -> dict[str, str]:
    run = (found.validation or found.fitted)[0]
    kind, ours = "not fitted" if found.validation else "fitted", _mean(run.rmse)
    over = f" over {DRIFTS:g} s" if run.is_driven else ""
    error = number(None if ours is None else ours / POSITION.scale, ".3g").html
    return {
        f"Simulated position error{over}, {kind}": f"<strong>{error} {_unit(run)}</strong>, "
        f"geometric mean of {len(run.rmse)} joint{'s' * (len(run.rmse) > 1)}"
    }


def _position_method(found: "PositionIdentification") -> str:
    fitted, validation = ([e.name for e in part] for part in (found.fitted, found.validation))
    return (
        f"{len(found.estimate.theta)} parameters of {len(found.model.joints)} joints were fitted "
        f"to {listed(fitted)} by {found.estimator.name}. "
        + (f"Validation: {listed(validation)}." if validation else "There is no validation log.")
    )


def _horizons(runs: Sequence[PositionEvaluation]) -> str:
    """Return errors over the horizon of the simulation: tables."""
    joints, parts = runs[0].log.joints, list[str]()
    for run in runs:
        whole = {} if run.is_driven else {run.extent.end - run.extent.start: run.rmse}
        errors = {h: x / POSITION.scale for h, x in sorted((dict(run.horizons) | whole).items())}
        rows = [
            [code(joint), *(number(float(x[j]), "#.3g") for x in errors.values())]
            for j, joint in enumerate(joints)
        ]
        foot = [text("geometric mean"), *(number(_mean(x), "#.3g") for x in errors.values())]
        caption = f"{run.name}: error over the horizon, {_unit(run)}"
        heads = ["joint", *(f"{h:.4g} s" for h in errors)]
        parts.append(table(caption, heads, rows, foot, is_data=True))
    return "".join(parts)


def _positions(
    found: "PositionIdentification", worst: str, kind: str, origin: Origin, replay: str
) -> str:
    intro = block(f"report.{kind}s", drift=f"{DRIFTS:g}")
    runs, judged = (*found.validation, *found.fitted), found.validation or found.fitted
    return curves_section(
        found, runs, worst, (replay, origin), intro, partial(_position_charts, found),
        partial(_position_errors, judged), POSITION, runs[0].units,
    )  # fmt: skip


def _position_errors(runs: Sequence[PositionEvaluation], row: int) -> Iterator[Residual]:
    for e in runs:
        yield Residual(e.name, e.log.name, e.log.t, (e.log.q - e.q)[:, row])


def _position_charts(
    found: "PositionIdentification", run: PositionEvaluation, j: int, link: str, points: int
) -> str:
    kind = "not fitted" if run in found.validation else "fitted"
    log, joint, unit = run.log, run.log.joints[j], run.units[j]
    q, q_sim = log.q[:, j], run.q[:, j]
    positions = [Series("measured", q, "text"), Series("simulated", q_sim, "predicted")]
    left = [Series("measured − simulated", (q - q_sim) / POSITION.scale, "residual")]
    if log.q_ref is not None and not run.is_driven:
        positions.insert(0, Series("commanded", log.q_ref[:, j], "tone-5"))
        far = (q - log.q_ref[:, j]) / POSITION.scale
        left.insert(0, Series("measured − commanded", far, "tone-5", is_hidden=True))
    above = Chart(
        f"position of {joint}", log.t, tuple(positions), "time [s]", f"position [{unit}]", link=link
    )
    below = Chart(
        f"position error of {joint}", log.t, tuple(left), "time [s]", f"error [m{unit}]",
        link=link, height=110,
    )  # fmt: skip
    caption = f"{escape(run.name)}, {kind}: RMSE {run.rmse[j] / POSITION.scale:.3g} m{unit}"
    return chart_html(above, caption, points=points) + chart_html(below, "", points=points)


def _open_section(found: "PositionIdentification") -> str:
    words = ["The logs determine all free parameters."]
    if found.undetermined:
        words = [f"The logs do not determine {listed(found.undetermined)}."]
    words += [f"Indistinguishable: {listed(names)}." for names in found.correlated]
    if found.is_scaled_by_gain:
        words.append(
            "Positions and commands determine torques up to a common factor: gains, inertias, "
            "friction and masses multiplied by this factor cause the same motion. Stated "
            "parameters and the masses of the URDF determine the factor."
        )
    return paragraphs(words)
