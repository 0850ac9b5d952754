"""Verdict on a result, with reasons; what was not tested is never "good"."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import Finding, grouped, listed, not_ignored, quoted, suggestion
from robotid.base.settings import require_kind
from robotid.diagnosis.catalogue import codes_with, reason_of, sentence_of
from robotid.diagnosis.decisions import BETTER, NO_ERROR_OF_MASSES
from robotid.diagnosis.verdict.scale_check import ScaleCheck
from robotid.estimation.fitting.evaluation import JointMetrics, Metrics, logs_that_test

GOOD = 15.0  # [%] largest torque prediction error on validation logs of a joint that is "good"
POOR = 50.0  # [%] a joint with a larger torque prediction error is not usable
GOOD_POSITION = 5.0  # [%] the same limit of simulated position errors
POOR_POSITION = 30.0
#: Error over that of the second-order model from which it is hardly smaller: half the squares.
HARDLY = 0.7
BEATEN = 1.05  # A simpler model is better if its error is smaller by this factor ...
_TIE = 0.3  # [%] ... and, for the URDF with fitted drives, by this share of the torque
COSTLY = 3.0  # [%] a larger error on the fitted logs, twice that of WLS, makes a joint poor
#: [%] of the torque: a smaller prediction error rejects a hypothesis on columns or masses, and
#: gives no warning of a missing drive term.
SMALL = 5.0
_HARMLESS = 1.0  # [%] of the torque, below which an error gives no warning
_MUCH = 1 / BETTER  # ratio of two errors, or of two gravity torques, that is no chance
_BASE = "base."  # of the rows of a floating base
NAMED = 8  # Parameters, joints or places that a sentence names
_NOT_VERIFIED = "not verified, no validation log"
_UNSCALED = "torque scale not verified"
_HYPOTHESES = ("current_for_torque", "gravity", "gravity_compensated", "unexplained_torque",
               "urdf_mismatch")  # fmt: skip
# places that are not a recording
_OF_THE_FIT = ("all joints", "estimator", "recordings", "standard_parameters")
_SIMPLER = ("command", "second_order", "urdf", "rows", "steady")  # baselines of simpler models


@dataclass(frozen=True)
class Predictions:
    """Torque prediction errors of each joint."""

    fit: Metrics  # over the fitted recordings
    validation: Mapping[str, Metrics]  # by validation log, or by log left out in turn
    #: The model's joints; one without a sample in any recording is not evaluated.
    joints: Sequence[str] = ()
    refitted: Sequence[str] = ()  # validation logs left out because they contain fitted samples
    hidden: Sequence[str] = ()  # joints not evaluated, of ``hidden_joints``; without metrics
    pinned: Sequence[str] = ()  # joints whose links keep the URDF's values, of ``pinned_joints``

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
        rows = {row: m for row, m in metrics.per_joint.items() if row not in self.hidden}
        joints = {row: m for row, m in rows.items() if not row.startswith(_BASE)}
        return joints or rows

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
        every = {joint: JointEvidence() for joint in dict.fromkeys([*named, *moved])}
        for log, metrics in self.tested.items():
            for joint, measured in metrics.items():
                _judge_joint(every[joint], joint, log, measured, self.fitted.get(joint))
                every[joint].errors.append(error_of(measured))
        return every

    def untested(self) -> list[str]:
        """Return why no prediction of unseen motion was evaluated; empty if one was."""
        if self.validation:
            return []
        logs = listed(self.refitted)
        return [sentence_of("verdict:untested", what=bool(self.refitted), logs=logs)]

    def better_by_urdf(self, rescaled: Collection[str] = ()) -> list[str]:
        """Return the joints that the URDF with fitted drives predicts better, and the remedy."""
        tested = (pair for metrics in self.tested.values() for pair in metrics.items())
        worse = dict.fromkeys(j for j, m in tested if is_beaten(m) and j not in rescaled)
        by_link = ((x, [j for j in worse if (j in self.pinned) is x]) for x in (False, True))
        return [sentence_of("verdict:urdf", joints=listed(j), pinned=x) for x, j in by_link if j]

    def at_rest(self) -> list[str]:
        """Return the joints at rest in all recordings, and those at rest in all validation logs."""
        fitted, validated = self.fitted, {joint for own in self.tested.values() for joint in own}
        names = [joint for joint in self.on_each() if joint not in validated]
        still = [joint for joint in names if joint not in fitted]
        missing = [joint for joint in names if joint in fitted]
        rest = {"recording": still, "validation log": missing if self.validation else []}
        return [sentence_of("verdict:rest", joints=listed(x), logs=k) for k, x in rest.items() if x]

    def why_untested(self, joint: str) -> str:
        """Return why a joint was evaluated on no validation log."""
        if joint in self.fitted and not self.validation:
            return "all logs contain fitted samples" if self.refitted else "no validation log given"
        logs = "validation log" if joint in self.fitted else "recording"
        return f"no {logs} has motion and a torque that varies"


@dataclass(frozen=True)
class JointEvidence:
    """Why a joint is poor, the worst kind of reason first; cautions; errors by log [%]."""

    poor: list[tuple[int, str]] = field(default_factory=list)
    cautions: list[str] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Determined:
    """Parameters that the data determine."""

    undetermined: Sequence[str] = ()  # base parameters that are not determined individually
    is_consistent: bool = True  # whether the parameters are physically consistent
    is_poorly_excited: bool = True  # whether a richer motion would determine them; else noise
    is_static: bool = False
    uncertain_drives: Sequence[str] = ()  # standard error from 0.9 of the prior's deviation

    def warnings(self) -> list[str]:
        """Return the reasons why the result is at best usable."""
        is_open = bool(self.undetermined) and self.is_poorly_excited
        reasons = [self._sentence("open", self.undetermined)] if is_open else []
        return reasons if self.is_consistent else [*reasons, self._sentence("inconsistent", ())]

    def notes(self) -> list[str]:
        """Return notes that do not change the verdict: parameters hidden by the noise."""
        hidden = () if self.is_poorly_excited else self.undetermined
        named = {"hidden": hidden, "drives": self.uncertain_drives}
        return [self._sentence(what, names) for what, names in named.items() if names]

    @staticmethod
    def _sentence(what: str, names: Sequence[str]) -> str:
        named = listed(names, NAMED)
        return sentence_of("verdict:determined", what=what, count=len(names), names=named)


def is_beaten(measured: JointMetrics) -> bool:
    """Return whether the URDF with fitted drives predicts a joint clearly better."""
    driven = measured.baselines.get("urdf_with_drives")
    return driven is not None and error_of(measured) > max(BEATEN * driven, driven + _TIE)


def is_harmless_cost(error: float, wls_error: float) -> bool:
    """Return whether constraints cost so little torque error that the verdict does not count it."""
    return error < max(_MUCH * wls_error, _HARMLESS)


def error_of(measured: JointMetrics) -> float:
    """Return the relative error of a joint [%], inf where nothing was measured."""
    value = measured.relative_error_pct
    return float("inf") if value is None else value


def _judge_joint(
    evidence: JointEvidence, joint: str, log: str, measured: JointMetrics,
    fitted: JointMetrics | None,
) -> None:  # fmt: skip
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
        "optimistic": (None, fitted is not None and error > max(_MUCH * before, SMALL)),
        "beaten": (None, is_beaten(measured)),
    }
    what, rank = next(((x, rank) for x, (rank, holds) in kinds.items() if holds), ("", None))
    if not what:
        return
    driven = measured.baselines.get("urdf_with_drives") or 0.0
    constant = error / np.sqrt(1.0 - measured.r2) if what == "constant" else 0.0
    text = sentence_of(
        "verdict:joint", what=what, subject_of=joint, on=log, error=error, urdf=urdf, fit=before,
        quoted=quoted(joint), driven=driven, constant=constant, poor=POOR, good=GOOD,
    )  # fmt: skip
    if rank is None:
        evidence.cautions.append(text)
    else:
        evidence.poor.append((rank, text))


def uses_of_torques(
    joints: Mapping[str, str], *, is_consistent: bool, is_static: bool, log_errors: Sequence[str],
    scale_check: ScaleCheck | None, inaccurate: Collection[str] = (),
) -> dict[str, str]:  # fmt: skip
    """Return what a result with predicted torques can be used for: "yes" or "no", and why."""
    # Inertials need consistency and the scale; a payload joints that gravity loads, and the scale.
    poor = [joint for joint, status in joints.items() if status == "poor"]
    joints = {**joints, **dict.fromkeys(inaccurate, "poor")}
    predicted, gravity = _predicted(joints), () if scale_check is None else scale_check.gravity
    loaded = {joint: status for joint, status in joints.items() if joint in gravity}
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
        elif poor:
            inertials = f"no, torques of {listed(poor, NAMED)} are poor"
    if is_static:
        predicted = _with(predicted, "at rest and in slow motion")
        inertials = "no, inertias are the URDF's" if inertials.startswith("yes") else inertials
    uses = ("torque feed-forward", "inertials in simulation", "payload estimation")
    return dict(zip(uses, (predicted, inertials, payload), strict=True))


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
    poor = [joint for joint, status in joints.items() if status == "poor"]
    untested = [joint for joint, status in joints.items() if status == "not evaluated"]
    passed = [joint for joint in joints if joint not in (*poor, *untested)]
    if not passed:
        return "no, the errors on validation logs are large" if poor else _NOT_VERIFIED
    if len(passed) < len(poor):
        return f"yes, for {listed(passed, NAMED)} only"
    if poor or untested:
        return f"yes, without {listed(poor or untested, NAMED)}{' (not evaluated)' * (not poor)}"
    return "yes, with the warnings" if "usable" in joints.values() else "yes"


def _with(use: str, condition: str) -> str:
    """Return a use under a condition; a "no" remains."""
    return f"{use}, {condition}" if use.startswith("yes") else use


@dataclass(frozen=True)
class VerdictWarning:
    """Reason why a result may be wrong although it predicts torque well."""

    code: str  # of the finding
    joint: str  # empty if the whole result is concerned
    message: str
    effect: str = "usable"  # the best verdict on the joint with this warning: or "poor"


@dataclass(frozen=True)
class JointVerdict:
    """Verdict on the torque prediction of one joint."""

    status: str  # "good", "usable", "poor" or "not evaluated"
    reasons: tuple[str, ...]  # the worst first; for "good" what was checked


@dataclass(frozen=True)
class Verdict:
    """Verdict on a result."""

    status: str  # "good", "usable", "poor" or "not evaluated"
    reasons: tuple[str, ...]  # the worst first; for "good" what was checked
    joints: Mapping[str, JointVerdict] = field(default_factory=dict)
    log_errors: tuple[str, ...] = ()  # faults of the recordings
    warnings: tuple[VerdictWarning, ...] = ()  # of the doctor and of the fit
    use_for: Mapping[str, str] = field(default_factory=dict)  # "yes" or "no" and why, by purpose

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as plain values, as result.json has it."""
        return {
            "status": self.status,
            "reasons": list(self.reasons),
            "per_joint": {
                joint: {"status": verdict.status, "reasons": list(verdict.reasons)}
                for joint, verdict in self.joints.items()
            },
            "log_errors": list(self.log_errors),
            "warnings": [asdict(warning) for warning in self.warnings],
            "use_for": dict(self.use_for),
        }


