"""What a user should know of a fit by simulation: scale, bounds, delays, gains, encoders."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from robotid.closed_loop.result import STATED_SCALE, LoopIdentification
from robotid.closed_loop.term_choice import Tried
from robotid.closed_loop.zeros import CLEAR, parallel_axes
from robotid.findings import Finding, by_severity, listed

__all__ = ["loop_findings"]

_SOFT = 0.5  # of what a step should correct: a loop that leaves more is soft
_MISSED = 0.5  # of a torque, that a loop which gives it does not miss
_MOVED = 0.2  # of a standard error, that halving the steps may move a parameter
_KNOWN = 0.1  # of the range of delays that one joint's response leaves: a smaller error settles it
_NAMED = 8  # parameters that a sentence names


def loop_findings(found: LoopIdentification, examined: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return what a user should know of logs and fit, the gravest first.

    Args:
        found: What was identified.
        examined: What the doctor found in the logs.
    """
    settled = [_settled_delay(finding, found) for finding in examined]
    return by_severity([*settled, *_of_fit(found)])


def _of_fit(found: LoopIdentification) -> Iterator[Finding]:
    """Yield what the user should know of the fit."""
    estimate = found.estimate
    if not estimate.converged:
        yield Finding(
            "not_settled",
            "warning",
            "fit",
            f"the fit has not settled after {estimate.n_iter} steps: its parameters may still "
            "move; state what you know of the loop in [controller], or use shorter windows",
        )
    yield from _soft_loop(estimate.details["left"])
    if not found.has_gains and not found.fit.simulator.knows_torques:
        yield Finding(
            "scale",
            "warning",
            "controller",
            "commands and positions tell gains, friction and inertia up to one factor; it rests "
            "on the masses of the URDF and on gravity. What is sure are ratios, as kp over "
            "armature; state kp in [controller], or log a torque, to tell them apart",
        )
    yield from _torque_mismatches(found)
    if found.is_scaled_by_gain:
        yield Finding("scale", "note", "controller", STATED_SCALE)
    yield from _gains_contradicted(found)
    yield from _coarse_steps(estimate.details)
    yield from _at_bound(estimate.details["at_bound"])
    for together in found.correlated:
        names = listed(together, _NAMED)
        message = f"{names} are strongly correlated: their ratios are known better than they are"
        yield Finding("correlated_terms", "note", names, message)
    if found.undetermined:
        names = listed(found.undetermined, _NAMED)
        yield Finding(
            "undetermined",
            "warning",
            names,
            f"the logs say nothing of {names}: they keep what was assumed; command a motion that "
            "needs them",
        )
    yield from _limits_found(found)
    yield from _encoder_findings(found)
    yield from map(_friction_found, (t for t in found.fit.tried if t.is_chosen))


def _settled_delay(finding: Finding, found: LoopIdentification) -> Finding:
    """Return a finding of the logs; "slow_command" as a note where the delay is known after all."""
    if finding.code != "slow_command":
        return finding
    estimate, free_parameters = found.estimate, found.fit.simulator.free_parameters
    errors = [
        float(error)
        for unknown, error in zip(free_parameters, estimate.std_error, strict=True)
        if unknown.what == "delay"
    ]
    span = finding.evidence["longest"] - finding.evidence["shortest"]
    error = max(errors, default=0.0)
    if error > _KNOWN * span:
        return finding
    how = "it is stated" if not errors else f"the fit finds it to +- {1e3 * error:.2g} ms"
    message = (
        f"the command ends below the bandwidth of the loop, up to "
        f"{finding.evidence['frequency']:.2g} Hz: the response of one joint does not show its "
        f"delay, but {how} with the gains and bodies of the model, and is as good as these. A "
        "chirp beyond the bandwidth of the loop, or steps, would show it by itself"
    )
    evidence = {**finding.evidence, "std_error": error}
    return replace(finding, severity="note", message=message, evidence=evidence)


