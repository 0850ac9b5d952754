"""From recordings to parameters and a verdict on them."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from robotid.base.exceptions import (
    DataError,
    ModelError,
    NotConvergedError,
    RankDeficientError,
    SettingsError,
)
from robotid.base.findings import Finding, grouped, not_ignored
from robotid.base.typing import ProgressCallback, ignore_progress, report_stage
from robotid.data.files.columns import Needs
from robotid.data.files.read import Readable, read_logs
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.explanations import explained
from robotid.diagnosis.residual.discrepancies import explain_residual
from robotid.diagnosis.residual.misfit import clipped, settled
from robotid.diagnosis.residual.term_trials import take_sample
from robotid.diagnosis.urdf.inertials import (
    assumed_inertials,
    explained_by_assumed,
    impossible_inertials,
)
from robotid.diagnosis.verdict.fit_findings import (
    fit_findings,
    log_findings,
    not_written,
    unlike_findings,
)
from robotid.diagnosis.verdict.scale_check import check_scale
from robotid.diagnosis.verdict.verdict import blocking, rejected, warnings_of
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.constraint_rows import logged_base
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.fit import fit_recordings, rough_choice, solve_recordings
from robotid.estimation.fitting.fitted import Fit
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.estimation.variation.variation import vary
from robotid.identification.drive_choice import choose_drives
from robotid.identification.model_error import settled_shapes, with_model_error
from robotid.identification.repeated_errors import with_repeated_errors
from robotid.identification.result import StatedSettings, TorqueIdentification
from robotid.robot.drives import AUTO, wanted_families
from robotid.robot.model import RobotModel
from robotid.robot.prior import with_assumed_inertials

_ROBOTS = (".urdf", ".xml", ".xacro")  # suffixes of files that describe robots
_MOST_SHAPES = 2  # fits for the refinement of shapes together with the terms of all joints


def in_memory(
    model: RobotModel, settings: SignalSettings, fitted: Sequence[Log], held_out: Sequence[Log] = ()
) -> Recordings:
    """Return the recordings of logs in memory."""
    first, second = (
        [hold_log(model, log, settings) for log in some] for some in (fitted, held_out)
    )
    return Recordings(model, structural_mapping(model), first, second)


def logs_of(
    model: RobotModel, given: Readable | Sequence[Readable], needs: Needs = "torque"
) -> tuple[Log, ...]:
    """Return the logs of a robot, read if they are files or DataFrames."""
    return read_logs(
        given, model.joints, prismatic=model.layout.prismatic, needs=needs,
        base=logged_base(model), passive=model.passive, robot=model.tree.movable,
    )  # fmt: skip


def robot_of(model: RobotModel | str | Path, logs: object) -> RobotModel:
    """Return the robot, read if it is given as the path of a URDF."""
    if isinstance(model, RobotModel):
        return with_assumed_inertials(model)
    kind, is_robot = type(model).__name__, isinstance(logs, RobotModel)
    is_path = isinstance(model, str | Path)
    suffixes = [Path(x).suffix.lower() if isinstance(x, str | Path) else "" for x in (model, logs)]
    if is_robot or (suffixes[1] in _ROBOTS and suffixes[0] not in _ROBOTS):
        what = f"the file {Path(str(model)).name}" if is_path else f"a {kind}"
        raise ModelError(
            f"model is {what}, and the robot is given as the logs; expected: the robot first, then "
            "the logs; swap the two"
        )
    if not is_path:
        raise ModelError(f"model is a {kind}, expected a RobotModel or the path of a URDF")
    return with_assumed_inertials(RobotModel.from_urdf(model))


def conclude(
    recordings: Recordings,
    choice: EstimatorSettings,
    doctor_findings: Sequence[Finding] = (),
    ignore: Sequence[str] = (),
    *,
    friction: str | Mapping[str, str] = AUTO,
    progress: ProgressCallback | None = None,
) -> TorqueIdentification:
    """Identify a robot's parameters from recordings, in memory or not, and give a verdict."""
    model, is_robust = recordings.model, choice.is_robust
    wanted = wanted_families(friction, model.joints)
    if model.is_static and any(wanted.values()):
        raise SettingsError(
            "dynamics is 'static', which allows friction 'none' or 'viscous+coulomb' (without "
            "the viscous term), but more is given; remove it, or set dynamics = 'full'"
        )
    report_stage(progress, "fitting")
    try:
        recordings = with_repeated_errors(recordings)
        fit = with_drives(recordings, choice, wanted, progress=progress)
    except (DataError, NotConvergedError, RankDeficientError) as error:
        for f in doctor_findings:
            if f.severity != "note" and f.message != str(error):
                error.add_note(f"doctor: {f.severity}: {f.code}: {f.message}")
        raise
    report_stage(progress, "errors and intervals")
    sample = take_sample(fit)
    units = sorted({log.unit for log in recordings.fitted})
    misfits, discrepancies = explain_residual(fit, sample, is_one_robot=len(units) == 1)
    judged = (f for f in clipped(sample) if f.joints[0] not in model.passive)
    found = {(f.code, f.where) for f in doctor_findings}
    discrepancies += tuple(f for f in judged if (f.code, f.where) not in found)
    fit, on_misfit = with_model_error(fit, sample, misfits)
    names = [Path(e.recording.log.path).name for e in fit.fitted]
    fit = replace(fit, variation=vary(names, fit.runs, units))
    result = TorqueIdentification(
        **{field.name: getattr(fit, field.name) for field in fields(fit)},
        misfits=misfits,
        on_misfit=on_misfit,
        stated=StatedSettings(recordings.fitted[0].asked, friction, tuple(ignore)),
    )
    result = replace(result, scale=check_scale(result))
    of_fit = *fit_findings(fit, misfits, on_misfit, discrepancies), *unlike_findings(fit.variation)
    # notes, and what the doctor says of excitation and logs, are replaced by those of the fit
    replaced = ("excitation", "log_assumption")
    others = [f for f in doctor_findings if f.severity != "note" and f.code not in replaced]
    merged = settled(others, of_fit)
    merged = [finding for finding in merged if not explained_by_assumed(model, finding)]
    merged = explained(rejected(merged, result.predictions, result.scale_check), model, ignore)
    log_errors = blocking(merged, ignore, is_robust=is_robust)
    heads = [log.head for log in (*recordings.fitted, *recordings.validation)]
    assumed = assumed_inertials(model)  # which the doctor finds, too, if it has run
    assumed = [] if any(finding in merged for finding in assumed) else assumed
    findings = [*assumed, *log_findings(heads), *impossible_inertials(model), *merged]
    findings += not_written(log_errors, "" if fit.is_consistent else fit.estimator.name)
    names = [Path(e.recording.log.path).name for e in fit.validation if not e.is_refitted]
    counted = not_ignored(findings, ignore)
    return replace(
        result,
        findings=tuple(findings),
        log_errors=tuple(m for cause in grouped(log_errors) for m in cause.messages),
        warnings=warnings_of(counted, model.joints, names, is_robust=is_robust),
    )


