"""identify_loops(): closed-loop identification of drives, loops and bodies from command logs."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import Finding, by_severity, listed, quoted
from robotid.base.typing import ProgressCallback, ignore_progress, report_stage
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import unwrap
from robotid.diagnosis.catalogue import entries, finding
from robotid.diagnosis.verdict.fit_findings import not_written, unlike_findings
from robotid.diagnosis.verdict.verdict import blocking
from robotid.dynamics.prediction import predict_instants
from robotid.dynamics.simulation.loops import Loops, open_loops
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.estimation.variation.variation import vary
from robotid.identification.closed_loop.initial_values import CLEAR, parallel_axes
from robotid.identification.closed_loop.loop_result import (
    PositionIdentification,
    identified_loops,
    loop_runs,
)
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.position_errors import run_open_loop
from robotid.identification.closed_loop.stages import (
    CHANGE,
    STAGES,
    Fitted,
    fit_loops,
    stated_loops,
)
from robotid.identification.result import StatedSettings
from robotid.robot.model import RobotModel


def identify_loops(
    model: RobotModel,
    logs: Sequence[Log],
    validation: Sequence[Log],
    loop: LoopSettings,
    settings: SimulationSettings,
    *,
    signals: SignalSettings | None = None,
    chooses: bool = True,
    examined: Sequence[Finding] = (),
    ignore: Sequence[str] = (),
    units: Sequence[str] = (),
    progress: ProgressCallback = ignore_progress,
) -> PositionIdentification:
    """Identify drives, loops and bodies from logs of commands and positions."""
    if not logs:
        raise DataError("no log was given. An identification needs at least one log")
    used = signals or SignalSettings()
    if loop.kind == "torque":
        logs, validation = (
            [driven_log(model, log, used) for log in part] for part in (logs, validation)
        )
    for log in (*logs, *validation):
        if log.q_ref is None:
            raise DataError(
                f"{log.name} has no commands, which the estimator 'simulation' needs. Record "
                "columns qref_ of each joint, or simulate from the logged torque: [controller] "
                "kind = 'torque'"
            )
    if loop.gravity_compensation:
        logs, validation = (
            [with_gravity(model, log) for log in part] for part in (logs, validation)
        )
    fitted = fit_loops(
        model, logs, loop, settings, signals=signals, chooses=chooses, progress=progress
    )
    report_stage(progress, "testing", STAGES)
    sign, simulator = fitted.encoders.sign, fitted.simulator
    robot = simulator.fine or simulator.robot  # with the steps of the fit
    runs = [
        [
            run_open_loop(
                robot, fitted.loops, log.turned(sign), _others(model, loop, fitted)
            )
            for log in part
        ]
        for part in (logs, validation)
    ]  # fmt: skip
    result = identified_loops(model, loop, settings, fitted, *map(tuple, runs))
    errors = blocking(examined, ignore)
    result = replace(
        result,
        log_errors=tuple(finding.message for finding in errors),
        stated=StatedSettings(used, ignore=tuple(ignore)),
        variation=vary(
            [log.name for log in logs],
            loop_runs(model, simulator, fitted.estimate, units),
            sorted(set(units)),
        ),
    )
    examined = [*examined, *unlike_findings(result.variation)]
    return replace(result, findings=(*loop_findings(result, examined), *not_written(errors)))


def _others(model: RobotModel, loop: LoopSettings, fitted: Fitted) -> dict[str, Loops]:
    """Return simpler models by name, for ``run_open_loop``.

    The URDF with the stated gains has no friction and no rotor inertia.
    """
    if fitted.linear is not None:
        driven, from_rows = fitted.linear.urdf_with_drives, fitted.linear.standard
        return {"urdf": open_loops(model, driven), "rows": open_loops(model, from_rows)}
    others = {} if fitted.plain is None else {"second_order": fitted.plain.loops}
    if loop.kp is not None and not any(u.what == "kp" for u in fitted.simulator.free_parameters):
        n, stated = len(model.joints), stated_loops(model, loop)
        bare = replace(stated, terms=((),) * n, values=np.zeros(0), armature=np.full(n, 1e-9))
        others["urdf"] = bare
    return others


def with_gravity(model: RobotModel, log: Log) -> Log:
    """Return a log with the URDF's gravity torque at the measured position added to tau_ref."""
    torque = predict_instants(model, model.standard_parameters(), log.q)
    fed = torque if log.tau_ref is None else log.tau_ref + torque
    return replace(log, tau_ref=fed)


