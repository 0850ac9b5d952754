"""The report of an identification by simulation: errors of positions, and the drives found."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from robotid._files import write_text
from robotid.closed_loop.evaluation import DRIFTS, OpenLoop
from robotid.exceptions import DataError
from robotid.export.ranges import stated_ranges
from robotid.findings import Finding, listed
from robotid.judgement.positions import GOOD, POOR
from robotid.judgement.verdict import JointVerdict
from robotid.pages.charts import Chart, Series, chart_html
from robotid.pages.html import (
    Cell,
    Section,
    code,
    folded,
    number,
    page,
    table,
    text,
    with_error,
)
from robotid.report.advice import Origin, loop_steps
from robotid.report.bars import Bar, Mark, bars_html
from robotid.report.causes import findings_line, findings_section
from robotid.report.summary_screen import first_screen
from robotid.report.tables import input_table, version_table
from robotid.versions import __version__

__all__ = ["write_loop_report"]

#: What predicts a position beside the identified robot, by name of the baseline.
_MARKS = {
    "second_order": Mark("second order", "M-5 -1h10l-5 6z", "fill"),
    "rows": Mark("torques alone", "M-5 19h10l-5 -6z", "fill"),
    "urdf": Mark("URDF", "M0 0v18", "line"),
    "command": Mark("command", "M-3 6l6 6m0 -6l-6 6", "line"),
    "steady": Mark("same speed", "M-3 9h6", "line"),
}
#: The same by key of its error in result.json.
_OTHERS = {f"{key}_rmse": mark.words for key, mark in _MARKS.items()}
#: What the error of a joint is a share of, as a column says it.
_SHARES = {"command_rmse": "% of command's", "steady_rmse": "% of same speed"}
_ROWS = 24_000  # of all charts together: about half a MB
_LONGEST = 3000  # rows of one chart
_OPEN = 3  # joints whose charts are open at first
_NAMED = 7  # joints whose errors over the horizon are drawn
_SMALL = 1e-3  # of rad and m, which errors are shown in
#: Parameters of a drive that stand before all others.
_FIRST_TERMS = ("kp", "kd", "delay", "limit", "zero")
_ROLES = {"validation": "kept apart", "identification": "fitted"}


def write_loop_report(
    content: Mapping[str, Any],
    fitted: Sequence[OpenLoop],
    kept: Sequence[OpenLoop],
    target: str | Path,
    *,
    files: Mapping[str, str] | None = None,
    origin: Origin | None = None,
) -> Path:
    """Write what drives were found from commands and positions, as one HTML file.

    The file fetches nothing. It is made beside its target and then put in place.

    Args:
        content: Content of the result.json.
        fitted: The fitted logs, with the positions simulated for them.
        kept: The same of logs kept apart.
        target: The file to write.
        files: Files beside it to link to, by what they are, as "URDF".
        origin: Where the results are, for the commands that it shows; none if not said.

    Returns:
        Path of the file.

    Raises:
        DataError: If a log has other joints than the result, or the target has no folder.
    """
    joints = content["joints"]
    for run in (*kept, *fitted):
        if run.q.shape[1] != len(joints):
            raise DataError(f"{run.log.name} has {run.q.shape[1]} joints, the result {len(joints)}")
    bars = _bars(content)
    worst = [bar.joint for bar in bars]
    findings = [
        Finding(entry["code"], entry["severity"], entry["where"], entry["message"])
        for entry in content.get("warnings", [])
    ]
    line = findings_line(findings, joints, worst[0])
    drives = content["drive_parameters"]
    known = sum(entry.get("std_error") is not None for entry in drives)
    sections = {
        "errors": Section("Errors", _errors(content), f"{len(joints)} joints, by recording", False),
        "findings": Section("Findings", findings_section(findings, joints, worst), line, False),
        "positions": Section("Positions", _positions(content, fitted, kept, worst)),
        "drives": Section("Drives", _drives(content), f"{known} of {len(drives)} found", False),
        "appendix": Section("Appendix", _appendix(content)),
    }
    others = {key for bar in bars for key, error in bar.others.items() if error is not None}
    marks = {key: mark for key, mark in _MARKS.items() if key in others}
    note = "of its motion, not fitted" if content["validation"] else "of its motion, fitted logs"
    header = first_screen(
        content["robot"], content["verdict"], _facts(content), files or {},
        bars_html("Simulated position error", note, bars, marks, (GOOD, POOR)),
        loop_steps(content, origin or Origin()),
    )  # fmt: skip
    source = "roll-outs of its torques" if _is_driven(content) else "commands"
    title = f"{content['robot']}: drives from {source}"
    return write_text(page(title, header, sections), target)


def _is_driven(content: Mapping[str, Any]) -> bool:
    """Return whether the logged torque drove the robot, which no loop was closed on."""
    return bool(content["simulation"]["controller"]["kind"] == "torque")


def _entries(content: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """Return errors by recording with its role, those kept apart first."""
    found = content["simulation"]
    return [(role, entry) for role in _ROLES for entry in found.get(role, [])]


def _shown(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the errors that the first screen shows: kept apart, else fitted; worst joint first."""
    entry = _entries(content)[0][1]
    order = sorted(entry["per_joint"].items(), key=lambda item: -item[1]["rmse"])
    return {**entry, "per_joint": dict(order)}


