"""robotid fleet: identify many robots from a table of logs."""

import argparse
from collections.abc import Mapping
from typing import Any

from robotid.cli.flags import add_json, add_out, add_progress
from robotid.cli.printing import echo
from robotid.cli.running import progress_of, show_found

SUMMARY = "identify many robots from a table of units and logs"
_SHOWN = 10  # failures and units that differ


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    words = "table, .csv or .parquet, with columns unit, log, and optionally urdf, payload, job"
    add("table", metavar="TABLE", help=words)
    add("--urdf", metavar="FILE", help="URDF of the units whose rows have none")
    add("--job", metavar="JOB.toml", help="settings of the units whose rows have no job")
    add_out(parser, "robotid-fleet")
    group = parser.add_mutually_exclusive_group()
    words = "worker processes; default: one per core"
    group.add_argument("--workers", type=int, metavar="N", help=words)
    words = "address of a Dask cluster, as tcp://host:8786"
    group.add_argument("--scheduler", metavar="ADDRESS", help=words)
    add("--resume", action="store_true", help="continue an interrupted run in --out")
    words = "take units whose inputs have not changed from the results in --out"
    add("--update", action="store_true", help=words)
    add_json(parser)
    add_progress(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    with progress_of(options) as progress:
        from robotid.cli.work.fleet import read_fleet, run_fleet
        from robotid.dynamics.factors import available_cores
        from robotid.estimation.workers.plan import WorkPlan

        units = read_fleet(options.table, options.urdf, options.job)
        workers = available_cores() if options.workers is None else options.workers
        plan = WorkPlan(workers, options.scheduler, progress)
        content = run_fleet(
            units, options.out, plan=plan, resume=options.resume, update=options.update
        )
    show_found(content, options, _show, ["fleet.parquet", "fleet.html", "fleet.json"])
    return 0 if content["done"] else 1


def _show(content: Mapping[str, Any]) -> None:
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in content["verdicts"].items())
    shown = f" ({verdicts})" if verdicts else ""
    echo(f"{content['done']} of {content['units']} units identified{shown}, {content['logs']} logs")
    failures, unlike = content["failures"], content["unlike"]
    for each in failures[:_SHOWN]:
        echo(f"failed: {each['unit']}{': ' * bool(each['log'])}{each['log']}: {each['error']}",
             "  ")  # fmt: skip
    for each in unlike[:_SHOWN]:
        low, high = (f"{x:.3g}" for x in each["others"])
        echo(
            f"differs: {each['unit']}: {each['parameter']} is {each['value']:.4g} +- "
            f"{each['std_error']:.2g} {each['parameter_unit']}; the other units predict {low} to "
            f"{high}", "  ",
        )  # fmt: skip
    more = max(len(failures) - _SHOWN, 0) + max(len(unlike) - _SHOWN, 0)
    if more:
        echo(f"{more} more failures or differences: fleet.html")
