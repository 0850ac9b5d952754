"""How far to trust a result: findings with reasons, and a verdict that never passes the unknown."""

import difflib
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from robotid._settings import require_kind
from robotid.doctor.diagnosis import CODES
from robotid.exceptions import SettingsError
from robotid.findings import Finding, current_code, listed
from robotid.fitting.metrics import Metrics
from robotid.judgement.evidence import Determined, Predictions, error_of
from robotid.judgement.scale_check import ScaleCheck

__all__ = [
    "WARNING_CODES",
    "JointVerdict",
    "Verdict",
    "VerdictWarning",
    "blocking",
    "check_ignored",
    "concluded",
    "is_downweighted",
    "judge",
    "on_joint",
    "rejected",
    "warnings_of",
]

_LOGGER = logging.getLogger("robotid")

_REJECTED = 5.0  # [%] a hypothesis on columns or masses is rejected by a prediction so good
_SCALED = 2.0  # a gravity within this factor of the URDF's contradicts another unit of the torque
_WRONG = 2.0  # a fit that misses this many times what WLS misses ...
_HARMLESS = 1.0  # [%] ... is doubtful, but not below this share of the torque
_SMALL = 5.0  # [%] of the torque: a term that a drive lacks leaves no doubt below
#: Warnings that make a result doubtful, in words that a verdict can hold. A word in braces is a
#: figure of the evidence.
_WORDS = {
    "angle_scale": "positions fit best times another factor",
    "active_bound": "the data, or the masses that it leaves, contradict a stated bound",
    "com_outside": "its centre of mass lies {outside:.2g} m outside its geometry: no such body",
    "clipped": "the torque is clipped at a limit",
    "constant_torque": "the torque never changes: the channel is dead",
    "constraint_costs": "{error_pct:.1f} % of the torque is missed where it was fitted, "
    "{wls_error_pct:.1f} % without constraints: physics and data disagree",
    "counterbalance": "a counterbalance or spring takes {cancelled_pct:.0f} % of its gravity: the "
    "model of its drive lacks it",
    "current_for_torque": "the torque fits the URDF in another scale only: if it is a current or "
    "in another unit, masses and inertias are wrong in the same proportion",
    "density": "its mass makes {density:.2g} kg/m^3 of the box around its geometry",
    "gravity": "the direction of gravity may be stated wrongly",
    "gravity_compensated": "the torque may be logged without gravity",
    "repeated_torque": "the torque is repeated over {rows:.0f} rows: delayed and stepped",
    "gyration": "its mass lies {gyration:.2g} m from its centre on average, its geometry ends at "
    "{farthest:.2g} m: no body can be so",
    "joint_origin": "the joint seems to lie elsewhere than the URDF has it",
    "joint_axis": "the joint's axis may be reversed",
    "joint_order": "the columns may be those of another joint",
    "joint_torque_delay": "the torque is {delay:+.3f} s (+ late, - early) against the position, "
    "those of the other joints are not",
    "lost_motion": "backlash may lie between the joint and its encoder",
    "mass_matrix": "the mass matrix is not positive definite everywhere",
    "payload_change": "its last link carries {mass:+.2g} kg against the fitted logs",
    "position_offset": "the zero of the position may be off",
    "position_order": "the position may be that of another joint",
    "position_sign": "the position may have the opposite sign",
    "solvers_differ": "two solvers found different parameters",
    "time_scale": "inertia and gravity contradict each other: the time stamps, or the size of "
    "gravity, may be wrong",
    "torque_delay": "the torque is {delay:+.3f} s (+ late, - early) against the position",
    "torque_order": "the torque may be that of another joint",
    "torque_scale": "the torque is in another scale than those of the other joints",
    "torque_sign": "the torque may have the opposite sign",
    "unexplained_torque": "much of the torque fits neither gravity, inertia nor friction",
    "unsigned_torque": "the torque may be a size without its sign",
    "unmounted_part": "{mass:.2g} kg of the URDF's last link seem not to have been mounted",
    "urdf_mismatch": "the torques do not fit the URDF's masses: it may be of another robot, or "
    "lack a load",
}
_MISFITS = {
    "backlash": "backlash or windup",
    "coupling": "a drive that turns with another joint, too,",
    "drift": "a drift with time",
    "friction_shape": "friction of another shape than viscous and Coulomb",
    "load_friction": "friction that grows with the load",
    "position_periodic": "a torque that repeats with its position",
    "spring": "a spring or counterbalance",
}
_WORDS |= {
    code: f"{term} would explain {{share_pct:.0f}} % of the squared residual ({{error_pct:.1f}} % "
    "of the torque): the model of its drive lacks it"
    for code, term in _MISFITS.items()
}
#: Codes of the warnings that make a result doubtful.
WARNING_CODES = (*_WORDS, "repeated_motion")
_OF_RESULTS = ("total_mass",)  # errors that a result alone can show
_HYPOTHESES = (
    "current_for_torque",
    "gravity",
    "gravity_compensated",
    "unexplained_torque",
    "urdf_mismatch",
)
_REPEATED = "the validation motion is in a fitted log, too, so no prediction was tested"
_STATIC = (
    "static: gravity, offsets and friction that needs no speed were identified; inertias, armature "
    "and viscous friction were not, and keep the URDF's values: the result holds for standing and "
    "slow motion"
)
_HIDDEN = "gravity changes its torque less than friction does where it stands"
# places that are no recording
_OF_THE_FIT = ("all joints", "estimator", "recordings", "standard_parameters")