def _name(entry: Mapping[str, Any]) -> str:
    return f"{Path(entry['log']).name}, {entry['start']:.4g} to {entry['end']:.4g} s"


def _unit(entry: Mapping[str, Any]) -> str:
    """Return the unit that errors are shown in, "mrad or mm" if some joints slide."""
    units = dict.fromkeys(each["unit"] for each in entry["per_joint"].values())
    return " or ".join(f"m{unit}" for unit in units)


def _mean(values: Sequence[float | None]) -> float | None:
    """Return the geometric mean; None if a value is missing."""
    if any(value is None or not value > 0 for value in values):
        return None
    return math.exp(float(np.mean(np.log(np.array(values, dtype=float)))))


def _facts(content: Mapping[str, Any]) -> dict[str, str]:
    role, entry = _entries(content)[0]
    joints = entry["per_joint"].values()
    ours = _mean([each["rmse"] for each in joints])
    size = number(ours and ours / _SMALL, ".3g").html
    over = f" over {DRIFTS:g} s" if _is_driven(content) else ""
    facts = {
        f"Open-loop position error{over}, {_ROLES[role]}": (
            f"<strong>{size} {_unit(entry)}</strong>, geometric mean of {len(joints)} "
            f"joint{'s' if len(joints) > 1 else ''}"
        )
    }
    times = [
        f"{label} {(ratio := theirs / ours):{'.2g' if ratio < 99.5 else '.0f'}} ×"
        for key, label in _OTHERS.items()
        if ours and (theirs := _mean([each.get(key) for each in joints]))
    ]
    if times:
        facts["By comparison, times that error"] = escape(", ".join(times))
    found = sum(entry.get("std_error") is not None for entry in content["drive_parameters"])
    stated = len(content["drive_parameters"]) - found
    facts["Drive parameters"] = f"{found} found, {stated} stated or held"
    return facts


def _bars(content: Mapping[str, Any]) -> list[Bar]:
    """Return the errors of joints on the log kept apart where each is worst, the worst first."""
    errors: dict[str, Mapping[str, Any]] = {}
    for metrics in content["validation"] or [content["identification"]]:
        for joint, own in metrics["per_joint"].items():
            if joint not in errors or _share(own) > _share(errors[joint]):
                errors[joint] = own
    verdicts, joints, found = content["verdict"].get("per_joint", {}), content["joints"], []
    for joint in sorted(joints, key=lambda joint: -_share(errors.get(joint, {}))):
        own, j = errors.get(joint, {}), joints.index(joint)
        others = {key: own.get(f"{key}_relative_error_pct") for key in _MARKS}
        stated = verdicts.get(joint, {"status": "not evaluated", "reasons": ()})
        verdict = JointVerdict(stated["status"], tuple(stated["reasons"]))
        error = own.get("relative_error_pct")
        found.append(Bar(j, joint, error, others, verdict, f"position-{j}"))
    return found


def _share(measured: Mapping[str, Any]) -> float:
    value = measured.get("relative_error_pct")
    return -1.0 if value is None else float(value)


def _scaled(value: float | None) -> float:
    return math.nan if value is None else value / _SMALL


