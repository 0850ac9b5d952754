"""Evidence for a verdict: prediction errors, what the data determine, what a result is for."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from robotid.base.findings import listed, quoted
from robotid.diagnosis.catalogue import sentence_of
from robotid.estimation.fitting.evaluation import JointMetrics, Metrics

if TYPE_CHECKING:
    from robotid.diagnosis.verdict.scale_check import ScaleCheck

#: [%] largest torque prediction error on validation logs of a joint that is "good".
GOOD = 15.0
#: [%] a joint with a larger torque prediction error is not usable.
POOR = 50.0
#: A simpler model is better if its error is smaller by this factor ...
BEATEN = 1.05
#: [%] a larger error on the fitted logs, twice that of WLS, makes a joint poor.
COSTLY = 3.0
_TIE = 0.3  # [%] ... and, for the URDF with fitted drives, by this share of the torque
_OPTIMISM = 2.0  # validation error over fitted error beyond which the fit is over-fitted
_BASE = "base."  # of the rows of a floating base
_WRONG = 2.0  # an error this many times that of WLS gives a warning ...
_HARMLESS = 1.0  # [%] ... but not below this share of the torque
_NAMED = 8  # parameters that a reason names
_USES_NAMED = 3  # joints that the line names
_NOT_VERIFIED = "not verified, no validation log"
_UNSCALED = "torque scale not verified"


@dataclass(frozen=True)
class Predictions:
    """Torque prediction errors of each joint.

    Attributes:
        fit: Metrics over the fitted recordings.
        validation: Metrics of each validation log, by its name; or of each log left out in turn.
        joints: The model's joints; one without a sample in any recording is not evaluated.
        refitted: Names of validation logs that are left out because they contain fitted samples.
        hidden: Joints that are not evaluated, as of ``hidden_joints``; their metrics are ignored.
    """

    fit: Metrics
    validation: Mapping[str, Metrics]
    joints: Sequence[str] = ()
    refitted: Sequence[str] = ()
    hidden: Sequence[str] = ()

    @cached_property
    def fitted(self) -> dict[str, JointMetrics]:
        """Metrics of each joint over the fitted recordings."""
        return self._evaluated(self.fit)

    @cached_property
    def tested(self) -> dict[str, dict[str, JointMetrics]]:
        """Metrics of each joint on each validation log."""
        return {log: self._evaluated(metrics) for log, metrics in self.validation.items()}

    def _evaluated(self, metrics: Metrics) -> dict[str, JointMetrics]:
        """Return the metrics of joints; those of a floating base if no joint has any."""
        found = {joint: m for joint, m in metrics.per_joint.items() if joint not in self.hidden}
        joints = {name: m for name, m in found.items() if not name.startswith(_BASE)}
        return joints or found

    def of_base(self) -> list[str]:
        """Return the prediction errors of the wrench on a floating base, beside its joints'."""
        notes = []
        for log, metrics in self.validation.items():
            own = {x: m for x, m in metrics.per_joint.items() if x.startswith(_BASE)}
            if not own or own.keys() & self.tested[log].keys():
                continue
            errors = [f"{x.removeprefix(_BASE)} {error_of(m):.0f} %" for x, m in own.items()]
            notes.append(sentence_of("verdict:base", log=log, errors=listed(errors)))
        return notes

    def on_each(self) -> dict[str, JointEvidence]:
        """Return the evidence for each joint."""
        moved = [joint for m in (self.fitted, *self.tested.values()) for joint in m]
        named = [joint for joint in self.joints if joint not in self.hidden]
        return {joint: self._on(joint) for joint in dict.fromkeys([*named, *moved])}

    def _on(self, joint: str) -> JointEvidence:
        evidence = JointEvidence()
        for log, metrics in self.tested.items():
            if (measured := metrics.get(joint)) is not None:
                _judge_joint(evidence, joint, log, measured, self.fitted.get(joint))
                evidence.errors.append(error_of(measured))
        return evidence

    def untested(self) -> list[str]:
        """Return why no prediction of unseen motion was evaluated; empty if one was."""
        if self.validation:
            return []
        what = "refitted" if self.refitted else "none"
        return [sentence_of("verdict:untested", what=what, logs=listed(self.refitted))]

    def better_by_urdf(self, rescaled: Collection[str] = ()) -> list[str]:
        """Return the joints that the URDF with fitted drives predicts better, and the remedy."""
        worse = [j for own in self.tested.values() for j, m in own.items() if is_beaten(m)]
        worse = [joint for joint in worse if joint not in rescaled]
        joints = listed(dict.fromkeys(worse))
        return [sentence_of("verdict:urdf", joints=joints)] if worse else []

    def at_rest(self) -> list[str]:
        """Return the joints at rest in all recordings, and those at rest in all validation logs."""
        fitted, validated = self.fitted, {joint for own in self.tested.values() for joint in own}
        names = [joint for joint in self.on_each() if joint not in validated]
        still = [joint for joint in names if joint not in fitted]
        missing = [joint for joint in names if joint in fitted]
        if still and not fitted:  # evaluated again without the fitted recordings
            still, missing = [], still
        named = {"recording": still, "validation log": missing if self.validation else []}
        return [
            sentence_of("verdict:rest", joints=listed(names), logs=logs)
            for logs, names in named.items()
            if names
        ]

    def why_untested(self, joint: str) -> str:
        """Return why a joint was evaluated on no validation log."""
        if joint not in self.fitted:
            return "it does not move in any recording"
        if self.validation:
            return "it does not move in any validation log"
        return "no validation log given"


