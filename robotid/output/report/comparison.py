"""Comparison of results, from their result.json files only, or of the units of a fleet: pages."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.files import check_file, write_text
from robotid.base.findings import listed
from robotid.base.text import period
from robotid.diagnosis.decisions import BEYOND_NOISE
from robotid.output.files.result_file import load_result
from robotid.output.pages.html import (
    Cell,
    Chart,
    Column,
    Series,
    block,
    chart_html,
    code,
    facts_html,
    listing,
    number,
    page,
    percent,
    plain,
    text,
    with_error,
)
from robotid.output.report.tables import POSITION, TORQUE, both
from robotid.robot.drives import TERMS

_FILES = ("urdf", "identification", "validation")  # settings that are shown as inputs


def compare_results(paths: Sequence[str | Path]) -> dict[str, Any]:
    """Compare results of the same robot and the same base parameters."""
    if len(paths) < 2:
        raise DataError(f"compare takes at least two results, found {len(paths)}")
    results = [load_result(path).content for path in paths]
    for path, result in zip(paths[1:], results[1:], strict=True):
        _require_same_mapping(str(paths[0]), results[0], str(path), result)
    logs = _short_names([entry["log"] for result in results for entry in result["validation"]])
    common, notes = _common_recordings(results, logs)
    names = _short_names(paths)
    return {
        "results": [
            {
                "label": _label(k),
                "name": names[str(path)],
                "path": str(path),
                "robot": result["robot"],
                "estimator": result["settings"].get("estimator", {}).get("name", ""),
                "verdict": result["verdict"],
            }
            for k, (path, result) in enumerate(zip(paths, results, strict=True))
        ],
        "validation": [
            {
                "log": result_log["log"],
                "name": logs[result_log["log"]],
                "start": key[1],
                "end": key[2],
                "per_joint": _errors([by_key[key] for by_key in map(_by_recording, results)]),
            }
            for key, result_log in common.items()
        ],
        "fitted": _errors([result["identification"] for result in results]),
        "fitted_alike": len({_recordings(result, "identification") for result in results}) == 1,
        "notes": notes,
        "base_parameters": _base_parameters(results),
        "settings": _differences([_flat(result["settings"]) for result in results]),
        "inputs": _inputs(results),
        "versions": _differences([r.get("versions", {"robotid": r["robotid"]}) for r in results]),
    }


def write_comparison(paths: Sequence[str | Path], target: str | Path) -> dict[str, Any]:
    """Compare results, write the page, and return the content of ``compare_results``."""
    check_file(Path(target), paths)
    content = compare_results(paths)
    write_text(comparison_page(content), target)
    return content


def _label(k: int) -> str:
    """Return A to Z, then A2 and so on."""
    return chr(ord("A") + k % 26) + (str(k // 26 + 1) if k >= 26 else "")


def _short_names(paths: Sequence[str | Path]) -> dict[str, str]:
    """Return the shortest unique end of each path, without the end that all have in common."""
    parts = {str(path): Path(path).resolve().parts for path in paths}
    every, common = set(parts.values()), 0
    while len(every) > 1 and len({names[-common - 1 :][:1] for names in every}) == 1:
        common += 1
    cut = {names: names[: len(names) - common] for names in every}
    return {path: _shortest(cut[names], set(cut.values())) for path, names in parts.items()}


def _shortest(names: tuple[str, ...], every: set[tuple[str, ...]]) -> str:
    ends = [names[-size:] for size in range(1, len(names) + 1)]
    unique = [end for end in ends if sum(other[-len(end) :] == end for other in every) == 1]
    return str(Path(*(unique or [names])[0]))


def _require_same_mapping(
    first: str, one: Mapping[str, Any], second: str, other: Mapping[str, Any]
) -> None:
    expressions = []
    for result in (one, other):  # without friction terms that were selected
        drives = {entry["name"] for entry in result["drive_parameters"]}
        chosen = {name for name in drives if name.rpartition(".")[2] not in TERMS}
        base = {entry["name"]: entry["expression"] for entry in result["base_parameters"]}
        expressions.append({name: x for name, x in base.items() if name not in chosen})
    ours, theirs = expressions
    what = "compare results of one URDF, with the same joints and drive terms"
    for has, lacks, names in (
        (first, second, [name for name in ours if name not in theirs]),
        (second, first, [name for name in theirs if name not in ours]),
    ):
        if names:
            raise DataError(
                f"{has} has {len(names)} base parameters that {lacks} does not have: "
                f"{listed(names, 5)}; {what}"
            )
    if changed := [name for name in ours if ours[name] != theirs[name]]:
        name = changed[0]
        raise DataError(
            f"{len(changed)} base parameters have other expressions in {first} and {second}: "
            f"{listed(changed, 5)}; {name} is {ours[name]} and {theirs[name]}; {what}"
        )


def _recordings(result: Mapping[str, Any], role: str) -> tuple[tuple[Any, ...], ...]:
    """Return the inputs of a role: the file's hash, or its path without hash, and the window."""
    return tuple(
        (entry["sha256"] or entry["path"], round(entry["start"], 6), round(entry["end"], 6))
        for entry in result["inputs"]
        if entry.get("role") == role
    )


