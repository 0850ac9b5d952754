"""The page of a fleet: verdicts, failures, units that differ, variation of each parameter."""

from collections import Counter
from collections.abc import Mapping
from html import escape
from pathlib import PurePath
from typing import Any

from robotid.output.pages.html import block, facts_html, listing, page, with_error

_ROWS = 20  # failures on the page, and units that differ; all are in the files of results
_FAILURES = (
    ("unit", "code", "unit"), ("log", "code", "log"), ("alike", "d", "alike"),
    ("error", "text", "error"),
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
    failures, unlike = content["failures"], content["unlike"]
    facts = {
        "Units": f"{content['done']} of {content['units']} identified",
        "Logs": str(content["logs"]),
        "Verdicts": ", ".join(f"{n} {escape(v)}" for v, n in content["verdicts"].items()) or "none",
        "Failures": str(len(failures)),
        "Units that differ": str(len({entry["unit"] for entry in unlike})),
    }
    sections = {
        "failures": ("Failures", _failures(content)),
        "unlike": ("Units that differ", _unlike(content)),
        "parameters": ("Variation between units", _parameters(content)),
    }
    title = f"Fleet of {content['units']} units"
    return page(title, f"<h1>{title}</h1>\n{facts_html(facts)}", sections)


def _failures(content: Mapping[str, Any]) -> str:
    """Return the failures, the first of each kind first."""
    failures = content["failures"]
    kinds = [_kind(failure) for failure in failures]
    count, first = Counter(kinds), {kind: k for k, kind in reversed([*enumerate(kinds)])}
    order = sorted(range(len(kinds)), key=lambda k: (first[kinds[k]] != k, k))
    rows = [
        failures[k] | {"log": failures[k]["log"] or "all", "alike": count[kinds[k]]}
        for k in order[:_ROWS]
    ]
    table = listing("Units and logs that were not identified", _FAILURES, rows)
    return table + _more(len(failures), "fleet.parquet") if table else "<p>None.</p>\n"


def _kind(failure: Mapping[str, str]) -> str:
    """Return the error without the names of its unit and log."""
    kind = failure["error"]
    for name in (failure["log"], PurePath(failure["log"]).name, failure["unit"]):
        kind = kind.replace(name, "") if name else kind
    return kind


def _more(count: int, file: str) -> str:
    """Return a note on the rows that are not shown."""
    return block("fleet.more", count=count - _ROWS, file=file) if count > _ROWS else ""


def _with_errors(entry: Mapping[str, Any], value: str, ends: str) -> dict[str, Any]:
    """Return an entry with its value and ends to the digits of its standard error."""
    error = entry["std_error"]
    digits, std_error = with_error(entry[value], error)
    low, high = (with_error(x, error)[0] for x in entry[ends])
    return {**entry, value: digits, "std_error": std_error, "low": low, "high": high}


def _unlike(content: Mapping[str, Any]) -> str:
    rows = [_with_errors(entry, "value", "others") for entry in content["unlike"][:_ROWS]]
    table = listing("Units that differ from the others", _UNLIKE, rows, is_data=True)
    more = _more(len(content["unlike"]), "fleet.json")
    return block("fleet.unlike") + table + more if table else "<p>None.</p>\n"


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
