"""Examine the logs of a job before anything is identified."""

from collections.abc import Sequence
from dataclasses import replace

from robotid.commands.job import Job, LogEntry
from robotid.commands.logs import examine_locked, is_long, survey_logs
from robotid.doctor.diagnosis import alarming, diagnose
from robotid.exceptions import DataError
from robotid.findings import Finding, by_severity
from robotid.logs.data import Log
from robotid.regressor.base_parameters import structural_mapping
from robotid.robot.model import RobotModel

__all__ = ["examine"]


def examine(job: Job) -> tuple[Finding, ...]:
    """Examine the logs of a job.

    Args:
        job: The job. A log that cannot be read gives a finding, not an error.

    Returns:
        The findings, errors first.

    Raises:
        ModelError: If the URDF cannot be used.
        SettingsError: If a setting does not fit, or a code to ignore is unknown.
    """
    alarming([], job.ignore)
    model = job.model()
    findings: list[Finding] = []
    read = _look if is_long(job, (*job.identification, *job.validation)) else _read
    fitted, kept = (
        read(job, model, entries, findings) for entries in (job.identification, job.validation)
    )
    return by_severity([*findings, *diagnose(model, fitted, kept, job.signals)])


def _read(
    job: Job, model: RobotModel, entries: Sequence[LogEntry], findings: list[Finding]
) -> list[Log]:
    """Return the logs that can be read; why the others cannot goes to the findings."""
    logs = []
    for entry in entries:
        try:
            logs.append(job.read(entry, model))
            findings += examine_locked(job, model, [entry])
        except DataError as error:
            findings.append(Finding(error.code, "error", entry.path.name, str(error)))
    return logs


def _look(
    job: Job, model: RobotModel, entries: Sequence[LogEntry], findings: list[Finding]
) -> list[Log]:
    """Return windows of logs that are too long to be in memory."""
    mapping, looks = structural_mapping(model), []
    for entry in entries:
        try:
            (log,) = survey_logs(job, [entry], model, mapping)
        except DataError as error:
            findings.append(Finding(error.code, "error", entry.path.name, str(error)))
            continue
        notes, name = log.head.notes, entry.path.name
        findings += [Finding("log_note", "note", name, f"{name}: {note}") for note in notes]
        looks += [replace(look, notes=()) for look in log.looks]
    return looks
