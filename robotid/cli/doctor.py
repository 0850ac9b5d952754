"""robotid doctor: check logs for faults: JOB.toml, or URDF LOG [LOG ...]."""

import argparse
from collections.abc import Sequence
from functools import partial
from typing import Any

from robotid.base.findings import Finding, grouped
from robotid.cli.console import echo, print_causes, progress_of, show_found
from robotid.cli.flags import add_job, job_from_flags
from robotid.cli.logs import examine
from robotid.diagnosis.logs.check_logs import findings_to_dict
from robotid.diagnosis.verdict.verdict import blocking


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add_job(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    with progress_of(options) as progress:
        job = job_from_flags(options)
        model = job.model()
        findings = examine(job, model, progress=progress)
    content = findings_to_dict(findings) | {"joints": list(model.joints)}
    logs = len({entry.path for entry in (*job.identification, *job.validation)})
    shown = partial(show, findings, model.joints, is_verbose=options.verbose, logs=logs)
    show_found(content, options, shown)
    return 1 if blocking(findings, job.ignore) else 0


def show(
    findings: Sequence[Finding],
    joints: Sequence[str],
    content: dict[str, Any],
    *,
    is_verbose: bool,
    logs: int,
) -> None:
    """Print the findings of the doctor, or that there is no fault."""
    worst = _worst_of(findings, joints)
    print_causes(findings, joints, is_verbose=is_verbose, worst=worst, none="")
    if all(finding.severity == "note" for finding in findings):
        echo(f"no fault found in {logs} {'log' if logs == 1 else 'logs'}")


def _worst_of(findings: Sequence[Finding], joints: Sequence[str]) -> str:
    """Return the joint with the most errors, then the most warnings, then the largest figure."""
    ranks = dict.fromkeys(joints, (0, 0, 0.0))
    for finding in findings:
        (cause,) = grouped([finding], joints)
        for joint in cause.joints:
            errors, warnings, share = ranks[joint]
            ranks[joint] = (
                errors + (cause.severity == "error"),
                warnings + (cause.severity == "warning"),
                max(share, finding.evidence.get("share", 0.0)),
            )
    worst = max(ranks, key=lambda joint: ranks[joint], default="")
    return worst if any(ranks.get(worst, ())[:2]) else ""
