"""identify_commands(): from a model and logs of commands to drives, loops, bodies and trust."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from robotid._typing import Array, ProgressCallback, ignore_progress, report_stage
from robotid.commanded.driven import driven_log
from robotid.commanded.errors import OpenLoop, run_open_loop
from robotid.commanded.fit import STAGES, Fitted, fit_loops, stated_loops
from robotid.commanded.open_loop_verdict import judge_open_loops
from robotid.commanded.settings import LoopSettings
from robotid.commanded.term_choice import Tried
from robotid.commanded.unknowns import with_terms
from robotid.commanded.zeros import CLEAR, parallel_axes
from robotid.exceptions import DataError
from robotid.findings import Finding, by_severity, listed
from robotid.fitting.bands import REACH
from robotid.fitting.settings import SimulationSettings
from robotid.judgement.verdict import Verdict, alarming
from robotid.logs.data import Log
from robotid.logs.settings import SignalSettings
from robotid.regressor.prediction import predict_instants
from robotid.robot.model import RobotModel
from robotid.simulation.loops import Loops, open_loops

__all__ = ["Commanded", "identify_commands", "with_gravity"]

_FROM_DATA = 0.3  # a parameter whose spread the data shrink below this share is theirs
_FROM_PRIOR = 0.9  # ... above this share, what was assumed of it
_TOGETHER = 0.98  # correlation from which two parameters are told together only
_SOFT = 0.5  # of what a step should correct: a loop that leaves more is soft
_MISSED = 0.5  # of a torque, that a loop which gives it does not miss
_MOVED = 0.2  # of a standard error, that halving the steps may move a parameter
_KNOWN = 0.1  # of the range of delays that one joint's response leaves: a smaller error settles it
_STATED_SCALE = (
    "positions do not show the scale: all drive and inertial parameters scale with kp as stated "
    "(kp stated 20 % too large makes all 20 % too large); log a torque to test it"
)
_CAUTIONS = ("at_bound", "coarse_steps", "gains_contradicted")  # keep a result from being good
_NAMED = 8  # parameters that a sentence names


@dataclass(frozen=True, eq=False)
class Commanded:
    """What was found from commands and positions.

    Attributes:
        model: The robot, with the friction terms that were found.
        loop: What was stated of the loops.
        settings: The estimator's.
        fitted: The fit.
        errors: Open loops on the fitted logs.
        kept: Open loops on logs kept apart.
        findings: What the user should know.
        alarms: Faults of the logs that make the result wrong, as the doctor found them.
    """

    model: RobotModel
    loop: LoopSettings
    settings: SimulationSettings
    fitted: Fitted
    errors: tuple[OpenLoop, ...]
    kept: tuple[OpenLoop, ...]
    findings: tuple[Finding, ...]
    alarms: tuple[str, ...] = ()

    @cached_property
    def standard(self) -> Array:
        """Standard parameters of the model, shape (p,)."""
        return self.fitted.simulator.standard(self.model, self.fitted.estimate.theta)[0]

    @cached_property
    def standard_covariance(self) -> Array:
        """Their covariance, shape (p, p); 0 of what was not to be found."""
        estimate = self.fitted.estimate
        _, slopes = self.fitted.simulator.standard(self.model, estimate.theta)
        covariance: Array = slopes @ estimate.covariance @ slopes.T
        return covariance

    @cached_property
    def standard_reach(self) -> Array:
        """How many standard errors the 95 % interval of each standard parameter reaches, (p,).

        The quantile is that of the unknown, of those it follows from, whose standard error has the
        fewest degrees of freedom.
        """
        estimate = self.fitted.estimate
        _, slopes = self.fitted.simulator.standard(self.model, estimate.theta)
        reach: Array = np.where(slopes != 0.0, estimate.reach, REACH).max(axis=1, initial=REACH)
        return reach

    @cached_property
    def shrunk(self) -> Array:
        """How far the data shrink what each unknown may be, shape (c,): 1 not at all [-]."""
        estimate = self.fitted.estimate
        share: Array = estimate.std_error / self.fitted.simulator.prior_std
        return share

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Unknowns that the logs say nothing of, bodies left out."""
        return tuple(
            unknown.name
            for unknown, share in zip(self.fitted.simulator.unknowns, self.shrunk, strict=True)
            if share > _FROM_PRIOR and unknown.what != "body"
        )

    @property
    def told_together(self) -> tuple[tuple[str, ...], ...]:
        """Unknowns of loops whose errors go together, so that their ratios alone are known."""
        return _together(self.fitted)

    @property
    def has_gains(self) -> bool:
        """Whether the gains of the position were stated, of every joint."""
        return not any(unknown.what == "kp" for unknown in self.fitted.simulator.unknowns)

    @cached_property
    def verdict(self) -> Verdict:
        """How far to trust it."""
        return judge_open_loops(
            self.model.joints,
            self.kept or self.errors,
            is_kept=bool(self.kept),
            is_settled=self.fitted.estimate.converged,
            alarms=self.alarms,
            cautions=[f.message for f in self.findings if f.code in _CAUTIONS],
            scale=_STATED_SCALE if self.is_scaled_by_gain else "",
        )

    @property
    def is_scaled_by_gain(self) -> bool:
        """Whether stated gains alone set the scale: no torque was logged that shows it."""
        simulator = self.fitted.simulator
        return self.loop.kind != "torque" and self.has_gains and not simulator.knows_torques