def judge(
    predictions: Predictions, determined: Determined, *, log_errors: Sequence[str] = (),
    warnings: Sequence[VerdictWarning] = (), scale_check: ScaleCheck | None = None,
    cause_of: Callable[[str], tuple[str, str]] = lambda joint: ("", ""),
) -> Verdict:  # fmt: skip
    """Return the verdict on a result."""
    evidence, hidden = predictions.on_each(), predictions.hidden
    unseen = sentence_of("verdict:note", what="hidden")
    costly = [w for w in warnings if w.effect == "poor" and w.joint in evidence]
    for warning in costly:
        evidence[warning.joint].poor.extend((2, text) for text in _described([warning]))
    stated, warnings = warnings, [warning for warning in warnings if warning not in costly]
    largest = sorted(evidence.values(), key=lambda one: -max(one.errors, default=0.0))
    is_far = scale_check is not None and scale_check.is_far
    scale = [] if scale_check is None else [scale_check.message]
    reasons = [
        *predictions.untested(),
        *(caution for one in largest for caution in one.cautions),
        *predictions.better_by_urdf({w.joint for w in warnings if w.code == "log_differs"}),
        *_described(warnings),
        *(scale if is_far else []),
        *predictions.at_rest(),
        *determined.warnings(),
    ]
    notes = [
        *determined.notes(),
        *predictions.of_base(),
        *([] if is_far else scale),
        *([f"{listed(hidden)}: {unseen}: not evaluated"] if hidden else []),
        *([sentence_of("verdict:note", what="static")] if determined.is_static else []),
    ]
    of_torque = [warning for warning in warnings if warning.code not in codes_with("of_body")]
    per_joint = {
        joint: on_joint(
            _ranked(one.poor),
            [*one.cautions, *_described([w for w in of_torque if w.joint in ("", joint)])],
            is_tested=bool(one.errors),
            checked=sentence_of("verdict:good", what="joint", error=max(one.errors))
            if one.errors
            else predictions.why_untested(joint),
        )
        for joint, one in evidence.items()
    }
    per_joint |= {joint: JointVerdict("not evaluated", (unseen,)) for joint in hidden}
    _explain_largest_error(per_joint, evidence, cause_of)
    errors = {joint: max(one.errors, default=0.0) for joint, one in evidence.items()}
    largest_error, logs = max(errors.values(), default=0.0), logs_that_test(predictions.validation)
    good = sentence_of("verdict:good", what="torque", logs=logs, error=largest_error)
    poor = _ranked(reason for one in largest for reason in one.poor)
    verdict = concluded(
        per_joint, poor=poor, warnings=reasons, good=good, notes=notes, log_errors=log_errors
    )
    uses = uses_of_torques(
        {joint: per_joint[joint].status for joint in evidence}, scale_check=scale_check,
        is_consistent=determined.is_consistent, is_static=determined.is_static,
        log_errors=log_errors, inaccurate=[x for x, error in errors.items() if error > GOOD],
    )  # fmt: skip
    return replace(verdict, warnings=tuple(stated), use_for=uses)


