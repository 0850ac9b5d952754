"""Payloads from two runs: logs with them, and logs or a result without them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from robotid.base.exceptions import SettingsError
from robotid.base.files import file_sha256
from robotid.base.findings import listed
from robotid.base.typing import ProgressCallback, report_stage
from robotid.cli.work.job import Job, LogEntry
from robotid.cli.work.logs import job_of_result, survey_logs
from robotid.diagnosis.verdict.payload_check import PayloadCheck
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.fitting.survey import SurveyedLog
from robotid.identification.payload_fit import fit_payloads, mass_checks, own_friction
from robotid.robot.bodies import usual_links
from robotid.robot.drives import DriveTerm
from robotid.robot.model import RobotModel

_STAGES = ("reading logs", "fitting")


def is_result(path: str | Path) -> bool:
    """Return whether a reference is a result or its folder, not a log."""
    return Path(path).suffix == ".json" or (Path(path) / "result.json").is_file()


def stated_masses(words: Sequence[str], links: Sequence[str]) -> dict[str, float]:
    """Return the known mass of each payload, by link [kg]."""
    masses = {}
    for word in words:
        link, _, number = word.rpartition("=")
        if not link and len(links) > 1:
            raise SettingsError(
                f"--mass {word}: the link is ambiguous, wanted one of {listed(links)}. "
                "Write --mass LINK=KG"
            )
        try:
            masses[link or next(iter(links), "")] = float(number)
        except ValueError as error:
            raise SettingsError(f"--mass {word!r}: wanted KG or LINK=KG") from error
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
    entries = [LogEntry(Path(path)) for path in references]
    if any(map(is_result, references)):
        if len(references) > 1:
            raise SettingsError(
                f"references are {listed(references)}, wanted one result alone, or logs"
            )
        job, entries = job_of_result(
            job, references[0], "give a log without the payload: --reference LOG"
        )
    report_stage(progress, "reading logs", _STAGES)
    model = job.model()
    unknown = [joint for joint in model.joints if joint not in job.gains] if find_gains else []
    job = replace(job, gains={**job.gains, **dict.fromkeys(unknown, 1.0)})
    links = tuple(links) or usual_links(model)
    surveyed = survey_logs(job, model, job.identification, entries)
    mapping = structural_mapping(model)
    loaded, reference = (Recordings(model, mapping, logs) for logs in surveyed)
    known = stated_masses(masses, links)
    report_stage(progress, "fitting", _STAGES)
    found = fit_payloads(loaded, reference, links=links, masses=known, unknown_gains=unknown)
    gains = {joint: gain.value for joint, gain in found.gains.items()}
    own = _chosen_terms(replace(job, gains={**job.gains, **gains}), model, entries)
    if own:
        loaded, reference = (run.with_model(model.with_terms(own)) for run in (loaded, reference))
        found = fit_payloads(loaded, reference, links=links, masses=known, unknown_gains=unknown)
    if known and not unknown:
        found = replace(found, checks=mass_checks(loaded, reference, masses=known, links=links))
    return found.to_dict()


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
    return tuple(sorted(checks, key=_width))


def _width(check: PayloadCheck) -> float:
    """Return the relative width of the interval of an identified mass; inf without one."""
    low, high = check.interval
    return (high - low) / check.known if check.identified is not None else float("inf")


def _chosen_terms(
    job: Job, model: RobotModel, entries: Sequence[LogEntry]
) -> Mapping[str, tuple[DriveTerm, ...]]:
    """Return the friction terms of the reference beyond viscous and Coulomb, by drive."""
    if not any(job.friction.values()):
        return {}
    (surveyed,) = survey_logs(job, model, entries)
    return own_friction(Recordings(model, structural_mapping(model), surveyed), job.friction)