def _by_recording(result: Mapping[str, Any]) -> dict[tuple[Any, ...], dict[str, Any]]:
    return dict(zip(_recordings(result, "validation"), result["validation"], strict=True))


def _signals(result: Mapping[str, Any], key: tuple[Any, ...]) -> dict[str, Any]:
    entries = [entry for entry in result["inputs"] if entry.get("role") == "validation"]
    entry = entries[_recordings(result, "validation").index(key)]
    return {**entry["signals"], "rows": entry["rows_used"]}


def _common_recordings(
    results: Sequence[Mapping[str, Any]], names: Mapping[str, str]
) -> tuple[dict[tuple[Any, ...], dict[str, Any]], list[str]]:
    """Return the validation recordings of all results, and notes on what is not comparable."""
    recordings = [_by_recording(result) for result in results]
    common = {k: v for k, v in recordings[0].items() if all(k in other for other in recordings)}
    notes = []
    for k, by_recording in enumerate(recordings):
        if left := [names[v["log"]] for key, v in by_recording.items() if key not in common]:
            notes.append(
                f"{_label(k)} was validated on {', '.join(left)}, other results were not: these "
                "errors are not compared"
            )
    if not common:
        notes.append(
            "the results have no common validation recording, so their prediction errors are not "
            "comparable; run 'robotid validate' with each result on the same log"
        )
    for key, entry in common.items():
        prepared = [_flat(_signals(result, key)) for result in results]
        if other := [f"{d['name']} {' | '.join(d['values'])}" for d in _differences(prepared)]:
            notes.append(
                f"the signal settings of {names[entry['log']]} differ ({'; '.join(other)}): "
                "smoother torque and fewer samples reduce the error"
            )
    return common, notes