def identify_commands(
    model: RobotModel,
    logs: Sequence[Log],
    kept: Sequence[Log],
    loop: LoopSettings,
    settings: SimulationSettings,
    *,
    signals: SignalSettings | None = None,
    chooses: bool = True,
    examined: Sequence[Finding] = (),
    ignore: Sequence[str] = (),
    progress: ProgressCallback = ignore_progress,
) -> Commanded:
    """Identify drives, loops and bodies from logs of commands and positions.

    Args:
        model: The robot.
        logs: Logs to fit, of its joints in its order, with commands, or with torques if these
            drive the robot.
        kept: Logs kept apart.
        loop: What is known of the loops.
        settings: The estimator's.
        signals: How torques become rows, and how late they are.
        chooses: Whether further friction is tried.
        examined: What the doctor found in the logs.
        ignore: Codes of its errors that you know better.
        progress: Told of the stages.

    Raises:
        DataError: If there is no log, or one has no commands.
        NotConvergedError: If it cannot be rolled out.
        SettingsError: If a setting does not fit the robot.
    """
    if not logs:
        raise DataError("no log was given; at least one is needed to identify anything")
    if loop.kind == "torque":
        told = signals or SignalSettings()
        logs, kept = ([driven_log(model, log, told) for log in part] for part in (logs, kept))
    for log in (*logs, *kept):
        if log.q_ref is None:
            raise DataError(
                f"{log.name} has no commands, which the estimator 'simulation' follows; record "
                "columns qref_ of each joint, or have its torque drive the robot: [controller] "
                "kind = 'torque'"
            )
    if loop.gravity_compensation:
        logs, kept = ([with_gravity(model, log) for log in part] for part in (logs, kept))
    fitted = fit_loops(
        model, logs, loop, settings, signals=signals, chooses=chooses, progress=progress
    )
    report_stage(progress, "testing", STAGES)
    sign = fitted.encoders.sign
    runs = [
        [
            run_open_loop(
                fitted.simulator.robot, fitted.loops, log.turned(sign),
                **_others(model, loop, fitted),
            )
            for log in part
        ]
        for part in (logs, kept)
    ]  # fmt: skip
    found = Commanded(
        model=with_terms(model, fitted.loops),
        loop=loop,
        settings=settings,
        fitted=fitted,
        errors=tuple(runs[0]),
        kept=tuple(runs[1]),
        findings=tuple(examined),
        alarms=tuple(finding.message for finding in alarming(examined, ignore)),
    )
    settled = [_settled_delay(finding, found) for finding in examined]
    return replace(found, findings=by_severity([*settled, *_findings(found)]))


def _others(model: RobotModel, loop: LoopSettings, fitted: Fitted) -> dict[str, Loops]:
    """Return plainer models, as ``run_open_loop`` takes them.

    With the stated gains the URDF has no friction, and rotors that weigh nothing.
    """
    if fitted.linear is not None:
        driven, found = fitted.linear.urdf_with_drives, fitted.linear.standard
        return {"urdf": open_loops(model, driven), "rows": open_loops(model, found)}
    others = {} if fitted.plain is None else {"plain": fitted.plain.loops}
    if loop.kp is not None and not any(u.what == "kp" for u in fitted.simulator.unknowns):
        n, stated = len(model.joints), stated_loops(model, loop)
        bare = replace(stated, terms=((),) * n, values=np.zeros(0), armature=np.full(n, 1e-9))
        others["urdf"] = bare
    return others


def with_gravity(model: RobotModel, log: Log) -> Log:
    """Return a log whose fed-forward torque has that of gravity by the URDF, as measured.

    Args:
        model: The robot as its URDF says.
        log: The log, of its joints in its order, with commands.
    """
    torque = predict_instants(model, model.standard_parameters(), log.q)
    fed = torque if log.tau_ref is None else log.tau_ref + torque
    return replace(log, tau_ref=fed)


