"""robotid export: write a result in the formats that other programs read."""

import argparse
from typing import Any

from robotid.cli.flags import add_json
from robotid.cli.printing import say
from robotid.cli.running import show_found

__all__ = ["SUMMARY", "add_flags", "run"]

SUMMARY = "write a result as URDF, MJCF, SDF, Isaac Lab's actuators or ranges for randomisation"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command.

    Args:
        parser: Its parser.
    """
    add = parser.add_argument
    add("result", metavar="RESULT", help="result.json or its folder")
    kinds = ("urdf", "mjcf", "sdf", "isaac", "ranges")
    words = "isaac: YAML of Isaac Lab's actuators; ranges: YAML of 95 %% intervals"
    add("--format", required=True, choices=kinds, help=words)
    add("--out", required=True, metavar="FILE", help="file to write")
    words = "time step of the simulator; default: 0.001 of mjcf, 0.005 of isaac"
    add("--step", type=float, metavar="S", help=words)
    words = "how mjcf delays commands; default: history, which needs MuJoCo 3.5"
    add("--delay", choices=("history", "filter"), help=words)
    words = "deprecated, without effect: friction that a format lacks is always projected"
    add("--mean-friction", action="store_true", help=words)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command.

    Args:
        options: Its flags.
    """
    from robotid.commands.export import export_result

    chosen = {key: getattr(options, key) for key in ("step", "delay")}
    done = export_result(options.result, options.format, options.out, **chosen)
    show_found(done, options, _show)


def _show(done: dict[str, Any]) -> None:
    print(f"written: {', '.join(done['files'])}")
    for note in done["not_stated"]:
        say(f"  {note}", "  ")