def _ranked(reasons: Iterable[tuple[int, str]]) -> list[str]:
    """Return reasons, the worst first."""
    return [text for _, text in sorted(reasons, key=lambda reason: reason[0])]


def _explain_largest_error(
    per_joint: dict[str, JointVerdict], evidence: Mapping[str, JointEvidence],
    cause_of: Callable[[str], tuple[str, str]],
) -> None:  # fmt: skip
    """Add the cause to the good joint with the largest error."""
    good = [joint for joint, verdict in per_joint.items() if verdict.status == "good"]
    if not good:
        return
    last = max(good, key=lambda joint: max(evidence[joint].errors))
    if cause := ". ".join(filter(None, cause_of(last))):
        text = f"largest error of the good joints: {cause}"
        per_joint[last] = replace(per_joint[last], reasons=(*per_joint[last].reasons, text))


def concluded(
    joints: Mapping[str, JointVerdict], *, poor: Sequence[str], warnings: Sequence[str], good: str,
    notes: Sequence[str] = (), log_errors: Sequence[str] = (), is_tested: bool = True,
) -> Verdict:  # fmt: skip
    """Return the verdict that follows from reasons; the same words about joints are one reason."""
    status = "usable" if warnings else "good"
    status = "poor" if poor or log_errors else status if is_tested else "not evaluated"
    parts = [(*x.partition(": "), x) for x in (*log_errors, *poor, *warnings)]
    reasons = _shared((name, words) if name in joints else ("", x) for name, _, words, x in parts)
    return Verdict(status, (*(reasons or [good]), *notes), joints, tuple(log_errors))