def _horizon_chart(entry: Mapping[str, Any], said: str) -> str:
    """Return the chart of errors over how long the open loop has run, of the worst joints."""
    horizons = {float(key): errors for key, errors in entry.get("horizons", {}).items()}
    joints = entry["per_joint"]
    if "steady_rmse" not in next(iter(joints.values())):  # which is put back again and again
        horizons[entry["end"] - entry["start"]] = {name: x["rmse"] for name, x in joints.items()}
    x = np.array(sorted(horizons))
    errors = {name: [horizons[h].get(name) for h in x.tolist()] for name in joints}
    means = [_mean([own[k] for own in errors.values()]) for k in range(len(x))]
    lines = [
        Series(name, np.array([_scaled(y) for y in ys]), f"tone-{k + 1}", is_faint=True)
        for k, (name, ys) in enumerate([*errors.items()][:_NAMED])
    ]
    mean = Series("geometric mean of all", np.array([_scaled(y) for y in means]), "text")
    chart = Chart(
        "position error over the horizon of the open loop", x, (*lines, mean),
        "time since the open loop began [s]", f"RMSE [{_unit(entry)}]", logarithmic="xy",
        height=220,
    )  # fmt: skip
    words = [f"the worst {_NAMED} joints"] if len(errors) > _NAMED else []
    words += ["the whole stretch last"] if len(x) > len(entry.get("horizons", {})) else []
    return chart_html(chart, f"{', '.join(['Error over horizon', *words])}: {said}")


def _errors(content: Mapping[str, Any]) -> str:
    words = (
        "The identified robot starts where the log starts and then hears the commands alone. "
        "RMSE of its position over the whole stretch, and over horizons after which it is put "
        "back to what was measured. Baselines: the command taken for the position, the URDF with "
        "the stated gains and neither friction nor delay, and a model of second order for each "
        "joint by itself."
    )
    if _is_driven(content):
        words = (
            "The logged torque alone drives the identified robot, which is put back to what was "
            f"measured every {DRIFTS:g} s, or after another horizon. Baselines: what the torques "
            "tell by themselves, the URDF with drives fitted to them, and going on at the speed of "
            "the start."
        )
    (role, _), shown = _entries(content)[0], _shown(content)
    chart = _horizon_chart(shown, f"{escape(_name(shown))}, {_ROLES[role]}")
    tables = "".join(_error_table(role, entry) for role, entry in _entries(content))
    return f"<p>{words}</p>\n{chart}{tables}"


def _error_table(role: str, entry: Mapping[str, Any]) -> str:
    joints, horizons = entry["per_joint"], entry.get("horizons", {})
    others = [key for key in _OTHERS if any(each.get(key) is not None for each in joints.values())]
    plain = "steady_rmse" if "steady_rmse" in others else "command_rmse"
    headers = ["joint", "RMSE", _SHARES[plain], *(_OTHERS[key] for key in others)]
    headers += [f"over {float(h):g} s" for h in horizons]

    def cells(first: Cell, own: Mapping[str, Any], short: Sequence[float | None]) -> list[Cell]:
        share = None
        if own.get("rmse") and own.get(plain):
            share = 100 * own["rmse"] / own[plain]
        values = [own.get("rmse"), *(own.get(key) for key in others), *short]
        ours, *rest = (number(x if x is None else x / _SMALL, "#.3g") for x in values)
        return [first, ours, number(share, ".1f"), *rest]

    rows = [
        cells(code(name), own, [errors.get(name) for errors in horizons.values()])
        for name, own in joints.items()
    ]
    means = {key: _mean([own.get(key) for own in joints.values()]) for key in ("rmse", *others)}
    short = [_mean([errors.get(name) for name in joints]) for errors in horizons.values()]
    foot = cells(text("geometric mean"), means, short)
    caption = f"{_name(entry)}, {_ROLES[role]}: errors in {_unit(entry)}"
    return table(caption, headers, rows, foot, is_data=True)


