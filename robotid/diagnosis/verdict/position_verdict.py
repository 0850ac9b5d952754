"""The verdict on positions simulated from commands or torques, compared with simpler models."""

import math
from collections.abc import Sequence
from dataclasses import replace

from robotid.base.findings import listed
from robotid.diagnosis.verdict.evidence import BEATEN, error_of, uses_of_motion
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
    measured, of_fit = metrics.per_joint, {} if fitted is None else fitted.per_joint
    verdicts = {j: _judge_joint(j, measured.get(j), of_fit.get(j), is_validation) for j in joints}
    errors = {joint: error_of(m) for joint, m in measured.items()}
    worst_first = sorted(verdicts, key=lambda joint: -errors.get(joint, 0.0))

    def reasons(status: str) -> list[str]:
        stated = (verdicts[joint] for joint in worst_first)
        return [why for verdict in stated if verdict.status == status for why in verdict.reasons]

    unseen = "prediction of unseen motion not evaluated: no validation log given"
    warnings = [*cautions, *([] if is_validation else [unseen])]
    warnings += [] if is_settled else ["the fit has not converged"]
    verdict = concluded(
        verdicts,
        poor=reasons("poor"),
        warnings=[*warnings, *reasons("not evaluated"), *reasons("usable")],
        good="simulated position error on validation logs: at most "
        f"{max(errors.values(), default=0.0):.2g} % of each joint's RMS motion, smaller than those "
        "of simpler models",
        notes=[scale] if scale else [],
        log_errors=log_errors,
        is_tested=is_validation and bool(measured),
    )
    status = {joint: verdict.status for joint, verdict in verdicts.items() if joint in measured}
    uses = uses_of_motion(status, log_errors=log_errors, is_scaled=knows_torques)
    return replace(verdict, use_for=uses)


def _judge_joint(
    joint: str, measured: JointMetrics | None, fitted: JointMetrics | None, is_validation: bool
) -> JointVerdict:
    """Return the verdict on one joint; metrics are None if no log commands it to move."""
    simple = None if fitted is None else fitted.baselines.get("second_order")
    if fitted is not None and simple is not None:
        error = error_of(fitted)
        if error > max(_FITTED, HARDLY * simple):
            lacking = (
                f"{joint}: simulated position error {error:.2g} % of its RMS motion on the fitted "
                f"logs, {simple:.2g} % with a second-order model: the model lacks an effect of "
                "this joint, such as a torque limit"
            )
            return on_joint([lacking], [], is_tested=is_validation, checked=lacking)
    if measured is None:
        still = f"{joint}: commanded to rest in all logs: not evaluated"
        return on_joint([], [], is_tested=False, checked=still)
    error, baselines = error_of(measured), measured.baselines
    simpler = {key: other for key, other in baselines.items() if other is not None}
    beaten = [key for key in _SIMPLER if error > BEATEN * simpler.get(key, math.inf)]
    words = _SIMPLER | ({"urdf": "the URDF with fitted drives"} if "steady" in baselines else {})
    text = f"{joint}: simulated position error {error:.2g} % of its RMS motion"
    text += f"; smaller with {listed(words[key] for key in beaten)}" * bool(beaten)
    is_poor = is_validation and (error > POOR or "command" in beaten)
    is_usable = is_validation and not is_poor and (error > GOOD or bool(beaten))
    return on_joint([text] * is_poor, [text] * is_usable, is_tested=is_validation, checked=text)