def on_joint(
    poor: Sequence[str], warnings: Sequence[str], *, is_tested: bool, checked: str
) -> JointVerdict:
    """Return the verdict on a joint."""
    if not is_tested:  # never a pass
        return JointVerdict("not evaluated", (checked, *warnings))
    if poor or warnings:
        return JointVerdict("poor" if poor else "usable", (*poor, *warnings))
    return JointVerdict("good", (checked,))


def check_ignored(ignore: Sequence[str]) -> None:
    """Check that every code to ignore is the code of an error or a warning."""
    known = sorted({*codes_with("ignorable"), *codes_with("verdict")})
    require_kind(ignore, (list, tuple, set, frozenset), "ignore", "a list of codes")
    for code in ignore:
        require_kind(code, str, "a code in ignore", "the code of a finding")
        if code not in known:
            raise SettingsError(
                f"doctor: ignore has the code {code!r}, which is unknown or changes no verdict; "
                f"expected: {listed(known)}{suggestion(code, known)}"
            )


def blocking(
    findings: Sequence[Finding], ignore: Sequence[str], *, is_robust: bool = False
) -> tuple[Finding, ...]:
    """Return the errors that make an identification wrong, except those that the user ignores."""
    errors = (f for f in not_ignored(findings, ignore) if f.severity == "error")
    return tuple(f for f in errors if not (is_robust and is_downweighted(f)))


