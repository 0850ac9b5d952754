"""The report's tables as HTML: parameters, changes, consistency, settings, inputs."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from html import escape
from typing import Any

import numpy as np

from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.estimation.fitting.evaluation import Recording
from robotid.estimation.fitting.identified import SOURCES
from robotid.identification.result import TorqueIdentification
from robotid.output.files.urdf import urdf_changes
from robotid.output.pages.html import Cell, code, folded, number, percent, table, text, with_error
from robotid.robot.model import RobotModel
from robotid.robot.parameters import INERTIAL_TERMS, pseudo_inertia

#: What determined a parameter, by its source.
SOURCE_NAMES = {
    "data": "data",
    "mixed": "data and prior",
    "prior": "prior",
    "bound": "at its bound",
    "stated": "stated",
}

_COLUMNS = 7  # drive terms that a page shows side by side
_FIRST_TERMS = ("kp", "kd", "delay", "limit", "zero")  # of a drive, before all others
_MILLI = {"s": "ms"}  # units in the table of drives
_ROLES = {"urdf": "URDF", "identification": "fitted", "validation": "validation"}
_CHOSEN = {
    "cv": "selected by cross-validation on the fitted logs",
    "evidence": "selected by the evidence of the fitted logs",
}


def parameter_section(
    model: RobotModel | None,
    standard: Array | None,
    entries: Sequence[Mapping[str, Any]],
    words: str,
    on_misfit: Collection[str] = (),
) -> str:
    """Return all parameters of the links and drives, and the changes of the URDF: standard (p,)."""
    return (
        f"<p>{words} ±: one standard error; low and high: the 95 % interval. Determined by data: "
        "the standard error is below 30 % of the prior's spread. By prior: it is above 90 %, and "
        "the value is the URDF's. At its bound: a physical constraint is active. "
        "With another parameter (r): the errors are strongly correlated, and the joint effect of "
        "both is determined far better than each parameter.</p>\n"
        + _drive_table(entries)
        + _parameter_table(entries, on_misfit)
        + folded("changes", "Changes of the URDF", _change_section(model, standard))
    )


def _parameter_table(entries: Sequence[Mapping[str, Any]], on_misfit: Collection[str]) -> str:
    """Return the table of parameters: the URDF's value, the identified value and its source."""
    rows = []
    for entry in entries:
        owner, _, term = entry["name"].rpartition(".")
        error, prior = _error(entry), entry.get("prior")
        value, uncertain = with_error(entry["value"], error)
        change = number(None)
        if prior is not None:
            change, _ = with_error(entry["value"] - prior, error, sign="+")
            if not set("123456789") & set(change.html):
                change = replace(change, html="0")
        words = SOURCE_NAMES[entry["source"]]
        words += ", model misfit" if entry["name"] in on_misfit else ""
        if other := entry.get("correlated_with"):
            words += f", with {other.rpartition('.')[2]} (r = {entry['correlation']:.3f})"
        ends = entry.get("interval_95") or (None, None)
        low, high = (number(x) if x is None else with_error(x, error)[0] for x in ends)
        rows.append(
            [
                code(owner),
                text(term),
                number(prior),
                value,
                uncertain,
                low,
                high,
                change,
                text(words),
                text(entry["unit"]),
            ]
        )
    headers = ["link or drive", "parameter", "URDF", "identified", "± error", "low", "high"]
    headers += ["change", "determined by", "unit"]
    return table("Parameters of links and drives", headers, rows, is_data=True)


def _drive_table(entries: Sequence[Mapping[str, Any]]) -> str:
    """Return the drive terms, one row per joint, or one per term if these are more."""
    drives: dict[str, dict[str, Mapping[str, Any]]] = {}
    for entry in entries:
        owner, _, term = entry["name"].rpartition(".")
        if term not in INERTIAL_TERMS:
            drives.setdefault(owner, {})[term] = entry
    shown = {
        term: entry
        for own in drives.values()
        for term, entry in own.items()
        if entry["value"] or entry.get("std_error") is not None
    }  # all other terms are fixed at 0
    terms = sorted(shown, key=lambda term: (*_FIRST_TERMS, term).index(term))
    units = [_MILLI.get(shown[term]["unit"], shown[term]["unit"]) for term in terms]
    names = [f"{term} [{unit}]" for term, unit in zip(terms, units, strict=True)]
    cells = [[_short(own.get(term)) for term in terms] for own in drives.values()]
    headers, rows = (
        ["joint", *names],
        [[code(x), *own] for x, own in zip(drives, cells, strict=True)],
    )
    if len(terms) > max(len(drives), _COLUMNS):  # too wide for a page
        headers = ["term", *drives]
        rows = [
            [text(name), *own] for name, own in zip(names, zip(*cells, strict=True), strict=True)
        ]
    return table("Drives, by joint", headers, rows, is_data=True) if terms else ""


