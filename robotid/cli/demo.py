"""robotid demo: simulate a Unitree Z1 arm, identify it and write a report; no input is needed."""

import argparse

from robotid.cli.console import terminal_progress
from robotid.cli.flags import add_out
from robotid.cli.identify import show_result
from robotid.cli.printing import echo, print_files

SUMMARY = "simulate a Unitree Z1 arm, identify it and write a report; no input is needed"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add_out(parser, "robotid-demo")


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from robotid.cli.work.demo import run_demo

    echo("simulating a Unitree Z1 arm whose masses, armature and friction differ from its URDF ...")
    with terminal_progress() as progress:
        identification, result, truth = run_demo(options.out, progress=progress)
    show_result(result)
    error = identification.base - truth
    within = sum(abs(error) < 3 * identification.base_error)
    echo(f"\n{within} of {len(truth)} base parameters lie within 3 standard errors of the truth")
    print_files(options.out, [*result["outputs"].values(), "result.json"])
