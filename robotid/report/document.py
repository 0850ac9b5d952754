"""The report: one HTML file that reads without a network, on a screen, a phone or paper."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from html import escape
from pathlib import Path

from robotid._files import write_text
from robotid._settings import require_each, require_kind
from robotid.closed_loop.result import LoopIdentification
from robotid.export.entries import build_result
from robotid.findings import listed
from robotid.fitting.evaluation import Evaluation
from robotid.fitting.metrics import JointMetrics, Metrics
from robotid.identification.result import Identification
from robotid.identification.summary import verdict_cell
from robotid.logs.settings import SignalSettings
from robotid.pages.html import (
    Section,
    code,
    folded,
    number,
    page,
    percent,
    table,
    text,
)
from robotid.report.advice import Origin
from robotid.report.causes import findings_line, findings_section
from robotid.report.diagnosis import (
    body_figures,
    drive_figures,
    information_section,
    residual_section,
)
from robotid.report.loop_page import write_loop_report
from robotid.report.summary_screen import joint_errors, summary_screen
from robotid.report.tables import tables
from robotid.report.torques import torques_section
from robotid.report.why import why_section
from robotid.versions import __version__

__all__ = ["write_report"]


def write_report(
    identification: Identification | LoopIdentification,
    target: str | Path,
    *,
    files: Mapping[str, str] | None = None,
    origin: Origin | None = None,
) -> Path:
    """Write what an identification found, and how far to trust it, as one HTML file.

    The file fetches nothing. It is made beside its target and then put in place.

    Args:
        identification: What was found.
        target: The file to write.
        files: Files beside it to link to, by what they are, as "URDF".
        origin: How it was identified and where its results are, for the commands that it shows;
            none are shown that need what is not said.

    Returns:
        Path of the file.

    Raises:
        DataError: If the folder of the target does not exist.
    """
    kinds = (Identification, LoopIdentification)
    require_kind(identification, kinds, "identification", "a robotid.Identification")
    require_kind(target, (str, Path), "target", "the path of a page to write")
    require_kind(files, (Mapping, type(None)), "files", "a table of file names")
    for what, name in (files or {}).items():
        require_each([what, name], str, "an entry of files", "text, and the name of a file")
    require_kind(origin, (Origin, type(None)), "origin", "an Origin")
    if isinstance(identification, LoopIdentification):
        content = build_result(identification, {})
        runs = identification.fitted, identification.validation
        return write_loop_report(content, *runs, target, files=files, origin=origin)
    found, made = identification, tables(identification)
    header = summary_screen(found, origin or Origin(), files or {}) + _made(found)
    joints = len(found.verdict.joints)
    worst = list(joint_errors(found))
    counts = [found.sources.count(source) for source in ("data", "mixed")]
    sections = {
        "errors": Section("Errors", _errors(found), f"{joints} joints, by recording", False),
        "findings": Section(
            "Findings",
            findings_section(found.findings, found.model.joints, worst),
            findings_line(found.findings, found.model.joints, next(iter(worst), "")),
            False,
        ),
        "torques": Section("Torques", torques_section(found)),
        "why": Section("Why each joint", why_section(found), "what its torque is made of", False),
        "parameters": Section(
            "Parameters",
            made["parameters"] + folded("changes", "Changes of the URDF", made["changes"]),
            f"{sum(counts)} of {len(found.sources)} determined by motion, in part or whole",
            False,
        ),
        "appendix": Section("Appendix", _appendix(found, made)),
    }
    title = f"{found.model.name}: identified parameters"
    return write_text(page(title, header, sections), target)


def _appendix(found: Identification, made: Mapping[str, str]) -> str:
    parts = {
        "residuals": ("What the residuals hold", residual_section(found)),
        "drives": ("Friction and drives", drive_figures(found)),
        "bodies": ("Bodies beside the URDF's", body_figures(found)),
        "base": ("Base parameters", made["base"]),
        "consistency": ("Physical consistency", made["consistency"]),
        "information": ("Excitation and correlation", information_section(found)),
        "open": ("What the data do not determine", made["open"]),
        "settings": ("Settings", made["settings"]),
        "inputs": ("Inputs", made["inputs"]),
        "versions": ("Versions", made["versions"]),
    }
    return "".join(folded(key, title, html) for key, (title, html) in parts.items() if html)


def _made(found: Identification) -> str:
    """Return what was fitted to what, and figures beside which a verdict is read."""
    fitted, kept = found.fitted, found.validation
    samples = sum(e.recording.extent.smooth for e in fitted)
    rows = sum(e.recording.extent.rows_used for e in fitted)
    chains = sorted({_chain(e.recording.signals) for e in (*fitted, *kept)})
    said = (
        f"{len(found.base)} base parameters of {len(found.model.joints)} joints were fitted to "
        f"{_names(fitted)} ({samples} samples after filtering, {rows} torque rows used) by "
        f"{found.estimator.words} ({found.estimator.name}). "
        + (f"Kept apart for validation: {_names(kept)}. " if kept else "No log was kept apart. ")
        + f"Signals: {'; or '.join(chains)}."
    )
    units = (
        f"Written by robotid {__version__}. SI units throughout; inertial parameters in "
        "Pinocchio's order, inertias about the joint frame."
    )
    words = "".join(f"<p>{escape(text)}</p>\n" for text in (said, _beside(found)))
    return folded("made", "How it was made", f'{words}<p class="note">{units}</p>\n')


def _beside(found: Identification) -> str:
    """Return masses, gravity and friction in a sentence, beside which a verdict is read."""
    witness = found.witness
    shares = [f"{joint} {100 * share:.0f} %" for joint, share in witness.friction.items()]
    before, after, _ = witness.masses
    gravity = [f"{joint} {ratio:.2f}" for joint, ratio in witness.gravity.items()]
    return (
        f"Total mass {before:.2f} -> {after:.2f} kg. Gravity torque over the URDF's: "
        f"{listed(gravity)}. Friction as a share of the torque: {listed(shares)}."
    )


def _chain(signals: SignalSettings) -> str:
    cutoff = "no filter"
    if signals.cutoff is not None:
        cutoff = (
            f"zero-phase Butterworth low-pass, cut-off {signals.cutoff:g} Hz, order "
            f"{signals.order} run forward and backward"
        )
    rate = f"grid of {signals.rate:.6g} Hz" if signals.rate else "rows as they were recorded"
    return f"{cutoff}, {rate}, velocity {signals.velocity}"


def _names(evaluations: Sequence[Evaluation]) -> str:
    return ", ".join(e.recording.name for e in evaluations)


def _errors(found: Identification) -> str:
    parts = [
        _error_table(
            f"{e.recording.name}: not fitted", found, e.metrics["estimate"], e.metrics["wls"]
        )
        for e in found.validation
    ]
    count = len(found.fitted)
    fitted = "All fitted rows together" if count > 1 else f"{_names(found.fitted)}: fitted"
    parts.append(_error_table(fitted, found, found.metrics(), found.metrics("wls")))
    return (
        "<p>error = 100 |τ − prediction| / |τ| over the rows used. For comparison, the error of "
        "unconstrained weighted least squares (WLS) on the same rows, of the URDF as shipped "
        "without drive parameters, of the URDF's bodies with drive terms fitted to the same rows, "
        "and of the URDF's gravity torque alone; predicting zero scores 100.</p>\n" + "".join(parts)
    )


def _error_table(caption: str, found: Identification, ours: Metrics, wls: Metrics) -> str:
    headers = ["joint", "error %", "verdict", "RMSE", "unit", "R²", "rows", "WLS %", "URDF %"]
    headers += ["URDF + drives %", "gravity only %"]
    rows, verdicts = [], found.verdict.joints
    for name in found.model.row_names:
        m, status = ours.per_joint.get(name), "–"
        if name in verdicts:
            status = verdict_cell(name, asdict(verdicts[name]))
        if m is None:
            dash = number(None)
            nothing = text(f"{status}; no rows used")
            rows.append([code(name), dash, nothing, dash, text(""), *[dash] * 6])
            continue
        said = "; ".join([status, *(remark for remark in _remarks(m) if remark not in status)])
        rows.append(
            [
                code(name),
                percent(m.relative_error_pct),
                text(said, flag=said != status or status.startswith("poor")),
                number(m.rmse, ".3g"),
                text(m.unit),
                number(m.r2, ".3f"),
                number(m.rows, "d"),
                percent(wls.per_joint[name].relative_error_pct),
                percent(m.baselines["urdf"]),
                percent(m.baselines.get("urdf_with_drives")),
                percent(m.baselines["gravity_only"]),
            ]
        )
    return table(caption, headers, rows, is_data=True)


def _remarks(measured: JointMetrics) -> list[str]:
    remarks = [] if measured.better_than_constant else ["worse than a constant"]
    error, urdf = measured.relative_error_pct, measured.baselines["urdf"]
    if error is not None and urdf is not None and error > urdf:
        remarks.append("worse than the URDF")
    return remarks