@dataclass(frozen=True)
class VerdictWarning:
    """Why a result may be wrong although it predicts torque well.

    Attributes:
        code: Code of the finding that it comes from.
        joint: The joint that it is about; empty for all of the result.
        message: Why, in words.
    """

    code: str
    joint: str
    message: str


@dataclass(frozen=True)
class JointVerdict:
    """How far to trust the torque that is predicted for one joint.

    Attributes:
        status: "good", "usable", "poor" or "not evaluated".
        reasons: Why, the worst first; for "good" what was checked.
    """

    status: str
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Verdict:
    """How far to trust a result.

    Attributes:
        status: "good", "usable", "poor" or "not evaluated".
        reasons: Why, the worst first; for "good" what was checked.
        joints: The same of each joint of the model.
        log_errors: Faults of the recordings that it was told of.
        warnings: Doubts that it was told of.
    """

    status: str
    reasons: tuple[str, ...]
    joints: Mapping[str, JointVerdict] = field(default_factory=dict)
    log_errors: tuple[str, ...] = ()
    warnings: tuple[VerdictWarning, ...] = ()

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
            "warnings": [asdict(doubt) for doubt in self.warnings],
        }


def judge(
    predictions: Predictions,
    determined: Determined,
    *,
    log_errors: Sequence[str] = (),
    warnings: Sequence[VerdictWarning] = (),
    scale_check: ScaleCheck | None = None,
) -> Verdict:
    """Return the verdict on a result.

    Args:
        predictions: How well it predicts torque.
        determined: What the data determine of its parameters.
        log_errors: Faults of the recordings that make any result of them wrong.
        warnings: Why the result may be wrong however well it predicts.
        scale_check: What speaks for the scale of the result but the sensors.

    Returns:
        The verdict. Without a validation log, or with a doubt, it is at best "usable"; so is that
        of a joint with a doubt, and that of all joints with one about all.
    """
    found, hidden = predictions.on_each(), predictions.hidden
    poor = sorted((reason for worse, _, _ in found.values() for reason in worse), key=_rank)
    against = scale_check is not None and scale_check.is_against
    reasons = [
        *predictions.untested(),
        *(reason for _, doubt, _ in found.values() for reason in doubt),
        *predictions.left_to_urdf(),
        *_described(warnings),
        *([scale_check.message] if scale_check is not None and against else []),
        *predictions.unseen(),
        *determined.warnings(),
    ]
    notes = [
        *determined.notes(),
        *([scale_check.message] if scale_check is not None and not against else []),
        *([f"{listed(hidden)}: {_HIDDEN}: not evaluated"] if hidden else []),
        *([_STATIC] if determined.is_static else []),
    ]
    per_joint = {
        joint: on_joint(
            sorted(worse, key=_rank),
            [*doubt, *_described([d for d in warnings if d.joint in ("", joint)])],
            is_tested=bool(errors),
            said=f"predicted within {max(errors):.1f} %, better than by a constant and than by the "
            "URDF"
            if errors
            else predictions.why_unseen(joint),
        )
        for joint, (worse, doubt, errors) in found.items()
    }
    per_joint |= {joint: JointVerdict("not evaluated", (_HIDDEN,)) for joint in hidden}
    worst = max((error for _, _, errors in found.values() for error in errors), default=0.0)
    good = (
        f"every joint is predicted within {worst:.1f} % on recordings that were not fitted, better "
        "than by a constant and than by the URDF, and every parameter is physically consistent"
    )
    verdict = concluded(
        per_joint, poor=poor, warnings=reasons, good=good, notes=notes, log_errors=log_errors
    )
    return replace(verdict, warnings=tuple(warnings))


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
    """Return the verdict that reasons make up.

    Args:
        joints: The verdict on each joint.
        poor: What makes the result poor.
        warnings: What keeps it from being good.
        good: What was checked, if it is good.
        notes: What follows the reasons, and changes no verdict.
        log_errors: Faults of the recordings that make it poor, whatever else is found.
        is_tested: Whether anything was evaluated; else a result that is not poor has no verdict.
    """
    status = "usable" if warnings else "good"
    status = "poor" if poor or log_errors else status if is_tested else "not evaluated"
    reasons = (*log_errors, *poor, *warnings) or (good,)
    return Verdict(status, (*reasons, *notes), joints, tuple(log_errors))


