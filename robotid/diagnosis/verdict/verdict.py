"""Verdict on a result, with reasons; what was not tested is never "good"."""

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import Finding, listed, not_ignored
from robotid.base.settings import require_kind
from robotid.diagnosis.logs.check_logs import CODES
from robotid.diagnosis.verdict.evidence import (
    COSTLY,
    Determined,
    Predictions,
    error_of,
    is_harmless_cost,
)
from robotid.diagnosis.verdict.scale_check import ScaleCheck
from robotid.diagnosis.verdict.uses import uses_of_torques
from robotid.estimation.fitting.evaluation import Metrics, logs_that_test

_REJECTED = 5.0  # [%] a smaller prediction error rejects a hypothesis on columns or masses
_SCALED = 2.0  # a gravity torque within this factor of the URDF's contradicts a wrong unit
_SMALL = 5.0  # [%] of the torque: a missing drive term below this gives no warning
#: Reasons of a verdict by code of the warning: such a result is at most "usable". Names in braces
#: are figures of the evidence.
_REASONS = {
    "angle_scale": "positions fit best when multiplied by another factor",
    "active_bound": "the data, or the masses that result from it, contradict a stated bound",
    "base_jump": "the pose of the base jumps {jumps:.0f} times: some of it may be wrong",
    "bunched_stamps": "rows are stamped when they arrive: velocities and accelerations are wrong",
    "clipped": "the torque is clipped at a limit",
    "contact_delay": "contact flags are delayed by {delay:+.3f} s (negative: early): contact "
    "forces remain in the rows",
    "constant_torque": "the torque is constant: the channel does not work",
    "constraint_costs": "torque error {error_pct:.1f} % on the fitted recordings, "
    "{wls_error_pct:.1f} % without constraints: physics and data disagree",
    "counterbalance": "a counterbalance or spring cancels {cancelled_pct:.0f} % of its gravity "
    "torque: the drive model lacks it",
    "current_for_torque": "the torque fits the URDF only in another scale. If it is a current or "
    "has another unit, masses and inertias are wrong by the same factor",
    "gain_change": "the torque on a validation log is {factor:.2f} times the predicted one: gain "
    "or friction differ between the logs",
    "gravity": "the stated direction of gravity may be wrong",
    "gravity_compensated": "the torque may be logged without gravity",
    "repeated_torque": "each torque value is repeated over {rows:.0f} samples: delayed and stepped",
    "joint_origin": "the joint's origin differs from the URDF's",
    "joint_axis": "the joint axis may be reversed",
    "joint_order": "the columns may belong to another joint",
    "joint_torque_delay": "the torque is delayed by {delay:+.3f} s relative to the position "
    "(negative: early), the torques of other joints are not",
    "link_mass": "the URDF's mass of a link, {mass:.3g} kg, is too large ({factor:.2g} times it "
    "explains the torques), or a spring cancels {cancelled_pct:.0f} % of the gravity torque",
    "lost_motion": "there may be backlash between the joint and its encoder",
    "rolling_contact": "feet roll as balls of a radius that is not stated: the force of the "
    "ground acts elsewhere",
    "moving_contact": "a link moves at {speed:.2g} m/s while it is in contact",
    "mass_matrix": "the mass matrix is not positive definite in all poses",
    "payload_change": "its last link carries {mass:+.2g} kg relative to the fitted logs",
    "position_offset": "the position may have an offset",
    "position_order": "the position may belong to another joint",
    "position_sign": "the position may have the opposite sign",
    "time_scale": "inertia and gravity contradict each other: the time stamps or the magnitude "
    "of gravity may be wrong",
    "torque_delay": "the torque is delayed by {delay:+.3f} s relative to the position (negative: "
    "early)",
    "torque_order": "the torque may belong to another joint",
    "torque_scale": "the scale of the torque differs from that of the other joints",
    "torque_sign": "the torque may have the opposite sign",
    "unexplained_torque": "gravity, inertia and friction do not explain much of the torque",
    "unlike_run": "the log differs from the other logs",
    "unlike_unit": "the robot differs from the other robots",
    "unsigned_torque": "the torque may be a magnitude without sign",
    "unmounted_part": "{mass:.2g} kg of the URDF's last link were probably not mounted",
    "urdf_mismatch": "the torques do not fit the URDF's masses: the URDF may be of another robot "
    "or lack a load",
}
_MISFITS = {
    "backlash": "backlash or windup",
    "coupling": "a drive that is coupled to another joint",
    "drift": "a drift with time",
    "friction_shape": "friction of another shape than viscous and Coulomb",
    "load_friction": "friction that increases with the load",
    "position_periodic": "a torque that is periodic in the position",
    "spring": "a spring or counterbalance",
}
_REASONS |= {
    code: f"{term} would explain {{share_pct:.0f}} % of the squared residual ({{error_pct:.1f}} % "
    "of the torque): the drive model lacks it"
    for code, term in _MISFITS.items()
}
#: Findings of impossible bodies: their messages are the reasons. They concern masses and inertias
#: of links, not the predicted torque of a joint.
_OF_BODIES = ("com_outside", "dense_body", "density", "ellipsoid", "gyration")
#: Codes of the warnings that make a result at most "usable".
WARNING_CODES = (*_REASONS, *_OF_BODIES, "repeated_motion")
_OF_RESULTS = ("total_mass",)  # errors that only a result can have
_HYPOTHESES = (
    "current_for_torque",
    "gravity",
    "gravity_compensated",
    "unexplained_torque",
    "urdf_mismatch",
)
_REPEATED = "the validation motion is also in a fitted log: no prediction was tested"
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
    cause_of: Callable[[str], str] | None = None,
) -> Verdict:
    """Return the verdict on a result."""
    found, hidden = predictions.on_each(), predictions.hidden
    costly = [w for w in warnings if w.effect == "poor" and w.joint in found]
    for warning in costly:
        found[warning.joint][0].extend(_described([warning]))
    stated, warnings = warnings, [warning for warning in warnings if warning not in costly]
    largest = sorted(found.values(), key=lambda of: -max(of[2], default=0.0))
    poor = sorted((reason for worse, _, _ in largest for reason in worse), key=_rank)
    is_contradicted = scale_check is not None and scale_check.contradicts
    reasons = [
        *predictions.untested(),
        *(reason for _, cautions, _ in largest for reason in cautions),
        *predictions.better_by_urdf({w.joint for w in warnings if w.code == "gain_change"}),
        *_described(warnings),
        *([scale_check.message] if scale_check is not None and is_contradicted else []),
        *predictions.at_rest(),
        *determined.warnings(),
    ]
    notes = [
        *determined.notes(),
        *predictions.of_base(),
        *([scale_check.message] if scale_check is not None and not is_contradicted else []),
        *([f"{listed(hidden)}: {_HIDDEN}: not evaluated"] if hidden else []),
        *([_STATIC] if determined.is_static else []),
    ]
    of_torque = [warning for warning in warnings if warning.code not in _OF_BODIES]
    per_joint = {
        joint: on_joint(
            sorted(worse, key=_rank),
            [*cautions, *_described([w for w in of_torque if w.joint in ("", joint)])],
            is_tested=bool(errors),
            checked=f"error at most {max(errors):.1f} %, smaller than that of a constant and "
            "that of the URDF"
            if errors
            else predictions.why_untested(joint),
        )
        for joint, (worse, cautions, errors) in found.items()
    }
    per_joint |= {joint: JointVerdict("not evaluated", (_HIDDEN,)) for joint in hidden}
    if cause_of is not None:
        notes = [*_largest_error(per_joint, found, cause_of), *notes]
    worst = max((error for _, _, errors in found.values() for error in errors), default=0.0)
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


