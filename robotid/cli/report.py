"""robotid report: write the report of a result again from its inputs."""

import argparse
from typing import Any

from robotid.cli.flags import add_json, add_progress, add_verbose
from robotid.cli.running import progress_of, show_found

SUMMARY = "write the report of a result again from its inputs"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add("result", metavar="RESULT", help="result.json or its folder")
    add("--out", metavar="FILE", help="page to write; default: report.html in the folder of RESULT")
    add_json(parser)
    add_verbose(parser)
    add_progress(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from robotid.base.typing import report_stage

    with progress_of(options) as progress:
        report_stage(progress, "reading logs")
        from robotid.cli.work.report import rewrite_report

        written = rewrite_report(options.result, options.out, progress=progress)
    show_found(written, options, _show)


def _show(done: dict[str, Any]) -> None:
    print(f"written: {done['report']}")