def with_drives(
    recordings: Recordings,
    choice: EstimatorSettings,
    wanted: Mapping[str, Sequence[str] | None],
    *,
    progress: ProgressCallback | None = None,
) -> Fit:
    """Identify a robot's parameters, and the friction terms of its joints from the logs."""
    report, rough = progress or ignore_progress, rough_choice(choice)
    report("fits", 0, 1, "fits")
    solved = solve_recordings(recordings, choice)
    drives = choose_drives(solved.solution, wanted)
    if not any(drive.terms for drive in drives):
        return replace(solved.with_errors(), drives=drives)

    def changed() -> Recordings:
        """Return the recordings with the selected drive terms, under the load of the last fit."""
        solution, layout = solved.solution, recordings.model.layout
        selected = {drive.joint: drive.terms for drive in drives}
        model = recordings.model.with_terms({
            d.name: (*layout.own.get(d.name, ()), *selected.get(d.name, ())) for d in layout.drives
        })  # fmt: skip
        values = dict(zip(solution.mapping.names, solution.standard, strict=True))
        start = np.array([values.get(name, 0.0) for name in model.layout.names])
        levelled = replace(recordings, levels=solved.ground.rough.sigma)
        extended = levelled.with_model(model.with_reference(start))
        return extended if recordings.repeated is None else with_repeated_errors(extended)

    most = _MOST_SHAPES if any(drive.shapes for drive in drives) else 0
    for done in range(most):
        report("fits", 1 + done, 2 + most, "fits")
        solved = solve_recordings(changed(), rough, is_last=False)
        moved = settled_shapes(replace(solved.solution, drives=drives))
        if moved is None:
            break
        drives = moved
    report("fits", 1 + most, 2 + most, "fits")
    return replace(fit_recordings(changed(), choice), drives=drives)
