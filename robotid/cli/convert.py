"""robotid convert: write a log as CSV, Parquet, NPZ, HDF5 or MAT, with standard column names."""

import argparse
from typing import Any

from robotid.cli.flags import JOB, SOURCE, add_json
from robotid.cli.printing import echo
from robotid.cli.running import show_found

SUMMARY = "write a log as CSV, Parquet, NPZ, HDF5 or MAT, with standard column names"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add("log", metavar="IN", help="log of any format, or the folder of a bag")
    add("out", metavar="OUT", help="file to write; its suffix determines the format")
    add("--joints", metavar="A,B,...", help="joints to write; default: all")
    add("--sensors", metavar="A,B,...", help="topics of base, IMU and forces; default: all")
    JOB.add(parser, SOURCE)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from dataclasses import asdict

    from robotid.cli.work.convert import convert
    from robotid.data.signal_settings import LogSource

    joints = options.joints.split(",") if options.joints else None
    topics = tuple(options.sensors.split(",")) if options.sensors else ()
    source = LogSource(**source_settings(options), sensors=topics)
    done = convert(options.log, options.out, joints=joints, source=source)
    show_found(asdict(done), options, _show)


def source_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of a ``LogSource`` that the flags state, by name."""
    return dict(JOB.stated(options, SOURCE).get("log", {}))


def _show(done: dict[str, Any]) -> None:
    print(f"{done['path']}: {done['samples']} samples of {len(done['joints'])} joints")
    echo(f"  columns {', '.join(done['columns'])}", "  ")
    if done["local"]:
        echo("  wrenches have the axes of their links: axes = 'link' in [[contact]]")
    if done["ignored"]:
        echo(f"  not written, not of a joint: {', '.join(done['ignored'])}", "  ")
