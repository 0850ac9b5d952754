"""robotid track: run the online estimator over a log: history, step changes."""

import argparse
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.files import check_folder, file_sha256, folder_beside, write_json
from robotid.base.text import columns, in_digits_of
from robotid.base.versions import __version__
from robotid.cli.console import SHOWN, echo, show_found
from robotid.cli.job import JOB, ONLINE, Job, add_out, add_shown, job_from_flags
from robotid.data.files.read import write_columns
from robotid.data.log import Log
from robotid.identification.online import OnlineIdentifier, OnlineSettings, Track, track
from robotid.output.files.result_file import SCHEMA_VERSION


def run_track(job: Job, folder: str | Path) -> dict[str, Any]:
    """Track the one log of a job, write the history and track.json, and return its content."""
    model, target, (entry,) = job.model(), Path(folder), job.identification
    history = "track.parquet" if find_spec("pyarrow") else "track.csv"
    check_folder(target, [history, "track.json"], [job.urdf, entry.path])
    log = job.read(entry, model)
    if job.signals.cutoff is None:
        words = "the cutoff is disabled, but the online estimator differentiates positions"
        raise SettingsError(f"{words}; set a cutoff in Hz")
    rate = job.signals.rate or 1.0 / float(np.median(np.diff(log.t)))
    cutoff, slowest = job.signals.cutoff, job.signals.min_velocity
    settings = OnlineSettings(rate=rate, cutoff=cutoff, min_velocity=slowest)
    tracked = track(model, log, settings)
    content = _summary(tracked, job, log, history)
    target.mkdir(parents=True, exist_ok=True)
    with folder_beside(target) as partial:
        write_columns(tracked.columns(), partial / history)
        write_json(content, partial / "track.json")
    return content


def _summary(tracked: Track, job: Job, log: Log, history: str) -> dict[str, Any]:
    identifier, last = tracked.identifier, tracked.identifier.reading
    model, mapping = identifier.model, identifier.mapping
    pairs = zip(tracked.t.tolist(), tracked.readings, strict=True)
    converged = [t for t, reading in pairs if reading.converged]
    units = [model.layout.units[i] for i in mapping.independent]
    rows = zip(mapping.base_names, mapping.expressions, last.theta.tolist(),
               last.std_error.tolist(), units, strict=True)  # fmt: skip
    keys = ("name", "expression", "value", "std_error", "unit")
    inputs = [("urdf", str(job.urdf)), ("log", log.path)]
    return {
        "schema_version": SCHEMA_VERSION, "robotid": __version__, "robot": model.name,
        "joints": list(model.joints), "settings": job.to_dict(),
        "inputs": [{"role": x, "path": path, "sha256": file_sha256(path)} for x, path in inputs],
        "samples": len(log.t), "delay": identifier.delay, "first_estimate": float(tracked.t[0]),
        "converged_at": converged[0] if converged else None, "excitation": last.excitation,
        "sigma": dict(zip(model.row_names, last.sigma.tolist(), strict=True)),
        "base_parameters": [dict(zip(keys, row, strict=True)) for row in rows],
        "changes": [_change(identifier, index) for index in range(len(identifier.changes))],
        "history": history,
    }  # fmt: skip


def _change(identifier: OnlineIdentifier, index: int) -> dict[str, Any]:
    """Return a change with its equivalent payload, estimated up to the end of the log."""
    change, load = identifier.changes[index], identifier.payload(index)
    body = identifier.model.layout.bodies[-1]
    payload = {"body": body, "mass": load.mass, "std_error": load.mass_std_error}
    return {"flagged": change.flagged, "onset": change.onset, "payload": payload}


def add_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", metavar="URDF")
    parser.add_argument("logs", nargs=1, metavar="LOG")
    add_out(parser, "robotid-track")
    add_shown(parser, "verbose", json="print track.json")
    JOB.add(parser.add_argument_group("the log"), ONLINE)


def run(options: argparse.Namespace) -> None:
    content = run_track(job_from_flags(options), options.out)
    show = partial(_show, is_verbose=options.verbose)
    show_found(content, options, show, [content["history"], "track.json"], options.out)


def _show(content: dict[str, Any], *, is_verbose: bool) -> None:
    converged = content["converged_at"]
    when = "not converged" if converged is None else f"converged at {converged:.2f} s"
    echo(
        f"{content['robot']}: {content['samples']} samples, delay of the estimate "
        f"{1e3 * content['delay']:.0f} ms, {when}, excitation {content['excitation']:.2f}"
    )
    for change in content["changes"]:
        load = change["payload"]
        mass, error = in_digits_of(load["mass"], load["std_error"])
        when = f"at {change['onset']:.2f} s, detected at {change['flagged']:.2f} s"
        payload = f"equivalent payload on {load['body']}: {mass} +- {error} kg"
        echo(f"step change {when}; {payload}", "  ")
    rows, entries = [], content["base_parameters"]
    if not is_verbose:
        ranked = sorted(entries, key=lambda entry: entry["std_error"] / (abs(entry["value"]) or 1))
        entries = [entry for entry in entries if entry in ranked[:SHOWN]]
        echo(f"the {len(entries)} most certain base parameters (all: --verbose)")
    for entry in entries:
        value, error = in_digits_of(entry["value"], entry["std_error"])
        rows.append([entry["name"], value, f"+- {error}", entry["unit"]])
    print("\n".join(columns(["", "", "", ""], rows, left=(0, 2, 3))[1:]))
