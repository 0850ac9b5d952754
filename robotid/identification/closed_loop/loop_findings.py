"""Findings of a closed-loop identification: scale, bounds, delays, gains, limits, encoders."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from robotid.base.findings import Finding, by_severity, listed, quoted
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
    settled = [_settled_delay(finding, result) for finding in examined]
    return by_severity([*settled, *_of_fit(result)])


def _of_fit(result: PositionIdentification) -> Iterator[Finding]:
    """Yield the findings of the fit."""
    estimate = result.estimate
    if not estimate.converged:
        message = (
            f"the fit has not converged after {estimate.n_iter} steps: its parameters may still "
            "change. State the known gains and delays in [controller], or use shorter windows"
        )
        yield Finding("not_settled", "warning", "fit", message)
    if not result.has_stated_gains and not result.fit.simulator.knows_torques:
        message = (
            "commands and positions determine gains, friction and inertia up to a common factor; "
            "here the masses of the URDF and gravity determine it. Ratios such as kp / armature "
            "do not depend on it. To determine the factor, state kp in [controller] or log a "
            "torque"
        )
        yield Finding("scale", "warning", "controller", message)
    yield from _torque_mismatches(result)
    if result.is_scaled_by_gain:
        yield Finding("scale", "note", "controller", STATED_SCALE)
    yield from _gains_contradicted(result)
    yield from _coarse_steps(estimate.details)
    yield from _at_bound(result)
    for together in result.correlated:
        names = listed(together, _NAMED)
        message = (
            f"{names} are strongly correlated: their ratios are more accurate than their values"
        )
        yield Finding("correlated_terms", "note", names, message)
    if result.undetermined:
        names = listed(result.undetermined, _NAMED)
        has_gains = any(name.endswith((".kp", ".kd")) for name in result.undetermined)
        known = (
            ", or state the gains, or groups of joints with equal drives, in [controller]"
            if has_gains
            else ""
        )
        message = (
            f"the logs do not determine {names}: the prior values remain. Command a motion that "
            f"depends on these parameters{known}"
        )
        yield Finding("undetermined", "warning", names, message)
    yield from _at_rest(result)
    yield from _limits_found(result)
    yield from _unequal_gains(result)
    yield from _encoder_findings(result)
    yield from map(_friction_found, (t for t in result.fit.tried if t.is_chosen or t.dropped))


def _at_rest(result: PositionIdentification) -> Iterator[Finding]:
    """Yield which friction terms and offsets are of joints that no fitted log commands to move."""
    moves = np.any([run.moves for run in result.fitted], axis=0)
    undetermined = set(result.undetermined)
    own = [
        free.name
        for free in result.fit.simulator.free_parameters
        if free.what == "term" and not moves[list(free.joints)].any()
    ]
    if left := [name for name in own if name not in undetermined]:
        names = listed(left, _NAMED)
        message = (
            f"no log commands the joints of {names} to move: these parameters explain where the "
            "joints rest, not how they move, and their standard errors are too small. Command a "
            "motion of these joints"
        )
        yield Finding("undetermined", "warning", names, message)


def _settled_delay(finding: Finding, result: PositionIdentification) -> Finding:
    """Return a finding of the logs; "slow_command" is a note if the fit determines the delay.

    A delay at its bound of 0 is not determined: the data would fit a negative one better.
    """
    if finding.code != "slow_command":
        return finding
    estimate, free_parameters = result.estimate, result.fit.simulator.free_parameters
    errors = [
        float(error)
        for free, error in zip(free_parameters, estimate.std_error, strict=True)
        if free.what == "delay"
    ]
    if any(name.endswith("delay") for name in estimate.details["at_bound"]):
        known = (
            "The delay of the fit is 0, its lower bound: its standard error is that of the bound, "
            "not of the delay"
        )
        return replace(finding, message=f"{finding.message}. {known}")
    span = finding.evidence["longest"] - finding.evidence["shortest"]
    error = max(errors, default=0.0)
    if error > _KNOWN * span:
        return finding
    how = (
        "[controller] states it"
        if not errors
        else f"the fit determines it to +- {1e3 * error:.2g} ms, provided that gains and bodies "
        "of the model are right"
    )
    message = (
        f"the command has power only up to {finding.evidence['frequency']:.2g} Hz, below the "
        "bandwidth of the loop: the response of a single joint does not determine its delay, but "
        f"{how}. To determine it independently of the model, command a chirp beyond the bandwidth "
        "of the loop, or steps"
    )
    evidence = {**finding.evidence, "std_error": error}
    return replace(finding, severity="note", message=message, evidence=evidence)


def _coarse_steps(details: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield a finding if smaller steps of the integration would still change the estimate."""
    halving = float(details.get("halving", 0.0))
    if halving > 1.0:
        message = (
            f"halving the steps of {1e3 * details['step']:.2g} ms changes a parameter by "
            f"{halving:.1f} standard errors, wanted at most {CHANGE}; the standard errors include "
            "this. Set a smaller step in [estimator]"
        )
        yield Finding("coarse_steps", "warning", "fit", message, {"halving": halving})