def _coarse_steps(details: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield that smaller steps of the integration would still move the estimate, if they would."""
    halving = float(details.get("halving", 0.0))
    if halving > 1.0:
        yield Finding(
            "coarse_steps",
            "warning",
            "fit",
            f"halving the steps of {1e3 * details['step']:.2g} ms moves a parameter by "
            f"{halving:.1f} standard errors, wanted at most {_MOVED}; this is counted in the "
            "standard errors. Set a smaller step under [estimator]",
            {"halving": halving},
        )


def _gains_contradicted(found: LoopIdentification) -> Iterator[Finding]:
    """Yield that bodies or logged torques show other gains than those that were stated."""
    scale, joints = found.fit.scale, found.model.joints
    if scale is None or not scale.is_wrong:
        return
    shows = "the logged torques" if found.fit.simulator.knows_torques else "weight and inertia"
    factor, error = 1.0 + scale.common, scale.common_error
    kp = zip(joints, (factor * found.fit.loops.kp).tolist(), strict=True)
    agreeing = listed([f"{joint} = {value:.3g}" for joint, value in kp], _NAMED)
    yield Finding(
        "gains_contradicted",
        "warning",
        "controller",
        f"{shows} show gains of {factor:.2f} +- {error:.2g} times those stated, wanted 1: "
        f"kp would agree with {agreeing}, kd likewise. Compare kp and kd in [controller] with "
        "those of the drives (units, gear), or the masses of the URDF; all drive parameters scale "
        "with them",
        {"scale": factor, "std_error": error},
    )


def _at_bound(names: Sequence[str]) -> Iterator[Finding]:
    """Yield which parameters came out as 0."""
    at_zero = [name for name in names if name.rpartition(".")[2] not in ("kp", "limit")]
    if at_zero:
        yield Finding(
            "at_bound",
            "warning",
            listed(at_zero, _NAMED),
            f"{listed(at_zero, _NAMED)} came out as 0, the smallest possible value: the motion "
            "shows none, or a stated gain or delay is wrong; leave the delay out of [controller], "
            "so that it is found, and compare the stated gains with those of the drive",
        )
    if any(name.endswith("delay") for name in at_zero):
        yield Finding(
            "no_delay",
            "warning",
            "delay",
            "the delay came out as 0: commands and positions may not be of one clock, or the "
            "motion is too slow to show it; command a faster one",
        )


def _limits_found(found: LoopIdentification) -> Iterator[Finding]:
    """Yield the largest torques that were found."""
    estimate = found.estimate
    for unknown, value, error in zip(
        found.fit.simulator.free_parameters, estimate.theta, estimate.std_error, strict=True
    ):
        if unknown.what == "limit":
            joint = found.model.limits[unknown.joints[0]]
            unit = "N" if joint.type == "prismatic" else "N m"
            yield Finding(
                "limit",
                "note",
                joint.name,
                f"{joint.name}: its drive gives at most {value:.3g} +- {error:.2g} {unit}, beyond "
                "which it no longer follows its command; if you know its limit, state it in "
                "[controller]",
                {"limit": float(value), "std_error": float(error)},
            )


def _soft_loop(left: float) -> Iterator[Finding]:
    """Yield that the direct method's steps leave much of what they should correct, if they do."""
    if left > _SOFT:
        yield Finding(
            "soft_loop",
            "warning",
            "fit",
            f"a step of error = 'direct' leaves {100 * left:.0f} % of what it should correct, "
            "because it neglects how the motion changes; errors are large in a loop as soft as "
            "this. Set error = 'input'",
            {"left": left},
        )


def _torque_mismatches(found: LoopIdentification) -> Iterator[Finding]:
    """Yield which logged torques are not those of the loops, though they weigh."""
    simulator = found.fit.simulator
    if simulator.behind is None:
        return
    missed = simulator.torque_mismatch(found.estimate.theta)
    for joint, share in zip(found.model.joints, missed.tolist(), strict=True):
        if share > _MISSED:
            yield Finding(
                "torque_mismatch",
                "warning",
                joint,
                f"{joint}: its loop and the logged torque, by which gains and friction are scaled, "
                f"differ by {100 * share:.0f} % of the larger (root mean squares); see whether the "
                "column is this joint's, in N m behind the gear and of this controller, or set "
                "torques = false",
                {"missed_pct": 100 * share},
            )


def _friction_found(tried: Tried) -> Finding:
    """Return what is said of terms that other windows confirmed."""
    return Finding(
        "friction_found",
        "note",
        tried.joint,
        f"{tried.joint}: {' and '.join(tried.terms)} lowers the squared error of windows that it "
        f"was not fitted to by {100 * tried.gain:.0f} %",
        {"gain_pct": 100 * tried.gain},
    )


def _encoder_findings(found: LoopIdentification) -> Iterator[Finding]:
    """Yield zero and sense of each encoder beside the URDF's, and what speaks for them."""
    encoders, open_ = found.fit.encoders, []
    if found.loop.zeros != "find":
        return
    for j, joint in enumerate(found.model.joints):
        zero, margin = float(found.fit.loops.zero[j]), float(encoders.margin[j])
        evidence = {
            "zero": zero, "sign": float(encoders.sign[j]), "gain": float(encoders.gain[j]),
            "explained": float(encoders.explained[j]), "margin": margin,
            "next_zero": float(encoders.next_zero[j]), "next_sign": float(encoders.next_sign[j]),
        }  # fmt: skip
        other = ", counted the other way," if encoders.next_sign[j] != encoders.sign[j] else ""
        beside = (
            f"the next best, {encoders.next_zero[j]:+.2g} rad{other} leaves {100 * margin:.0f} % "
            "more of the squared error of the loops"
        )
        if encoders.gain[j] > 0:
            sense = "counts the other way, and " if encoders.sign[j] < 0 else ""
            yield Finding(
                "encoder",
                "warning",
                joint,
                f"{joint}: its encoder {sense}reads 0 where the URDF is at {zero:+.3g} rad; by "
                f"gravity this explains {100 * encoders.gain[j]:.0f} % of what holds the loop off "
                f"its command; {beside}. Calibrate it, or state the zero in the URDF",
                evidence,
            )
        elif margin > CLEAR:
            yield Finding(
                "encoder_uncorrected",
                "note",
                joint,
                f"{joint}: its encoder has zero and sense of the URDF, by gravity, which explains "
                f"{100 * encoders.explained[j]:.0f} % of what slowly holds it off its command; "
                f"{beside}",
                evidence,
            )
        else:
            open_.append(joint)
    yield from _untold_encoders(found, open_)


def _untold_encoders(found: LoopIdentification, open_: Sequence[str]) -> Iterator[Finding]:
    """Yield which zeros and senses gravity leaves open: those of joints, and those of chains."""
    if open_:
        margins = [found.fit.encoders.margin[found.model.joints.index(j)] for j in open_]
        margin = max(0.0, *margins)
        names = listed(open_, _NAMED)
        yield Finding(
            "encoder_undetermined",
            "note",
            names,
            f"gravity does not tell zero and sense of {names}: they move little, or bear so "
            f"little that others leave {100 * margin:.0f} % more of the squared error of the loops "
            "at most. They are taken to be the URDF's; compare them at a known pose",
            {"margin": float(margin)},
        )
    for chain in parallel_axes(found.model):
        names = listed(chain, _NAMED)
        yield Finding(
            "mirror_image",
            "note",
            names,
            f"{names} turn about parallel axes: gravity hardly tells them from their mirror image, "
            "all of them counted the other way. Look which way one of them turns",
        )
