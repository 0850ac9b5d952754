"""The report's tables: errors (also as bars), parameters, bodies, changes, consistency, inputs."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Any, NamedTuple

import numpy as np

from robotid.base.findings import listed
from robotid.base.versions import versions
from robotid.diagnosis.verdict.verdict import GOOD, GOOD_POSITION, POOR, POOR_POSITION
from robotid.estimation.fitting.evaluation import Metrics
from robotid.estimation.variation.variation import Variation, VaryingParameter
from robotid.identification.parameter_table import CENTRAL_TERMS, central_parameters
from robotid.identification.result import Identification, TorqueIdentification
from robotid.identification.summary import joint_reason, verdict_cell
from robotid.output.files.entries import input_entries
from robotid.output.pages.html import (
    Cell,
    block,
    code,
    listing,
    number,
    paragraphs,
    percent,
    table,
    text,
    with_error,
)
from robotid.robot.parameters import INERTIAL_TERMS, pseudo_inertia

VISIBLE = 10  # joints that are visible without unfolding
_END = 100  # [%] end of the linear axis of the bars; larger errors end there, too
_TICKS = range(0, _END + 1, 20)  # [%]
_COLUMNS = (
    ("joint", "code", "joint"), ("error %", "%", "relative_error_pct"),
    ("RMSE", ".3g", "rmse"), ("unit", "text", "unit"), ("R²", ".3f", "r2"),
    ("samples", "d", "rows"),
)  # fmt: skip
_UNKNOWN = {"status": "not evaluated", "reasons": ()}


class Baseline(NamedTuple):
    """Another prediction: its name, and the colour of its bar, a variable of tones.css."""

    words: str
    tone: str


@dataclass(frozen=True)
class Quantity:
    """The predicted quantity, and the baselines of its error."""

    title: str  # name of its error
    share: str  # definition of the error, as a formula
    limits: tuple[float, float]  # largest error that is good, and largest that is usable [%]
    baselines: Mapping[str, Baseline]
    scale: float = 1.0  # unit of the errors shown, in units of the quantity
    prefix: str = ""  # prefix of that unit


TORQUE = Quantity(
    "Torque prediction error",
    "100 |τ − prediction| / |τ|",
    (GOOD, POOR),
    {
        "wls": Baseline("least squares", "tone-5"),
        "urdf_with_drives": Baseline("URDF + drives", "tone-3"),
        "urdf": Baseline("URDF", "urdf"),
        "gravity_only": Baseline("gravity only", "quiet"),
    },
)
POSITION = Quantity(
    "Simulated position error",
    "100 |q − simulated| / |motion|",
    (GOOD_POSITION, POOR_POSITION),
    {
        "second_order": Baseline("2nd-order model", "tone-3"),
        "rows": Baseline("torque fit", "tone-3"),
        "urdf": Baseline("URDF", "urdf"),
        "command": Baseline("command", "tone-5"),
        "steady": Baseline("constant speed", "quiet"),
    },
    scale=1e-3,
    prefix="m",
)


@dataclass(frozen=True)
class Errors:
    """The errors of the joints on one recording, or on several together."""

    name: str
    # metrics of each joint that has samples, as in result.json; WLS is a baseline
    joints: Mapping[str, Mapping[str, Any]]
    is_fitted: bool = False  # whether the recording was fitted

    @property
    def caption(self) -> str:
        """The recording, and whether it was fitted."""
        if self.is_fitted and not self.name:
            return "All fitted samples together"
        return f"{self.name}: {'fitted' if self.is_fitted else 'not fitted'}"


def errors_of(found: Identification) -> tuple[Errors, ...]:
    """Return the errors on the validation recordings, then on all fitted ones together."""

    def joints(metrics: Metrics, wls: Metrics | None) -> dict[str, Any]:
        content: dict[str, Any] = metrics.to_dict()["per_joint"]
        for joint, plain in ({} if wls is None else wls.per_joint).items():
            content[joint]["wls_relative_error_pct"] = plain.relative_error_pct
        return content

    name = found.fitted[0].name if len(found.fitted) == 1 else ""
    return (
        *(Errors(e.name, joints(e.metrics["estimate"], found.beside(e))) for e in found.validation),
        Errors(name, joints(found.metrics(), found.beside()), is_fitted=True),
    )


def worst_errors(recordings: Sequence[Errors]) -> dict[str, Mapping[str, Any]]:
    """Return the metrics of each joint on its worst recording, the worst joint first."""
    worst: dict[str, Mapping[str, Any]] = {}
    for errors in recordings:
        for joint, measured in errors.joints.items():
            if joint not in worst or _share(measured) > _share(worst[joint]):
                worst[joint] = measured
    return dict(sorted(worst.items(), key=lambda item: -_share(item[1])))


def _share(measured: Mapping[str, Any]) -> float:
    """Return a joint's error [%]; inf without measurement."""
    error = measured.get("relative_error_pct")
    return float("inf") if error is None else float(error)


