"""Logs compared with those of a result, and added to their variation without reading these."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.files import read_json, source_entry, write_json
from robotid.base.findings import Finding
from robotid.cli.work.job import Job, LogEntry
from robotid.cli.work.logs import units_of_logs
from robotid.diagnosis.verdict.unlike_runs import unlike_findings
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.fit import sums_of_logs
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.fitting.survey import SurveyedLog
from robotid.estimation.variation.groups import RunSums, runs_of
from robotid.estimation.variation.variation import vary
from robotid.identification.repeated_errors import with_repeated_errors
from robotid.output.files.result_file import Result, stated_parameters
from robotid.robot.model import RobotModel

_ADVICE = "identify again from all logs"


@dataclass(frozen=True)
class AddedLogs:
    """The variation between the logs of a result and new ones.

    Attributes:
        content: As "variation" of result.json, of all these logs.
        findings: Findings about the new logs that differ, and about their robots.
    """

    content: dict[str, Any]
    findings: tuple[Finding, ...]

    @property
    def shown(self) -> dict[str, Any]:
        """The content without the sums of the logs."""
        return {key: x for key, x in self.content.items() if key != "sums"}

    def write(self, result: Result) -> None:
        """Write the variation to the result.json."""
        content = read_json(result.path, "result")  # with the keys as they are in the file
        write_json({**content, "variation": self.content}, result.path)


def check_update(result: Result, job: Job, entries: Sequence[LogEntry]) -> None:
    """Check that logs can be added to the variation of a result."""
    stated = result.content.get("variation", {})
    if "sums" not in stated:
        raise DataError(
            f"{result.path.name} has no variation to which logs can be added, wanted a result of "
            f"three or more logs with torques; {_ADVICE}"
        )
    known = [x for x in result.content["inputs"] if x["role"] == "identification"]
    of_file = {x["sha256"]: x["path"] for x in (*known, *stated.get("added", ()))}
    for entry in entries:
        own = source_entry(str(entry.path))["sha256"]
        if own in of_file:
            raise DataError(
                f"{entry.path} is {of_file[own]}, which {result.path.name} has already; "
                "leave it out"
            )
        of_file[own] = str(entry.path)
    units_of_logs([*job.identification, *entries])


def add_logs(
    result: Result, model: RobotModel, job: Job, logs: Sequence[SurveyedLog]
) -> AddedLogs | None:
    """Return the variation between the logs of a result and new ones.

    The sums of the new logs about the parameters of the fit are added to those of the others; the
    mixed-effects model is that of all. To first order it is the variation of a fit to all logs.
    """
    stated = result.content.get("variation", {})
    if "sums" not in stated:
        return None
    mapping, before = structural_mapping(model), stated["sums"]
    recordings = with_repeated_errors(Recordings(model, mapping, logs))
    pi, old = stated_parameters(result.content, model), RunSums.from_dict(before)
    shift = np.array(before.get("shift", np.zeros(len(mapping.base_names))))
    sigma = old.sigma if (old.sigma > 0).all() else np.zeros(0)
    wanted = {"sigma": (model.n_rows,), "shift": (len(mapping.base_names),)}
    _require_shapes(result, {"sigma": sigma.shape, "shift": shift.shape}, wanted)
    new = sums_of_logs(recordings, job.estimator, pi, sigma, shift)
    old_sizes, sizes = ({"H": x.H.shape[1:], "scatter": x.scatter.shape} for x in (old, new))
    _require_shapes(result, old_sizes, sizes)
    new_units = [log.unit or any(before["unit"]) * Path(log.path).name for log in logs]
    units = [*before["unit"], *new_units]
    unit_names, unit = np.unique(units, return_inverse=True)
    sums = old.joined(new)
    groups = runs_of(model, mapping, pi, sums, unit)
    names = [*stated["logs"], *(Path(log.path).name for log in logs)]
    varied = vary(names, groups, unit_names.tolist())
    assert varied is not None
    count = len(stated["logs"])
    unlike = replace(
        varied,
        unlike=tuple(each for each in varied.unlike if each.run >= count),
        unlike_units=tuple(each for each in varied.unlike_units if each.run in unit[count:]),
    )
    added = [source_entry(log.path) for log in logs]
    content = varied.to_dict() | {
        "sums": sums.to_dict() | {key: before[key] for key in ("shift",) if key in before}
        | {"unit": units},
        "added": [*stated.get("added", ()), *added],
    }  # fmt: skip
    return AddedLogs(content, tuple(unlike_findings(unlike)))


def _require_shapes(
    result: Result, found: Mapping[str, tuple[int, ...]], wanted: Mapping[str, tuple[int, ...]]
) -> None:
    """Refuse sums of other sizes than those of this version."""
    for key, shape in wanted.items():
        if found[key] != shape:
            raise DataError(
                f"variation.sums.{key} in {result.path.name} has the shape {found[key]}, wanted "
                f"{shape}: another version of robotid wrote it; {_ADVICE}"
            )
