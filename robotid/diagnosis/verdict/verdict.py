"""Verdict on a result, with reasons; what was not tested is never "good"."""

import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import Finding, listed, not_ignored
from robotid.base.settings import require_kind
from robotid.diagnosis.catalogue import codes_with, reason_of
from robotid.diagnosis.verdict.evidence import (
    COSTLY,
    Determined,
    JointEvidence,
    Predictions,
    error_of,
    is_harmless_cost,
    uses_of_torques,
)
from robotid.diagnosis.verdict.scale_check import ScaleCheck
from robotid.estimation.fitting.evaluation import Metrics, logs_that_test

_REJECTED = 5.0  # [%] a smaller prediction error rejects a hypothesis on columns or masses
_SCALED = 2.0  # a gravity torque within this factor of the URDF's contradicts a wrong unit
_SMALL = 5.0  # [%] of the torque: a missing drive term below this gives no warning
_HYPOTHESES = (
    "current_for_torque",
    "gravity",
    "gravity_compensated",
    "unexplained_torque",
    "urdf_mismatch",
)
_STATIC = (
    "static model: gravity, offsets and Coulomb friction were identified. Inertias, armature and "
    "viscous friction keep the URDF's values: the result is valid at rest and for slow motion"
)
_HIDDEN = "gravity changes its torque less than friction does at rest"
# places that are not a recording
_OF_THE_FIT = ("all joints", "estimator", "recordings", "standard_parameters")


@dataclass(frozen=True)
class VerdictWarning:
    """Reason why a result may be wrong although it predicts torque well.

    Attributes:
        code: Code of the finding.
        joint: The joint concerned; empty if the whole result is.
        message: The reason as text.
        effect: The best verdict on the joint with this warning: "usable" or "poor".
    """

    code: str
    joint: str
    message: str
    effect: str = "usable"


@dataclass(frozen=True)
class JointVerdict:
    """Verdict on the torque prediction of one joint.

    Attributes:
        status: "good", "usable", "poor" or "not evaluated".
        reasons: Why, the worst first; for "good" what was checked.
    """

    status: str
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Verdict:
    """Verdict on a result.

    Attributes:
        status: "good", "usable", "poor" or "not evaluated".
        reasons: Why, the worst first; for "good" what was checked.
        joints: The verdict on each joint of the model.
        log_errors: Faults of the recordings.
        warnings: Warnings of the doctor and of the fit.
        use_for: Whether the result can be used for a purpose, "yes" or "no" and why, by purpose.
    """

    status: str
    reasons: tuple[str, ...]
    joints: Mapping[str, JointVerdict] = field(default_factory=dict)
    log_errors: tuple[str, ...] = ()
    warnings: tuple[VerdictWarning, ...] = ()
    use_for: Mapping[str, str] = field(default_factory=dict)

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
    predictions: Predictions,
    determined: Determined,
    *,
    log_errors: Sequence[str] = (),
    warnings: Sequence[VerdictWarning] = (),
    scale_check: ScaleCheck | None = None,
    cause_of: Callable[[str], tuple[str, str]] | None = None,
) -> Verdict:
    """Return the verdict on a result."""
    found, hidden = predictions.on_each(), predictions.hidden
    costly = [w for w in warnings if w.effect == "poor" and w.joint in found]
    for warning in costly:
        found[warning.joint].poor.extend((2, text) for text in _described([warning]))
    stated, warnings = warnings, [warning for warning in warnings if warning not in costly]
    largest = sorted(found.values(), key=lambda one: -max(one.errors, default=0.0))
    poor = _ranked(reason for one in largest for reason in one.poor)
    is_contradicted = scale_check is not None and scale_check.contradicts
    scale = [] if scale_check is None else [scale_check.message]
    reasons = [
        *predictions.untested(),
        *(caution for one in largest for caution in one.cautions),
        *predictions.better_by_urdf({w.joint for w in warnings if w.code == "gain_change"}),
        *_described(warnings),
        *(scale if is_contradicted else []),
        *predictions.at_rest(),
        *determined.warnings(),
    ]
    notes = [
        *determined.notes(),
        *predictions.of_base(),
        *([] if is_contradicted else scale),
        *([f"{listed(hidden)}: {_HIDDEN}: not evaluated"] if hidden else []),
        *([_STATIC] if determined.is_static else []),
    ]
    of_torque = [warning for warning in warnings if warning.code not in codes_with("of_body")]
    per_joint = {
        joint: on_joint(
            _ranked(one.poor),
            [*one.cautions, *_described([w for w in of_torque if w.joint in ("", joint)])],
            is_tested=bool(one.errors),
            checked=f"error at most {max(one.errors):.1f} %, smaller than that of a constant and "
            "that of the URDF"
            if one.errors
            else predictions.why_untested(joint),
        )
        for joint, one in found.items()
    }
    per_joint |= {joint: JointVerdict("not evaluated", (_HIDDEN,)) for joint in hidden}
    if cause_of is not None:
        notes = [*_largest_error(per_joint, found, cause_of), *notes]
    worst = max((error for one in found.values() for error in one.errors), default=0.0)
    good = (
        f"torque prediction error on {logs_that_test(predictions.validation)}: at most "
        f"{worst:.1f} % at every joint, smaller than that of a constant and that of the URDF; all "
        "parameters are physically consistent"
    )
    verdict = concluded(
        per_joint, poor=poor, warnings=reasons, good=good, notes=notes, log_errors=log_errors
    )
    uses = uses_of_torques(
        {joint: per_joint[joint].status for joint in found},
        is_consistent=determined.is_consistent,
        is_static=determined.is_static,
        log_errors=log_errors,
        scale_check=scale_check,
    )
    return replace(verdict, warnings=tuple(stated), use_for=uses)


