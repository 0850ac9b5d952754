"""robotid identify: identify a robot: JOB.toml, or URDF LOG [LOG ...]."""

import argparse
from collections.abc import Mapping
from functools import partial
from typing import Any

from robotid.base.text import columns, terminal_width, wrapped
from robotid.cli.flags import OUTPUT, add_job, add_out, add_progress, job_from_flags, source_words
from robotid.cli.printing import (
    echo,
    print_block,
    print_causes,
    print_steps,
    print_verdict,
    recordings_of,
)
from robotid.cli.running import progress_of, show_found

SUMMARY = "identify a robot: JOB.toml, or URDF LOG [LOG ...]"
MAIN_FLAGS = (
    "--validate", "--out", "--estimator", "--friction", "--gain", "--joints", "--lock", "--cutoff",
    "--verbose", "--json",
)  # fmt: skip
EXAMPLES = (
    "robotid identify robot.urdf first.csv --validate second.csv --out result",
    "robotid identify job.toml --out result",
)


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add_job(parser, "result.json", OUTPUT)
    add_out(parser, "robotid-out")
    _add_work(parser)
    add_progress(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from robotid.base.typing import report_stage

    with progress_of(options) as progress:
        report_stage(progress, "reading logs")  # before what takes the first second: its modules
        from robotid.cli.work.identify import run_job
        from robotid.estimation.workers.plan import WorkPlan
        from robotid.output.report.next_steps import next_steps
        from robotid.output.report.steps import Origin

        job = job_from_flags(options)
        workers = job.workers if options.workers is None else options.workers
        plan = WorkPlan(workers, options.scheduler, progress=progress)
        source = source_words(options.words)
        found, result = run_job(job, options.out, plan=plan, source=source)
    show_found(
        result,
        options,
        partial(show_result, is_verbose=options.verbose),
        [*result["outputs"].values(), "result.json"],
    )
    if not options.json:
        print_steps(next_steps(found, Origin(source, options.out)))
    return 1 if result["verdict"]["log_errors"] else 0


def show_result(result: dict[str, Any], *, is_verbose: bool = False) -> None:
    """Print an identification."""
    from robotid.identification.summary import error_lines

    width, wls = terminal_width(), result.get("wls")
    echo(f"\n{result['robot']}: {len(result['joints'])} joints, {_found(result)}")
    roles = ("identification", "validation")
    fitted, validation = (recordings_of(result["inputs"], role) for role in roles)
    echo(f"\nfitted: {', '.join(fitted)}", "  ")
    print("\n".join(error_lines(result["identification"], wls and wls["identification"], width)))
    for k, (name, ours) in enumerate(zip(validation, result["validation"], strict=True)):
        echo(f"\nnot fitted: {name}", "  ")
        print("\n".join(error_lines(ours, wls and wls["validation"][k], width)))
    if lines := _drive_lines(result):
        print_block(*(wrapped(line, width, "  ") for line in lines))
    print()
    verdict = result["verdict"]
    print_causes(
        result["warnings"],
        result["joints"],
        is_verbose=is_verbose,
        worst="" if verdict["status"] == "good" else _worst(result),
        printed=verdict["reasons"],
    )
    print_verdict(verdict)


def _found(result: Mapping[str, Any]) -> str:
    """Return the number of parameters and their conditioning, as text."""
    if "simulation" in result:
        from robotid.identification.closed_loop.position_errors import DRIFTS  # imports numpy

        fit, kind = (result["simulation"][key] for key in ("fit", "controller"))
        over = f" over {DRIFTS:g} s" if kind["kind"] == "torque" else ""
        text = f"{fit['parameters']} free parameters; {fit['message']}; errors are position errors"
        return text + over
    structure, (before, after, _) = result["structure"], result["scale_check"]["masses"]
    assumed = " assumed" if result["scale_check"].get("assumed") else ""
    return (
        f"{structure['base']} base parameters ({structure['base_inertial']} inertial), condition "
        f"number {structure['condition']:.3g} (regressor, unit columns), "
        f"total mass {before:.2f}{assumed} -> {after:.2f} kg"
    )


def _drive_lines(result: Mapping[str, Any]) -> list[str]:
    """Return the friction terms, or all parameters of drives and controllers of a simulation."""
    from robotid.identification.summary import friction_lines, left_out_lines, variation_lines

    if "simulation" not in result:
        lines = friction_lines(result["friction"]) + left_out_lines(result.get("left_out", ()))
        return lines + variation_lines(result.get("variation"))
    rows = [
        (
            entry["name"],
            f"{entry['value']:.4g}",
            "at bound" if entry["source"] == "bound" else f"{entry['std_error']:.2g}",
            entry["unit"],
        )
        for entry in result["drive_parameters"]
        if entry["std_error"] is not None
    ]
    found = columns(("parameter", "value", "+-", "unit"), rows)
    return found + variation_lines(result.get("variation"))


def _worst(result: Mapping[str, Any]) -> str:
    """Return the joint with the largest prediction error, and that error."""
    is_motion = "simulation" in result
    errors = [
        (m["relative_error_pct"], joint)
        for metrics in result["validation"] or [result["identification"]]
        for joint, m in metrics["per_joint"].items()
        if m["relative_error_pct"] is not None
    ]
    if not errors:
        return ""
    error, joint = max(errors)
    return f"{joint}, {'position' if is_motion else 'torque'} error {error:.1f} %"


def _add_work(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the reduction of long logs; they never change a result."""
    flags = parser.add_argument_group("long logs; these flags do not change a bit of the result")
    words = "worker processes; default: as in the job file, or one per core for long logs"
    flags.add_argument("--workers", type=int, metavar="N", help=words)
    words = "address of a Dask cluster, as tcp://host:8786"
    flags.add_argument("--scheduler", metavar="ADDRESS", help=words)
