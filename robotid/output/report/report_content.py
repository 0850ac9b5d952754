"""The content of a report: on an identification from torques, and on one by simulation."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path
from statistics import geometric_mean
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast
from urllib.parse import quote, urlencode

import numpy as np

from robotid.base.files import write_text
from robotid.base.findings import Cause, grouped, listed, tally
from robotid.base.typing import Array
from robotid.base.versions import __version__
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.decisions import LEAST_SHARE
from robotid.diagnosis.residual.joint_torques import JointTorque
from robotid.diagnosis.verdict.verdict import uses_line
from robotid.dynamics.torque_split import friction_split
from robotid.estimation.fitting.evaluation import Evaluated, Evaluation
from robotid.estimation.fitting.fitted import next_errors
from robotid.identification.closed_loop.position_errors import (
    DRIFTS,
    PositionEvaluation,
    pool_positions,
)
from robotid.identification.parameter_table import parameter_entries
from robotid.identification.result import Identification, TorqueIdentification
from robotid.identification.summary import left_out_lines
from robotid.output.files.entries import loop_parameters
from robotid.output.pages.html import (
    POINTS,
    Cell,
    Chart,
    Section,
    Series,
    block,
    cell,
    chart_html,
    code,
    command_html,
    facts_html,
    folded,
    listing,
    number,
    page,
    paragraphs,
    percent,
    table,
    text,
    verdict_html,
)
from robotid.output.report import pictures, tables
from robotid.output.report.next_steps import Origin, Step, next_steps
from robotid.output.report.tables import POSITION, TORQUE, Errors, Quantity, errors_of, worst_errors

if TYPE_CHECKING:
    from robotid.identification.closed_loop.from_commands import PositionIdentification

_ROWS = 24_000  # of all charts over time: about half a MB
_WINDOW = 1.0  # [s]
_USED = 0.5  # smallest share of a window's samples that are used
_FEWEST = 140  # rows of one chart; recordings that would leave fewer are not drawn

EvaluatedT = TypeVar("EvaluatedT", bound=Evaluated)


@dataclass(frozen=True)
class Report:
    """What a report shows of torques or of positions. Texts are HTML."""

    title: str  # title of the page, not escaped
    quantity: Quantity  # the predicted quantity
    counted: Sequence[Errors]  # the recordings whose errors the verdict uses
    facts: Mapping[str, str]  # figures by their names
    made: str  # description of the identification
    errors: tuple[str, str]  # definition of the errors, and content after their tables
    curves: tuple[str, str]  # title and content of the section of charts over time
    parameters: str  # content of the section of parameters
    entries: Sequence[Mapping[str, Any]]  # the parameters, as in result.json
    # title and content of the parts of the appendix, by their keys
    appendix: Mapping[str, tuple[str, str]]
    variation: str  # variation of drive parameters between logs; "" for fewer than three logs
    why: str = ""  # residual analysis of each joint; "" if there is none
    friction: str = ""  # friction against speed; "" if there is none
    bodies: str = ""  # links, URDF and identified; "" if there are none


def page_of(found: Identification, report: Report, origin: Origin, files: Mapping[str, str]) -> str:
    """Return the HTML of the report."""
    rows, verdicts = found.model.row_names, found.verdict.to_dict()["per_joint"]
    definition, after = report.errors
    *validation, fitted = errors_of(found)
    of_fitted = {} if validation else verdicts  # a verdict is on the validation logs, if any
    shown = "".join(tables.error_table(report.quantity, x, rows, verdicts) for x in validation)
    shown += tables.error_table(report.quantity, fitted, rows, of_fitted)
    count = sum(entry["source"] in ("data", "mixed") for entry in report.entries)
    determined = f"{count} of {len(report.entries)} determined by the data, fully or partly"
    parts = report.appendix.items()
    appendix = "".join(folded(key, title, html) for key, (title, html) in parts if html)
    causes = grouped(found.findings, rows)
    findings = "".join(map(_cause, causes)) or "<p>None.</p>\n"
    worst = escape(next(iter(worst_errors(report.counted)), ""))
    sections = {
        "errors": Section(
            "Errors", f"{definition}{shown}{after}", f"{len(verdicts)} joints, by recording", False
        ),
        "findings": Section("Findings", findings, tally(causes, worst) or "none", False),
        "friction": Section("Friction against speed", report.friction, "of each joint", False),
        "curves": Section(*report.curves),
        "why": Section("Residual analysis", report.why, "torque components of each joint", False),
        "variation": Section("Variation between logs", report.variation, "", False),
        "bodies": Section("Links", report.bodies),
        "parameters": Section("Parameters", report.parameters, determined, False),
        "appendix": Section("Appendix", appendix),
    }
    written = block("report.written", version=__version__)
    made = folded("made", "Method and data", f"{report.made}{written}")
    known = {key: section for key, section in sections.items() if section.html}
    return page(report.title, first_screen(found, report, origin, files) + made, known)


def first_screen(
    found: Identification, report: Report, origin: Origin, files: Mapping[str, str]
) -> str:
    """Return the HTML of the first screen: verdict, figures, errors of joints, next steps."""
    verdict = found.verdict.to_dict()
    uses = uses_line(verdict.get("use_for", {}))
    uses = f"{uses[:1].upper()}{uses[1:]}." if uses else ""
    bars = tables.error_bars(
        report.quantity, report.counted, found.model.row_names, verdict["per_joint"],
        has_why=bool(report.why),
    )  # fmt: skip
    return block(
        "report.first",
        verdict=verdict_html(found.model.name, verdict["status"], verdict["reasons"], uses),
        facts=facts_html({**report.facts, **tables.sources_fact(report.entries)}, files),
        bars=bars,
        steps=_steps(next_steps(found, origin)),
    )


def _steps(steps: Sequence[Step]) -> str:
    items = "".join(
        f"<li><p>{escape(step.words)}</p>"
        + "".join(f'<div class="copy">{command_html(text)}</div>' for text in step.blocks)
        + "</li>\n"
        for step in steps
    )
    return f'<h2 id="next">Do next</h2>\n<ol class="next">{items}</ol>\n' if items else ""


def _cause(cause: Cause) -> str:
    findings = ""
    if len(cause.findings) > len(cause.messages):
        items = "".join(f"<li>{escape(finding.message)}</li>" for finding in cause.findings)
        title = f"<summary>all {len(cause.findings)} findings</summary>"
        findings = f"<details>{title}<ul>{items}</ul></details>\n"
    return block(
        "report.cause",
        severity=cause.severity,
        code=code(cause.code).html,
        about=f": {escape(', '.join(cause.joints))}" if cause.joints else "",
        messages="".join(f"<p>{escape(message)}</p>\n" for message in cause.messages),
        findings=findings,
    )


# ---- the replay in the report ---------------------------------------------------------------
#
# A frame at the lower edge of the window, on the clock of the charts, is loaded when it is asked
# for. Its file may be written after the report: dock.js finds out whether it is there. A link leads
# to the second with the largest residual.


class Clip(NamedTuple):
    """A recording with charts: the name that links them, its file or "", first and last time."""

    link: str
    log: str
    start: float
    end: float


@dataclass(frozen=True)
class Dock:
    """The replay of a report."""

    replay: str  # file of the replay in the report's folder; "" if it is not written yet
    origin: Origin  # folder of the results, for the command that writes the replay
    urdf: str
    clips: Sequence[Clip]  # the recordings with charts

    @property
    def file(self) -> str:
        """File of the replay, written or not; "" if there cannot be one."""
        has_command = any(map(self._command, self.clips))
        return self.replay or (self.origin.replay if has_command else "")

    def _command(self, clip: Clip) -> str:
        words = self.origin.using("replay", self.urdf, clip.log, self.origin.folder)
        return "".join(map(command_html, words)) if clip.log else ""

    def link(self, words: str, start: float, joint: str, log: str) -> str:
        """Return the HTML of a link to a time of the replay; "" without replay."""
        if not self.file:
            return ""
        there = urlencode({"t": f"{start:.3f}", "joint": joint, "log": log}, quote_via=quote)
        to = f"{quote(self.replay)}#{there}" if self.replay else "#replay"
        return (
            f'<a href="{escape(to)}" target="{"replay" if self.replay else "_self"}" '
            f'data-at="{escape(there)}">{words}</a>'
        )

    @property
    def html(self) -> str:
        """The button that shows the replay, or the command that writes it; "" without replay."""
        if not self.file:
            return ""
        clips = [
            clip._asdict() | {"log": Path(clip.log).name, "command": self._command(clip)}
            for clip in self.clips
        ]
        kind = "written" if self.replay else "unwritten"
        command = "" if self.replay else next(filter(None, map(self._command, self.clips)))
        file, packed = escape(quote(self.file)), escape(json.dumps(clips))
        return block(f"report.{kind}_dock", file=file, clips=packed, command=command)


class Residual(NamedTuple):
    """The residual of a joint in a recording."""

    name: str  # name of the recording
    file: str  # name of its file, which the replay states
    t: Array  # times, shape (N,), increasing [s]
    values: Array  # residuals, shape (N,), NaN for samples that are not used


@dataclass(frozen=True)
class WorstSecond:
    """The window of 1 s with the largest RMS residual, and its ratio to the RMS of the log."""

    of: Residual
    start: float
    end: float
    rms: float
    ratio: float


def worst_second(residuals: Iterable[Residual]) -> WorstSecond | None:
    """Return the window of 1 s with the largest RMS residual of a joint in its recordings.

    Windows of which less than half is used are ignored. A shorter recording is one window.
    """
    windows = [worst for residual in residuals if (worst := _worst(residual)) is not None]
    return max(windows, key=lambda worst: worst.rms, default=None)


def _worst(of: Residual) -> WorstSecond | None:
    t, used = of.t, np.isfinite(of.values)
    if len(t) < 2 or not used.any():
        return None
    squares = np.append(0.0, np.cumsum(np.where(used, of.values, 0.0) ** 2))
    counts = np.append(0, np.cumsum(used))
    step = float(np.median(np.diff(t)))
    first = np.arange(max(1, int(np.searchsorted(t, t[-1] - _WINDOW + 1.5 * step, side="right"))))
    last = np.searchsorted(t, t[first] + _WINDOW - step / 2)  # exclusive
    count = counts[last] - counts[first]
    enough = count >= _USED * min(_WINDOW / step, len(t))
    if not enough.any():
        return None
    mean = np.where(enough, (squares[last] - squares[first]) / np.maximum(count, 1), -1.0)
    k = int(mean.argmax())
    end = min(float(t[k]) + _WINDOW, float(t[-1]))
    ratio = (mean[k] / (squares[-1] / counts[-1] or 1.0)) ** 0.5
    return WorstSecond(of, float(t[k]), end, float(mean[k] ** 0.5), float(ratio))


def worst_html(
    worst: WorstSecond | None, joint: str, unit: str, dock: Dock, scale: float = 1.0
) -> str:
    """Return a paragraph on the worst second of a joint; nothing without one."""
    if worst is None:
        return ""
    return block(
        "report.worst", name=escape(worst.of.name), start=f"{worst.start:.2f}", unit=unit,
        end=f"{worst.end:.2f}", rms=f"{worst.rms / scale:.3g}", ratio=f"{worst.ratio:.2g}",
        link=dock.link("Show this second in the replay", worst.start, joint, worst.of.file),
    )  # fmt: skip


# ---- charts over time --------------------------------------------------------------------


def drawn(runs: Sequence[EvaluatedT], rows: Sequence[str]) -> Sequence[EvaluatedT]:
    """Return the recordings that are drawn: the first ones, to limit the page's size."""
    return runs[: max(1, _ROWS // (2 * len(rows) * _FEWEST))]


def curves_section(
    found: Identification,
    evaluations: Sequence[EvaluatedT],
    worst: str,
    dock: tuple[str, Origin],
    intro: str,
    charts: Callable[[EvaluatedT, int, str, int], str],
    residuals: Callable[[int], Iterable[Residual]],
    quantity: Quantity,
    units: Sequence[str],
) -> str:
    """Return a part for each joint, the worst one open; the file of the replay and the source."""
    rows, verdicts = found.model.row_names, found.verdict.to_dict()["per_joint"]
    shown = drawn(evaluations, rows)
    runs = {f"recording {k}": e for k, e in enumerate(shown)}
    clips = [Clip(link, str(e.log.path), e.extent.start, e.extent.end) for link, e in runs.items()]
    player = Dock(*dock, str(found.model.tree.path), clips)
    points = min(POINTS, max(_FEWEST, _ROWS // (2 * len(rows) * max(1, len(runs)))))
    parts = [player.html, intro]
    if left := [e.name for e in evaluations[len(shown) :]]:
        parts.append(block("report.not_drawn", names=escape(", ".join(left))))
    for row, name in enumerate(rows):
        status = verdicts[name]["status"] if name in verdicts else ""
        unit = f"{quantity.prefix}{units[row]}"
        note = worst_html(worst_second(residuals(row)), name, unit, player, quantity.scale)
        html = note + "".join(charts(e, row, link, points) for link, e in runs.items())
        summary = f"<strong>{code(name).html}</strong> {escape(status)}"
        parts.append(folded(f"joint-{row}", summary, html, is_open=name == worst))
    return "".join(parts)


_SELECTED = (
    ("joint", "code", "joint"), ("terms", "text", "terms"), ("shape parameters", "text", "shapes"),
)  # fmt: skip


def write_report(found: Identification, target: str | Path, **options: Any) -> Path:  # noqa: ANN401
    """Write the report of an identification as one HTML file."""
    return write_text(report_html(found, **options), target)


def report_html(
    found: Identification, files: Mapping[str, str] | None = None, origin: Origin | None = None
) -> str:
    """Return the HTML of the report of an identification, with links to files by their kind."""
    at, links = origin or Origin(), files or {}
    replay = links.get("replay", "")
    if isinstance(found, TorqueIdentification):
        report = torque_report(found, at, replay)
    else:
        report = position_report(cast("PositionIdentification", found), at, replay)
    return page_of(found, report, at, links)


def torque_report(found: TorqueIdentification, origin: Origin, replay: str = "") -> Report:
    """Return the content of a report on an identification from torques."""
    *validation, fitted = errors_of(found)
    counted = [errors for errors, e in zip(validation, found.validation, strict=True)
               if not e.is_refitted] or [fitted]  # fmt: skip
    entries = [entry for part in parameter_entries(found) for entry in part]
    worst, words = next(iter(worst_errors(counted))), block("report.torque_parameters")
    return Report(
        title=f"{found.model.name}: identified parameters", quantity=TORQUE, counted=counted,
        entries=entries, friction=_friction(found), bodies=tables.body_table(found),
        facts=_torque_facts(found), why=why_section(found),
        made=f"<p>{escape(_torque_method(found))}</p>\n",
        errors=(block("report.torque_errors"), ""),
        curves=("Torques", _torques(found, worst, origin, replay)),
        variation=tables.variation_section(found.variation, _next_errors(found)),
        parameters=tables.parameter_section(entries, words, found.on_misfit),
        appendix={
            "drives": ("Selected friction terms", _selected_terms(found)),
            "base": ("Base parameters", tables.base_table(found)),
            "consistency": ("Physical consistency", tables.consistency_section(found)),
            "open": ("Parameters not identifiable", tables.open_section(found)),
            **tables.sources_of(found),
        },
    )  # fmt: skip


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
    chains = _chains(e.recording.signals for e in (*fitted, *validation))
    left_out = left_out_lines([metrics.to_dict() for metrics in found.left_out.values()])
    others = "; ".join(["There is no validation log", *left_out])
    if validation:
        others = f"Validation: {listed(e.name for e in validation)}"
    return (
        f"{len(found.base)} base parameters of {len(found.model.joints)} joints were fitted to "
        f"{listed(e.name for e in fitted)} ({samples} samples after filtering, {rows} torque "
        f"values used) by {found.estimator.words} ({found.estimator.name}). {others}. Signals: "
        f"{chains}."
    )


def _chains(settings: Iterable[SignalSettings]) -> str:
    rates = dict[str, dict[str, None]]()  # by the other settings, which most logs share
    for x in settings:
        order = f"order {x.order} run forward and backward"
        low_pass = f"zero-phase Butterworth low-pass, cut-off {x.cutoff or 0:g} Hz, {order}"
        rate = f"grid of {round(x.rate, 1):g} Hz" if x.rate else "samples as recorded"
        chain = f"{low_pass if x.cutoff else 'no filter'}, velocity {x.velocity}"
        rates.setdefault(chain, {})[rate] = None
    return "; or ".join(f"{chain}, {' or '.join(same)}" for chain, same in rates.items())


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
    motion = pictures.shown_evaluation(found).recording.trajectory
    split = friction_split(model, motion, found.standard)
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
    torques = sorted(
        found.joint_torques, key=lambda x: -x.rms["residual"] / (x.rms["measured"] or np.inf)
    )
    logs = torques[0].rows.recordings
    is_validation = any(not e.is_refitted for e in found.validation)
    kind = "Validation logs" if is_validation else "Fitted logs, without validation"
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
    headers = ["component", f"RMS [{torque.unit}]", "% of torque", "terms, RMS"]
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
        title=f"{found.model.name}: drives from {source}", quantity=POSITION, counted=counted,
        entries=entries, facts=_position_facts(found),
        made=f"<p>{escape(_position_method(found))}</p>\n",
        errors=(block(f"report.{kind}_errors", drift=f"{DRIFTS:g}"), _horizons(runs)),
        curves=("Positions", _positions(found, worst, kind, origin, replay)),
        parameters=tables.parameter_section(entries, block(f"report.{kind}_parameters")),
        variation=tables.variation_section(found.variation, {}),
        appendix={
            "open": ("Parameters not identifiable", _open_section(found)),
            **tables.sources_of(found),
        },
    )  # fmt: skip


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
