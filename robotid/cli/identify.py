"""robotid identify: identify a robot: JOB.toml, or URDF LOG [LOG ...]."""

import argparse
from collections.abc import Mapping
from functools import partial
from typing import Any

from robotid._text import columns, terminal_width, wrapped
from robotid.cli.flags import OUTPUT, add_job, add_out, add_progress, job_from_flags, source_words
from robotid.cli.printing import (
    print_block,
    print_causes,
    print_open_loop,
    print_steps,
    print_verdict,
    recordings_of,
    say,
)
from robotid.cli.running import progress_of, show_found

__all__ = ["SUMMARY", "add_flags", "run", "show_result"]

SUMMARY = "identify a robot: JOB.toml, or URDF LOG [LOG ...]"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command.

    Args:
        parser: Its parser.
    """
    add_job(parser, "result.json", OUTPUT)
    add_out(parser, "robotid-out")
    _add_work(parser)
    add_progress(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command.

    Args:
        options: Its flags.
    """
    from robotid._typing import report_stage

    with progress_of(options) as progress:
        report_stage(progress, "reading logs")  # before what takes the first second: its modules
        from robotid.commands.identify import run_job
        from robotid.identification.result import Identification
        from robotid.report.advice import Origin, loop_steps, next_steps
        from robotid.workers.plan import WorkPlan

        job = job_from_flags(options)
        workers = job.workers if options.workers is None else options.workers
        plan = WorkPlan(workers, options.scheduler, options.resume, progress)
        source = source_words(options.words)
        found, result = run_job(job, options.out, plan=plan, source=source)
    show_found(
        result,
        options,
        partial(show_result, is_verbose=options.verbose),
        [*result["outputs"].values(), "result.json"],
    )
    if not options.json:
        origin = Origin(source, options.out)
        if isinstance(found, Identification):
            print_steps(next_steps(found, origin))
        else:
            print_steps(loop_steps(result, origin))
    return 1 if result["verdict"]["alarms"] else 0


def show_result(result: dict[str, Any], *, is_verbose: bool = False) -> None:
    """Print what was identified.

    Args:
        result: The content of result.json.
        is_verbose: Whether to print notes, too.
    """
    from robotid.identification.summary import error_lines, friction_lines

    if "simulation" in result:
        _print_commanded(result, is_verbose=is_verbose)
        return
    structure, wls, width = result["structure"], result["wls"], terminal_width()
    before, after, _ = result["witness"]["masses"]
    say(
        f"\n{result['robot']}: {len(result['joints'])} joints, {structure['base']} base parameters "
        f"({structure['base_inertial']} inertial), condition number {structure['condition']:.3g}, "
        f"total mass {before:.2f} -> {after:.2f} kg"
    )
    fitted, kept = (recordings_of(result["inputs"], of) for of in ("identification", "validation"))
    say(f"\nfitted: {', '.join(fitted)}", "  ")
    print("\n".join(error_lines(result["identification"], wls["identification"], width)))
    for name, ours, theirs in zip(kept, result["validation"], wls["validation"], strict=True):
        say(f"\nnot fitted: {name}", "  ")
        print("\n".join(error_lines(ours, theirs, width)))
    if lines := friction_lines(result["friction"]):
        print_block(*(wrapped(line, width, "  ") for line in lines))
    print()
    verdict = result["verdict"]
    print_causes(
        result["warnings"],
        result["joints"],
        is_verbose=is_verbose,
        worst="" if verdict["status"] == "good" else _worst(result),
        said=verdict["reasons"],
    )
    print_verdict(verdict)


def _print_commanded(result: dict[str, Any], *, is_verbose: bool) -> None:
    """Print what was found from commands: open loops beside plainer models, drives, the verdict."""
    found, fit = result["simulation"], result["simulation"]["fit"]
    say(
        f"\n{result['robot']}: {len(result['joints'])} joints, {fit['parameters']} unknowns; "
        f"{fit['message']}"
    )
    for role, words in (("identification", "fitted"), ("validation", "not fitted")):
        for run in found[role]:
            print_open_loop(run, f"{words}: ")
    rows = []
    for entry in result["drive_parameters"]:
        error = entry["std_error"]
        if error is not None:
            rows.append((entry["name"], f"{entry['value']:.4g}", f"{error:.2g}", entry["unit"]))
    heads = ("parameter", "value", "+-", "unit")
    print("\n" + "\n".join(columns(heads, rows)) + "\n")
    print_causes(result["warnings"], result["joints"], is_verbose=is_verbose)
    print_verdict(result["verdict"])


def _worst(result: Mapping[str, Any]) -> str:
    """Return the joint whose torque is explained least, and how much of it is missed."""
    errors = [
        (m["relative_error_pct"], joint)
        for metrics in result["validation"] or [result["identification"]]
        for joint, m in metrics["per_joint"].items()
        if m["relative_error_pct"] is not None
    ]
    return "{1}, {0:.1f} % of its torque is missed".format(*max(errors)) if errors else ""


def _add_work(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say who reduces long logs; they never change a result."""
    flags = parser.add_argument_group("long logs; the result has the same bits in any case")
    words = "worker processes; default: that of the job file, else one per core for long logs"
    flags.add_argument("--workers", type=int, metavar="N", help=words)
    words = "of a Dask cluster, as tcp://host:8786"
    flags.add_argument("--scheduler", metavar="ADDRESS", help=words)
    words = "go on from where an interrupted run in --out ended"
    flags.add_argument("--resume", action="store_true", help=words)
