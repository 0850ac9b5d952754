"""The page of a designed motion: criterion, smallest margin to each limit, expected errors."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.files import write_text
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.base.versions import __version__
from robotid.design.limits import LIMITS, Course
from robotid.design.previews import Preview
from robotid.output.pages.html import (
    TONES,
    Chart,
    Section,
    Series,
    block,
    chart_html,
    facts_html,
    listing,
    page,
    paragraphs,
)
from robotid.robot.model import RobotModel

_UNITS = ("rad", "rad/s", "rad/s²", "rad/s³", "N m", "W")
_PRISMATIC = ("m", "m/s", "m/s²", "m/s³", "N", "W")
_COLUMNS = (
    ("limit", "text", "kind"), ("largest use %", "%", "use"), ("margin %", "%", "margin"),
    ("joint", "code", "joint"), ("at [s]", ".2f", "time"), ("value of limit", ".4g", "limit"),
    ("unit", "text", "unit"),
)  # fmt: skip
UNCHECKED = {
    "unread": "not checked, because no shape of these links can be read",
    "left_alone": "not checked, because these links touch by design",
    "built_near": "close by design, with half of their median distance as clearance",
}
_NAMED = 5  # base parameters with the largest expected standard errors that are named
_SHARP = 0.1  # share of the plausible range below which one is well determined ...
_OPEN = 0.5  # ... and above which it is undetermined


def write_motion_page(
    target: str | Path,
    model: RobotModel,
    content: Mapping[str, Any],
    course: Course,
    expected: Preview,
) -> Path:
    """Write a designed motion's use of the limits and its expected errors, as one HTML file."""
    sections = {
        "limits": Section("Smallest margin to each limit", _limit_table(model, content, course)),
        "time": Section("Course over time", _over_time(model, content, course)),
        "expected": Section("Expected standard errors", _expected(expected)),
    }
    title = f"{model.name}: excitation trajectory"
    return write_text(page(title, _head(model, content), sections), target)


def search_figures(content: Mapping[str, Any]) -> tuple[str, str]:
    """Return the condition number of a motion and the computing time of its design, as text."""
    condition, how = content["condition_number"], f"{content['seconds']:.1f} s"
    if content["starts"]:
        settled = "converged" if content["converged"] else "not converged: increase --seconds"
        how += f", {content['starts']} start{'s' * (content['starts'] != 1)}, {settled}"
    number = "infinite" if condition is None else f"{condition:.0f}"
    return f"{number} (regressor, columns in units of the prior)", how


def _head(model: RobotModel, content: Mapping[str, Any]) -> str:
    condition, how = search_figures(content)
    facts = {
        "motion": f"{content['kind']}, {content['duration']:.4g} s",
        "joints": f"{len(model.joints)}",
        "criterion": content["criterion"],
        "condition number": condition,
        "computing time": how,
    }
    html = facts_html({name: escape(value) for name, value in facts.items()})
    return block("motion.head", robot=escape(model.name), facts=html, version=__version__)


def _limit_table(model: RobotModel, content: Mapping[str, Any], course: Course) -> str:
    rows = []
    for k, kind in enumerate(LIMITS):
        if entry := content["limits"].get(kind):
            joint = model.joints.index(entry["where"])
            units = _PRISMATIC if entry["where"] in model.layout.prismatic else _UNITS
            share = 100 * entry["margin"]
            rows.append(
                {"kind": kind, "use": 100 - share, "margin": share, "joint": entry["where"],
                 "time": course.peak(kind, joint), "limit": course.limits.sizes[k, joint],
                 "unit": units[k]}
            )  # fmt: skip
    table = listing("Largest use of each limit", _COLUMNS, rows)
    used = block("motion.limits", share=f"{100 * content['share']:.0f}", table=table)
    return used + _collisions(content, course)


def _collisions(content: Mapping[str, Any], course: Course) -> str:
    """Return the smallest margin of the motion to a collision, and what was not checked."""
    entry, contact = content["limits"].get("collision"), course.nearest
    if entry is None or course.clearance is None:
        return "<p>Collisions were not checked.</p>\n"
    html, where = "<p>No two links can collide.</p>\n", entry["where"]
    if entry["margin"] is not None:
        required, between = entry["kept"], ", also between samples"
        html = _nearest(where, entry["margin"] + required, entry["time"], required, between)
    elif contact is not None:
        where = f"{contact.first} and {contact.second}"
        html = _nearest(where, contact.distance, contact.time, contact.required)
    for key, words in ((key, words) for key, words in UNCHECKED.items() if entry[key]):
        html += f"<p>{words.capitalize()}: {escape(listed(entry[key]))}.</p>\n"
    return html


def _nearest(where: str, distance: float, time: float, required: float, between: str = "") -> str:
    figures = {"distance": f"{1e3 * distance:.0f}", "required": f"{1e3 * required:.0f}"}  # [mm]
    figures |= {"where": escape(where), "time": f"{time:.2f}", "between": between}
    return block("motion.collisions", **figures)


def _over_time(model: RobotModel, content: Mapping[str, Any], course: Course) -> str:
    charts = []
    for k, kind in enumerate(LIMITS):
        is_limited = np.isfinite(course.limits.sizes[k])
        joints, free = np.flatnonzero(is_limited), np.flatnonzero(~is_limited)
        if len(joints):
            bound = np.full(len(course.t), 100.0)
            edges = [Series("limit", bound, "text"), Series("limit", -bound, "text")]
            series = (*edges, *_lines(model, 100.0 * course.used[k], joints))
            title = f"{kind} of each joint relative to its limit"
            chart = Chart(title, course.t, series, "time [s]", "% of the limit", "time")
            charts.append(chart_html(chart, kind.capitalize()))
        if len(free) and kind in ("acceleration", "torque"):
            prismatic = [model.joints[j] in model.layout.prismatic for j in free]
            units = [_UNITS[k]] * (not all(prismatic)) + [_PRISMATIC[k]] * any(prismatic)
            name, lines = f"{kind} [{' or '.join(units)}]", _lines(model, course.values[k], free)
            chart = Chart(f"{kind} of each joint", course.t, tuple(lines), "time [s]", name, "time")
            charts.append(chart_html(chart, f"{kind.capitalize()} without a limit"))
    return f'<div class="plots">\n{"".join(charts)}</div>\n'


def _lines(model: RobotModel, values: Array, joints: Array) -> list[Series]:
    return [Series(model.joints[j], values[:, j], f"tone-{j % TONES + 1}") for j in joints.tolist()]


def _expected(preview: Preview) -> str:
    found, noise = preview.expected, preview.noise
    ratio = np.minimum(preview.base_error / preview.plausible, 1.0)
    order = np.argsort(-ratio, kind="stable")[:_NAMED]
    names = found.mapping.base_names
    least = [f"{names[k]} {100 * ratio[k]:.0f} %" for k in order if ratio[k] > _OPEN]
    rows = zip(found.model.joints, noise.std, found.model.row_units, strict=True)
    stds = [f"{joint} {std:.2g} {unit}" for joint, std, unit in rows]
    sentences = [
        f"{preview.words}.",
        f"Of {len(ratio)} base parameters, {int((ratio < _SHARP).sum())} have an expected standard "
        f"error below 10 % of their plausible range, {int((ratio > _OPEN).sum())} above 50 %.",
        f"Largest, in % of the plausible range: {', '.join(least)}." if least else "",
        f"Torque noise, {listed(dict.fromkeys(noise.origins))}, RMS: {', '.join(stds)}.",
    ]
    return paragraphs(sentences)
