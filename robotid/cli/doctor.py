"""robotid doctor: check logs for faults: JOB.toml, or URDF LOG [LOG ...]."""

import argparse
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from robotid.base.findings import Finding, grouped
from robotid.base.settings import require_kind
from robotid.cli.console import echo, print_causes, progress_of, show_found
from robotid.cli.job import add_job, add_shown, job_file, job_from_flags
from robotid.cli.logs import examine
from robotid.data.files.read import Readable
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.check_logs import diagnose, findings_to_dict
from robotid.diagnosis.verdict.verdict import blocking
from robotid.identification.pipeline import logs_of, robot_of
from robotid.robot.model import RobotModel


def doctor(
    model: RobotModel | str | Path,
    logs: Readable | Sequence[Readable] | None = None,
    *,
    validation: Readable | Sequence[Readable] = (),
    signals: SignalSettings | None = None,
) -> tuple[Finding, ...]:
    """Check logs for faults before an identification.

    Args:
        model: The robot, or the path of its URDF with all joints free; or a job file, alone.
        logs: Logs to fit, one or several, as of ``identify``.
        validation: Validation logs, likewise.
        signals: How logs become trajectories; the defaults if None.

    Returns:
        The findings, errors first. Each has a code, a severity, a place and a message.

    Raises:
        DataError: If a file or a DataFrame is no log.
        SettingsError: If a setting does not fit a log.
    """
    if logs is None:
        return examine(job_file(model))
    require_kind(signals, (SignalSettings, type(None)), "signals", "a robotid.SignalSettings")
    model = robot_of(model, logs)
    fitted, held_out = (logs_of(model, some, needs="any") for some in (logs, validation))
    return diagnose(model, fitted, held_out, signals or SignalSettings())


def add_flags(parser: argparse.ArgumentParser) -> None:
    add_job(parser)
    add_shown(parser, "json", "verbose")


def run(options: argparse.Namespace) -> int:
    with progress_of(options) as progress:
        job = job_from_flags(options)
        model = job.model()
        findings = examine(job, model, progress=progress)
    content = findings_to_dict(findings) | {"joints": list(model.joints)}
    count = len({entry.path for entry in (*job.identification, *job.validation)})
    show = partial(_show, findings, model.joints, is_verbose=options.verbose, count=count)
    show_found(content, options, show)
    return 1 if blocking(findings, job.ignore) else 0


def _show(
    findings: Sequence[Finding], joints: Sequence[str], _: Mapping[str, Any], *, is_verbose: bool,
    count: int,
) -> None:  # fmt: skip
    worst = _worst_of(findings, joints)
    print_causes(findings, joints, is_verbose=is_verbose, worst=worst, none="")
    if all(finding.severity == "note" for finding in findings):
        echo(f"no fault found in {count} {'log' if count == 1 else 'logs'}")


def _worst_of(findings: Sequence[Finding], joints: Sequence[str]) -> str:
    """Return the joint with the most errors, then the most warnings, then the largest figure."""
    ranks = {joint: [0, 0, 0.0] for joint in joints}
    for finding in findings:
        (cause,) = grouped([finding], joints)
        for joint in cause.joints:
            rank = ranks[joint]
            rank[0] += cause.severity == "error"
            rank[1] += cause.severity == "warning"
            rank[2] = max(rank[2], finding.evidence.get("share", 0.0))
    worst = max(ranks, key=lambda joint: ranks[joint], default="")
    return worst if any(ranks.get(worst, ())[:2]) else ""
