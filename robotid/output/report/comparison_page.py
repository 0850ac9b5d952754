"""The page of a comparison: errors as bars, friction curves, differences, tables."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from itertools import chain
from typing import Any

import numpy as np

from robotid.base.text import period
from robotid.base.typing import Array
from robotid.output.pages.charts import Chart, Series, chart_html
from robotid.output.pages.html import Cell, code, number, page, percent, table, text, with_error

_FAR = 3.0  # combined standard errors beyond which a difference is in bold
_WIDEST = 6.0  # combined standard errors at the end of a bar
_BAR, _HIGH = 160, 9  # [px] of an error's bar: the longest, and its height
_HALF = 45  # [px] of a difference's bar, to each side
_TONES = 8


def comparison_page(content: Mapping[str, Any]) -> str:
    """Return the HTML of the page."""
    sections = {
        "errors": ("Prediction errors", _errors_section(content)),
        "friction": ("Friction", _friction_section(content)),
        "settings": ("Different settings", _differing(content, "settings", "setting")),
        "base": ("Base parameters", _base_section(content)),
        "inputs": ("Inputs", _inputs_section(content)),
        "versions": ("Different versions", _differing(content, "versions", "package")),
    }
    robots = ", ".join(dict.fromkeys(result["robot"] for result in content["results"]))
    title = f"{robots}: {len(content['results'])} results compared"
    return page(title, f"<h1>{escape(title)}</h1>\n{_verdicts(content)}", sections)


def _verdicts(content: Mapping[str, Any]) -> str:
    return "".join(
        f'<div class="verdict {escape(result["verdict"]["status"])}"><p>{_key(k)} '
        f"{result['label']}: <strong>{escape(result['verdict']['status'])}</strong> "
        f"({escape(result['estimator'])}) {code(result['path']).html}</p>"
        f"<ul>{''.join(f'<li>{escape(r)}</li>' for r in result['verdict']['reasons'])}</ul></div>\n"
        for k, result in enumerate(content["results"])
    )


def _tone(k: int) -> str:
    return f"tone-{k % _TONES + 1}"


def _key(k: int) -> str:
    """Return a patch in a result's colour."""
    return (
        '<svg width="14" height="10" style="vertical-align: baseline" aria-hidden="true">'
        f'<path d="M0 0h14v10h-14z" fill="var(--{_tone(k)})"/></svg>'
    )


def _legend(content: Mapping[str, Any]) -> str:
    """Return the legend of colours and letters of the results."""
    keys = "".join(
        f"<span>{_key(k)} {result['label']} {escape(result['name'])}</span> "
        for k, result in enumerate(content["results"])
    )
    return f'<p class="legend">{keys}</p>\n'


def _labels(content: Mapping[str, Any], unit: str = "") -> list[str]:
    return [result["label"] + unit for result in content["results"]]


def _errors_section(content: Mapping[str, Any]) -> str:
    notes = "".join(f"<li>{escape(note)}</li>" for note in content["notes"])
    parts = [
        "<p>error = 100 |τ − prediction| / |τ| over the samples used. The largest difference comes "
        "first. Bold: the smallest error, if only one result has it.</p>\n",
        _legend(content),
    ]
    if notes:
        parts.append(f"<ul>{notes}</ul>\n")
    parts += [
        _error_table(
            f"{entry['name']} {period(entry['start'], entry['end'])}: not fitted",
            content,
            entry["per_joint"],
            alike=True,
        )
        for entry in content["validation"]
    ]
    fitted, alike = content["fitted"], content["fitted_alike"]
    if not alike:
        parts.append("<p>The results were fitted to different recordings. The errors below are of "
                     "each result's own recordings and are not comparable.</p>\n")  # fmt: skip
    parts.append(_error_table("Fitted samples of each result", content, fitted, alike))
    return "".join(parts)


def _error_table(
    caption: str, content: Mapping[str, Any], per_joint: Sequence[Mapping[str, Any]], alike: bool
) -> str:
    headers = ["joint", "error", *_labels(content, " %"), *_labels(content, " RMSE"), "unit"]
    every = [x for entry in per_joint for x in entry["relative_error_pct"] if x is not None]
    rows = [
        [
            code(entry["joint"]),
            _bars(entry["relative_error_pct"], max(every, default=1.0)),
            *_percents(entry["relative_error_pct"], alike),
            *[number(value, ".3g") for value in entry["rmse"]],
            text(entry["unit"]),
        ]
        for entry in per_joint
    ]
    return table(caption, headers, rows)


def _bars(values: Sequence[float | None], most: float) -> Cell:
    """Return one bar for each value, relative to the largest."""
    height = _HIGH * len(values)
    paths = "".join(
        f'<path d="M0 {k * _HIGH + 1}h{_BAR * value / (most or 1.0):.1f}v{_HIGH - 2}H0z" '
        f'fill="var(--{_tone(k)})"/>'
        for k, value in enumerate(values)
        if value is not None
    )
    size = f'width="{_BAR}" height="{height}"'
    return Cell(f'<svg style="display: block" {size} aria-hidden="true">{paths}</svg>')


def _percents(errors: Sequence[float | None], alike: bool) -> list[Cell]:
    """Return the errors, the smallest in bold if they are comparable and it is unique."""
    cells = [percent(error) for error in errors]
    known = [(error, cell.html) for error, cell in zip(errors, cells, strict=True) if error]
    least = min(known)[1] if known and alike else None
    if [html for _, html in known].count(least or "") != 1 or len(known) < 2:
        return cells
    return [
        Cell(f"<strong>{cell.html}</strong>", "number", cell.value) if cell.html == least else cell
        for cell in cells
    ]