@dataclass(frozen=True)
class JointEvidence:
    """Why a joint is poor, the worst kind of reason first; cautions; errors by log [%]."""

    poor: list[tuple[int, str]] = field(default_factory=list)
    cautions: list[str] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Determined:
    """Parameters that the data determine.

    Attributes:
        undetermined: Base parameters that the data do not determine individually.
        is_consistent: Whether the parameters are physically consistent.
        is_poorly_excited: Whether a richer motion would determine them; else noise is the limit.
        is_static: Whether the model is static.
        uncertain_drives: Other drive parameters whose standard error is not smaller than 0.9 of
            their prior standard deviation.
    """

    undetermined: Sequence[str] = ()
    is_consistent: bool = True
    is_poorly_excited: bool = True
    is_static: bool = False
    uncertain_drives: Sequence[str] = ()

    def warnings(self) -> list[str]:
        """Return the reasons why the result is at best usable."""
        is_open = bool(self.undetermined) and self.is_poorly_excited
        holds = {"open": is_open, "inconsistent": not self.is_consistent}
        return [self._sentence(what, self.undetermined) for what, is_so in holds.items() if is_so]

    def notes(self) -> list[str]:
        """Return notes that do not change the verdict: parameters hidden by the noise."""
        hidden = () if self.is_poorly_excited else self.undetermined
        named = {"hidden": hidden, "drives": self.uncertain_drives}
        return [self._sentence(what, names) for what, names in named.items() if names]

    @staticmethod
    def _sentence(what: str, names: Sequence[str]) -> str:
        named = listed(names, _NAMED)
        return sentence_of("verdict:determined", what=what, count=len(names), names=named)


def is_beaten(measured: JointMetrics) -> bool:
    """Return whether the URDF with fitted drives predicts a joint clearly better."""
    driven = measured.baselines.get("urdf_with_drives")
    return driven is not None and error_of(measured) > max(BEATEN * driven, driven + _TIE)


def is_harmless_cost(error: float, wls_error: float) -> bool:
    """Return whether constraints cost so little torque error that the verdict does not count it."""
    return error < max(_WRONG * wls_error, _HARMLESS)


def error_of(measured: JointMetrics) -> float:
    """Return the relative error of a joint [%], inf where nothing was measured."""
    value = measured.relative_error_pct
    return float("inf") if value is None else value


