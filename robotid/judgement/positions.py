"""The verdict on positions that are simulated from commands or torques, beside plainer models."""

from collections.abc import Sequence

from robotid.findings import listed
from robotid.fitting.metrics import JointMetrics, Metrics
from robotid.judgement.evidence import BEATEN, error_of
from robotid.judgement.verdict import JointVerdict, Verdict, concluded, on_joint

__all__ = ["GOOD", "POOR", "judge_positions"]

#: [%] of its motion that the simulation of a joint misses on validation logs: good, not usable.
GOOD, POOR = 5.0, 30.0
#: Plainer models, by name of the baseline; the URDF has drives fitted to torques that drive it.
_PLAINER = {
    "command": "the command itself",
    "second_order": "the plain model of second order",
    "urdf": "the URDF with the stated gains",
    "rows": "the fit of torques alone",
    "steady": "going on at the speed of the start",
}
_DRIVEN = {**_PLAINER, "urdf": "the URDF with fitted drives"}


def judge_positions(
    metrics: Metrics,
    joints: Sequence[str],
    *,
    is_kept: bool,
    is_settled: bool = True,
    log_errors: Sequence[str] = (),
    cautions: Sequence[str] = (),
    scale: str = "",
) -> Verdict:
    """Return the verdict on simulated positions.

    Args:
        metrics: Those of positions, all logs together, of the joints that are commanded to move.
        joints: Names of the model's joints; one without metrics is not evaluated.
        is_kept: Whether the logs were kept apart from the fit.
        is_settled: Whether the fit has settled.
        log_errors: Faults of the logs that make the result wrong.
        cautions: What keeps a result from being good, whatever its errors are.
        scale: What the scale of all parameters depends on, if nothing measured shows it.
    """
    found = {joint: _judge_joint(joint, metrics.per_joint.get(joint), is_kept) for joint in joints}
    reasons = {
        status: [why for own in found.values() if own.status == status for why in own.reasons]
        for status in ("poor", "not evaluated", "usable")
    }
    warnings = list(cautions)
    if not is_kept:
        warnings.append("the prediction of a new motion was not evaluated: no validation log given")
    if not is_settled:
        warnings.append("the fit has not settled")
    worst = max(map(error_of, metrics.per_joint.values()), default=0.0)
    return concluded(
        found,
        poor=reasons["poor"],
        warnings=[*warnings, *reasons["not evaluated"], *reasons["usable"]],
        good=f"simulated position error on validation logs: at most {worst:.2g} % of each joint's "
        "RMS motion, smaller than that of plainer models",
        notes=[scale] if scale else [],
        log_errors=log_errors,
        is_tested=is_kept and bool(metrics.per_joint),
    )


def _judge_joint(joint: str, measured: JointMetrics | None, is_kept: bool) -> JointVerdict:
    """Return the verdict on one joint; measured is None if no log commands it to move."""
    if measured is None:
        still = f"{joint}: commanded to are at rest in all logs: not evaluated"
        return on_joint([], [], is_tested=False, said=still)
    error, baselines = error_of(measured), measured.baselines
    names = _DRIVEN if "steady" in baselines else _PLAINER
    beaten = [
        key
        for key in names
        if (plainer := baselines.get(key)) is not None and error > BEATEN * plainer
    ]
    said = f"{joint}: simulated position error {error:.2g} % of its RMS motion"
    if beaten:
        said += f"; smaller with {listed(names[key] for key in beaten)}"
    if not is_kept:
        return on_joint([], [], is_tested=False, said=said)
    if error > POOR or "command" in beaten:
        return on_joint([said], [], is_tested=True, said="")
    return on_joint([], [said] if error > GOOD or beaten else [], is_tested=True, said=said)
