"""robotid validate: compute a result's prediction error on other logs."""

import argparse
from typing import Any

from robotid._text import terminal_width
from robotid.cli.flags import add_json
from robotid.cli.printing import echo, print_verdict
from robotid.cli.running import show_found

__all__ = ["SUMMARY", "add_flags", "run"]

SUMMARY = "compute a result's prediction error on other logs"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command.

    Args:
        parser: Its parser.
    """
    add = parser.add_argument
    add("result", metavar="RESULT.json")
    add("logs", nargs="+", metavar="LOG")
    words = "temperature of the drives [degC], where it has an effect; default: that in each log"
    add("--temperature", metavar="DEGC", type=float, help=words)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command.

    Args:
        options: Its flags.
    """
    from robotid.commands.validate import validate_result

    found = validate_result(options.result, options.logs, temperature=options.temperature)
    show_found(found, options, _show)


def _show(found: dict[str, Any]) -> None:
    from robotid.identification.summary import error_lines

    echo(f"predicted with {found['predicted_with']}")
    for recording in found["validation"]:
        echo(f"\n{recording['name']}", "  ")
        print("\n".join(error_lines(recording, width=terminal_width())))
        expected = recording.get("expected", {})
        if "missing" in expected:
            echo(f"no expected rmse: {expected['missing']}", "  ")
        elif expected:
            source = "fit and spread between logs" if expected["with_spread"] else "fit"
            own = [
                f"{joint} {each['rmse']:.3g} ({each['within_95_pct']:.0f} %)"
                for joint, each in expected["per_joint"].items()
                if each["within_95_pct"] is not None
            ]
            echo(
                f"expected rmse by the {source} (share of rows within 95 %): {', '.join(own)}", "  "
            )
    print_verdict(found["verdict"])
