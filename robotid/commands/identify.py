"""A job from its files to the folder of results."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from robotid._files import folder_beside, write_json
from robotid.commands.job import Job
from robotid.commands.logs import checkpoint_inputs, examine_logs, survey_logs
from robotid.doctor.diagnosis import alarming
from robotid.doctor.urdf_inertials import impossible_inertials
from robotid.exceptions import DataError, NotConvergedError, RankDeficientError, SettingsError
from robotid.export.result import build_result
from robotid.export.urdf import write_urdf
from robotid.findings import Finding
from robotid.identification.findings import fit_findings, locked_findings, log_findings
from robotid.identification.misfit import settled
from robotid.identification.pipeline import Identification, conclude
from robotid.identification.recordings import Recordings
from robotid.identification.verdict import doubts_of
from robotid.regressor.base_parameters import structural_mapping
from robotid.report.document import write_report
from robotid.robot.model import RobotModel
from robotid.workers.checkpoint import Checkpoint
from robotid.workers.plan import WorkPlan

__all__ = ["run_job"]

_log = logging.getLogger(__name__)


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
    identification, findings, checkpoint = _identify(job, model, target, plan)
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


def _identify(
    job: Job, model: RobotModel, folder: Path, plan: WorkPlan | None
) -> tuple[Identification, list[Finding], Checkpoint | None]:
    """Identify from the job's logs; finished pieces of long ones are kept in the folder."""
    fitted, kept = survey_logs(job, model, job.identification, job.validation)
    if not fitted:
        raise DataError("no log was given; at least one is needed to identify anything")
    diagnosis = examine_logs(job, model, fitted, kept)
    is_robust = job.estimator.is_robust
    alarms = alarming(diagnosis, job.ignore, is_robust=is_robust)
    recordings = Recordings(model, structural_mapping(model), fitted, kept)
    chosen, checkpoint = plan or WorkPlan(job.workers or 1), None
    if not recordings.is_held:
        checkpoint = Checkpoint.open(
            folder, checkpoint_inputs(job), recordings.pieces, resume=chosen.resume
        )
        recordings = replace(recordings, plan=chosen, checkpoint=checkpoint)
    elif chosen.is_asked_for:
        _log.warning(
            "the logs have no more than %d rows and are read at once: workers, scheduler and "
            "resume have nothing to do; lower rows_in_memory in [reduction] to cut them",
            job.rows_in_memory,
        )
    with chosen, _explained(diagnosis):
        identification = conclude(recordings, job.estimator)
    stated = model.locked if job.mimic == "coupled" else job.locked
    findings = locked_findings(model, stated)
    findings += log_findings([log.head for log in (*fitted, *kept)])
    findings += impossible_inertials(model)
    # what the motion excites the fit tells from all rows: finding "undetermined"
    told = [f for f in diagnosis if f.severity != "note" and f.code != "excitation"]
    findings += settled(told, fit_findings(identification))
    counted = [finding for finding in findings if finding.code not in job.ignore]
    names = [
        Path(e.recording.log.path).name for e in identification.validation if not e.is_refitted
    ]
    doubts = doubts_of(counted, model.joints, names, is_robust=is_robust)
    messages = tuple(finding.message for finding in alarms)
    return replace(identification, alarms=messages, doubts=doubts), findings, checkpoint


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
