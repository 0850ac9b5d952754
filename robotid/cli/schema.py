"""robotid schema: print the JSON schema of job files, for editors."""

import argparse
import json

SUMMARY = "print the JSON schema of job files, for editors"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add nothing but an example: the command has no flags."""
    parser.epilog = (
        "robotid schema > job.schema.json; the first line of the job file is then "
        "#:schema job.schema.json"
    )


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from robotid.cli.work.schema import job_schema

    print(json.dumps(job_schema(), indent=2))
