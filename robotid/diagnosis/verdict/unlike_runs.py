"""Findings about logs and units (robots) whose parameters differ from those of the others."""

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import numpy as np

from robotid.base.findings import Finding, log_finding
from robotid.diagnosis.verdict.evidence import GOOD, error_of
from robotid.diagnosis.verdict.scale_check import friction_shares
from robotid.estimation.fitting.fitted import Fit
from robotid.estimation.variation.variation import UnlikeRun, Variation

_RESCALED = 0.1  # least difference from 1 of a factor between measured and predicted torque
_LEFT = 1 / 3  # ... and the largest share of the squared error that it leaves
_MOSTLY = 0.6  # share of friction in a torque from which friction may have changed, too


def unlike_findings(variation: Variation | None) -> Iterator[Finding]:
    """Yield a finding for each unit and log that differs from what the others predict."""
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


def rescaled_findings(fit: Fit, loaded: Collection[str] = ()) -> Iterator[Finding]:
    """Yield a finding for each torque of a validation log that is a multiple of its prediction.

    The factor c minimises |tau - c tau_predicted| over the rows used. It is reported if the torque
    error is above the limit of a good prediction, and the factor removes most of its square.
    """
    if fit.model.constraints:  # the rows are projected, and mix the joints
        return
    friction = dict[str, float]()
    for e in fit.validation:
        motion, mask = e.recording.trajectory, e.recording.mask
        log = Path(e.recording.log.path).name
        if e.is_refitted or e.recording.is_partial or log in loaded:
            continue
        for k, joint in enumerate(fit.model.row_names):
            measured = e.metrics["estimate"].per_joint.get(joint)
            if joint not in fit.model.joints or measured is None or error_of(measured) <= GOOD:
                continue
            if measured.relative_error_pct is None:
                continue  # the torque is 0: it has no gain
            tau, own = motion.tau[mask[:, k], k], e.torques["estimate"][mask[:, k], k]
            factor = float(own @ tau) / max(float(own @ own), 1e-300)
            left = float(np.sum((tau - factor * own) ** 2) / np.sum((tau - own) ** 2))
            if abs(factor - 1.0) < _RESCALED or left > _LEFT:
                continue
            friction = friction or friction_shares(fit)
            what = "its gain differs"
            if friction[joint] > _MOSTLY:
                what = f"its gain, or its friction ({100 * friction[joint]:.0f} % of it), differs"
            message = (
                f"the torque of {joint} is {factor:.2f} times the predicted one. This factor "
                f"explains {100 * (1 - left):.0f} % of the squared error: {what} between this log "
                "and the fitted ones; check the gain of each log"
            )
            evidence = {"factor": factor, "share_pct": 100 * (1 - left)}
            yield log_finding(log, "gain_change", "warning", message, joint, **evidence)


_REMEDY = {
    "payload": "A load may be mounted: leave the log out, or identify the load by robotid payload",
    "gain": "The torque constant, the sensor or the temperature may have changed: leave the log "
    "out, or correct its torque",
    "drive": "Temperature, lubrication or the zero of a sensor may have changed: leave the log "
    "out, or use the interval of the next log",
    "zero": "The encoder may have slipped, or been calibrated again: correct the positions of the "
    "log, or leave it out",
}

_UNIT_REMEDY = {
    "payload": "A load may be mounted, or its last link is another version: remove the load, or "
    "identify this robot alone",
    "gain": "Its torque constant or sensor differs: correct its torque, or identify this robot "
    "alone",
    "drive": "Its drive may be worn, cold, or of another version: identify this robot alone, or "
    "use the interval of the next robot",
    "zero": "Its encoder is calibrated otherwise: correct the positions of its logs, or identify "
    "this robot alone",
}


def _words(found: UnlikeRun, others: str) -> str:
    """Return what differs in the log or unit, as text."""
    size = f"{found.value:.3g} +- {found.std_error:.2g}"
    those = others.split(" ", 1)[1]
    if found.kind == "payload":
        return f"{found.name} is {size} {found.unit} more than in the {those}"
    if found.kind == "zero":
        sized = f"{found.value:+.3g} +- {found.std_error:.2g} {found.unit}"
        return f"the positions of {found.where} differ by {sized} from those in the {those}"
    if found.kind == "gain":
        change = f"{100 * (found.value - 1):+.3g} +- {100 * found.std_error:.2g} %"
        return f"the torque of {found.where} differs from that of the fit by {change}"
    return f"{found.name} is {size} {found.unit}"
