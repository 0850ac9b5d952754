"""The page of a fleet: verdicts, failures, units that differ, distribution of each parameter."""

from collections import Counter
from collections.abc import Mapping
from html import escape
from pathlib import PurePath
from typing import Any

import numpy as np

from robotid.output.pages.charts import Chart, Series, chart_html
from robotid.output.pages.html import code, facts_html, number, page, table, text, with_error

_BINS = 24  # of a distribution, at most
_CHARTS = 12  # distributions on the page, those with the largest spread
_ROWS = 20  # failures on the page, and units that differ; all are in the files of results


def fleet_page(content: Mapping[str, Any]) -> str:
    """Return the HTML of the page."""
    failures, unlike = content["failures"], content["unlike"]
    facts = {
        "Units": f"{content['done']} of {content['units']} identified",
        "Logs": str(content["logs"]),
        "Verdicts": ", ".join(f"{n} {escape(v)}" for v, n in content["verdicts"].items()) or "none",
        "Failures": str(len(failures)),
        "Units that differ": str(len({each["unit"] for each in unlike})),
    }
    sections = {
        "failures": ("Failures", _failures(content)),
        "unlike": ("Units that differ", _unlike(content)),
        "parameters": ("Variation between units", _parameters(content)),
        "distributions": ("Distributions", _distributions(content)),
    }
    title = f"Fleet of {content['units']} units"
    return page(title, f"<h1>{title}</h1>\n{facts_html(facts)}", sections)


def _failures(content: Mapping[str, Any]) -> str:
    """Return the failures, the first of each kind first."""
    failures = content["failures"]
    if not failures:
        return "<p>None.</p>\n"
    kinds = [_kind(each) for each in failures]
    count, first = Counter(kinds), {kind: k for k, kind in reversed([*enumerate(kinds)])}
    order = sorted(range(len(kinds)), key=lambda k: (first[kinds[k]] != k, k))
    rows = [
        [
            code(failures[k]["unit"]),
            code(failures[k]["log"] or "all"),
            number(count[kinds[k]], "d"),
            text(failures[k]["error"]),
        ]
        for k in order[:_ROWS]
    ]
    headers = ["unit", "log", "alike", "error"]
    shown = table("Units and logs that were not identified", headers, rows)
    return shown + _more(len(failures), "fleet.parquet")


def _kind(failure: Mapping[str, str]) -> str:
    """Return the error without the names of its unit and log."""
    kind = failure["error"]
    for name in (failure["log"], PurePath(failure["log"]).name, failure["unit"]):
        kind = kind.replace(name, "") if name else kind
    return kind


def _more(count: int, file: str) -> str:
    """Return a note on the rows that are not shown."""
    more = count - _ROWS
    return f"<p>{more} more are in <code>{file}</code>.</p>\n" if more > 0 else ""


def _unlike(content: Mapping[str, Any]) -> str:
    rows = [
        [
            code(each["unit"]),
            code(each["parameter"]),
            *with_error(each["value"], each["std_error"]),
            *(with_error(x, each["std_error"])[0] for x in each["others"]),
            text(each["parameter_unit"]),
        ]
        for each in content["unlike"][:_ROWS]
    ]
    if not rows:
        return "<p>None.</p>\n"
    headers = ["unit", "parameter", "value", "± error", "low", "high", "unit of value"]
    return (
        "<p>Units outside what the others predict (low to high: 95 %), the least probable first. A "
        "fleet of alike units has one with a probability of about 2 %. Look for a payload, a "
        "changed gain, wear or a wrong URDF.</p>\n"
        + table("Units that differ from the others", headers, rows, is_data=True)
        + _more(len(content["unlike"]), "fleet.json")
    )


def _parameters(content: Mapping[str, Any]) -> str:
    rows = []
    for each in content["parameters"]:
        mean, error = with_error(each["mean"], each["std_error"])
        low, high = (with_error(x, each["std_error"])[0] for x in each["next_interval"])
        spread = with_error(each["spread"], each["spread"])[1]
        rows.append(
            [code(each["name"]), text(each["robot"]), number(each["units"], "d"), mean, error,
             spread, low, high, text(each["unit"])]
        )  # fmt: skip
    if not rows:
        return "<p>Fewer than three units of one robot were identified.</p>\n"
    headers = ["parameter", "robot", "units", "mean", "± error", "spread", "low", "high", "unit"]
    return (
        "<p>Mean with its standard error, standard deviation between units (spread), and the 95 % "
        "prediction interval of the next unit (low to high), without units that differ.</p>\n"
        + table("Base parameters of the units", headers, rows, is_data=True)
    )


def _distributions(content: Mapping[str, Any]) -> str:
    """Return histograms, those with the largest spread relative to the mean's error first."""
    every = sorted(content["parameters"], key=lambda e: -e["spread"] / (abs(e["mean"]) or 1.0))
    shown = every[:_CHARTS]
    note = f"<p>{len(shown)} of {len(every)}, those with the largest relative spread.</p>\n"
    charts = "".join(map(_histogram, shown))
    return f'{note if len(every) > len(shown) else ""}<div class="plots">\n{charts}</div>\n'


def _histogram(entry: Mapping[str, Any]) -> str:
    values = np.array(entry["values"])
    count, edges = np.histogram(values, bins=min(_BINS, max(4, len(values) // 2)))
    chart = Chart(
        title=f"Distribution of {entry['name']} over units",
        x=(edges[1:] + edges[:-1]) / 2,
        series=(Series("units", count.astype(float), "tone-1", "bars"),),
        x_label=f"{entry['name']} [{entry['unit']}]",
        y_label="units",
        height=120,
        marks=tuple(entry["next_interval"]),
    )
    return chart_html(chart, f"<strong>{escape(entry['name'])}</strong>; dotted: 95 % of the next")