def error_bars(
    quantity: Quantity,
    recordings: Sequence[Errors],
    rows: Sequence[str],
    verdicts: Mapping[str, Mapping[str, Any]],
    *,
    has_why: bool = False,
) -> str:
    """Return the errors of the joints on their worst recordings as bars, the worst joint first."""
    worst = worst_errors(recordings)
    # the only validation recording need not be named
    alone = f" on {recordings[0].name}" * (len(recordings) == 1 and not recordings[0].is_fitted)
    items, said = list[str](), set[str]()
    for joint in [*worst, *(joint for joint in verdicts if joint not in worst)]:
        verdict, row, link = verdicts.get(joint, _UNKNOWN), rows.index(joint), ""
        figure = picture = ""
        status = verdict["status"]
        reasons = [reason.replace(alone, "") for reason in verdict["reasons"]]
        shown = reasons if status != "good" else [] if items else reasons[-1:]
        why = joint_reason(joint, shown)
        why, said = "as above" if why and why in said else why, said | {why}
        error = _share(worst[joint]) if joint in worst else None
        if error is not None:
            figure = f"{percent(error).html} %"
            picture = _picture(quantity, row, joint, error, worst[joint])
            if has_why and why:  # else the link would stand alone on a line
                link = block("report.analysis", row=row, joint=escape(joint))
        items.append(
            block(
                "report.bar", kind=status.replace(" ", "-"), row=row, joint=code(joint).html,
                picture=picture, error=figure, status=status, why=escape(why) + link,
            )
        )  # fmt: skip
    more = "".join(items[VISIBLE:])
    if more:
        words = f"{len(items) - VISIBLE} more joints with smaller errors"
        more = f"<details><summary>{words}</summary><ol>{more}</ol></details>\n"
    return block(
        "report.bars", title=quantity.title, share=quantity.share, more=more,
        kind="fitted samples, without validation log" if recordings[0].is_fitted else "not fitted",
        legend=_legend(quantity, {key for m in worst.values() for key in _others(quantity, m)}),
        bars="".join(items[:VISIBLE]),
    )  # fmt: skip


def _others(quantity: Quantity, measured: Mapping[str, Any]) -> dict[str, float]:
    errors = {key: measured.get(f"{key}_relative_error_pct") for key in quantity.baselines}
    return {key: error for key, error in errors.items() if error is not None}


def _at(value: float) -> str:
    """Return the position of an error on the axis."""
    return f"{100 * min(value / _END, 1.0):.2f}%"


def _picture(
    quantity: Quantity, row: int, joint: str, error: float, measured: Mapping[str, Any]
) -> str:
    others, words = "", []
    for k, (key, value) in enumerate(_others(quantity, measured).items()):
        baseline = quantity.baselines[key]
        style = f'y="{10 + 4 * k}" height="3" style="--tone: var(--{baseline.tone})"'
        others += f'<rect width="{_at(value)}" {style}/>'
        words.append(f"{baseline.words} {percent(value).html} %")
    places = map(_at, quantity.limits)
    lines = "".join(f'<line x1="{x}" x2="{x}" y1="0" y2="100%"/>' for x in places)
    title = escape(f"{joint}: error {percent(error).html} %; for comparison {', '.join(words)}")
    figures = {"lines": lines, "width": _at(error), "others": others}
    return block("report.picture", row=row, title=title, height=10 + 4 * len(words), **figures)


def _legend(quantity: Quantity, known: set[str]) -> str:
    keys = "".join(
        f'<span><i style="--tone: var(--{baseline.tone})"></i>{baseline.words}</span>'
        for key, baseline in quantity.baselines.items()
        if key in known
    )
    ticks = "".join(f'<span style="left: {_at(x)}">{x}</span>' for x in _TICKS)
    good, usable = (f"{limit:g}" for limit in quantity.limits)
    return block("report.legend", keys=keys, ticks=ticks, good=good, usable=usable)


