"""A job from its files to the folder of results; and validation of a result on other logs."""

import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from robotid.data import Log
from robotid.doctor import alarming, diagnose
from robotid.identification import Identification, identify
from robotid.job import Job, LogEntry, job_from_settings
from robotid.metrics import Metrics
from robotid.model import RobotModel
from robotid.report import write_report
from robotid.result import (
    build_result,
    read_result,
    recording_metrics,
    stated_parameters,
    write_json,
)
from robotid.sidecar import load_identified
from robotid.urdf import write_urdf
from robotid.validation import evaluate, prepare
from robotid.verdict import Finding, judge

__all__ = ["run_job", "validate_result"]

_DIFFERS = 1.2  # a consistent fit that misses this much more than WLS is worth a word


def run_job(job: Job, folder: str | Path) -> tuple[Identification, dict[str, Any]]:
    """Run an identification and write result.json, report.html and the URDF with its sidecar.

    Every file is made in a folder of its own first and put in place when all are complete.

    Args:
        job: What to do.
        folder: Where to write; made if it is missing.

    Returns:
        The identification and the content of result.json.

    Raises:
        DataError: If a log cannot be used.
        ModelError: If the URDF cannot be used.
        NotConvergedError: If a solver fails.
        RankDeficientError: If "ols" or "wls" is asked for and the data leave parameters open.
        SettingsError: If a setting does not fit.
    """
    model = job.model()
    logs = [job.read(entry, model) for entry in job.identification]
    kept = [job.read(entry, model) for entry in job.validation]
    findings = [*_locked_findings(job, model), *_log_findings([*logs, *kept])]
    diagnosis = diagnose(model, logs, kept, job.signals)
    alarms = tuple(finding.message for finding in alarming(diagnosis, job.ignore))
    findings += [finding for finding in diagnosis if finding.severity != "note"]
    identification = identify(
        model, logs, validation=kept, signals=job.signals, estimator=job.estimator
    )
    identification = replace(identification, alarms=alarms)
    findings += _fit_findings(identification)
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=".robotid-", dir=target))
    try:
        outputs = {"report": "report.html"}
        if identification.is_consistent:
            name = f"{Path(model.tree.path).stem}.identified.urdf"
            sidecar = write_urdf(
                model, identification.standard, partial / name, dynamics=job.dynamics
            )
            outputs |= {"urdf": name, "sidecar": sidecar.name}
        write_report(identification, partial / "report.html", findings=findings)
        result = build_result(identification, job.to_settings(), findings, outputs)
        write_json(result, partial / "result.json")
        for made in sorted(partial.iterdir()):
            os.replace(made, target / made.name)
    finally:
        shutil.rmtree(partial)
    return identification, result


def validate_result(path: str | Path, logs: Sequence[str | Path]) -> dict[str, Any]:
    """Measure the prediction of a written result on other logs.

    Where the result has a URDF, that file and its sidecar predict; they are what a user ships.

    Args:
        path: A result.json.
        logs: Logs of the same robot.

    Returns:
        {"result", "predicted_with", "validation": [...], "verdict": {...}}, as in result.json.

    Raises:
        DataError: If the result or a log cannot be used.
        ModelError: If the URDF is missing or was changed.
        SettingsError: If the settings in the result are not usable.
    """
    result = read_result(path)
    folder = Path(path).parent
    settings = {key: value for key, value in result["settings"].items() if value != {}}
    job = job_from_settings(settings, Path(path).name, Path())
    source = job.model()
    outputs = result["outputs"]
    if "urdf" in outputs:
        model, pi = load_identified(folder / outputs["urdf"], folder / outputs["sidecar"])
    else:
        model, pi = source, stated_parameters(result, source)
    prior = source.standard_parameters()
    evaluations = []
    for log in logs:
        recording = prepare(model, job.read(LogEntry(Path(log)), model), job.signals)
        evaluations.append(evaluate(model, recording, {"estimate": pi}, prior))
    verdict = judge(
        Metrics({}, 0.0),
        {e.recording.name: e.metrics["estimate"] for e in evaluations},
        undetermined=result["structure"]["undetermined"],
        is_consistent=result["consistency"]["is_consistent"],
    )
    return {
        "result": str(path),
        "predicted_with": outputs.get("urdf", "base parameters of result.json"),
        "validation": [recording_metrics(e, "estimate") for e in evaluations],
        "verdict": {"status": verdict.status, "reasons": list(verdict.reasons)},
    }


def _locked_findings(job: Job, model: RobotModel) -> list[Finding]:
    assumed = [name for name in model.locked if name not in job.locked and job.mimic != "coupled"]
    if not assumed:
        return []
    message = (
        f"the joints {assumed} are neither identified nor locked in the job: they are taken to "
        "stand at 0; state their true positions with locked = { joint = position }"
    )
    return [Finding("locked_at_zero", "warning", ", ".join(assumed), message)]


def _log_findings(logs: Sequence[Log]) -> list[Finding]:
    by_note: dict[str, list[str]] = {}
    for log in logs:
        for note in log.notes:
            by_note.setdefault(note, []).append(Path(log.path).name)
    return [
        Finding("log_note", "note", ", ".join(names), f"{', '.join(names)}: {note}")
        for note, names in by_note.items()
    ]


def _fit_findings(identification: Identification) -> list[Finding]:
    findings = []
    undetermined = identification.estimate.undetermined
    if undetermined:
        message = (
            f"the data say nothing about the base parameters {list(undetermined)}; they keep the "
            "URDF's values. Record a richer trajectory to determine them"
        )
        findings.append(Finding("undetermined", "warning", "base_parameters", message))
    if not identification.is_consistent:
        message = (
            f"the {identification.estimator.name} estimate is not physically consistent, so no "
            "URDF was written; use the 'consistent' estimator for one that loads"
        )
        findings.append(Finding("urdf_not_written", "warning", "urdf", message))
    for evaluation in identification.refitted:
        message = (
            f"the validation log {evaluation.recording.name} holds rows that were fitted: its "
            "score shows the fit, not the prediction; validate on another recording"
        )
        where = evaluation.recording.log.path
        findings.append(Finding("validation_was_fitted", "warning", where, message))
    ours, wls = identification.metrics(), identification.metrics("wls")
    for joint, measured in ours.per_joint.items():
        if measured.rmse > _DIFFERS * wls.per_joint[joint].rmse:
            message = (
                f"{joint}: the residual is {measured.rmse:.3g} {measured.unit} against "
                f"{wls.per_joint[joint].rmse:.3g} of unconstrained WLS: physics and data disagree "
                "there; check the torque scale (gains), the drive model and the payload"
            )
            findings.append(Finding("constraint_costs", "warning", joint, message))
    return findings