def _positions(
    content: Mapping[str, Any],
    fitted: Sequence[OpenLoop],
    kept: Sequence[OpenLoop],
    worst: Sequence[str],
) -> str:
    """Return charts of each joint in every log, the worst joints open."""
    joints = content["joints"]
    runs = [*((run, "kept apart") for run in kept), *((run, "fitted") for run in fitted)]
    if not runs:
        return "<p>No log is at hand to be shown.</p>\n"
    points = min(_LONGEST, max(200, _ROWS // (2 * len(joints) * len(runs))))
    units = {name: each["unit"] for _, entry in _entries(content)
             for name, each in entry["per_joint"].items()}  # fmt: skip
    words = (
        f"Measured and simulated position, the simulation put back every {DRIFTS:g} s"
        if _is_driven(content)
        else "Commanded, measured and simulated position, the simulation in open loop from the "
        "first sample"
    )
    parts = [
        f"<p>{words}; below, what is left. Drag to zoom; double-click or Escape shows all.</p>\n"
    ]
    for joint in [*worst, *(name for name in joints if name not in worst)]:
        j = joints.index(joint)
        charts = "".join(
            _charts(run, kind, j, joint, units.get(joint, "rad"), link=f"log {k}", points=points)
            for k, (run, kind) in enumerate(runs)
        )
        summary, is_open = f"<strong>{code(joint).html}</strong>", joint in worst[:_OPEN]
        parts.append(folded(f"position-{j}", summary, charts, is_open=is_open))
    return "".join(parts)


def _charts(
    run: OpenLoop, kind: str, j: int, joint: str, unit: str, *, link: str, points: int
) -> str:
    """Return positions of a joint in a log, and how far they are from what was measured."""
    log, q, q_sim = run.log, run.log.q[:, j], run.q[:, j]
    positions = [Series("measured", q, "text"), Series("simulated", q_sim, "predicted")]
    left = [Series("measured − simulated", (q - q_sim) / _SMALL, "residual")]
    if log.q_ref is not None and not run.is_driven:
        q_ref = log.q_ref[:, j]
        positions.insert(0, Series("commanded", q_ref, "tone-5"))
        far = (q - q_ref) / _SMALL
        left.insert(0, Series("measured − commanded", far, "tone-5", is_hidden=True))
    rmse = float(np.sqrt(np.nanmean((q - q_sim) ** 2))) / _SMALL
    above = Chart(
        f"position of {joint}", log.t, tuple(positions), "time [s]", f"position [{unit}]", link=link
    )
    below = Chart(
        f"position error of {joint}", log.t, tuple(left), "time [s]", f"error [m{unit}]",
        link=link, height=110,
    )  # fmt: skip
    window = f"{escape(log.name)}, {log.t[0]:.4g} to {log.t[-1]:.4g} s"
    caption = f"{window}, {kind}: RMSE {rmse:.3g} m{unit}"
    return chart_html(above, caption, points=points) + chart_html(below, "", points=points)


def _drives(content: Mapping[str, Any]) -> str:
    """Return a table of drives, joint by joint, and one of all parameters with intervals."""
    entries = content["drive_parameters"]
    by_joint: dict[str, dict[str, Mapping[str, Any]]] = {}
    for entry in entries:
        joint, _, term = entry["name"].rpartition(".")
        by_joint.setdefault(joint, {})[term] = entry
    terms, units = _terms(entries), dict[str, str]()
    for entry in entries:
        units.setdefault(entry["name"].rpartition(".")[2], entry["unit"])
    rows = [
        [code(joint), *(_short(own.get(term)) for term in terms)] for joint, own in by_joint.items()
    ]
    headers = [
        "joint",
        *(f"{term} [{'ms' if units[term] == 's' else units[term]}]" for term in terms),
    ]
    ranges, lines = stated_ranges(content)["drives"], []
    for joint, own in by_joint.items():
        for term, entry in own.items():
            ends = ranges[joint][term]
            value, error = with_error(entry["value"], _error(entry))
            low, high = (number(ends.get(end), ".4g") for end in ("low", "high"))
            lines.append(
                [
                    code(entry["name"]), value, error, low, high,
                    text(ends["source"]), text(entry["unit"]),
                ]
            )  # fmt: skip
    heads = ["parameter", "value", "standard error", "low", "high", "from", "unit"]
    every = table("All drive parameters with their 95 % intervals", heads, lines, is_data=True)
    words = (
        "τ = kp (q<sub>ref</sub>(t − delay) − q) + kd (v<sub>ref</sub> − v) moves the joint "
        "against armature, friction and offset; where an encoder reads 0, the joint is at zero "
        "in the URDF."
    )
    if _is_driven(content):
        words = "The logged torque moves the joint against armature, friction and offset."
    return (
        f"<p>{words} Value ± standard error; what has none was stated or is held.</p>\n"
        + table("Drives, joint by joint", headers, rows, is_data=True)
        + folded("intervals", "All drive parameters with their intervals", every)
    )


def _error(entry: Mapping[str, Any]) -> float:
    error = entry.get("std_error")
    return math.nan if error is None else float(error)


def _terms(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the parameters that drives have, but for those that are 0 and held of all of them.

    Those of the controller come first.
    """
    said = [entry for entry in entries if entry["value"] or entry.get("std_error") is not None]
    found = dict.fromkeys(entry["name"].rpartition(".")[2] for entry in said)
    return sorted(found, key=lambda term: (*_FIRST_TERMS, term).index(term))


def _short(entry: Mapping[str, Any] | None) -> Cell:
    """Return a parameter with its standard error in one cell; times in ms."""
    if entry is None:
        return number(None)
    scale = 1e3 if entry["unit"] == "s" else 1.0
    value, error = with_error(scale * entry["value"], scale * _error(entry))
    if error.value is None:
        return value
    return Cell(f"{value.html} ± {error.html}", "number", value.value)


def _undetermined(content: Mapping[str, Any]) -> str:
    """Return what positions and commands alone do not determine."""
    structure = content["structure"]
    names = structure["undetermined"]
    parts = []
    if names:
        items = "".join(f"<li>{escape(name)}</li>" for name in names)
        parts.append(f"<p>The logs leave these open:</p>\n<ul>{items}</ul>\n")
    elif alike := [f for f in content.get("warnings", ()) if f["code"] == "commands_alike"]:
        names = escape(listed([f["where"] for f in alike]))
        parts.append(
            "<p>Every parameter has a standard error by this model, but some commands are "
            f"proportional (commands_alike: {names}): effects of one joint on another are not "
            "distinguishable from its own.</p>\n"
        )
    else:
        parts.append("<p>The logs determine all that was to be found.</p>\n")
    for entry in structure.get("not_told_apart", []):
        parts.append(f"<p>Only together: {escape(listed(entry['names']))}.</p>\n")
    if _is_driven(content):
        return "".join(parts)
    parts.append(
        "<p>Positions and commands tell torques up to one factor: with gains, inertias, frictions "
        "and masses all larger by it, the motion is the same. What was stated or is held sets it: "
        f"{escape(_held(content))}.</p>\n"
    )
    return "".join(parts)


def _held(content: Mapping[str, Any]) -> str:
    """Return which drive parameters were stated or are held, those of all joints by their term."""
    held: dict[str, list[str]] = {}
    for entry in content["drive_parameters"]:
        if entry["value"] and entry.get("std_error") is None:
            joint, _, term = entry["name"].rpartition(".")
            held.setdefault(term, []).append(joint)
    every = len(content["joints"])
    said = [
        f"{term} of {'every joint' if len(joints) == every else listed(joints, 4)}"
        for term, joints in held.items()
    ]
    return listed([*said, "masses of the URDF"])


def _appendix(content: Mapping[str, Any]) -> str:
    controller = content["simulation"]["controller"]
    rows = [[text(key), text(_words(value))] for key, value in controller.items()]
    parts = {
        "open": ("What the data do not determine", _undetermined(content)),
        "settings": ("Controller", table("Controller", ["setting", "value"], rows)),
        "inputs": ("Inputs", input_table(content["inputs"])),
        "versions": (
            "Versions",
            version_table({"robotid": content["robotid"], **content.get("versions", {})}),
        ),
    }
    return "".join(folded(key, title, html) for key, (title, html) in parts.items()) + (
        f'<p class="note">Written by robotid {__version__}.</p>\n'
    )


def _words(value: Any) -> str:  # noqa: ANN401
    if value is None:
        return "none"
    if isinstance(value, Mapping):
        return listed(f"{key} {_words(x)}" for key, x in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)