def rejected(
    findings: Sequence[Finding], validation: Mapping[str, Metrics], scale_check: ScaleCheck
) -> list[Finding]:
    """Return findings; hypotheses that a good prediction of unseen motion rejects become notes."""
    # If the error of these torques is below 5 % on every validation log. Another unit, or a torque
    # without gravity, also needs an identified gravity torque within a factor of two of the URDF's.
    errors: dict[str, float] = {}
    is_fitted = any(one.code == "repeated_motion" for one in findings)
    for metrics in () if is_fitted else validation.values():
        for joint, measured in metrics.per_joint.items():
            errors[joint] = max(errors.get(joint, 0.0), error_of(measured))
    kept = []
    for one in findings:
        joints = [joint for joint in one.joints if joint in errors] or [*errors]
        worst = max((errors[joint] for joint in joints), default=np.inf)
        gravity = scale_check.gravity
        ratios = {
            "current_for_torque": [gravity[joint] for joint in joints if joint in gravity],
            "gravity_compensated": [np.inf if scale_check.scale is None else scale_check.factor],
        }.get(one.code, [np.inf] if one.severity == "error" else [])
        is_near = all(1 / _MUCH < ratio < _MUCH for ratio in ratios)
        # one of all joints was found in the residual of the prediction
        if one.code in _HYPOTHESES and one.where != "all joints" and worst < SMALL and is_near:
            logs = logs_that_test(validation)
            but = f"; rejected: torque error on {logs} at most {worst:.1f} %"
            one = one.reworded(severity="note", remedy=one.remedy + but)
        kept.append(one)
    return kept


def warnings_of(
    findings: Sequence[Finding], joints: Sequence[str], validation: Sequence[str] = (), *,
    is_robust: bool = False,
) -> tuple[VerdictWarning, ...]:  # fmt: skip
    """Return the warnings of a verdict that follow from findings, each once."""
    jumps = {(f.log, f.joints) for f in findings if is_robust and is_downweighted(f)}
    known = {*codes_with("verdict")} - {"repeated_motion"}
    warned = [one for one in findings if one.severity == "warning" and one.code in known]
    bodies = grouped(one for one in warned if one.code in codes_with("of_body"))
    warnings = [VerdictWarning(x.code, "", text) for x in bodies for text in x.messages]
    for one in (one for one in warned if one.code not in codes_with("of_body")):
        # the unexplained torque is the spikes, which a robust fit downweights
        is_jump = one.code == "unexplained_torque" and (one.log, one.joints) in jumps
        if not is_jump and not _is_harmless(one):
            warnings += _warnings(one, joints)
    repeated = {f.where: f for f in findings if f.code == "repeated_motion"}
    if validation and repeated.keys() >= set(validation):
        warnings += [VerdictWarning(f.code, "", reason_of(f)) for f in repeated.values()]
    return tuple(dict.fromkeys(warnings))


def is_downweighted(finding: Finding) -> bool:
    """Whether a robust loss makes a finding harmless: it concerns jumps of the torque only."""
    return finding.code == "spikes" and finding.words["channel"] == "tau"


def _described(warnings: Sequence[VerdictWarning]) -> list[str]:
    """Return one sentence per kind of warning, with the joints that share it."""
    return _shared((warning.joint, f"{warning.message} ({warning.code})") for warning in warnings)


def _shared(reasons: Iterable[tuple[str, str]]) -> list[str]:
    """Return sentences, with the joints (or "") that share their words before them."""
    shared: dict[str, list[str]] = {}
    for joint, words in reasons:
        shared.setdefault(words, []).append(joint)
    return [
        f"{', '.join(joints)}: {words}" if any(joints) else words
        for words, joints in shared.items()
    ]


