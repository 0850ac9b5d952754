"""robotid preview: compute the expected standard errors of a motion before it is recorded."""

import argparse
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.files import file_sha256
from robotid.base.findings import listed
from robotid.base.text import columns
from robotid.cli.console import SHOWN, echo, recordings_of, show_found
from robotid.cli.job import (
    JOB,
    MOTION,
    Job,
    LogEntry,
    add_shown,
    job_from_flags,
    pairs,
    refuse_log_flags,
)
from robotid.cli.logs import fitted_hashes, result_run
from robotid.design.previews import preview_logs
from robotid.estimation.fitting.recorded import SurveyedLog, survey_log
from robotid.output.files.entries import build_preview
from robotid.output.files.result_file import load_result, stated_between
from robotid.robot.model import RobotModel


def preview_job(
    job: Job,
    given: str | None = None,
    *,
    noise: Mapping[str, float] | None = None,
    correlation: float | None = None,
) -> dict[str, Any]:
    """Preview the logs of a job from their positions alone."""
    if not job.identification:
        raise DataError("no motion is given, expected at least one to preview")
    about: dict[str, Any] = {"noise": noise, "correlation": correlation}
    if given is None:
        model = job.model()
        motions = _motions(job, model, job.identification)
        return build_preview(preview_logs(model, motions, job.estimator, **about))
    job, fitted, model, run = result_run(job, given)
    result = load_result(given).content
    hashes = fitted_hashes(result)
    new = [x.path for x in job.identification if file_sha256(x.path) not in hashes]
    if len(new) == len(job.identification):
        motions = _motions(job, model, job.identification)
        preview = preview_logs(model, motions, job.estimator, run=run, **about)
        between = stated_between(result, model)
        return build_preview(replace(preview, between=(between,) * len(motions)))
    if new:
        raise DataError(
            f"the given result was fitted to some of these motions, but not to {listed(new)}; "
            "preview fitted logs and new motions separately"
        )
    motions = _motions(job, model, fitted)
    alone = preview_logs(model, motions, job.estimator, like=run, **about)
    return _with_achieved(build_preview(alone), result)


def _motions(job: Job, model: RobotModel, entries: Sequence[LogEntry]) -> list[SurveyedLog]:
    """Return motions in memory, read without their torques."""
    motions = []
    for entry in entries:
        file = job.lay_out(entry, model, needs="motion")
        window = entry.start, entry.end
        motions.append(survey_log(*file, model, job.signals, window, length=None))
    return motions


def _with_achieved(content: dict[str, Any], result: Mapping[str, Any]) -> dict[str, Any]:
    """Return a preview with the achieved standard errors of a result of the same logs."""
    std_errors = {entry["name"]: entry["std_error"] for entry in result["base_parameters"]}
    for entry in content["base_parameters"]:
        achieved, expected = std_errors.get(entry["name"]), entry["std_error"]
        ratio = achieved / expected if achieved is not None and expected else None
        entry |= {"achieved_std_error": achieved, "ratio": ratio}
    for joint, entry in content["noise"].items():
        entry["achieved"] = result["identification"]["per_joint"].get(joint, {}).get("rmse")
    ratios = [entry["ratio"] for entry in content["base_parameters"] if entry["ratio"] is not None]
    low, middle, high = np.quantile(ratios or [1.0], [0.1, 0.5, 0.9]).tolist()
    content["achieved"] = {"count": len(ratios), "median": middle, "range_80": [low, high]}
    return content


_TERM = re.compile(r" [+-] ")  # the sign before each further term of an expression