def _largest_error(
    per_joint: dict[str, JointVerdict],
    found: Mapping[str, tuple[list[str], list[str], list[float]]],
    cause_of: Callable[[str], str],
) -> list[str]:
    """Add the cause to the good joint with the largest error; return it if all joints are good."""
    good = [joint for joint, verdict in per_joint.items() if verdict.status == "good"]
    if not good:
        return []
    last = max(good, key=lambda joint: max(found[joint][2]))
    cause = cause_of(last)
    reasons = (*per_joint[last].reasons, f"largest error of the good joints: {cause}")
    per_joint[last] = replace(per_joint[last], reasons=reasons)
    is_all = len(good) == len(per_joint)
    return [f"{last}: largest error: {cause.partition('. ')[0]}"] if is_all else []


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
    known = sorted({*CODES, *WARNING_CODES, *_OF_RESULTS})
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
    if any(finding.code == "repeated_motion" for finding in findings):
        errors = {}  # the motion was fitted
    found = []
    for finding in findings:
        named = [j for j in finding.where.rpartition(": ")[2].split(", ") if j in errors]
        joints = named or [*errors]
        worst = max((errors[joint] for joint in joints), default=np.inf)
        is_rejected = finding.code in _HYPOTHESES and worst < _REJECTED
        if finding.where == "all joints":
            is_rejected = False  # it was found in the residual of the prediction
        elif finding.code == "current_for_torque":
            ratios = [scale_check.gravity[j] for j in joints if j in scale_check.gravity]
            is_rejected &= all(1 / _SCALED < ratio < _SCALED for ratio in ratios)
        elif finding.code == "gravity_compensated":
            is_rejected &= (
                scale_check.scale is not None and 1 / _SCALED < scale_check.factor < _SCALED
            )
        elif finding.severity == "error":
            is_rejected = False
        if is_rejected:
            but = f"; rejected: torque error on {logs_that_test(validation)} at most {worst:.1f} %"
            finding = replace(finding, severity="note", message=f"{finding.message}{but}")
        found.append(finding)
    return found


