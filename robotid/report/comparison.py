"""Several results side by side, from their result.json files only: compared, and shown."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from robotid._files import check_file, write_text
from robotid.exceptions import DataError
from robotid.export.result import load_result
from robotid.findings import listed
from robotid.pages.html import Cell, code, number, page, percent, table, text
from robotid.robot.drives import TERMS

__all__ = ["compare_results", "write_comparison"]

_FAR = 3.0  # combined standard errors beyond which a difference is shown as a fault
_FILES = ("urdf", "identification", "validation")  # settings that stand among the inputs


def compare_results(paths: Sequence[str | Path]) -> dict[str, Any]:
    """Compare results of the same robot and the same base parameters.

    Args:
        paths: At least two result.json files.

    Returns:
        Plain values: "results" (label, path, robot, estimator, verdict), "validation" and "fitted"
        (errors by joint, one column per result), "fitted_alike" and "remarks" (what may
        not be compared, and why), "base_parameters" (values, standard errors, and the difference to
        the first result over the combined standard error), "settings", "inputs" and "versions"
        that differ.

    Raises:
        DataError: If there are fewer than two results, one cannot be read, or their base
            parameters are not the same; the message names what differs.
    """
    if len(paths) < 2:
        raise DataError(f"compare takes at least two results, found {len(paths)}")
    results = [load_result(path).content for path in paths]
    for path, result in zip(paths[1:], results[1:], strict=True):
        _require_same_mapping(str(paths[0]), results[0], str(path), result)
    common, remarks = _common_recordings(results)
    return {
        "results": [
            {
                "label": _label(k),
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
                "start": key[1],
                "end": key[2],
                "per_joint": _errors([by_key[key] for by_key in map(_by_recording, results)]),
            }
            for key, result_log in common.items()
        ],
        "fitted": _errors([result["identification"] for result in results]),
        "fitted_alike": len({_recordings(result, "identification") for result in results}) == 1,
        "remarks": remarks,
        "base_parameters": _base_parameters(results),
        "settings": _differences([_flat(_chosen(result)) for result in results]),
        "inputs": _inputs(results),
        "versions": _differences([r.get("versions", {"robotid": r["robotid"]}) for r in results]),
    }


def write_comparison(paths: Sequence[str | Path], target: str | Path) -> dict[str, Any]:
    """Compare results, write the page, and return what ``compare_results`` does.

    Args:
        paths: At least two result.json files.
        target: The HTML file to write; made beside it and then put in place.

    Raises:
        DataError: If the results cannot be compared, or the folder of the target is missing.
        SettingsError: If the target is a folder.
    """
    check_file(Path(target))
    content = compare_results(paths)
    write_text(_page(content), target)
    return content


def _label(k: int) -> str:
    """Return A to Z, then A2 and so on."""
    return chr(ord("A") + k % 26) + (str(k // 26 + 1) if k >= 26 else "")


def _require_same_mapping(
    first: str, one: Mapping[str, Any], second: str, other: Mapping[str, Any]
) -> None:
    """Refuse results whose base parameters stand for other things."""
    ours, theirs = (
        {
            entry["name"]: entry["expression"]
            for entry in result["base_parameters"]
            if not _is_chosen(entry["name"], result)
        }
        for result in (one, other)
    )
    what = "compare results of one URDF, with the same joints and drive terms"
    for has, lacks, names in (
        (first, second, [name for name in ours if name not in theirs]),
        (second, first, [name for name in theirs if name not in ours]),
    ):
        if names:
            raise DataError(
                f"{has} has {len(names)} base parameters that {lacks} has not: "
                f"{listed(names, 5)}; {what}"
            )
    changed = [name for name in ours if ours[name] != theirs[name]]
    if changed:
        name = changed[0]
        raise DataError(
            f"{len(changed)} base parameters stand for other sums in {first} and {second}: "
            f"{listed(changed, 5)}; {name} is {ours[name]} and {theirs[name]}; {what}"
        )


def _is_chosen(name: str, result: Mapping[str, Any]) -> bool:
    """Return whether a parameter is one of friction that only some results may have found."""
    drives = {entry["name"] for entry in result["drive_parameters"]}
    return name in drives and name.rpartition(".")[2] not in TERMS


def _recordings(result: Mapping[str, Any], role: str) -> tuple[tuple[Any, ...], ...]:
    """Return what was read in a role: the file's hash, or its path without one, and the window."""
    return tuple(
        (entry["sha256"] or entry["path"], round(entry["start"], 6), round(entry["end"], 6))
        for entry in result["inputs"]
        if entry.get("role") == role
    )