def _ranked(reasons: Iterable[tuple[int, str]]) -> list[str]:
    """Return reasons, the worst first."""
    return [text for _, text in sorted(reasons, key=lambda reason: reason[0])]


def _largest_error(
    per_joint: dict[str, JointVerdict],
    found: Mapping[str, JointEvidence],
    cause_of: Callable[[str], tuple[str, str]],
) -> list[str]:
    """Add the cause to the good joint with the largest error; return it if all joints are good."""
    good = [joint for joint, verdict in per_joint.items() if verdict.status == "good"]
    if not good:
        return []
    last = max(good, key=lambda joint: max(found[joint].errors))
    cause, advice = cause_of(last)
    text = f"largest error of the good joints: {'. '.join(filter(None, (cause, advice)))}"
    per_joint[last] = replace(per_joint[last], reasons=(*per_joint[last].reasons, text))
    is_all = len(good) == len(per_joint)
    return [f"{last}: largest error: {cause}"] if is_all else []


def concluded(
    joints: Mapping[str, JointVerdict],
    *,
    poor: Sequence[str],
    warnings: Sequence[str],
    good: str,
    notes: Sequence[str] = (),
    log_errors: Sequence[str] = (),
    is_tested: bool = True,
) -> Verdict:
    """Return the verdict that follows from reasons."""
    status = "usable" if warnings else "good"
    status = "poor" if poor or log_errors else status if is_tested else "not evaluated"
    reasons = (*log_errors, *poor, *warnings) or (good,)
    return Verdict(status, (*reasons, *notes), joints, tuple(log_errors))


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
            near = difflib.get_close_matches(code, known, n=1)
            hint = f". Did you mean {near[0]!r}?" if near else ""
            raise SettingsError(
                f"doctor: ignore has the code {code!r}, which is unknown or changes no verdict; "
                f"wanted: {listed(known)}{hint}"
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
    """Return findings; hypotheses that a good prediction of unseen motion rejects become notes.

    Wrong masses, a wrong direction of gravity or an unexplained torque are rejected if the error of
    these torques is below 5 % on every validation log. Another unit of the torque, or a torque
    without gravity, is rejected if the identified gravity torque is also within a factor of two
    of the URDF's.
    """
    errors: dict[str, float] = {}
    for metrics in validation.values():
        for joint, measured in metrics.per_joint.items():
            errors[joint] = max(errors.get(joint, 0.0), error_of(measured))
    if any(one.code == "repeated_motion" for one in findings):
        errors = {}  # the motion was fitted
    kept = []
    for one in findings:
        joints = [joint for joint in one.joints if joint in errors] or [*errors]
        worst = max((errors[joint] for joint in joints), default=np.inf)
        is_rejected = one.code in _HYPOTHESES and worst < _REJECTED
        if one.where == "all joints":
            is_rejected = False  # it was found in the residual of the prediction
        elif one.code == "current_for_torque":
            ratios = [scale_check.gravity[j] for j in joints if j in scale_check.gravity]
            is_rejected &= all(1 / _SCALED < ratio < _SCALED for ratio in ratios)
        elif one.code == "gravity_compensated":
            is_rejected &= (
                scale_check.scale is not None and 1 / _SCALED < scale_check.factor < _SCALED
            )
        elif one.severity == "error":
            is_rejected = False
        if is_rejected:
            logs = logs_that_test(validation)
            but = f"; rejected: torque error on {logs} at most {worst:.1f} %"
            one = one.reworded(severity="note", remedy=one.remedy + but)
        kept.append(one)
    return kept


def warnings_of(
    findings: Sequence[Finding],
    joints: Sequence[str],
    validation: Sequence[str] = (),
    *,
    is_robust: bool = False,
) -> tuple[VerdictWarning, ...]:
    """Return the warnings of a verdict that follow from findings, each once."""
    jumps = {(f.log, f.joints) for f in findings if is_robust and is_downweighted(f)}
    warnings: list[VerdictWarning] = []
    for one in findings:
        is_known = one.code in codes_with("verdict")
        if one.severity != "warning" or not is_known or one.code == "repeated_motion":
            continue
        # the unexplained torque is the spikes, which a robust fit downweights
        is_jump = one.code == "unexplained_torque" and (one.log, one.joints) in jumps
        if not is_jump and not _is_harmless(one):
            warnings += _warnings(one, joints)
    repeated = {f.code: f for f in findings if f.code == "repeated_motion"}
    logs = {f.where for f in findings if f.code == "repeated_motion"}
    if validation and logs.issuperset(validation):
        warnings += [VerdictWarning(code, "", reason_of(f)) for code, f in repeated.items()]
    return tuple(dict.fromkeys(warnings))


def is_downweighted(finding: Finding) -> bool:
    """Whether a robust loss makes a finding harmless: it concerns jumps of the torque only."""
    return finding.code == "spikes" and finding.words["channel"] == "tau"


def _described(warnings: Sequence[VerdictWarning]) -> list[str]:
    """Return one sentence per kind of warning, with the joints that share it."""
    shared: dict[tuple[str, str], list[str]] = {}
    for warning in warnings:
        shared.setdefault((warning.message, warning.code), []).append(warning.joint)
    return [
        f"{', '.join(joints)}: {message} ({code})" if any(joints) else f"{message} ({code})"
        for (message, code), joints in shared.items()
    ]


def _warnings(finding: Finding, joints: Sequence[str]) -> Iterator[VerdictWarning]:
    message, named = reason_of(finding), [x for x in finding.joints if x in joints]
    if finding.code in codes_with("of_body"):
        yield VerdictWarning(finding.code, "", message)
        return
    is_costly = finding.code == "constraint_costs" and finding.evidence["error_pct"] > COSTLY
    for joint in named:
        yield VerdictWarning(finding.code, joint, message, "poor" if is_costly else "usable")
    if not named:
        where = finding.log or finding.where
        where = "" if finding.where in _OF_THE_FIT else f"{where}: "
        yield VerdictWarning(finding.code, "", f"{where}{message}")


def _is_harmless(finding: Finding) -> bool:
    """Return whether the torque error is small in spite of a constraint or a missing term."""
    if finding.code in codes_with("term"):
        return finding.evidence["error_pct"] < _SMALL and "replaces" not in finding.evidence
    if finding.code != "constraint_costs":
        return False
    return is_harmless_cost(finding.evidence["error_pct"], finding.evidence["wls_error_pct"])