def _errors(metrics: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return error and RMSE of each joint, one entry per result; None without samples."""
    joints = dict.fromkeys(joint for m in metrics for joint in m["per_joint"])
    rows = []
    for joint in joints:
        cells = [m["per_joint"].get(joint, {}) for m in metrics]
        row = {key: [cell.get(key) for cell in cells] for key in ("relative_error_pct", "rmse")}
        unit = next(cell["unit"] for cell in cells if cell)
        rows.append({"joint": joint, "unit": unit, **row})
    return sorted(rows, key=lambda row: -_spread(row["relative_error_pct"]))


def _spread(values: Sequence[float | None]) -> float:
    """Return the range of the values; -1 for fewer than two."""
    known = [value for value in values if value is not None]
    return max(known) - min(known) if len(known) > 1 else -1.0


def _base_parameters(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the values of all results, with (b_k - b_1) / sqrt(s_k^2 + s_1^2) or None."""
    by_name = [{e["name"]: e for e in result["base_parameters"]} for result in results]
    rows = []
    for name in dict.fromkeys(name for entries in by_name for name in entries):
        stated = [entries.get(name, {}) for entries in by_name]
        first = next(entry for entry in stated if entry)
        rows.append(
            {
                "name": name,
                "unit": first["unit"],
                "expression": first["expression"],
                "values": [entry.get("value") for entry in stated],
                "std_errors": [entry.get("std_error") for entry in stated],
                "differences": [_difference(stated[0], entry) for entry in stated[1:]],
            }
        )
    return sorted(rows, key=_largest, reverse=True)


def _largest(row: Mapping[str, Any]) -> float:
    return max((abs(d) for d in row["differences"] if d is not None), default=-1.0)


def _difference(one: Mapping[str, Any], other: Mapping[str, Any]) -> float | None:
    if one.get("std_error") is None or other.get("std_error") is None:
        return None
    combined = math.hypot(one["std_error"], other["std_error"])
    return (other["value"] - one["value"]) / combined if combined > 0 else None


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    found: dict[str, str] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = plain(value)
    return found


def _differences(each: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
    """Return the keys whose values differ; "" where a key is missing."""
    keys = dict.fromkeys(key for values in each for key in values if key not in _FILES)
    rows = [{"name": key, "values": [values.get(key, "") for values in each]} for key in keys]
    return [row for row in rows if len(set(row["values"])) > 1]


def _inputs(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return every file and window with the results that use it, the common ones last."""
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for k, result in enumerate(results):
        for entry in result["inputs"]:
            where = {key: entry.get(key) for key in ("path", "sha256", "start", "end")}
            row = {"role": entry.get("role", ""), **where, "in": [False] * len(results)}
            what = (row["role"], row["sha256"] or row["path"], row["start"], row["end"])
            found.setdefault(what, row)["in"][k] = True
    return sorted(found.values(), key=lambda row: all(row["in"]))


# ---- the page -------------------------------------------------------------------------------


def comparison_page(content: Mapping[str, Any]) -> str:
    """Return the HTML of the page."""
    results = content["results"]
    robots = ", ".join(dict.fromkeys(result["robot"] for result in results))
    title = f"{robots}: {len(results)} results compared"
    sections = {
        "errors": ("Prediction errors", _errors_section(content)),
        "settings": ("Different settings", _differing(content, "settings", "setting")),
        "base": ("Base parameters", _base_section(content), "the largest differences first", False),
        "inputs": ("Inputs", _inputs_section(content), "files read", False),
        "versions": ("Different versions", _differing(content, "versions", "package")),
    }
    return page(title, f"<h1>{escape(title)}</h1>\n{''.join(map(_verdict, results))}", sections)


def _verdict(result: Mapping[str, Any]) -> str:
    return block(
        "comparison.verdict", status=escape(result["verdict"]["status"]), label=result["label"],
        name=escape(result["name"]), estimator=escape(result["estimator"]),
        path=code(result["path"]).html,
        reasons="".join(f"<li>{escape(reason)}</li>" for reason in result["verdict"]["reasons"]),
    )  # fmt: skip


def _columns(content: Mapping[str, Any], key: str, form: str, words: str = "{}") -> list[Column]:
    labels = [result["label"] for result in content["results"]]
    return [(words.format(label), form, f"{key} {label}") for label in labels]


def _cells(content: Mapping[str, Any], key: str, values: Sequence[Any]) -> dict[str, Any]:
    labels = [result["label"] for result in content["results"]]
    return {f"{key} {label}": x for label, x in zip(labels, values, strict=True)}


def _errors_section(content: Mapping[str, Any]) -> str:
    tables = ""
    for entry in content["validation"]:
        caption = f"{entry['name']} {period(entry['start'], entry['end'])}: not fitted"
        tables += _error_table(caption, content, entry["per_joint"], are_alike=True)
    are_alike = content["fitted_alike"]
    tables += "" if are_alike else block("comparison.not_alike")
    tables += _error_table("Fitted samples of each result", content, content["fitted"], are_alike)
    notes = "".join(f"<li>{escape(note)}</li>" for note in content["notes"])
    units = {entry["unit"] for entry in content["fitted"]}
    share = (TORQUE if units.isdisjoint(("rad", "m")) else POSITION).share
    return block("comparison.errors", notes=notes, tables=tables, share=share)


def _error_table(
    caption: str, content: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], are_alike: bool
) -> str:
    columns = [
        ("joint", "code", "joint"),
        *_columns(content, "error", "%", "{} %"),
        *_columns(content, "rmse", ".3g", "{} RMSE"),
        ("unit", "text", "unit"),
    ]
    entries = []
    for row in rows:
        errors = row["relative_error_pct"]
        cells = [percent(error) for error in errors]
        known = [cell.html for cell, error in zip(cells, errors, strict=True) if error is not None]
        if are_alike and len(known) > 1:
            least = percent(min(error for error in errors if error is not None)).html
            cells = [_bold(x) if x.html == least and known.count(least) == 1 else x for x in cells]
        rmse = _cells(content, "rmse", row["rmse"])
        entries.append({**row, **_cells(content, "error", cells), **rmse})
    return listing(caption, columns, entries)


def _bold(cell: Cell) -> Cell:
    return replace(cell, html=f"<strong>{cell.html}</strong>")


def _base_section(content: Mapping[str, Any]) -> str:
    columns = [
        ("parameter", "code", "name"),
        *_columns(content, "difference", ".1f", "({} − A) / s")[1:],
        *_columns(content, "value", ".4g"),
        ("unit", "text", "unit"),
    ]
    entries, different = [], 0
    for entry in content["base_parameters"]:
        is_far = [x is not None and abs(x) > BEYOND_NOISE for x in entry["differences"]]
        shown = [number(x, "z.1f") for x in entry["differences"]]
        shown = [_bold(x) if far else x for x, far in zip(shown, is_far, strict=True)]
        values = [
            both(math.nan if value is None else value, math.inf if error is None else error)
            for value, error in zip(entry["values"], entry["std_errors"], strict=True)
        ]
        different += any(is_far)
        rows = _cells(content, "difference", [None, *shown]) | _cells(content, "value", values)
        entries.append({**entry, **rows})
    table = listing("Base parameters ± standard errors", columns, entries, is_data=True)
    figures = {"different": different, "count": len(entries), "far": f"{BEYOND_NOISE:g}"}
    return block("comparison.base", table=table, **figures)


def _differing(content: Mapping[str, Any], key: str, head: str) -> str:
    entries = [
        {"name": row["name"], **_cells(content, "value", [value or "–" for value in row["values"]])}
        for row in content[key]
    ]
    columns = [(head, "code", "name"), *_columns(content, "value", "text")]
    return listing(f"Different {key}", columns, entries) or "<p>None.</p>\n"


def _inputs_section(content: Mapping[str, Any]) -> str:
    columns = [
        ("role", "text", "role"), *_columns(content, "in", "text"), ("file", "code", "path"),
        ("from s", ".6g", "start"), ("to s", ".6g", "end"), ("SHA-256", "code", "sha256"),
    ]  # fmt: skip
    entries = []
    for row in content["inputs"]:
        cells = [text("yes" if x else "no", flag=not x) for x in row["in"]]
        sha256 = row["sha256"] or "not read from a file"
        entries.append({**row, **_cells(content, "in", cells), "sha256": sha256})
    return listing("Files read, different ones first", columns, entries)


# ---- the page of a fleet --------------------------------------------------------------------

_ORDER = ("failed", "poor", "usable", "good")
_UNITS = (
    ("unit", "code", "unit"), ("verdict", "text", "verdict"), ("reason", "text", "reason"),
    ("report", "text", "report"),
)  # fmt: skip
_UNLIKE = (
    ("unit", "code", "unit"), ("parameter", "code", "parameter"), ("value", ".4g", "value"),
    ("± error", ".4g", "std_error"), ("low", ".4g", "low"), ("high", ".4g", "high"),
    ("unit of value", "text", "parameter_unit"),
)  # fmt: skip
_PARAMETERS = (
    ("parameter", "code", "name"), ("robot", "text", "robot"), ("units", "d", "units"),
    ("mean", ".4g", "mean"), ("± error", ".4g", "std_error"), ("spread", ".4g", "spread"),
    ("low", ".4g", "low"), ("high", ".4g", "high"), ("unit", "text", "unit"),
)  # fmt: skip


def fleet_page(content: Mapping[str, Any]) -> str:
    """Return the HTML of the page."""
    facts = {
        "Units": f"{content['done']} of {content['units']} identified",
        "Logs": str(content["logs"]),
        "Verdicts": ", ".join(f"{n} {escape(v)}" for v, n in content["verdicts"].items()) or "none",
        "Units that differ": str(len({entry["unit"] for entry in content["unlike"]})),
    }
    sections = {
        "units": ("Units", _units(content)),
        "unlike": ("Units that differ", _unlike(content)),
        "parameters": ("Variation between units", _parameters(content), "by parameter", False),
        "values": ("Distributions", _distributions(content), "units by parameter", False),
    }
    title = f"Fleet of {content['units']} units"
    return page(title, f"<h1>{title}</h1>\n{facts_html(facts)}", sections)


def _units(content: Mapping[str, Any]) -> str:
    rows, differing = [], {entry["unit"] for entry in content["unlike"]}
    alike_last = sorted(content["results"], key=lambda x: x["unit"] not in differing)
    for entry in sorted(alike_last, key=lambda x: _ORDER.index(x["verdict"])):
        names = [x["parameter"] for x in content["unlike"] if x["unit"] == entry["unit"]]
        words = f"differs from the other units in {listed(names)}; " * bool(names)
        link = f'<a href="{escape(entry["report"])}">report</a>' if entry["report"] else "–"
        verdict = text(entry["verdict"], flag=entry["verdict"] in _ORDER[:2])
        shown = {"verdict": verdict, "reason": words + entry["reason"]}
        rows.append({**entry, **shown, "report": Cell(link, "text")})
    return listing("Units, the worst first", _UNITS, rows, is_data=True)


def _distributions(content: Mapping[str, Any]) -> str:
    figures = "" if content["parameters"] else "<p>None.</p>\n"
    for entry in content["parameters"]:
        counts, edges = np.histogram(entry["values"], "auto")
        units = Series("units", np.repeat(counts, 2).astype(float), "tone-1", "area")
        name, x = f"{entry['name']} [{entry['unit']}]", np.repeat(edges, 2)[1:-1]
        chart = Chart(f"Units by {name}", x, (units,), name, "units", height=90)
        figures += chart_html(chart, f"<strong>{code(entry['name']).html}</strong>")
    return f'<div class="plots small">\n{figures}</div>\n'


def _with_errors(entry: Mapping[str, Any], value: str, ends: str) -> dict[str, Any]:
    error = entry["std_error"]
    digits, std_error = with_error(entry[value], error)
    low, high = (with_error(x, error)[0] for x in entry[ends])
    return {**entry, value: digits, "std_error": std_error, "low": low, "high": high}


def _unlike(content: Mapping[str, Any]) -> str:
    rows = [_with_errors(entry, "value", "others") for entry in content["unlike"]]
    table = listing("Units that differ from the others", _UNLIKE, rows, is_data=True)
    return block("fleet.unlike") + table if table else "<p>None.</p>\n"


def _parameters(content: Mapping[str, Any]) -> str:
    rows = [
        _with_errors(entry, "mean", "next_interval")
        | {"spread": with_error(entry["spread"], entry["spread"])[1]}
        for entry in content["parameters"]
    ]
    table = listing("Base parameters of the units", _PARAMETERS, rows, is_data=True)
    if not table:
        return "<p>Fewer than three units of one robot were identified.</p>\n"
    return block("fleet.parameters") + table
