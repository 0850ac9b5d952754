"""Expected standard errors of motions before they are recorded, compared with achieved ones."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.files import file_sha256
from robotid.base.findings import listed
from robotid.cli.work.job import Job, LogEntry
from robotid.cli.work.logs import result_run
from robotid.design.previews import preview_logs
from robotid.estimation.fitting.survey import SurveyedLog, survey_log
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
    """Preview the logs of a job from their positions alone.

    A given result adds the information of its logs, and its noise. If one of the motions is a log
    of that result, all logs of the result are previewed and compared with its standard errors.
    """
    stated: dict[str, Any] = {"noise": noise, "correlation": correlation}
    if not job.identification:
        raise DataError("no motion is given, wanted at least one to preview")
    if given is None:
        model = job.model()
        motions = _motions(job, model, job.identification)
        return build_preview(preview_logs(model, motions, job.estimator, **stated))
    job, fitted, model, run = result_run(job, given)
    result = load_result(given).content
    hashes = {entry["sha256"] for entry in result["inputs"] if entry["role"] == "identification"}
    is_fitted = {entry.path: file_sha256(entry.path) in hashes for entry in job.identification}
    if not any(is_fitted.values()):
        motions = _motions(job, model, job.identification)
        found = preview_logs(model, motions, job.estimator, run=run, **stated)
        between = stated_between(result, model)
        return build_preview(replace(found, between=(between,) * len(motions)))
    if not all(is_fitted.values()):
        new = listed([path for path, own in is_fitted.items() if not own])
        raise DataError(
            f"the given result was fitted to some of these motions, but not to {new}; preview "
            "fitted logs and new motions separately"
        )
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
    """Return a preview with the achieved standard errors of a result of the same logs."""
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
