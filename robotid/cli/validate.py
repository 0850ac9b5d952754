"""robotid validate: compute a result's prediction error on other logs."""

import argparse
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.files import (
    check_file,
    file_sha256,
    finite,
    log_exists,
    read_json,
    source_entry,
    write_json,
)
from robotid.base.findings import Finding, listed
from robotid.base.text import terminal_width
from robotid.cli.console import echo, print_verdict, show_found
from robotid.cli.flags import add_json
from robotid.cli.job import Job, LogEntry, written_job
from robotid.cli.logs import log_of_commands, survey_logs, units_of_logs
from robotid.data.log import Log
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
from robotid.estimation.fitting.evaluation import (
    Evaluation,
    Metrics,
    evaluate_logs,
    hidden_joints,
    shares_rows,
)
from robotid.estimation.fitting.fit import sums_of_logs
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.fitting.standard_errors import rms_error, torque_band
from robotid.estimation.fitting.survey import SurveyedLog
from robotid.estimation.variation.groups import RunSums, runs_of
from robotid.estimation.variation.variation import vary
from robotid.identification.closed_loop.position_errors import pool_positions
from robotid.identification.repeated_errors import with_repeated_errors
from robotid.identification.summary import error_lines, variation_lines
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

_ADVICE = "identify again from all logs"


def check_update(result: Result, job: Job, entries: Sequence[LogEntry]) -> None:
    """Check that logs can be added to the variation of a result."""
    stated = result.content.get("variation", {})
    if "sums" not in stated:
        raise DataError(
            f"{result.path.name} has no variation to which logs can be added, wanted a result of "
            f"three or more logs with torques; {_ADVICE}"
        )
    known = [x for x in result.content["inputs"] if x["role"] == "identification"]
    of_file = {x["sha256"]: x["path"] for x in (*known, *stated.get("added", ()))}
    for entry in entries:
        own = source_entry(str(entry.path))["sha256"]
        if own in of_file:
            raise DataError(
                f"{entry.path} is {of_file[own]}, which {result.path.name} has already; "
                "leave it out"
            )
        of_file[own] = str(entry.path)
    units_of_logs([*job.identification, *entries])


def add_logs(
    result: Result, model: RobotModel, job: Job, logs: Sequence[SurveyedLog]
) -> tuple[dict[str, Any], tuple[Finding, ...]] | None:
    """Return the variation between the logs of a result and new ones, and findings about these."""
    stated = result.content.get("variation", {})
    if "sums" not in stated:
        return None
    mapping, before = structural_mapping(model), stated["sums"]
    recordings = with_repeated_errors(Recordings(model, mapping, logs))
    pi, old = stated_parameters(result.content, model), RunSums.from_dict(before)
    shift = np.array(before.get("shift", np.zeros(len(mapping.base_names))))
    try:
        if old.sigma.shape != (model.n_rows,) or not (old.sigma > 0).all():
            raise ValueError(f"sigma is {old.sigma}")
        sums = old.joined(sums_of_logs(recordings, job.estimator, pi, old.sigma, shift))
    except ValueError as error:
        raise DataError(
            f"variation.sums in {result.path.name} does not fit the robot ({error}): another "
            f"version of robotid wrote it; {_ADVICE}"
        ) from error
    new_units = [log.unit or any(before["unit"]) * Path(log.path).name for log in logs]
    units = [*before["unit"], *new_units]
    unit_names, unit = np.unique(units, return_inverse=True)
    groups = runs_of(model, mapping, pi, sums, unit)
    names = [*stated["logs"], *(Path(log.path).name for log in logs)]
    varied = vary(names, groups, unit_names.tolist())
    assert varied is not None
    count = len(stated["logs"])
    unlike = replace(
        varied,
        unlike=tuple(each for each in varied.unlike if each.run >= count),
        unlike_units=tuple(each for each in varied.unlike_units if each.run in unit[count:]),
    )
    added = [source_entry(log.path) for log in logs]
    content = varied.to_dict() | {
        "sums": sums.to_dict() | {key: before[key] for key in ("shift",) if key in before}
        | {"unit": units},
        "added": [*stated.get("added", ()), *added],
    }  # fmt: skip
    return content, tuple(unlike_findings(unlike))