def error_table(
    quantity: Quantity,
    errors: Errors,
    rows: Sequence[str],
    verdicts: Mapping[str, Mapping[str, Any]],
) -> str:
    """Return the table of the errors on a recording."""
    others = {f"{key}_relative_error_pct": x.words for key, x in quantity.baselines.items()}
    known = [key for key in others if any(m.get(key) is not None for m in errors.joints.values())]
    entries = []
    for joint in rows:
        measured, entry, notes = errors.joints.get(joint), dict[str, Any](), ["no samples used"]
        status = verdict_cell(joint, verdicts[joint]) if joint in verdicts else ""
        if measured is not None:
            notes = [note for note in _notes(measured) if note not in status]
            rmse, unit = measured["rmse"] / quantity.scale, f"{quantity.prefix}{measured['unit']}"
            entry = {**measured, "rmse": rmse, "unit": unit}
        is_flagged = bool(measured and notes) or status.startswith("poor")
        note = text("; ".join(filter(None, [status, *notes])), flag=is_flagged)
        entries.append({**entry, "joint": joint, "note": note})
    columns = [*_COLUMNS, *((f"{others[key]} %", "%", key) for key in known)]
    if any(entry["note"].html for entry in entries):
        columns.insert(2, ("verdict" if verdicts else "note", "text", "note"))
    return listing(errors.caption, columns, entries, is_data=True)


def _notes(measured: Mapping[str, Any]) -> list[str]:
    notes = [] if measured.get("better_than_constant", True) else ["worse than a constant"]
    error, urdf = measured["relative_error_pct"], measured.get("urdf_relative_error_pct")
    if error is not None and urdf is not None and error > urdf:
        notes.append("worse than the URDF")
    return notes


#: What determined a parameter, by its source.
SOURCE_NAMES = {
    "data": "data", "mixed": "data and prior", "prior": "prior", "bound": "at its bound",
    "stated": "stated",
}  # fmt: skip
_WIDEST = 7  # logs that a page shows side by side
_FIRST_TERMS = ("kp", "kd", "delay", "limit", "zero")  # of a drive, before all others
_MILLI = {"s": "ms"}  # units in the table of drives
_ROLES = {"urdf": "URDF", "identification": "fitted", "validation": "validation"}
_CONSTRAINTS = {  # in the details of a consistent fit
    "active": "Active constraints",
    "relaxed": "Extents that contradict the data",
    "pinned": "Fixed at the URDF's values",
}
#: Units of ``CENTRAL_TERMS``.
_CENTRAL_UNITS = ("kg", "m", "m", "m", *["kg m²"] * 6)

# columns: heading, form, key
_PARAMETERS = (
    ("link or drive", "code", "owner"), ("parameter", "text", "term"), ("URDF", ".4g", "prior"),
    ("identified", ".4g", "value"), ("± error", ".4g", "error"), ("low", ".4g", "low"),
    ("high", ".4g", "high"), ("change", ".4g", "change"), ("determined by", "text", "source"),
    ("unit", "text", "unit"),
)  # fmt: skip
_BASE = (
    ("parameter", "code", "name"), ("value", ".4g", "value"), ("± error", ".4g", "error"),
    ("relative %", "%", "relative"), ("unit", "text", "unit"), ("expression", "code", "expression"),
)  # fmt: skip
_INPUTS = (
    ("role", "text", "role"), ("file", "code", "path"), ("samples", "d", "samples"),
    ("rate [Hz]", ".5g", "rate"), ("from [s]", ".6g", "start"), ("to [s]", ".6g", "end"),
    ("segments", "d", "segments"), ("SHA-256", "code", "sha256"),
)  # fmt: skip

_VARYING = (
    ("parameter", "code", "name"), ("mean", ".4g", "mean"), ("± error", ".4g", "error"),
    ("spread", ".4g", "spread"), ("low", ".4g", "low"), ("high", ".4g", "high"),
    ("unit", "text", "unit"), ("± error with one more, %", ".0f", "less"),
    ("width with one more, %", ".0f", "narrower"),
)  # fmt: skip


def parameter_section(
    entries: Sequence[Mapping[str, Any]], words: str, on_misfit: Collection[str] = ()
) -> str:
    """Return all parameters of the links and drives."""
    rows = [_parameter(entry, on_misfit) for entry in entries]
    parameters = listing("Parameters of links and drives", _PARAMETERS, rows, is_data=True)
    return block("report.parameters", words=words, tables=_drive_table(entries) + parameters)


