"""The report of an identification, on torques or on positions, as one self-contained page."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import quote, urlencode

import numpy as np

from robotid.base.findings import Cause, grouped, tally
from robotid.base.typing import Array
from robotid.base.versions import __version__
from robotid.diagnosis.verdict.verdict import uses_line
from robotid.estimation.fitting.evaluation import Evaluated
from robotid.identification.result import Identification
from robotid.identification.summary import verdict_cell
from robotid.output.pages.html import (
    POINTS,
    Section,
    block,
    code,
    command_html,
    facts_html,
    folded,
    page,
    verdict_html,
)
from robotid.output.report.errors import (
    Errors,
    Quantity,
    error_bars,
    error_table,
    errors_of,
    worst_errors,
)
from robotid.output.report.next_steps import Origin, Step, next_steps
from robotid.output.report.tables import sources_fact

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
    tables = "".join(
        error_table(report.quantity, errors, rows, verdicts) for errors in errors_of(found)
    )
    count = sum(entry["source"] in ("data", "mixed") for entry in report.entries)
    determined = f"{count} of {len(report.entries)} determined by the data, fully or partly"
    appendix = "".join(
        folded(key, title, html) for key, (title, html) in report.appendix.items() if html
    )
    causes = grouped(found.findings, rows)
    findings = "".join(map(_cause, causes)) or "<p>None.</p>\n"
    notes = [cause for cause in causes if cause.severity == "note"]
    serious = [cause for cause in causes if cause.severity != "note"]
    worst = escape(next(iter(worst_errors(report.counted)), ""))
    sections = {
        "errors": Section(
            "Errors", f"{definition}{tables}{after}", f"{len(verdicts)} joints, by recording", False
        ),
        "findings": Section("Findings", findings, tally(serious, notes, worst) or "none", False),
        "friction": Section("Friction against speed", report.friction),
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
    bars = error_bars(
        report.quantity, report.counted, found.model.row_names, verdict["per_joint"],
        has_why=bool(report.why),
    )  # fmt: skip
    return block(
        "report.first",
        verdict=verdict_html(found.model.name, verdict["status"], verdict["reasons"], uses),
        facts=facts_html({**report.facts, **sources_fact(report.entries)}, files),
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
        title = f"all {len(cause.findings)} findings"
        findings = f"<details><summary>{title}</summary><ul>{items}</ul></details>\n"
    return block(
        "report.cause",
        severity=cause.severity,
        key=escape(cause.code),
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
        return "".join(words) if clip.log else ""

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
        kind, command = "written", ""
        if not self.replay:
            kind = "unwritten"
            command = command_html(next(filter(None, map(self._command, self.clips))))
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

    Windows with less than half of their samples used are ignored, as those across gaps. A
    recording shorter than 1 s is one window.
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
        "report.worst",
        name=escape(worst.of.name),
        start=f"{worst.start:.2f}",
        end=f"{worst.end:.2f}",
        rms=f"{worst.rms / scale:.3g}",
        unit=unit,
        ratio=f"{worst.ratio:.2g}",
        link=dock.link("Show this second in the replay", worst.start, joint, worst.of.file),
    )


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
        status = verdict_cell(name, verdicts[name]) if name in verdicts else ""
        unit = f"{quantity.prefix}{units[row]}"
        note = worst_html(worst_second(residuals(row)), name, unit, player, quantity.scale)
        html = note + "".join(charts(e, row, link, points) for link, e in runs.items())
        summary = f"<strong>{code(name).html}</strong> {escape(status)}"
        parts.append(folded(f"joint-{row}", summary, html, is_open=name == worst))
    return "".join(parts)
