"""What the report shows of an identification by simulation, from its result.json and its logs."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.closed_loop.evaluation import DRIFTS, OpenLoop
from robotid.exceptions import DataError
from robotid.export.ranges import source_of
from robotid.findings import Finding, listed
from robotid.pages.charts import Chart, Series, chart_html
from robotid.pages.html import code, number, table, text
from robotid.report.advice import Origin, loop_steps
from robotid.report.curves import curves_section, drawn
from robotid.report.errors import POSITION, Errors, worst_errors
from robotid.report.shown import Shown
from robotid.report.tables import input_table, parameter_section, version_table
from robotid.robot.model import RobotModel

__all__ = ["shown_positions"]

_NAMED = 7  # joints whose errors over the horizon are drawn
_ROLES = {"validation": "not fitted", "identification": "fitted"}
_ERRORS = (
    "<p>error = 100 |q − simulated| / |motion|, of the motion about its mean. The identified robot "
    "starts where the log starts and then hears the commands alone; over horizons, it is put back "
    "to what was measured after each. For comparison, the error of the command taken for the "
    "position, of the URDF with the stated gains and neither friction nor delay, and of a model of "
    "second order for each joint by itself.</p>\n"
)
_DRIVEN_ERRORS = (
    "<p>error = 100 |q − simulated| / |motion|. The logged torque alone drives the identified "
    f"robot, which is put back to what was measured every {DRIFTS:g} s, or after another horizon. "
    "For comparison, the error of what the torques determine by themselves, of the URDF with "
    "drives fitted to them, and of going on at the speed of the start.</p>\n"
)
_PARAMETERS = (
    "τ = kp (q<sub>ref</sub>(t − delay) − q) + kd (v<sub>ref</sub> − v) moves the joint against "
    "armature, friction and offset; where an encoder reads 0, the joint is at zero in the URDF."
)
_DRIVEN = "The logged torque moves the joint against armature, friction and offset."


def shown_positions(
    content: Mapping[str, Any],
    fitted: Sequence[OpenLoop],
    kept: Sequence[OpenLoop],
    origin: Origin,
    changed: tuple[RobotModel, Array] | None = None,
) -> Shown:
    """Return what a report shows of a result.

    Args:
        content: Content of the result.json.
        fitted: The fitted logs, with the positions simulated for them.
        kept: The same of validation logs.
        origin: Where the result is, for commands.
        changed: The robot of the URDF and its identified standard parameters, shape (p,), SI
            units; None if the URDF is not at hand.

    Raises:
        DataError: If a log has other joints than the result.
    """
    joints, is_driven = content["joints"], _is_driven(content)
    for run in (*kept, *fitted):
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
    apart = [
        Errors(entry.get("name", Path(entry["log"]).name), entry["per_joint"])
        for entry in content["validation"]
    ]
    entries = [
        entry | {"source": source_of(entry)}
        for key in ("standard_parameters", "drive_parameters")
        for entry in content[key]
    ]
    worst = list(worst_errors(apart or [whole]))
    source = "roll-outs of its torques" if is_driven else "commands"
    model, standard = changed or (None, np.zeros(0))
    return Shown(
        title=f"{content['robot']}: drives from {source}",
        robot=content["robot"],
        rows=joints,
        verdict=content["verdict"],
        findings=[
            Finding(entry["code"], entry["severity"], entry["where"], entry["message"])
            for entry in content.get("warnings", [])
        ],
        quantity=POSITION,
        counted=apart or [whole],
        recordings=[*apart, whole],
        facts=_facts(content),
        steps=loop_steps(content, origin),
        made=f"<p>{escape(_made(content, names))}</p>\n",
        errors=(_DRIVEN_ERRORS if is_driven else _ERRORS, _horizons(content)),
        curves=("Positions", _positions(content, fitted, kept, worst)),
        why="",
        parameters=parameter_section(
            model, standard, entries, _DRIVEN if is_driven else _PARAMETERS
        ),
        entries=entries,
        appendix={
            "open": ("What the data do not determine", _undetermined(content)),
            "settings": ("Controller", _controller(content)),
            "inputs": ("Inputs", input_table(content["inputs"])),
            "versions": (
                "Versions",
                version_table({"robotid": content["robotid"], **content.get("versions", {})}),
            ),
        },
    )


def _is_driven(content: Mapping[str, Any]) -> bool:
    """Return whether the logged torque drove the robot, which no loop was closed on."""
    return bool(content["simulation"]["controller"]["kind"] == "torque")


def _entries(content: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """Return errors by recording with its role, validation first."""
    found = content["simulation"]
    return [(role, entry) for role in _ROLES for entry in found.get(role, [])]


def _name(entry: Mapping[str, Any]) -> str:
    """Return the name of a recording, as ``OpenLoop.name``."""
    return f"{Path(entry['log']).name} {entry['start']:.4g}-{entry['end']:.4g} s"


def _unit(entry: Mapping[str, Any]) -> str:
    """Return the unit that errors are shown in, "mrad or mm" if some joints are prismatic."""
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
        f"Open-loop position error{over}, {_ROLES[role]}": (
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
        facts["By comparison, times that error"] = escape(", ".join(times))
    return facts


def _made(content: Mapping[str, Any], names: Mapping[str, Sequence[str]]) -> str:
    """Return what was fitted to what."""
    fit, kept = content["simulation"].get("fit", {}), names["validation"]
    count = f"{fit['parameters']} parameters" if "parameters" in fit else "Parameters"
    return (
        f"{count} of {len(content['joints'])} joints were fitted to "
        f"{listed(names['identification'])} by {content['settings']['estimator']['name']}. "
        + (f"Validation: {listed(kept)}." if kept else "There is no validation log.")
    )


def _horizons(content: Mapping[str, Any]) -> str:
    """Return errors over how long the open loop has run, of the worst joints as a chart."""
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
        "position error over the horizon of the open loop", x,
        (*series, Series("geometric mean of all", _curve(means), "text")),
        "time since the open loop began [s]", f"RMSE [{_unit(entry)}]", logarithmic="xy",
        height=220,
    )  # fmt: skip
    words = [f"the worst {_NAMED} joints"] if len(lines) > _NAMED else []
    words += ["the whole recording last"] if len(x) > len(entry.get("horizons", {})) else []
    said = f"{', '.join(['Error over horizon', *words])}: {escape(_name(entry))}, {_ROLES[role]}"
    return chart_html(chart, said) + "".join(_horizon_table(*each) for each in _entries(content))


def _by_horizon(entry: Mapping[str, Any]) -> dict[float, Mapping[str, float]]:
    """Return the errors of joints by horizon [s], that of the whole recording among them."""
    errors = {float(key): own for key, own in entry.get("horizons", {}).items()}
    joints = entry["per_joint"]
    if "steady_rmse" not in next(iter(joints.values())):  # which is put back again and again
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
    kept: Sequence[OpenLoop],
    worst: Sequence[str],
) -> str:
    """Return charts of each joint in every log."""
    joints, count = content["joints"], len(kept)
    shown = drawn([*kept, *fitted], joints)
    if not shown:
        return "<p>No log is at hand to be shown.</p>\n"
    units = {name: each["unit"] for _, entry in _entries(content)
             for name, each in entry["per_joint"].items()}  # fmt: skip
    words = (
        f"Measured and simulated position, the simulation put back every {DRIFTS:g} s"
        if _is_driven(content)
        else "Commanded, measured and simulated position, the simulation in open loop from the "
        "first sample"
    )
    said = f"<p>{words}; below, what is left. Drag to zoom; double-click or Escape shows all.</p>\n"
    if left := [run.name for run in [*kept, *fitted][len(shown) :]]:
        said += f"<p>Not drawn, to keep the file small: {escape(', '.join(left))}.</p>\n"
    runs = {
        f"log {k}": (run, "not fitted" if k < count else "fitted") for k, run in enumerate(shown)
    }

    def charts(of: tuple[OpenLoop, str], row: int, link: str, points: int) -> str:
        unit = units.get(joints[row], "rad")
        return _charts(*of, row, joints[row], unit, link=link, points=points)

    verdicts = content["verdict"].get("per_joint", {})
    return curves_section(said, runs, joints, verdicts, worst, charts)


def _charts(
    run: OpenLoop, kind: str, j: int, joint: str, unit: str, *, link: str, points: int
) -> str:
    """Return positions of a joint in a log, and how far they are from what was measured."""
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
    """Return what positions and commands alone do not determine."""
    structure = content["structure"]
    names = structure["undetermined"]
    parts = []
    if names:
        items = "".join(f"<li>{escape(name)}</li>" for name in names)
        parts.append(f"<p>The logs leave these open:</p>\n<ul>{items}</ul>\n")
    elif alike := [f for f in content.get("warnings", ()) if f["code"] == "proportional_commands"]:
        names = escape(listed([f["where"] for f in alike]))
        parts.append(
            "<p>Every parameter has a standard error by this model, but some commands are "
            f"proportional (proportional_commands: {names}): effects of one joint on another "
            "are not distinguishable from its own.</p>\n"
        )
    else:
        parts.append("<p>The logs determine all that was to be found.</p>\n")
    for entry in structure.get("indistinguishable", []):
        parts.append(f"<p>Only together: {escape(listed(entry['names']))}.</p>\n")
    if _is_driven(content):
        return "".join(parts)
    parts.append(
        "<p>Positions and commands determine torques up to one factor: with gains, inertias, "
        "frictions and masses all larger by it, the motion is the same. What was stated or is held "
        "sets it: "
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
