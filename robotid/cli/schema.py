"""robotid schema: print the JSON schema of job files, for editors."""

import argparse
import json

__all__ = ["SUMMARY", "add_flags", "run"]

SUMMARY = "print the JSON schema of job files, for editors"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add nothing but an example: the command has no flags.

    Args:
        parser: Its parser.
    """
    parser.epilog = (
        "robotid schema > job.schema.json; the first line of the job file is then "
        "#:schema job.schema.json"
    )


def run(options: argparse.Namespace) -> None:
    """Run the command.

    Args:
        options: Its flags.
    """
    from robotid.cli.work.schema import job_schema

    print(json.dumps(job_schema(), indent=2))