def _warnings(finding: Finding, joints: Sequence[str]) -> Iterator[VerdictWarning]:
    message, named = reason_of(finding), [x for x in finding.joints if x in joints]
    factor, costs = finding.evidence.get("factor", 1.0), finding.evidence.get("error_pct", 0.0)
    is_poor = {
        "constraint_costs": costs > COSTLY,
        "current_for_torque": max(factor, 1.0 / factor) > NO_ERROR_OF_MASSES,
    }.get(finding.code, False)
    for joint in named or (joints if is_poor else ()):
        yield VerdictWarning(finding.code, joint, message, "poor" if is_poor else "usable")
    if not (named or is_poor):
        where = finding.log or finding.where
        where = "" if finding.where in _OF_THE_FIT else f"{where}: "
        yield VerdictWarning(finding.code, "", f"{where}{message}")


def _is_harmless(finding: Finding) -> bool:
    """Return whether the torque error is small in spite of a constraint or a missing term."""
    figures, is_term = finding.evidence, finding.code in codes_with("term")
    if is_term or finding.code != "constraint_costs":
        return is_term and figures["error_pct"] < SMALL and "replaces" not in figures
    return is_harmless_cost(figures["error_pct"], figures["wls_error_pct"])


def judge_positions(
    metrics: Metrics, joints: Sequence[str], *, is_validation: bool, fitted: Metrics | None = None,
    is_settled: bool = True, log_errors: Sequence[str] = (), cautions: Sequence[str] = (),
    scale: str = "", knows_torques: bool = False,
) -> Verdict:  # fmt: skip
    """Return the verdict on simulated positions."""
    measured, of_fit = metrics.per_joint, {} if fitted is None else fitted.per_joint
    verdicts = {
        j: _judge_position(j, measured.get(j), of_fit.get(j), is_validation) for j in joints
    }
    errors = {joint: error_of(m) for joint, m in measured.items()}
    reasons: dict[str, list[str]] = {status: [] for status in ("poor", "not evaluated", "usable")}
    for joint in sorted(verdicts, key=lambda joint: -errors.get(joint, 0.0)):  # the worst first
        reasons.setdefault(verdicts[joint].status, []).extend(verdicts[joint].reasons)
    unseen = "prediction of unseen motion not evaluated: no validation log given"
    warnings = [*cautions, *([] if is_validation else [unseen])]
    warnings += [] if is_settled else ["the fit has not converged"]
    largest_error = max(errors.values(), default=0.0)
    good = sentence_of("verdict:good", what="position", error=largest_error)
    verdict = concluded(
        verdicts, poor=reasons["poor"], good=good, notes=[scale] if scale else [],
        warnings=[*warnings, *reasons["not evaluated"], *reasons["usable"]],
        log_errors=log_errors, is_tested=is_validation and bool(measured),
    )  # fmt: skip
    status = {joint: verdict.status for joint, verdict in verdicts.items() if joint in measured}
    uses = uses_of_motion(status, log_errors=log_errors, is_scaled=knows_torques)
    return replace(verdict, use_for=uses)


def _judge_position(
    joint: str, measured: JointMetrics | None, fitted: JointMetrics | None, is_validation: bool
) -> JointVerdict:
    """Return the verdict on one joint; metrics are None if no log commands it to move."""
    simple = None if fitted is None else fitted.baselines.get("second_order")
    if fitted is not None and simple is not None:
        error = error_of(fitted)
        if error > max(GOOD, HARDLY * simple):
            figures = {"error": error, "simple": simple}
            lacking = sentence_of("verdict:joint", what="lacking", subject_of=joint, **figures)
            return on_joint([lacking], [], is_tested=is_validation, checked=lacking)
    if measured is None:
        still = sentence_of("verdict:joint", what="still", subject_of=joint)
        return on_joint([], [], is_tested=False, checked=still)
    error, baselines = error_of(measured), measured.baselines
    simpler = {key: other for key, other in baselines.items() if other is not None}
    beaten = [key for key in _SIMPLER if error > BEATEN * simpler.get(key, math.inf)]
    # where torques are the input, the URDF has fitted drives
    names = ["driven" if key == "urdf" and "steady" in baselines else key for key in beaten]
    text = sentence_of(
        "verdict:joint", what="position", subject_of=joint, error=error, smaller=bool(names),
        simpler=listed(sentence_of("verdict:simpler", what=name) for name in names),
    )  # fmt: skip
    is_poor = is_validation and (error > POOR_POSITION or "command" in beaten)
    is_usable = is_validation and not is_poor and (error > GOOD_POSITION or bool(beaten))
    return on_joint([text] * is_poor, [text] * is_usable, is_tested=is_validation, checked=text)
