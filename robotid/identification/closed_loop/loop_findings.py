"""Findings of a closed-loop identification: scale, bounds, delays, gains, limits, encoders."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from robotid.base.findings import Finding, by_severity, listed, quoted
from robotid.diagnosis.catalogue import entries, finding
from robotid.identification.closed_loop.encoder_zeros import CLEAR, parallel_axes
from robotid.identification.closed_loop.further_parameters import Tried
from robotid.identification.closed_loop.loop_result import STATED_SCALE, PositionIdentification
from robotid.identification.closed_loop.stages import CHANGE

_MISMATCH = 0.5  # largest relative error of a torque that the loop of its joint gives
_KNOWN = 0.1  # standard error of a known delay, relative to the range found from one response
_POSITIVE = ("kp", "limit")  # parameters whose lower bound is more than 0
_UNEQUAL = 3.0  # ratio of the gains of equal drives from which on they are reported
_NAMED = 8  # largest number of parameters that a sentence names


def loop_findings(
    result: PositionIdentification, examined: Sequence[Finding]
) -> tuple[Finding, ...]:
    """Return the findings of logs and fit, the most severe first."""
    settled = [_settled_delay(one, result) for one in examined]
    return by_severity([*settled, *_of_fit(result)])


def _of_fit(result: PositionIdentification) -> Iterator[Finding]:
    """Yield the findings of the fit."""
    estimate = result.estimate
    if not estimate.converged:
        yield finding("not_settled", subject="fit", steps=estimate.n_iter)
    if not result.has_stated_gains and not result.fit.simulator.knows_torques:
        yield finding("scale", subject="controller", what="unknown", cure="unknown")
    yield from _torque_mismatches(result)
    if result.is_scaled_by_gain:
        words = {"what": "stated", "cure": "stated", "text": STATED_SCALE}
        yield finding("scale", subject="controller", severity="note", **words)
    yield from _gains_contradicted(result)
    yield from _coarse_steps(estimate.details)
    yield from _at_bound(result)
    for together in result.correlated:
        names = listed(together, _NAMED)
        yield finding("correlated_terms", subject=names, what="ratios", joint=names)
    if result.undetermined:
        names = listed(result.undetermined, _NAMED)
        has_gains = any(name.endswith((".kp", ".kd")) for name in result.undetermined)
        cure = "gains" if has_gains else "commands"
        yield finding("undetermined", subject=names, what="commands", cure=cure, names=names)
    yield from _at_rest(result)
    yield from _limits_found(result)
    yield from _unequal_gains(result)
    yield from _encoder_findings(result)
    yield from map(_friction_found, (t for t in result.fit.tried if t.is_chosen or t.dropped))


def _at_rest(result: PositionIdentification) -> Iterator[Finding]:
    """Yield which friction terms and offsets are of joints that no fitted log commands to move."""
    moves = np.any([run.moves for run in result.fitted], axis=0)
    left = [
        free.name
        for free in result.fit.simulator.free_parameters
        if free.what == "term" and not moves[list(free.joints)].any()
        if free.name not in result.undetermined
    ]
    if left:
        names = listed(left, _NAMED)
        yield finding("undetermined", subject=names, what="rest", cure="rest", names=names)


def _settled_delay(found: Finding, result: PositionIdentification) -> Finding:
    """Return a finding of the logs; "slow_command" is a note if the fit determines the delay.

    A delay at its bound of 0 is not determined: the data would fit a negative one better.
    """
    if found.code != "slow_command":
        return found
    texts, estimate = entries()["slow_command"], result.estimate
    errors = [
        float(error)
        for free, error in zip(
            result.fit.simulator.free_parameters, estimate.std_error, strict=True
        )
        if free.what == "delay"
    ]
    if any(name.endswith("delay") for name in estimate.details["at_bound"]):
        return found.reworded(remedy=found.remedy + texts["at_zero"])
    span = found.evidence["longest"] - found.evidence["shortest"]
    error = max(errors, default=0.0)
    if error > _KNOWN * span:
        return found
    how = texts["by_fit"] if errors else texts["by_statement"]
    return found.reworded(
        severity="note", evidence={**found.evidence, "std_error": error},
        fault=texts["settled"].replace("{how}", how), remedy=texts["settled_remedy"],
    )  # fmt: skip


def _coarse_steps(details: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield a finding if smaller steps of the integration would still change the estimate."""
    halving = float(details.get("halving", 0.0))
    if halving > 1.0:
        figures = {"halving": halving, "step": details["step"], "wanted": CHANGE}
        yield finding("coarse_steps", subject="fit", **figures)


