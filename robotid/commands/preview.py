"""What motions will tell before they are recorded, and how that compares with what they told."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robotid._files import file_sha256
from robotid.commands.job import Job, LogEntry
from robotid.commands.logs import result_run
from robotid.exceptions import DataError
from robotid.export.entries import build_preview
from robotid.export.result import load_result
from robotid.fitting.survey import SurveyedLog, survey_log
from robotid.identification.previews import preview_logs
from robotid.robot.model import RobotModel

__all__ = ["preview_job"]


def preview_job(
    job: Job,
    given: str | None = None,
    *,
    noise: Mapping[str, float] | None = None,
    correlation: float | None = None,
) -> dict[str, Any]:
    """Preview the logs of a job by their positions alone.

    A result that is given adds what its logs have said, and its noise. If one of the motions is a
    log of that result, all of these are previewed, beside what the result found.

    Args:
        job: The motions, and how logs are read.
        given: A result.json, or its folder; how logs are read is then its own.
        noise: Standard deviation of the torque's noise by joint [N m or N].
        correlation: As of ``preview_logs``.

    Returns:
        What ``robotid preview --json`` prints.

    Raises:
        DataError: If a motion cannot be used, or logs of the result are gone.
        ModelError: If the URDF cannot be used.
        SettingsError: If a setting does not fit.
    """
    stated: dict[str, Any] = {"noise": noise, "correlation": correlation}
    if not job.identification:
        raise DataError("no motion was given; at least one is needed to preview anything")
    if given is None:
        model = job.model()
        motions = _motions(job, model, job.identification)
        return build_preview(preview_logs(model, motions, job.estimator, **stated))
    job, fitted, model, run = result_run(job, given)
    result = load_result(given).content
    hashes = {entry["sha256"] for entry in result["inputs"] if entry["role"] == "identification"}
    if not any(file_sha256(entry.path) in hashes for entry in job.identification):
        motions = _motions(job, model, job.identification)
        return build_preview(preview_logs(model, motions, job.estimator, run=run, **stated))
    motions = _motions(job, model, fitted)
    alone = preview_logs(model, motions, job.estimator, like=run, **stated)
    return _with_achieved(build_preview(alone), result)


def _motions(job: Job, model: RobotModel, entries: Sequence[LogEntry]) -> list[SurveyedLog]:
    """Return motions in memory, read without their torques."""
    found = []
    for entry in entries:
        layout, table = job.lay_out(entry, model, needs="motion")
        window = entry.start, entry.end
        found.append(survey_log(layout, table, model, job.signals, window, length=None))
    return found


def _with_achieved(content: dict[str, Any], result: Mapping[str, Any]) -> dict[str, Any]:
    """Return a preview with what a result of the same logs found beside it."""
    found = {entry["name"]: entry["std_error"] for entry in result["base_parameters"]}
    ratios = []
    for entry in content["base_parameters"]:
        achieved, expected = found.get(entry["name"]), entry["std_error"]
        ratio = achieved / expected if achieved is not None and expected else None
        entry |= {"achieved_std_error": achieved, "ratio": ratio}
        ratios += [ratio] if ratio is not None else []
    for joint, entry in content["noise"].items():
        entry["achieved"] = result["identification"]["per_joint"].get(joint, {}).get("rmse")
    low, middle, high = np.quantile(ratios or [1.0], [0.1, 0.5, 0.9]).tolist()
    content["achieved"] = {"count": len(ratios), "median": middle, "range_80": [low, high]}
    return content