def on_joint(
    poor: Sequence[str], warnings: Sequence[str], *, is_tested: bool, said: str
) -> JointVerdict:
    """Return the verdict on a joint.

    Args:
        poor: What makes it poor.
        warnings: What keeps it from being good.
        is_tested: Whether a validation log tests it.
        said: What was checked, if it is good; why nothing was, if it is not tested.
    """
    if not is_tested:  # never a pass
        return JointVerdict("not evaluated", (said, *warnings))
    if poor or warnings:
        return JointVerdict("poor" if poor else "usable", (*poor, *warnings))
    return JointVerdict("good", (said,))


def check_ignored(ignore: Sequence[str]) -> None:
    """Refuse codes to ignore that no error and no doubt has.

    Args:
        ignore: The codes.

    Raises:
        SettingsError: If a code is unknown.
    """
    known = sorted({*CODES, *WARNING_CODES, *_OF_RESULTS})
    require_kind(ignore, (list, tuple, set, frozenset), "ignore", "a list of codes")
    for stated in ignore:
        require_kind(stated, str, "a code in ignore", "the code of a finding")
        code = current_code(stated)
        if code != stated:
            _LOGGER.warning("doctor: ignore names %r, which is %r since 0.2", stated, code)
        if code not in known:
            near = difflib.get_close_matches(code, known, n=1)
            hint = f". Did you mean {near[0]!r}?" if near else ""
            raise SettingsError(
                f"doctor: ignore names {code!r}, wanted some of {listed(known)}{hint}"
            )


def blocking(
    findings: Sequence[Finding], ignore: Sequence[str], *, is_robust: bool = False
) -> tuple[Finding, ...]:
    """Return the errors that make an identification wrong, but for those the user knows better.

    Args:
        findings: What was found.
        ignore: Codes of errors that the user knows better.
        is_robust: Whether a robust loss was set, which outvotes jumps of the torque.
    """
    known = {current_code(code) for code in ignore}
    errors = (f for f in findings if f.severity == "error" and f.code not in known)
    return tuple(f for f in errors if not (is_robust and is_downweighted(f)))