def _by_recording(result: Mapping[str, Any]) -> dict[tuple[Any, ...], dict[str, Any]]:
    return dict(zip(_recordings(result, "validation"), result["validation"], strict=True))


def _signals(result: Mapping[str, Any], key: tuple[Any, ...]) -> dict[str, Any]:
    """Return how a validation recording was prepared, and how many rows of it are used."""
    entries = [entry for entry in result["inputs"] if entry.get("role") == "validation"]
    entry = entries[_recordings(result, "validation").index(key)]
    return {**entry["signals"], "rows": entry["rows_used"]}


def _common_recordings(
    results: Sequence[Mapping[str, Any]],
) -> tuple[dict[tuple[Any, ...], dict[str, Any]], list[str]]:
    """Return the validation recordings that every result has, and what is not comparable."""
    each = [_by_recording(result) for result in results]
    common = {k: v for k, v in each[0].items() if all(k in other for other in each[1:])}
    remarks = []
    for k, by_recording in enumerate(each):
        left = [Path(v["log"]).name for key, v in by_recording.items() if key not in common]
        if left:
            remarks.append(
                f"{_label(k)} was validated on {', '.join(left)}, which not every result was: "
                "these errors are not compared"
            )
    if not common:
        remarks.append(
            "no validation recording is common to all results: their errors of prediction cannot "
            "be compared; run 'robotid validate' on one log with each"
        )
    for key, entry in common.items():
        prepared = [_flat(_signals(result, key)) for result in results]
        if other := [f"{d['name']} {' | '.join(d['values'])}" for d in _differences(prepared)]:
            remarks.append(
                f"{Path(entry['log']).name} was prepared in other ways ({'; '.join(other)}): a "
                "smoother torque, and fewer rows, are easier to predict"
            )
    return common, remarks


