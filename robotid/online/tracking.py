"""An online identification over a recorded log, as if it came in live; its history in files."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robotid import __version__
from robotid._typing import Array
from robotid.commands.job import Job
from robotid.exceptions import DataError, MissingDependencyError, SettingsError
from robotid.export.result import file_sha256, write_json
from robotid.logs.data import Log
from robotid.logs.formats import write_columns
from robotid.logs.parquet_files import load_pyarrow
from robotid.online.identifier import OnlineIdentifier
from robotid.online.settings import OnlineSettings, Reading
from robotid.robot.model import RobotModel

__all__ = ["Observer", "Track", "run_track", "track"]

Observer = Callable[[int, OnlineIdentifier], None]

_ROWS = 20.0  # [Hz] rows of the history per second
_SCHEMA = 1


@dataclass(frozen=True, eq=False)
class Track:
    """The history of an online identification.

    Attributes:
        identifier: The identifier after the last sample.
        t: Time stamps of the newest sample, shape (N,) [s].
        theta: Base parameters, shape (N, b).
        std_error: Their standard errors, shape (N, b).
        excitation: Share of the prior variance removed, shape (N,).
        converged: Whether the estimate had converged, shape (N,), bool.
    """

    identifier: OnlineIdentifier
    t: Array
    theta: Array
    std_error: Array
    excitation: Array
    converged: Array

    def columns(self) -> dict[str, Array]:
        """Return the history as columns: time, each base parameter and its standard error.

        Returns:
            Columns by name, each of shape (N,).
        """
        table = {"time": self.t}
        for i, name in enumerate(self.identifier.names):
            table[name] = self.theta[:, i]
            table[f"{name}.std_error"] = self.std_error[:, i]
        return {
            **table,
            "excitation": self.excitation,
            "converged": self.converged.astype(float),
        }


def track(
    model: RobotModel, log: Log, settings: OnlineSettings, *, observer: Observer | None = None
) -> Track:
    """Give a log to an online identifier, sample by sample.

    Args:
        model: The robot, with a fixed base.
        log: The log, of the model's joints in its order; its q and tau are used.
        settings: How the identification runs.
        observer: Called after each sample with its row of the log and the identifier.

    Returns:
        The history, about 20 rows a second.

    Raises:
        DataError: If the log is too short for a first estimate, or the base floats.
        SettingsError: If a setting does not fit the log.
    """
    identifier = OnlineIdentifier(model, settings)
    times: list[float] = []
    readings: list[Reading] = []
    for k in range(len(log.t)):
        identifier.update(float(log.t[k]), log.q[k], log.tau[k])
        if observer is not None:
            observer(k, identifier)
        is_due = not times or log.t[k] > times[-1] + 0.999 / _ROWS
        if identifier.is_ready and (is_due or k == len(log.t) - 1):
            times.append(float(log.t[k]))
            readings.append(identifier.reading)
    if not readings:
        raise DataError(
            f"{log.path or 'log'}: the robot moves for less than the warm-up of "
            f"{settings.warmup:g} s, so there is no estimate; give a longer log with motion"
        )
    return Track(
        identifier,
        np.array(times),
        np.array([r.theta for r in readings]),
        np.array([r.std_error for r in readings]),
        np.array([r.excitation for r in readings]),
        np.array([r.converged for r in readings]),
    )


def run_track(
    job: Job, folder: str | Path | None, *, observer: Observer | None = None
) -> dict[str, Any]:
    """Track the one log of a job; write the history and track.json.

    Args:
        job: The robot, the log and the signals' settings.
        folder: Where to write; made if it is missing. Nothing is written if None.
        observer: Called after each sample with its row of the log and the identifier.

    Returns:
        The content of track.json.

    Raises:
        DataError: If the log cannot be used.
        ModelError: If the URDF cannot be used.
        SettingsError: If a setting does not fit.
    """
    model = job.model()
    if len(job.identification) != 1:
        raise SettingsError(f"track takes one log, found {len(job.identification)}")
    log = job.read(job.identification[0], model)
    if job.signals.cutoff is None:
        raise SettingsError("tracking differentiates positions as they come: it needs a cutoff")
    step = float(np.median(np.diff(log.t)))
    settings = OnlineSettings(
        rate=job.signals.rate or 1.0 / step,
        cutoff=job.signals.cutoff,
        min_velocity=job.signals.min_velocity,
    )
    found = track(model, log, settings, observer=observer)
    history = _history_name()
    content = _summary(found, job, log, history)
    if folder is not None:
        target = Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        write_columns(found.columns(), target / history)
        write_json(content, target / "track.json")
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
    return {
        "schema_version": _SCHEMA,
        "robotid": __version__,
        "robot": model.name,
        "joints": list(model.joints),
        "settings": job.to_settings(),
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
            {
                "name": name,
                "expression": expression,
                "value": float(value),
                "std_error": float(error),
                "unit": model.layout.units[i],
            }
            for name, expression, value, error, i in zip(
                mapping.base_names,
                mapping.expressions,
                last.theta,
                last.std_error,
                mapping.independent,
                strict=True,
            )
        ],
        "changes": [_change(identifier, index) for index in range(len(identifier.changes))],
        "history": history,
    }


def _change(identifier: OnlineIdentifier, index: int) -> dict[str, Any]:
    """Return a change, and the load that would explain it, by the end of the log."""
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
