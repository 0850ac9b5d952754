"""Findings about logs whose parameters differ from those of the other logs."""

from collections.abc import Iterator

from robotid.findings import Finding
from robotid.variation.variation import UnlikeRun, Variation

__all__ = ["unlike_findings"]


def unlike_findings(variation: Variation | None) -> Iterator[Finding]:
    """Yield a finding for each log that differs from what the others predict.

    Args:
        variation: The variation between the fitted logs; None if there are too few.
    """
    if variation is None:
        return
    others = len(variation.runs) - 1
    for found in variation.unlike:
        log = variation.runs[found.run]
        low, high = found.ends
        message = f"{log}: {_words(found)}; {others} other logs predict " + (
            f"{100 * (low - 1):+.3g} to {100 * (high - 1):+.3g} %"
            if found.kind == "gain"
            else f"{low:.3g} to {high:.3g} {found.unit}"
        )
        evidence = {
            "value": found.value, "std_error": found.std_error, "low": float(low),
            "high": float(high), "probability": found.probability,
        }  # fmt: skip
        yield Finding("unlike_run", "warning", log, f"{message}. {_REMEDY[found.kind]}", evidence)


_REMEDY = {
    "payload": "A load may be mounted: leave the log out, or identify the load by robotid payload",
    "gain": "The torque constant, the sensor or the temperature may have changed: leave the log "
    "out, or correct its torque",
    "drive": "Temperature, lubrication or the zero of a sensor may have changed: leave the log "
    "out, or use the interval of the next log",
}


def _words(found: UnlikeRun) -> str:
    """Return what differs in the log, as text."""
    size = f"{found.value:.3g} +- {found.std_error:.2g}"
    if found.kind == "payload":
        return f"{found.name} is {size} {found.unit} more than in the other logs"
    if found.kind == "gain":
        change = f"{100 * (found.value - 1):+.3g} +- {100 * found.std_error:.2g} %"
        return f"the torque of {found.where} differs from that of the fit by {change}"
    return f"{found.name} is {size} {found.unit}"