def _gains_contradicted(result: PositionIdentification) -> Iterator[Finding]:
    """Yield a finding if bodies or logged torques indicate gains other than those stated."""
    scale, joints = result.fit.scale, result.model.joints
    if scale is None or not scale.is_wrong:
        return
    source = "the logged torques" if result.fit.simulator.knows_torques else "weight and inertia"
    factor, error = 1.0 + scale.common, scale.common_error
    kp = zip(joints, (factor * result.fit.loops.kp).tolist(), strict=True)
    agreeing = listed([f"{joint} = {value:.3g}" for joint, value in kp], _NAMED)
    message = (
        f"{source} indicate gains of {factor:.2f} +- {error:.2g} times those stated, wanted 1. "
        f"Consistent values of kp: {agreeing}; kd likewise. Compare kp and kd in [controller] "
        "with those of the drives (units, gear ratio), and the masses of the URDF with the robot; "
        "all drive parameters scale with the gains"
    )
    yield Finding(
        "gains_contradicted",
        "warning",
        "controller",
        message,
        {"scale": factor, "std_error": error},
    )


def _at_bound(result: PositionIdentification) -> Iterator[Finding]:
    """Yield which parameters are estimated as 0, or as the largest value of a drive that moves."""
    loop = result.loop
    estimate, free_parameters = result.estimate, result.fit.simulator.free_parameters
    largest = [
        free
        for free, value in zip(free_parameters, estimate.theta.tolist(), strict=True)
        if value >= free.highest
    ]
    if largest:
        names = listed([f"{free.name} = {free.highest:g}" for free in largest], _NAMED)
        message = (
            f"{names}: the estimate is the upper bound; with more, the gear is self-locking. The "
            "motion hardly separates it from Coulomb friction and gravity, or another term is "
            "missing. Record slow motion at several loads, or set friction = 'viscous+coulomb' in "
            "[model]"
        )
        yield Finding("at_bound", "warning", names, message)
    others = {free.name for free in largest}
    at_zero = [
        name
        for name in estimate.details["at_bound"]
        if name not in others and name.rpartition(".")[2] not in _POSITIVE
    ]
    gains = [name for name in ("kp", "kd") if getattr(loop, name) is not None]
    if at_zero:
        subject = listed(at_zero, _NAMED)
        stated = [*gains, *(["delay"] if loop.delay is not None else [])]
        wrong = f", or {' or '.join(stated)} in [controller] is wrong" if stated else ""
        remedies = [f"command a motion that depends more on {subject}"]
        if loop.delay is not None:
            remedies.insert(0, "leave the delay out of [controller], so that it is fitted")
        if gains:
            remedies.insert(0, f"compare {' and '.join(gains)} with the gains of the drive")
        todo = "; ".join(remedies)
        message = (
            f"{subject}: the estimate is 0, the lower bound. The motion does not excite "
            f"{'them' if len(at_zero) > 1 else 'it'}{wrong}. {todo[0].upper()}{todo[1:]}"
        )
        yield Finding("at_bound", "warning", subject, message)
    yield from _at_least(result)
    if any(name.endswith("delay") for name in at_zero):
        message = (
            "the estimated delay is 0, its lower bound: the data do not determine it. The motion "
            "is too slow, the model lacks a drive term, or commands and positions have different "
            "clocks. Command a faster motion"
        )
        yield Finding("no_delay", "warning", "delay", message)


def _at_least(result: PositionIdentification) -> Iterator[Finding]:
    """Yield which gains and torque limits are estimated at their lower bound, which is not 0."""
    at_bound = result.estimate.details["at_bound"]
    least = [
        f"{free.name} = {free.lowest:.3g}"
        for free in result.fit.simulator.free_parameters
        if free.what in _POSITIVE and free.name in at_bound
    ]
    if least:
        names = listed(least, _NAMED)
        message = (
            f"{names}: the estimate is the lower bound, a small share of the initial value. The "
            "joint hardly follows its command, or the model lacks a drive term. Check that command "
            "and position belong to this joint, and state the value in [controller] if it is known"
        )
        yield Finding("at_bound", "warning", names, message)


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
            group = listed(map(quoted, names))
            message = (
                f"{listed(names, _NAMED)} have equal limits of effort and velocity in the URDF, as "
                f"equal drives have, but kp from {kp.min():.3g} to {kp.max():.3g}. If the drives "
                "are equal, fit their gains, armature and friction together: "
                f"groups = {{ NAME = [{group}] }} in [controller]"
            )
            yield Finding(
                "unequal_gains",
                "note",
                listed(names, _NAMED),
                message,
                {"lowest": float(kp.min()), "highest": float(kp.max())},
            )