def rejected(
    findings: Sequence[Finding], kept: Mapping[str, Metrics], scale_check: ScaleCheck
) -> list[Finding]:
    """Return findings, hypotheses that a prediction of unseen motion contradicts as notes.

    That masses or the direction of gravity are not as stated, or that no physics explains a
    torque, is rejected where the result predicts these torques of every validation recording
    within 5 %; another unit of the torque, or a torque without gravity, if gravity as identified
    is also within a factor of two of the URDF's there.

    Args:
        findings: What was found.
        kept: Metrics of each validation recording and shows a prediction.
        scale_check: The identified gravity against the URDF's.
    """
    errors: dict[str, float] = {}
    for metrics in kept.values():
        for joint, measured in metrics.per_joint.items():
            errors[joint] = max(errors.get(joint, 0.0), error_of(measured))
    if any(finding.code == "repeated_motion" for finding in findings):
        errors = {}  # the motion was seen
    found = []
    for finding in findings:
        named = [j for j in finding.where.rpartition(": ")[2].split(", ") if j in errors]
        joints = named or [*errors]
        worst = max((errors[joint] for joint in joints), default=np.inf)
        is_rejected = finding.code in _HYPOTHESES and worst < _REJECTED
        if finding.where == "all joints":
            is_rejected = False  # it was found in what the prediction leaves
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
            but = f"; but the result predicts unseen motion within {worst:.1f} %"
            finding = replace(finding, severity="note", message=f"{finding.message}{but}")
        found.append(finding)
    return found


def warnings_of(
    findings: Sequence[Finding],
    joints: Sequence[str],
    kept: Sequence[str] = (),
    *,
    is_robust: bool = False,
) -> tuple[VerdictWarning, ...]:
    """Return the doubts that findings raise, each once.

    Args:
        findings: What the doctor and the fit found; notes and errors raise no doubt.
        joints: The model's joints. A finding whose place names some is about these only.
        kept: Names of the validation recordings, one each.
        is_robust: Whether a robust loss was set.
    """
    # the places of jumps of a torque, as other findings call them: log and joint
    downweighted = {
        f.where.replace(": tau_", ": ") for f in findings if is_robust and is_downweighted(f)
    }
    found: list[VerdictWarning] = []
    for finding in findings:
        if finding.severity != "warning" or finding.code not in _WORDS or _is_harmless(finding):
            continue
        # spikes that a robust fit leaves out are what physics could not explain
        if finding.code == "unexplained_torque" and finding.where in downweighted:
            continue
        found += _warnings(finding, joints)
    repeated = {f.where for f in findings if f.code == "repeated_motion"}
    if kept and repeated.issuperset(kept):
        found.append(VerdictWarning("repeated_motion", "", _REPEATED))
    return tuple(dict.fromkeys(found))


def is_downweighted(finding: Finding) -> bool:
    """Return whether a robust loss makes it harmless: it is about jumps of the torque only.

    Args:
        finding: The finding; a position that jumps spoils the regressor.
    """
    return finding.code == "spikes" and finding.where.rsplit(": ", 1)[-1].startswith("tau_")


def _described(warnings: Sequence[VerdictWarning]) -> list[str]:
    """Return one sentence per kind of doubt, with the joints that share it."""
    shared: dict[tuple[str, str], list[str]] = {}
    for doubt in warnings:
        shared.setdefault((doubt.message, doubt.code), []).append(doubt.joint)
    return [
        f"{', '.join(joints)}: {message} ({code})" if any(joints) else f"{message} ({code})"
        for (message, code), joints in shared.items()
    ]


def _rank(reason: str) -> int:
    """Return 0 for what is worse than a constant, 1 for worse than the URDF, 2 for the rest."""
    return 0 if "a constant" in reason else 1 if "the URDF" in reason else 2


def _warnings(finding: Finding, joints: Sequence[str]) -> Iterator[VerdictWarning]:
    message = _WORDS[finding.code].format(**finding.evidence)
    log, _, last = finding.where.rpartition(": ")
    named = [joint for joint in last.split(", ") if joint in joints]
    for joint in named:
        yield VerdictWarning(finding.code, joint, message)
    if not named:
        where = "" if finding.where in _OF_THE_FIT else f"{log or last}: "
        yield VerdictWarning(finding.code, "", f"{where}{message}")


def _is_harmless(finding: Finding) -> bool:
    """Return whether the torque is explained well in spite of a constraint or a missing term."""
    if finding.code in _MISFITS:
        return finding.evidence["error_pct"] < _SMALL and "replaces" not in finding.evidence
    if finding.code != "constraint_costs":
        return False
    error, wls = finding.evidence["error_pct"], finding.evidence["wls_error_pct"]
    return error < max(_WRONG * wls, _HARMLESS)