def _parameter(entry: Mapping[str, Any], on_misfit: Collection[str]) -> dict[str, Any]:
    owner, _, term = entry["name"].rpartition(".")
    error, prior = _error(entry), entry.get("prior")
    value, uncertainty = with_error(entry["value"], error)
    change = number(None)
    if prior is not None:
        change, _ = with_error(entry["value"] - prior, error, sign="+")
        if not set("123456789") & set(change.html):
            change = replace(change, html="0")
    source = SOURCE_NAMES[entry["source"]]
    source += ", model misfit" if entry["name"] in on_misfit else ""
    if other := entry.get("correlated_with"):
        source += f", with {other.rpartition('.')[2]} (r = {entry['correlation']:.3f})"
    ends = entry.get("interval_95") or (None, None)
    low, high = (number(x) if x is None else with_error(x, error)[0] for x in ends)
    return {
        "owner": owner, "term": term, "prior": prior, "value": value, "error": uncertainty,
        "low": low, "high": high, "change": change, "source": source, "unit": entry["unit"],
    }  # fmt: skip


def _drive_table(entries: Sequence[Mapping[str, Any]]) -> str:
    drives: dict[str, dict[tuple[str, str], Mapping[str, Any]]] = {}
    for entry in entries:
        owner, _, term = entry["name"].rpartition(".")
        if term not in INERTIAL_TERMS:
            unit = _MILLI.get(entry["unit"], entry["unit"])
            drives.setdefault(owner, {})[term, unit] = entry
    known = {
        (term, unit): term
        for terms in drives.values()
        for (term, unit), entry in terms.items()
        if entry["value"] or entry.get("std_error") is not None
    }  # all other terms are fixed at 0
    columns = sorted(known, key=lambda column: (*_FIRST_TERMS, known[column]).index(known[column]))
    names = [f"{term} [{unit}]" for term, unit in columns]
    cells = [[_short(own.get(column)) for column in columns] for own in drives.values()]
    rows = [[code(drive), *row] for drive, row in zip(drives, cells, strict=True)]
    return table("Drives, by joint", ["joint", *names], rows, is_data=True) if columns else ""


def _error(entry: Mapping[str, Any]) -> float:
    error = entry.get("std_error")
    return math.inf if error is None else float(error)


def _short(entry: Mapping[str, Any] | None) -> Cell:
    """Return a parameter with its standard error in one cell; times in ms."""
    if entry is None:
        return number(None)
    scale = 1e3 if entry["unit"] in _MILLI else 1.0
    return both(scale * entry["value"], scale * _error(entry))


def both(value: float, error: float) -> Cell:
    """Return a number and its error in one cell."""
    cell, uncertainty = with_error(value, error)
    if uncertainty.value is None:
        return cell
    return Cell(f"{cell.html} ± {uncertainty.html}", "number", cell.value)


