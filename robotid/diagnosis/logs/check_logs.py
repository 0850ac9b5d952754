"""The doctor: finds faults of logs, and of the URDF for these logs, before an identification.

Findings never change data. An error is a fault that makes the result wrong; it stops an
identification unless its code is ignored.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from robotid.base.exceptions import DataError
from robotid.base.findings import Finding, by_severity
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.logs.channels import (
    check_channels,
    check_clock,
    check_rest,
    check_torque_channels,
)
from robotid.diagnosis.logs.command_channels import check_commands
from robotid.diagnosis.logs.contacts import check_base
from robotid.diagnosis.logs.loads import Segments, check_payload_change
from robotid.diagnosis.logs.motion_checks import check_excitation, check_repeated_motion
from robotid.diagnosis.logs.torque_checks import check_torques
from robotid.diagnosis.logs.torque_delay import check_torque_delay
from robotid.diagnosis.logs.torque_sample import Probe, smooth_motion, take_probe
from robotid.diagnosis.urdf.inertials import (
    assumed_inertials,
    explained_by_assumed,
    rounded_angles,
)
from robotid.dynamics.base_parameters import structural_mapping
from robotid.robot.model import RobotModel
from robotid.robot.prior import with_assumed_inertials


def diagnose(
    model: RobotModel, fitted: Sequence[Log], validation: Sequence[Log], signals: SignalSettings
) -> tuple[Finding, ...]:
    """Check logs that are in memory; the findings have errors first."""
    # friction with an internal state is not examined here
    model = with_assumed_inertials(model.with_terms({}))
    findings = assumed_inertials(model)
    motions = [_examine_log(model, log, signals, findings) for log in (*fitted, *validation)]
    first = [motion for motion, _ in motions[: len(fitted)] if motion is not None]
    probes = [probe for _, probe in motions[: len(fitted)] if probe is not None]
    mapping = structural_mapping(model) if probes else None
    moving = [probe.motion for probe in probes]
    segments = Segments(model, mapping, moving, signals.min_velocity) if mapping else None
    for log, (motion, probe) in zip(validation, motions[len(fitted) :], strict=True):
        if motion is not None:
            findings += check_repeated_motion(first, motion, log.name)
        if probe is not None and segments is not None:
            own = replace(segments, motions=[probe.motion])
            findings += check_payload_change(segments, own, signals, log.name)
    if mapping is not None:
        names = ", ".join(log.name for log in fitted)
        findings += check_excitation(model, mapping, moving, signals, names)
        findings += [x for x in rounded_angles(model, mapping) if x.evidence["felt"]]
    return by_severity(x for x in findings if not explained_by_assumed(model, x))


def findings_to_dict(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return findings as plain values, as ``robotid doctor --json`` prints them."""
    keys = ("code", "severity", "where", "message")
    plain = [
        {key: getattr(one, key) for key in keys}
        | {"evidence": {key: float(x) for key, x in one.evidence.items()}}
        for one in findings
    ]
    return {"findings": plain}


def _examine_log(
    model: RobotModel, log: Log, signals: SignalSettings, findings: list[Finding]
) -> tuple[Trajectory | None, Probe | None]:
    """Add the findings on one log; return its smooth motion and a probe of it, or None."""
    name = log.name
    findings += [finding("log_note", name, text=note) for note in log.notes]
    findings += [finding("log_assumption", name, text=text) for text in log.assumed]
    if not model.is_static:  # rows of static poses may have gaps between them
        findings += [*check_clock(log), *check_channels(log, signals)]
    prismatic = [limit.name for limit in model.limits if limit.type == "prismatic"]
    findings += check_commands(log, prismatic)
    driven = [joint for joint in log.joints if joint not in model.passive]
    has_torque = log.has_torque and bool(driven)
    sizes = list(check_torque_channels(log.select(driven))) if has_torque else []
    findings += sizes
    if model.free_flyer or model.constraints or model.passive:
        findings.append(finding("floating_base", name))
        findings += check_base(model, log, signals)
        return None, None
    if model.is_static:
        return None, None  # the other checks need accelerations
    try:
        motion = smooth_motion(model, log, signals)
    except DataError as error:
        findings.append(Finding(error.code, "error", name, str(error), log=name))
        return None, None
    findings += check_rest(log, motion, model.layout)
    if not log.has_torque:
        return motion, None
    probe = take_probe(model, motion)
    if probe is None:
        findings.append(finding("no_motion", name))
        return motion, None
    if any(x.severity == "error" for x in sizes):
        return motion, probe  # torques without signs fit no model
    torques = list(check_torques(probe, name))
    findings += torques
    if not any(x.severity == "error" for x in torques):
        findings += check_torque_delay(model, log, signals, name)
    return motion, probe
