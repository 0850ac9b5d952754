"""robotid track: run the online estimator over a log: history, step changes."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import MissingDependencyError, SettingsError
from robotid.base.files import check_folder, file_sha256, folder_beside, write_json
from robotid.base.text import columns, in_digits_of
from robotid.base.versions import __version__
from robotid.cli.console import echo, show_found
from robotid.cli.flags import (
    JOB,
    ONLINE,
    add_json,
    add_out,
    add_robot_and_log,
    add_verbose,
    job_from_flags,
)
from robotid.cli.job import Job
from robotid.data.files.formats import write_columns
from robotid.data.files.parquet_files import load_pyarrow
from robotid.data.log import Log
from robotid.identification.online import (
    OnlineIdentifier,
    OnlineSettings,
    Track,
    track,
)

_SCHEMA = 1


def run_track(job: Job, folder: str | Path | None) -> dict[str, Any]:
    """Track the one log of a job, write the history and track.json, and return its content."""
    model, history = job.model(), _history_name()
    if folder is not None:
        inputs = [job.urdf, *(entry.path for entry in job.identification)]
        check_folder(Path(folder), [history, "track.json"], inputs)
    if len(job.identification) != 1:
        raise SettingsError(f"{len(job.identification)} logs are given, wanted one to track")
    log = job.read(job.identification[0], model)
    if job.signals.cutoff is None:
        raise SettingsError(
            "the cutoff is disabled, but the online estimator differentiates positions; state a "
            "cutoff in Hz"
        )
    step = float(np.median(np.diff(log.t)))
    settings = OnlineSettings(
        rate=job.signals.rate or 1.0 / step,
        cutoff=job.signals.cutoff,
        min_velocity=job.signals.min_velocity,
    )
    found = track(model, log, settings)
    content = _summary(found, job, log, history)
    if folder is not None:
        target = Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        with folder_beside(target) as partial:
            write_columns(found.columns(), partial / history)
            write_json(content, partial / "track.json")
    return content


def _history_name() -> str:
    try:
        load_pyarrow("writing Parquet")
    except MissingDependencyError:
        return "track.csv"
    return "track.parquet"


def _summary(found: Track, job: Job, log: Log, history: str) -> dict[str, Any]:
    identifier = found.identifier
    model, mapping = identifier.model, identifier.mapping
    converged = np.flatnonzero(found.converged)
    last = identifier.reading
    columns = {
        "name": mapping.base_names,
        "expression": mapping.expressions,
        "value": last.theta.tolist(),
        "std_error": last.std_error.tolist(),
        "unit": [model.layout.units[i] for i in mapping.independent],
    }
    return {
        "schema_version": _SCHEMA,
        "robotid": __version__,
        "robot": model.name,
        "joints": list(model.joints),
        "settings": job.to_dict(),
        "inputs": [
            {"role": "urdf", "path": str(job.urdf), "sha256": file_sha256(job.urdf)},
            {"role": "log", "path": log.path, "sha256": file_sha256(log.path)},
        ],
        "samples": len(log.t),
        "delay": identifier.delay,
        "first_estimate": float(found.t[0]),
        "converged_at": float(found.t[converged[0]]) if len(converged) else None,
        "excitation": last.excitation,
        "sigma": dict(zip(model.row_names, last.sigma.tolist(), strict=True)),
        "base_parameters": [
            dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)
        ],
        "changes": [_change(identifier, index) for index in range(len(identifier.changes))],
        "history": history,
    }


def _change(identifier: OnlineIdentifier, index: int) -> dict[str, Any]:
    """Return a change with its equivalent payload, estimated up to the end of the log."""
    change, load = identifier.changes[index], identifier.payload(index)
    return {
        "flagged": change.flagged,
        "onset": change.onset,
        "payload": {
            "body": identifier.model.layout.bodies[-1],
            "mass": load.mass,
            "std_error": load.mass_std_error,
        },
    }


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add_robot_and_log(parser)
    add_out(parser, "robotid-track")
    add_json(parser, "track.json")
    JOB.add(parser.add_argument_group("the log"), ONLINE)
    add_verbose(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    content = run_track(job_from_flags(options), options.out)
    show_found(content, options, _show, [content["history"], "track.json"])


def _show(found: dict[str, Any]) -> None:
    converged = found["converged_at"]
    when = "not converged" if converged is None else f"converged at {converged:.2f} s"
    echo(
        f"{found['robot']}: {found['samples']} samples, delay of the estimate "
        f"{1e3 * found['delay']:.0f} ms, {when}, excitation {found['excitation']:.2f}"
    )
    for change in found["changes"]:
        load = change["payload"]
        mass, error = in_digits_of(load["mass"], load["std_error"])
        echo(
            f"step change at {change['onset']:.2f} s, detected at {change['flagged']:.2f} s; "
            f"equivalent payload on {load['body']}: {mass} +- {error} kg",
            "  ",
        )
    rows = []
    for entry in found["base_parameters"]:
        value, error = in_digits_of(entry["value"], entry["std_error"])
        rows.append([entry["name"], value, f"+- {error}", entry["unit"]])
    print("\n".join(columns(["", "", "", ""], rows, left=(0, 2, 3))[1:]))