def _friction_section(content: Mapping[str, Any]) -> str:
    curves = content["friction"]
    if not curves:
        return "<p>No result has friction curves with a range of speeds.</p>\n"
    charts = "".join(_friction_figure(content, entry) for entry in curves)
    return (
        "<p>Friction of each drive at constant speed, without load and offset, over the speeds of "
        "the recordings. The largest difference comes first.</p>\n"
        f'{_legend(content)}<div class="plots">\n{charts}</div>\n'
    )


def _friction_figure(content: Mapping[str, Any], entry: Mapping[str, Any]) -> str:
    v = np.array(entry["speeds"])
    is_revolute = entry["unit"] == "N m"
    series = tuple(
        Series(result["label"], _open_at_0(v, np.array(torque)), _tone(k))
        for k, (result, torque) in enumerate(zip(content["results"], entry["torques"], strict=True))
        if torque is not None
    )
    chart = Chart(
        title=f"Friction of {entry['joint']} over its speed, by result",
        x=v,
        series=series,
        x_label=f"speed [{'rad/s' if is_revolute else 'm/s'}]",
        y_label=f"friction [{entry['unit']}]",
        height=150,
    )
    loads = ", ".join(
        f"{result['label']} {load:.3g}"
        for result, load in zip(content["results"], entry["load"], strict=True)
        if load is not None
    )
    of_load = f"; additional friction per {entry['unit']} of load: {loads}" if loads else ""
    return chart_html(chart, f"<strong>{escape(entry['joint'])}</strong>{of_load}")


def _open_at_0(v: Array, torque: Array) -> Array:
    """Return a friction curve with a gap at speed 0, where its sign changes."""
    return np.where(v == 0, np.nan, torque)


def _base_section(content: Mapping[str, Any]) -> str:
    labels = _labels(content)
    headers = ["parameter", *[f"({label} − A) / s" for label in labels[1:]]]
    headers += [head for label in labels for head in (label, f"± {label}")] + ["unit"]
    rows, different = [], 0
    for entry in content["base_parameters"]:
        differences = entry["differences"]
        far = any(d is not None and abs(d) > _FAR for d in differences)
        different += far
        rows.append(
            [
                code(entry["name"]),
                *[_difference(d, k) for k, d in enumerate(differences, start=1)],
                *chain.from_iterable(
                    _stated(value, error)
                    for value, error in zip(entry["values"], entry["std_errors"], strict=True)
                ),
                text(entry["unit"]),
            ]
        )
    return (
        f"<p>{different} of {len(rows)} parameters differ from A by more than {_FAR:g} combined "
        "standard errors s = √(s² + s_A²): dotted lines, bold figures. Results of the same "
        "recordings share their noise; their differences are not significance tests. Standard "
        f"errors do not include errors of the model.</p>\n{_legend(content)}"
        + table("Base parameters with standard errors", headers, rows, is_data=True)
    )


def _stated(value: float | None, error: float | None) -> tuple[Cell, Cell]:
    """Return a value and its standard error, to the digits of the error."""
    if value is None or error is None:
        return number(value), number(error, ".2g")
    return with_error(value, error)


def _difference(difference: float | None, k: int) -> Cell:
    """Return a difference after its bar, which ends in a point beyond six standard errors."""
    cell = number(difference, "z.1f")
    if difference is None:
        return cell
    middle, unit = _HALF, _HALF / _WIDEST
    lines = "".join(f"M{middle + s * _FAR * unit:.0f} 0v14" for s in (-1, 1))
    end = max(-_WIDEST, min(_WIDEST, difference)) * unit
    tip = math.copysign(4, difference) if abs(difference) > _WIDEST else 0
    bar = (
        f'<svg width="{2 * _HALF}" height="14" aria-hidden="true" style="vertical-align: middle">'
        f'<path d="M{middle} 0v14{lines}" stroke="var(--quiet)" stroke-dasharray="1 2"/>'
        f'<path d="M{middle} 3h{end - tip:.1f}l{tip:g} 4l{-tip:g} 4H{middle}z" '
        f'fill="var(--{_tone(k)})"/></svg>'
    )
    html = f"<strong>{cell.html}</strong>" if abs(difference) > _FAR else cell.html
    digits = f'<span style="display: inline-block; min-width: 3em">{html}</span>'
    return Cell(bar + digits, "number", cell.value)


def _differing(content: Mapping[str, Any], key: str, head: str) -> str:
    rows = [
        [code(row["name"]), *[text(value or "–") for value in row["values"]]]
        for row in content[key]
    ]
    if not rows:
        return "<p>None.</p>\n"
    return table(f"Different {key}", [head, *_labels(content)], rows)


def _inputs_section(content: Mapping[str, Any]) -> str:
    rows = [
        [
            text(row["role"]),
            *[text("yes" if has else "no", flag=not has) for has in row["in"]],
            code(row["path"]),
            number(row["start"], ".6g"),
            number(row["end"], ".6g"),
            code(row["sha256"] or "not read from a file"),
        ]
        for row in content["inputs"]
    ]
    headers = ["role", *_labels(content), "file", "from s", "to s", "SHA-256"]
    return table("Files read, different ones first", headers, rows)
