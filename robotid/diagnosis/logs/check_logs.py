"""The doctor: finds faults of logs, and of the URDF for these logs, before an identification.

Findings never change data. An error is a fault that makes the result wrong; it stops an
identification unless its code is ignored.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, RobotIdError
from robotid.base.findings import Finding, by_severity, quoted, toml_key
from robotid.base.tolerances import TINY
from robotid.base.typing import Array
from robotid.data.log import REPEATED, Log, Trajectory, repeated_share
from robotid.data.signal_settings import LogUnits, SignalSettings
from robotid.data.units import AT_REST, STATIC, STILL
from robotid.diagnosis.catalogue import codes_with, finding
from robotid.diagnosis.decisions import BETTER, NOTHING, ROWS, SCATTERED, SEGMENTS, ZERO
from robotid.diagnosis.explanations import explained
from robotid.diagnosis.logs import channels
from robotid.diagnosis.logs.base_checks import examine_base
from robotid.diagnosis.logs.command_channels import check_commands
from robotid.diagnosis.logs.probe import Probe, smooth_motion, take_probe
from robotid.diagnosis.logs.torque_checks import TorqueCheck, is_suspect
from robotid.diagnosis.logs.torque_delay import check_torque_delay
from robotid.diagnosis.urdf.inertials import assumed_inertials, explained_by_assumed, rounded_angles
from robotid.dynamics.base_parameters import BaseMapping, structural_mapping
from robotid.dynamics.factors import compress, merge
from robotid.dynamics.prepared_logs import base_problem, independent_share
from robotid.dynamics.rows import sure_rows
from robotid.estimation.estimators import WLS, Estimate, determination
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread, with_assumed_inertials

_FAR = 2 * np.pi  # number in a log above which a position may be a percentage


def diagnose(
    model: RobotModel, fitted: Sequence[Log], validation: Sequence[Log], signals: SignalSettings
) -> tuple[Finding, ...]:
    """Check logs that are in memory; the findings have errors first."""
    # friction with an internal state is not examined here
    model = with_assumed_inertials(model.with_terms({}))
    examined = [_examine_log(model, log, signals) for log in (*fitted, *validation)]
    assumed = assumed_inertials(model)
    is_possible = all(x.severity != "error" for x in assumed)
    _examine_torques(model, [one for one in examined if one.is_tried and is_possible], signals)
    findings = [*assumed, *(x for one in examined for x in one.findings)]
    first = [one.motion for one in examined[: len(fitted)] if one.motion is not None]
    moved = {x for m in first for j, x in enumerate(model.joints) if np.ptp(m.q[:, j]) >= STATIC}
    findings = [x for x in findings if x.code != "static_joint" or not moved >= {*x.joints}]
    probes = [x.probe for x in examined[: len(fitted)] if x.probe and not model.constraints]
    mapping = structural_mapping(model) if probes else None
    for k, log in enumerate(fitted):
        same = [x.name for x in fitted[:k] if np.array_equal([x.q, x.tau], [log.q, log.tau])]
        findings += [finding("repeated_log", log.name, other=same[0])] if same else []
    for one in examined[len(fitted) :]:
        share = 0.0 if one.motion is None else repeated_share(first, one.motion)
        if share >= REPEATED:
            findings.append(finding("repeated_motion", one.log.name, share=share))
    if mapping is not None:
        names = ", ".join(log.name for log in fitted)
        findings += check_excitation(model, mapping, [x.motion for x in probes], signals, names)
        findings += [x for x in rounded_angles(model, mapping) if x.evidence["felt"]]
    return by_severity(x for x in explained(findings, model) if not explained_by_assumed(model, x))


def findings_to_dict(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return findings as plain values, as ``robotid doctor --json`` prints them."""
    keys = ("code", "severity", "where", "message")
    evidence = [{key: float(x) for key, x in one.evidence.items()} for one in findings]
    plain = [{key: getattr(one, key) for key in keys} for one in findings]
    return {"findings": [x | {"evidence": y} for x, y in zip(plain, evidence, strict=True)]}


@dataclass(eq=False)
class _Examined:
    """A log and what is found of it."""

    log: Log
    findings: list[Finding]
    motion: Trajectory | None = None  # smooth
    probe: Probe | None = None  # of a motion with torques
    is_tried: bool = False  # whether a model may fit these torques


