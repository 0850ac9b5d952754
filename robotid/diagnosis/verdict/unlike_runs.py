"""Findings about logs and units (robots) whose parameters differ from those of the others."""

from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from robotid.base.findings import Finding
from robotid.diagnosis.catalogue import finding
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
    for unlike in variation.unlike_units:
        name = f"unit {variation.unit_names[unlike.run]}"
        yield _unlike("unlike_unit", name, unlike, variation.units - 1, "other units")
    for unlike in variation.unlike:
        count = len(variation.runs) - 1
        yield _unlike("unlike_run", variation.runs[unlike.run], unlike, count, "other logs")


def _unlike(code: str, name: str, unlike: UnlikeRun, others: int, rest: str) -> Finding:
    """Return the finding about a log or a unit, with the prediction of the others."""
    (low, high), kind = (float(end) for end in unlike.ends), unlike.kind
    size, span = f"{unlike.value:.3g} +- {unlike.std_error:.2g}", f"{low:.3g} to {high:.3g}"
    if kind == "zero":
        size = f"{unlike.value:+.3g} +- {unlike.std_error:.2g}"
    if kind == "gain":
        size = f"{100 * (unlike.value - 1):+.3g} +- {100 * unlike.std_error:.2g} %"
        span = f"{100 * (low - 1):+.3g} to {100 * (high - 1):+.3g} %"
    return finding(
        code, subject=name, name=name, what=kind, cure=kind, others=f"{others} {rest}", rest=rest,
        parameter=unlike.where if kind in ("zero", "gain") else unlike.name, unit=unlike.unit,
        size=size, range=span if kind == "gain" else f"{span} {unlike.unit}", value=unlike.value,
        std_error=unlike.std_error, low=low, high=high, probability=unlike.probability,
    )  # fmt: skip


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
            tau, predicted = motion.tau[mask[:, k], k], e.torques["estimate"][mask[:, k], k]
            factor = float(predicted @ tau) / max(float(predicted @ predicted), 1e-300)
            left = float(np.sum((tau - factor * predicted) ** 2) / np.sum((tau - predicted) ** 2))
            if abs(factor - 1.0) < _RESCALED or left > _LEFT:
                continue
            friction = friction or friction_shares(fit)
            yield finding(
                "gain_change", log, joint, what=friction[joint] > _MOSTLY, factor=factor,
                share_pct=100 * (1 - left), friction=friction[joint],
            )  # fmt: skip
