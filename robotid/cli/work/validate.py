"""Validation of a written result on other logs, with a verdict."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.files import check_file, file_sha256, finite, log_exists
from robotid.base.findings import Finding, listed
from robotid.cli.work.added_logs import add_logs, check_update
from robotid.cli.work.job import Job, LogEntry, job_from_settings
from robotid.cli.work.logs import log_of_commands, survey_logs
from robotid.data.log import Log
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.diagnosis.verdict.evidence import Determined, Predictions
from robotid.diagnosis.verdict.position_verdict import judge_positions
from robotid.diagnosis.verdict.verdict import Verdict, VerdictWarning, blocking, judge, warnings_of
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.bands import rms_error, torque_band
from robotid.estimation.fitting.evaluation import (
    Evaluation,
    evaluate_logs,
    hidden_joints,
    shares_rows,
)
from robotid.estimation.fitting.metrics import Metrics
from robotid.estimation.fitting.survey import SurveyedLog
from robotid.identification.closed_loop.position_errors import pool_positions
from robotid.output.files.result_file import (
    Result,
    load_result,
    stated_between,
    stated_covariance,
    stated_model,
    stated_parameters,
    stated_scale_check,
    stated_urdf_with_drives,
)
from robotid.robot.model import RobotModel


def validate_result(
    path: str | Path, logs: Sequence[LogEntry | str | Path], *, update: bool = False
) -> dict[str, Any]:
    """Compute the prediction error of a written result on other logs.

    If the result has a URDF, the prediction uses that file and its sidecar, as a user does. The
    doctor examines the logs. Logs that contain fitted rows do not count as validation. If three or
    more logs were fitted, the drives in the new logs are compared with those in the fitted ones.
    """
    loaded = load_result(path)
    result = loaded.content
    settings = {key: value for key, value in result["settings"].items() if value != {}}
    job = job_from_settings(settings, Path(path).name, Path())
    entries = [log if isinstance(log, LogEntry) else LogEntry(Path(log)) for log in logs]
    if update:
        check_file(loaded.path)
        check_update(loaded, job, entries)
    if "simulation" in result:
        return _validate_commands(loaded, job, entries)
    source = stated_model(result, job.model())
    if loaded.has_urdf:
        model, pi = loaded.identified
        model = replace(model, constraints=source.constraints)  # the URDF does not state them
    else:
        model, pi = source, stated_parameters(result, source)
    prior = source.standard_parameters()
    (surveyed,) = survey_logs(job, model, entries)
    driven = stated_urdf_with_drives(result, source)
    _, evaluations = evaluate_logs((), surveyed, {"estimate": pi}, prior, driven)
    own = [log.with_model(source) for log in surveyed]
    added = add_logs(loaded, source, job, own)
    unlike = () if added is None else added.findings
    verdict = _verdict(job, source, result, evaluations, surveyed, unlike)
    if update and added is not None:
        added.write(loaded)
    return {
        "result": str(path),
        "predicted_with": result["outputs"].get("urdf", "base parameters of result.json"),
        "validation": [e.to_dict() | _expected(result, model, e) for e in evaluations],
        "verdict": verdict.to_dict(),
        **({} if added is None else {"variation": added.shown}),
        "findings": [asdict(finding) for finding in unlike],
    }


def _expected(
    result: Mapping[str, Any], model: RobotModel, evaluation: Evaluation
) -> dict[str, Any]:
    """Return the expected torque error of a log by the result, and how often it is within 95 %.

    The error has the uncertainty of the parameters, the spread of the drives between logs, if three
    or more were fitted, and the residual of the fit.
    """
    covariance = stated_covariance(result, model.layout.names)
    if covariance is None:
        return {}
    between = stated_between(result, model)
    of_fit = result["identification"]["per_joint"]
    noise = np.array([of_fit.get(row, {}).get("rmse") or 0.0 for row in model.row_names])
    recording, mapping = evaluation.recording, structural_mapping(model)
    C = covariance if between is None else covariance + between
    motion = recording.trajectory
    band = torque_band(model, mapping, motion, mapping.K @ C @ mapping.K.T, noise)
    inside = band.coverage(motion.tau, evaluation.torques["estimate"], recording.mask)
    rows = zip(model.row_names, rms_error([band]), inside, strict=True)
    return {
        "expected": {
            "with_spread": between is not None,
            "per_joint": {
                row: {"rmse": float(error), "within_95_pct": finite(100.0 * share)}
                for row, error, share in rows
                if row in of_fit
            },
        }
    }


def _validate_commands(loaded: Result, job: Job, entries: Sequence[LogEntry]) -> dict[str, Any]:
    """Compute the simulated position errors of a result on other logs of commands."""
    model = loaded.robot
    logs = [log_of_commands(job, entry, loaded) for entry in entries]
    runs = [loaded.open_loop(log) for log in logs]
    hashes = {i["sha256"] for i in loaded.content["inputs"] if i["role"] == "identification"}
    is_validation = not any(file_sha256(entry.path) in hashes for entry in entries)
    log_errors = blocking(diagnose(model, (), logs, job.signals), job.ignore)
    verdict = judge_positions(
        pool_positions(runs, moving=True),
        model.joints,
        is_validation=is_validation,
        log_errors=[finding.message for finding in log_errors],
    )
    return {
        "result": str(loaded.path),
        "predicted_with": loaded.content["outputs"]["urdf"],
        "validation": [run.to_dict() for run in runs],
        "verdict": verdict.to_dict(),
    }


def _fitted_logs(
    job: Job, model: RobotModel, hashes: Collection[str]
) -> tuple[list[Log], list[str]]:
    """Return the fitted logs, windows of long ones, and the names of missing ones."""
    exists = [log_exists(e.path) and file_sha256(e.path) in hashes for e in job.identification]
    missing = [
        e.path.name for e, found in zip(job.identification, exists, strict=True) if not found
    ]
    (surveyed,) = survey_logs(job, model, list(compress(job.identification, exists)))
    return [look for log in surveyed for look in log.looks], missing


def _verdict(
    job: Job,
    model: RobotModel,
    result: Mapping[str, Any],
    evaluations: Sequence[Evaluation],
    logs: Sequence[SurveyedLog],
    unlike: Sequence[Finding],
) -> Verdict:
    """Return the verdict on logs, which may be fitted, faulty, unlike, or of a fitted motion."""
    hashes = {i["sha256"] for i in result["inputs"] if i["role"] == "identification"}
    fitted, missing = _fitted_logs(job, model, hashes)
    again = [
        file_sha256(log.path) in hashes or any(_share(a, b) for a in log.looks for b in fitted)
        for log in logs
    ]
    is_new = [not is_refitted for is_refitted in again]
    looks = [look for log in compress(logs, is_new) for look in log.looks]
    names = list(dict.fromkeys(Path(log.path).name for log in looks))
    found = [
        finding
        for finding in diagnose(model, fitted, looks, job.signals)
        if finding.where.split(": ")[0] in names and finding.code not in job.ignore
    ]
    found += [each for each in unlike if each.code not in job.ignore]
    log_errors = blocking(found, job.ignore, is_robust=job.estimator.is_robust)
    stated = result["verdict"]
    predictions = Predictions(
        Metrics({}, 0.0),
        {e.name: e.metrics["estimate"] for e in compress(evaluations, is_new)},
        tuple(joint for joint in model.joints if joint not in model.passive),
        refitted=[e.name for e in compress(evaluations, again)],
        hidden=hidden_joints(model, evaluations),
    )
    determined = Determined(
        result["structure"]["undetermined"],
        result["consistency"]["is_consistent"],
        result["structure"].get("poorly_excited", True),
        model.is_static,
    )
    return judge(
        predictions,
        determined,
        log_errors=list(
            dict.fromkeys([*stated.get("log_errors", ()), *(f.message for f in log_errors)])
        ),
        warnings=list(dict.fromkeys(_warnings(job, model, stated, found, names, missing))),
        scale_check=stated_scale_check(result),
    )


def _warnings(
    job: Job,
    model: RobotModel,
    stated: Mapping[str, Any],
    found: Sequence[Finding],
    names: Sequence[str],
    missing: Sequence[str],
) -> list[VerdictWarning]:
    """Return the warnings of the result, without those of its validation, and of the new logs."""
    own = [VerdictWarning(**warning) for warning in stated.get("warnings", ())]
    is_robust = job.estimator.is_robust
    warnings = [warning for warning in own if warning.code != "repeated_motion"]
    warnings += warnings_of(found, model.joints, names, is_robust=is_robust)
    if missing:
        message = (
            f"the fitted logs {listed(missing)} are missing or were changed: rows of these "
            "recordings were not compared with fitted rows"
        )
        warnings.append(VerdictWarning("fitted_logs_missing", "", message))
    return warnings


def _share(one: Log, other: Log) -> bool:
    """Return whether one of two logs contains rows of the other, as a cut or thinned copy."""
    return shares_rows(one, other) or shares_rows(other, one)