def _error(entry: Mapping[str, Any]) -> float:
    error = entry.get("std_error")
    return math.inf if error is None else float(error)


def _short(entry: Mapping[str, Any] | None) -> Cell:
    """Return a parameter with its standard error in one cell; times in ms."""
    if entry is None:
        return number(None)
    scale = 1e3 if entry["unit"] in _MILLI else 1.0
    value, error = with_error(scale * entry["value"], scale * _error(entry))
    if error.value is None:
        return value
    return Cell(f"{value.html} ± {error.html}", "number", value.value)


def sources_fact(entries: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the number of parameters by source, HTML by its name."""
    counts = {kind: sum(entry["source"] == kind for entry in entries) for kind in SOURCE_NAMES}
    there = {kind: count for kind, count in counts.items() if count}
    shares = "".join(
        f'<i class="from-{kind}" style="flex: {count}"></i>' for kind, count in there.items()
    )
    words = ", ".join(f"{count} {SOURCE_NAMES[kind]}" for kind, count in there.items())
    name = f"{len(entries)} parameters, determined by"
    return {name: f'<span class="shares">{shares}</span>{words}'}


def _change_section(model: RobotModel | None, standard: Array | None) -> str:
    """Return the changed lines of the URDF, each link's under its name."""
    if standard is None:
        return "<p>No URDF was written.</p>\n"
    lines = [] if model is None else urdf_changes(model, standard)
    if not lines:
        return "<p>The URDF is no longer at its path.</p>\n"
    kinds, html, link = {"-": "del", "+": "ins"}, "", ""
    for line in lines[2:]:
        if line[0] in kinds:
            html += f"<{kinds[line[0]]}>{escape(line)}</{kinds[line[0]]}>\n"
        elif (name := line.rpartition("@@ ")[2]) != link:  # unchanged lines split a link's changes
            html, link = f"{html}<strong>{escape(name)}</strong>\n", name
    title = " and ".join(line.split(" ", 1)[1].strip() for line in lines[:2])
    return (
        f"<p>{escape(title)}; all other bytes are unchanged.</p>\n"
        f'<pre class="diff" tabindex="0">{html}</pre>\n'
    )


def base_table(found: TorqueIdentification) -> str:
    """Return the table of the base parameters."""
    mapping, units = found.mapping, found.model.layout.units
    open_ = set(found.determination.undetermined)
    rows = []
    for k, (name, i, expression) in enumerate(
        zip(mapping.base_names, mapping.independent, mapping.expressions, strict=True)
    ):
        error = math.inf if name in open_ else float(found.base_error[k])
        value, uncertain = with_error(found.base[k], error)
        share = _relative(found.base[k], error)
        rows.append([code(name), value, uncertain, share, text(units[i]), code(expression)])
    headers = ["parameter", "value", "± error", "relative %", "unit", "expression"]
    return (
        "<p>The combinations of standard parameters that the torque depends on. Each is named "
        "after one of its terms. A dash as error: not identifiable alone from these data. Errors "
        f"are standard errors from {escape(found.errors.method)}.</p>\n"
        + table("Base parameters", headers, rows, is_data=True)
    )


def consistency_section(found: TorqueIdentification) -> str:
    """Return masses and pseudo-inertias, of the URDF and identified; prior, bounds, mass matrix."""
    layout = found.model.layout
    before, after = (
        pseudo_inertia(pi[: layout.n_inertial]) for pi in (found.prior, found.standard)
    )
    low_before, low_after = (np.linalg.eigvalsh(J)[:, 0] for J in (before, after))
    rows = [
        [
            code(body),
            number(before[i, 3, 3]),
            number(after[i, 3, 3]),
            number(low_before[i], ".3g"),
            number(low_after[i], ".3g"),
            text("" if low_after[i] > 0 else "inconsistent", flag=True),
        ]
        for i, body in enumerate(layout.bodies)
    ]
    totals = [number(float(J[:, 3, 3].sum())) for J in (before, after)]
    foot = [text("total"), *totals, text(""), text(""), text("")]
    headers = ["body", "mass, URDF [kg]", "mass [kg]", "smallest eigenvalue, URDF"]
    headers += ["smallest eigenvalue", "remark"]
    every = "All bodies and drives are" if found.is_consistent else "Not all bodies and drives are"
    return (
        f"<p>{every} physically consistent. A body is consistent if the smallest eigenvalue of its "
        "pseudo-inertia is positive; a drive, if armature and friction are not negative.</p>\n"
        + table("Mass and pseudo-inertia of each body", headers, rows, foot)
        + _consistency_notes(found)
    )


def open_section(found: TorqueIdentification) -> str:
    """Return the parameters that the data do not determine."""
    wls, layout = found.wls, found.model.layout
    fixed = [n for n, source in zip(layout.names, found.sources, strict=True) if source == "prior"]
    return (
        f"<p>The data determine {found.determination.rank} of {len(found.base)} base parameters; "
        f"condition number {wls.condition:.3g} (regressor, unit columns).</p>\n"
        + _indistinguishable(found)
        + _listed("Parameters without effect on the torque", found.mapping.unidentifiable)
        + _combinations(found)
        + _listed("Standard parameters that remain at the URDF's values", fixed)
    )


def _indistinguishable(found: TorqueIdentification) -> str:
    """Return indistinguishable base parameters, and their identifiable combinations."""
    groups = found.determination.merged
    title = "Base parameters that are not identifiable alone"
    if not groups:
        return _listed(title, ())
    parts = [
        f"<h3>{title}</h3>\n<p>A combination counts as identifiable if the data reduce its prior "
        "spread by 10 % or more. Factors are in SI units. Terms below 5 % of the largest one, each "
        "times its spread, are left out. result.json has all.</p>\n"
    ]
    for group in groups:
        names = ", ".join(code(name).html for name in group.names)
        sums = "<br>".join(code(str(combination)).html for combination in group.combinations)
        parts.append(
            f'<p>Parameters:</p>\n<p class="code">{names}</p>\n<p>Identifiable:</p>\n'
            f'<p class="code">{sums}</p>\n'
            if sums
            else f'<p>Not identifiable:</p>\n<p class="code">{names}</p>\n'
        )
    return "".join(parts)


def _combinations(found: TorqueIdentification) -> str:
    """Return the identifiability of each body's parameters: alone, in sums only, or never."""
    layout = found.model.layout
    rows = []
    for i, body in enumerate(layout.bodies):
        names = layout.names[10 * i : 10 * i + 10]
        kinds = found.mapping.described(names)
        short = {key: ", ".join(n.rsplit(".", 1)[1] for n in kinds[key]) or "–" for key in kinds}
        rows.append([code(body), *[text(short[key]) for key in ("alone", "in sums", "never")]])
    return table(
        "Structural identifiability of each body",
        ["body", "alone", "only in sums with others (see base parameters)", "never"],
        rows,
    )


def settings_tables(found: TorqueIdentification) -> str:
    """Return the tables of the settings, as used."""
    model = found.model
    settings = found.estimator.to_dict()
    pairs = {
        "estimator": settings.pop("name"),
        **{key.replace("_", " "): str(value) for key, value in settings.items()},
        "solver": f"{found.estimate.message} ({found.estimate.n_iter} iterations)",
        "drive terms": listed(model.layout.terms),
        "gravity [m/s²]": listed(f"{g:g}" for g in model.pin_model.gravity.linear.tolist()),
        "base": "floating" if model.free_flyer else "fixed",
        "joints": listed(model.joints),
        "locked joints": listed(f"{k} = {v:g}" for k, v in model.locked.items()),
    }
    for coupling in model.layout.couplings:
        ratios = listed(f"{joint} × {ratio:g}" for joint, ratio in coupling.ratios)
        pairs[f"coupling {coupling.name}"] = ratios
    rows = [[text(key), text(value)] for key, value in pairs.items()]
    headers = ["log", "filter", "rate Hz", "velocity", "trim s", "minimum speed", "gap s"]
    signals = [_signal_row(e.recording) for e in (*found.fitted, *found.validation)]
    return table("Model and estimator", ["setting", "value"], rows) + table(
        "Signals, as used for each log; minimum speed in rad/s or m/s", headers, signals
    )


def input_table(inputs: Iterable[Mapping[str, Any]]) -> str:
    """Return the table of the input files."""
    rows = [
        [
            text(_ROLES[entry["role"]]),
            code(entry["path"]),
            number(entry.get("samples"), "d"),
            number(entry.get("rate"), ".5g"),
            number(entry.get("start"), ".6g"),
            number(entry.get("end"), ".6g"),
            number(entry.get("segments"), "d"),
            code(entry["sha256"] or "not read from a file"),
        ]
        for entry in inputs
    ]
    headers = ["role", "file", "samples", "rate Hz", "from s", "to s", "segments", "SHA-256"]
    return table("Files read", headers, rows)


def version_table(ran: Mapping[str, str]) -> str:
    """Return the table of the versions that ran."""
    rows = [[text(name), code(version)] for name, version in ran.items()]
    return table("Versions that ran", ["what", "version"], rows)


def _relative(value: float, error: float) -> Cell:
    relative = 100 * error / abs(value) if value and math.isfinite(error) else None
    if relative is not None and relative >= 1000:
        return Cell("&gt; 999", "number", relative)
    return percent(relative)


def _listed(title: str, names: Sequence[str]) -> str:
    listed = ", ".join(code(name).html for name in names) or "none"
    return f'<h3>{title}</h3>\n<p class="code">{listed}</p>\n'


def _signal_row(recording: Recording) -> list[Cell]:
    s = recording.signals
    return [
        code(recording.name),
        text("none" if s.cutoff is None else f"{s.cutoff:g} Hz, order {s.order}"),
        number(s.rate, ".6g"),
        text(s.velocity),
        number(s.trim, ".3g"),
        number(s.min_velocity, ".3g"),
        number(s.max_gap, ".3g"),
    ]


def _consistency_notes(found: TorqueIdentification) -> str:
    """Return paragraphs on data coverage, mass matrix, prior and bounds of the fit."""
    notes = [_coverage(found), _mass_matrix(found)]
    details = found.estimate.details
    if "prior" in details:
        prior = details["prior"]
        chosen = _CHOSEN.get(prior.get("chosen_by", ""), "as set")
        notes.append(
            "The prior is the distance from the URDF's values by the divergence of the "
            f"pseudo-inertias (entropic); its weight is {prior['weight']:.3g}, {chosen}."
        )
        active = ", ".join(details["active"])
        notes.append(f"Active constraints: {active}." if active else "No constraint is active.")
        if details["relaxed"]:
            notes.append(f"Extents that contradict the data: {', '.join(details['relaxed'])}.")
        if details["pinned"]:
            notes.append(f"Fixed at the URDF's values: {', '.join(details['pinned'])}.")
    return "".join(f"<p>{escape(text)}</p>\n" for text in notes)


def _coverage(found: TorqueIdentification) -> str:
    counts = {kind: found.sources.count(kind) for kind in SOURCES}
    carried = [
        body
        for body in found.model.layout.bodies
        if all(
            source == "prior"
            for name, source in zip(found.model.layout.names, found.sources, strict=True)
            if name.rsplit(".", 1)[0] == body
        )
    ]
    text = (
        f"Sources of the {len(found.sources)} parameters: {counts['data']} the data, "
        f"{counts['mixed']} data and URDF together, {counts['prior']} the URDF; {counts['bound']} "
        "are at a physical bound."
    )
    return text + (
        f" The data do not determine {', '.join(carried)}: URDF only." if carried else ""
    )


def _mass_matrix(found: TorqueIdentification) -> str:
    check = found.mass_matrix
    where = "at all" if check.is_positive else f"at {100 * check.positive_share:.3g} % of"
    return (
        f"The mass matrix, armatures included, is positive definite {where} {check.poses} "
        f"random poses (smallest eigenvalue {check.smallest_eigenvalue:.3g})."
    )
