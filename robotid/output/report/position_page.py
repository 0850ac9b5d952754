"""The content of a report on a closed-loop identification, from its result.json and logs."""

import math
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import Finding, grouped, listed
from robotid.base.text import period
from robotid.base.typing import Array
from robotid.identification.closed_loop.position_errors import DRIFTS, OpenLoop, position_metrics
from robotid.output.files.ranges import source_of
from robotid.output.pages.charts import Chart, Series, chart_html
from robotid.output.pages.html import code, number, table, text
from robotid.output.report.dock import Clip, Dock, Residual, worst_html, worst_second
from robotid.output.report.errors import POSITION, Errors, worst_errors
from robotid.output.report.loop_steps import loop_steps
from robotid.output.report.report_page import Report, cause_links, curves_section, drawn
from robotid.output.report.steps import Origin
from robotid.output.report.tables import input_table, parameter_section, version_table
from robotid.robot.model import RobotModel

_NAMED = 7  # joints in the chart of errors over the horizon
_ROLES = {"validation": "not fitted", "identification": "fitted"}
_ERRORS = (
    "<p>error = 100 |q − simulated| / |motion|, with the motion about its mean. The simulation "
    "starts at the log's first sample and has the commands as its only input; errors over "
    "horizons are of simulations that restart from the measurement after each horizon. For "
    "comparison: the error of the command as position,{} and of a second-order model of each joint "
    "alone.</p>\n"
)
_STATED = " of the URDF with the stated gains, without friction and delay,"
_DRIVEN_ERRORS = (
    "<p>error = 100 |q − simulated| / |motion|. The simulation has the logged torque as its only "
    f"input and restarts from the measurement every {DRIFTS:g} s, or after another horizon. "
    "For comparison: the error of the parameters fitted to torques only, of the URDF with "
    "drives fitted to torques, and of a motion at constant speed.</p>\n"
)
_PARAMETERS = (
    "Motor torque: τ = kp (q<sub>ref</sub>(t − delay) − q) + kd (v<sub>ref</sub> − v). It moves "
    "armature, links, friction and offset. zero: position of the joint in the URDF where its "
    "encoder reads 0."
)
_DRIVEN = "The logged torque moves armature, links, friction and offset."


def shown_positions(
    content: Mapping[str, Any],
    fitted: Sequence[OpenLoop],
    validation: Sequence[OpenLoop],
    origin: Origin,
    changed: tuple[RobotModel, Array] | None = None,
    replay: str = "",
) -> Report:
    """Return the content of a report on a result: changed (p,)."""
    joints, is_driven = content["joints"], _is_driven(content)
    for run in (*validation, *fitted):
        if run.q.shape[1] != len(joints):
            raise DataError(f"{run.log.name} has {run.q.shape[1]} joints, the result {len(joints)}")
    names = {
        role: [_name(entry) for entry in content["simulation"].get(role, [])] for role in _ROLES
    }
    together = names["identification"]
    whole = Errors(
        together[0] if len(together) == 1 else "",
        content["identification"]["per_joint"],
        is_fitted=True,
    )
    validated = [
        Errors(entry.get("name", Path(entry["log"]).name), entry["per_joint"])
        for entry in content["validation"]
    ]
    entries = [
        entry | {"source": source_of(entry)}
        for key in ("standard_parameters", "drive_parameters")
        for entry in content[key]
    ]
    model, standard = changed or (None, np.zeros(0))
    counted = _counted(model, validation or fitted, bool(validation)) or validated or [whole]
    worst = list(worst_errors(counted))
    source = "torque-driven simulation" if is_driven else "commands"
    findings = [
        Finding(entry["code"], entry["severity"], entry["where"], entry["message"])
        for entry in content.get("warnings", [])
    ]
    return Report(
        title=f"{content['robot']}: drives from {source}",
        robot=content["robot"],
        rows=joints,
        verdict=content["verdict"],
        findings=findings,
        quantity=POSITION,
        counted=counted,
        recordings=[*validated, whole],
        facts=_facts(content) | _warned(findings, joints),
        steps=loop_steps(content, origin),
        made=f"<p>{escape(_method(content, names))}</p>\n",
        errors=(_compared(content, is_driven=is_driven), _horizons(content)),
        curves=("Positions", _positions(content, fitted, validation, worst, origin, replay)),
        why="",
        parameters=parameter_section(
            model, standard, entries, _DRIVEN if is_driven else _PARAMETERS
        ),
        entries=entries,
        appendix={
            "open": ("Parameters not identifiable", _undetermined(content)),
            "settings": ("Controller", _controller(content)),
            "inputs": ("Inputs", input_table(content["inputs"])),
            "versions": (
                "Versions",
                version_table({"robotid": content["robotid"], **content.get("versions", {})}),
            ),
        },
    )