def _gains_contradicted(result: PositionIdentification) -> Iterator[Finding]:
    """Yield a finding if bodies or logged torques indicate gains other than those stated."""
    scale, joints = result.fit.scale, result.model.joints
    if scale is None or not scale.is_wrong:
        return
    factor = 1.0 + scale.common
    kp = zip(joints, (factor * result.fit.loops.kp).tolist(), strict=True)
    yield finding(
        "gains_contradicted", subject="controller", source=result.fit.simulator.knows_torques,
        agreeing=listed([f"{joint} = {value:.3g}" for joint, value in kp], _NAMED),
        scale=factor, std_error=scale.common_error,
    )  # fmt: skip


def _at_bound(result: PositionIdentification) -> Iterator[Finding]:
    """Yield which parameters are estimated as 0, or as the largest value of a drive that moves."""
    loop, estimate = result.loop, result.estimate
    pairs = zip(result.fit.simulator.free_parameters, estimate.theta.tolist(), strict=True)
    largest = [free for free, value in pairs if value >= free.highest]
    if largest:
        names = listed([f"{free.name} = {free.highest:g}" for free in largest], _NAMED)
        yield finding("at_bound", subject=names, severity="warning", what="highest", names=names)
    others = {free.name for free in largest}
    at_zero = [
        name
        for name in estimate.details["at_bound"]
        if name not in others and name.rpartition(".")[2] not in _POSITIVE
    ]
    if at_zero:
        names = listed(at_zero, _NAMED)
        gains = [name for name in ("kp", "kd") if getattr(loop, name) is not None]
        stated = [*gains, *(["delay"] if loop.delay is not None else [])]
        wrong = f", or {' or '.join(stated)} in [controller] is wrong" if stated else ""
        todo = [f"command a motion that depends more on {names}"]
        if loop.delay is not None:
            todo.insert(0, "leave the delay out of [controller], so that it is fitted")
        if gains:
            todo.insert(0, f"compare {' and '.join(gains)} with the gains of the drive")
        text = "; ".join(todo)
        yield finding(
            "at_bound", subject=names, severity="warning", what="zero", names=names, wrong=wrong,
            it="them" if len(at_zero) > 1 else "it", cure=f"{text[0].upper()}{text[1:]}",
        )  # fmt: skip
    lowest = [
        f"{free.name} = {free.lowest:.3g}"
        for free in result.fit.simulator.free_parameters
        if free.what in _POSITIVE and free.name in estimate.details["at_bound"]
    ]
    if lowest:
        names = listed(lowest, _NAMED)
        yield finding("at_bound", subject=names, severity="warning", what="lowest", names=names)
    if any(name.endswith("delay") for name in at_zero):
        yield finding("no_delay", subject="delay")


