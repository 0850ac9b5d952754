"""robotid validate: compute a result's prediction error on other logs."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.files import file_sha256, finite, log_exists, source_entry
from robotid.base.findings import Finding, listed
from robotid.base.text import terminal_width
from robotid.cli.console import echo, print_verdict, show_found
from robotid.cli.job import Job, LogEntry, add_shown, written_job
from robotid.cli.logs import fitted_hashes, log_of_commands, survey_logs
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.diagnosis.verdict.fit_findings import unlike_findings
from robotid.diagnosis.verdict.verdict import (
    Determined,
    Predictions,
    Verdict,
    VerdictWarning,
    blocking,
    judge,
    judge_positions,
    warnings_of,
)
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.evaluation import (
    Evaluation,
    Metrics,
    evaluate_logs,
    hidden_joints,
    shares_rows,
)
from robotid.estimation.fitting.fit import pinned_joints, sums_of_logs
from robotid.estimation.fitting.recorded import Recordings, SurveyedLog
from robotid.estimation.fitting.standard_errors import rms_error, torque_band
from robotid.estimation.variation.groups import RunSums, runs_of
from robotid.estimation.variation.variation import vary
from robotid.identification.closed_loop.position_errors import pool_positions
from robotid.identification.repeated_errors import with_repeated_errors
from robotid.identification.summary import error_lines
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


def compare_runs(
    result: Result, model: RobotModel, logs: Sequence[SurveyedLog], estimator: EstimatorSettings
) -> tuple[dict[str, Any], tuple[Finding, ...]]:
    """Return the variation between the logs of a result and new ones, and findings about these."""
    stated = result.content.get("variation", {})
    if "sums" not in stated:
        return {}, ()
    mapping, before = structural_mapping(model), stated["sums"]
    recordings = with_repeated_errors(Recordings(model, mapping, logs))
    pi, old = stated_parameters(result.content, model), RunSums.from_dict(before)
    shift = np.array(before.get("shift", np.zeros(len(mapping.base_names))))
    try:
        if old.sigma.shape != (model.n_rows,) or not (old.sigma > 0).all():
            raise ValueError(f"sigma is {old.sigma}")
        sums = old.joined(sums_of_logs(recordings, estimator, pi, old.sigma, shift))
    except ValueError as error:
        raise DataError(
            f"variation.sums in {result.path.name} does not fit the robot ({error}): another "
            "version of robotid wrote it; identify again from all logs"
        ) from error
    names, count = [Path(log.path).name for log in logs], len(stated["logs"])
    units = [log.unit or any(before["unit"]) * name for log, name in zip(logs, names, strict=True)]
    unit_names, unit = np.unique([*before["unit"], *units], return_inverse=True)
    groups = runs_of(model, mapping, pi, sums, unit)
    varied = vary([*stated["logs"], *names], groups, unit_names.tolist())
    assert varied is not None
    unlike = tuple(run for run in varied.unlike if run.run >= count)
    unlike_units = tuple(run for run in varied.unlike_units if run.run in unit[count:])
    findings = unlike_findings(replace(varied, unlike=unlike, unlike_units=unlike_units))
    added = [source_entry(log.path) for log in logs]
    return varied.to_dict() | {"added": added}, tuple(findings)


def validate(result: str | Path, logs: Sequence[LogEntry | str | Path]) -> dict[str, Any]:
    """Compute the prediction error of a written result on other logs.

    If the result has a URDF, the prediction uses that file and its sidecar, as a user does. The
    doctor examines the logs. Logs that contain fitted rows do not count as validation. If three or
    more logs were fitted, the drives in the new logs are compared with those in the fitted ones.

    Args:
        result: A result.json or its folder.
        logs: Files of logs, read with the settings of the result.

    Returns:
        The errors of each log and the verdict, as ``robotid validate --json``.

    Raises:
        DataError: If a log cannot be used.
    """
    loaded = load_result(result)
    content, job = loaded.content, written_job(loaded.content["settings"], loaded.path.name)
    entries = [log if isinstance(log, LogEntry) else LogEntry(Path(log)) for log in logs]
    if "simulation" in content:
        return _validate_commands(loaded, job, entries)
    source = stated_model(content, job.model())
    if loaded.has_urdf:
        model, pi = loaded.identified
        model = replace(model, constraints=source.constraints)  # the URDF does not state them
    else:
        model, pi = source, stated_parameters(content, source)
    prior = source.standard_parameters()
    (surveyed,) = survey_logs(job, model, entries)
    driven = stated_urdf_with_drives(content, source)
    _, evaluations = evaluate_logs((), surveyed, {"estimate": pi}, prior, driven)
    runs = [log.with_model(source) for log in surveyed]
    variation, unlike = compare_runs(loaded, source, runs, job.estimator)
    verdict = _verdict(job, source, content, evaluations, surveyed, unlike)
    return {
        "result": str(result),
        "predicted_with": content["outputs"].get("urdf", "base parameters of result.json"),
        "validation": [e.to_dict() | _expected(content, model, e) for e in evaluations],
        "verdict": verdict.to_dict(),
        **({"variation": variation} if variation else {}),
        "findings": [asdict(finding) for finding in unlike],
    }


def _expected(
    result: Mapping[str, Any], model: RobotModel, evaluation: Evaluation
) -> dict[str, Any]:
    """Return the expected torque error of a log by the result, and how often it is within 95 %."""
    covariance = stated_covariance(result, model.layout.names)
    if covariance is None:
        return {}
    between = stated_between(result, model)
    of_fit = result["identification"]["per_joint"]
    noise = np.array([of_fit.get(row, {}).get("rmse") or 0.0 for row in model.row_names])
    recording, mapping = evaluation.recording, structural_mapping(model)
    C = covariance if between is None else covariance + between
    band = torque_band(model, mapping, recording.trajectory, mapping.K @ C @ mapping.K.T, noise)
    inside = band.coverage(recording.trajectory.tau, evaluation.torques["estimate"], recording.mask)
    per_joint = {
        row: {"rmse": float(error), "within_95_pct": finite(100.0 * share)}
        for row, error, share in zip(model.row_names, rms_error([band]), inside, strict=True)
        if row in of_fit
    }
    return {"expected": {"with_spread": between is not None, "per_joint": per_joint}}


def _validate_commands(loaded: Result, job: Job, entries: Sequence[LogEntry]) -> dict[str, Any]:
    """Compute the simulated position errors of a result on other logs of commands."""
    model = loaded.robot
    logs = [log_of_commands(job, entry, loaded) for entry in entries]
    runs = [loaded.open_loop(log) for log in logs]
    hashes = fitted_hashes(loaded.content)
    log_errors = blocking(diagnose(model, (), logs, job.signals), job.ignore)
    verdict = judge_positions(
        pool_positions(runs, moving=True), model.joints,
        is_validation=not any(file_sha256(entry.path) in hashes for entry in entries),
        log_errors=[finding.message for finding in log_errors],
    )  # fmt: skip
    return {
        "result": str(loaded.path),
        "predicted_with": loaded.content["outputs"]["urdf"],
        "validation": [run.to_dict() for run in runs],
        "verdict": verdict.to_dict(),
    }


def _verdict(
    job: Job, model: RobotModel, result: Mapping[str, Any], evaluations: Sequence[Evaluation],
    logs: Sequence[SurveyedLog], unlike: Sequence[Finding],
) -> Verdict:  # fmt: skip
    """Return the verdict on logs, which may be fitted, faulty, unlike, or of a fitted motion."""
    hashes, is_robust = fitted_hashes(result), job.estimator.is_robust
    is_there = [log_exists(e.path) and file_sha256(e.path) in hashes for e in job.identification]
    (surveyed,) = survey_logs(job, model, list(compress(job.identification, is_there)))
    fitted = [look for log in surveyed for look in log.looks]
    is_new = [  # whether a log is neither a fitted one nor a cut or thinned copy
        file_sha256(log.path) not in hashes
        and not any(shares_rows(a, b) or shares_rows(b, a) for a in log.looks for b in fitted)
        for log in logs
    ]
    looks = [look for log in compress(logs, is_new) for look in log.looks]
    names = list(dict.fromkeys(Path(log.path).name for log in looks))
    of_doctor = diagnose(model, fitted, looks, job.signals)
    findings = [*(x for x in of_doctor if x.where.split(": ")[0] in names), *unlike]
    findings = [finding for finding in findings if finding.code not in job.ignore]
    log_errors = [x.message for x in blocking(findings, job.ignore, is_robust=is_robust)]
    stated, structure = result["verdict"], result["structure"]
    warnings = [VerdictWarning(**warning) for warning in stated.get("warnings", ())]
    warnings = [warning for warning in warnings if warning.code != "repeated_motion"]
    warnings += warnings_of(findings, model.joints, names, is_robust=is_robust)
    if not all(is_there):
        missing = [e.path.name for e in compress(job.identification, np.logical_not(is_there))]
        message = (
            f"the fitted logs {listed(missing)} are missing or were changed: rows of these "
            "recordings were not compared with fitted rows"
        )
        warnings.append(VerdictWarning("fitted_logs_missing", "", message))
    new = {e.recording.name: e.metrics["estimate"] for e in compress(evaluations, is_new)}
    driven = tuple(x for x in model.joints if x not in model.passive)
    return judge(
        Predictions(
            Metrics.from_dict(result["identification"]), new,
            driven if any(log.head.has_torque for log in logs) else (),
            refitted=[e.recording.name for e in compress(evaluations, np.logical_not(is_new))],
            hidden=hidden_joints(model, evaluations),
            pinned=pinned_joints(job.estimator.bounds, model),
        ),
        Determined(
            structure["undetermined"], result["consistency"]["is_consistent"],
            structure.get("poorly_excited", True), model.is_static,
        ),
        log_errors=list(dict.fromkeys([*stated.get("log_errors", ()), *log_errors])),
        warnings=list(dict.fromkeys(warnings)),
        scale_check=stated_scale_check(result),
    )  # fmt: skip


def add_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("result", metavar="RESULT.json")
    add("logs", nargs="+", metavar="LOG")
    words = "name of the robot of the logs, if the fitted logs are of several"
    add("--unit", metavar="NAME", help=words)
    add_shown(parser, "json")


def run(options: argparse.Namespace) -> None:
    unit = {} if options.unit is None else {"unit": options.unit}
    entries = [LogEntry.from_dict({"log": log, **unit}) for log in options.logs]
    show_found(validate(options.result, entries), options, _show)


def _show(content: dict[str, Any]) -> None:
    echo(f"predicted with {content['predicted_with']}")
    for recording in content["validation"]:
        echo(f"\n{recording['name']}", "  ")
        print("\n".join(error_lines(recording, width=terminal_width())))
        if expected := recording.get("expected"):
            has_spread = expected["with_spread"]
            source = " and spread between logs" if has_spread else ", for logs of the same day"
            figures = ", ".join(
                f"{joint} {error['rmse']:.3g} ({error['within_95_pct']:.0f} %)"
                for joint, error in expected["per_joint"].items()
                if error["within_95_pct"] is not None
            )
            echo(f"expected rmse [N m or N] by the fit{source} (rows within 95 %): {figures}", "  ")
    for finding in content.get("findings", ()):
        echo(f"\n{finding['message']}")
    print_verdict(content["verdict"])
