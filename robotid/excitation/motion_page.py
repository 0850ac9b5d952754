"""The page of a designed motion: what it is, what it uses of each limit, what it will tell."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from robotid._files import write_text
from robotid._typing import Array
from robotid.excitation.clearance import Clearance
from robotid.excitation.course import Course
from robotid.excitation.limits import LIMITS
from robotid.findings import listed
from robotid.identification.previews import Preview
from robotid.pages.charts import Chart, Series, chart_html
from robotid.pages.html import Section, code, facts_html, number, page, percent, table, text
from robotid.robot.model import RobotModel
from robotid.versions import __version__

__all__ = ["write_motion_page"]

_UNITS = ("rad", "rad/s", "rad/s²", "rad/s³", "N m", "W")
_SLIDING = ("m", "m/s", "m/s²", "m/s³", "N", "W")
_TONES = 8  # of lines that can be told apart in one chart
_NAMED = 5  # base parameters that stay open the most
_SHARP = 0.1  # share of the plausible spread below which one is well known ...
_OPEN = 0.5  # ... and above which it is open
_VISIBLE = 1e-3  # change of a criterion that is worth a chart
_WIDE = 10.0  # ratio of distances from which their axis is logarithmic
_SOURCES = {
    "data": "by the motion",
    "mixed": "by motion and URDF together",
    "prior": "by the URDF alone",
    "bound": "by what is physically possible",
}
_CRITERIA = {
    "D": "D: −log det of the information, by parameter",
    "A": "A: log of the mean variance",
    "E": "E: −log of the weakest direction's information",
    "condition": "log of the information's condition number",
    "widest": "mean log variance of the quarter of the parameters that was known the least",
}


def write_motion_page(
    target: str | Path,
    model: RobotModel,
    content: Mapping[str, Any],
    course: Course,
    expected: Preview | Sequence[str],
) -> Path:
    """Write what a designed motion uses and what it will tell, as one HTML file.

    The file fetches nothing. It is made beside its target and then put in place.

    Args:
        target: The file to write.
        model: The robot.
        content: What ``robotid excite --json`` prints of the motion.
        course: The motion over time.
        expected: What is to be expected of it; or sentences that say so.

    Returns:
        Path of the file.

    Raises:
        DataError: If the folder of the target does not exist.
    """
    told = _expected(expected) if isinstance(expected, Preview) else _paragraphs(expected)
    sections = {
        "limits": Section("Limits", _limit_table(model, content, course)),
        "time": Section("Over time", _over_time(model, content, course)),
        "expected": Section("What it will tell", told),
    }
    best = [entry[1] for entry in content["history"]]
    if best and max(best) - min(best) > _VISIBLE:
        sections["design"] = Section("How it was found", _history(content))
    title = f"{model.name}: excitation trajectory"
    return write_text(page(title, _head(model, content), sections), target)


def _head(model: RobotModel, content: Mapping[str, Any]) -> str:
    """Return what was designed, and how."""
    condition = content["condition_number"]
    how = f"{content['seconds']:.1f} s"
    if content["starts"]:
        settled = "settled" if content["converged"] else "not settled: more seconds may improve it"
        plural = "start" if content["starts"] == 1 else "starts"
        how += f", {content['starts']} {plural}, {settled}"
    facts = {
        "motion": f"{content['kind']}, {content['duration']:.4g} s",
        "joints": f"{len(model.joints)}",
        "criterion": content["criterion"],
        "condition number": (
            "infinite" if condition is None else f"{condition:,.0f}, in units of the URDF's spread"
        ),
        "designed in": how,
    }
    said = facts_html({name: escape(value) for name, value in facts.items()})
    return (
        f"<h1>{escape(model.name)}: excitation trajectory</h1>\n{said}"
        "<p>Torques depend on the URDF's masses and on assumed friction. Play the motion slowly "
        f'first.</p>\n<p class="note">Written by robotid {__version__}.</p>\n'
    )


def _limit_table(model: RobotModel, content: Mapping[str, Any], course: Course) -> str:
    """Return the most that is used of each limit, where and when, and what is left."""
    rows = []
    for kind, entry in content["limits"].items():
        if kind == "collision":
            continue
        joint, k = model.joints.index(entry["where"]), LIMITS.index(kind)
        unit = (_SLIDING if entry["where"] in model.layout.prismatic else _UNITS)[k]
        rows.append(
            [
                text(kind),
                percent(100 * (1.0 - entry["margin"])),
                percent(100 * entry["margin"]),
                code(entry["where"]),
                number(course.peak(kind, joint), ".2f"),
                number(float(course.limits.sizes[k, joint]), ".4g"),
                text(unit),
            ]
        )
    headers = ["limit", "most used %", "left %", "joint", "at [s]", "its limit", "unit"]
    said = (
        f"<p>100 % is {100 * content['share']:.0f} % of what the URDF states of position, velocity "
        "and torque, and what was stated of the others. Positions count from the middle of their "
        "range.</p>\n"
    )
    return said + table("Largest share of each limit", headers, rows) + _collisions(content, course)


def _collisions(content: Mapping[str, Any], course: Course) -> str:
    """Return in words how near the motion comes to a collision."""
    entry, contact = content["limits"].get("collision"), course.nearest
    if entry is None or course.clearance is None:
        return "<p>Collisions were not looked at.</p>\n"
    said = "No two links can collide."
    if entry["margin"] is not None:
        kept = entry["kept"]
        said = (
            f"Nearest to a collision: {entry['where']} come to "
            f"{1e3 * (entry['margin'] + kept):.0f} mm at {entry['time']:.2f} s; "
            f"{1e3 * kept:.0f} mm are kept, between the instants, too."
        )
    elif contact is not None:
        said = (
            f"Nearest to a collision: {contact.first} and {contact.second}, "
            f"{1e3 * contact.distance:.0f} mm apart at {contact.time:.2f} s; "
            f"{1e3 * contact.kept:.0f} mm are kept."
        )
    if entry["unread"]:
        said += f" Not looked at, since no shape can be read: {listed(entry['unread'])}."
    if entry["left_alone"]:
        said += f" Made to touch, and not looked at: {listed(entry['left_alone'])}."
    if entry["built_near"]:
        said += f" Built near each other, and kept apart by less: {listed(entry['built_near'])}."
    return f"<p>{escape(said)}</p>\n"


def _over_time(model: RobotModel, content: Mapping[str, Any], course: Course) -> str:
    """Return charts of what is used of each limit, of what has none, and of distances."""
    charts = []
    for k, kind in enumerate(LIMITS):
        is_limited = np.isfinite(course.limits.sizes[k])
        if is_limited.any():
            charts.append(_share_chart(model, course, kind, np.flatnonzero(is_limited)))
        free = np.flatnonzero(~is_limited)
        if len(free) and kind in ("acceleration", "torque"):
            charts.append(_free_chart(model, course, kind, free))
    if course.clearance is not None and course.nearest is not None:
        charts.append(_distance_chart(model, course, course.clearance))
    return f'<div class="plots">\n{"".join(charts)}</div>\n'


def _share_chart(model: RobotModel, course: Course, kind: str, joints: Array) -> str:
    """Return the chart of what joints use of a limit."""
    bound = np.full(len(course.t), 100.0)
    lines = _lines(model, 100.0 * course.used[LIMITS.index(kind)], joints)
    edges = [Series(label, sign * bound, "text") for label, sign in (("limit", 1), ("−limit", -1))]
    chart = Chart(
        f"{kind} of each joint as a share of its limit", course.t, (*edges, *lines),
        "time [s]", "% of the limit", link="time",
    )  # fmt: skip
    return chart_html(chart, f"{kind.capitalize()}, % of the limit")


def _free_chart(model: RobotModel, course: Course, kind: str, joints: Array) -> str:
    """Return the chart of what has no limit, in its unit."""
    k = LIMITS.index(kind)
    slides = [model.joints[j] in model.layout.prismatic for j in joints]
    units = [_UNITS[k]] * (not all(slides)) + [_SLIDING[k]] * any(slides)
    unit, lines = " or ".join(units), _lines(model, course.values[k], joints)
    chart = Chart(
        f"{kind} of each joint", course.t, tuple(lines), "time [s]", f"{kind} [{unit}]",
        link="time",
    )  # fmt: skip
    return chart_html(chart, f"{kind.capitalize()}, of which no limit was stated")


def _lines(model: RobotModel, values: Array, joints: Array) -> list[Series]:
    return [
        Series(model.joints[j], values[:, j], f"tone-{j % _TONES + 1}") for j in joints.tolist()
    ]


def _distance_chart(model: RobotModel, course: Course, clearance: Clearance) -> str:
    """Return the chart of distances between links, and to what stands around them."""
    course = course.thinned
    own = np.array([b in model.tree.links and a in model.tree.links for a, b in clearance.named])
    series = [Series("clearance", np.full(len(course.t), 1e3 * clearance.least), "text")]
    changes = course.changes(clearance)
    near = np.isfinite(clearance.room)
    groups = (
        ("links", own & ~near, "tone-1"),
        ("floor and boxes", ~own, "tone-2"),
        ("links built near each other", near, "tone-3"),
    )
    for label, chosen, tone in groups:
        if (chosen & changes).any():
            series.append(Series(label, 1e3 * course.nearness(chosen & changes)[0], tone))
    low, high = (float(f([f(x.y) for x in series])) for f in (np.min, np.max))
    is_wide = low > 0 and high > _WIDE * low
    chart = Chart(
        "distance of the two hulls that are nearest", course.t, tuple(series), "time [s]",
        "distance [mm]", link="time", logarithmic="y" if is_wide else "",
    )  # fmt: skip
    return chart_html(
        chart, "Least distance between two links, and to floor and boxes, where it changes"
    )


def _expected(preview: Preview) -> str:
    """Return in words what is to be expected of a log of the motion."""
    found, noise = preview.expected, preview.noise
    left = np.minimum(preview.base_error / preview.plausible, 1.0)
    order = np.argsort(-left, kind="stable")[:_NAMED]
    open_ones = [
        f"{found.mapping.base_names[k]} {100 * left[k]:.0f} %" for k in order if left[k] > _OPEN
    ]
    counts = {source: found.sources.count(source) for source in dict.fromkeys(found.sources)}
    sources = [f"{count} {_SOURCES[source]}" for source, count in counts.items()]
    stds = [f"{joint} {s:.2g}" for joint, s in zip(found.model.joints, noise.std, strict=True)]
    said = [
        f"{preview.words}.",
        f"Of {len(left)} base parameters, {int((left < _SHARP).sum())} are expected with a "
        "standard error below a tenth of what is plausible of them, "
        f"{int((left > _OPEN).sum())} above half of it.",
        f"The least certain, as shares of that: {', '.join(open_ones)}." if open_ones else "",
        f"The standard parameters will be told: {listed(sources)}.",
        f"Noise of the torque, standard deviation {listed(dict.fromkeys(noise.origins))}: "
        f"{', '.join(stds)} (N m or N).",
    ]
    return _paragraphs(said)


def _paragraphs(said: Sequence[str]) -> str:
    return "".join(f"<p>{escape(words)}</p>\n" for words in said if words)


def _history(content: Mapping[str, Any]) -> str:
    """Return the chart of the best criterion against the time that the design took."""
    seconds, best = np.array(content["history"]).T
    chart = Chart(
        "the best motion's criterion against the time of design", seconds,
        (Series("best so far", best, "tone-1"),),
        "design time [s]", "criterion",
    )  # fmt: skip
    return chart_html(chart, f"Criterion {escape(_CRITERIA[content['criterion']])}; less is better")