def driven_log(model: RobotModel, log: Log, signals: SignalSettings) -> Log:
    """Return a log whose feed-forward torque is the measured one.

    The feed-forward torque is constant between two rows: the mean of the two, which avoids a delay
    of half a row. The command is the measured position; its gain is 0.
    """
    if not log.has_torque:
        raise DataError(
            f"{log.name} has no torque, which [controller] kind = 'torque' needs as the input. "
            "Record columns tau_ of each joint, or set kind = 'pd' for a log of commands"
        )
    free = np.array([joint.turns_freely for joint in model.limits])
    log = unwrap(log, free)
    measured = np.column_stack(
        [np.interp(log.t + signals.torque_delay, log.t, own) for own in log.tau.T]
    )
    tau = np.vstack([0.5 * (measured[1:] + measured[:-1]), measured[-1:]])
    return replace(log, q_ref=log.q, v_ref=None, tau_ref=tau)


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
        yield finding("scale", subject="controller", what="urdf")
    mismatch = result.fit.simulator.torque_mismatch(estimate.theta)
    for joint, share in zip(result.model.joints, mismatch.tolist(), strict=True):
        if share > _MISMATCH:
            yield finding("torque_mismatch", "", joint, missed_pct=100 * share)
    if result.is_scaled_by_gain:
        yield finding("scale", severity="note", subject="controller", what="gains")
    yield from _gains_contradicted(result)
    if (halving := float(estimate.details.get("halving", 0.0))) > 1.0:
        step = float(estimate.details["step"])
        yield finding("coarse_steps", subject="fit", halving=halving, step=step, limit=CHANGE)
    yield from _at_bound(result)
    for together in result.correlated:
        yield _named("correlated_terms:commands", together)
    if names := result.undetermined:
        has_gains = any(name.endswith((".kp", ".kd")) for name in names)
        yield _named("undetermined:commands", names, cure=has_gains)
    yield from _at_rest(result)
    yield from _limits_found(result)
    yield from _unequal_gains(result)
    yield from _encoder_findings(result)
    for tried in result.fit.tried:
        terms, gain = " and ".join(tried.terms), 100 * tried.gain
        if tried.dropped:
            yield finding(
                "friction_dropped", "", tried.joint, terms=terms, gain_pct=gain,
                dropped=tried.dropped,
            )  # fmt: skip
        elif tried.is_chosen:
            yield finding("friction_found", "", tried.joint, terms=terms, gain_pct=gain)


def _named(code: str, names: Sequence[str], **values: Any) -> Finding:  # noqa: ANN401
    """Return a finding about parameters."""
    words = listed(names, _NAMED)
    return finding(code, subject=words, names=words, **values)


def _at_rest(result: PositionIdentification) -> Iterator[Finding]:
    """Yield which friction terms and offsets are of joints that no fitted log commands to move."""
    moves = np.any([run.moves for run in result.fitted], axis=0)
    names = [
        free.name
        for free in result.fit.simulator.free_parameters
        if free.what == "term" and not moves[list(free.joints)].any()
    ]
    if left := [name for name in names if name not in result.undetermined]:
        yield _named("undetermined:rest", left)


def _settled_delay(examined: Finding, result: PositionIdentification) -> Finding:
    """Return a finding of the logs; "slow_command" is a note if the fit determines the delay.

    A delay at its bound of 0 is not determined: the data would fit a negative one better.
    """
    if examined.code != "slow_command":
        return examined
    estimate, free_parameters = result.estimate, result.fit.simulator.free_parameters
    errors = [
        float(error)
        for free, error in zip(free_parameters, estimate.std_error, strict=True)
        if free.what == "delay"
    ]
    if any(name.endswith("delay") for name in estimate.details["at_bound"]):
        known = (
            ". The delay of the fit is 0, its lower bound: its standard error is that of the "
            "bound, not of the delay"
        )
        return examined.reworded(remedy=examined.remedy + known)
    span = examined.evidence["longest"] - examined.evidence["shortest"]
    error = max(errors, default=0.0)
    if error > _KNOWN * span:
        return examined
    entry = entries()["slow_command:known"]
    fault = entry["message"].replace("{what}", entry["what"]["fitted" if errors else "stated"])
    evidence = {**examined.evidence, "std_error": error}
    return examined.reworded(
        severity="note", fault=fault, remedy=entry["remedy"], evidence=evidence
    )


