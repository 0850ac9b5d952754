"""The verdict on drives found from commands: how far open loops run, beside plainer models."""

from collections.abc import Iterable, Sequence

import numpy as np

from robotid.commanded.errors import OpenLoop
from robotid.findings import listed
from robotid.judgement.verdict import JointVerdict, Verdict

__all__ = ["GOOD", "POOR", "judge_open_loops"]

#: Share of its motion that the open loop of a joint misses on logs kept apart: well, not usable.
GOOD, POOR = 0.05, 0.3
_URDF = {False: "the URDF with the stated gains", True: "the URDF with fitted drives"}
_BEATEN = 1.05  # a plainer model that misses this many times less is better


def judge_open_loops(
    joints: Sequence[str],
    runs: Sequence[OpenLoop],
    *,
    is_kept: bool,
    is_settled: bool = True,
    alarms: Sequence[str] = (),
    cautions: Sequence[str] = (),
    scale: str = "",
) -> Verdict:
    """Return the verdict: by open loops on logs kept apart, and by plainer models on the same.

    Args:
        joints: Names of the n joints.
        runs: Open loops beside logs.
        is_kept: Whether the logs were kept apart from the fit.
        is_settled: Whether the fit has settled.
        alarms: Faults of the logs that make the result wrong.
        cautions: What keeps a result from being good, whatever its open loops are.
        scale: What the scale of all parameters rests on, if nothing measured shows it.
    """
    told = [[run for run in runs if _is_told(run, j)] for j in range(len(joints))]
    by_joint = {
        joint: _judge_joint(joint, j, own, is_kept)
        if own
        else JointVerdict("not evaluated", (f"{joint} is told to stand still: nothing tests it",))
        for j, (joint, own) in enumerate(zip(joints, told, strict=True))
    }
    rank = {"poor": 0, "not evaluated": 1, "usable": 2, "good": 3}
    tested = [by_joint[joint].status for joint, own in zip(joints, told, strict=True) if own]
    status = min(tested, key=rank.__getitem__, default="not evaluated")
    if status == "good" and not all(told):
        status = "usable"
    reasons = [
        reason
        for verdict in sorted(by_joint.values(), key=lambda v: rank[v.status])
        if verdict.status != "good"
        for reason in verdict.reasons
    ]
    if not is_settled:
        reasons.insert(0, "the fit has not settled")
        status = min(status, "usable", key=rank.__getitem__)
    if not is_kept:
        reasons.insert(0, "no log was kept apart: nothing tests the open loop; add [[validation]]")
    if status == "good":
        worst = max(_share(own, j) for j, own in enumerate(told))
        reasons = [
            f"open loops miss at most {100 * worst:.2g} % of the motion of any joint on logs kept "
            "apart, and less than plainer models"
        ]
    if cautions:
        reasons = [*cautions, *(reasons if status != "good" else [])]
        status = min(status, "usable", key=rank.__getitem__)
    reasons += [scale] if scale else []
    if alarms:
        status, reasons = "poor", [*alarms, *(reasons if status != "good" else [])]
    return Verdict(status, tuple(reasons), by_joint, alarms=tuple(alarms))


def _is_told(run: OpenLoop, j: int) -> bool:
    """Return whether a log tells a joint to move: at rest, its errors are no share of a motion."""
    if run.steady is not None or run.log.q_ref is None:
        return True  # by torques
    return bool(np.ptp(run.log.q_ref[:, j]) > 0)


def _judge_joint(joint: str, j: int, runs: Sequence[OpenLoop], is_kept: bool) -> JointVerdict:
    """Return the verdict on one joint, by all logs together that tell it to move."""
    share = _share(runs, j)
    said = f"{joint}: the open loop misses {100 * share:.2g} % of its motion"
    beaten = [
        name
        for name, others in (
            ("the command itself", [run.command for run in runs]),
            ("the plain model of second order", [run.second_order for run in runs]),
            (_URDF[runs[0].steady is not None], [run.urdf for run in runs]),
            ("what the torques tell by themselves", [run.rows for run in runs]),
            ("going on at the speed of the start", [run.steady for run in runs]),
        )
        if all(other is not None for other in others)
        and _mean(run.rmse[j] for run in runs)
        > _BEATEN * _mean(other[j] for other in others if other is not None)
    ]
    if beaten:
        said += f"; {listed(beaten)} misses less"
    if not is_kept:
        return JointVerdict("not evaluated", (said,))
    if share > POOR or "the command itself" in beaten:
        return JointVerdict("poor", (said,))
    if share > GOOD or beaten:
        return JointVerdict("usable", (said,))
    return JointVerdict("good", (said,))


def _share(runs: Sequence[OpenLoop], j: int) -> float:
    """Return the share of a joint's motion that open loops miss, all logs together."""
    return _mean(run.rmse[j] for run in runs) / max(_mean(run.spread[j] for run in runs), 1e-12)


def _mean(values: Iterable[float]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(list(values)))))
