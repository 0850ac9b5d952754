"""A job from its files to the folder of results."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from robotid._files import check_folder, folder_beside, write_json
from robotid._typing import report_stage
from robotid.commands.job import Job
from robotid.commands.logs import checkpoint_inputs, examine_logs, survey_logs
from robotid.exceptions import DataError
from robotid.export.result import build_result
from robotid.export.urdf import write_urdf
from robotid.identification.advice import Origin
from robotid.identification.findings import locked_findings
from robotid.identification.pipeline import Identification, conclude
from robotid.identification.recordings import Recordings
from robotid.identification.verdict import check_ignored
from robotid.regressor.base_parameters import structural_mapping
from robotid.report.document import write_report
from robotid.robot.model import RobotModel
from robotid.workers.checkpoint import Checkpoint
from robotid.workers.plan import WorkPlan

__all__ = ["run_job"]

_log = logging.getLogger(__name__)


def run_job(
    job: Job,
    folder: str | Path,
    *,
    plan: WorkPlan | None = None,
    source: Sequence[str] = (),
    beside: Mapping[str, str] | None = None,
) -> tuple[Identification, dict[str, Any]]:
    """Run an identification and write result.json, report.html and the URDF with its sidecar.

    A job may want no report, and an impossible result has no URDF. Every file is made in a folder
    of its own first and put in place when all are complete.

    Args:
        job: What to do.
        folder: Where to write; made if it is missing.
        plan: Who works on long logs; as the job says, in this process, if None.
        source: What follows ``robotid identify`` to run it again, for the report.
        beside: Further files that the folder will hold, by what they are, for the report.

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
    chosen = plan or WorkPlan(job.workers or 1)
    report_stage(chosen.progress, "reading logs")
    model, target = job.model(), Path(folder)
    name = f"{Path(model.tree.path).stem}.identified.urdf"
    sidecar = str(Path(name).with_suffix(".drive.json"))
    files = ["report.html", name, sidecar]
    check_folder(target, ["result.json", *files])
    identification, checkpoint = _identify(job, model, target, chosen)
    report_stage(chosen.progress, "writing")
    target.mkdir(parents=True, exist_ok=True)
    with folder_beside(target) as partial:
        outputs = {}
        written = {"urdf": name, "sidecar": sidecar} if identification.has_urdf else {}
        if job.report:
            links = {"result": "result.json", **written, **(beside or {})}
            origin = Origin(tuple(source), str(target))
            write_report(identification, partial / "report.html", files=links, origin=origin)
            outputs["report"] = "report.html"
            identification = replace(identification, report=str(target / "report.html"))
        if written:
            write_urdf(
                identification.model, identification.standard, partial / name, dynamics=job.dynamics
            )
            outputs |= written
        result = build_result(identification, job.to_dict(), outputs=outputs)
        write_json(result, partial / "result.json")
    _remove_stale(target / other for other in files if other not in outputs.values())
    if checkpoint is not None:
        checkpoint.remove()
    return identification, result


def _remove_stale(files: Iterable[Path]) -> None:
    """Remove the files that an earlier run left, for they are not of this result."""
    for stale in files:
        if stale.exists():
            _log.warning("%s is of an earlier run and was removed: this one wrote none", stale)
            stale.unlink()


def _identify(
    job: Job, model: RobotModel, folder: Path, plan: WorkPlan
) -> tuple[Identification, Checkpoint | None]:
    """Identify from the job's logs; finished pieces of long ones are kept in the folder."""
    check_ignored(job.ignore)
    fitted, kept = survey_logs(job, model, job.identification, job.validation)
    if not fitted:
        raise DataError("no log was given; at least one is needed to identify anything")
    report_stage(plan.progress, "checking logs")
    stated = model.locked if job.mimic == "coupled" else job.locked
    found = [*locked_findings(model, stated), *examine_logs(job, model, fitted, kept)]
    recordings = Recordings(model, structural_mapping(model), fitted, kept)
    checkpoint = None
    if not recordings.is_held:
        checkpoint = Checkpoint.open(
            folder, checkpoint_inputs(job), recordings.pieces, resume=plan.resume
        )
        recordings = replace(recordings, plan=plan, checkpoint=checkpoint)
    elif plan.is_asked_for:
        _log.warning(
            "the logs have no more than %d rows and are read at once: workers, scheduler and "
            "resume have nothing to do; lower rows_in_memory in [reduction] to cut them",
            job.rows_in_memory,
        )
    with plan:
        concluded = conclude(
            recordings,
            job.estimator,
            found,
            job.ignore,
            friction=job.friction,
            progress=plan.progress,
        )
    return concluded, checkpoint