def warnings_of(
    findings: Sequence[Finding],
    joints: Sequence[str],
    validation: Sequence[str] = (),
    *,
    is_robust: bool = False,
) -> tuple[VerdictWarning, ...]:
    """Return the warnings of a verdict that follow from findings, each once."""
    # places of jumps of a torque in the form of other findings: log and joint
    downweighted = {
        f.where.replace(": tau_", ": ") for f in findings if is_robust and is_downweighted(f)
    }
    found: list[VerdictWarning] = []
    for finding in findings:
        if finding.severity != "warning" or finding.code not in WARNING_CODES:
            continue
        if finding.code == "repeated_motion" or _is_harmless(finding):
            continue
        # the unexplained torque is the spikes, which a robust fit downweights
        if finding.code == "unexplained_torque" and finding.where in downweighted:
            continue
        found += _warnings(finding, joints)
    repeated = {f.where for f in findings if f.code == "repeated_motion"}
    if validation and repeated.issuperset(validation):
        found.append(VerdictWarning("repeated_motion", "", _REPEATED))
    return tuple(dict.fromkeys(found))


def is_downweighted(finding: Finding) -> bool:
    """Whether a robust loss makes a finding harmless: it concerns jumps of the torque only."""
    return finding.code == "spikes" and finding.where.rsplit(": ", 1)[-1].startswith("tau_")


def _described(warnings: Sequence[VerdictWarning]) -> list[str]:
    """Return one sentence per kind of warning, with the joints that share it."""
    shared: dict[tuple[str, str], list[str]] = {}
    for warning in warnings:
        shared.setdefault((warning.message, warning.code), []).append(warning.joint)
    return [
        f"{', '.join(joints)}: {message} ({code})" if any(joints) else f"{message} ({code})"
        for (message, code), joints in shared.items()
    ]


def _rank(reason: str) -> int:
    """Return 0 for worse than a constant, 1 for worse than the URDF, 2 for the rest."""
    return 0 if "a constant" in reason else 1 if "the URDF" in reason else 2


def _warnings(finding: Finding, joints: Sequence[str]) -> Iterator[VerdictWarning]:
    if finding.code in _OF_BODIES:
        yield VerdictWarning(finding.code, "", finding.message)
        return
    message = _REASONS[finding.code].format(**finding.evidence)
    log, _, last = finding.where.rpartition(": ")
    named = [joint for joint in last.split(", ") if joint in joints]
    is_costly = finding.code == "constraint_costs" and finding.evidence["error_pct"] > COSTLY
    for joint in named:
        yield VerdictWarning(finding.code, joint, message, "poor" if is_costly else "usable")
    if not named:
        where = "" if finding.where in _OF_THE_FIT else f"{log or last}: "
        yield VerdictWarning(finding.code, "", f"{where}{message}")


def _is_harmless(finding: Finding) -> bool:
    """Return whether the torque error is small in spite of a constraint or a missing term."""
    if finding.code in _MISFITS:
        return finding.evidence["error_pct"] < _SMALL and "replaces" not in finding.evidence
    if finding.code != "constraint_costs":
        return False
    return is_harmless_cost(finding.evidence["error_pct"], finding.evidence["wls_error_pct"])