def _gains_contradicted(result: PositionIdentification) -> Iterator[Finding]:
    """Yield a finding if bodies or logged torques indicate gains other than those stated."""
    scale, joints = result.fit.scale, result.model.joints
    if scale is None or not scale.is_wrong:
        return
    factor = 1.0 + scale.common
    kp = zip(joints, (factor * result.fit.loops.kp).tolist(), strict=True)
    yield finding(
        "gains_contradicted", subject="controller", what=result.fit.simulator.knows_torques,
        agreeing=listed([f"{joint} = {value:.3g}" for joint, value in kp], _NAMED),
        scale=factor, std_error=scale.common_error,
    )  # fmt: skip


def _at_bound(result: PositionIdentification) -> Iterator[Finding]:
    """Yield which parameters are estimated at a bound, and what to do about it."""
    loop, estimate = result.loop, result.estimate
    free_parameters, at_bound = result.fit.simulator.free_parameters, estimate.details["at_bound"]
    values = zip(free_parameters, estimate.theta.tolist(), strict=True)
    largest = {free.name: free.highest for free, value in values if value >= free.highest}
    if largest:
        yield _named("at_bound:largest", [f"{name} = {x:g}" for name, x in largest.items()])
    least = {
        free.name: free.lowest
        for free in free_parameters
        if free.what in _POSITIVE and free.name in at_bound
    }
    at_zero = [
        name
        for name in at_bound
        if name not in largest and name.rpartition(".")[2] not in _POSITIVE
    ]
    if at_zero:
        gains = [name for name in ("kp", "kd") if getattr(loop, name) is not None]
        stated = [*gains, *(["delay"] if loop.delay is not None else [])]
        wrong = f", or {' or '.join(stated)} in [controller] is wrong" if stated else ""
        remedies = [f"command a motion that depends more on {listed(at_zero, _NAMED)}"]
        if loop.delay is not None:
            remedies.insert(0, "leave the delay out of [controller], so that it is fitted")
        if gains:
            remedies.insert(0, f"compare {' and '.join(gains)} with the gains of the drive")
        todo = "; ".join(remedies)
        todo = f"{todo[0].upper()}{todo[1:]}"
        yield _named("at_bound:zero", at_zero, wrong=wrong, todo=todo)
    if least:
        yield _named("at_bound:least", [f"{name} = {x:.3g}" for name, x in least.items()])
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
            yield finding(
                "unequal_gains", "", names, lowest=kp.min(), highest=kp.max(),
                group=listed(map(quoted, names)),
            )  # fmt: skip


def _limits_found(result: PositionIdentification) -> Iterator[Finding]:
    """Yield the estimated torque limits of the drives, except those at a bound."""
    estimate, free_parameters = result.estimate, result.fit.simulator.free_parameters
    severity = "note" if result.loop.limit == "find" else "warning"
    for free, value, error in zip(free_parameters, estimate.theta, estimate.std_error, strict=True):
        if free.what == "limit" and free.name not in estimate.details["at_bound"]:
            joint = result.model.limits[free.joints[0]]
            unit = "N" if joint.type == "prismatic" else "N m"
            yield finding(
                "limit", "", joint.name, severity=severity, limit=value, std_error=error, unit=unit
            )


def _encoder_findings(result: PositionIdentification) -> Iterator[Finding]:
    """Yield zero and sign of each encoder relative to the URDF, with the evidence for them."""
    if result.loop.zeros != "find":
        return
    encoders, undetermined = result.fit.encoders, []
    for j, joint in enumerate(result.model.joints):
        figures = {
            "zero": result.fit.loops.zero[j], "sign": encoders.sign[j], "gain": encoders.gain[j],
            "explained": encoders.explained[j], "margin": encoders.margin[j],
            "next_zero": encoders.next_zero[j], "next_sign": encoders.next_sign[j],
        }  # fmt: skip
        other = bool(encoders.next_sign[j] != encoders.sign[j])
        if encoders.gain[j] > 0:
            sense = bool(encoders.sign[j] < 0)
            yield finding("encoder", "", joint, sense=sense, other=other, **figures)
        elif encoders.margin[j] > CLEAR:
            yield finding("encoder_uncorrected", "", joint, other=other, **figures)
        else:
            undetermined.append(j)
    if undetermined:
        names = [result.model.joints[j] for j in undetermined]
        margin = max(0.0, *encoders.margin[undetermined])
        yield finding("encoder_undetermined", "", names, margin=margin)
    for chain in parallel_axes(result.model):
        yield finding("mirror_image", "", chain)
