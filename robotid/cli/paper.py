"""robotid paper: repeat the simulation of the paper: figures, tables, numbers."""

import argparse
from typing import Any

from robotid.cli.console import progress_of, show_found
from robotid.cli.job import add_out, add_shown


def add_flags(parser: argparse.ArgumentParser) -> None:
    add_out(parser, "robotid-paper")
    parser.add_argument("--quick", action="store_true", help="few iterations and motions: a trial")
    add_shown(parser, "progress", json="print paper.json")


def run(options: argparse.Namespace) -> None:
    from robotid.paper.run import run_paper
    from robotid.paper.study import PaperSettings

    few = PaperSettings(iterations=5, longest=5, runs=5, patience=5)
    with progress_of(options) as progress:
        result = run_paper(options.out, settings=few if options.quick else None, progress=progress)
    if options.quick and not options.json:
        print("a trial: too few iterations and motions to converge\n")
    show_found(result, options, _show, ("paper.html", "paper.json", "replay.html"), options.out)


def _show(result: dict[str, Any]) -> None:
    cases = {"disturbed": "disturbed", "noisy": "noisy", "on_program": "on program"}
    print("relative error of the parameters; NA: first iteration with PRX = 0, - if there is none")
    print("  model       start   after 1   at end   " + "  ".join(cases.values()) + "   NA")
    for name, model in result["models"].items():
        errors = model["relative_error"]
        ends = [result[case][name]["relative_error"][-1] for case in cases]
        cells = "".join(f"{x:9.2g}" for x in (errors[0], errors[1], errors[-1], *ends))
        print(f"  {name:10}{cells}   {model['NA'] or '-'}")
    print("\nrandom motions that converged to 1e-3")
    for name, motions in result["trajectories"].items():
        print(f"  {name:10} {motions['converged']} of {motions['runs']}")