def _counted(
    model: RobotModel | None, runs: Sequence[OpenLoop], is_validation: bool
) -> list[Errors]:
    """Return the errors that the verdict uses: of all logs that move a joint, together."""
    if model is None or not runs:
        return []
    name = runs[0].name if len(runs) == 1 else f"{len(runs)} logs together"
    joints = position_metrics(model, runs, moving=True).to_dict()["per_joint"]
    return [Errors(name, joints, is_fitted=not is_validation)]


def _warned(findings: Sequence[Finding], joints: Sequence[str]) -> dict[str, str]:
    """Return links to the errors and warnings, for the figures beside the verdict."""
    causes = grouped([f for f in findings if f.severity != "note"], joints)
    return {"Errors and warnings": cause_links(causes)} if causes else {}


def _is_driven(content: Mapping[str, Any]) -> bool:
    """Return whether the logged torque is the simulation's input, without a controller."""
    return bool(content["simulation"]["controller"]["kind"] == "torque")


def _entries(content: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """Return errors by recording with its role, validation first."""
    found = content["simulation"]
    return [(role, entry) for role in _ROLES for entry in found.get(role, [])]


def _name(entry: Mapping[str, Any]) -> str:
    """Return the name of a recording, as ``OpenLoop.name``."""
    return f"{Path(entry['log']).name} {period(entry['start'], entry['end'])}"


def _unit(entry: Mapping[str, Any]) -> str:
    """Return the unit of the errors, "mrad or mm" if some joints are prismatic."""
    units = dict.fromkeys(each["unit"] for each in entry["per_joint"].values())
    return " or ".join(f"{POSITION.prefix}{unit}" for unit in units)


def _mean(values: Sequence[float | None]) -> float | None:
    """Return the geometric mean; None if a value is missing."""
    if any(value is None or not value > 0 for value in values):
        return None
    return math.exp(float(np.mean(np.log(np.array(values, dtype=float)))))


def _scaled(value: float | None) -> float | None:
    return None if value is None else value / POSITION.scale


def _facts(content: Mapping[str, Any]) -> dict[str, str]:
    role, entry = _entries(content)[0]
    joints = entry["per_joint"].values()
    ours = _mean([each["rmse"] for each in joints])
    over = f" over {DRIFTS:g} s" if _is_driven(content) else ""
    facts = {
        f"Simulated position error{over}, {_ROLES[role]}": (
            f"<strong>{number(_scaled(ours), '.3g').html} {_unit(entry)}</strong>, geometric mean "
            f"of {len(joints)} joint{'s' if len(joints) > 1 else ''}"
        )
    }
    times = [
        f"{mark.words} {(ratio := theirs / ours):{'.2g' if ratio < 99.5 else '.0f'}} ×"
        for key, mark in POSITION.marks.items()
        if ours and (theirs := _mean([each.get(f"{key}_rmse") for each in joints]))
    ]
    if times:
        facts["Other predictions, relative to this error"] = escape(", ".join(times))
    return facts


def _method(content: Mapping[str, Any], names: Mapping[str, Sequence[str]]) -> str:
    """Return a description of the fit and its logs."""
    fit, validation = content["simulation"].get("fit", {}), names["validation"]
    count = f"{fit['parameters']} parameters" if "parameters" in fit else "Parameters"
    return (
        f"{count} of {len(content['joints'])} joints were fitted to "
        f"{listed(names['identification'])} by {content['settings']['estimator']['name']}. "
        + (f"Validation: {listed(validation)}." if validation else "There is no validation log.")
    )


def _compared(content: Mapping[str, Any], *, is_driven: bool) -> str:
    """Return what the error is and which simpler models stand beside it."""
    if is_driven:
        return _DRIVEN_ERRORS
    runs = [content["identification"], *content["validation"]]
    errors = [m.get("urdf_relative_error_pct") for run in runs for m in run["per_joint"].values()]
    return _ERRORS.format(_STATED if any(error is not None for error in errors) else "")


def _horizons(content: Mapping[str, Any]) -> str:
    """Return errors over the horizon of the simulation: a chart of the worst joints, and tables."""
    (role, entry), *_ = _entries(content)
    order = sorted(entry["per_joint"].items(), key=lambda item: -item[1]["rmse"])
    errors = _by_horizon({**entry, "per_joint": dict(order)})
    x = np.array(sorted(errors))
    lines = {name: [errors[h].get(name) for h in x.tolist()] for name, _ in order}
    means = [_mean([own[k] for own in lines.values()]) for k in range(len(x))]
    series = [
        Series(name, _curve(ys), f"tone-{k + 1}", is_weak=True)
        for k, (name, ys) in enumerate([*lines.items()][:_NAMED])
    ]
    chart = Chart(
        "position error over the horizon of the simulation", x,
        (*series, Series("geometric mean", _curve(means), "text")),
        "horizon [s]", f"RMSE [{_unit(entry)}]", logarithmic="xy",
        height=220,
    )  # fmt: skip
    words = [f"the worst {_NAMED} joints"] if len(lines) > _NAMED else []
    words += ["whole recording at the end"] if len(x) > len(entry.get("horizons", {})) else []
    caption = f"{', '.join(['Error over horizon', *words])}: {escape(_name(entry))}, {_ROLES[role]}"
    return chart_html(chart, caption) + "".join(_horizon_table(*each) for each in _entries(content))


def _by_horizon(entry: Mapping[str, Any]) -> dict[float, Mapping[str, float]]:
    """Return the errors of the joints by horizon [s], including the whole recording."""
    errors = {float(key): own for key, own in entry.get("horizons", {}).items()}
    joints = entry["per_joint"]
    if "steady_rmse" not in next(iter(joints.values())):  # no restarts
        errors[entry["end"] - entry["start"]] = {name: x["rmse"] for name, x in joints.items()}
    return errors


def _curve(values: Sequence[float | None]) -> Array:
    return np.array([math.nan if value is None else value / POSITION.scale for value in values])


def _horizon_table(role: str, entry: Mapping[str, Any]) -> str:
    joints, errors = entry["per_joint"], _by_horizon(entry)
    rows = [
        [code(name), *(number(_scaled(own.get(name)), "#.3g") for own in errors.values())]
        for name in joints
    ]
    means = [_mean([own.get(name) for name in joints]) for own in errors.values()]
    foot = [text("geometric mean"), *(number(_scaled(mean), "#.3g") for mean in means)]
    caption = f"{_name(entry)}, {_ROLES[role]}: error over the horizon, {_unit(entry)}"
    return table(caption, ["joint", *(f"{h:.4g} s" for h in errors)], rows, foot, is_data=True)


def _positions(
    content: Mapping[str, Any],
    fitted: Sequence[OpenLoop],
    validation: Sequence[OpenLoop],
    worst: Sequence[str],
    origin: Origin,
    replay: str,
) -> str:
    """Return charts of each joint in every log."""
    joints, count = content["joints"], len(validation)
    shown = drawn([*validation, *fitted], joints)
    if not shown:
        return "<p>The logs are not available.</p>\n"
    units = {name: each["unit"] for _, entry in _entries(content)
             for name, each in entry["per_joint"].items()}  # fmt: skip
    words = (
        f"Measured and simulated position; the simulation restarts every {DRIFTS:g} s"
        if _is_driven(content)
        else "Commanded, measured and simulated position; the simulation starts at the first "
        "sample and has the commands as its only input"
    )
    zoom = "Drag to zoom; double-click or Escape shows all."
    intro = f"<p>{words}. Below: the position error. {zoom}</p>\n"
    if left := [run.name for run in [*validation, *fitted][len(shown) :]]:
        intro += f"<p>Not drawn, to limit the file size: {escape(', '.join(left))}.</p>\n"
    runs = {
        f"log {k}": (run, "not fitted" if k < count else "fitted") for k, run in enumerate(shown)
    }

    urdf = next((x["path"] for x in content["inputs"] if x["role"] == "urdf"), "")
    clips = [Clip(link, str(run.log.path), float(run.log.t[0]), float(run.log.t[-1]))
             for link, (run, _) in runs.items()]  # fmt: skip
    dock = Dock(replay, origin, urdf, clips)

    def charts(of: tuple[OpenLoop, str], row: int, link: str, points: int) -> str:
        unit = units.get(joints[row], "rad")
        return _charts(*of, row, joints[row], unit, link=link, points=points)

    def note(row: int) -> str:
        unit = f"{POSITION.prefix}{units.get(joints[row], 'rad')}"
        seconds = worst_second(_residuals(validation or fitted, row))
        return worst_html(seconds, joints[row], unit, dock, POSITION.scale)

    verdicts = content["verdict"].get("per_joint", {})
    return curves_section(dock.html + intro, runs, joints, verdicts, worst, charts, note, most=1)


def _residuals(runs: Sequence[OpenLoop], j: int) -> Iterator[Residual]:
    """Yield the position errors of a joint."""
    for run in runs:
        yield Residual(run.name, run.log.name, run.log.t, run.log.q[:, j] - run.q[:, j])


def _charts(
    run: OpenLoop, kind: str, j: int, joint: str, unit: str, *, link: str, points: int
) -> str:
    """Return charts of positions and position errors of a joint in a log."""
    log, q, q_sim = run.log, run.log.q[:, j], run.q[:, j]
    positions = [Series("measured", q, "text"), Series("simulated", q_sim, "predicted")]
    left = [Series("measured − simulated", (q - q_sim) / POSITION.scale, "residual")]
    if log.q_ref is not None and not run.is_driven:
        q_ref = log.q_ref[:, j]
        positions.insert(0, Series("commanded", q_ref, "tone-5"))
        far = (q - q_ref) / POSITION.scale
        left.insert(0, Series("measured − commanded", far, "tone-5", is_hidden=True))
    rmse = float(np.sqrt(np.nanmean((q - q_sim) ** 2))) / POSITION.scale
    above = Chart(
        f"position of {joint}", log.t, tuple(positions), "time [s]", f"position [{unit}]", link=link
    )
    below = Chart(
        f"position error of {joint}", log.t, tuple(left), "time [s]", f"error [m{unit}]",
        link=link, height=110,
    )  # fmt: skip
    caption = f"{escape(run.name)}, {kind}: RMSE {rmse:.3g} m{unit}"
    return chart_html(above, caption, points=points) + chart_html(below, "", points=points)


def _undetermined(content: Mapping[str, Any]) -> str:
    """Return the parameters that positions and commands do not determine."""
    structure = content["structure"]
    names = structure["undetermined"]
    parts = []
    if names:
        items = "".join(f"<li>{escape(name)}</li>" for name in names)
        parts.append(f"<p>The logs do not determine:</p>\n<ul>{items}</ul>\n")
    elif alike := [f for f in content.get("warnings", ()) if f["code"] == "proportional_commands"]:
        names = escape(listed([f["where"] for f in alike]))
        parts.append(
            "<p>Every parameter has a standard error in this model, but some commands are "
            f"proportional (proportional_commands: {names}): effects of one joint on another "
            "are not distinguishable from its own.</p>\n"
        )
    else:
        parts.append("<p>The logs determine all free parameters.</p>\n")
    for entry in structure.get("indistinguishable", []):
        parts.append(f"<p>Indistinguishable: {escape(listed(entry['names']))}.</p>\n")
    if _is_driven(content):
        return "".join(parts)
    parts.append(
        "<p>Positions and commands determine torques up to a common factor: gains, inertias, "
        "friction and masses multiplied by this factor cause the same motion. Stated and fixed "
        f"parameters determine the factor: {escape(_fixed(content))}.</p>\n"
    )
    return "".join(parts)


def _fixed(content: Mapping[str, Any]) -> str:
    """Return the stated and fixed drive parameters, by term if all joints have them."""
    fixed: dict[str, list[str]] = {}
    for entry in content["drive_parameters"]:
        if entry["value"] and entry.get("std_error") is None:
            joint, _, term = entry["name"].rpartition(".")
            fixed.setdefault(term, []).append(joint)
    every = len(content["joints"])
    terms = [
        f"{term} of {'all joints' if len(joints) == every else listed(joints, 4)}"
        for term, joints in fixed.items()
    ]
    return listed([*terms, "masses of the URDF"])


def _controller(content: Mapping[str, Any]) -> str:
    controller = content["simulation"]["controller"]
    rows = [[text(key), text(_words(value))] for key, value in controller.items()]
    return table("Controller", ["setting", "value"], rows)


def _words(value: Any) -> str:  # noqa: ANN401
    if value is None:
        return "none"
    if isinstance(value, Mapping):
        return listed(f"{key} {_words(x)}" for key, x in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)
