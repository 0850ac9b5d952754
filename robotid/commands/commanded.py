"""A job of commands and positions from its files to the folder of results."""

from pathlib import Path
from typing import Any

from robotid._files import check_folder, folder_beside, write_json
from robotid._typing import ProgressCallback, ignore_progress, report_stage
from robotid.commanded.driven import driven_log
from robotid.commanded.fit import STAGES
from robotid.commanded.identify import Commanded, identify_commands, with_gravity
from robotid.commands.job import Job, LogEntry
from robotid.doctor.diagnosis import diagnose
from robotid.exceptions import SettingsError
from robotid.export.commanded_entries import build_commanded
from robotid.export.result import Result
from robotid.export.urdf import DYNAMICS_TERMS, write_urdf
from robotid.fitting.settings import SimulationSettings
from robotid.judgement.verdict import check_ignored
from robotid.logs.columns import Needs
from robotid.logs.data import Log
from robotid.regressor.friction_projection import DriveMoments, project_friction
from robotid.report.advice import Origin
from robotid.report.commanded_page import Followed, write_commanded_report
from robotid.robot.families import AUTO

__all__ = ["log_of_commands", "run_commanded"]


def run_commanded(
    job: Job, folder: str | Path, *, progress: ProgressCallback | None = None
) -> tuple[Commanded, dict[str, Any]]:
    """Identify from commands and write result.json, report.html and the URDF with its sidecar.

    Args:
        job: What to do; its estimator is "simulation".
        folder: Where to write; made if it is missing.
        progress: Told of the stages.

    Returns:
        What was found, and the content of result.json.

    Raises:
        DataError: If a log cannot be used.
        NotConvergedError: If the loops cannot be rolled out.
        SettingsError: If a setting does not fit.
    """
    if not isinstance(job.estimator, SimulationSettings):
        raise SettingsError(f"the estimator is {job.estimator.name!r}, wanted 'simulation'")
    told = progress or ignore_progress
    report_stage(told, "reading logs", STAGES)
    model, target = job.model(), Path(folder)
    name = f"{Path(model.tree.path).stem}.identified.urdf"
    sidecar = str(Path(name).with_suffix(".drive.json"))
    check_folder(target, ["result.json", "report.html", name, sidecar])
    logs, kept = (
        [job.read(entry, model, needs=_needed(job)) for entry in entries]
        for entries in (job.identification, job.validation)
    )
    check_ignored(job.ignore)
    found = identify_commands(
        model, logs, kept, job.controller, job.estimator, signals=job.signals,
        chooses=AUTO in job.terms, examined=diagnose(model, logs, kept, job.signals),
        ignore=job.ignore, progress=told,
    )  # fmt: skip
    report_stage(told, "writing", STAGES)
    outputs = {"urdf": name, "sidecar": sidecar} | ({"report": "report.html"} if job.report else {})
    content = build_commanded(found, job.to_dict(), outputs)
    target.mkdir(parents=True, exist_ok=True)
    with folder_beside(target) as partial:
        model, pi = found.model, found.standard
        moments = {
            drive: DriveMoments.from_dict(table)
            for drive, table in content["drive_moments"].items()
        }
        dynamics = job.dynamics and project_friction(model, pi, moments, DYNAMICS_TERMS)
        write_urdf(model, pi, partial / name, dynamics=dynamics)
        if job.report:
            files = {"result": "result.json", "urdf": name, "sidecar": sidecar}
            write_commanded_report(
                content,
                followed(found),
                partial / "report.html",
                files=files,
                origin=Origin((), str(target)),
            )
        write_json(content, partial / "result.json")
    return found, content


def log_of_commands(job: Job, entry: LogEntry, result: Result) -> Log:
    """Return a log of commands as its robot hears them, the controller's own torque included.

    Where its torque drives the robot, that is what it hears.

    Args:
        job: The job of the result.
        entry: Which log.
        result: What the job has found.

    Raises:
        DataError: If the file cannot be used, or has no commands.
    """
    log = job.read(entry, result.robot, needs=_needed(job))
    if job.controller.kind == "torque":
        return driven_log(result.robot, log, job.signals)
    return with_gravity(job.model(), log) if job.controller.gravity_compensation else log


def _needed(job: Job) -> Needs:
    """Return what a log of the job must have beside positions."""
    return "torque" if job.controller.kind == "torque" else "commands"


def followed(found: Commanded) -> list[Followed]:
    """Return the logs beside their open loops, those kept apart first, as the report shows them.

    Args:
        found: What was found.
    """
    shown = []
    for is_kept, runs in ((True, found.kept), (False, found.errors)):
        for run in runs:
            t = run.log.t
            name = f"{run.log.name}, {t[0]:.4g} to {t[-1]:.4g} s"
            q_ref = None if run.command is None else run.log.q_ref
            shown.append(Followed(name, is_kept, t, q_ref, run.log.q, run.q))
    return shown
