"""Findings about logs and units (robots) whose parameters differ from those of the others."""

from collections.abc import Iterator, Mapping

from robotid.findings import Finding
from robotid.variation.variation import UnlikeRun, Variation

__all__ = ["unlike_findings"]


def unlike_findings(variation: Variation | None) -> Iterator[Finding]:
    """Yield a finding for each unit and log that differs from what the others predict.

    Args:
        variation: The variation between the fitted logs; None if there are too few.
    """
    if variation is None:
        return
    for found in variation.unlike_units:
        name = variation.unit_names[found.run]
        others = f"{variation.units - 1} other units"
        yield _finding("unlike_unit", f"unit {name}", found, others, _UNIT_REMEDY)
    for found in variation.unlike:
        name, others = variation.runs[found.run], f"{len(variation.runs) - 1} other logs"
        yield _finding("unlike_run", name, found, others, _REMEDY)


def _finding(
    code: str, name: str, found: UnlikeRun, others: str, remedies: Mapping[str, str]
) -> Finding:
    """Return the finding about a log or a unit, with the prediction of the others."""
    low, high = found.ends
    message = f"{name}: {_words(found, others)}; {others} predict " + (
        f"{100 * (low - 1):+.3g} to {100 * (high - 1):+.3g} %"
        if found.kind == "gain"
        else f"{low:.3g} to {high:.3g} {found.unit}"
    )
    evidence = {
        "value": found.value, "std_error": found.std_error, "low": float(low),
        "high": float(high), "probability": found.probability,
    }  # fmt: skip
    return Finding(code, "warning", name, f"{message}. {remedies[found.kind]}", evidence)


_REMEDY = {
    "payload": "A load may be mounted: leave the log out, or identify the load by robotid payload",
    "gain": "The torque constant, the sensor or the temperature may have changed: leave the log "
    "out, or correct its torque",
    "drive": "Temperature, lubrication or the zero of a sensor may have changed: leave the log "
    "out, or use the interval of the next log",
}

_UNIT_REMEDY = {
    "payload": "A load may be mounted, or its last link is another version: remove the load, or "
    "identify this robot alone",
    "gain": "Its torque constant or sensor differs: correct its torque, or identify this robot "
    "alone",
    "drive": "Its drive may be worn, cold, or of another version: identify this robot alone, or "
    "use the interval of the next robot",
}


def _words(found: UnlikeRun, others: str) -> str:
    """Return what differs in the log or unit, as text."""
    size = f"{found.value:.3g} +- {found.std_error:.2g}"
    if found.kind == "payload":
        return f"{found.name} is {size} {found.unit} more than in the {others.split(' ', 1)[1]}"
    if found.kind == "gain":
        change = f"{100 * (found.value - 1):+.3g} +- {100 * found.std_error:.2g} %"
        return f"the torque of {found.where} differs from that of the fit by {change}"
    return f"{found.name} is {size} {found.unit}"
