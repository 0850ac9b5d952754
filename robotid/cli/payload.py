"""robotid payload: identify a payload from a log with it and a log without it."""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from robotid.base.exceptions import SettingsError
from robotid.base.files import file_sha256
from robotid.base.findings import listed
from robotid.base.text import columns, in_digits_of
from robotid.base.typing import ProgressCallback, report_stage
from robotid.cli.console import echo, progress_of, show_found
from robotid.cli.job import (
    JOB,
    LOG,
    Job,
    LogEntry,
    add_shown,
    job_from_flags,
    number,
    refuse_log_flags,
)
from robotid.cli.logs import job_of_result, survey_logs
from robotid.diagnosis.verdict.scale_check import PayloadCheck
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.recorded import Recordings, SurveyedLog
from robotid.identification.payload_fit import fit_with_friction, mass_checks
from robotid.identification.summary import cell
from robotid.robot.bodies import usual_links
from robotid.robot.model import RobotModel

_STAGES = ("reading logs", "fitting")


def is_result(path: str | Path) -> bool:
    return Path(path).suffix == ".json" or (Path(path) / "result.json").is_file()


def stated_masses(words: Sequence[str], links: Sequence[str]) -> dict[str, float]:
    """Return the known mass of each payload, by link [kg]."""
    masses = {}
    for word in words:
        link, _, mass = word.rpartition("=")
        if not link and len(links) > 1:
            raise SettingsError(
                f"--mass {word}: the link is ambiguous, expected one of {listed(links)}. "
                "Write --mass LINK=KG"
            )
        masses[link or links[0]] = number(mass, "--mass", "KG or LINK=KG", repr(word))
    return masses


def measure_payload(
    job: Job,
    references: Sequence[str],
    *,
    links: Sequence[str] = (),
    masses: Sequence[str] = (),
    find_gains: bool = False,
    progress: ProgressCallback | None = None,
) -> dict[str, Any]:
    """Identify the payloads of the logs of a job, relative to references without payloads."""
    given, entries = job.gains, [LogEntry(Path(path)) for path in references]
    if any(map(is_result, references)):
        if len(references) > 1:
            wanted = "expected one result alone, or logs"
            raise SettingsError(f"references are {listed(references)}, {wanted}")
        advice = "give a log without the payload: --reference LOG"
        job, entries = job_of_result(job, references[0], advice)
    report_stage(progress, "reading logs", _STAGES)
    model = job.model()
    unknown = [joint for joint in model.joints if joint not in given] if find_gains else []
    job = replace(job, gains={**job.gains, **dict.fromkeys(unknown, 1.0)})
    links = tuple(links) or usual_links(model)
    surveyed = survey_logs(job, model, job.identification, entries)
    mapping, known = structural_mapping(model), stated_masses(masses, links)
    loaded, reference = (Recordings(model, mapping, logs) for logs in surveyed)
    report_stage(progress, "fitting", _STAGES)

    def rescaled(gains: Mapping[str, float]) -> Recordings:
        (runs,) = survey_logs(replace(job, gains={**job.gains, **gains}), model, entries)
        return Recordings(model, mapping, runs)

    return fit_with_friction(
        loaded, reference, job.friction, rescaled, links=links, masses=known, unknown_gains=unknown
    ).to_dict()


def check_payloads(
    job: Job, model: RobotModel, reference: Sequence[SurveyedLog]
) -> tuple[PayloadCheck, ...]:
    """Return the checks of the torque scale with the payloads that a job states."""
    checks = []
    for entry in job.payload_checks:
        (logs,) = survey_logs(job, model, [LogEntry(entry.path, entry.start, entry.end)])
        runs = [Recordings(model, structural_mapping(model), run) for run in (logs, reference)]
        link = entry.link or model.layout.bodies[-1]
        check = mass_checks(*runs, masses={link: entry.mass})[link]
        checks.append(replace(check, log=str(entry.path), sha256=file_sha256(entry.path)))

    def width(check: PayloadCheck) -> float:  # relative, of the interval of an identified mass
        low, high = check.interval
        return (high - low) / check.known if check.identified is not None else float("inf")

    return tuple(sorted(checks, key=width))