def _examine_log(model: RobotModel, log: Log, signals: SignalSettings) -> _Examined:
    """Return what the channels of one log show, and its motion."""
    name = log.name
    findings = [finding("log_note", name, text=note) for note in log.notes]
    findings += [finding("log_assumption", name, text=text) for text in log.assumed]
    if not model.is_static:  # rows of static poses may have gaps between them
        clock = list(channels.check_clock(log))
        if without := [x for x in clock if (x.code, x.severity) == ("bunched_stamps", "error")]:
            return _Examined(log, [*findings, *without])  # no times of rows: nothing can be said
        findings += [*clock, *channels.check_channels(log, signals)]
    findings += channels.check_limits(log, model.limits)
    prismatic = [limit.name for limit in model.limits if limit.type == "prismatic"]
    findings += check_commands(log, prismatic)
    driven = [joint for joint in log.joints if joint not in model.passive]
    if log.has_torque and driven:
        findings += channels.check_torque_channels(log.select(driven))
    one = _Examined(log, findings)
    if model.free_flyer or model.constraints or model.passive:
        of_base, motion = examine_base(model, log, signals)
        findings += of_base
        if model.loops or model.passive or motion is None:
            findings.append(finding("floating_base", name))
        elif log.has_torque:
            one.probe = take_probe(model, motion)
        one.is_tried = all(x.severity != "error" for x in findings)
        return one
    if model.is_static:
        return one  # the other checks need accelerations
    try:
        one.motion = smooth_motion(model, log, signals)
    except DataError as error:
        findings.append(Finding(error.code, "error", name, str(error), log=name))
        return one
    findings += channels.check_rest(log, one.motion, model.layout)
    if not log.has_torque:
        return one
    one.probe = take_probe(model, one.motion)
    if one.probe is None:
        findings.append(finding("no_motion", name))
    codes = {x.code for x in findings if x.severity == "error"}
    one.is_tried = codes.isdisjoint(codes_with("fits_no_model"))
    return one


def _examine_torques(model: RobotModel, logs: Sequence[_Examined], signals: SignalSettings) -> None:
    """Add the findings on the torques of logs."""
    # Other readings are tried for the log that is explained worst, and for those that are explained
    # clearly worse than another; for all once one is found.
    checks = [(one, TorqueCheck.of(one.probe)) for one in logs if one.probe is not None]
    checks.sort(key=lambda x: float(np.log(x[1].share + TINY).mean()), reverse=True)
    is_read = False
    for i, (one, check) in enumerate(checks):
        name = one.log.name
        is_tried = i == 0 or is_read or is_suspect(check, [x for _, x in checks])
        torques = list(check.read(name)) if is_tried else []
        is_read |= bool(torques)
        torques = torques or list(check.loads(name))
        coarse = {joint for x in one.findings if x.code == "quantised" for joint in x.joints}
        is_wrong = any(x.severity == "error" for x in one.findings)  # and so the URDF's torque
        off = [] if model.constraints or is_wrong else _drives_off(check.probe, coarse, name)
        one.findings += [*off, *torques]
        if not (model.constraints or any(x.severity == "error" for x in torques)):
            one.findings += check_torque_delay(model, one.log, signals, name)


def _drives_off(probe: Probe, coarse: Collection[str], name: str) -> Iterator[Finding]:
    """Yield the joints that move by the torque of others, in a part of the motion or all of it."""
    # The torque is about 0 and related to neither the URDF's torque nor the speed.
    loads, parts = probe.loads.sum(axis=2), np.array_split(np.arange(len(probe.tau)), SEGMENTS)
    tau, load, speed = (
        np.array([np.mean(x[rows] ** 2, axis=0) for rows in parts])  # (parts, n)
        for x in (probe.tau, loads, probe.v)
    )
    moves = speed > AT_REST**2
    is_small = moves & (tau < ZERO * load)
    for j, joint in enumerate(probe.model.joints):
        is_all = bool((is_small == moves)[:, j].all())
        is_off = is_small[:, j] & (is_all | (tau[:, j] < ZERO**2 * tau[:, j].mean()))
        off = np.flatnonzero(is_off)
        if len(off) < SCATTERED or (joint in coarse and not is_all):
            continue
        rows = np.concatenate([parts[k] for k in off])
        x = np.column_stack([probe.tau[rows, j], loads[rows, j], probe.v[rows, j]])
        x = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), NOTHING)
        if np.ptp(probe.tau[:, j]) and np.mean(x[:, 1:] * x[:, :1], axis=0).max() < BETTER:
            yield finding(
                "drive_off", name, joint, share=len(off) / moves[:, j].sum(), quoted=quoted(joint),
                ratio=np.sqrt(tau[off, j].mean() / load[off, j].mean()),
                severity="error" if is_all else "warning",
            )  # fmt: skip


