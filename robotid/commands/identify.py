"""A job from its files to the folder of results."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from robotid._files import folder_beside, write_json
from robotid.commands.checkpoint_inputs import checkpoint_inputs
from robotid.commands.job import Job
from robotid.commands.logs import examine_locked, is_long, survey_logs
from robotid.doctor.diagnosis import alarming, diagnose
from robotid.doctor.urdf_inertials import impossible_inertials
from robotid.exceptions import DataError, NotConvergedError, RankDeficientError, SettingsError
from robotid.export.result import build_result
from robotid.export.urdf import write_urdf
from robotid.findings import Finding
from robotid.identification.doubts import doubts_of
from robotid.identification.findings import consistency_findings
from robotid.identification.long_recordings import LongRecordings
from robotid.identification.pipeline import Identification, conclude, identify
from robotid.identification.settings import BoundedSettings
from robotid.identification.verdict import Doubt
from robotid.logs.data import Log
from robotid.regressor.base_parameters import structural_mapping
from robotid.report.document import write_report
from robotid.robot.model import RobotModel
from robotid.workers.checkpoint import Checkpoint
from robotid.workers.plan import WorkPlan

__all__ = ["run_job"]

_log = logging.getLogger(__name__)

_NAMED = 5  # outliers that a finding names
_WIDE = 1e-2  # margin of a pseudo-inertia above which it may hold a fit back
_DIFFERS = 1.2  # a consistent fit that misses this much more than WLS is worth a word


def run_job(
    job: Job, folder: str | Path, *, plan: WorkPlan | None = None
) -> tuple[Identification, dict[str, Any]]:
    """Run an identification and write result.json, report.html and the URDF with its sidecar.

    Every file is made in a folder of its own first and put in place when all are complete.

    Args:
        job: What to do.
        folder: Where to write; made if it is missing.
        plan: Who works on long logs; as the job says, in this process, if None.

    Returns:
        The identification and the content of result.json.

    Raises:
        DataError: If a log cannot be used.
        ModelError: If the URDF cannot be used.
        NotConvergedError: If a solver fails.
        RankDeficientError: If "ols" or "wls" is asked for and the data leave parameters open.
        SettingsError: If a setting does not fit.
        WorkerError: If a worker ends before its work.
    """
    model, target = job.model(), Path(folder)
    if target.exists() and not target.is_dir():
        raise SettingsError(
            f"{str(target)!r} is a file, wanted a folder for the results; name another"
        )
    chosen = plan or WorkPlan(job.workers or 1)
    checkpoint: Checkpoint | None = None
    if is_long(job, (*job.identification, *job.validation)):
        identification, findings, checkpoint = _identify_long(job, model, target, chosen)
    else:
        if chosen.is_asked_for:
            _log.warning(
                "the logs have no more than %d rows and are read at once: workers, scheduler and "
                "resume have nothing to do; lower rows_in_memory in [reduction] to cut them",
                job.rows_in_memory,
            )
        identification, findings = _identify(job, model)
    findings += _fit_findings(identification)
    identification = replace(identification, doubts=_doubts(job, identification, findings))
    target.mkdir(parents=True, exist_ok=True)
    with folder_beside(target) as partial:
        outputs = {"report": "report.html"}
        name = f"{Path(model.tree.path).stem}.identified.urdf"
        if identification.is_consistent:
            sidecar = write_urdf(
                model, identification.standard, partial / name, dynamics=job.dynamics
            )
            outputs |= {"urdf": name, "sidecar": sidecar.name}
        write_report(identification, partial / "report.html", findings=findings)
        result = build_result(identification, job.to_dict(), findings, outputs)
        write_json(result, partial / "result.json")
    if "urdf" not in outputs:
        _remove_urdf(target / name)
    identification = replace(identification, report=str(target / outputs["report"]))
    if checkpoint is not None:
        checkpoint.remove()
    return identification, result


def _remove_urdf(urdf: Path) -> None:
    """Remove the URDF and sidecar that an earlier run left, for they are not of this result."""
    for stale in (urdf, urdf.with_suffix(".drive.json")):
        if stale.exists():
            _log.warning("%s is of an earlier run and was removed: this one wrote none", stale)
            stale.unlink()


def _identify(job: Job, model: RobotModel) -> tuple[Identification, list[Finding]]:
    """Identify from logs in memory."""
    logs = [job.read(entry, model) for entry in job.identification]
    kept = [job.read(entry, model) for entry in job.validation]
    held = examine_locked(job, model, [*job.identification, *job.validation])
    diagnosis = (*held, *diagnose(model, logs, kept, job.signals))
    alarms = alarming(diagnosis, job.ignore, is_robust=job.estimator.is_robust)
    with _explained(diagnosis):
        identification = identify(
            model, logs, validation=kept, signals=job.signals, estimator=job.estimator
        )
    return _with_alarms(job, model, identification, [*logs, *kept], diagnosis, alarms)


def _identify_long(
    job: Job, model: RobotModel, folder: Path, plan: WorkPlan
) -> tuple[Identification, list[Finding], Checkpoint]:
    """Identify from logs that are read in pieces; finished ones are kept in the folder."""
    mapping = structural_mapping(model)
    logs = survey_logs(job, job.identification, model, mapping)
    kept = survey_logs(job, job.validation, model, mapping)
    if not logs:
        raise DataError("no log was given; at least one is needed to identify anything")
    fitted_looks, kept_looks = (
        [look for log in some for look in log.looks] for some in (logs, kept)
    )
    diagnosis = diagnose(model, fitted_looks, kept_looks, job.signals)
    alarms = alarming(diagnosis, job.ignore, is_robust=job.estimator.is_robust)
    pieces = [piece for log in logs for piece in log.pieces]
    checkpoint = Checkpoint.open(folder, checkpoint_inputs(job), pieces, resume=plan.resume)
    with plan, _explained(diagnosis):
        recordings = LongRecordings(model, logs, kept, plan, checkpoint)
        identification = conclude(model, recordings, job.estimator)
    heads = [log.head for log in (*logs, *kept)]
    return *_with_alarms(job, model, identification, heads, diagnosis, alarms), checkpoint


@contextmanager
def _explained(diagnosis: Sequence[Finding]) -> Iterator[None]:
    """Add what the doctor found to the error of a fit that fails."""
    try:
        yield
    except (DataError, NotConvergedError, RankDeficientError) as error:
        for finding in diagnosis:
            if finding.severity != "note":
                error.add_note(f"doctor: {finding.severity}: {finding.code}: {finding.message}")
        raise


def _with_alarms(
    job: Job,
    model: RobotModel,
    identification: Identification,
    logs: Sequence[Log],
    diagnosis: Sequence[Finding],
    alarms: Sequence[Finding],
) -> tuple[Identification, list[Finding]]:
    """Return the identification with its alarms, and what is worth a word so far."""
    findings = [*_locked_findings(job, model), *_log_findings(logs)]
    findings += impossible_inertials(model)
    # what the motion excites the fit tells from all rows: finding "undetermined"
    findings += [f for f in diagnosis if f.severity != "note" and f.code != "excitation"]
    messages = tuple(finding.message for finding in alarms)
    return replace(identification, alarms=messages), findings


def _doubts(
    job: Job, identification: Identification, findings: Sequence[Finding]
) -> tuple[Doubt, ...]:
    """Return what makes the result doubtful, but for what the user knows better."""
    kept = [Path(e.recording.log.path).name for e in identification.validation if not e.is_refitted]
    told = [finding for finding in findings if finding.code not in job.ignore]
    is_robust = job.estimator.is_robust
    return doubts_of(told, identification.model.joints, kept, is_robust=is_robust)


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


def _outlier_findings(identification: Identification) -> list[Finding]:
    outliers = identification.outliers
    if not outliers:
        return []
    places = [
        f"{o.joint} at {o.t:.3f} s of {o.log}: {o.torque:.4g} against {o.predicted:.4g} predicted, "
        f"{o.size:.0f} times its usual residual"
        for o in outliers[:_NAMED]
    ]
    more = f"; and {len(outliers) - _NAMED} more" if len(outliers) > _NAMED else ""
    advice = (
        "they were weighted down"
        if identification.estimator.is_robust
        else "look at the recording there, cut it out, or set robust = 'tukey' in [estimator]"
    )
    message = (
        f"{len(outliers)} places of the fitted logs are not explained: {'; '.join(places)}{more}; "
        f"{advice}"
    )
    evidence = {"places": float(len(outliers)), "largest": outliers[0].size}
    return [Finding("outliers", "warning", outliers[0].joint, message, evidence)]


def _asked(identification: Identification) -> str:
    """Return in words what the user asks of the parameters, empty if nothing."""
    settings = identification.estimator
    if not isinstance(settings, BoundedSettings):
        return ""
    asked = {key: value for key, value in settings.constraints.items() if value}
    if settings.margin > _WIDE:
        asked["margin"] = settings.margin
    return f"what [estimator] asks for ({asked}), " if asked else ""


def _fit_findings(identification: Identification) -> list[Finding]:
    findings = []
    known = identification.determination
    if known.groups:
        message = (
            f"the data determine {known.rank} of {len(known.names)} base parameters: "
            f"{known.in_words()}. What they leave open keeps the URDF's values; record a richer "
            "trajectory to determine it"
        )
        findings.append(Finding("undetermined", "warning", "base_parameters", message))
    if not identification.is_consistent:
        message = (
            f"the {identification.estimator.name} estimate is not physically consistent, so no "
            "URDF was written; use the 'consistent' estimator for one that loads"
        )
        findings.append(Finding("urdf_not_written", "warning", "urdf", message))
    findings += consistency_findings(identification)
    findings += _outlier_findings(identification)
    for evaluation in identification.refitted:
        message = (
            f"the validation log {evaluation.recording.name} holds rows that were fitted: its "
            "score shows the fit, not the prediction; validate on another recording"
        )
        where = evaluation.recording.log.path
        findings.append(Finding("validation_was_fitted", "warning", where, message))
    ours, wls = identification.metrics(), identification.metrics("wls")
    asked = _asked(identification)
    for joint, measured in ours.per_joint.items():
        if measured.rmse > _DIFFERS * wls.per_joint[joint].rmse:
            message = (
                f"{joint}: the residual is {measured.rmse:.3g} {measured.unit} against "
                f"{wls.per_joint[joint].rmse:.3g} of unconstrained WLS: physics and data disagree "
                f"there; check {asked}the torque scale (gains), the drive model and the payload"
            )
            evidence = {
                "error_pct": measured.relative_error_pct or 0.0,
                "wls_error_pct": wls.per_joint[joint].relative_error_pct or 0.0,
            }
            findings.append(Finding("constraint_costs", "warning", joint, message, evidence))
    return findings
