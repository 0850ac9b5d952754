"""Payloads from two runs: logs with them, and logs or a result without."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from robotid._typing import ProgressCallback, report_stage
from robotid.commands.job import Job, LogEntry
from robotid.commands.logs import job_of_result, survey_logs
from robotid.exceptions import SettingsError
from robotid.findings import listed
from robotid.fitting.recordings import Recordings
from robotid.identification.payload_fit import fit_payloads, own_friction
from robotid.regressor.base_parameters import structural_mapping
from robotid.robot.drives import DriveTerm
from robotid.robot.model import RobotModel

__all__ = ["is_result", "measure_payload", "stated_masses"]

_STAGES = ("reading logs", "fitting")


def is_result(path: str | Path) -> bool:
    """Return whether a reference is a result, or its folder, and no log.

    Args:
        path: The reference.
    """
    return Path(path).suffix == ".json" or (Path(path) / "result.json").is_file()


def stated_masses(words: Sequence[str], links: Sequence[str]) -> dict[str, float]:
    """Return the known mass of each payload, by link [kg].

    Args:
        words: "2.8" for the only link, or "tool0=2.8".
        links: The links that are named; "" stands for the one that is not.

    Raises:
        SettingsError: If a mass is no number, or it is not said of which link.
    """
    masses = {}
    for word in words:
        link, _, number = word.rpartition("=")
        if not link and len(links) > 1:
            raise SettingsError(
                f"--mass {word}: of which of the links {listed(links)}? Write --mass LINK=KG"
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
    """Identify what hangs on links in the logs of a job and not in the references.

    Args:
        job: The logs with the payloads, and how logs are read.
        references: Logs without them; or one result, whose logs are read again as it says.
        links: Links that the payloads hang on; the last moving one if empty.
        masses: Masses that are known, as of ``stated_masses``.
        find_gains: Whether the gains that the job does not state are found, too.
        progress: Called as its two stages begin.

    Returns:
        What ``robotid payload --json`` prints.

    Raises:
        DataError: If a log cannot be used, the logs of a result are gone, or the motion does not
            show a mass.
        ModelError: If the URDF cannot be used, or a link is not in it.
        SettingsError: If settings do not fit.
    """
    entries = [LogEntry(Path(path)) for path in references]
    if any(map(is_result, references)):
        if len(references) > 1:
            raise SettingsError(f"one result is a reference by itself; found {listed(references)}")
        job, entries = job_of_result(
            job, references[0], "give a log without the payload instead: --reference LOG"
        )
    report_stage(progress, "reading logs", _STAGES)
    model = job.model()
    unknown = [joint for joint in model.joints if joint not in job.gains] if find_gains else []
    job = replace(job, gains={**job.gains, **dict.fromkeys(unknown, 1.0)})
    links = tuple(links) or model.layout.bodies[-1:]
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
    return found.to_dict()


def _chosen_terms(
    job: Job, model: RobotModel, entries: Sequence[LogEntry]
) -> Mapping[str, tuple[DriveTerm, ...]]:
    """Return the friction that the reference shows beside viscous and Coulomb's, by drive."""
    if not any(job.friction.values()):
        return {}
    (surveyed,) = survey_logs(job, model, entries)
    return own_friction(Recordings(model, structural_mapping(model), surveyed), job.friction)