def _together(fitted: Fitted) -> tuple[tuple[str, ...], ...]:
    """Return the sets of unknowns of loops whose errors are correlated."""
    unknowns, errors = fitted.simulator.unknowns, fitted.estimate.std_error
    own = [k for k, u in enumerate(unknowns) if u.what != "body" and errors[k] > 0]
    covariance = fitted.estimate.covariance[np.ix_(own, own)]
    correlation = covariance / np.outer(errors[own], errors[own])
    sets: list[set[int]] = []
    for a, b in np.argwhere(np.triu(np.abs(correlation) > _TOGETHER, 1)):
        joined = [s for s in sets if s & {int(a), int(b)}]
        sets = [s for s in sets if s not in joined] + [set().union({int(a), int(b)}, *joined)]
    return tuple(tuple(unknowns[own[k]].name for k in sorted(s)) for s in sets)


def _findings(found: Commanded) -> Iterator[Finding]:
    """Yield what the user should know of the fit."""
    estimate = found.fitted.estimate
    if not estimate.converged:
        yield Finding(
            "not_settled",
            "warning",
            "fit",
            f"the fit has not settled after {estimate.n_iter} steps: its parameters may still "
            "move; state what you know of the loop in [controller], or use shorter windows",
        )
    yield from _soft_loop(estimate.details["left"])
    if not found.has_gains and not found.fitted.simulator.knows_torques:
        yield Finding(
            "scale",
            "warning",
            "controller",
            "commands and positions tell gains, friction and inertia up to one factor; it rests "
            "on the masses of the URDF and on gravity. What is sure are ratios, as kp over "
            "armature; state kp in [controller], or log a torque, to tell them apart",
        )
    yield from _torques_missed(found)
    if found.is_scaled_by_gain:
        yield Finding("scale", "note", "controller", _STATED_SCALE)
    yield from _gains_contradicted(found)
    yield from _coarse_steps(estimate.details)
    yield from _at_bound(estimate.details["at_bound"])
    for told_names in found.told_together:
        told = listed(told_names, _NAMED)
        yield Finding(
            "told_together",
            "note",
            told,
            f"{told} are told together only: their ratios are known better than they are",
        )
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
    yield from map(_friction_found, (t for t in found.fitted.tried if t.is_chosen))


def _settled_delay(finding: Finding, found: Commanded) -> Finding:
    """Return a finding of the logs; "slow_command" as a note where the delay is known after all."""
    if finding.code != "slow_command":
        return finding
    estimate, unknowns = found.fitted.estimate, found.fitted.simulator.unknowns
    errors = [
        float(error)
        for unknown, error in zip(unknowns, estimate.std_error, strict=True)
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


def _gains_contradicted(found: Commanded) -> Iterator[Finding]:
    """Yield that bodies or logged torques show other gains than those that were stated."""
    scale, joints = found.fitted.scale, found.model.joints
    if scale is None or not scale.is_wrong:
        return
    shows = "the logged torques" if found.fitted.simulator.knows_torques else "weight and inertia"
    factor, error = 1.0 + scale.common, scale.common_error
    kp = zip(joints, (factor * found.fitted.loops.kp).tolist(), strict=True)
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


def _limits_found(found: Commanded) -> Iterator[Finding]:
    """Yield the largest torques that were found."""
    estimate = found.fitted.estimate
    for unknown, value, error in zip(
        found.fitted.simulator.unknowns, estimate.theta, estimate.std_error, strict=True
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


def _torques_missed(found: Commanded) -> Iterator[Finding]:
    """Yield which logged torques are not those of the loops, though they weigh."""
    simulator = found.fitted.simulator
    if simulator.behind is None:
        return
    missed = simulator.missed_torque(found.fitted.estimate.theta)
    for joint, share in zip(found.model.joints, missed.tolist(), strict=True):
        if share > _MISSED:
            yield Finding(
                "torque_missed",
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


def _encoder_findings(found: Commanded) -> Iterator[Finding]:
    """Yield zero and sense of each encoder beside the URDF's, and what speaks for them."""
    encoders, open_ = found.fitted.encoders, []
    if found.loop.zeros != "find":
        return
    for j, joint in enumerate(found.model.joints):
        zero, margin = float(found.fitted.loops.zero[j]), float(encoders.margin[j])
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
                "encoder_kept",
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


def _untold_encoders(found: Commanded, open_: Sequence[str]) -> Iterator[Finding]:
    """Yield which zeros and senses gravity leaves open: those of joints, and those of chains."""
    if open_:
        margins = [found.fitted.encoders.margin[found.model.joints.index(j)] for j in open_]
        margin = max(0.0, *margins)
        names = listed(open_, _NAMED)
        yield Finding(
            "encoder_open",
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