def validate(
    result: str | Path, logs: Sequence[LogEntry | str | Path], *, update: bool = False
) -> dict[str, Any]:
    """Compute the prediction error of a written result on other logs.

    If the result has a URDF, the prediction uses that file and its sidecar, as a user does. The
    doctor examines the logs. Logs that contain fitted rows do not count as validation. If three or
    more logs were fitted, the drives in the new logs are compared with those in the fitted ones.

    Args:
        result: A result.json or its folder.
        logs: Files of logs, read with the settings of the result.
        update: Whether the logs are added to the variation between logs in the result.json.

    Returns:
        The errors of each log and the verdict, as ``robotid validate --json``.

    Raises:
        DataError: If a log cannot be used.
        SettingsError: If the result cannot be updated.
    """
    loaded = load_result(result)
    content, job = loaded.content, written_job(loaded.content["settings"], loaded.path.name)
    entries = [log if isinstance(log, LogEntry) else LogEntry(Path(log)) for log in logs]
    if update:
        check_file(loaded.path)
        check_update(loaded, job, entries)
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
    own = [log.with_model(source) for log in surveyed]
    variation, unlike = add_logs(loaded, source, job, own) or ({}, ())
    verdict = _verdict(job, source, content, evaluations, surveyed, unlike)
    if update:
        stored = read_json(loaded.path, "result")  # with the keys as they are in the file
        write_json({**stored, "variation": variation}, loaded.path)
    shown = {key: x for key, x in variation.items() if key != "sums"}
    return {
        "result": str(result),
        "predicted_with": content["outputs"].get("urdf", "base parameters of result.json"),
        "validation": [e.to_dict() | _expected(content, model, e) for e in evaluations],
        "verdict": verdict.to_dict(),
        **({"variation": shown} if shown else {}),
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
        {e.recording.name: e.metrics["estimate"] for e in compress(evaluations, is_new)},
        tuple(joint for joint in model.joints if joint not in model.passive),
        refitted=[e.recording.name for e in compress(evaluations, again)],
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


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add("result", metavar="RESULT.json")
    add("logs", nargs="+", metavar="LOG")
    words = "name of the robot of the logs, if the fitted logs are of several"
    add("--unit", metavar="NAME", help=words)
    words = "add the logs to the variation between logs in RESULT.json"
    add("--update", action="store_true", help=words)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    entries = [_entry(log, options) for log in options.logs]
    found = validate(options.result, entries, update=options.update)
    show_found(found, options, partial(_show, is_update=options.update))


def _entry(log: str, options: argparse.Namespace) -> "LogEntry":
    """Return a log with its robot, checked as in a job file."""
    unit = {} if options.unit is None else {"unit": options.unit}
    return LogEntry.from_dict({"log": log, **unit})


def _show(found: dict[str, Any], *, is_update: bool = False) -> None:

    echo(f"predicted with {found['predicted_with']}")
    for recording in found["validation"]:
        echo(f"\n{recording['name']}", "  ")
        print("\n".join(error_lines(recording, width=terminal_width())))
        expected = recording.get("expected", {})
        if expected:
            source = "fit, for logs of the same day"
            if expected["with_spread"]:
                source = "fit and spread between logs"
            own = [
                f"{joint} {each['rmse']:.3g} ({each['within_95_pct']:.0f} %)"
                for joint, each in expected["per_joint"].items()
                if each["within_95_pct"] is not None
            ]
            echo(
                f"expected rmse by the {source} (share of rows within 95 %): {', '.join(own)}", "  "
            )
    for finding in found.get("findings", ()):
        echo(f"\n{finding['message']}")
    print_verdict(found["verdict"])
    if is_update:
        echo(f"the variation between logs in {found['result']} counts these logs now:")
        for line in variation_lines(found["variation"]):
            echo(line, "  ")
