"""robotid compare: compare several results."""

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from robotid.base.findings import listed
from robotid.base.text import columns, in_digits_of
from robotid.cli.console import SHOWN, echo, show_found, window_name
from robotid.cli.job import add_shown
from robotid.identification.summary import cell
from robotid.output.report.comparison import compare_results, write_comparison


def compare(results: Sequence[str | Path], page: str | Path | None = None) -> dict[str, Any]:
    """Compare results of one robot: errors, parameters, settings, inputs.

    Args:
        results: At least two, each a result.json or its folder.
        page: HTML page to write; none if None.

    Returns:
        The comparison, as ``robotid compare --json``.

    Raises:
        DataError: If a result is missing, or the robots or their base parameters differ.
        SettingsError: If the page cannot be written.
    """
    return compare_results(results) if page is None else write_comparison(results, page)


def add_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("results", nargs="+", metavar="RESULT.json")
    add("--out", metavar="FILE.html", help="page to write")
    add_shown(parser, "json", verbose="print all base parameters")


def run(options: argparse.Namespace) -> None:
    content = compare(options.results, options.out)
    files = [options.out] if options.out else []
    show_found(content, options, partial(_show, is_verbose=options.verbose), files)


def _show(content: dict[str, Any], *, is_verbose: bool) -> None:
    labels = [result["label"] for result in content["results"]]
    for result in content["results"]:
        verdict = result["verdict"]["status"]
        line = f"{result['label']}  {verdict:7} {result['estimator']:10} {result['path']}"
        echo(line, "   ", verdict)
    for note in content["notes"]:
        echo(f"- {note}", "  ")
    alike = "" if content["fitted_alike"] else "; other recordings, not comparable"
    tables = [
        (f"not fitted: {window_name(entry['name'], entry)}, error %", entry["per_joint"])
        for entry in content["validation"]
    ]
    tables.append((f"fitted recordings of each, error %{alike}", content["fitted"]))
    for title, per_joint in tables:
        rows = [[e["joint"], *map(cell, e["relative_error_pct"])] for e in per_joint]
        echo(f"\n{title}", "  ")
        print("\n".join(columns(["joint", *labels], rows)))
    _print_base_parameters(content, labels, None if is_verbose else SHOWN)
    for key in ("settings", "versions"):
        for row in content[key]:
            echo(f"{key}: {row['name']}: {' | '.join(v or '-' for v in row['values'])}", "  ")
    for row in content["inputs"]:
        if not all(row["in"]):
            read = listed(label for label, has in zip(labels, row["in"], strict=True) if has)
            name = row["path"] if row["start"] is None else window_name(row["path"], row)
            echo(f"only {read} read {name} ({row['role']})", "  ")


def _print_base_parameters(
    content: Mapping[str, Any], labels: Sequence[str], limit: int | None
) -> None:
    echo(
        "\nbase parameters to the second digit of their standard errors; last columns: difference "
        f"to {labels[0]} divided by the combined standard error, in descending order"
    )
    rows = []
    entries = content["base_parameters"]
    if limit is not None and len(entries) == limit + 1:  # a row is as long as its replacement
        limit = None
    for entry in entries[:limit]:
        pairs = zip(entry["values"], entry["std_errors"], strict=True)
        values = ["-" if x is None else in_digits_of(x, error)[0] for x, error in pairs]
        differences = [
            "-" if x is None else f"{round(x, 1) + 0.0:.1f}" for x in entry["differences"]
        ]
        rows.append([entry["name"], *values, entry["unit"], *differences])
    heads = ["", *labels, "", *[f"{label}-{labels[0]}" for label in labels[1:]]]
    print("\n".join(columns(heads, rows, left=(0, len(labels) + 1))))
    if len(entries) > len(rows):
        echo(f"  {len(entries) - len(rows)} more with smaller differences: --verbose", "  ")
