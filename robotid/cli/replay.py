"""robotid replay: play a log in the browser: robot, torques, identified parameters."""

import argparse
import sys
from pathlib import Path

from robotid.base.files import check_file
from robotid.cli.flags import (
    JOB,
    ONLINE,
    add_robot_and_log,
    add_serve,
    job_from_flags,
    refuse_log_flags,
)
from robotid.cli.running import serve

SUMMARY = "play a log in the browser: robot, torques, identified parameters"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add_robot_and_log(parser)
    results = "result.json, track.json or their folder"
    add("results", nargs="*", metavar="RESULT", help=results)
    add("--html", metavar="FILE", help="page to write; default: replay.html beside the RESULT")
    add("--ghost", metavar="LOG", help="second motion, shown as a ghost")
    add_serve(parser, "track the log again in real time, and show it in the browser")
    group = parser.add_argument_group("the log, unless a RESULT is given")
    JOB.add(group, ONLINE)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from robotid.cli.work.replay import read_findings, replay_files, stated_job

    findings = read_findings(options.results)
    if findings.settings is None:
        job = job_from_flags(options)
    else:
        refuse_log_flags(options, "a RESULT states how its logs are read")
        job = stated_job(findings, options.source, options.logs[0])
    if options.html or options.serve is None:
        page_file = Path(options.html or findings.beside / "replay.html")
        check_file(page_file, [options.source, *options.logs, *options.results])
        target = replay_files(job, findings, ghost=options.ghost).write(page_file)
        print(f"written: {target}, {target.stat().st_size / 1e6:.1f} MB", file=sys.stderr)
    if options.serve is not None:
        serve(job, None, options, lambda found: None)