def _limits_found(result: PositionIdentification) -> Iterator[Finding]:
    """Yield the estimated torque limits of the drives, except those at a bound."""
    estimate = result.estimate
    is_expected = result.loop.limit == "find"
    for free, value, error in zip(
        result.fit.simulator.free_parameters, estimate.theta, estimate.std_error, strict=True
    ):
        if free.what == "limit" and free.name not in estimate.details["at_bound"]:
            joint = result.model.limits[free.joints[0]]
            unit = "N" if joint.type == "prismatic" else "N m"
            message = (
                f"{joint.name}: its drive saturates. The torque limit of the drive is estimated as "
                f"{value:.3g} +- {error:.2g} {unit}; at the limit the joint does not follow its "
                "command. If you know the limit, state it in [controller]"
            )
            yield Finding(
                "limit",
                "note" if is_expected else "warning",
                joint.name,
                message,
                {"limit": float(value), "std_error": float(error)},
            )


def _torque_mismatches(result: PositionIdentification) -> Iterator[Finding]:
    """Yield which logged torques differ from those of the loops, where the fit uses them."""
    mismatch = result.fit.simulator.torque_mismatch(result.estimate.theta)
    for joint, share in zip(result.model.joints, mismatch.tolist(), strict=True):
        if share > _MISMATCH:
            message = (
                f"{joint}: the torque of its loop and the logged torque differ by "
                f"{100 * share:.0f} % of the larger (RMS); gains and friction are scaled by the "
                "logged one. Check that the column belongs to this joint and this controller, and "
                "is the joint torque in N m, or set torques = false"
            )
            yield Finding("torque_mismatch", "warning", joint, message, {"missed_pct": 100 * share})


def _friction_found(tried: Tried) -> Finding:
    """Return the finding of friction terms that cross-validation confirmed."""
    message = (
        f"{tried.joint}: {' and '.join(tried.terms)} lowers the squared error of held-out windows "
        f"by {100 * tried.gain:.0f} %"
    )
    figures = {"gain_pct": 100 * tried.gain}
    if not tried.dropped:
        return Finding("friction_found", "note", tried.joint, message, figures)
    message += (
        f", but with it {tried.dropped}. The term was dropped: another effect than friction acts "
        "on the joint. Check the mounting of the base, the torque limit and the zeros"
    )
    return Finding("friction_dropped", "warning", tried.joint, message, figures)


def _encoder_findings(result: PositionIdentification) -> Iterator[Finding]:
    """Yield zero and sign of each encoder relative to the URDF, with the evidence for them."""
    encoders, undetermined = result.fit.encoders, []
    if result.loop.zeros != "find":
        return
    for j, joint in enumerate(result.model.joints):
        zero, margin = float(result.fit.loops.zero[j]), float(encoders.margin[j])
        evidence = {
            "zero": zero, "sign": float(encoders.sign[j]), "gain": float(encoders.gain[j]),
            "explained": float(encoders.explained[j]), "margin": margin,
            "next_zero": float(encoders.next_zero[j]), "next_sign": float(encoders.next_sign[j]),
        }  # fmt: skip
        other = " and the other sign," if encoders.next_sign[j] != encoders.sign[j] else ""
        next_best = (
            f"The next best, {encoders.next_zero[j]:+.2g} rad{other} leaves {100 * margin:.0f} % "
            "more squared position error"
        )
        if encoders.gain[j] > 0:
            sense = "has the opposite sign and " if encoders.sign[j] < 0 else ""
            message = (
                f"{joint}: its encoder {sense}reads 0 where the URDF has {zero:+.3g} rad. With "
                f"gravity this explains {100 * encoders.gain[j]:.0f} % of the squared position "
                f"error. {next_best}. Calibrate the encoder, or change the zero in the URDF"
            )
            yield Finding("encoder", "warning", joint, message, evidence)
        elif margin > CLEAR:
            message = (
                f"{joint}: its encoder has the zero and sign of the URDF. Gravity explains "
                f"{100 * encoders.explained[j]:.0f} % of the slow part of the squared position "
                f"error. {next_best}"
            )
            yield Finding("encoder_uncorrected", "note", joint, message, evidence)
        else:
            undetermined.append(joint)
    yield from _undetermined_encoders(result, undetermined)


def _undetermined_encoders(
    result: PositionIdentification, undetermined: Sequence[str]
) -> Iterator[Finding]:
    """Yield which encoder zeros and signs gravity does not determine, of joints and of chains."""
    if undetermined:
        margins = [result.fit.encoders.margin[result.model.joints.index(j)] for j in undetermined]
        margin = max(0.0, *margins)
        names = listed(undetermined, _NAMED)
        message = (
            f"gravity does not determine the encoder zeros and signs of {names}: the joints move "
            "little or gravity hardly loads them, and another zero or sign leaves at most "
            f"{100 * margin:.0f} % more squared position error. The URDF's values are assumed; "
            "check them at a known pose"
        )
        yield Finding("encoder_undetermined", "note", names, message, {"margin": float(margin)})
    for chain in parallel_axes(result.model):
        names = listed(chain, _NAMED)
        message = (
            f"{names} have parallel axes: with all their signs reversed, the gravity torques are "
            "almost the same, so that gravity does not determine their common sign. Check the "
            "direction of rotation of one of them"
        )
        yield Finding("mirror_image", "note", names, message)
