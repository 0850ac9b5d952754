"""robotid validate: compute a result's prediction error on other logs."""

import argparse
from functools import partial
from typing import TYPE_CHECKING, Any

from robotid.base.text import terminal_width
from robotid.cli.flags import add_json
from robotid.cli.printing import echo, print_verdict
from robotid.cli.running import show_found

if TYPE_CHECKING:
    from robotid.cli.work.job import LogEntry

SUMMARY = "compute a result's prediction error on other logs"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add("result", metavar="RESULT.json")
    add("logs", nargs="+", metavar="LOG")
    words = "name of the robot of the logs, if the fitted logs are of several"
    add("--unit", metavar="NAME", help=words)
    words = "add the logs to the variation between logs in RESULT.json"
    add("--update", action="store_true", help=words)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from robotid.cli.work.validate import validate_result

    entries = [_entry(log, options) for log in options.logs]
    found = validate_result(options.result, entries, update=options.update)
    show_found(found, options, partial(_show, is_update=options.update))


def _entry(log: str, options: argparse.Namespace) -> "LogEntry":
    """Return a log with its robot, checked as in a job file."""
    from robotid.cli.work.job import LogEntry

    unit = {} if options.unit is None else {"unit": options.unit}
    return LogEntry.from_dict({"log": log, **unit})


def _show(found: dict[str, Any], *, is_update: bool = False) -> None:
    from robotid.identification.summary import error_lines, variation_lines

    echo(f"predicted with {found['predicted_with']}")
    for recording in found["validation"]:
        echo(f"\n{recording['name']}", "  ")
        print("\n".join(error_lines(recording, width=terminal_width())))
        expected = recording.get("expected", {})
        if expected:
            source = "fit, for logs of the same day"
            if expected["with_spread"]:
                source = "fit and spread between logs"
            own = [
                f"{joint} {each['rmse']:.3g} ({each['within_95_pct']:.0f} %)"
                for joint, each in expected["per_joint"].items()
                if each["within_95_pct"] is not None
            ]
            echo(
                f"expected rmse by the {source} (share of rows within 95 %): {', '.join(own)}", "  "
            )
    for finding in found.get("findings", ()):
        echo(f"\n{finding['message']}")
    print_verdict(found["verdict"])
    if is_update:
        echo(f"the variation between logs in {found['result']} counts these logs now:")
        for line in variation_lines(found["variation"]):
            echo(line, "  ")