def add_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="JOB.toml | URDF")
    add("logs", nargs="*", metavar="LOG", help="logs with the payload, instead of a job file")
    words = "log without the payload, or a result.json or its folder; repeatable"
    add("--reference", required=True, metavar="LOG | RESULT", help=words, action="append")
    words = "link that carries the payload; default: the last moving link; repeatable"
    add("--link", metavar="NAME", help=words, action="append", default=[])
    words = "mass of the payload, if it is known; for several payloads LINK=KG"
    add("--mass", metavar="KG", help=words, action="append", default=[])
    words = "from a known mass, estimate the gains of logged currents without --gain"
    add("--gains", action="store_true", help=words)
    add_shown(parser, "json")
    flags = [flag for flag in LOG if flag != "--ignore"]  # the logs are not examined
    JOB.add(parser.add_argument_group("the logs, unless a RESULT is given"), flags)


def run(options: argparse.Namespace) -> None:
    if any(map(is_result, options.reference)):
        refuse_log_flags(options, "a RESULT has the settings of its logs")
    with progress_of(options) as progress:
        content = measure_payload(
            job_from_flags(options), options.reference, links=options.link, masses=options.mass,
            find_gains=options.gains, progress=progress,
        )  # fmt: skip
    show_found(content, options, _show)


def _show(content: dict[str, Any]) -> None:
    checks = {check["link"]: check for check in content.get("mass_checks", ())}
    for load in content["payloads"]:
        _print_one_payload(load, checks.get(load["link"]))
    errors = [f"{joint} {cell(x)} %" for joint, x in content["relative_error_pct"].items()]
    echo(f"torque prediction error: {listed(errors)}", "  ")
    if "gains" in content:
        checked = "the gains are those with which this payload has the given mass"
        echo(f"{checked}; verify them with another payload or another log of it", "  ")
        print("\n[torque.gains]  # [N m/A], of prismatic joints [N/A]")
        for joint, gain in content["gains"].items():
            low, high = gain["interval"]
            value, _ = in_digits_of(gain["gain"], gain["std_error"])
            print(f"{joint} = {value}  # 95 % interval {low:.4g} to {high:.4g}")


def _print_one_payload(load: Mapping[str, Any], check: Mapping[str, Any] | None) -> None:
    link = load["link"]
    mass, error = in_digits_of(load["mass"], load["mass_std_error"])
    print(f"payload on {link}")
    if error == "-":
        print(f"  mass {load['mass']:g} kg, given")
        if check is not None:
            echo(f"  scale of the torques: {check['message']}", "  ")
    else:
        low, high = (in_digits_of(end, load["mass_std_error"])[0] for end in load["mass_interval"])
        scale = "It is proportional to the torque scale: gains that are 5 % too large add 5 %"
        echo(f"  mass {mass} kg (95 % interval {low} to {high}). {scale}", "  ")
    if load["com"] is not None:
        print(f"  centre of mass in the frame of {link} [m]")
        _print_values(zip("xyz", load["com"], load["com_std_error"], strict=True))
    if load["inertia"] is not None:
        for where, key, errors in (
            ("its centre of mass", "inertia", load["inertia_std_error"]),
            (f"the origin of {link}", "inertia_at_link", [[None] * 3] * 3),
        ):
            echo(f"  inertia about {where}, axes of {link} [kg m^2]", "  ")
            upper = [(i, j) for i in range(3) for j in range(i, 3)]
            inertia = load[key]
            _print_values(
                ("I" + "xyz"[i] + "xyz"[j], inertia[i][j], errors[i][j]) for i, j in upper
            )
    for name, reason in load["reasons"].items():
        what = "centre of mass" if name == "com" else name
        echo(f"  {what}: not determined; {reason}", "  ")


def _print_values(values: Iterable[tuple[str, float, float | None]]) -> None:
    rows = []
    for name, value, error in values:
        shown, half = in_digits_of(value, error)
        rows.append([name, shown, "" if half == "-" else f"+- {half}"])
    print("\n".join(f"  {line}" for line in columns(["", "", ""], rows, left=(0, 2))[1:]))