def check_excitation(
    model: RobotModel, mapping: BaseMapping, motions: Sequence[Trajectory],
    signals: SignalSettings, name: str,
) -> Iterator[Finding]:  # fmt: skip
    """Yield which base parameters the fitted motions determine."""
    prior, step = model.standard_parameters(), -(-max(len(m.t) for m in motions) // ROWS)
    thinned = [motion.every(step) for motion in motions]
    try:
        masks = [sure_rows(model.layout, m.v, signals.min_velocity) for m in thinned]
        used = zip(thinned, masks, strict=True)
        factors = merge([compress(base_problem(model, mapping, *motion)) for motion in used])
        wls = WLS(prior=mapping.to_base(prior)).fit(factors)
    except RobotIdError as error:
        yield finding(
            "excitation", name, severity="warning", what="unchecked", todo="unchecked",
            text=str(error),
        )  # fmt: skip
        return
    share = step * min(independent_share(replace(signals, rate=m.rate)) for m in motions)
    squares = np.sum([motion.squares for motion in thinned], axis=0)
    spread = prior_spread(model, squares, sum(len(motion.t) for motion in thinned))
    rows = factors.weighted(wls.sigma / np.sqrt(share))[:, :-1]
    spread = determination.base_spread(mapping.K, spread)
    known = determination.determine(mapping.base_names, rows, spread)
    yield excitation_finding(wls, known, name)


def excitation_finding(wls: Estimate, known: determination.Determination, name: str) -> Finding:
    """Return the finding on which base parameters a motion determines."""
    evidence = {"rank": known.rank, "base": len(known.names), "weakest": known.shrinkage[-1]}
    if np.isfinite(wls.condition):
        evidence["condition"] = wls.condition
    kinds = ("poor", "lost") if known.groups else ("weak", "good")
    todo = kinds[not determination.is_poorly_excited(wls, len(known.names))]
    return finding(
        "excitation", name, severity="warning" if todo == "poor" else "note", what="rank",
        todo=todo, described=known.described() if known.groups else "",
        condition_number=f"{wls.condition:.3g}", **evidence,
    )  # fmt: skip


def check_locked(
    model: RobotModel, positions: Mapping[str, Array], log: str, asked: Collection[str],
    units: LogUnits,
) -> Iterator[Finding]:  # fmt: skip
    """Yield an error "locked_position" per locked joint that moves or has another position."""
    types = {joint.name: joint.type for joint in model.tree.movable}
    for joint, q in positions.items():
        stated = model.locked[joint]
        middle, extent = float(np.median(q)), float(np.ptp(q))
        if extent <= STILL and abs(middle - stated) <= STILL:
            continue
        what = "moves" if extent > STILL else "stands"
        yield finding(
            "locked_position", log, joint, what=what, todo=what, default=joint in asked,
            unit="m" if types[joint] == "prismatic" else "rad", stated=stated, median=middle,
            range=extent,
            setting=f"locked = {{ {joint} = {middle:.4g} }}", flag=f"--lock {joint}={middle:.4g}",
            percent=percent_hint(model, joint, middle, units),
        )  # fmt: skip


def percent_hint(model: RobotModel, name: str, position: float, units: LogUnits) -> str:
    """Return what to state if the position of a gripper is a percentage; "" if it cannot be one."""
    joint = next(joint for joint in model.tree.movable if joint.name == name)
    first, scale = units.scale(name, is_angle=joint.type != "prismatic")
    logged = (position - first) / scale
    moves = any(other.parent == joint.child for other in model.tree.movable)
    if name in units.percent or moves or not joint.has_limits or not _FAR < logged <= 100:
        return ""
    low, high = joint.lower, joint.upper
    unit = "m" if joint.type == "prismatic" else "rad"
    return (
        f". If {logged:.4g}, the number in the log, is a percentage, as of LeRobot's grippers, set "
        f"percent = {{ {toml_key(name)} = [{low:.4g}, {high:.4g}] }} in [units], the positions at "
        f"0 and at 100 [{unit}]: it then is at {low + (high - low) * logged / 100:.4g} {unit}"
    )
