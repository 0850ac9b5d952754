"""Examine the logs of a job before anything is identified."""

from collections.abc import Sequence
from pathlib import Path

from robotid.commands.job import Job, LogEntry
from robotid.commands.logs import survey_logs
from robotid.doctor.diagnosis import alarming, diagnose
from robotid.doctor.locked_joints import check_locked
from robotid.exceptions import DataError
from robotid.findings import Finding, by_severity
from robotid.identification.survey import SurveyedLog
from robotid.robot.model import RobotModel

__all__ = ["examine", "examine_logs"]


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
    refused: list[Finding] = []

    def refuse(entry: LogEntry, error: DataError) -> None:
        refused.append(Finding(error.code, "error", entry.path.name, str(error)))

    fitted, kept = survey_logs(job, model, job.identification, job.validation, refuse=refuse)
    return by_severity([*refused, *examine_logs(job, model, fitted, kept)])


def examine_logs(
    job: Job, model: RobotModel, fitted: Sequence[SurveyedLog], kept: Sequence[SurveyedLog]
) -> tuple[Finding, ...]:
    """Examine logs that were surveyed: their windows, and the joints that the job holds still.

    Args:
        job: The job.
        model: Its robot.
        fitted: Its logs to fit.
        kept: Its logs kept apart.

    Returns:
        The findings, held joints first.

    Raises:
        SettingsError: If a setting does not fit a log.
    """
    findings: list[Finding] = []
    for log in (*fitted, *kept):
        name = Path(log.path).name
        findings += check_locked(model, log.held, name, job.locked)
        if len(log.windows) > 1:  # the windows have no notes of their own
            notes = log.head.notes
            findings += [Finding("log_note", "note", name, f"{name}: {note}") for note in notes]
    first, second = ([look for log in logs for look in log.looks] for logs in (fitted, kept))
    return (*findings, *diagnose(model, first, second, job.signals))