def add_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="JOB.toml | URDF")
    add("logs", nargs="*", metavar="MOTION", help="motions or logs; only positions are read")
    words = "result.json or its folder: the information of its logs is added; its noise is used"
    add("--given", metavar="RESULT", help=words)
    words = "standard deviation of a joint's torque [N m or N]; repeatable; default: the "
    words += "noise of RESULT, or 1 %% of the joint's largest torque"
    add("--noise", metavar="JOINT=N_M", action="append", default=[], help=words)
    words = "correlation time of the noise [s]; 0: uncorrelated samples; default: 0.1"
    add("--correlation", metavar="S", type=float, help=words)
    words = "print standard parameters and whole expressions, too; print choices on stderr"
    add_shown(parser, "json", verbose=words)
    flags = parser.add_argument_group("instead of a job file or a RESULT, with URDF MOTION")
    JOB.add(flags, ("--estimator", *MOTION))


def run(options: argparse.Namespace) -> None:
    if options.given:
        refuse_log_flags(options, "a RESULT has the settings of its logs")
    job, noise = job_from_flags(options), pairs(options.noise, "--noise")
    content = preview_job(job, options.given, noise=noise, correlation=options.correlation)
    show_found(content, options, partial(_show, is_verbose=options.verbose))


def _show(content: dict[str, Any], *, is_verbose: bool) -> None:
    motions = recordings_of(content["motions"], "motion")
    count = f"{content['structure']['base']} base parameters, estimator {content['estimator']}"
    echo(f"{content['robot']}: {', '.join(motions)}; {count}", "  ")
    entries, shown = content["base_parameters"], content["base_parameters"]
    if not is_verbose:
        largest = sorted(entries, key=lambda e: -(e["std_error"] or math.inf) / e["plausible"])
        shown = [entry for entry in entries if entry in largest[:SHOWN]]
    echo(
        f"\nthe {len(shown)} least determined base parameters: expected standard errors, and their "
        "share of the plausible spread"
    )
    heads = {"std_error_before": "before", "gain": "gain", "achieved_std_error": "achieved",
             "ratio": "ratio"}  # fmt: skip
    keys = {key: head for key, head in heads.items() if key in entries[0]}
    rows = []
    for entry in shown:
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
    echo(f"\nstandard parameters by source, given the URDF: {listed(counts)}", "  ")
    if is_verbose:
        rows = [[e["name"], f"{e['prior']:.4g}", _two_digits(e["std_error"]), e["unit"],
                 e["source"]] for e in parameters]  # fmt: skip
        print("\n".join(columns(["", "prior", "+-", "", "by"], rows, left=(0, 3, 4))))
    else:
        echo("all parameters, and the terms of each base parameter: --verbose")
    _print_expected_torque(content)
    echo(f"\n{content['words']}", "  ")
    if achieved := content.get("achieved"):
        low, high = achieved["range_80"]
        echo(
            f"\nthese logs were identified: of {achieved['count']} achieved standard errors, 80 % "
            f"are {low:.2f} to {high:.2f} times the expected ones; median {achieved['median']:.2f}"
        )


def _print_expected_torque(content: Mapping[str, Any]) -> None:
    """Print each joint's torque with its band, and the assumed or stated noise."""
    echo(
        "\nRMS torque of the motion, half width of the 95 % prediction band, and its part from the "
        "parameters"
    )
    rows, noises = [], content["noise"].values()
    further = ["achieved"] if all("achieved" in noise for noise in noises) else []
    for (joint, torque), noise in zip(content["torque"].items(), noises, strict=True):
        cells = [f"{torque[key]:.3g}" for key in ("rms", "half_width", "of_parameters")]
        achieved = [_two_digits(noise[key]) for key in further]
        rows.append([joint, *cells, _two_digits(noise["std"]), *achieved, torque["unit"],
                     f"{noise['correlation']:.2g} s", noise["is"]])  # fmt: skip
    heads = ["joint", "torque", "band", "part", "noise", *further, "", "over", ""]
    print("\n".join(columns(heads, rows, left=(0, len(heads) - 3, len(heads) - 1))))
    if any(noise["is"] == "assumed" for noise in noises):
        echo(
            "assumed noise: 1 % of the URDF's effort limit, or of the largest torque without a "
            "limit. Standard errors are proportional to it. Give it with --noise JOINT=N_M, or use "
            "the noise of an earlier run with --given RESULT",
            "  ",
        )


def _two_digits(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}"
