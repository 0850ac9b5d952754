"""The verdict on positions simulated from commands or torques, compared with simpler models."""

from collections.abc import Sequence
from dataclasses import replace

from robotid.base.findings import listed
from robotid.diagnosis.verdict.evidence import BEATEN, error_of
from robotid.diagnosis.verdict.uses import uses_of_motion
from robotid.diagnosis.verdict.verdict import JointVerdict, Verdict, concluded, on_joint
from robotid.estimation.fitting.evaluation import JointMetrics, Metrics

#: [%] simulated position error of a joint on validation logs: limits of "good" and "usable".
GOOD, POOR = 5.0, 30.0
#: Error over that of the second-order model from which it is hardly smaller: half the squares.
HARDLY = 0.7
_FITTED = 15.0  # [%] ... on fitted logs: then the model lacks an effect if this large
#: Simpler models, by name of the baseline; "urdf" has fitted drives where torques are the input.
_SIMPLER = {
    "command": "the command itself",
    "second_order": "a second-order model",
    "urdf": "the URDF with the stated gains",
    "rows": "the fit to torques alone",
    "steady": "constant velocity from the start",
}
_DRIVEN = {**_SIMPLER, "urdf": "the URDF with fitted drives"}


def judge_positions(
    metrics: Metrics,
    joints: Sequence[str],
    *,
    fitted: Metrics | None = None,
    is_validation: bool,
    is_settled: bool = True,
    log_errors: Sequence[str] = (),
    cautions: Sequence[str] = (),
    scale: str = "",
    knows_torques: bool = False,
) -> Verdict:
    """Return the verdict on simulated positions."""
    own = {} if fitted is None else fitted.per_joint
    found = {
        joint: _judge_joint(joint, metrics.per_joint.get(joint), own.get(joint), is_validation)
        for joint in joints
    }
    worst_first = sorted(
        found, key=lambda j: -error_of(metrics.per_joint[j]) if j in metrics.per_joint else 0.0
    )
    reasons = {
        status: [why for j in worst_first if found[j].status == status for why in found[j].reasons]
        for status in ("poor", "not evaluated", "usable")
    }
    warnings = list(cautions)
    if not is_validation:
        warnings.append("prediction of unseen motion not evaluated: no validation log given")
    if not is_settled:
        warnings.append("the fit has not converged")
    worst = max(map(error_of, metrics.per_joint.values()), default=0.0)
    verdict = concluded(
        found,
        poor=reasons["poor"],
        warnings=[*warnings, *reasons["not evaluated"], *reasons["usable"]],
        good=f"simulated position error on validation logs: at most {worst:.2g} % of each joint's "
        "RMS motion, smaller than those of simpler models",
        notes=[scale] if scale else [],
        log_errors=log_errors,
        is_tested=is_validation and bool(metrics.per_joint),
    )
    uses = uses_of_motion(
        {joint: found[joint].status for joint in found if joint in metrics.per_joint},
        log_errors=log_errors,
        is_scaled=knows_torques,
    )
    return replace(verdict, use_for=uses)


def _judge_joint(
    joint: str, measured: JointMetrics | None, fitted: JointMetrics | None, is_validation: bool
) -> JointVerdict:
    """Return the verdict on one joint; metrics are None if no log commands it to move."""
    simple = None if fitted is None else fitted.baselines.get("second_order")
    if fitted is not None and simple is not None:
        own = error_of(fitted)
        if own > max(_FITTED, HARDLY * simple):
            lacking = (
                f"{joint}: simulated position error {own:.2g} % of its RMS motion on the fitted "
                f"logs, {simple:.2g} % with a second-order model: the model lacks an effect of "
                "this joint, such as a torque limit"
            )
            return on_joint([lacking], [], is_tested=is_validation, checked=lacking)
    if measured is None:
        still = f"{joint}: commanded to rest in all logs: not evaluated"
        return on_joint([], [], is_tested=False, checked=still)
    error, baselines = error_of(measured), measured.baselines
    names = _DRIVEN if "steady" in baselines else _SIMPLER
    beaten = [
        key
        for key in names
        if (simpler := baselines.get(key)) is not None and error > BEATEN * simpler
    ]
    error_text = f"{joint}: simulated position error {error:.2g} % of its RMS motion"
    if beaten:
        error_text += f"; smaller with {listed(names[key] for key in beaten)}"
    if not is_validation:
        return on_joint([], [], is_tested=False, checked=error_text)
    if error > POOR or "command" in beaten:
        return on_joint([error_text], [], is_tested=True, checked="")
    return on_joint(
        [], [error_text] if error > GOOD or beaten else [], is_tested=True, checked=error_text
    )