def _judge_joint(
    evidence: JointEvidence,
    joint: str,
    log: str,
    measured: JointMetrics,
    fitted: JointMetrics | None,
) -> None:
    """Add the first reason that one log gives: rank 0 is worse than a constant, 1 than the URDF."""
    error, urdf = error_of(measured), measured.baselines.get("urdf")
    urdf = np.inf if urdf is None else urdf
    before = 0.0 if fitted is None else error_of(fitted)
    is_flat = not measured.better_than_constant and not joint.startswith(_BASE)  # no weight alone
    kinds = {
        "zero": (2, measured.relative_error_pct is None),
        "constant": (0, is_flat),
        "urdf": (1, error > urdf),
        "poor": (2, error > POOR),
        "usable": (None, error > GOOD),
        "optimistic": (None, fitted is not None and error > max(_OPTIMISM * before, 5.0)),
        "beaten": (None, is_beaten(measured)),
    }
    what, rank = next(((x, rank) for x, (rank, holds) in kinds.items() if holds), ("", None))
    if not what:
        return
    driven = measured.baselines.get("urdf_with_drives") or 0.0
    constant = error / np.sqrt(1.0 - measured.r2) if what == "constant" else 0.0
    text = sentence_of(
        "verdict:joint", what=what, subject_of=joint, on=log, error=error, urdf=urdf, fit=before,
        quoted=quoted(joint), driven=driven, constant=constant,
        poor=POOR, good=GOOD,
    )  # fmt: skip
    if rank is None:
        evidence.cautions.append(text)
    else:
        evidence.poor.append((rank, text))


def uses_of_torques(
    joints: Mapping[str, str],
    *,
    is_consistent: bool,
    is_static: bool,
    log_errors: Sequence[str],
    scale_check: ScaleCheck | None,
) -> dict[str, str]:
    """Return what a result with predicted torques can be used for: "yes" or "no", and why.

    Torque feed-forward needs the predicted torque of its joints. Inertials in a simulation need
    physical consistency and the torque scale, too. The mass of a payload is that of the gravity
    torque: it needs the joints that gravity loads, and the torque scale.
    """
    predicted = _predicted(joints)
    loaded = (
        {} if scale_check is None else {j: s for j, s in joints.items() if j in scale_check.gravity}
    )
    if log_errors:
        predicted = inertials = payload = "no, errors of the recordings"
    elif scale_check is not None and scale_check.contradicts:
        inertials = payload = "no, the torque scale is contradicted"
    else:
        is_scaled = scale_check is not None and scale_check.agrees
        inertials = predicted if is_scaled else _with(predicted, _UNSCALED)
        payload = _predicted(loaded) if loaded else "no, no joint determines its gravity"
        payload = payload if is_scaled else _with(payload, _UNSCALED)
        if not is_consistent:
            inertials = "no, not physically consistent"
        elif "poor" in joints.values():
            inertials = f"no, torques of {_named(joints, 'poor')} are poor"
    if is_static:
        predicted = _with(predicted, "at rest and in slow motion")
        inertials = "no, inertias are the URDF's" if inertials.startswith("yes") else inertials
    return {
        "torque feed-forward": predicted,
        "inertials in simulation": inertials,
        "payload estimation": payload,
    }


def uses_of_motion(
    joints: Mapping[str, str], *, log_errors: Sequence[str], is_scaled: bool
) -> dict[str, str]:
    """Return what a result with simulated positions can be used for: "yes" or "no", and why."""
    simulated = "no, errors of the recordings" if log_errors else _predicted(joints)
    torque = simulated if is_scaled else _with(simulated, "scale not verified by a torque")
    return {
        "simulation of drives and controllers": simulated,
        "torque feed-forward": torque,
        "payload estimation": "no, it needs a result from logged torques",
    }


def uses_line(uses: Mapping[str, str]) -> str:
    """Return the uses as one line of text; "" if there are none."""
    return f"use for: {'; '.join(f'{what}: {is_so}' for what, is_so in uses.items())}" * bool(uses)


def _predicted(joints: Mapping[str, str]) -> str:
    """Return whether the predictions of joints can be used."""
    tested = {joint: status for joint, status in joints.items() if status != "not evaluated"}
    if not tested:
        return _NOT_VERIFIED
    poor = [joint for joint, status in tested.items() if status == "poor"]
    if len(poor) == len(tested):
        return "no, the errors on validation logs are large"
    if poor:
        return f"yes, without {_named(joints, 'poor')}"
    if len(tested) < len(joints):
        return f"yes, without {_named(joints, 'not evaluated')} (not evaluated)"
    return "yes, with the warnings" if "usable" in tested.values() else "yes"


def _named(joints: Mapping[str, str], status: str) -> str:
    """Return the joints with a status, as part of a sentence."""
    return listed([joint for joint, found in joints.items() if found == status], _USES_NAMED)


def _with(use: str, condition: str) -> str:
    """Return a use under a condition; a "no" remains."""
    return f"{use}, {condition}" if use.startswith("yes") else use
