"""robotid preview: compute the expected standard errors of a motion before it is recorded."""

import argparse
import re
from collections.abc import Mapping
from functools import partial
from typing import Any

from robotid.base.findings import listed
from robotid.base.text import columns
from robotid.cli.flags import (
    JOB,
    MOTION,
    add_json,
    job_from_flags,
    pairs,
    refuse_log_flags,
)
from robotid.cli.printing import echo, recordings_of
from robotid.cli.running import show_found

SUMMARY = "compute the expected standard errors of a motion before it is recorded"
_TERM = re.compile(r" [+-] ")  # the sign before each further term of an expression


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add("source", metavar="JOB.toml | URDF")
    add("logs", nargs="*", metavar="MOTION", help="motions or logs; only positions are read")
    words = "result.json or its folder: the information of its logs is added; its noise is used"
    add("--given", metavar="RESULT", help=words)
    words = "standard deviation of a joint's torque [N m or N]; repeatable; default: that "
    words += "of RESULT, or 1 %% of the joint's largest torque"
    add("--noise", metavar="JOINT=N_M", action="append", default=[], help=words)
    words = "correlation time of the noise [s]; 0: uncorrelated samples; default: 0.1"
    add("--correlation", metavar="S", type=float, help=words)
    add_json(parser)
    words = "print standard parameters and whole expressions, too; print choices on stderr"
    parser.add_argument("--verbose", action="store_true", help=words)
    flags = parser.add_argument_group("instead of a job file or a RESULT, with URDF MOTION")
    JOB.add(flags, ("--estimator", *MOTION))


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from robotid.cli.work.preview import preview_job

    if options.given:
        refuse_log_flags(options, "a RESULT states how its logs are read")
    stated = {"noise": stated_noise(options), "correlation": options.correlation}
    show_found(
        preview_job(job_from_flags(options), options.given, **stated),
        options,
        partial(_show, is_verbose=options.verbose),
    )


def stated_noise(options: argparse.Namespace) -> dict[str, float]:
    """Return the noise that the flags state, by joint [N m or N]."""
    return pairs(options.noise, "--noise")


def _show(content: dict[str, Any], *, is_verbose: bool) -> None:
    motions = recordings_of(content["motions"], "motion")
    count = f"{content['structure']['base']} base parameters, by {content['estimator']}"
    echo(f"{content['robot']}: {', '.join(motions)}; {count}", "  ")
    echo("\nbase parameters: expected standard errors, and their share of the plausible spread")
    keys = {"std_error_before": "before", "gain": "gain", "achieved_std_error": "achieved",
            "ratio": "ratio"}  # fmt: skip
    keys = {key: head for key, head in keys.items() if key in content["base_parameters"][0]}
    rows = []
    for entry in content["base_parameters"]:
        error, more = entry["std_error"], len(_TERM.findall(entry["expression"]))
        short = f"{entry['name']} + {more} more" if more else entry["name"]
        left = "open" if error is None else f"{100 * min(error / entry['plausible'], 1):.0f} %"
        name = entry["expression"] if is_verbose else short
        rows.append([name, _two_digits(error), entry["unit"], left,
                     *(_two_digits(entry[key]) for key in keys)])  # fmt: skip
    print("\n".join(columns(["", "+-", "", "left", *keys.values()], rows, left=(0, 2))))
    parameters = [*content["standard_parameters"], *content["drive_parameters"]]
    sources = [entry["source"] for entry in parameters]
    counts = [f"{sources.count(source)} {source}" for source in dict.fromkeys(sources)]
    echo(f"\nstandard parameters, given the URDF: by {listed(counts)}", "  ")
    if is_verbose:
        rows = [
            [e["name"], f"{e['prior']:.4g}", _two_digits(e["std_error"]), e["unit"], e["source"]]
            for e in parameters
        ]
        print("\n".join(columns(["", "prior", "+-", "", "by"], rows, left=(0, 3, 4))))
    else:
        echo("each standard parameter, and the terms of each base parameter: --verbose")
    _print_expected_torque(content)
    echo(f"\n{content['words']}", "  ")
    if "achieved" in content:
        achieved = content["achieved"]
        echo(
            f"\nthese logs were identified: of {achieved['count']} achieved standard errors, 80 % "
            "are {:.2f} to {:.2f} times the expected ones; median {:.2f}".format(
                *achieved["range_80"], achieved["median"]
            )
        )


def _print_expected_torque(content: Mapping[str, Any]) -> None:
    """Print each joint's torque with its band, and the assumed or stated noise."""
    echo(
        "\nRMS torque of the motion, half width of the 95 % prediction band, and the part of it "
        "that the uncertainty of the parameters causes"
    )
    rows, noises = [], content["noise"].values()
    found = ["achieved"] if all("achieved" in noise for noise in noises) else []
    for (joint, torque), noise in zip(content["torque"].items(), noises, strict=True):
        cells = [f"{torque[key]:.3g}" for key in ("rms", "half_width", "of_parameters")]
        achieved = [_two_digits(noise[key]) for key in found]
        rows.append([joint, *cells, _two_digits(noise["std"]), *achieved, torque["unit"],
                     f"{noise['correlation']:.2g} s", noise["is"]])  # fmt: skip
    heads = ["joint", "torque", "band", "part", "noise", *found, "", "over", ""]
    print("\n".join(columns(heads, rows, left=(0, len(heads) - 3, len(heads) - 1))))
    if any(noise["is"] == "assumed" for noise in noises):
        echo(
            "assumed noise: 1 % of the URDF's effort limit, or of the largest torque of the bodies "
            "where there is no limit. Standard errors are proportional to the noise. State it with "
            "--noise JOINT=N_M, or use that of an earlier run with --given RESULT",
            "  ",
        )


def _two_digits(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}"