def sources_fact(entries: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the number of parameters by source, HTML by its name."""
    sources = [entry["source"] for entry in entries]
    known = {kind: sources.count(kind) for kind in SOURCE_NAMES if kind in sources}
    shares = "".join(f'<i class="from-{k}" style="flex: {n}"></i>' for k, n in known.items())
    words = ", ".join(f"{count} {SOURCE_NAMES[kind]}" for kind, count in known.items())
    name = f"{len(entries)} parameters, determined by"
    return {name: f'<span class="shares">{shares}</span>{words}'}


def body_table(identification: TorqueIdentification) -> str:
    """Return mass, centre and inertia about it of each link, below them those of the URDF."""
    central = central_parameters(identification)
    rows = []
    for i, body in enumerate(identification.model.layout.bodies):
        cells, parts = [], (central.values[i], central.half[i], central.urdf[i])
        for value, half, urdf in zip(*parts, strict=True):
            identified = both(value, half)
            prior = with_error(urdf, half)[0].html
            lines = identified.html.replace(" ± ", "<br>± ")
            html = f'{lines}<br><span class="note">{prior}</span>'
            cells.append(Cell(html, "number", identified.value))
        rows.append([code(body), *cells])
    units = zip(CENTRAL_TERMS, _CENTRAL_UNITS, strict=True)
    headers = ["link", *(f"{term} [{unit}]" for term, unit in units)]
    return block("report.central") + table("Links", headers, rows, is_data=True)


def base_table(identification: TorqueIdentification) -> str:
    """Return the table of the base parameters."""
    mapping, units = identification.mapping, identification.model.layout.units
    undetermined, rows = set(identification.determination.undetermined), []
    for k, name in enumerate(mapping.base_names):
        value = identification.base[k]
        error = math.inf if name in undetermined else float(identification.base_error[k])
        shown, uncertainty = with_error(value, error)
        relative = 100 * error / abs(value) if value and math.isfinite(error) else None
        rows.append(
            {"name": name, "value": shown, "error": uncertainty, "relative": relative,
             "unit": units[mapping.independent[k]], "expression": mapping.expressions[k]}
        )  # fmt: skip
    parameters = listing("Base parameters", _BASE, rows, is_data=True)
    return block("report.base", method=escape(identification.errors.method), table=parameters)


def consistency_section(identification: TorqueIdentification) -> str:
    """Return whether bodies and drives are consistent, and the constraints of the fit."""
    details, layout = identification.estimate.details, identification.model.layout
    lows = np.linalg.eigvalsh(pseudo_inertia(identification.standard[: layout.n_inertial]))[:, 0]
    bodies = zip(layout.bodies, lows, strict=True)
    wrong = [f"{body} ({low:.3g})" for body, low in bodies if low <= 0]
    notes = [f"Inconsistent, with the smallest eigenvalue: {listed(wrong)}."] if wrong else []
    for key, words in _CONSTRAINTS.items():
        if key in details:
            notes.append(f"{words}: {listed(details[key])}.")
    every = "All" if identification.is_consistent else "Not all"
    return block("report.consistency", all=every, notes=paragraphs(notes))


def open_section(identification: TorqueIdentification) -> str:
    """Return the parameters that the data do not determine, and indistinguishable ones."""
    names, sources = identification.model.layout.names, identification.sources
    fixed = [name for name, source in zip(names, sources, strict=True) if source == "prior"]
    groups = identification.determination.merged
    html = block("report.indistinguishable") if groups else ""
    for group in groups:
        combinations = map(str, group.combinations)
        html += block("report.group", names=_codes(group.names), sums=_codes(combinations, "<br>"))
    return block(
        "report.open", rank=identification.determination.rank, count=len(identification.base),
        groups=html, fixed=_codes(fixed),
        without_effect=_codes(identification.mapping.unidentifiable),
    )  # fmt: skip


def _codes(names: Iterable[str], between: str = ", ") -> str:
    return between.join(code(name).html for name in names) or "none"


def sources_of(found: Identification) -> dict[str, tuple[str, str]]:
    """Return the parts of an appendix on the files read and the versions that ran."""
    rows = [
        {
            **entry,
            "role": _ROLES[entry["role"]],
            "sha256": entry["sha256"] or "not read from a file",
        }
        for entry in input_entries(found)
    ]
    ran = [[text(name), text(version)] for name, version in versions().items()]
    return {
        "inputs": ("Inputs", listing("Files read", _INPUTS, rows)),
        "versions": ("Versions", table("Versions that ran", ["what", "version"], ran)),
    }


def variation_section(variation: Variation | None, torques: Mapping[str, str]) -> str:
    """Return the values of drive parameters in each log, and the prediction of the next log."""
    if variation is None:
        return ""
    new, members, one = ("log of this robot", "logs", "log")
    if variation.units > 1:
        new, members, one = (f"robot (after {variation.units})", "robots", "robot")
    html = block("report.variation", members=members, new=new, one=one)
    if torques:
        errors = ", ".join(f"{escape(row)} {error}" for row, error in torques.items())
        html += block("report.next_torque", one=one, errors=errors)
    different = {(unlike.run, unlike.name) for unlike in variation.unlike}
    rows = [_varying(parameter, different) for parameter in variation.parameters]
    caption = f"Drive parameters in {len(variation.runs)} logs; low to high: 95 % of the next {new}"
    runs = variation.runs if len(variation.runs) <= _WIDEST else ()
    columns = [_VARYING[0], *((run, ".4g", f"run {k}") for k, run in enumerate(runs))]
    return html + listing(caption, [*columns, *_VARYING[1:]], rows, is_data=True)


def _varying(parameter: VaryingParameter, different: Collection[tuple[int, str]]) -> dict[str, Any]:
    prediction = parameter.prediction
    mean, error = with_error(prediction.mean, prediction.std_error)
    low, high = (with_error(float(x), prediction.std_error)[0] for x in prediction.ends)
    less, width = prediction.after
    row = {
        "name": parameter.name, "mean": mean, "error": error, "low": low, "high": high,
        "spread": with_error(prediction.spread, prediction.spread)[1], "unit": parameter.unit,
        "less": 100 * less / prediction.std_error,
        "narrower": 100 * width / float(np.ptp(prediction.ends)),
    }  # fmt: skip
    values = zip(parameter.values, parameter.std_errors, strict=True)
    for k, (value, std_error) in enumerate(values):
        shown = both(value, std_error)
        is_different = (k, parameter.name) in different
        bold = f"<strong>{shown.html}</strong>" if is_different else shown.html
        row[f"run {k}"] = replace(shown, html=bold)
    return row
