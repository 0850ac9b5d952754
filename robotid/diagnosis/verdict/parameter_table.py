"""The identified parameters as a table for Python: a row per parameter."""

import math
from collections.abc import Iterable, Mapping
from html import escape
from importlib.util import find_spec
from typing import Any

from robotid.base.files import finite
from robotid.diagnosis.verdict.correlation import correlated_parameters
from robotid.estimation.fitting.fitted import Identified

#: Columns of a row: link or drive, parameter, the URDF's value, the identified one, its standard
#: error, its 95 % interval, what determined it, unit.
HEADERS = ("part", "parameter", "urdf", "value", "std_error", "low", "high", "source", "unit")
_NUMBERS = HEADERS[2:7]


class ParameterRows(list[dict[str, Any]]):
    """The rows if pandas is not installed: dictionaries, which a notebook shows as a table."""

    def _repr_html_(self) -> str:
        rows = [HEADERS, *(tuple("" if x is None else x for x in row.values()) for row in self)]
        html = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
        return f"<table>{html}</table>"


def _cell(value: object) -> str:
    words = f"{value:.4g}" if isinstance(value, float) else str(value)
    return f"<td>{escape(words)}</td>"


def parameter_entries(found: Identified) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the parameters of the bodies and of the drives, as in result.json."""
    layout, sources, at_bound = found.model.layout, found.sources, found.at_bound
    errors, ends, quantile = found.standard_error, found.standard_interval, found.standard_quantile
    pairs = correlated_parameters(found)
    entries = [
        {
            "name": name,
            "value": float(found.standard[i]),
            "std_error": finite(errors[i]),
            "quantile": float(quantile[i]) if math.isfinite(errors[i]) else None,
            "interval_95": [finite(end) for end in ends[i]],
            "unit": layout.units[i],
            "prior": float(found.prior[i]),
            "source": sources[i],
            "at_bound": bool(at_bound[i]),
            **(_partner(layout.names[pairs[i][0]], pairs[i][1]) if i in pairs else {}),
        }
        for i, name in enumerate(layout.names)
    ]
    return entries[: layout.n_inertial], entries[layout.n_inertial :]


def _partner(name: str, correlation: float) -> dict[str, Any]:
    return {"correlated_with": name, "correlation": correlation}


def parameter_table(
    bodies: Iterable[Mapping[str, Any]], drives: Iterable[Mapping[str, Any]]
) -> Any:  # noqa: ANN401
    """Return the parameters of a result as a table, links first, then drives."""
    entries = [*bodies, *({**entry, "prior": None} for entry in drives)]
    rows = ParameterRows()
    for entry in entries:
        part, _, parameter = entry["name"].rpartition(".")
        low, high = entry.get("interval_95", (None, None))  # of results without intervals
        values = [entry.get("prior"), entry["value"], entry.get("std_error"), low, high]
        row = (part, parameter, *values, entry.get("source", ""), entry["unit"])
        rows.append(dict(zip(HEADERS, row, strict=True)))
    if find_spec("pandas") is None:
        return rows
    import pandas

    frame = pandas.DataFrame(rows, columns=list(HEADERS))
    return frame.astype(dict.fromkeys(_NUMBERS, float))
