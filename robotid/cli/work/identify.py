"""A job: from its files to the folder of results."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid.base.arguments import checked
from robotid.base.exceptions import DataError
from robotid.base.files import check_folder, folder_beside, remove_written, write_json
from robotid.base.settings import require_kind
from robotid.base.typing import STAGES, ProgressCallback, ignore_progress, report_stage
from robotid.cli.work.job import Job, LogEntry
from robotid.cli.work.logs import (
    examine_logs,
    locked_as_logged,
    needed_of,
    survey_logs,
    units_of_logs,
)
from robotid.cli.work.payload import check_payloads
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.diagnosis.verdict.fit_findings import locked_findings
from robotid.diagnosis.verdict.verdict import check_ignored
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.friction_projection import project_friction
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.estimation.fitting.evaluation import Evaluated
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.workers.plan import WorkPlan
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.pipeline import conclude
from robotid.identification.result import Identification, TorqueIdentification
from robotid.output.files.entries import build_result
from robotid.output.files.urdf import DYNAMICS_TERMS, write_urdf
from robotid.output.report.document import write_report
from robotid.output.report.steps import Origin
from robotid.robot.drives import DriveTerm
from robotid.robot.families import AUTO, wanted_families
from robotid.robot.model import RobotModel
from robotid.robot.tree import read_tree

if TYPE_CHECKING:
    from robotid.output.viewer.replays import Replay

_log = logging.getLogger(__name__)


def run_job(
    job: Job,
    folder: str | Path,
    *,
    plan: WorkPlan | None = None,
    source: Sequence[str] = (),
) -> tuple[Identification, dict[str, Any]]:
    """Run an identification and write result.json, report.html and the URDF with its sidecar.

    The settings may exclude the report and add replay.html; an impossible result has no URDF. All
    files are first written to a temporary folder and moved when they are complete.

    Args:
        job: The job.
        folder: Folder of the results; created if it is missing.
        plan: Workers for long logs; if None those of the job, in this process.
        source: The words after ``robotid identify`` that repeat the run, for the report.

    Returns:
        The identification and the content of result.json.

    Raises:
        DataError: If a log cannot be used.
        MissingDependencyError: If the estimator is "simulation" and Numba is not installed.
        ModelError: If the URDF is not usable.
        NotConvergedError: If a solver fails, or the closed loop cannot be simulated.
        RankDeficientError: If the estimator is "ols" or "wls" and the data do not determine all
            base parameters.
        SettingsError: If a setting is not usable.
        WorkerError: If a worker ends before its work is done.
    """
    require_kind(job, Job, "job", "a Job, as robotid.read_job returns it")
    require_kind(folder, (str, Path), "folder", "the path of a folder")
    chosen = plan or WorkPlan(job.workers or 1)
    stages = _loop_stages() if isinstance(job.estimator, SimulationSettings) else STAGES
    report_stage(chosen.progress, "reading logs", stages)
    model, target = job.model(), Path(folder)
    check_folder(target, ["result.json", *_names(model)])
    found = identify_job(job, model, chosen)
    report_stage(chosen.progress, "writing", stages)
    return _write(found, _job_of(found), target, source=source)


@checked("identification")
def save_result(
    identification: Identification,
    folder: str | Path,
    *,
    report: bool = True,
    replay: bool = False,
) -> Path:
    """Write the files of ``robotid identify``: result.json, report, URDF with its sidecar.

    ``robotid.load_result(folder)``, ``robotid validate`` and ``robotid replay`` read them. All
    files are first written to a temporary folder and moved when they are complete. An impossible
    result has no URDF. Logs in files are listed with their hashes. Gains, units and column names
    with which the logs were read in Python are not recorded.

    Args:
        identification: The identification.
        folder: Folder of the results; created if it is missing.
        report: Whether report.html is written.
        replay: Whether replay.html is written: the first validation log, or the first fitted log.

    Returns:
        Path of the result.json.

    Raises:
        DataError: If a replay is wanted of position-controlled drives whose logs are in memory.
        ModelError: If the URDF of the robot no longer exists.
        SettingsError: If the folder is a file, or is not writable.
    """
    require_kind(folder, (str, Path), "folder", "the path of a folder")
    require_kind(report, bool, "report", "True or False")
    require_kind(replay, bool, "replay", "True or False")
    target = Path(folder)
    check_folder(target, ["result.json", *_names(identification.model)])
    job = replace(_job_of(identification), report=report, replay=replay)
    _write(identification, job, target)
    return target / "result.json"


def _names(model: RobotModel) -> tuple[str, str, str, str]:
    """Return the names of report, replay, URDF and sidecar."""
    name = f"{Path(model.tree.path).stem}.identified.urdf"
    return "report.html", "replay.html", name, str(Path(name).with_suffix(".drive.json"))


def _write(
    found: Identification,
    job: Job,
    target: Path,
    *,
    source: Sequence[str] = (),
) -> tuple[Identification, dict[str, Any]]:
    """Write all files of a result; return the identification with its report, and result.json."""
    names = report, replay, name, sidecar = _names(found.model)
    target.mkdir(parents=True, exist_ok=True)
    with folder_beside(target) as partial:
        outputs = {}
        played = {"replay": replay} if job.replay else {}
        written = {"urdf": name, "sidecar": sidecar} if found.has_urdf else {}
        if job.report:
            found = replace(found, report=str(target / report))
            links = {"result": "result.json", **written, **played}
            origin = Origin(tuple(source), str(target), replay)
            write_report(found, partial / report, files=links, origin=origin)
            outputs["report"] = report
        if written:
            model, pi = found.model, found.standard
            moments = found.moments if job.dynamics else {}
            dynamics = job.dynamics and project_friction(model, pi, moments, DYNAMICS_TERMS)
            write_urdf(model, pi, partial / name, dynamics=dynamics)
            outputs |= written
        outputs |= played
        result = build_result(found, job.to_dict(), outputs=outputs)
        write_json(result, partial / "result.json")
        if job.replay:
            _replay_of(found, job, partial).write(partial / replay)
    others = {*names} - set(outputs.values())
    remove_written(target / other for other in sorted(others))
    return found, result


def _replay_of(found: Identification, job: Job, folder: Path) -> "Replay":
    """Return the replay of a result that is written in a folder; its modules are imported here."""
    from robotid.cli.work.replay import read_findings, replay_files, replay_identified, stated_job

    if isinstance(found, TorqueIdentification):
        return replay_identified(found)
    entries = (*job.validation, *job.identification)
    if not entries:
        raise DataError(
            "the logs are in memory, and a replay of position-controlled drives reads them from "
            "their files; write the logs with robotid.write_log and identify from these files"
        )
    findings = read_findings([folder])
    stated = stated_job(findings, job.urdf, entries[0].path)
    return replay_files(replace(stated, identification=entries[:1]), findings)


def _job_of(identification: Identification) -> Job:
    """Return the job of an identification; one made in Python gets an equivalent job.

    Logs in memory have no file, and a ``Log`` has no gains, units or names of columns.
    """
    model, asked = identification.model, identification.stated
    if isinstance(asked.job, Job):
        return asked.job
    chosen, loop = {}, LoopSettings()
    if isinstance(identification, TorqueIdentification):
        chosen = {drive.joint: drive for drive in identification.drives}
    else:
        loop = getattr(identification, "loop", loop)
    wanted = wanted_families(asked.friction, model.joints)
    is_auto = all(names is None for names in wanted.values())
    drives: dict[str, tuple[str | DriveTerm, ...]] = {}
    for drive in model.layout.drives:
        name, own = drive.name, model.layout.own.get(drive.name, ())
        found = chosen.get(name)
        stated = [term for term in own if found is None or term not in found.terms]
        families = (wanted.get(name) or ()) if found is None else found.families
        entries: tuple[str | DriveTerm, ...] = (*(() if is_auto else families), *stated)
        if entries:
            drives[name] = entries
    options = model.options
    return Job(
        urdf=Path(model.tree.path),
        joints=model.joints,
        locked=options["locked"],
        gravity=tuple(options["gravity"]),
        mimic=model.mimic,
        snap_angles=read_tree(model.tree.path).joints != model.tree.joints,
        signals=asked.signals,
        terms=(*model.layout.terms, *([AUTO] if is_auto else [])),
        model_dynamics=model.dynamics,
        drives=drives,
        couplings=model.layout.couplings,
        contacts=model.contacts,
        loops=model.loops,
        passive=model.passive,
        estimator=identification.estimator,
        identification=_entries(identification.fitted),
        validation=_entries(identification.validation),
        ignore=asked.ignore,
        controller=loop,
    )


def _entries(evaluations: Sequence[Evaluated]) -> tuple[LogEntry, ...]:
    """Return the windows of the logs that are in files."""
    return tuple(
        LogEntry(Path(e.log.path), e.extent.start, e.extent.end) for e in evaluations if e.log.path
    )


def identify_job(
    job: Job,
    model: RobotModel,
    plan: WorkPlan,
    *,
    refuse: Callable[[LogEntry, DataError], None] | None = None,
) -> Identification:
    """Identify from a job's logs; nothing is written."""
    check_ignored(job.ignore)
    if isinstance(job.estimator, SimulationSettings):
        return _identify_loops(job, model, plan.progress)
    groups = job.identification, job.validation
    fitted, validation = survey_logs(job, model, *groups, refuse=refuse)
    if not fitted:
        which = "no log is usable" if job.identification else "no log is given"
        raise DataError(f"{which}, wanted at least one to identify from")
    report_stage(plan.progress, "checking logs")
    placed = locked_as_logged(job, model, fitted, validation)
    job, model, fitted, validation = placed.job, placed.model, placed.fitted, placed.validation
    locked = locked_findings(model, job.placed(model))
    found = [*locked, *examine_logs(job, model, fitted, validation)]
    recordings = Recordings(model, structural_mapping(model), fitted, validation)
    if not recordings.is_in_memory:
        recordings = replace(recordings, plan=plan)
    elif plan.is_asked_for:
        _log.warning(
            "the logs have at most %d rows and are read whole: workers and scheduler have no "
            "effect. Reduce rows_in_memory in [reduction] to read the logs in pieces",
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
    return replace(
        concluded,
        stated=replace(concluded.stated, job=job),
        findings=(*placed.notes, *concluded.findings),
        payload_checks=check_payloads(job, concluded.model, fitted),
    )


def _loop_stages() -> Sequence[str]:
    """Return the stages of a simulation; other jobs do not import its modules."""
    from robotid.identification.closed_loop.stages import STAGES as stages

    return stages


def _identify_loops(
    job: Job, model: RobotModel, progress: ProgressCallback | None
) -> Identification:
    """Identify by simulation, from commands or logged torques; no file is written."""
    from robotid.identification.closed_loop.from_commands import identify_loops

    assert isinstance(job.estimator, SimulationSettings)
    logs, validation = (
        [job.read(entry, model, needs=needed_of(job)) for entry in entries]
        for entries in (job.identification, job.validation)
    )
    found = identify_loops(
        model, logs, validation, job.controller, job.estimator, signals=job.signals,
        chooses=AUTO in job.terms, examined=diagnose(model, logs, validation, job.signals),
        ignore=job.ignore, units=units_of_logs(job.identification),
        progress=progress or ignore_progress,
    )  # fmt: skip
    return replace(found, stated=replace(found.stated, job=job))