def _unequal_gains(result: PositionIdentification) -> Iterator[Finding]:
    """Yield which joints with equal limits in the URDF have gains that differ, each fitted alone.

    Equal drives have equal gains: a large difference is an error of one of them.
    """
    free = [x for x in result.fit.simulator.free_parameters if x.what == "kp"]
    alike: dict[tuple[str, float, float], list[int]] = {}
    for j in (x.joints[0] for x in free if len(x.joints) == 1):
        limit = result.model.limits[j]
        alike.setdefault((limit.type, limit.effort, limit.velocity), []).append(j)
    for (_, effort, _), joints in alike.items():
        kp = result.fit.loops.kp[joints]
        if kp.max() > _UNEQUAL * kp.min() > 0 and np.isfinite(effort):
            names = [result.model.joints[j] for j in joints]
            text = listed(names, _NAMED)
            yield finding(
                "unequal_gains", "", names, subject=text, names=text, lowest=kp.min(),
                group=listed(map(quoted, names)), highest=kp.max(),
            )  # fmt: skip


def _limits_found(result: PositionIdentification) -> Iterator[Finding]:
    """Yield the estimated torque limits of the drives, except those at a bound."""
    estimate = result.estimate
    severity = "note" if result.loop.limit == "find" else "warning"
    for free, value, error in zip(
        result.fit.simulator.free_parameters, estimate.theta, estimate.std_error, strict=True
    ):
        if free.what == "limit" and free.name not in estimate.details["at_bound"]:
            joint = result.model.limits[free.joints[0]]
            unit = "N" if joint.type == "prismatic" else "N m"
            figures = {"limit": float(value), "std_error": float(error)}
            yield finding("limit", "", joint.name, severity=severity, unit=unit, **figures)


def _torque_mismatches(result: PositionIdentification) -> Iterator[Finding]:
    """Yield which logged torques differ from those of the loops, where the fit uses them."""
    mismatch = result.fit.simulator.torque_mismatch(result.estimate.theta)
    for joint, share in zip(result.model.joints, mismatch.tolist(), strict=True):
        if share > _MISMATCH:
            yield finding("torque_mismatch", "", joint, missed_pct=100 * share)


def _friction_found(tried: Tried) -> Finding:
    """Return the finding of friction terms that cross-validation confirmed."""
    code = "friction_dropped" if tried.dropped else "friction_found"
    words = {"terms": " and ".join(tried.terms), "dropped": tried.dropped}
    return finding(code, "", tried.joint, gain_pct=100 * tried.gain, **words)


def _encoder_findings(result: PositionIdentification) -> Iterator[Finding]:
    """Yield zero and sign of each encoder relative to the URDF, with the evidence for them."""
    encoders, undetermined = result.fit.encoders, []
    if result.loop.zeros != "find":
        return
    for j, joint in enumerate(result.model.joints):
        margin = float(encoders.margin[j])
        evidence = {
            "zero": float(result.fit.loops.zero[j]), "sign": float(encoders.sign[j]),
            "gain": float(encoders.gain[j]), "explained": float(encoders.explained[j]),
            "margin": margin, "next_zero": float(encoders.next_zero[j]),
            "next_sign": float(encoders.next_sign[j]),
        }  # fmt: skip
        other = "other" if encoders.next_sign[j] != encoders.sign[j] else "same"
        if encoders.gain[j] > 0:
            is_reversed = bool(encoders.sign[j] < 0)
            yield finding("encoder", "", joint, sense=is_reversed, next=other, **evidence)
        elif margin > CLEAR:
            yield finding("encoder_uncorrected", "", joint, next=other, **evidence)
        else:
            undetermined.append(joint)
    yield from _undetermined_encoders(result, undetermined)


def _undetermined_encoders(
    result: PositionIdentification, undetermined: Sequence[str]
) -> Iterator[Finding]:
    """Yield which encoder zeros and signs gravity does not determine, of joints and of chains."""
    if undetermined:
        margins = [result.fit.encoders.margin[result.model.joints.index(j)] for j in undetermined]
        names = listed(undetermined, _NAMED)
        margin = float(max(0.0, *margins))
        yield finding(
            "encoder_undetermined", "", undetermined, subject=names, names=names, margin=margin
        )
    for chain in parallel_axes(result.model):
        names = listed(chain, _NAMED)
        yield finding("mirror_image", "", chain, subject=names, names=names)
