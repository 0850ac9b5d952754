"""robotid track: run the online estimator over a log: history, step changes."""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.files import check_folder, file_sha256, folder_beside, write_json
from robotid.base.text import columns, in_digits_of
from robotid.base.versions import __version__
from robotid.cli.console import Terminated, echo, show_found
from robotid.cli.job import JOB, ONLINE, Job, add_out, add_shown, job_from_flags
from robotid.data.files.read import write_columns
from robotid.data.log import Log
from robotid.dynamics.base_parameters import structural_mapping
from robotid.identification.online import Observer, OnlineIdentifier, OnlineSettings, Track, track
from robotid.output.files.result_file import SCHEMA_VERSION
from robotid.output.viewer.replays import gap_marks, live_page
from robotid.output.viewer.scene import coordinates
from robotid.output.viewer.server import LivePage
from robotid.robot.model import RobotModel

_RATE = 25.0  # [Hz] messages per second of the log
_SLOWEST = 1e-3  # [-] smallest speed, relative to real time


def run_track(job: Job, folder: str | Path, *, observer: Observer | None = None) -> dict[str, Any]:
    """Track the one log of a job, write the history and track.json, and return its content."""
    model = job.model()
    history = "track.parquet" if find_spec("pyarrow") else "track.csv"
    inputs = [job.urdf, *(entry.path for entry in job.identification)]
    check_folder(Path(folder), [history, "track.json"], inputs)
    (entry,) = job.identification
    log = job.read(entry, model)
    if job.signals.cutoff is None:
        raise SettingsError(
            "the cutoff is disabled, but the online estimator differentiates positions; state a "
            "cutoff in Hz"
        )
    rate = job.signals.rate or 1.0 / float(np.median(np.diff(log.t)))
    settings = OnlineSettings(
        rate=rate, cutoff=job.signals.cutoff, min_velocity=job.signals.min_velocity
    )
    tracked = track(model, log, settings, observer=observer)
    content = _summary(tracked, job, log, history)
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    with folder_beside(target) as partial:
        write_columns(tracked.columns(), partial / history)
        write_json(content, partial / "track.json")
    return content


def _summary(tracked: Track, job: Job, log: Log, history: str) -> dict[str, Any]:
    identifier = tracked.identifier
    model, mapping = identifier.model, identifier.mapping
    pairs, last = zip(tracked.t.tolist(), tracked.readings, strict=True), identifier.reading
    converged = [t for t, reading in pairs if reading.converged]
    units = [model.layout.units[i] for i in mapping.independent]
    rows = zip(mapping.base_names, mapping.expressions, last.theta.tolist(),
               last.std_error.tolist(), units, strict=True)  # fmt: skip
    keys = ("name", "expression", "value", "std_error", "unit")
    inputs = {"urdf": str(job.urdf), "log": log.path}
    return {
        "schema_version": SCHEMA_VERSION, "robotid": __version__, "robot": model.name,
        "joints": list(model.joints), "settings": job.to_dict(),
        "inputs": [
            {"role": role, "path": path, "sha256": file_sha256(path)}
            for role, path in inputs.items()
        ],
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


def serve_track(
    job: Job,
    folder: str,
    *,
    port: int = 0,
    speed: float = 1.0,
    announce: Callable[[str], None],
    finished: Callable[[dict[str, Any]], None],
    linger: bool = True,
) -> dict[str, Any]:
    """Track the one log of a job, show it in a live page, and return as ``run_track``."""
    if not (speed == 0 or speed >= _SLOWEST):
        raise SettingsError(f"speed is {speed}, wanted 0, or {_SLOWEST} or more")
    if not 0 <= port < 2**16:
        raise SettingsError(f"port is {port}, wanted 1 to 65535, or 0 for any free port")
    model = job.model()
    log = job.read(job.identification[0], model)
    mapping = structural_mapping(model)
    units = [model.layout.units[i] for i in mapping.independent]
    html = live_page(model, mapping.base_names, units, log.q, model.standard_parameters())
    with LivePage(html, port) as live:
        announce(live.url)
        content = run_track(job, folder, observer=_LiveFeed(live, model, log, speed))
        live.finish()
        finished(content)
        while linger:
            time.sleep(3600.0)
    return content


class _LiveFeed:
    """Sends the estimates of a tracker to a live page, no faster than the time of the log."""

    def __init__(self, live: LivePage, model: RobotModel, log: Log, speed: float) -> None:
        self._live, self._model, self._log, self._speed = live, model, log, speed
        self._due, self._marks = -np.inf, 0
        self._gaps = gap_marks(log.t)  # those that are not sent yet
        self._started = time.monotonic()

    def __call__(self, k: int, identifier: OnlineIdentifier) -> None:
        t, start = float(self._log.t[k]), float(self._log.t[0])
        if t < self._due and k < len(self._log.t) - 1:  # the page ends at the last pose
            return
        self._due = t + 1.0 / _RATE
        while self._gaps and self._gaps[0].t < t:
            self._live.send({"mark": asdict(self._gaps.pop(0))})
        if self._speed > 0:
            ahead = (t - start) / self._speed - (time.monotonic() - self._started)
            time.sleep(max(ahead, 0.0))
        message = {"t": t, "q": coordinates(self._model, self._log.q[k : k + 1])[0].tolist()}
        if identifier.is_ready:
            reading, (tau, predicted) = identifier.reading, identifier.compared
            message |= {
                "at": reading.t, "tau": tau.tolist(), "theta": reading.theta.tolist(),
                "predicted": [x if np.isfinite(x) else None for x in predicted.tolist()],
                "std_error": reading.std_error.tolist(),
            }  # fmt: skip
        self._live.send(message)
        for change in identifier.changes[self._marks :]:
            label = f"step change, detected at {change.flagged:.2f} s"
            mark = {"t": change.onset, "label": label, "kind": "payload"}
            self._live.send({"mark": mark})
        self._marks = len(identifier.changes)


def add_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", metavar="URDF")
    parser.add_argument("logs", nargs=1, metavar="LOG")
    add_out(parser, "robotid-track")
    add_shown(parser, "verbose", json="print track.json")
    JOB.add(parser.add_argument_group("the log"), ONLINE)
    words = "show the run in the browser, in real time"
    parser.add_argument("--serve", nargs="?", const=0, type=int, metavar="PORT", help=words)
    words = "speed of --serve, relative to real time; 0: as fast as possible; default: 1"
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help=words)


def run(options: argparse.Namespace) -> None:
    job = job_from_flags(options)

    def finished(found: dict[str, Any]) -> None:
        show_found(found, options, _show, [found["history"], "track.json"])
        sys.stdout.flush()

    def announce(url: str) -> None:
        print(f"live: {url}  (stop with Ctrl-C)", file=sys.stderr, flush=True)

    if options.serve is None:
        finished(run_track(job, options.out))
        return
    try:
        serve_track(job, options.out, port=options.serve, speed=options.speed, announce=announce,
                    finished=finished)  # fmt: skip
    except Terminated:
        raise
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)


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
