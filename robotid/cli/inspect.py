"""robotid inspect: list joints, parameters and faults of a URDF."""

import argparse
import shlex
from collections.abc import Sequence
from functools import partial
from typing import Any

from robotid.base.exceptions import ModelError
from robotid.base.findings import Finding, listed
from robotid.cli.console import echo, print_causes, show_found
from robotid.cli.job import add_shown
from robotid.diagnosis.urdf.inspection import inspect_urdf


def add_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("urdf", metavar="URDF")
    add("--free-flyer", action="store_true", help="floating base")
    add("--base", action="store_true", help="print the base parameters, too")
    add_shown(parser, "json", verbose="print notes, too")


def run(options: argparse.Namespace) -> None:
    inspection = inspect_urdf(options.urdf, free_flyer=options.free_flyer)
    content = inspection.to_dict()
    if not (content["robot"] or options.json):
        raise ModelError(content["findings"][0]["message"])
    show_found(content, options, partial(_show, options=options, findings=inspection.findings))
    if content["structure"] is None:
        raise ModelError(f"{options.urdf} does not give a valid model; see the findings")


def _show(
    content: dict[str, Any], *, options: argparse.Namespace, findings: Sequence[Finding]
) -> None:
    structure, joints = content["structure"], content["joints"]
    if content["robot"]:
        echo(f"{content['robot']}: {len(joints)} joints: {listed(joints)}", "  ")
    if structure:
        echo(
            f"{structure['standard']} standard inertial parameters, {structure['base_inertial']} "
            f"base; with drives {structure['base']}"
        )
    print_causes(findings, joints, is_verbose=options.verbose)
    if options.base:
        print("\nbase parameters, inertial")
        for group in content["base_groups"]:
            echo(f"  {group}", "    ")
    elif structure:
        flags = ["--free-flyer", "--base"] if options.free_flyer else ["--base"]
        command = shlex.join(["robotid", "inspect", options.urdf, *flags])
        print(f"list of base parameters:\n  {command}")