def _errors(metrics: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return error and RMSE of each joint, one entry per result; None where a joint has no rows."""
    joints = dict.fromkeys(joint for m in metrics for joint in m["per_joint"])
    rows = []
    for joint in joints:
        cells = [m["per_joint"].get(joint, {}) for m in metrics]
        row = {key: [cell.get(key) for cell in cells] for key in ("relative_error_pct", "rmse")}
        unit = next(cell["unit"] for cell in cells if cell)
        rows.append({"joint": joint, "unit": unit, **row})
    return rows


def _base_parameters(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return values beside each other, with (b_k - b_1) / sqrt(s_k^2 + s_1^2); None for none."""
    each = [{e["name"]: e for e in result["base_parameters"]} for result in results]
    stated = {name: entry for by_name in reversed(each) for name, entry in by_name.items()}
    rows = []
    for name in dict.fromkeys(name for by_name in each for name in by_name):
        own = [by_name.get(name, {}) for by_name in each]
        rows.append(
            {
                "name": name,
                "unit": stated[name]["unit"],
                "expression": stated[name]["expression"],
                "values": [entry.get("value") for entry in own],
                "std_errors": [entry.get("std_error") for entry in own],
                "differences": [_difference(own[0], entry) for entry in own[1:]],
            }
        )
    return rows


def _difference(one: Mapping[str, Any], other: Mapping[str, Any]) -> float | None:
    if one.get("std_error") is None or other.get("std_error") is None:
        return None
    combined = math.hypot(one["std_error"], other["std_error"])
    ratio = (other["value"] - one["value"]) / combined if combined > 0 else math.inf
    return ratio if math.isfinite(ratio) else None


def _chosen(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a job; recordings stand among the inputs."""
    return {k: v for k, v in result["settings"].items() if k not in _FILES}


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    found: dict[str, str] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = _plain(value)
    return found


def _plain(value: object) -> str:
    if isinstance(value, list):
        return listed(map(_plain, value))
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _differences(each: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
    """Return the keys whose values are not the same everywhere; "" where a key is missing."""
    keys = dict.fromkeys(key for values in each for key in values)
    rows = [{"name": key, "values": [values.get(key, "") for values in each]} for key in keys]
    return [row for row in rows if len(set(row["values"])) > 1]


def _inputs(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return every file and window with who read it, those that all have last."""
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for k, result in enumerate(results):
        for entry in result["inputs"]:
            where = {key: entry.get(key) for key in ("path", "sha256", "start", "end")}
            row = {"role": entry.get("role", ""), **where, "in": [False] * len(results)}
            what = (row["role"], row["sha256"] or row["path"], row["start"], row["end"])
            found.setdefault(what, row)["in"][k] = True
    return sorted(found.values(), key=lambda row: all(row["in"]))


# --- the page ---------------------------------------------------------------------------------


def _page(content: Mapping[str, Any]) -> str:
    sections = {
        "errors": ("Prediction errors", _errors_section(content)),
        "base": ("Base parameters", _base_section(content)),
        "settings": ("Settings that differ", _differing(content, "settings", "setting")),
        "inputs": ("Inputs", _inputs_section(content)),
        "versions": ("Versions that differ", _differing(content, "versions", "what")),
    }
    robots = ", ".join(dict.fromkeys(result["robot"] for result in content["results"]))
    title = f"{robots}: {len(content['results'])} results compared"
    return page(title, f"<h1>{escape(title)}</h1>\n{_verdicts(content)}", sections)


def _verdicts(content: Mapping[str, Any]) -> str:
    return "".join(
        f'<div class="verdict {escape(result["verdict"]["status"])}"><p>{result["label"]}: '
        f"<strong>{escape(result['verdict']['status'])}</strong> "
        f"({escape(result['estimator'])}) {code(result['path']).html}</p>"
        f"<ul>{''.join(f'<li>{escape(r)}</li>' for r in result['verdict']['reasons'])}</ul></div>\n"
        for result in content["results"]
    )


def _labels(content: Mapping[str, Any], unit: str = "") -> list[str]:
    return [result["label"] + unit for result in content["results"]]


def _errors_section(content: Mapping[str, Any]) -> str:
    remarks = "".join(f"<li>{escape(remark)}</li>" for remark in content["remarks"])
    parts = ["<p>error = 100 |τ − prediction| / |τ| over the rows used; the least in bold.</p>\n"]
    if remarks:
        parts.append(f"<ul>{remarks}</ul>\n")
    parts += [
        _error_table(
            f"{Path(entry['log']).name} {entry['start']:.4g}-{entry['end']:.4g} s: not fitted",
            content,
            entry["per_joint"],
            alike=True,
        )
        for entry in content["validation"]
    ]
    fitted, alike = content["fitted"], content["fitted_alike"]
    if not alike:
        parts.append("<p>The results were fitted to other recordings: of the errors below each is "
                     "that of its own, and they are not comparable.</p>\n")  # fmt: skip
    parts.append(_error_table("Fitted rows of each result", content, fitted, alike))
    return "".join(parts)


def _error_table(
    caption: str, content: Mapping[str, Any], per_joint: Sequence[Mapping[str, Any]], alike: bool
) -> str:
    headers = ["joint", *_labels(content, " %"), *_labels(content, " RMSE"), "unit"]
    rows = [
        [
            code(entry["joint"]),
            *_percents(entry["relative_error_pct"], alike),
            *[number(value, ".3g") for value in entry["rmse"]],
            text(entry["unit"]),
        ]
        for entry in per_joint
    ]
    return table(caption, headers, rows)


def _percents(errors: Sequence[float | None], alike: bool) -> list[Cell]:
    """Return the errors, the least in bold where they are comparable; ties by what is shown."""
    cells = [percent(error) for error in errors]
    known = [(error, cell.html) for error, cell in zip(errors, cells, strict=True) if error]
    least = min(known)[1] if known and alike else None
    return [
        Cell(f"<strong>{cell.html}</strong>", "number") if cell.html == least else cell
        for cell in cells
    ]


def _base_section(content: Mapping[str, Any]) -> str:
    labels = _labels(content)
    headers = ["parameter", *labels, *[f"± {label}" for label in labels]]
    headers += [f"({label} − A) / s" for label in labels[1:]] + ["unit", "remark"]
    rows, apart = [], 0
    for entry in content["base_parameters"]:
        differences = entry["differences"]
        far = any(d is not None and abs(d) > _FAR for d in differences)
        apart += far
        rows.append(
            [
                code(entry["name"]),
                *[number(value) for value in entry["values"]],
                *[number(error, ".2g") for error in entry["std_errors"]],
                *[number(d, ".1f") for d in differences],
                text(entry["unit"]),
                text("apart" if far else "", flag=True),
            ]
        )
    return (
        f"<p>{apart} of {len(rows)} differ from A by more than {_FAR:g} combined standard errors "
        "s = √(s² + s_A²). Results of the same recordings share their noise: there the figure only "
        "sets a scale. Standard errors do not know of faults of the model.</p>\n"
        + table("Base parameters with standard errors", headers, rows)
    )


def _differing(content: Mapping[str, Any], key: str, head: str) -> str:
    rows = [
        [code(row["name"]), *[text(value or "–") for value in row["values"]]]
        for row in content[key]
    ]
    if not rows:
        return "<p>None.</p>\n"
    return table(f"{key.capitalize()} that differ", [head, *_labels(content)], rows)


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
    return table("Files read, those that differ first", headers, rows)
