"""robotid track: run the online estimator over a log: history, step changes."""

import argparse
import sys
from typing import Any

from robotid.base.text import columns, in_digits_of
from robotid.cli.flags import (
    JOB,
    ONLINE,
    add_json,
    add_out,
    add_robot_and_log,
    add_serve,
    add_verbose,
    job_from_flags,
)
from robotid.cli.printing import echo
from robotid.cli.running import serve, show_found

SUMMARY = "run the online estimator over a log: history, step changes"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add_robot_and_log(parser)
    add_out(parser, "robotid-track")
    add_json(parser, "track.json")
    JOB.add(parser.add_argument_group("the log"), ONLINE)
    add_verbose(parser)
    add_serve(parser, "show the run in the browser, in real time")


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from robotid.cli.work.track import run_track

    job = job_from_flags(options)

    def finished(found: dict[str, Any]) -> None:
        show_found(found, options, _show, [found["history"], "track.json"])
        sys.stdout.flush()

    if options.serve is None:
        finished(run_track(job, options.out))
    else:
        serve(job, options.out, options, finished)


def _show(found: dict[str, Any]) -> None:
    converged = found["converged_at"]
    when = "not converged" if converged is None else f"converged at {converged:.2f} s"
    echo(
        f"{found['robot']}: {found['samples']} samples, delay of the estimate "
        f"{1e3 * found['delay']:.0f} ms, {when}, excitation {found['excitation']:.2f}"
    )
    for change in found["changes"]:
        load = change["payload"]
        mass, error = in_digits_of(load["mass"], load["std_error"])
        echo(
            f"step change at {change['onset']:.2f} s, detected at {change['flagged']:.2f} s; "
            f"equivalent payload on {load['body']}: {mass} +- {error} kg",
            "  ",
        )
    rows = []
    for entry in found["base_parameters"]:
        value, error = in_digits_of(entry["value"], entry["std_error"])
        rows.append([entry["name"], value, f"+- {error}", entry["unit"]])
    print("\n".join(columns(["", "", "", ""], rows, left=(0, 2, 3))[1:]))
