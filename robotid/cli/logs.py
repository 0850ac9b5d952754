"""The logs of a job: opened once, examined, and identified by their inputs."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import file_sha256, log_exists
from robotid.base.findings import Finding, by_severity, listed
from robotid.base.typing import STAGES, ProgressCallback, report_stage
from robotid.cli.job import Job, LogEntry, written_job
from robotid.data.files.columns import Needs
from robotid.data.files.read import LogLayout
from robotid.data.files.table import Table
from robotid.data.log import Log
from robotid.data.units import STILL
from robotid.diagnosis.logs.check_logs import check_locked, diagnose, percent_hint
from robotid.diagnosis.verdict.fit_findings import log_findings
from robotid.diagnosis.verdict.verdict import check_ignored
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.recorded import Recordings, SurveyedLog, survey_log
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.output.files.result_file import Result, load_result, stated_model, stated_parameters
from robotid.robot.model import RobotModel

if TYPE_CHECKING:
    from robotid.design.previews import Run


_PIECES = 8  # pieces per rows in memory: the filter of a piece needs memory of its own
_SHORTEST = 256  # rows of a piece

#: Logs that cannot be read, and why.
Refused: TypeAlias = list[tuple[LogEntry, DataError]]
Surveyed: TypeAlias = tuple[SurveyedLog, ...]


def survey_logs(
    job: Job,
    model: RobotModel,
    *groups: Sequence[LogEntry],
    refused: Refused | None = None,
    needs: Needs = "torque",
) -> tuple[Surveyed, ...]:
    """Return the logs of each group, ready to be read; faulty ones go into refused, or raise."""
    paths = dict.fromkeys(entry.path for entry in chain(*groups))
    opened = {path: _open(job, model, path, needs) for path in paths}
    tables = [file[1].rows for file in opened.values() if not isinstance(file, DataError)]
    rows = sum(table.count() for table in tables if table is not None)  # if not only read whole
    is_long = rows > job.rows_in_memory and not model.is_static
    length = max(job.rows_in_memory // _PIECES, _SHORTEST) if is_long else None
    faults: Refused = [] if refused is None else refused

    def survey(entries: Sequence[LogEntry]) -> Surveyed:
        logs = []
        units_of_logs(entries)
        for entry in entries:
            try:
                file = opened[entry.path]
                if isinstance(file, DataError):
                    raise file
                window = entry.start, entry.end
                log = survey_log(*file, model, job.signals, window, length=length)
                logs.append(replace(log, unit=entry.unit or ""))
            except DataError as error:
                faults.append((entry, error))
        return tuple(logs)

    surveyed = tuple(survey(entries) for entries in groups)
    if faults and refused is None:
        errors = [error for _, error in _by_fault(faults)]
        raise DataError("\n".join(map(str, errors)), errors[0].code)
    return surveyed


def _by_fault(refused: Refused) -> Iterator[tuple[str, DataError]]:
    """Yield the logs with each fault, and its error in the first of them, which names all."""
    faults: dict[str, dict[str, DataError]] = {}
    for entry, error in refused:
        fault = str(error) if error.code == "unusable_log" else error.code  # the code of any other
        faults.setdefault(fault, {}).setdefault(entry.path.name, error)
    for logs in faults.values():
        first, *others = logs.values()
        same = f"{listed(logs)} have the same fault ({first.code}). " if others else ""
        yield listed(logs), DataError(f"{same}{first}", first.code)


def units_of_logs(entries: Sequence[LogEntry]) -> list[str]:
    """Return the unit (name of the robot) of each log; "" if none is given."""
    unnamed = [entry for entry in entries if not entry.unit]
    if 0 < len(unnamed) < len(entries):
        named = next(entry for entry in entries if entry.unit)
        raise SettingsError(
            f"{unnamed[0].path.name} has no unit, but {named.path.name} has unit = "
            f"{named.unit!r}; give the unit (name of the robot) of each log, or of none"
        )
    return [entry.unit or "" for entry in entries]


def examine(
    job: Job, model: RobotModel | None = None, *, progress: ProgressCallback | None = None
) -> tuple[Finding, ...]:
    """Examine the logs of a job; the findings have errors first."""
    check_ignored(job.ignore)
    if not (job.identification or job.validation):
        raise SettingsError("the job has no log; add one: [[identification]] with log = FILE")
    model = model or job.model()
    refused: Refused = []
    report_stage(progress, "reading logs", STAGES[:2])
    groups = job.identification, job.validation
    fitted, validation = survey_logs(job, model, *groups, refused=refused, needs="any")
    report_stage(progress, "checking logs", STAGES[:2])
    job, model, first, second, notes = locked_as_logged(job, model, fitted, validation)
    faults = [Finding(x.code, "error", where, str(x)) for where, x in _by_fault(refused)]
    return by_severity([*faults, *notes, *examine_logs(job, model, first, second)])


def locked_as_logged(
    job: Job, model: RobotModel, fitted: Surveyed, validation: Surveyed
) -> tuple[Job, RobotModel, Surveyed, Surveyed, tuple[Finding, ...]]:
    """Return the job with joints locked at their positions in the logs, unless it states them."""
    logged, logs = {}, (*fitted, *validation)
    for joint in [joint for joint in model.locked if joint not in job.placed(model)]:
        positions = np.concatenate([log.locked.get(joint, []) for log in logs])
        if len(positions) and np.ptp(positions) <= STILL:
            logged[joint] = float(np.median(positions))
    if not logged:
        return job, model, fitted, validation, ()
    shown = ", ".join(f"{joint} = {position:.4g}" for joint, position in logged.items())
    message = (
        f"joints are locked at their positions in the logs: {shown}. Set other positions with "
        "locked = { joint = position }"
    )
    message += "".join(percent_hint(model, *place, job.units) for place in logged.items())
    note = Finding("locked_as_logged", "note", ", ".join(logged), message, logged)
    job = replace(job, locked={**job.locked, **logged})
    model = job.model()
    first, second = (tuple(replace(x, model=model) for x in logs) for logs in (fitted, validation))
    return job, model, first, second, (note,)


def examine_logs(
    job: Job, model: RobotModel, fitted: Sequence[SurveyedLog], validation: Sequence[SurveyedLog]
) -> tuple[Finding, ...]:
    """Examine surveyed logs: the locked joints of the job, then the windows of the logs."""
    findings, placed = list[Finding](), job.placed(model)
    for log in (*fitted, *validation):
        findings += check_locked(model, log.locked, Path(log.path).name, placed, job.units)
        if len(log.windows) > 1:  # the windows have no notes of their own
            findings += log_findings([log.head])
    first, second = ([look for log in logs for look in log.looks] for logs in (fitted, validation))
    return (*findings, *diagnose(model, first, second, job.signals))


def job_of_result(job: Job, path: str | Path, advice: str) -> tuple[Job, list[LogEntry]]:
    """Return a job with the settings of a result, and the logs that the result was fitted to."""
    result = load_result(path).content
    stated, hashes = written_job(result["settings"], Path(path).name), fitted_hashes(result)
    for entry in stated.identification:
        if not log_exists(entry.path) or file_sha256(entry.path) not in hashes:
            raise DataError(
                f"{entry.path}, a fitted log of {path}, is missing or was changed; {advice}"
            )
    wanted = replace(stated, urdf=job.urdf, identification=job.identification)
    return wanted, list(stated.identification)


def fitted_hashes(result: Mapping[str, Any]) -> set[str]:
    """Return the SHA-256 of the logs that a result was fitted to."""
    return {entry["sha256"] for entry in result["inputs"] if entry["role"] == "identification"}


def result_run(job: Job, path: str | Path) -> tuple[Job, list[LogEntry], RobotModel, "Run"]:
    """Return the information of the logs of a result."""
    from robotid.design.previews import Run

    job, fitted = job_of_result(job, path, "give a result whose logs exist")
    result = load_result(path).content
    model = stated_model(result, job.model())
    (logs,) = survey_logs(job, model, fitted)
    recordings = Recordings(model, structural_mapping(model), logs)
    details = result["consistency"].get("fit", {})
    return job, fitted, model, Run.of(recordings, stated_parameters(result, model), details)


def _open(
    job: Job, model: RobotModel, path: Path, needs: Needs
) -> tuple[LogLayout, Table] | DataError:
    try:
        layout, table = job.lay_out(LogEntry(path), model, needs=needs)
    except DataError as error:
        return error
    read = cache(table.read)  # once for all windows of the file
    return layout, replace(table, read=lambda wanted: read(tuple(wanted)))


def log_of_commands(job: Job, entry: LogEntry, result: Result) -> Log:
    """Return a log with the inputs of the simulated robot, gravity compensation included."""
    from robotid.identification.closed_loop.from_commands import driven_log, with_gravity

    log = job.read(entry, result.robot, needs=needed_of(job.controller))
    if job.controller.kind == "torque":
        return driven_log(result.robot, log, job.signals)
    return with_gravity(job.model(), log) if job.controller.gravity_compensation else log


def needed_of(controller: LoopSettings) -> Needs:
    """Return the signals, besides positions, that a simulation requires of a log."""
    return "torque" if controller.kind == "torque" else "commands"
