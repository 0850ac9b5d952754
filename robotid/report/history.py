"""Parameters over results in order of time: findings, their causes, charts."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.pages.charts import Chart, Series, chart_html
from robotid.pages.html import code, table, text, with_error
from robotid.variation.change_causes import Cause, cause_of
from robotid.variation.history import FALSE_ALARMS, Change, changes, steps_of

__all__ = ["history_of", "history_section"]

_EPOCH = (
    1e8  # [s] earliest time stamp of logs that are ordered by it: of 1973, not of a log's start
)
_UNKNOWN = 1e3  # standard error of what a result does not determine, over the largest value
_HALF = 1.96  # standard errors of a 95 % interval
_REMEDY = {
    "friction": "Warm the robot up and repeat the log. If the friction remains, check lubrication, "
    "brake and wear of the drive",
    "offset": "Zero the torque sensor, and check balance and preload of the drive",
    "gain": "Check the torque sensor or the current's gain in [torque.gains]",
    "payload": "Remove the load, or state it: robotid payload",
    "other": "Check mounting, tool and settings of these logs",
}


def history_of(
    results: Sequence[Mapping[str, Any]],
    parameters: Sequence[Mapping[str, Any]],
    labels: Sequence[str],
    false_alarms: float = FALSE_ALARMS,
) -> dict[str, Any]:
    """Return order, changes and findings of results.

    Args:
        results: Contents of their result.json.
        parameters: Base parameters with the values and standard errors of all results.
        labels: Names of the results.
        false_alarms: Probability that a history without a change has a finding.

    Returns:
        Plain values: "order" (indices of the results by the time stamps of their logs, if these
        are dates, otherwise as given), "by_time" (whether they are), "false_alarms", "changes"
        (parameters that earlier results do not predict) and "findings" (their causes). Parameters
        that a result does not determine have no weight in it.

    Raises:
        SettingsError: If the probability is not between 0 and 1.
    """
    if not 0.0 < false_alarms < 1.0:
        raise SettingsError(
            f"false_alarms is {false_alarms:g}, wanted a probability between 0 and 1, as 0.02"
        )
    times = [_first_time(result) for result in results]
    by_time = all(t is not None and t >= _EPOCH for t in times)
    order = sorted(range(len(results)), key=lambda k: times[k] or 0.0 if by_time else k)
    content: dict[str, Any] = {"order": order, "by_time": by_time, "false_alarms": false_alarms}
    known = [each for each in parameters if all(each["std_errors"])]
    found: list[Change] = []
    values = errors = np.zeros((len(results), 0))
    if known:
        values, errors = (
            np.array([each[key] for each in known]).T[order] for key in ("values", "std_errors")
        )
        weak = [results[k].get("structure", {}).get("undetermined", ()) for k in order]
        is_weak = np.array([[each["name"] in own for each in known] for own in weak])
        size = np.maximum(np.abs(values).max(axis=0), errors.max(axis=0))
        errors = np.where(is_weak, _UNKNOWN * size, errors)
        found = changes(values, errors, false_alarms=false_alarms)
    names = [labels[k] for k in order]
    content["changes"] = [
        {
            "result": names[each.result],
            "since": names[each.first],
            "name": known[each.parameter]["name"],
            "unit": known[each.parameter]["unit"],
            "value": values[each.result, each.parameter],
            "std_error": errors[each.result, each.parameter],
            "compared_from": names[each.start],
            "predicted": each.expected.ends.tolist(),
            "probability": each.probability,
        }
        for each in found
    ]
    content["findings"] = _findings(results[0], known, values, errors, found, names)
    return content


def _first_time(result: Mapping[str, Any]) -> float | None:
    """Return the start of the first fitted log on its own clock [s]."""
    starts = [e["start"] for e in result["inputs"] if e.get("role") == "identification"]
    known = [start for start in starts if start is not None]
    return min(known) if known else None


def _findings(
    result: Mapping[str, Any],
    known: Sequence[Mapping[str, Any]],
    values: Array,
    errors: Array,
    found: Sequence[Change],
    labels: Sequence[str],
) -> list[dict[str, Any]]:
    """Return the findings with their causes; later ones of the same change are joined with it."""
    findings: list[dict[str, Any]] = []
    raised: list[int] = []  # index of the result of each
    drives = list(dict.fromkeys(e["name"].rpartition(".")[0] for e in result["drive_parameters"]))
    bodies = [entry["name"].rpartition(".")[0] for entry in result["standard_parameters"]]
    link = next((body for body in reversed(bodies) if body not in drives), "")
    expressions = {each["name"]: each["expression"] for each in known}
    for k in dict.fromkeys(each.result for each in found):
        own = [each for each in found if each.result == k]
        first, start = own[0].first, own[0].start
        steps = steps_of(values[start : k + 1], errors[start : k + 1])
        place = first - start - 1
        at = steps.before[:, place], steps.change[:, place], steps.std_error[:, place]
        cause = cause_of(expressions, drives, link, *at)
        names = [known[each.parameter]["name"] for each in own]
        same = [
            finding for finding, before in zip(findings, raised, strict=True)
            if (finding["kind"], finding["where"]) == (cause.kind, cause.where) and first <= before
        ]  # fmt: skip
        if same:
            same[-1]["parameters"] += [name for name in names if name not in same[-1]["parameters"]]
            continue
        raised.append(k)
        findings.append(
            {
                "result": labels[k],
                "since": labels[first],
                "kind": cause.kind,
                "where": cause.where,
                "size": cause.size,
                "std_error": cause.std_error,
                "parameters": names,
                "message": _message(cause, names),
                "remedy": _REMEDY[cause.kind],
            }
        )
    return findings


def _percent(share: float) -> str:
    """Return a share as text, with two digits or more, never as a power of ten."""
    return f"{100 * share:.0f} %" if share >= 0.995 else f"{100 * share:.2g} %"


def _message(cause: Cause, names: Sequence[str]) -> str:
    """Return the cause as text."""
    size, error = cause.size, cause.std_error
    if cause.kind in ("friction", "gain"):
        what = "friction" if cause.kind == "friction" else "gain of the torque"
        way = "higher" if size > 0 else "lower"
        share = f"{_percent(abs(size))} {way} (standard error {_percent(error)})"
        return f"{what} of {cause.where} is {share}"
    if cause.kind == "payload":
        mass = f": {size:+.3g} kg (standard error {error:.2g} kg)" if error > 0 else ""
        return f"the load on {cause.where} has changed{mass}"
    if cause.kind == "offset":
        return (
            f"the offset of {cause.where} has changed by {size:+.3g} (standard error {error:.2g})"
        )
    return f"no single cause explains the change of {names[0]}"


def history_section(content: Mapping[str, Any]) -> str:
    """Return the section of a comparison with changes: findings, parameters, a chart of each.

    Args:
        content: The value of ``compare_results``.
    """
    labels = [result["label"] for result in content["results"]]
    order = content["order"]
    in_time = ", ".join(labels[k] for k in order)
    source = "of the time stamps of their logs" if content["by_time"] else "in which they are given"
    intro = (
        f"<p>Results in the order {source}: {escape(in_time)}. Each is compared with those before "
        f"it. A history without a change has a finding with a probability of at most "
        f"{100 * content['false_alarms']:.3g} %.</p>\n"
    )
    findings = [
        [text(each["result"]), text(each["since"]), text(each["message"]),
         code(", ".join(each["parameters"])), text(each["remedy"])]
        for each in content["findings"]
    ]  # fmt: skip
    rows = [
        [
            text(each["result"]),
            code(each["name"]),
            *with_error(each["value"], each["std_error"]),
            *(with_error(x, each["std_error"])[0] for x in each["predicted"]),
            text(each["unit"]),
            text(each["since"]),
        ]
        for each in content["changes"]
    ]
    headers = ["result", "parameter", "value", "± error", "low", "high", "unit", "since"]
    caption = "Parameters outside what the results before them predict; low to high: 95 %"
    changed = dict.fromkeys(each["name"] for each in content["changes"])
    charts = "".join(_chart(content, name, [labels[k] for k in order]) for name in changed)
    heads = ["result", "changed since", "cause", "parameters", "what to do"]
    return (
        intro
        + table("Findings", heads, findings)
        + table(caption, headers, rows, is_data=True)
        + f'<div class="plots">\n{charts}</div>\n'
    )


def _chart(content: Mapping[str, Any], name: str, labels: Sequence[str]) -> str:
    """Return a parameter over the results, and the prediction for those after each change."""
    entry = next(each for each in content["base_parameters"] if each["name"] == name)
    values, errors = (
        np.array([entry[key][k] for k in content["order"]], dtype=float)
        for key in ("values", "std_errors")
    )
    own = [each for each in content["changes"] if each["name"] == name]
    middle, half = np.full((2, len(labels)), np.nan)
    for each in own:
        low, high = each["predicted"]
        place = slice(labels.index(each["compared_from"]), labels.index(each["result"]) + 1)
        middle[place], half[place] = (low + high) / 2, (high - low) / 2
    series = (
        Series("predicted before the change", middle, "quiet", half=half, is_weak=True),
        Series("result", values, "tone-1", "dots", half=_HALF * errors),
    )
    chart = Chart(
        title=f"{name} over the results",
        x=np.arange(len(labels)),
        series=series,
        x_label="result",
        y_label=f"{name} [{entry['unit']}]",
        marks=tuple(labels.index(each["since"]) - 0.5 for each in own),
        x_names=tuple(labels),
        height=150,
    )
    return chart_html(chart, f"<strong>{escape(name)}</strong>; dotted: changes; bars: 95 %")
