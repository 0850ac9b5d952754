"""How far to trust a result: findings with reasons, and a verdict that never passes the unknown."""

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from robotid._settings import require_kind
from robotid.doctor.diagnosis import CODES
from robotid.exceptions import SettingsError
from robotid.findings import Finding, listed
from robotid.fitting.metrics import JointMetrics, Metrics
from robotid.judgement.witness import Witness

__all__ = [
    "BEATEN",
    "DOUBTFUL",
    "GOOD",
    "POOR",
    "Doubt",
    "JointVerdict",
    "Verdict",
    "alarming",
    "check_ignored",
    "concluded",
    "doubts_of",
    "error_of",
    "is_beaten",
    "is_outvoted",
    "judge",
    "on_joint",
    "refuted",
]

#: [%] a joint predicted within this on kept recordings is predicted well.
GOOD = 15.0
#: [%] a joint predicted worse than this is not usable.
POOR = 50.0
#: A plainer model is better if it misses this many times less ...
BEATEN = 1.05

_TIE = 0.3  # [%] ... and, of the URDF with fitted drives, by this share of the torque
_REFUTED = 5.0  # [%] a hypothesis on columns or masses is refuted by a prediction so good
_SCALED = 2.0  # a gravity within this factor of the URDF's refutes another unit of the torque
_OPTIMISM = 2.0  # an error this many times the fitted one on kept recordings shows over-fitting
_WRONG = 2.0  # a fit that misses this many times what WLS misses ...
_HARMLESS = 1.0  # [%] ... is doubtful, but not below this share of the torque
_SMALL = 5.0  # [%] of the torque: a term that a drive lacks leaves no doubt below
#: Warnings that make a result doubtful, in words that a verdict can hold. A word in braces is a
#: figure of the evidence.
_WORDS = {
    "angle_scale": "positions fit best times another factor",
    "bound_binds": "the data, or the masses that it leaves, speak against a stated bound",
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
    "held_torque": "the torque is held for {rows:.0f} rows at a time, so it is late and stepped",
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
DOUBTFUL = (*_WORDS, "repeated_motion")
_OF_RESULTS = ("total_mass",)  # errors that a result alone can show
_NAMED = 8  # parameters that a reason names
_HYPOTHESES = (
    "current_for_torque",
    "gravity",
    "gravity_compensated",
    "unexplained_torque",
    "urdf_mismatch",
)
_REPEATED = "the motion kept apart is in a fitted log, too, so no prediction was tested"
_STATIC = (
    "static: gravity, offsets and friction that needs no speed were identified; inertias, armature "
    "and viscous friction were not, and keep the URDF's values: the result holds for standing and "
    "slow motion"
)
_HIDDEN = "gravity changes its torque less than friction does where it stands"
# places that are no recording
_OF_THE_FIT = ("all joints", "estimator", "recordings", "standard_parameters")


@dataclass(frozen=True)
class Doubt:
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
        alarms: Faults of the recordings that it was told of.
        doubts: Doubts that it was told of.
    """

    status: str
    reasons: tuple[str, ...]
    joints: Mapping[str, JointVerdict] = field(default_factory=dict)
    alarms: tuple[str, ...] = ()
    doubts: tuple[Doubt, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as plain values, as result.json has it."""
        return {
            "status": self.status,
            "reasons": list(self.reasons),
            "per_joint": {
                joint: {"status": verdict.status, "reasons": list(verdict.reasons)}
                for joint, verdict in self.joints.items()
            },
            "alarms": list(self.alarms),
            "doubts": [asdict(doubt) for doubt in self.doubts],
        }


def judge(
    fit: Metrics,
    validation: Mapping[str, Metrics],
    *,
    undetermined: Sequence[str],
    is_consistent: bool,
    is_poorly_excited: bool = True,
    joints: Sequence[str] = (),
    alarms: Sequence[str] = (),
    doubts: Sequence[Doubt] = (),
    refitted: Sequence[str] = (),
    witness: Witness | None = None,
    is_static: bool = False,
    hidden: Sequence[str] = (),
) -> Verdict:
    """Return the verdict on a result.

    Args:
        fit: Metrics over the fitted recordings.
        validation: Metrics of each kept recording, by its name.
        undetermined: Base parameters that the data do not determine by themselves.
        is_consistent: Whether the parameters are physically possible.
        is_poorly_excited: Whether a richer motion would determine them; else noise hides them.
        joints: The model's joints; one without a row in any recording is not evaluated.
        alarms: Faults of the recordings that make any result of them wrong.
        doubts: Why the result may be wrong however well it predicts.
        refitted: Kept recordings, by name, that are left out since they hold fitted rows.
        witness: What speaks for the scale of the result but the sensors.
        is_static: Whether the model is.
        hidden: Joints that are not evaluated, as of ``hidden_joints``.

    Returns:
        The verdict. Without a kept recording, or with a doubt, it is at best "usable"; so is that
        of a joint with a doubt, and that of all joints with one about all.
    """
    fit = _without(fit, hidden)
    validation = {name: _without(metrics, hidden) for name, metrics in validation.items()}
    joints = [joint for joint in joints if joint not in hidden]
    moved = [joint for m in (fit, *validation.values()) for joint in m.per_joint]
    names = dict.fromkeys([*joints, *moved])
    found = {joint: _found_on(joint, fit, validation) for joint in names}
    poor = sorted((reason for worse, _, _ in found.values() for reason in worse), key=_rank)
    reasons = []
    if not validation:
        held = f"{listed(refitted)} hold rows that were fitted"
        why = held if refitted else "no validation log given"
        reasons.append(f"the prediction of a new motion was not evaluated: {why}")
    reasons += [reason for _, doubt, _ in found.values() for reason in doubt]
    reasons += _left_to_urdf(validation)
    reasons += _in_words(doubts)
    if witness is not None and witness.is_against:
        reasons.append(witness.message)
    reasons += _unseen(names, fit, validation)
    if undetermined and is_poorly_excited:
        reasons.append(
            f"the data do not determine {len(undetermined)} base parameters by themselves: "
            f"{listed(undetermined, _NAMED)}"
        )
    if not is_consistent:
        reasons.append(
            "the standard parameters are not physically consistent, so no URDF was written; the "
            "base parameters predict torque all the same"
        )
    per_joint = {
        joint: on_joint(
            sorted(worse, key=_rank),
            [*doubt, *_in_words([d for d in doubts if d.joint in ("", joint)])],
            is_tested=bool(errors),
            said=f"predicted within {max(errors):.1f} %, better than by a constant and than by the "
            "URDF"
            if errors
            else _why_unseen(joint not in moved, bool(validation)),
        )
        for joint, (worse, doubt, errors) in found.items()
    }
    worst = max((error for _, _, errors in found.values() for error in errors), default=0.0)
    notes = []
    if undetermined and not is_poorly_excited:
        notes.append(
            f"{len(undetermined)} base parameters are lost in the noise of a rich motion or known "
            "only in sums with others; what the data leave open keeps the URDF's values: "
            f"{listed(undetermined, _NAMED)}"
        )
    if witness is not None and not witness.is_against:
        notes.append(witness.message)
    if hidden:
        notes.append(f"{listed(hidden)}: {_HIDDEN}: not evaluated")
    notes += [_STATIC] if is_static else []
    per_joint |= {joint: JointVerdict("not evaluated", (_HIDDEN,)) for joint in hidden}
    good = (
        f"every joint is predicted within {worst:.1f} % on recordings that were not fitted, better "
        "than by a constant and than by the URDF, and every parameter is physically consistent"
    )
    verdict = concluded(per_joint, poor=poor, doubts=reasons, good=good, notes=notes, alarms=alarms)
    return replace(verdict, doubts=tuple(doubts))


def concluded(
    joints: Mapping[str, JointVerdict],
    *,
    poor: Sequence[str],
    doubts: Sequence[str],
    good: str,
    notes: Sequence[str] = (),
    alarms: Sequence[str] = (),
    is_tested: bool = True,
) -> Verdict:
    """Return the verdict that reasons make up.

    Args:
        joints: The verdict on each joint.
        poor: What makes the result poor.
        doubts: What keeps it from being good.
        good: What was checked, if it is good.
        notes: What follows the reasons, and changes no verdict.
        alarms: Faults of the recordings that make it poor, whatever else is found.
        is_tested: Whether anything was evaluated; else a result that is not poor has no verdict.
    """
    status = "usable" if doubts else "good"
    status = "poor" if poor or alarms else status if is_tested else "not evaluated"
    reasons = (*alarms, *poor, *doubts) or (good,)
    return Verdict(status, (*reasons, *notes), joints, tuple(alarms))


def on_joint(
    poor: Sequence[str], doubts: Sequence[str], *, is_tested: bool, said: str
) -> JointVerdict:
    """Return the verdict on a joint.

    Args:
        poor: What makes it poor.
        doubts: What keeps it from being good.
        is_tested: Whether a validation log tests it.
        said: What was checked, if it is good; why nothing was, if it is not tested.
    """
    if not is_tested:  # never a pass
        return JointVerdict("not evaluated", (said, *doubts))
    if poor or doubts:
        return JointVerdict("poor" if poor else "usable", (*poor, *doubts))
    return JointVerdict("good", (said,))


def check_ignored(ignore: Sequence[str]) -> None:
    """Refuse codes to ignore that no error and no doubt has.

    Args:
        ignore: The codes.

    Raises:
        SettingsError: If a code is unknown.
    """
    known = sorted({*CODES, *DOUBTFUL, *_OF_RESULTS})
    require_kind(ignore, (list, tuple, set, frozenset), "ignore", "a list of codes")
    for code in ignore:
        require_kind(code, str, "a code in ignore", "the code of a finding")
        if code not in known:
            near = difflib.get_close_matches(code, known, n=1)
            hint = f". Did you mean {near[0]!r}?" if near else ""
            raise SettingsError(
                f"doctor: ignore names {code!r}, wanted some of {listed(known)}{hint}"
            )


def alarming(
    findings: Sequence[Finding], ignore: Sequence[str], *, is_robust: bool = False
) -> tuple[Finding, ...]:
    """Return the errors that make an identification wrong, but for those the user knows better.

    Args:
        findings: What was found.
        ignore: Codes of errors that the user knows better.
        is_robust: Whether a robust loss was set, which outvotes jumps of the torque.
    """
    errors = (f for f in findings if f.severity == "error" and f.code not in ignore)
    return tuple(f for f in errors if not (is_robust and is_outvoted(f)))


def refuted(
    findings: Sequence[Finding], kept: Mapping[str, Metrics], witness: Witness
) -> list[Finding]:
    """Return findings, hypotheses that a prediction of unseen motion refutes as notes.

    That masses or the direction of gravity are not as stated, or that no physics explains a
    torque, is refuted where the result predicts these torques of every kept recording within 5 %;
    another unit of the torque, or an error that it holds no gravity, if gravity as identified is
    also within a factor of two of the URDF's there.

    Args:
        findings: What was found.
        kept: Metrics of each recording that was kept apart and shows a prediction.
        witness: The identified gravity against the URDF's.
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
        is_refuted = finding.code in _HYPOTHESES and worst < _REFUTED
        if finding.where == "all joints":
            is_refuted = False  # it was found in what the prediction leaves
        elif finding.code == "current_for_torque":
            ratios = [witness.gravity[j] for j in joints if j in witness.gravity]
            is_refuted &= all(1 / _SCALED < ratio < _SCALED for ratio in ratios)
        elif finding.code == "gravity_compensated":
            is_refuted &= witness.scale is not None and 1 / _SCALED < witness.factor < _SCALED
        elif finding.severity == "error":
            is_refuted = False
        if is_refuted:
            but = f"; but the result predicts unseen motion within {worst:.1f} %"
            finding = replace(finding, severity="note", message=f"{finding.message}{but}")
        found.append(finding)
    return found


def doubts_of(
    findings: Sequence[Finding],
    joints: Sequence[str],
    kept: Sequence[str] = (),
    *,
    is_robust: bool = False,
) -> tuple[Doubt, ...]:
    """Return the doubts that findings raise, each once.

    Args:
        findings: What the doctor and the fit found; notes and errors raise no doubt.
        joints: The model's joints. A finding whose place names some is about these only.
        kept: Names of the recordings kept apart, one each.
        is_robust: Whether a robust loss was set.
    """
    # the places of jumps of a torque, as other findings call them: log and joint
    outvoted = {f.where.replace(": tau_", ": ") for f in findings if is_robust and is_outvoted(f)}
    found: list[Doubt] = []
    for finding in findings:
        if finding.severity != "warning" or finding.code not in _WORDS or _is_harmless(finding):
            continue
        # spikes that a robust fit leaves out are what physics could not explain
        if finding.code == "unexplained_torque" and finding.where in outvoted:
            continue
        found += _doubts(finding, joints)
    repeated = {f.where for f in findings if f.code == "repeated_motion"}
    if kept and repeated.issuperset(kept):
        found.append(Doubt("repeated_motion", "", _REPEATED))
    return tuple(dict.fromkeys(found))


def is_outvoted(finding: Finding) -> bool:
    """Return whether a robust loss makes it harmless: it is about jumps of the torque only.

    Args:
        finding: The finding; a position that jumps spoils the regressor.
    """
    return finding.code == "spikes" and finding.where.rsplit(": ", 1)[-1].startswith("tau_")


def is_beaten(measured: JointMetrics) -> bool:
    """Return whether the URDF's bodies with fitted drives predict a joint clearly better.

    Args:
        measured: How well it is predicted.
    """
    driven = measured.baselines.get("urdf_with_drives")
    return driven is not None and error_of(measured) > max(BEATEN * driven, driven + _TIE)


def _without(metrics: Metrics, joints: Sequence[str]) -> Metrics:
    """Return metrics without those of some joints."""
    kept = {joint: m for joint, m in metrics.per_joint.items() if joint not in joints}
    return replace(metrics, per_joint=kept)


def _found_on(
    joint: str, fit: Metrics, validation: Mapping[str, Metrics]
) -> tuple[list[str], list[str], list[float]]:
    """Return what makes a joint poor, what makes it doubtful, and its errors [%], log by log."""
    poor, doubts, errors = [], [], []
    for log, metrics in validation.items():
        measured = metrics.per_joint.get(joint)
        if measured is not None:
            found = _judge_joint(joint, log, measured, fit.per_joint.get(joint))
            poor += found[0]
            doubts += found[1]
            errors.append(error_of(measured))
    return poor, doubts, errors


def _unseen(names: Iterable[str], fit: Metrics, validation: Mapping[str, Metrics]) -> list[str]:
    """Return which joints move in no recording, and which in no kept one."""
    kept = {joint for m in validation.values() for joint in m.per_joint}
    fitted = fit.per_joint
    still = [joint for joint in names if joint not in kept and joint not in fitted]
    missing = [joint for joint in names if joint not in kept and joint in fitted]
    if still and not fitted:  # measured again without the fitted recordings
        still, missing = [], still
    reasons = [f"the joints {listed(still)} move in no recording: not evaluated"] if still else []
    if missing and validation:
        reasons.append(
            f"the joints {listed(missing)} do not move in any validation log: not evaluated"
        )
    return reasons


def _why_unseen(is_still: bool, has_kept: bool) -> str:
    """Return why a joint was evaluated on no kept recording."""
    if is_still:
        return "it does not move in any recording"
    return "it does not move in any kept recording" if has_kept else "no recording was kept apart"


def _in_words(doubts: Sequence[Doubt]) -> list[str]:
    """Return one sentence per kind of doubt, with the joints that share it."""
    shared: dict[tuple[str, str], list[str]] = {}
    for doubt in doubts:
        shared.setdefault((doubt.message, doubt.code), []).append(doubt.joint)
    return [
        f"{', '.join(joints)}: {message} ({code})" if any(joints) else f"{message} ({code})"
        for (message, code), joints in shared.items()
    ]


def _judge_joint(
    joint: str, log: str, measured: JointMetrics, fitted: JointMetrics | None
) -> tuple[list[str], list[str]]:
    """Return what makes the result poor, and what makes it doubtful, on one joint."""
    error = error_of(measured)
    urdf = measured.baselines.get("urdf")
    if measured.relative_error_pct is None:
        return [f"{joint}: the torque on {log} is 0 throughout: nothing was predicted"], []
    if not measured.better_than_constant:
        constant = error / np.sqrt(1.0 - measured.r2)
        why = f"{error:.1f} % of it is missed, by its mean {constant:.1f} %"
        return [f"{joint}: worse than a constant torque on {log}: {why}"], []
    if urdf is not None and error > urdf:
        return [f"{joint}: {error:.1f} % on {log}, worse than the URDF's {urdf:.1f} %"], []
    if error > POOR:
        return [f"{joint}: predicted to {error:.1f} % only on {log}"], []
    if error > GOOD:
        why = f"predicted to {error:.1f} % on {log} (wanted: {GOOD:g} %)"
        return [], [f"{joint}: {why}; see in the report what its residual holds"]
    if fitted is not None and error > max(_OPTIMISM * error_of(fitted), 5.0):
        return [], [
            f"{joint}: {error:.1f} % on {log} against {error_of(fitted):.1f} % where it was "
            "fitted; record a richer motion to fit"
        ]
    if is_beaten(measured):
        driven = measured.baselines["urdf_with_drives"]
        why = f"{error:.1f} % on {log}, {driven:.1f} % by the URDF with fitted drives"
        return [], [f"{joint}: {why}: leave its link at the URDF"]
    return [], []


def _left_to_urdf(validation: Mapping[str, Metrics]) -> list[str]:
    """Return which joints the URDF with fitted drives predicts better, and what to do."""
    worse = [
        joint
        for metrics in validation.values()
        for joint, measured in metrics.per_joint.items()
        if is_beaten(measured)
    ]
    if not worse:
        return []
    return [
        f"the URDF with fitted drives predicts {listed(dict.fromkeys(worse))} better than the "
        "identified bodies: leave the links of these joints at the URDF, as pinned in "
        "[estimator.constraints]"
    ]


def _rank(reason: str) -> int:
    """Return 0 for what is worse than a constant, 1 for worse than the URDF, 2 for the rest."""
    return 0 if "a constant" in reason else 1 if "the URDF" in reason else 2


def error_of(measured: JointMetrics) -> float:
    """Return the relative error of a joint [%], inf where nothing was measured.

    Args:
        measured: How well it is predicted.
    """
    value = measured.relative_error_pct
    return float("inf") if value is None else value


def _doubts(finding: Finding, joints: Sequence[str]) -> Iterator[Doubt]:
    message = _WORDS[finding.code].format(**finding.evidence)
    log, _, last = finding.where.rpartition(": ")
    named = [joint for joint in last.split(", ") if joint in joints]
    for joint in named:
        yield Doubt(finding.code, joint, message)
    if not named:
        where = "" if finding.where in _OF_THE_FIT else f"{log or last}: "
        yield Doubt(finding.code, "", f"{where}{message}")


def _is_harmless(finding: Finding) -> bool:
    """Return whether the torque is explained well in spite of a constraint or a missing term."""
    if finding.code in _MISFITS:
        return finding.evidence["error_pct"] < _SMALL and "replaces" not in finding.evidence
    if finding.code != "constraint_costs":
        return False
    error, wls = finding.evidence["error_pct"], finding.evidence["wls_error_pct"]
    return error < max(_WRONG * wls, _HARMLESS)
