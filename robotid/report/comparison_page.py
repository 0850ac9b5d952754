"""The page that shows several results side by side."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from robotid._files import write_text
from robotid._html import Cell, code, number, page, percent, table, text
from robotid.report.comparison import compare_results

__all__ = ["comparison_page", "write_comparison"]

_FAR = 3.0  # combined standard errors beyond which a difference is shown as a fault


def write_comparison(paths: Sequence[str | Path], target: str | Path) -> dict[str, Any]:
    """Compare results and write the page.

    Args:
        paths: At least two result.json files.
        target: The HTML file to write; made beside it and then put in place.

    Returns:
        What ``compare_results`` returns.

    Raises:
        DataError: If the results cannot be compared, or the folder of the target is missing.
    """
    content = compare_results(paths)
    write_text(comparison_page(content), target)
    return content


def comparison_page(content: Mapping[str, Any]) -> str:
    """Return the page.

    Args:
        content: What ``compare_results`` returns.

    Returns:
        HTML that fetches nothing.
    """
    sections = {
        "errors": ("Prediction errors", _errors(content)),
        "base": ("Base parameters", _base(content)),
        "settings": ("Settings that differ", _differing(content, "settings", "setting")),
        "inputs": ("Inputs", _inputs(content)),
        "versions": ("Versions that differ", _differing(content, "versions", "what")),
    }
    links = "".join(f'<a href="#{key}">{title}</a> ' for key, (title, _) in sections.items())
    body = "".join(
        f'<section aria-labelledby="{key}">\n<h2 id="{key}">{title}</h2>\n{html}</section>\n'
        for key, (title, html) in sections.items()
    )
    robots = ", ".join(dict.fromkeys(result["robot"] for result in content["results"]))
    title = f"{robots}: {len(content['results'])} results compared"
    nav = f'<nav aria-label="Sections">{links}</nav>'
    return page(
        title, f"<header>\n<h1>{escape(title)}</h1>\n{_verdicts(content)}</header>{nav}{body}"
    )


def _verdicts(content: Mapping[str, Any]) -> str:
    shown = "".join(
        f'<div class="verdict {result["verdict"]["status"]}"><p>{result["label"]}: '
        f"<strong>{escape(result['verdict']['status'])}</strong> "
        f"({escape(result['estimator'])}) {code(result['path']).html}</p>"
        f"<ul>{''.join(f'<li>{escape(r)}</li>' for r in result['verdict']['reasons'])}</ul></div>\n"
        for result in content["results"]
    )
    return shown


def _labels(content: Mapping[str, Any], unit: str = "") -> list[str]:
    return [result["label"] + unit for result in content["results"]]


def _errors(content: Mapping[str, Any]) -> str:
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
    if not content["fitted_alike"]:
        parts.append("<p>The results were fitted to other recordings: of the errors below each is "
                     "that of its own, and they are not comparable.</p>\n")  # fmt: skip
    fitted, alike = content["fitted"], content["fitted_alike"]
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


def _base(content: Mapping[str, Any]) -> str:
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


def _inputs(content: Mapping[str, Any]) -> str:
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
