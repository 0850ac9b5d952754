"""robotid payload: identify a payload from a log with it and a log without it."""

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from robotid.base.findings import listed
from robotid.base.text import columns, in_digits_of
from robotid.cli.flags import JOB, LOG, add_json, job_from_flags, refuse_log_flags
from robotid.cli.printing import echo
from robotid.cli.running import progress_of, show_found

SUMMARY = "identify a payload from a log with it and a log without it"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add("source", metavar="URDF")
    add("logs", nargs="+", metavar="LOG", help="logs with the payload")
    words = "log without the payload, or a result.json or its folder; repeatable"
    again: dict[str, Any] = {"action": "append", "default": []}
    add("--reference", required=True, metavar="LOG | RESULT", help=words, action="append")
    words = "link that carries the payload; default: the last moving link; repeatable"
    add("--link", metavar="NAME", help=words, **again)
    words = "mass of the payload, if it is known; for several payloads LINK=KG"
    add("--mass", metavar="KG", help=words, **again)
    words = "from a known mass, estimate the gains of logged currents without --gain"
    add("--gains", action="store_true", help=words)
    add_json(parser)
    flags = [flag for flag in LOG if flag != "--ignore"]  # the logs are not examined
    JOB.add(parser.add_argument_group("the logs, unless a RESULT is given"), flags)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from robotid.cli.work.payload import is_result, measure_payload

    if any(map(is_result, options.reference)):
        refuse_log_flags(options, "a RESULT states how its logs are read")
    with progress_of(options) as progress:
        found = measure_payload(
            job_from_flags(options),
            options.reference,
            links=options.link,
            masses=options.mass,
            find_gains=options.gains,
            progress=progress,
        )
    show_found(found, options, _show)


def _show(content: dict[str, Any]) -> None:
    from robotid.identification.summary import cell

    checks = {check["link"]: check for check in content.get("mass_checks", ())}
    for found in content["payloads"]:
        _print_one_payload(found, checks.get(found["link"]))
    errors = [f"{joint} {cell(x)} %" for joint, x in content["relative_error_pct"].items()]
    echo(f"torque prediction error: {listed(errors)}", "  ")
    if "gains" in content:
        checked = "the gains are those with which this payload has the stated mass"
        echo(f"{checked}; verify them with another payload or another log of it", "  ")
        print("\n[torque.gains]")
        for joint, gain in content["gains"].items():
            low, high = gain["interval"]
            value, _ = in_digits_of(gain["gain"], gain["std_error"])
            print(f"{joint} = {value}  # 95 % interval {low:.4g} to {high:.4g}")


def _print_one_payload(found: Mapping[str, Any], check: Mapping[str, Any] | None) -> None:
    link, (low, high) = found["link"], found["mass_interval"]
    mass, error = in_digits_of(found["mass"], found["mass_std_error"])
    print(f"payload on {link}")
    if error == "-":
        print(f"  mass {found['mass']:g} kg, stated")
        if check is not None:
            echo(f"  scale of the torques: {check['message']}", "  ")
    else:
        low, high = (in_digits_of(end, found["mass_std_error"])[0] for end in (low, high))
        echo(
            f"  mass {mass} kg (95 % interval {low} to {high}). It is proportional to the torque "
            "scale: torque gains that are too large give a mass that is too large",
            "  ",
        )
    if found["com"] is not None:
        print(f"  centre of mass in the frame of {link} [m]")
        rows = [
            [axis, *_with_error(x, error)]
            for axis, x, error in zip("xyz", found["com"], found["com_std_error"], strict=True)
        ]
        _print_values(rows)
    if found["inertia"] is not None:
        for where, key in (
            ("its centre of mass", "inertia"),
            (f"the origin of {link}", "inertia_at_link"),
        ):
            echo(f"  inertia about {where}, axes of {link} [kg m^2]", "  ")
            errors = found["inertia_std_error"] if key == "inertia" else None
            rows = [
                [f"I{'xyz'[i]}{'xyz'[j]}", *_with_error(found[key][i][j], errors and errors[i][j])]
                for i in range(3)
                for j in range(i, 3)
            ]
            _print_values(rows)
    for name, reason in found["reasons"].items():
        what = "centre of mass" if name == "com" else name
        echo(f"  {what}: not determined; {reason}", "  ")


def _with_error(value: float, error: float | None) -> list[str]:
    """Return a value in the digits of its error, and the error, as cells."""
    shown, half = in_digits_of(value, error)
    return [shown, "" if half == "-" else f"+- {half}"]


def _print_values(rows: Sequence[Sequence[str]]) -> None:
    for line in columns([""] * len(rows[0]), rows, left=(0, 2))[1:]:
        print(f"  {line}")
